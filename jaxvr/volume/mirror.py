"""Points that turn a mesh inside out: what becomes of the integers that say where rays enter.

The walk goes by which boundary faces a ray enters through. That is how the cells lay when the mesh
was built; where all cells of a component are turned over, as by another sign of one coordinate or
by swapped axes, its entries have become exits, and the picture would be blank.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from . import connectivity as conn
from . import packing
from .geometry import flat_cells, signed_volumes

_MANY = 0.25  # part of the volume at the boundary above which a mesh turned over is worth a word


def mirrored(
    points: Any, cells: Any, neighbors: Any, boundary: Any
) -> tuple[np.ndarray | None, str | None]:
    """The words of the boundary (F,) for moved points (P, 3), `None` if they stay, and a warning
    about cells that are turned over all the same, or `None`. The others: as in `TetMesh`.

    Looks at the cells of the boundary, which are few: all components have some. Components more
    than half of whose volume there lies the wrong way round are turned inside out. Where those at
    the boundary are all flat, as on the sides of a lattice, they do not tell, and all cells do.
    """
    points, words = np.asarray(points), np.asarray(boundary)
    cells, neighbors = np.asarray(cells), np.asarray(neighbors)
    if len(words) == 0:
        return None, None
    at, first = np.unique(packing.cell_of(words), return_index=True)
    outer = words[first]
    size, wrong = _wrong(points, cells[at], conn.entry_signs(outer), packing.turned_of(outer))
    if (size > 0).all() and not wrong.any():
        return None, None
    tau, label = conn.orientations(neighbors, words)
    blind = np.bincount(label[at], size, len(cells)) == 0
    blind[np.setdiff1d(label, label[at])] = False  # without a boundary there is nothing to turn
    if blind[label[at]].any():
        more = np.flatnonzero(blind[label])
        turned = _turned(neighbors, words)[more]
        more_size, more_wrong = _wrong(points, cells[more], tau[more], turned)
        at = np.concatenate([at, more])
        size, wrong = np.concatenate([size, more_size]), np.concatenate([wrong, more_wrong])
    if not wrong.any():
        return None, None
    of = label[at]
    whole = np.bincount(of, size, len(cells))
    inside_out = np.bincount(of, np.where(wrong, size, 0.0), len(cells)) > 0.5 * whole
    change = inside_out[label[packing.cell_of(words)]]
    wrong = wrong ^ (inside_out[of] & (size > 0))
    message = None
    if size[wrong].sum() > _MANY * size.sum():
        tau = np.where(inside_out[label], -tau, tau)
        size, wrong = _wrong(points, cells, tau, _turned(neighbors, words))
        message = (
            f"These points turn {int(wrong.sum())} of {len(wrong)} tetrahedra over. Rays pass "
            "through such cells in no length, so the picture may not be what you want: build the "
            "mesh anew with TetMesh.from_cells."
        )
    return (words ^ (change.astype(np.int32) << 3) if change.any() else None), message


def _turned(neighbors: np.ndarray, boundary: np.ndarray) -> np.ndarray:
    """The `turned` bits (T,) of all cells, which words of either kind have."""
    turned = np.zeros(len(neighbors), np.int32)
    for word in (neighbors[neighbors >= 0], boundary):
        turned[packing.cell_of(word)] = packing.turned_of(word)
    return turned


def _wrong(
    points: np.ndarray, cells: np.ndarray, tau: np.ndarray, turned: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Six volumes (N,) of cells, 0 where they are flat, and whether they are turned over (N,)."""
    det, sign = signed_volumes(points, cells)
    solid = (sign != 0) & ~flat_cells(points, cells)
    expected = np.where(turned == 1, -tau, tau)
    return np.where(solid, np.abs(det), 0.0), solid & (sign * expected < 0)
