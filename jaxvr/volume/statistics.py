"""What the values of a mesh are, counted by the space that they fill.

Points that no cell uses are part of a mesh's arrays and of nothing else: no ray meets them, and
they count in none of these numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from .geometry import signed_volumes
from .unused import used_by

if TYPE_CHECKING:
    from .base import AbstractVolume
    from .mesh import TetMesh


def _values(mesh: TetMesh) -> np.ndarray:
    """As the field has them: float64 where they are held relative to an offset."""
    return mesh.absolute_values() if mesh.offset else np.asarray(mesh.values)


def used_points(mesh: TetMesh) -> np.ndarray:
    """Which points (P,) cells use."""
    return used_by(mesh.n_points, np.asarray(mesh.cells))


def used_values(mesh: TetMesh) -> np.ndarray:
    """The values (n,) that cells use, in the order of the mesh's; as the field has them."""
    values = _values(mesh)
    return values[used_points(mesh)] if mesh.location == "point" else values.reshape(-1)


def value_range(mesh: TetMesh) -> tuple[float, float]:
    """The least and the largest value that a cell uses."""
    values = used_values(mesh)
    return float(values.min()), float(values.max())


def weighted_values(mesh: TetMesh) -> tuple[np.ndarray, np.ndarray]:
    """Values (n,) that cells use and the part (n,) float64 of the volume that each stands for.

    A quarter of a cell goes with the value of each of its corners. Where cells have no volume, each
    counts the same. The parts add up to 1.
    """
    size = np.abs(signed_volumes(np.asarray(mesh.points), np.asarray(mesh.cells))[0])
    size = np.asarray(size, np.float64)
    if not size.sum() > 0:
        size = np.ones(len(size))
    size = size / size.sum()
    values = _values(mesh)
    if mesh.location == "cell":
        return values, size
    quarter = np.repeat(size / 4, 4)
    if mesh.location == "corner":
        return values.reshape(-1), quarter
    parts = np.bincount(np.asarray(mesh.cells).reshape(-1), quarter, minlength=mesh.n_points)
    used = used_points(mesh)
    return values[used], parts[used]


def dots(mesh: TetMesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Middles (T, 3), volumes (T,) and mean values (T,) of the cells, float64."""
    cells, points = np.asarray(mesh.cells), np.asarray(mesh.points, np.float64)
    size = np.abs(signed_volumes(points, cells)[0]) / 6
    values = mesh.absolute_values()
    if mesh.location == "point":
        values = values[cells]
    values = values if values.ndim == 1 else values.mean(axis=1)
    return points[cells].mean(axis=1), size, values


def quantiles(volume: AbstractVolume, parts: Sequence[float]) -> list[float]:
    """For each part, from 0 to 1, the least value that with those below it fills so much of the
    volume; 0 and 1 give the range."""
    values, weights = volume.weighted_values()
    order = np.argsort(values, kind="stable")
    values, reached = values[order], np.cumsum(weights[order])
    at = np.searchsorted(reached, np.asarray(parts) * reached[-1])
    at = np.where(np.asarray(parts) >= 1, len(values) - 1, np.minimum(at, len(values) - 1))
    return [float(values[k]) for k in at]
