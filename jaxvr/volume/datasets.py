"""Volumes that the package makes itself; each generator returns a `TetMesh` with a real field.

`heat_sink`: a finned block of all four cell types, with the steady heat equation solved on it.
`cylinder_flow`: curvilinear hexahedra round a cylinder in potential flow.
`box`: a small block of any cells, for tests and first steps.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from . import cells as zoo
from .build import mesh_dtype
from .flow import cylinder_flow
from .heat import heat_sink
from .mesh import TetMesh
from .structured import grid_cells

__all__ = ["box", "cylinder_flow", "heat_sink"]


def _wave(points: np.ndarray) -> np.ndarray:
    """A smooth field from 0 to 1 with no symmetry of the box."""
    x, y, z = points.T
    return 0.5 + 0.5 * np.sin(3.0 * x + 1.0) * np.cos(2.0 * y - 0.5 * z)


def box(
    n: tuple[int, int, int] = (2, 2, 2),
    jitter: float = 0.0,
    seed: int = 0,
    cell: str = "tetra",
    dtype: Any = None,
    field: Callable[[np.ndarray], Any] | Any = None,
    location: str | None = None,
    shuffle: bool = False,
) -> TetMesh:
    """The unit cube in n[0] x n[1] x n[2] blocks.

    jitter: moves inner points by up to this part of the spacing along each axis (below 0.3 no
        tetrahedron turns over). shuffle: numbers the points at random, so that blocks are cut in
        all ways, into five too. seed: of both.
    cell: "tetra" (the blocks' tetrahedra as input), "hexahedron", "wedge" (two a block) or
        "pyramid" (six a block, round its centre).
    field: a function from points (P, 3) to values (P,), or the values, for any `location`; `None`
        is a smooth wave between 0 and 1.
    """
    sizes = tuple(int(k) for k in n)
    if len(sizes) != 3 or min(sizes) < 1:
        raise ValueError(f"n must be three positive integers, but is {n}.")
    if not 0.0 <= jitter < 0.5:
        raise ValueError(f"jitter must lie in [0, 0.5), but is {jitter}.")
    rng = np.random.default_rng(seed)
    axes = [np.arange(k + 1) / k for k in sizes]
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), z.ravel()], 1)
    inner = ((points > 0.0) & (points < 1.0)).all(1)
    points[inner] += jitter / np.array(sizes) * rng.uniform(-1.0, 1.0, (int(inner.sum()), 3))
    blocks = grid_cells(*(k + 1 for k in sizes))
    if cell == "pyramid":
        centres = len(points) + np.arange(len(blocks))
        points = np.concatenate([points, points[blocks].mean(1)])
    if shuffle:
        number = rng.permutation(len(points))
        shuffled = np.empty_like(points)
        shuffled[number] = points
        points, blocks = shuffled, number[blocks]
        if cell == "pyramid":
            centres = number[centres]
    if cell == "hexahedron":
        cells = blocks
    elif cell == "tetra":
        cells, _ = zoo.subdivide(zoo.HEXAHEDRON, blocks, np.arange(len(points)))
    elif cell == "wedge":
        cells = blocks[:, [[0, 2, 1, 4, 6, 5], [0, 3, 2, 4, 7, 6]]].reshape(-1, 6)
    elif cell == "pyramid":
        # quads face outwards, so the centre lies behind them: reversed, the apex is in front
        bases = blocks[:, [q[::-1] for q in zoo.HEXAHEDRON.quads]]
        apex = np.broadcast_to(centres[:, None, None], (len(blocks), 6, 1))
        cells = np.concatenate([bases, apex], 2).reshape(-1, 5)
    else:
        raise ValueError(f"cell must be one of {sorted(zoo.KINDS)}, but is {cell!r}.")
    if field is None or callable(field):
        field = (field or _wave)(points)
        location = "point"
    points = points.astype(mesh_dtype(points, dtype))
    return TetMesh.from_cells(points, {cell: cells}, field, location=location, dtype=dtype)
