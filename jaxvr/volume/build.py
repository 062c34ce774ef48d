"""From points, cells and values as people have them to the arrays of a `TetMesh` (all NumPy).

The steps, each a function below or in a file beside this one: name the cell types (`cells`), check
the indices, weld, subdivide, drop what repeats a point, turn what is inverted, sort each row by
welded id, match the faces, find the fold bits, and put the boundary in order.

Cells without volume stay. A face is shared by two cells or bounds the mesh, so without a flat cell
the faces beside it would bound the mesh inside of it: a crack, whose two sides a ray may or may not
cross both, and a hole once the points move. Which cells are flat `geometry.flat_cells` says; their
corners do not tell which way round they lie, and their neighbours do (`connectivity.fill_signs`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from .._core.checks import as_floats, default_float, float_dtype, is_concrete, require_finite
from .._core.offsets import NOWHERE, Origin, origin_between
from .._core.units import scaled_to_one
from . import cells as zoo
from . import connectivity as conn
from .digits import coarse_cells
from .geometry import flat_cells, signed_volumes
from .packing import MAX_CELLS
from .report import MeshReport, collapse
from .unused import gathered, used_by
from .weld import weld

# comparators of a sorting network for four keys
_NETWORK = ((0, 1), (2, 3), (0, 2), (1, 3), (1, 2))

# A cell is twisted if more than this part of its volume lies the other way round than the rest.
# Thin curved cells have slivers that do; wrong orders of the nodes turn a quarter or more.
_TWISTED = 0.05
# Six volumes of a cell, as a part of its longest edge cubed, above which it is no sliver of
# rounding.
_SOLID = 1e-6
# The same for a cell that lies the wrong way round among its neighbours: half the digits of
# float64, in which meshes are made. Generators compare squares of lengths (circumspheres of nearly
# cospherical points), which tell lengths to the root of the rounding only; so a fold lower than
# that is theirs. Qhull returns some on lattices jittered by 1e-12, about 1e-11 high.
_RESOLVED = 2.0**-26
# Cells on which other orders are tried.
_SAMPLE = 1000


@dataclasses.dataclass(frozen=True)
class Block:
    """Input cells of one type. corners (N, n): point ids in VTK's order; columns: where each of
    them stood in the cells as given."""

    name: str
    kind: zoo.CellKind
    corners: np.ndarray
    columns: tuple[int, ...]


def mesh_dtype(points: Any, dtype: Any) -> np.dtype:
    """float64 where x64 is on and the points (or `dtype`) ask for it, else float32."""
    if dtype is None:
        given = getattr(points, "dtype", None)
        if given is None:
            try:
                given = np.asarray(points).dtype
            except Exception:
                return default_float()
        given = np.dtype(given).newbyteorder("=")  # files may have the other byte order
        return float_dtype(given) if given.kind == "f" else default_float()
    try:
        want = np.dtype(dtype)
    except TypeError as e:
        raise ValueError(f"dtype must be float32 or float64, but is {dtype!r}.") from e
    if want not in (np.float32, np.float64):
        raise ValueError(f"dtype must be float32 or float64, but is {want}.")
    if want == np.float64 and default_float() != np.float64:
        raise ValueError(
            'dtype float64 needs 64-bit JAX: jax.config.update("jax_enable_x64", True) first.'
        )
    return want


def numbers(name: str, x: Any) -> np.ndarray:
    """x as a finite NumPy array of float64, or a ValueError that names it."""
    if not is_concrete(x):
        raise ValueError(
            f"{name} is traced, but building a mesh finds integers from its values. Build the mesh "
            "outside jit and grad, and use mesh.replace(points=..., values=...) inside."
        )
    array = as_floats(name, np.asarray(x) if isinstance(x, jax.Array) else x, dtype=np.float64)
    require_finite(name, array)
    return array


def cast(name: str, array: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """Finite float64 numbers in this dtype, or a ValueError that names them."""
    with np.errstate(over="ignore", under="ignore"):
        out = array.astype(dtype)
    if not np.isfinite(out).all():
        i = int(np.argmax(np.abs(array).ravel()))
        raise ValueError(
            f"{name} overflows {dtype}: the largest is {array.ravel()[i]:g}. Scale it."
        )
    return out


def read_points(points: Any) -> np.ndarray:
    """(P, 3) float64."""
    out = numbers("points", points)
    if out.ndim != 2 or out.shape[1] != 3:
        raise ValueError(f"points must have shape (P, 3), but has {out.shape}.")
    if len(out) == 0:
        raise ValueError("The mesh is empty: points has shape (0, 3).")
    return out


def origin_for(points: np.ndarray, dtype: np.dtype) -> Origin:
    """What to hold points (n, 3) that cells use relative to: see `offsets`."""
    low, high = points.min(axis=0), points.max(axis=0)
    return origin_between(low, high, dtype)


def read_indices(name: str, x: Any, nodes: int | None, corners: int, n_points: int) -> np.ndarray:
    """Cell indices (N, nodes) as int64, in range, or a ValueError that names the cell type."""
    try:
        ids = np.asarray(x)
    except Exception as e:
        raise ValueError(f"cells[{name!r}] cannot be read as an array: {e}") from e
    if ids.size == 0 and ids.dtype.kind in "fiu":
        return np.zeros((0, corners if nodes is None else nodes), np.int64)
    if ids.dtype.kind not in "iu":
        raise ValueError(f"cells[{name!r}] must hold integers, but has dtype {ids.dtype}.")
    width = f"at least {corners}" if nodes is None else str(nodes)
    if ids.ndim != 2 or (ids.shape[1] < corners if nodes is None else ids.shape[1] != nodes):
        raise ValueError(f"cells[{name!r}] must have shape (N, {width}), but has {ids.shape}.")
    bad = (ids < 0) | (ids >= n_points)
    if bad.any():
        row, col = (int(i) for i in np.argwhere(bad)[0])
        raise ValueError(
            f"cells[{name!r}] has {int(bad.sum())} indices out of range, the first at "
            f"({row}, {col}): {int(ids[row, col])}, where 0 to {n_points - 1} are points."
        )
    return ids.astype(np.int64)


def read_blocks(cells: Any, n_points: int) -> tuple[list[Block], dict[str, int], dict[str, int]]:
    """The solid blocks in their order; counts of cells reduced to corners and of cells ignored."""
    if not isinstance(cells, Mapping):
        raise ValueError(
            'cells must be a dict from type to indices, such as {"tetra": (N, 4)}, but is '
            f"{type(cells).__name__}."
        )
    blocks, reduced, ignored = [], {}, {}
    for name, x in cells.items():
        kind, nodes, corners = zoo.canonical(name)
        label = str(name)
        if kind is None:
            ignored[label] = len(x)
            continue
        assert corners is not None
        ids = read_indices(label, x, nodes, kind.n_corners, n_points)
        if ids.shape[1] > kind.n_corners and len(ids):
            reduced[label] = len(ids)
        blocks.append(Block(label, kind, ids[:, corners], corners))
    if sum(len(b.corners) for b in blocks) == 0:
        found = ", ".join(f"{n} {t}" for t, n in ignored.items()) or "none at all"
        raise ValueError(f"The mesh has no solid cells (found: {found}).")
    return blocks, reduced, ignored


def sort_rows(tets: np.ndarray, welded: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How to sort each row by welded id: local order (T, 4) and whether it is odd (T,) bool."""
    ids = welded[tets]
    order = np.tile(np.arange(4, dtype=np.int8), (len(tets), 1))
    odd = np.zeros(len(tets), bool)
    for i, j in _NETWORK:
        swap = ids[:, i] > ids[:, j]
        for a in (ids, order):
            a[swap, i], a[swap, j] = a[swap, j], a[swap, i]
        odd ^= swap
    return order, odd


