"""DiffDVR's protocol for fitting a transfer function, on an unstructured mesh.

    python -m experiments.fit_transfer bluntfin.vtu --size 512 --out output/bluntfin

Weiss and Westermann, "Differentiable direct volume rendering" (2021), section 6.2: eight views on a
Fibonacci sphere; a reference of 256 control points, 64 to fit, from noise, colours behind a sigmoid
and extinctions behind a softplus; L1 loss and 0.4 times the mean squared difference of neighbouring
colours; Adam with rate 0.8, 200 iterations; PSNR and SSIM on a view held out.

Schedules:

    diffdvr   just that.
    decay     the same 200 iterations over all rays of all views, with the rate falling from 0.4 to
              0 along a cosine and Adam's moments forgetting faster (b1 0.8, b2 0.95, for gradients
              that shrink as the loss does), and the prior falling to 0 in the first half: it starts
              the fit well, but with it the true colours are no minimum.
    batches   as many rays in all, as 8 random minibatches for each pass over the views: 1600 steps
              with the rate falling from 0.2 along a cosine, without a prior.

Cases: 64 control points fitted to a reference of 256 ("256"), and to one of the same 64 ("64").
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import optax

import jaxvr
from experiments.common import diagonal, shells, write_json
from jaxvr.fit import noise
from jaxvr.pictures import save_fit

VIEWS = 8
POINTS = 64


def schedule(name: str, passes: int) -> dict[str, Any]:
    """Keywords of `fit` for `passes` over all views."""
    cosine = optax.cosine_decay_schedule
    if name == "diffdvr":
        return {"learning_rate": 0.8, "smoothness": 0.4, "iterations": passes}
    if name == "decay":
        return {
            "optimizer": optax.adam(cosine(0.4, passes), b1=0.8, b2=0.95),
            "smoothness": lambda i: 0.4 * max(0.0, 1 - 2 * i / passes) ** 2,
            "iterations": passes,
        }
    if name == "batches":
        return {"learning_rate": cosine(0.2, VIEWS * passes), "iterations": VIEWS * passes}
    raise ValueError(f"schedule must be diffdvr, decay or batches, but is {name!r}.")


def run(
    volume: Any,
    out: Any,
    *,
    size: int = 512,
    reference_points: int = 256,
    schedules: tuple[str, ...] = ("diffdvr", "decay", "batches"),
    passes: int = 200,
    uncached: int = 3,
    depth: float = 40.0,
    seed: int = 0,
    progress: bool | None = None,
) -> dict[str, Any]:
    """One case: writes pictures and report.json under `out`, and returns the report.

    volume: a `TetMesh`. size: pixels along a side. passes: over all rays. uncached: iterations to
    time without cached segments; 0 leaves that out. depth: optical depth of the reference along the
    diagonal at its highest peak.
    """
    out = Path(out)
    reference = shells(volume, reference_points, depth=depth)
    pixels = {"width": size, "height": size}
    cameras = jaxvr.Camera.sphere(volume, VIEWS, **pixels)
    held_out = jaxvr.Camera.orbit(volume, azimuth=75.0, elevation=35.0, **pixels)
    targets = [np.asarray(jaxvr.render(volume, c, reference)) for c in cameras]
    unseen = np.asarray(jaxvr.render(volume, held_out, reference))
    lo, hi = (float(reference.positions[k]) for k in (0, -1))
    positions = np.linspace(lo, hi, POINTS).astype(reference.dtype)
    start = noise(positions, 0.25 * depth / diagonal(volume), seed)
    report: dict[str, Any] = {
        "size": size,
        "reference_points": reference_points,
        "fitted_points": POINTS,
        "volume": volume.describe(),
        "schedules": {},
    }
    first = np.asarray(jaxvr.render(volume, held_out, start))
    report["start"] = {"psnr": float(jaxvr.psnr(first, unseen))}
    common = {"held_out": ([held_out], [unseen]), "seed": seed, "progress": progress}
    for name in schedules:
        keywords = schedule(name, passes)
        if name == "batches":
            keywords["rays"] = size * size
        result = jaxvr.fit(start, volume, cameras, targets, **keywords, **common)
        folder = result.save(out / name)
        fitted = result.held_out_images[0]
        save_fit(folder, unseen, first, fitted, result.transfer, reference, background=np.ones(3))
        numbers = result.report()
        report["schedules"][name] = {
            key: numbers[key] for key in ("iterations", "held_out", "seconds", "cached_bytes")
        } | {"final_loss": numbers["loss"][-1]}
        scores, seconds = numbers["held_out"][0], numbers["seconds"]
        print(
            f"{out.name} {size}x{size}, 64 to {reference_points}, {name}: held-out PSNR "
            f"{scores['psnr']:.2f} dB, SSIM {scores['ssim']:.6f}, {numbers['iterations']} "
            f"iterations of {seconds['per_iteration']:.4f} s",
            flush=True,
        )
    if uncached:
        timed = jaxvr.fit(
            start, volume, cameras, targets, cache=False, iterations=uncached + 1, seed=seed
        )
        report["seconds_per_iteration_uncached"] = timed.report()["seconds"]["per_iteration"]
        print(f"without cached segments: {report['seconds_per_iteration_uncached']:.4f} s")
    write_json(out / "report.json", report)
    return report


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("mesh", type=Path, nargs="?", help="any mesh file; none: a small box")
    parser.add_argument("--field")
    parser.add_argument("--out", type=Path, default=Path("output/fit_transfer"))
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--passes", type=int, default=200)
    parser.add_argument("--depth", type=float, default=40.0)
    parser.add_argument("--cases", type=int, nargs="+", default=[256, 64], metavar="POINTS")
    parser.add_argument("--schedules", nargs="+", default=["diffdvr", "decay", "batches"])
    parser.add_argument("--uncached", type=int, default=3, help="iterations to time (0: none)")
    parser.add_argument("--tiny", action="store_true", help="a few pixels and passes")
    a = parser.parse_args()
    if a.mesh is not None:
        volume = jaxvr.read_mesh(a.mesh, field=a.field)
    else:
        volume = jaxvr.datasets.box((4, 4, 4), jitter=0.2)
    for points in a.cases:
        run(
            volume,
            a.out / f"from_{points}",
            size=16 if a.tiny else a.size,
            reference_points=points,
            schedules=tuple(a.schedules),
            passes=20 if a.tiny else a.passes,
            uncached=a.uncached,
            depth=a.depth,
            progress=True,
        )


if __name__ == "__main__":
    main()
