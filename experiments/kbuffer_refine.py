"""What refining degenerate cells does to the k that a k-buffer needs (Callahan et al. 2005,
section 5).

    python -m experiments.kbuffer_refine bluntfin.vtu:density can.vtu:EQPS_node ... [--json F]

For each mesh as it is, refined by deviation from the Delaunay property, and by size alone: cells,
and over the viewpoints the largest k, its mean and the pixels that need more than 6, sorted by
centroid and by first vertex. And the largest change of the picture, which is none.

Besides the meshes given, some that the paper's argument is about: the Delaunay mesh of random
points in a cube, squeezed afterwards to some of its height, so that it is one no more.
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from scipy.spatial import Delaunay

import jaxvr
from experiments.common import table, transfer_of
from experiments.havs import ORDERS, options, report, viewpoints, volumes


def run(volume: jaxvr.TetMesh, name: str, size: int, views: int, shares: list[float]):
    cameras, transfer = viewpoints(volume, size)[-views:], transfer_of(volume)
    before = np.asarray(jaxvr.render(volume, cameras[0], transfer))
    meshes = {"as it is": volume}
    for share in shares:
        meshes[f"by deviation, {share:g}"] = jaxvr.refine(volume, share)
        meshes[f"by size, {share:g}"] = jaxvr.refine(volume, share, deviation=0.0)
    rows = []
    for label, mesh in meshes.items():
        row: dict[str, Any] = {"mesh": name, "refined": label, "tets": mesh.n_tets}
        for key, order in ORDERS.items():
            found = [jaxvr.measure_k(mesh, camera, order=order) for camera in cameras]
            row[f"k, {key}"] = max(f.k for f in found)
            row[f"mean k, {key}"] = float(np.mean([f.k for f in found]))
            row[f"> 6, {key}"] = max(f.count_above(6) for f in found)
        after = np.asarray(jaxvr.render(mesh, cameras[0], transfer))
        row["change"] = float(np.abs(after - before).max())
        rows.append(row)
        print(table([row]), flush=True)
        jax.clear_caches()  # each has shapes of its own, and Linux bounds the memory maps of code
    return rows


def squeezed(height: float, points: int, seed: int = 0) -> jaxvr.TetMesh:
    """Delaunay tetrahedra of the unit cube by random points, with z times height afterwards."""
    rng = np.random.default_rng(seed)
    corners = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    where = np.concatenate([corners, rng.uniform(0, 1, (points, 3))])
    cells = Delaunay(where).simplices
    values = np.sin(5 * where).sum(1)
    where = where * [1, 1, height]
    corners = where[cells]
    size = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1]))
    cells = cells[size > 1e-9 * height]  # on the sides of the cube are some without a volume
    return jaxvr.TetMesh.from_cells(where, {"tetra": cells}, values, dtype="float32")


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    found = options(__doc__, arguments, views=6, shares=[0.01, 0.05], heights=[1.0, 0.3, 0.1])
    if found.tiny:
        found.views, found.shares, found.heights = 1, [0.05], []
    meshes = volumes(found)
    for height in found.heights:
        meshes[f"Delaunay, height {height:g}"] = squeezed(height, 4000)
    rows = []
    for name, volume in meshes.items():
        rows += run(volume, name, found.size, found.views, found.shares)
    print(table(rows))
    return report(found, rows, "views")


if __name__ == "__main__":
    main()
