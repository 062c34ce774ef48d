"""Full against partial pre-integration under sharp peaks.

    python -m experiments.full_vs_partial bluntfin.vtu [--size 512] [--out FOLDER] [--json FILE]
        [--tiny]

Espinha and Celes 2005, Figure 8: a table over both scalars and the length blurs what lies between
its nodes, a table of psi does not know the transfer function and so cannot. Here each peak's foot
is half a node's distance of the 128^3 table wide on either side of its tip. Full tables in floats
and, as in the paper, in eight bits; psi by the default bicubic lookup and by the papers' 512 x 512
tables in gamma coordinates; each against `Analytic`, and that against itself in float64. All shade
the same segments, traced in float32, and full tables reach to the longest of them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxvr
from experiments.common import (
    errors,
    in_float64,
    run_on_pictures,
    spikes,
    table,
)
from jaxvr import plot

INTEGRATORS = {
    "full, 128^3": jaxvr.PreIntegration(),
    "full, 128^3, 8 bits": jaxvr.PreIntegration(bits=8),
    "full, 256^2 x 16, log": jaxvr.PreIntegration((256, 256, 16), "log"),
    "partial, bicubic 128^2": jaxvr.PartialPreIntegration(),
    "partial, bilinear 512^2": jaxvr.PartialPreIntegration(512, "bilinear"),
    "partial, nearest 512^2": jaxvr.PartialPreIntegration(512, "nearest"),
}
# Tips of the peaks as parts of the range, and from a tip to its foot.
TIPS = (0.12, 0.22, 0.34, 0.5, 0.7)
HALF_WIDTH = 1 / 256
# Where the window of the picture lies, as parts of it: row, column, side.
WINDOW = (0.33, 0.1, 0.24)


def run(
    mesh: jaxvr.TetMesh,
    out: Path | None = None,
    *,
    size: int = 512,
    integrators: dict[str, Any] = INTEGRATORS,
) -> dict[str, Any]:
    """Errors of each integrator; with `out`, pictures of those that the paper compares.

    mesh: in float32; one picture is shaded in float64, for which jax_enable_x64 must be on.
    """
    camera = jaxvr.Camera.orbit(mesh, azimuth=-60, zoom=1.4, width=size, height=size)
    segments = jaxvr.trace(mesh, camera)
    transfer = spikes(mesh, TIPS, HALF_WIDTH, depth=400.0, floor=0.002)
    exact = np.asarray(jaxvr.shade(segments, transfer))
    wide = jaxvr.shade(in_float64(segments), in_float64(transfer))
    rows = [{"integrator": "Analytic, against float64"} | errors(exact, wide)]
    pictures = {}
    for name, integrator in integrators.items():
        pictures[name] = np.asarray(jaxvr.shade(segments, transfer, integrator=integrator))
        rows.append({"integrator": name} | errors(pictures[name], exact))
    print(table(rows), flush=True)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        shown = [name for name in pictures if "log" not in name and "nearest" not in name]
        row, column, side = (int(x * size) for x in WINDOW)
        axes = plot.against(
            [pictures[name] for name in shown],
            exact,
            [*shown, "Analytic"],
            window=(row, column, side),
        )
        axes.savefig(out / "full_vs_partial.png", dpi=150)
    return {
        "size": size,
        "tips": TIPS,
        "half_width": HALF_WIDTH,
        "control_points": len(transfer.positions),
        "errors": rows,
    }


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    jax.config.update("jax_enable_x64", True)
    small = {name: INTEGRATORS[name] for name in ("full, 128^3", "partial, bicubic 128^2")}
    small["full, 128^3"] = jaxvr.PreIntegration((16, 16, 16))
    return run_on_pictures(run, __doc__, arguments, {"size": 16, "integrators": small})


if __name__ == "__main__":
    main()
