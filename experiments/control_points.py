"""Cost against the number of control points: Espinha and Celes 2005, Table 3.

    python -m experiments.control_points bluntfin.vtu oxygen_post.vtu [--size 512] [--json FILE]

Renders and shades one view with 2, 10, 64 and 255 linear pieces of one transfer function, with
integrators that cut segments at control points and with one that looks whole segments up. Pieces a
segment are counted too: Espinha and Celes cite a growth of 3 to 4 % in steps for each control
point. Tasks take turns; medians of one run.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import jaxvr
from experiments.common import diagonal, write_json
from experiments.speed import camera_of, median_of

PIECES = (2, 10, 64, 255)
INTEGRATORS = {
    "Analytic": jaxvr.Analytic(),
    "texture": jaxvr.PartialPreIntegration(crossings="texture"),
    "PreIntegration": jaxvr.PreIntegration(),
}


def transfer_of(mesh: jaxvr.TetMesh, pieces: int) -> jaxvr.TransferFunction:
    """`pieces` linear pieces over the field's range, on the same curves for all of them."""
    t = np.linspace(0, 1, pieces + 1)
    values = np.asarray(mesh.values, np.float64)
    positions = values.min() + (values.max() - values.min()) * t
    extinctions = (4 + 3.5 * np.cos(9 * t)) / diagonal(mesh)
    return jaxvr.TransferFunction.from_colormap("viridis", positions, extinctions, dtype=mesh.dtype)


def pieces_of(segments: jaxvr.Segments, transfer: jaxvr.TransferFunction) -> float:
    """Mean number of pieces that control points cut a segment into."""
    scalar, length = (np.asarray(x)[: segments.count] for x in (segments.scalar, segments.length))
    positions = np.asarray(transfer.positions)
    slab = np.searchsorted(positions, scalar, side="right")
    crossed = np.abs(np.diff(slab))[length[1:] > 0]
    return float(1 + crossed.mean())


def run(
    meshes: dict[str, jaxvr.TetMesh],
    size: int,
    repeat: int,
    pieces: Sequence[int] = PIECES,
    integrators: Mapping[str, Any] = INTEGRATORS,
) -> dict[str, Any]:
    """Seconds and pieces a segment, {mesh: {pieces: {...}}}; prints a table for each mesh."""
    result: dict[str, Any] = {}
    for title, mesh in meshes.items():
        camera = camera_of(mesh, size)
        segments = jaxvr.trace(mesh, camera)
        rows: dict[int, dict[str, float]] = {}
        tasks: dict[str, Callable[[], Any]] = {}
        for n in pieces:
            transfer = transfer_of(mesh, n)
            rows[n] = {"pieces": pieces_of(segments, transfer)}
            for name, integrator in integrators.items():
                tasks[f"{n} render {name}"] = lambda t=transfer, i=integrator: jaxvr.render(
                    mesh, camera, t, integrator=i
                )
                tasks[f"{n} shade {name}"] = lambda t=transfer, i=integrator: jaxvr.shade(
                    segments, t, integrator=i
                )
        for key, seconds in median_of(tasks, repeat, quiet=True).items():
            n, what = key.split(" ", 1)
            rows[int(n)][what] = seconds
        result[title] = rows
        print(f"\n{title}, {mesh.n_tets:,} tets, {size} x {size}, seconds\n")
        heads = [f"{what} {name}" for what in ("render", "shade") for name in integrators]
        print("| pieces of the function | pieces a segment | " + " | ".join(heads) + " |")
        print("|---|---|" + "---|" * len(heads))
        for n, row in rows.items():
            cells = [f"{row[h]:.3f}" for h in heads]
            print(f"| {n} | {row['pieces']:.2f} | " + " | ".join(cells) + " |", flush=True)
    return result


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description="cost against the number of control points")
    parser.add_argument("meshes", nargs="+", type=Path)
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--json")
    options = parser.parse_args(arguments)
    meshes = {p.stem: jaxvr.read_mesh(p, dtype="float32") for p in options.meshes}
    result = run(meshes, options.size, options.repeat)
    if options.json:
        write_json(options.json, result)
    return result


if __name__ == "__main__":
    main()