@dataclasses.dataclass(frozen=True)
class Built:
    """Arrays of a `TetMesh` without its values. parent (T,): the input cell of each tetrahedron,
    counted over all blocks; order (T, 4): which corner of it (for tetra) each row entry is."""

    points: np.ndarray
    cells: np.ndarray
    neighbors: np.ndarray
    boundary: np.ndarray
    duplicates: np.ndarray
    parent: np.ndarray
    order: np.ndarray
    n_input: int
    all_tetra: bool
    block_sizes: tuple[tuple[str, int], ...]
    report: MeshReport
    origin: Origin = NOWHERE  # the points are relative to it
    mixed: int = 0  # cells of the zoo that lie the other way round than most of their type


def _input_name(i: int, blocks: list[Block]) -> str:
    for b in blocks:
        if i < len(b.corners):
            return f"{b.name} {i}"
        i -= len(b.corners)
    raise AssertionError


def _cut(
    pts: np.ndarray, welded: np.ndarray, kind: zoo.CellKind, corners: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Cells as tetrahedra (T, 4), their parents (T,), volumes times six (T,) and signs (T,), which
    are 0 for those without volume, as those that repeat a point."""
    t, p = zoo.subdivide(kind, corners, welded)
    return t, p, *signed_volumes(pts, t)


def _repeats(welded: np.ndarray, tets: np.ndarray) -> np.ndarray:
    """Which tetrahedra (T,) bool have a point twice, by welded ids."""
    ids = welded[tets]
    return np.any([ids[:, i] == ids[:, j] for i in range(4) for j in range(i)], axis=0)


def _twisted(
    parent: np.ndarray, volume: np.ndarray, sign: np.ndarray, n: int
) -> tuple[int, int, int]:
    """Of n cells, how many are twisted (see `_TWISTED`), and how many of the others are positive
    and negative. Flat ones are none of the three."""
    up = np.bincount(parent, np.where(sign > 0, volume, 0), n)
    down = np.bincount(parent, np.where(sign < 0, -volume, 0), n)
    mixed = np.minimum(up, down) > _TWISTED * (up + down)
    return int(mixed.sum()), int((up > down)[~mixed].sum()), int((down > up)[~mixed].sum())


def _require_order(
    pts: np.ndarray, welded: np.ndarray, block: Block, counts: tuple[int, int, int]
) -> None:
    """ValueError if most cells of a block are twisted, with the order of their nodes if it is a
    known one. counts: from `_twisted`."""
    twisted, solid = counts[0], sum(counts)
    if 2 * twisted <= solid:
        return
    sample = block.corners[:: -(-len(block.corners) // _SAMPLE)]
    untwisting = {}
    for columns in zoo.ORDERS[block.kind.name]:
        _, p, volume, s = _cut(pts, welded, block.kind, sample[:, columns])
        still, positive, _ = _twisted(p, volume, s, len(sample))
        if still <= len(sample) // 100:  # real meshes have some that nothing untwists
            untwisting[columns] = positive
    advice = ""
    if untwisting:
        # A reflection of the right order untwists too, and turns the cells inside out.
        columns = max(untwisting, key=lambda c: untwisting[c])
        use = [block.columns[i] for i in columns]
        advice = f' They are consistent as {{"{block.kind.name}": cells[:, {use}]}}.'
    raise ValueError(
        f"{twisted} of {solid} {block.name} cells are twisted: their tetrahedra lie some one way "
        "round and some the other. Their nodes are probably not in VTK's order, which is "
        f"{zoo.ORDER_WORDS[block.kind.name]}.{advice}"
    )


def _collapsed(given: Any, pts: np.ndarray, tets: np.ndarray) -> int:
    """How many of these cells without volume (N, 4) have one in the points as they were given."""
    exact, _ = scaled_to_one(given)
    if pts.dtype == np.float64 or np.array_equal(given, pts):
        return 0
    volume, _ = signed_volumes(exact, tets)
    return int((np.abs(volume) > _SOLID * _longest(exact, tets) ** 3).sum())


def _longest(points: np.ndarray, tets: np.ndarray) -> np.ndarray:
    """The longest edge of each tetrahedron (T,), in float64."""
    corners = points[tets].astype(np.float64)
    edges = (corners[:, :, None] - corners[:, None]).reshape(len(tets), 16, 3)
    return np.sqrt((edges**2).sum(-1).max(-1))


def _match(welded_rows: np.ndarray, parent: np.ndarray, blocks: list[Block]) -> np.ndarray:
    """`match_faces`, with an error that names the cells as they were given."""
    try:
        return conn.match_faces(welded_rows)
    except conn.NonManifoldError as e:
        names = ", ".join(dict.fromkeys(_input_name(int(parent[c]), blocks) for c in e.cells))
        raise ValueError(
            f"{e}, in cells {names}. A volume has at most two cells to a face: remove the others."
        ) from None


def build(
    points: Any, cells: Any, dtype: Any, field: str | None = None, origin: Origin | None = None
) -> Built:
    """Everything but the values. Raises ValueError as `TetMesh.from_cells` says.

    origin: what the points are relative to; None for points as they are, which may get one.
    """
    kind, exact = mesh_dtype(points, dtype), read_points(points)
    blocks, reduced, ignored = read_blocks(cells, len(exact))
    used = used_by(len(exact), *(b.corners for b in blocks))
    if origin is None:
        origin = origin_for(exact[used], kind)
        exact = exact - np.asarray(origin)
    exact = gathered(exact, used)
    pts = cast("points", exact, kind)
    welded, duplicates = weld(pts)

    tets, parent, sizes, sign, start = [], [], [], [], 0
    zoo_signs = []
    for b in blocks:
        t, p, volume, s = _cut(pts, welded, b.kind, b.corners)
        if b.kind is not zoo.TETRA:
            counts = _twisted(p, volume, s, len(b.corners))
            _require_order(pts, welded, b, counts)
            zoo_signs.append(counts)
        # two node orders are in use for wedges (see cells.WEDGE); the sign of most tells which
        if b.kind is zoo.WEDGE and int(s.sum(dtype=np.int64)) < 0:
            s, volume = -s, -volume
            t = t[:, [0, 2, 1, 3]]
        tets.append(t)
        parent.append(p + start)
        sizes.append(volume)
        sign.append(s)
        start += len(b.corners)
    t, p, volume, s = (np.concatenate(x) for x in (tets, parent, sizes, sign))
    made, repeats = len(t), _repeats(welded, t)
    flat = flat_cells(pts, t) | (s == 0)
    collapsed = _collapsed(exact, pts, t[flat | repeats]) if flat.any() or repeats.any() else 0
    if not (s[~repeats] != 0).any():
        advice = f" {collapse(collapsed)}" if collapsed else ""
        raise ValueError(
            f"No cells left: all {made} tetrahedra are degenerate (no volume, or a repeated "
            f"point).{advice}"
        )
    if made - int(repeats.sum()) > MAX_CELLS:
        raise ValueError(f"The mesh has {made} tetrahedra; {MAX_CELLS} is the most that fit.")
    keep = np.flatnonzero(~repeats)
    order, odd = sort_rows(t[keep], welded)
    rows = np.take_along_axis(t[keep], order.astype(np.intp), 1)
    try:
        pairs = conn.match_faces(welded[rows])
    except conn.NonManifoldError:
        # flat cells are kept to close cracks, not to make a mesh unreadable
        left = ~conn.surplus(welded[rows], flat[keep])
        keep, order, odd, rows = keep[left], order[left], odd[left], rows[left]
        pairs = _match(welded[rows], p[keep], blocks)
    crowded = made - int(repeats.sum()) - len(keep)
    p, volume, flat = p[keep], volume[keep], flat[keep]
    s = np.where(flat, 0, s[keep]).astype(np.int8)
    swap = np.where(odd, -1, 1)
    orientation = conn.fill_signs(swap * s, swap * volume, pairs)
    turned, one_sided = conn.combinatorial(orientation, pairs, np.where(flat, 0.0, abs(volume)))
    flat[turned] |= _longest(pts, rows[turned]) ** 3 * _RESOLVED >= np.abs(volume[turned])
    # the sign of a flat cell is free, so it is never the one that lies the wrong way round
    orientation[turned & flat] *= -1
    turned &= ~flat
    neighbors = conn.neighbor_words(rows, pairs, turned)
    boundary = conn.boundary_words(pts, rows, neighbors, orientation, turned)
    report = MeshReport(
        input_cells=tuple((b.name, len(b.corners)) for b in blocks if len(b.corners)),
        reduced=tuple(reduced.items()),
        ignored=tuple(ignored.items()),
        tets=len(rows),
        degenerate=int(repeats.sum()),
        crowded=crowded,
        flat=int(flat.sum()),
        inverted=int(((s < 0) & ~flat).sum()),
        collapsed=collapsed,
        folded=int(turned.sum()),
        seams=int(((neighbors >= 0) & ((neighbors >> 3) & 1 == 1)).sum()) // 2,
        duplicate_points=len(duplicates),
        one_sided=one_sided,
        components=conn.components(len(rows), pairs)[0],
        field=field,
        coarse=coarse_cells(points, exact, pts, np.asarray(origin), rows),
    )
    return Built(
        points=pts,
        cells=rows.astype(np.int32),
        neighbors=neighbors,
        boundary=boundary,
        duplicates=duplicates,
        parent=p,
        order=order,
        n_input=start,
        all_tetra=all(b.kind is zoo.TETRA for b in blocks if len(b.corners)),
        block_sizes=tuple((b.name, len(b.corners)) for b in blocks),
        report=report,
        origin=origin,
        mixed=sum(min(up, down) for _, up, down in zoo_signs),
    )


# A file of which more than this part would have to be repaired is not what it seems.
_REPAIRED = 0.1


def require_sound(built: Built) -> None:
    """ValueError where repairs touch more than a tenth of a mesh: cells dropped as all of their
    tetrahedra repeat a point or stand three to a face, cells of the zoo turned round among others
    of their type that lie right, tetrahedra that overlap their neighbours.

    Which way round tetrahedra are written, and a mesh that lies the other way round as a whole,
    are conventions; so are hexahedra with an edge or a face in one point, while part of them is
    left.
    """
    n, report = built.n_input, built.report
    lost = n - len(np.unique(built.parent))
    found = (
        (lost, n, "cells repeat points or stand three to a face, and nothing is left of them"),
        (built.mixed, n, "cells are turned inside out, among others of their type that are not"),
        (report.folded, report.tets, "tetrahedra overlap their neighbours"),
    )
    for count, of, what in found:
        if count > _REPAIRED * of:
            raise ValueError(
                f"{count} of {of} {what}: with repairs in more than a tenth of it, the mesh would "
                "not be the one that was meant. The order of the nodes in its cells is probably "
                "another one, or points and cells do not belong together. If it is right, pass its "
                "arrays to TetMesh.from_cells, which repairs with a warning."
            )
