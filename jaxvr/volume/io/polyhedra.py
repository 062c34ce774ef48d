"""Polyhedra as tetrahedra: each convex one is cut about its centroid.

A face is cut into triangles from its smallest vertex (by `weld`), as the quadrilaterals of the zoo
are (see `cells`), so two cells that share a face cut it alike. Each triangle and the centroid, a
new point, make a tetrahedron. The centroid is the mean of the vertices, and fields on points get
the mean of theirs: exact for linear ones.
"""

from __future__ import annotations

import numpy as np

from ..weld import weld
from .content import Content, Trouble

# How far a vertex may lie outside the plane of a face, as a part of the cell's size: the faces of
# meshes of flow solvers are not quite plane.
_WARPED = 0.01


def cut(
    content: Content, cells: list[list[list[int]]], numbers: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Tetrahedra (T, 4) of cells given by their faces, and the cell (T,) that each came from.

    Adds the centroids to the points and the point fields of `content`. numbers: of the cells in the
    file, for errors. Raises Trouble for cells that are not convex, with their numbers.
    """
    points = np.asarray(content.points, np.float64)
    if not np.isfinite(points).all():
        raise Trouble("damaged", "Its points have NaN or infinite numbers.")
    welded, _ = weld(np.asarray(content.points))
    tets, parents, members, refused = [], [], [], []
    for k, faces in enumerate(cells):
        ids = np.unique([i for f in faces for i in f])
        if len(faces) < 4 or len(ids) < 4 or ids[0] < 0 or ids[-1] >= len(points):
            refused.append(k)
            continue
        corners = points[ids]
        center = corners.mean(0)
        triangles = _outward(points, faces, welded, center)
        if triangles is None or not _convex(points, corners, faces):
            refused.append(k)
            continue
        apex = np.full(len(triangles), len(points) + len(members))
        tets.append(np.column_stack([triangles, apex]))
        parents.append(np.full(len(triangles), k))
        members.append(ids)
    if refused:
        listed = ", ".join(str(int(numbers[k])) for k in refused[:10])
        raise Trouble(
            "unsupported",
            f"{len(refused)} of {len(cells)} polyhedra are not convex or not closed, so there is "
            f"no cutting them about their centroid: cells {listed}"
            f"{', ...' if len(refused) > 10 else ''}. Cut them before "
            "(pyvista.read(path).triangulate()).",
        )

    def grown(a: np.ndarray) -> np.ndarray:
        wide = a.astype(np.float64) if a.dtype.kind != "f" else a
        means = [wide[ids].mean(0, dtype=np.float64) for ids in members]
        return np.concatenate([wide, np.array(means).reshape(-1, *a.shape[1:]).astype(wide.dtype)])

    content.points = grown(np.asarray(content.points))
    content.point = {name: grown(a) for name, a in content.point.items()}
    return np.concatenate(tets).astype(np.int64), np.concatenate(parents)


def _outward(
    points: np.ndarray, faces: list[list[int]], welded: np.ndarray, center: np.ndarray
) -> np.ndarray | None:
    """The faces as triangles (n, 3), each the base of a positive tetrahedron whose apex is the
    centroid; None for a face that lies on both sides of it."""
    found = []
    for f in faces:
        if len(f) < 3:
            return None
        first = int(np.argmin(welded[f]))
        ring = f[first:] + f[:first]
        rows = np.array([[ring[0], ring[i], ring[i + 1]] for i in range(1, len(ring) - 1)])
        a, b, c = (points[rows[:, i]] - center for i in range(3))
        volume = np.einsum("ni,ni->n", np.cross(a, b), c)
        size = np.abs(volume).max()
        if (volume > 1e-6 * size).any() and (volume < -1e-6 * size).any():
            return None
        # det(q1 - q0, q2 - q0, q3 - q0) > 0 for triangle and centroid where `volume` < 0
        found.append(rows if volume.sum() < 0 else rows[:, [0, 2, 1]])
    return np.concatenate(found)


def _convex(points: np.ndarray, corners: np.ndarray, faces: list[list[int]]) -> bool:
    size = np.linalg.norm(corners.max(0) - corners.min(0))
    for f in faces:
        q = points[f] - points[f].mean(0)  # far from the origin digits count
        normal = np.cross(q, np.roll(q, -1, 0)).sum(0)  # Newell's
        length = np.linalg.norm(normal)
        if length == 0:
            return False
        side = (corners - points[f].mean(0)) @ (normal / length)
        if side.max() > _WARPED * size and side.min() < -_WARPED * size:
            return False
    return closed(faces)


def closed(faces: list[list[int]]) -> bool:
    """Whether each edge has two faces."""
    edges: dict[tuple[int, int], int] = {}
    for f in faces:
        for a, b in zip(f, f[1:] + f[:1], strict=True):
            edges[min(a, b), max(a, b)] = edges.get((min(a, b), max(a, b)), 0) + 1
    return all(n == 2 for n in edges.values())
