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


def outer_faces(cells: Any, boundary: Any, xp: Any = np) -> Any:
    """Ids (F, 3) out of those of cells (T, 4), for the faces that the boundary's words name."""
    cell = xp.clip(packing.cell_of(boundary), 0, cells.shape[0] - 1)
    face = xp.asarray(conn.FACES)[packing.corner_of(boundary)]
    return xp.take_along_axis(cells[cell], face, axis=1)


def enclosed(
    points: Any, cells: Any, boundary: Any, xp: Any = np, label: Any = None
) -> tuple[Any, Any]:
    """What each face of the boundary adds to six times the volume that it encloses, as its `entry`
    bit orients it (F,), in units of the mesh's own, and how much rounding may add to that (F,).

    By Gauss's theorem the volume is the sum of det(a - o, b - o, c - o) over the faces a, b, c seen
    from outside, wherever o is: that of a mirrored mesh is below 0, whatever its cells are. A
    determinant errs by no more than some ulps of |a - o| |b - o| |c - o|. xp: NumPy, or jax.numpy.
    label (F,): a cell of each face's component, for sums by components: o is a point of it then,
    since small ones far from the middle of all would be below the rounding.
    """
    corners = points[outer_faces(cells, boundary, xp)]
    low, high = (f(corners, (0, 1), keepdims=True) for f in (xp.min, xp.max))
    middle = 0.5 * (low + high) if label is None else points[cells[label, 0]][:, None]
    corners = corners - middle
    limits = xp.finfo(points.dtype)
    corners = corners / xp.maximum(xp.abs(corners).max(), limits.tiny)
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    outwards = (1 - 2 * packing.flag_of(boundary)).astype(points.dtype)
    lengths = xp.sqrt(xp.sum(corners**2, axis=-1))
    ulps = 16 * limits.eps * xp.prod(lengths, axis=-1)
    return outwards * xp.sum(a * xp.cross(b, c), axis=-1), ulps


def mirrored(
    points: Any, cells: Any, neighbors: Any, boundary: Any
) -> tuple[np.ndarray | None, str | None]:
    """The words of the boundary (F,) for moved points (P, 3), `None` if they stay, and a warning
    about cells that are turned over all the same, or `None`. The others: as in `TetMesh`.

    Components whose boundary encloses a volume below 0 are turned inside out. One-sided ones, which
    have no inside, stay. The cells of the boundary, which are few, tell whether to look.
    """
    points, words = np.asarray(points, np.float64), np.asarray(boundary)
    cells, neighbors = np.asarray(cells), np.asarray(neighbors)
    if len(words) == 0:
        return None, None
    at, first = np.unique(packing.cell_of(words), return_index=True)
    outer = words[first]
    size, wrong = _wrong(points, cells[at], conn.entry_signs(outer), packing.turned_of(outer))
    volume, error = enclosed(points, cells, words)
    if (size > 0).all() and not wrong.any() and volume.sum() >= 0:
        return None, None
    tau, label = conn.orientations(neighbors, words)
    of = label[packing.cell_of(words)]
    volume, error = np.bincount(of, volume, len(cells)), np.bincount(of, error, len(cells))
    inside_out = volume < -error
    inside_out[label[tau == 0]] = False
    change = inside_out[of]
    wrong = wrong ^ (inside_out[label[at]] & (size > 0))
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
