"""Linear against logarithmic lengths in a pre-integrated table of the same size.

    python -m experiments.log_table bluntfin.vtu [--size 512] [--out FOLDER] [--json FILE] [--tiny]

Kraus, Qiao and Ebert 2004, Figure 10: where the longest edge of a mesh is very many times as long
as the shortest, a table with evenly spaced lengths has no slices for most segments, and pictures
get darker. Here both tables, with 256 x 256 scalars as in the paper and more and more lengths, are
compared with `Analytic`. The tables reach to the longest edge of the mesh, as in the paper, so
pictures are made by `render`, not `shade`, whose tables reach to the longest segment in view. Two
transfer functions: two sharp peaks like isosurfaces, but wide enough for 256 nodes to follow, and
five broad shells.
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
    shells,
    spikes,
    table,
)
from jaxvr import plot


def edge_lengths(mesh: jaxvr.TetMesh) -> np.ndarray:
    """Lengths (6, T) of the edges of each tetrahedron."""
    corner = np.asarray(mesh.points, np.float64)[np.asarray(mesh.cells)]
    pairs = [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
    return np.stack([np.linalg.norm(corner[:, i] - corner[:, j], axis=-1) for i, j in pairs])


def run(
    mesh: jaxvr.TetMesh,
    out: Path | None = None,
    *,
    size: int = 512,
    nodes: int = 256,
    slices: tuple[int, ...] = (8, 16, 32, 128),
    shown: int = 16,
    functions: tuple[str, ...] = ("peaks", "shells"),
) -> dict[str, Any]:
    """Errors of both tables for each number of slices; with `out`, pictures of those with `shown`.

    mesh: in float32; one picture is made in float64, for which jax_enable_x64 must be on.
    """
    edges = edge_lengths(mesh)
    report: dict[str, Any] = {
        "size": size,
        "nodes": nodes,
        "longest_edge": float(edges.max()),
        "edge_ratio": float(edges.max() / edges.min()),
        "edge_ratio_of_a_cell": float((edges.max(0) / edges.min(0)).max()),
        "edges_below_a_sixteenth": float((edges < edges.max() / 16).mean()),
        "transfer": {},
    }
    print({k: v for k, v in report.items() if k != "transfer"}, flush=True)
    camera = jaxvr.Camera.orbit(mesh, azimuth=-60, zoom=1.4, width=size, height=size)
    transfers = {
        "peaks": spikes(mesh, (0.3, 0.6), 0.02),
        "shells": shells(mesh, 64),
    }
    for name in functions:
        transfer = transfers[name]
        exact = np.asarray(jaxvr.render(mesh, camera, transfer))
        wide = jaxvr.render(*(in_float64(x) for x in (mesh, camera, transfer)))
        rows = [{"table": f"Analytic, {mesh.dtype}", "slices": 0} | errors(exact, wide)]
        pictures = {}
        for n in slices:
            for scale in ("linear", "log"):
                integrator = jaxvr.PreIntegration((nodes, nodes, n), scale)
                image = np.asarray(jaxvr.render(mesh, camera, transfer, integrator=integrator))
                rows.append({"table": scale, "slices": n} | errors(image, wide))
                if n == shown:
                    pictures[scale] = image
        print(f"\n{name}: against Analytic in float64\n{table(rows)}", flush=True)
        report["transfer"][name] = rows
        if out is not None and pictures:
            out.mkdir(parents=True, exist_ok=True)
            titles = [f"{scale}, {nodes} x {nodes} x {shown}" for scale in pictures]
            axes = plot.against(list(pictures.values()), exact, [*titles, "Analytic"])
            axes.savefig(out / f"log_table_{name}.png", dpi=150)
    return report


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    jax.config.update("jax_enable_x64", True)
    tiny = {"size": 16, "nodes": 16, "slices": (8,), "shown": 8}
    return run_on_pictures(run, __doc__, arguments, tiny)


if __name__ == "__main__":
    main()
