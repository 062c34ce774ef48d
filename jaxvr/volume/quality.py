"""How well shaped the tetrahedra are (NumPy, float64)."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from jaxvr._core.units import scaled_to_one

_CHUNK = 1 << 18
_EDGES = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))


@dataclasses.dataclass(frozen=True)
class Quality:
    """Extremes over all tetrahedra. Dihedral angles in degrees; edge_ratio is the largest ratio of
    a cell's longest edge to its shortest; volumes are without sign, in cubed units of length."""

    min_dihedral: float
    max_dihedral: float
    edge_ratio: float
    min_volume: float
    max_volume: float
    volume: float


def quality(points: Any, cells: Any) -> Quality:
    """The quality of points (P, 3), cells (T, 4) with T > 0; rows may have either orientation."""
    # Angles need products of four lengths, volumes of three.
    (p, exponent), tets = scaled_to_one(points), np.asarray(cells)
    parts = [_extremes(p[tets[i : i + _CHUNK]]) for i in range(0, len(tets), _CHUNK)]
    lo, hi, ratio, small, large, total = zip(*parts, strict=True)
    with np.errstate(over="ignore", under="ignore"):
        volumes = [float(np.ldexp(x, 3 * exponent)) for x in (min(small), max(large), sum(total))]
    return Quality(min(lo), max(hi), max(ratio), *volumes)


def _extremes(q: np.ndarray) -> tuple[float, float, float, float, float, float]:
    a, b, c = q[:, 1] - q[:, 0], q[:, 2] - q[:, 0], q[:, 3] - q[:, 0]
    # normals of the faces, all outwards or all inwards, with length twice their area; the first
    # is -(b x c + c x a + a x b), which would cancel in a sliver
    normals = [-np.cross(b - a, c - a), np.cross(b, c), np.cross(c, a), np.cross(a, b)]
    lo, hi = np.inf, -np.inf
    for i, j in _EDGES:
        m, n = normals[i], normals[j]
        # atan2 keeps angles near 0 and 180 degrees, where the cosine is flat
        angle = np.arctan2(np.linalg.norm(np.cross(m, n), axis=1), -(m * n).sum(1))
        lo, hi = min(lo, float(angle.min())), max(hi, float(angle.max()))
    length = np.stack([np.linalg.norm(q[:, j] - q[:, i], axis=1) for i, j in _EDGES])
    volume = np.abs((a * normals[1]).sum(1)) / 6.0
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = float((length.max(0) / length.min(0)).max())
    return (
        float(np.degrees(lo)),
        float(np.degrees(hi)),
        ratio,
        float(volume.min()),
        float(volume.max()),
        float(volume.sum()),
    )
