"""Potential flow round a circular cylinder, on an O-grid of curvilinear hexahedra."""

from __future__ import annotations

from typing import Any

import numpy as np

from .mesh import TetMesh, _from_cells
from .structured import grid_cells


def potential_flow(points: np.ndarray, radius: float, circulation: float = 0.0) -> np.ndarray:
    """Velocity (P, 2) at points (P, 3) of the flow with unit speed along x past a cylinder on z.

    u_r = (1 - a^2/r^2) cos t, u_t = -(1 + a^2/r^2) sin t - G / (2 pi r), with a the radius and G
    the circulation, clockwise (Batchelor, An Introduction to Fluid Dynamics, section 6.6).
    """
    x, y = points[:, 0], points[:, 1]
    r = np.hypot(x, y)
    cos, sin = x / r, y / r
    radial = (1.0 - (radius / r) ** 2) * cos
    around = -(1.0 + (radius / r) ** 2) * sin - circulation / (2.0 * np.pi * r)
    return np.stack([radial * cos - around * sin, radial * sin + around * cos], 1)


def cylinder_flow(
    n: tuple[int, int, int] = (16, 48, 8),
    radius: float = 1.0,
    outer: float = 4.0,
    length: float = 3.0,
    circulation: float = 0.0,
    field: str = "speed",
    closed: bool = True,
    dtype: Any = None,
) -> TetMesh:
    """The ring between a cylinder and a wider one, with potential flow along x through it.

    radius, outer, length: of the two cylinders, in world units; their axis is z. n: cells outwards,
    around and along it. Rings are spaced geometrically, so that cells
    keep their shape. circulation: of the flow, clockwise, in units of speed times length.
    field: "speed" (0 at the stagnation points, 2 at the sides without circulation) or "pressure",
        the coefficient 1 - speed^2.
    closed: the last cells around use the first ones' points; if not, they have points of their own
        that coincide with those, as files of O-grids do.
    """
    rings, around, layers = (int(k) for k in n)
    if rings < 1 or around < 3 or layers < 1:
        raise ValueError(f"n must be at least (1, 3, 1), but is {n}.")
    if not (0.0 < radius < outer and length > 0.0):
        raise ValueError(
            f"0 < radius < outer and length > 0 are needed, but radius is {radius}, outer {outer}, "
            f"length {length}."
        )
    if field not in ("speed", "pressure"):
        raise ValueError(f'field must be "speed" or "pressure", but is {field!r}.')
    r = radius * (outer / radius) ** (np.arange(rings + 1) / rings)
    angle = 2.0 * np.pi * (np.arange(around + 1) % around) / around  # the last equals the first
    z = length * (np.arange(layers + 1) / layers - 0.5)
    zz, tt, rr = np.meshgrid(z, angle, r, indexing="ij")
    points = np.stack([rr * np.cos(tt), rr * np.sin(tt), zz], -1).reshape(-1, 3)
    cells = grid_cells(rings + 1, around + 1, layers + 1)
    if closed:
        i = np.arange(len(points)).reshape(layers + 1, around + 1, rings + 1)
        keep = np.zeros(i.shape, bool)
        keep[:, :around] = True
        number = np.cumsum(keep.ravel()) - 1
        first = i.copy()
        first[:, around] = i[:, 0]
        cells = number[first.ravel()[cells]]
        points = points[keep.ravel()]
    velocity = potential_flow(points, radius, circulation)
    square = (velocity**2).sum(1)
    values = np.sqrt(square) if field == "speed" else 1.0 - square
    blocks = {"hexahedron": cells}
    return _from_cells(TetMesh, points, blocks, values, "point", dtype, field, stacklevel=3)
