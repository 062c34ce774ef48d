"""Eight and sixteen bits a channel against floats in a pre-integrated table.

    python -m experiments.quantised_table bluntfin.vtu [--size 512] [--out FOLDER] [--json FILE]
        [--tiny]

Kraus, Qiao and Ebert 2004, Figure 7: with eight bits the colour and opacity of a thin segment are
a few steps of 1/255, or none, and many thin segments add up to structured bands. Tables are built
in float32 and rounded at the copy, as in Callahan et al. 2005, section 4.1. Two shapes: 256 x 256
scalars and 16 logarithmic lengths as in the first paper, and 128^3 as in the others. What rounding
costs is the difference from the table in floats; what the table costs, that from `Analytic`.
Tables reach to the longest segment in view. Compositing is in float32 throughout, so the paper's
other artifact, of the frame buffer, is absent.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import jaxvr
from experiments.common import errors, run_on_pictures, shells, table
from jaxvr import plot

TABLES = {
    "log": {"size": (256, 256, 16), "scale": "log"},
    "linear": {"size": (128, 128, 128), "scale": "linear"},
}
# Where the window of the pictures lies, as parts of the picture: row, column, side.
WINDOW = (0.34, 0.22, 0.24)


def run(
    mesh: jaxvr.TetMesh,
    out: Path | None = None,
    *,
    size: int = 512,
    tables: dict[str, dict[str, Any]] = TABLES,
    depth: float = 20.0,
) -> dict[str, Any]:
    """Errors for each table and number of bits; with `out`, pictures of each table.

    mesh: in float32. depth: of the transfer function, see `experiments.common.shells`.
    """
    camera = jaxvr.Camera.orbit(mesh, azimuth=-60, zoom=1.4, width=size, height=size)
    segments = jaxvr.trace(mesh, camera)
    transfer = shells(mesh, 64, depth=depth, floor=0.05)
    exact = np.asarray(jaxvr.shade(segments, transfer))
    # Nodes of no length are entries and jumps.
    lengths = np.asarray(segments.length[: segments.count])
    report: dict[str, Any] = {
        "size": size,
        "depth": depth,
        "segments": int((lengths > 0).sum()),
        "pixels": int((exact[..., 3] > 0).sum()),
        "largest_alpha": float(exact[..., 3].max()),
        "tables": [],
    }
    print({k: v for k, v in report.items() if k != "tables"}, flush=True)
    for name, form in tables.items():
        pictures = {}
        for bits in (None, 16, 8):
            integrator = jaxvr.PreIntegration(**form, bits=bits)
            pictures[bits] = np.asarray(jaxvr.shade(segments, transfer, integrator=integrator))
        for against, reference in (("Analytic", exact), ("float", pictures[None])):
            for bits, image in pictures.items():
                if image is not reference:
                    row = {"table": name, "bits": bits or "float", "against": against}
                    report["tables"].append(row | errors(image, reference))
        if out is not None:
            out.mkdir(parents=True, exist_ok=True)
            n = " x ".join(map(str, form["size"]))
            titles = ["8 bits", "16 bits", "float32", "Analytic"]
            titles[:3] = [f"{title}, {n}, {name}" for title in titles[:3]]
            row, column, side = (int(x * size) for x in WINDOW)
            axes = plot.against(
                [pictures[8], pictures[16], pictures[None]],
                exact,
                titles,
                window=(row, column, side),
            )
            axes.savefig(out / f"quantised_table_{name}.png", dpi=150)
    print(table(report["tables"]), flush=True)
    return report


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    tiny = {"size": 16, "tables": {"log": {"size": (16, 16, 16), "scale": "log"}}}
    return run_on_pictures(run, __doc__, arguments, tiny)


if __name__ == "__main__":
    main()
