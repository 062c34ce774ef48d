"""Curvilinear grids as hexahedra: the numbering that PLOT3D files and generators share."""

from __future__ import annotations

import numpy as np


def grid_cells(ni: int, nj: int, nk: int) -> np.ndarray:
    """Hexahedra ((ni-1)(nj-1)(nk-1), 8) in VTK's order, of ni x nj x nk points, i fastest."""
    k, j, i = np.meshgrid(np.arange(nk - 1), np.arange(nj - 1), np.arange(ni - 1), indexing="ij")
    first = (i + ni * (j + nj * k)).ravel().astype(np.int64)
    up = ni * nj
    return first[:, None] + np.array([0, 1, 1 + ni, ni, up, 1 + up, 1 + ni + up, ni + up])


def right_handed(points: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """The hexahedra, upside down if most of them have negative volume (a left-handed i, j, k)."""
    q = np.asarray(points, np.float64)[cells]
    a, b, c = q[:, 1] - q[:, 0], q[:, 3] - q[:, 0], q[:, 4] - q[:, 0]
    negative = np.einsum("ni,ni->n", np.cross(a, b), c) < 0
    return cells[:, [4, 5, 6, 7, 0, 1, 2, 3]] if negative.mean() > 0.5 else cells
