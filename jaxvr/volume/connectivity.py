"""Which cells share a face, which way round they lie, and which faces bound the mesh.

Rows of a cell array are sorted by welded id, so a shared face lists its three vertices in the same
order on both sides, and face k (opposite local vertex k) of a row (q0, q1, q2, q3) has the parity
(-1)**k in the orientation that the row induces. Two neighbours c (face k) and n (face f) lie on
opposite sides of the face exactly if o(c) o(n) = -(-1)**(k + f), o being the sign of a row's
determinant. A mesh where that fails somewhere is folded; `combinatorial` finds the signs that it
would have if it were not, which is what a walk through the cells has to go by. Cells without
volume have no sign of their own; they get the one that fits their neighbours (`fill_signs`).
"""

from __future__ import annotations

import numpy as np

from . import packing
from .unused import used_by

FACES = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # face k omits vertex k


class NonManifoldError(ValueError):
    """A face with three or more cells, or a cell given twice; `cells` are those of the first."""

    def __init__(self, message: str, cells: np.ndarray):
        super().__init__(message)
        self.cells = cells


def _face_order(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Faces sorted by their vertices: ids k * T + c in order (4T,), and whether each equals the
    next one (4T - 1,). rows (T, 4): small non-negative ids, ascending along each row."""
    bits = int(rows.max()).bit_length()
    a, b, c = (np.concatenate([rows[:, f[i]] for f in FACES]) for i in range(3))
    if 3 * bits <= 63:
        key = (a << (2 * bits)) | (b << bits) | c
        order = np.argsort(key)
        key = key[order]
        return order, key[1:] == key[:-1]
    low = (b << 32) | c
    order = np.lexsort((low, a))
    a, low = a[order], low[order]
    return order, (a[1:] == a[:-1]) & (low[1:] == low[:-1])


def match_faces(welded_rows: np.ndarray) -> np.ndarray:
    """Pairs (M, 4) of cells that share a face: cell c, its face k, cell n, its face f.

    welded_rows (T, 4): welded ids, ascending along each row.
    Raises NonManifoldError where three or more cells meet in a face or a cell stands there twice.
    """
    n = len(welded_rows)
    used = used_by(int(welded_rows.max()) + 1, welded_rows)
    rank = np.cumsum(used, dtype=np.int64) - 1  # few bits, so that a face packs into one word
    order, same = _face_order(rank[welded_rows])
    third = same[1:] & same[:-1]
    if third.any():
        first = int(np.argmax(third))
        count = int((third & ~np.r_[False, third[:-1]]).sum())
        last = first + 2
        while last < len(same) and same[last]:
            last += 1
        ids = np.sort(order[first : last + 1] % n)
        face = welded_rows[order[first] % n][FACES[order[first] // n]]
        raise NonManifoldError(
            f"{count} face(s) belong to three or more cells, the first with points "
            f"{tuple(int(v) for v in face)} (lowest of coincident ones)",
            ids,
        )
    i = np.flatnonzero(same)
    one, two = order[i], order[i + 1]
    pairs = np.stack([one % n, one // n, two % n, two // n], 1)
    c, k, m, f = pairs.T
    twice = welded_rows[c, k] == welded_rows[m, f]
    if twice.any():
        first = int(np.argmax(twice))
        row = tuple(int(v) for v in welded_rows[c[first]])
        count = len(np.unique(np.minimum(c, m)[twice]))
        raise NonManifoldError(
            f"{count} cell(s) are given twice, the first with points {row} "
            "(lowest of coincident ones)",
            np.sort(pairs[first][[0, 2]]),
        )
    return pairs


def components(n: int, pairs: np.ndarray) -> tuple[int, np.ndarray]:
    """Number of face-connected components of n cells, and the label (n,) of each."""
    return _connected(n, pairs[:, 0], pairs[:, 2])


def _connected(n: int, first: np.ndarray, second: np.ndarray) -> tuple[int, np.ndarray]:
    """Components of a graph of n nodes with edges between `first` and `second` (E,)."""
    from scipy.sparse import coo_matrix  # here, since these two take a while to import
    from scipy.sparse.csgraph import connected_components

    graph = coo_matrix((np.ones(len(first), np.int8), (first, second)), shape=(n, n))
    count, label = connected_components(graph, directed=False)
    return int(count), label


def surplus(welded_rows: np.ndarray, flat: np.ndarray) -> np.ndarray:
    """Flat cells (T,) bool to leave out, so that no face has three cells because of them and none
    is given twice; of several the ones given last. flat (T,): cells without volume."""
    drop = flat.copy()
    _, first = np.unique(welded_rows, axis=0, return_index=True)
    drop[first] = False
    while True:
        left = np.flatnonzero(~drop)
        faces = np.concatenate([welded_rows[left][:, f] for f in FACES])
        _, group, count = np.unique(faces, axis=0, return_inverse=True, return_counts=True)
        cell = np.tile(left, 4)
        crowded = np.flatnonzero((count[group.ravel()] > 2) & flat[cell])
        if len(crowded) == 0:
            return drop
        # the last flat cell of each crowded face, and then look again
        order = crowded[np.argsort(cell[crowded], kind="stable")]
        last = dict(zip(group.ravel()[order].tolist(), cell[order].tolist(), strict=True))
        drop[list(last.values())] = True


def _implied(sign: np.ndarray, k: np.ndarray, f: np.ndarray) -> np.ndarray:
    """The sign of a cell whose face f is face k of a cell with this sign; see the module."""
    return np.where((k + f) % 2 == 0, -sign, sign).astype(np.int8)


def fill_signs(sign: np.ndarray, det: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Signs (T,) int8 with those that are 0, of cells without volume, as their neighbours imply.

    From cell to cell through faces, nearest first. Where no neighbour has a sign, as where all
    cells of a component are flat, they agree with each other and with most of det (T,), whatever
    of it may be rounding.
    """
    sign = sign.astype(np.int8)
    ends = pairs[(sign[pairs[:, 0]] == 0) | (sign[pairs[:, 2]] == 0)]
    ends = np.concatenate([ends, ends[:, [2, 3, 0, 1]]])  # from c, k to m, f
    ends = _spread_signs(sign, ends)
    unknown = np.flatnonzero(sign == 0)
    if len(unknown) == 0:
        return sign
    number = np.full(len(sign), -1)
    number[unknown] = np.arange(len(unknown))
    among = np.column_stack([number[ends[:, 0]], ends[:, 1], number[ends[:, 2]], ends[:, 3]])
    _, label = components(len(unknown), among)
    sign[unknown[np.unique(label, return_index=True)[1]]] = 1
    _spread_signs(sign, ends)
    against = np.bincount(label, sign[unknown] * det[unknown]) < 0
    sign[unknown] = np.where(against[label], -sign[unknown], sign[unknown])
    return sign


def _spread_signs(sign: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Fills in signs, in place, along ends (M, 4), c, k, m, f, until none is to be had; returns
    the ends that lead to cells without."""
    while True:
        ends = ends[sign[ends[:, 2]] == 0]
        now = ends[sign[ends[:, 0]] != 0]
        if len(now) == 0:
            return ends
        sign[now[:, 2]] = _implied(sign[now[:, 0]], now[:, 1], now[:, 3])


def combinatorial(
    sign: np.ndarray, pairs: np.ndarray, size: np.ndarray | None = None
) -> tuple[np.ndarray, int]:
    """Which cells lie the wrong way round among their neighbours.

    sign (T,): geometric orientation of each sorted row, 1 or -1; pairs from `match_faces`. size
    (T,): the weight of each cell's vote, its volume; 0 where the sign is a guess, else all equal.
    Returns turned (T,) bool, the cells whose geometric sign differs from the consistent one, and
    the number of components that have none (one-sided, as a Moebius band is; turned is False
    there). The overall sign of a component is that of most of its volume, so that its boundary
    encloses a positive one.
    """
    n = len(sign)
    c, k, m, f = pairs.T
    agrees = sign[c] * sign[m] == np.where((k + f) % 2 == 0, -1, 1)
    turned = np.zeros(n, bool)
    if agrees.all():
        return turned, 0
    # patches of cells that agree, then a graph of two copies (upright, turned) of each patch:
    # a face where geometry disagrees joins the upright copy of one to the turned copy of the other
    patches, patch = components(n, pairs[agrees])
    p, q = patch[c[~agrees]], patch[m[~agrees]]
    rows, cols = np.r_[p, p + patches], np.r_[q + patches, q]
    count, label = _connected(2 * patches, rows, cols)
    upright, other = label[:patches], label[patches:]
    one_sided = upright == other
    # each orientable component appears twice, mirrored: keep the copy with more upright volume
    votes = np.bincount(patch, size, minlength=patches)
    cells_upright = np.bincount(upright, votes, minlength=count)
    more = cells_upright[upright] - cells_upright[other]
    flip = (more < 0) | ((more == 0) & (upright > other))
    flip &= ~one_sided
    turned = flip[patch]
    return turned, len(np.unique(upright[one_sided]))


def orientations(neighbors: np.ndarray, boundary: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """tau (T,) int8 of `TetMesh.boundary`, the orientation of each row as the mesh would be
    unfolded, from the integers of a mesh alone, and the component (T,) of each cell.

    Cells without volume have one as well, and moved points change nothing. It is 0 in components
    without a boundary and in one-sided ones, which have none.
    """
    n = len(neighbors)
    count, label = _two_copies(neighbors)
    cell, sign = packing.cell_of(boundary), entry_signs(boundary)
    known = np.zeros(count, np.int8)
    known[label[np.where(sign > 0, cell, cell + n)]] = 1
    up, down = known[label[:n]], known[label[n:]]
    return (up - down).astype(np.int8), np.minimum(label[:n], label[n:])


def _two_copies(neighbors: np.ndarray) -> tuple[int, np.ndarray]:
    """Number of components, and the label (2 T,) of each, of two copies of the cells, upright and
    the other way round, where a face joins those that go together."""
    n = len(neighbors)
    c, k = np.nonzero(neighbors >= 0)
    words = neighbors[c, k]
    m, f = packing.cell_of(words), packing.corner_of(words)
    other = (k + f) % 2 == 0
    rows, cols = np.r_[c, c + n], np.r_[np.where(other, m + n, m), np.where(other, m, m + n)]
    return _connected(2 * n, rows, cols)


def entries_agree(neighbors: np.ndarray, boundary: np.ndarray) -> np.ndarray:
    """Whether no `entry` bit in the component of a boundary face (F,) contradicts its own: all of a
    component follow from one of them. (One-sided components have no such rule.)"""
    n = len(neighbors)
    count, label = _two_copies(neighbors)
    cell, up = packing.cell_of(boundary), entry_signs(boundary) > 0
    mine, opposite = label[np.where(up, cell, cell + n)], label[np.where(up, cell + n, cell)]
    said = np.zeros(count, bool)
    said[mine] = True
    return ~said[opposite] | (mine == opposite)


def entry_signs(boundary: np.ndarray) -> np.ndarray:
    """tau (F,) int8 of the cells at the boundary, from its words."""
    entry, odd = packing.flag_of(boundary), packing.corner_of(boundary) % 2
    return np.where(entry == odd, 1, -1).astype(np.int8)


def neighbor_words(rows: np.ndarray, pairs: np.ndarray, turned: np.ndarray) -> np.ndarray:
    """The `neighbors` (T, 4) int32 of `TetMesh`. rows (T, 4): own point ids in sorted order."""
    out = np.full(rows.shape, -1, np.int32)
    c, k, m, f = pairs.T
    seam = np.zeros(len(pairs), bool)
    for i in range(3):
        seam |= rows[c, FACES[k, i]] != rows[m, FACES[f, i]]
    out[c, k] = packing.pack(m, f, turned[m], seam)
    out[m, f] = packing.pack(c, k, turned[c], seam)
    return out


def boundary_words(
    points: np.ndarray,
    rows: np.ndarray,
    neighbors: np.ndarray,
    sign: np.ndarray,
    turned: np.ndarray,
) -> np.ndarray:
    """The `boundary` (F,) int32 of `TetMesh`. sign (T,): geometric orientation of the rows."""
    c, f = np.nonzero(neighbors < 0)
    tau = np.where(turned[c], -sign[c], sign[c])
    entry = np.where(f % 2 == 1, tau, -tau) > 0
    words = packing.pack(c, f, turned[c], entry).astype(np.int32)
    corners = rows[c[:, None], FACES[f]]
    return words[morton_order(points[corners].astype(np.float64).mean(1))]


def morton_order(points: np.ndarray) -> np.ndarray:
    """The order (n,) of points (n, 3) along a Z-shaped curve through their bounding box."""
    if len(points) == 0:
        return np.zeros(0, np.intp)
    lo = points.min(0)
    size = np.maximum(points.max(0) - lo, np.finfo(np.float64).tiny)
    cell = np.clip((points - lo) / size * 2.0**21, 0, 2**21 - 1).astype(np.uint64)
    code = np.zeros(len(points), np.uint64)
    for axis in range(3):
        code |= _spread(cell[:, axis]) << np.uint64(axis)
    return np.argsort(code, kind="stable")


def _spread(x: np.ndarray) -> np.ndarray:
    """The 21 bits of x with two zero bits between any two of them."""
    for shift, mask in (
        (32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3), (2, 0x1249249249249249),
    ):  # fmt: skip
        x = (x | (x << np.uint64(shift))) & np.uint64(mask)
    return x
