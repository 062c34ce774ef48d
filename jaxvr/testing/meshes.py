"""Meshes on which tracers fail: what is equal, flat, thin, folded, doubled, hollow or in pieces.

Each is small (10 to 700 tetrahedra), of about unit size, with a smooth field from 0 to 1. `TetMesh`
warns where it drops or turns cells, which is left to the caller.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from jaxvr.volume import TetMesh, datasets

# Meshes whose cells overlap: no picture of them is right, but nothing may crash, hang or be NaN.
FOLDED = frozenset({"folded"})


def nasty_meshes(dtype: Any = "float64", only: Iterable[str] | None = None) -> dict[str, TetMesh]:
    """Meshes by name: see the functions of `jaxvr.testing.meshes`, one for each.

    dtype: float32 or float64. only: names to make, or None for all.

    Warns, as `TetMesh.from_cells` does, of cells that are dropped or turned round. Those named in
    `jaxvr.testing.FOLDED` have cells that overlap, which brute force sees twice.
    """
    chosen = list(MESHES) if only is None else list(only)
    if unknown := [n for n in chosen if n not in MESHES]:
        raise ValueError(f"There is no mesh {unknown[0]!r}, but there are {sorted(MESHES)}.")
    return {name: MESHES[name](dtype) for name in chosen}


def field(points: Any) -> np.ndarray:
    """A smooth field from 0 to 1 without symmetry, of points (P, 3)."""
    x, y, z = np.asarray(points, np.float64).T
    return 0.5 + 0.5 * np.sin(2.3 * x + 0.4) * np.cos(1.7 * y - 0.9 * z)


def delaunay(points: Any, dtype: Any) -> TetMesh:
    """The Delaunay tetrahedra of points (P, 3), by Qhull, all kept whatever their shape."""
    from scipy.spatial import Delaunay

    points = np.asarray(points, np.float64)
    return _mesh(points, Delaunay(points).simplices, dtype)


def lattice(jitter: float, dtype: Any, n: int = 4) -> TetMesh:
    """A Delaunay mesh of n^3 lattice points, those inside moved by up to `jitter`: eight points of
    each block lie on one sphere, or almost, so that many cells are flat, or almost."""
    axis = np.arange(n) / (n - 1)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    inner = ((points > 0) & (points < 1)).all(1)
    points[inner] += jitter * np.random.default_rng(n).uniform(-1, 1, (int(inner.sum()), 3))
    return delaunay(points, dtype)


def cospherical(dtype: Any) -> TetMesh:
    """Points of a sphere, some of them opposite each other, without any inside."""
    rng = np.random.default_rng(2)
    points = rng.normal(size=(24, 3))
    points = np.concatenate([points, -points[:8], np.eye(3), -np.eye(3)])
    return delaunay(0.5 + 0.5 * points / np.linalg.norm(points, axis=1, keepdims=True), dtype)


def slivers(dtype: Any) -> TetMesh:
    """Quads of almost coplanar points (1e-3 to 1e-9 off) between two layers: Delaunay's own."""
    rng = np.random.default_rng(4)
    axis = np.arange(4) / 3
    x, y = (v.ravel() for v in np.meshgrid(axis, axis, indexing="ij"))
    middle = 0.5 + 10.0 ** rng.uniform(-9, -3, x.size) * rng.choice([-1, 1], x.size)
    layers = [np.zeros(x.size), middle, np.ones(x.size)]
    return delaunay(np.concatenate([np.stack([x, y, z], 1) for z in layers]), dtype)


def prisms(dtype: Any) -> TetMesh:
    """A stack of wedges, from 1e-6 to 0.5 high, as boundary layers are."""
    heights = np.concatenate([[0], np.cumsum([0.5, 0.1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 0.3])])
    base = np.array([[0, 0], [1, 0], [0, 1], [1, 1]])
    points = np.concatenate([np.c_[base, np.full(4, h)] for h in heights])
    first = 4 * np.arange(len(heights) - 1)[:, None]
    wedges = np.concatenate([first + np.array(w) for w in ([0, 2, 1, 4, 6, 5], [1, 2, 3, 5, 6, 7])])
    return _mesh(points, wedges, dtype, "wedge")


def squashed(dtype: Any) -> TetMesh:
    """A Delaunay mesh of random points, pressed flat to 1e-4 of its height."""
    points = np.random.default_rng(6).uniform(size=(40, 3))
    mesh = delaunay(points, "float64")
    return _mesh(points * [1, 1, 1e-4], np.asarray(mesh.cells), dtype)


def folded(dtype: Any) -> TetMesh:
    """A box with a point inside that was pulled through its neighbours."""
    mesh = datasets.box((3, 3, 3), dtype="float64")
    points = np.array(mesh.points)
    inner = np.flatnonzero(((points > 0) & (points < 1)).all(1))[0]
    points[inner] += [0.4, 0.37, 0.45]
    return _mesh(points, np.asarray(mesh.cells), dtype)


