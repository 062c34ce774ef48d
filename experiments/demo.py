"""The demo: a transfer function recovered from pictures of a heat sink that is made here.

    python -m experiments.demo --out output/demo

The steady heat equation is solved on a finned block, eight views are rendered with a transfer
function of five translucent shells, and starting from noise another one is fitted to those views.
It is judged by a view that the fit has not seen. About a minute on two cores.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
import optax

import jaxvr
from experiments.common import shells, write_json
from jaxvr.fit import noise
from jaxvr.pictures import save_fit

BACKGROUND = np.ones(3)
# Centre, width, height: the cool fins dense enough to be seen, the chip through all of it.
PEAKS = (
    (0.10, 0.06, 0.3),
    (0.30, 0.04, 0.4),
    (0.52, 0.05, 0.5),
    (0.72, 0.04, 0.7),
    (0.92, 0.06, 1),
)


def run(
    out: Any, *, tiny: bool = False, progress: bool | None = None, seed: int = 0
) -> dict[str, Any]:
    """Writes pictures and report.json to the folder `out`; returns the report."""
    begin = time.perf_counter()
    size, number, iterations = (16, 3, 40) if tiny else (256, 8, 400)
    volume = jaxvr.datasets.heat_sink(**({"fins": 2} if tiny else {}))
    reference = shells(volume, 64, "turbo", depth=40.0, peaks=PEAKS, floor=0.04)
    cameras = jaxvr.Camera.sphere(volume, number, zoom=1.1, width=size, height=size)
    # The view to judge by: from the side, a little above.
    held_out = jaxvr.Camera.orbit(
        volume, azimuth=35.0, elevation=25.0, zoom=1.1, width=size, height=size
    )
    targets = [np.asarray(jaxvr.render(volume, c, reference)) for c in cameras]
    unseen = np.asarray(jaxvr.render(volume, held_out, reference))
    start = noise(reference.positions, np.mean(reference.extinctions), seed)
    result = jaxvr.fit(
        start,
        volume,
        cameras,
        targets,
        rays=min(8192, number * size * size // 2),
        iterations=iterations,
        optimizer=optax.adam(optax.cosine_decay_schedule(0.3, iterations), b2=0.95),
        held_out=([held_out], [unseen]),
        seed=seed,
        progress=progress,
    )
    first = jaxvr.render(volume, held_out, start)
    folder = result.save(out)
    fitted = result.held_out_images[0]
    save_fit(folder, unseen, first, fitted, result.transfer, reference, background=BACKGROUND)
    report = result.report() | {
        "volume": volume.describe(),
        "start_psnr": float(jaxvr.psnr(np.asarray(first), unseen)),
        "seconds_in_all": time.perf_counter() - begin,
    }
    write_json(folder / "report.json", report)
    return report


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("output/demo"))
    parser.add_argument("--tiny", action="store_true", help="a few pixels and iterations")
    arguments = parser.parse_args()
    print("Rendering eight views of a heat sink, then fitting a transfer function to them ...")
    report = run(arguments.out, tiny=arguments.tiny, progress=True)
    scores = report["held_out"][0]
    seconds = report["seconds"]
    print(
        f"View held out of the fit: PSNR {report['start_psnr']:.1f} dB at the start, "
        f"{scores['psnr']:.1f} dB fitted, SSIM {scores['ssim']:.5f}.\n"
        f"{report['iterations']} iterations of {seconds['per_iteration'] * 1e3:.0f} ms, "
        f"{report['seconds_in_all']:.0f} s in all.\nWritten:"
    )
    for file in sorted(arguments.out.iterdir()):
        print(f"  {file}")


if __name__ == "__main__":
    main()