def seams(dtype: Any) -> TetMesh:
    """Two boxes whose common face has points of either's own, in the same places."""
    half = datasets.box((2, 2, 2), dtype="float64")
    points, cells = np.asarray(half.points), np.asarray(half.cells)
    mirrored = points * [-1, 1, 1] + [2, 0, 0]  # so that the diagonals of the common face agree
    return _mesh(
        np.concatenate([points, mirrored]) * [0.5, 1, 1],
        np.concatenate([cells, cells + len(points)]),
        dtype,
    )


def hollow(dtype: Any) -> TetMesh:
    """Not convex: a box with a hole inside, a notch and a bare edge, where two cells touch."""
    mesh = datasets.box((4, 4, 4), dtype="float64")
    points, cells = np.asarray(mesh.points), np.asarray(mesh.cells)
    block = np.floor(points[cells].mean(1) * 4).astype(int)
    gone = ((block >= 1) & (block <= 2)).all(1) | ((block[:, 0] >= 2) & (block[:, 2] == 3))
    gone |= (block == 0).all(1) & (np.arange(len(cells)) % 2 == 0)
    return _mesh(points, cells[~gone], dtype)


def pieces(dtype: Any) -> TetMesh:
    """Four boxes: apart, 1e-6 apart, and touching in one point."""
    mesh = datasets.box((1, 1, 1), dtype="float64")
    points, cells = np.asarray(mesh.points) * 0.4, np.asarray(mesh.cells)
    moves = np.array([[0, 0, 0], [0.4 + 1e-6, 0, 0], [0.9, 0.3, 0.2], [-0.4, -0.4, -0.4]])
    return _mesh(
        np.concatenate([points + m for m in moves]),
        np.concatenate([cells + k * len(points) for k in range(len(moves))]),
        dtype,
    )


def cracks(dtype: Any) -> TetMesh:
    """A box without some of its cells inside, one at a time: rays leave it and enter it again."""
    mesh = datasets.box((3, 3, 3), jitter=0.2, seed=3, dtype="float64")
    cells = np.asarray(mesh.cells)
    return _mesh(np.asarray(mesh.points), cells[np.arange(len(cells)) % 7 != 3], dtype)


def zoo(dtype: Any) -> TetMesh:
    """Hexahedra, wedges and pyramids in one mesh, side by side."""
    points = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1, 2, 3)], float)
    points = np.concatenate([points, [[0.5, 0.5, 0.5]]])
    hexahedra = np.array([[1, 2, 6, 5, 9, 10, 14, 13]])
    wedges = np.array([[2, 6, 3, 10, 14, 11], [3, 6, 7, 11, 14, 15]])
    quads = [[0, 4, 5, 1], [8, 9, 13, 12], [0, 1, 9, 8], [4, 12, 13, 5], [0, 8, 12, 4]]
    quads += [[1, 5, 13, 9]]
    pyramids = np.array([[*q, 16] for q in quads])
    points *= [1 / 3, 1, 1]
    cells = {"hexahedron": hexahedra, "wedge": wedges, "pyramid": pyramids}
    return TetMesh.from_cells(points.astype(dtype), cells, field(points), dtype=dtype)


def one(dtype: Any) -> TetMesh:
    """A single tetrahedron."""
    return _mesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]), [[0, 1, 2, 3]], dtype)


def _mesh(points: np.ndarray, cells: Any, dtype: Any, kind: str = "tetra") -> TetMesh:
    points, cells = np.asarray(points, np.float64), np.array(cells)
    if kind == "tetra":  # right way round in float64; what rounding then does is the test
        a, b, c, d = points[cells].transpose(1, 0, 2)
        wrong = np.einsum("tx,tx->t", np.cross(b - a, c - a), d - a) < 0
        cells[wrong] = cells[wrong][:, [1, 0, 2, 3]]
    values, points = field(points), points.astype(dtype)
    return TetMesh.from_cells(points, {kind: cells}, values, location="point", dtype=dtype)


MESHES: dict[str, Callable[[Any], TetMesh]] = {
    "one": one,
    "lattice": lambda dtype: lattice(0.0, dtype),
    "lattice 1e-12": lambda dtype: lattice(1e-12, dtype),
    "lattice 1e-7": lambda dtype: lattice(1e-7, dtype),
    "cospherical": cospherical,
    "slivers": slivers,
    "prisms": prisms,
    "squashed": squashed,
    "folded": folded,
    "seams": seams,
    "hollow": hollow,
    "pieces": pieces,
    "cracks": cracks,
    "zoo": zoo,
}
