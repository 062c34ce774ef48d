"""Refinement of degenerate cells, those that are large but thin.

Paper: Callahan, Ikits, Comba and Silva, "Hardware-Assisted Visibility Sorting for Unstructured
Volume Rendering" (2005), section 5. They find that such cells bring
faces, sorted by their centroids, far out of visibility order, and propose to look for the cells
that digress most from the Delaunay property (no point in the circumsphere) and to subdivide them
into smaller and more symmetric ones. How far a cell digresses and how it is cut they leave open:
here the first is `delaunay_deviation`, and cuts are longest-edge bisections (Rivara, "New
longest-edge algorithms for the refinement and/or improvement of unstructured triangulations",
1997). From the longest edge of a chosen cell one goes on to the longest of all edges of the cells
round it, until an edge is the longest in each of its cells; that edge is bisected, and all those
cells with it. So faces go on matching, no cell is cut across a shorter edge, and none twice in a
round. Edges are compared by welded ids, so both sides of a seam are cut alike, each with a midpoint
of its own (see `weld`).

Which cells first? Of those that deviate clearly the longest: for as many added cells that lowered
the k that a k-buffer needs more than going by deviation, by its depth as a length, or by products
of the two. Whether k is lowered at all depends on the mesh (`experiments/havs.md`). Means over six
views of the largest k, before and after `refine` with its defaults: 26,500 Delaunay cells of random
points, squeezed along z to three tenths, 88 and 71 (71 by size alone too); to one tenth, where
nearly all are thin, 101 and 101. In can.vtu, thin cells all over, 28 and 34: a face that stays
large has more faces beside it than before. bluntfin.vtu comes back as it is, since its cells,
however thin, are Delaunay to within 4 % of the radius; by size alone k rises there from 59 to 75.
So measure. Nor is the result a Delaunay mesh: midpoints lie in other cells' spheres, and halves of
slivers are slivers.
"""

from __future__ import annotations

import dataclasses
import math
from numbers import Integral, Real
from typing import Any, NamedTuple

import numpy as np

from .._core.checks import is_concrete
from .._core.units import scaled_to_one
from .geometry import flat_cells, signed_volumes
from .integrity import require_mesh
from .mesh import TetMesh, _from_cells
from .packing import cell_of, corner_of
from .weld import weld

_CHUNK = 1 << 16
_EDGES = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])
# An apex no deeper than this part of the radius is on the sphere: the corners of a grid's block
# are, but for the rounding of their coordinates.
_SHALLOW = 1e-4


def refine(mesh: TetMesh, share: float = 0.01, rounds: int = 3, deviation: float = 0.05) -> TetMesh:
    """The same volume and field with large, thin cells cut into smaller ones.

    share: the part of all cells, in (0, 1], that are chosen in a round: the longest of those whose
    `delaunay_deviation` is at least `deviation`, in [0, 1]; 0 leaves size alone to decide. rounds:
    how often, at least 1; each measures and chooses anew.

    A chosen cell has its longest edge bisected, with all cells round it, five or so; but longer
    edges of these come first, and the cell itself in a later round (see the module). A round adds
    some 5 `share` of the cells at most, usually less than half. Points keep their ids, new ones
    follow; halves of a cell stand where it stood. The field is the same function of space, to
    rounding: midpoints of point data are means, cell data are inherited, corner data interpolated.
    What is cut depends on the geometry alone, so two fields on the same mesh are refined alike. A
    mesh with nothing to cut comes back as it is.

    An edge stays whole where its midpoint, rounded to the dtype of the points, would leave a cell
    flat or turned over, or would fall on another point. Cells that are flat already are cut with
    those round them, into flat ones. Turned cells (see `TetMesh`) are cut as
    others are, and their halves are turned. The report goes on telling what was given and repaired
    when the mesh was built. Nothing is differentiated: refine outside `jit` and `grad`.

    Raises ValueError for anything but a `TetMesh` of known numbers, and for numbers out of range.
    """
    _check(mesh)
    if not _is_real(share) or not 0.0 < share <= 1.0:
        raise ValueError(f"share must be in (0, 1], but is {share!r}; 0.01 chooses 1 % of cells.")
    if not _is_real(rounds) or not isinstance(rounds, Integral) or rounds < 1:
        raise ValueError(f"rounds must be an integer of at least 1, but is {rounds!r}.")
    if not _is_real(deviation) or not 0.0 <= deviation <= 1.0:
        raise ValueError(
            f"deviation must be in [0, 1], but is {deviation!r}; 0 chooses cells by size alone."
        )
    for _ in range(rounds):
        finer = _round(mesh, float(share), float(deviation))
        if finer is mesh:
            break
        mesh = finer
    return mesh


def _is_real(x: Any) -> bool:
    return isinstance(x, Real) and not isinstance(x, bool)


def _check(mesh: Any) -> None:
    if not isinstance(mesh, TetMesh):
        raise ValueError(
            f"mesh must be a TetMesh, but is {type(mesh).__name__}. Make one with "
            "TetMesh.from_cells or read_mesh."
        )
    if not is_concrete(mesh.points, mesh.values, mesh.cells):
        raise ValueError(
            "mesh is traced, but which cells to cut follows from its numbers. Use it outside jit "
            "and grad."
        )
    require_mesh(mesh)


def delaunay_deviation(mesh: TetMesh) -> np.ndarray:
    """How far each cell digresses from the Delaunay property: (T,) float64, 0 where it does not.

    It is the depth to which a neighbour's vertex (opposite their common face) lies inside the
    cell's circumsphere, r - |apex - centre|, by the radius r: the largest of up to four, from 0 to
    1, where the apex is the centre. Size does not enter. Boundary faces count for nothing, so a
    mesh of one cell has 0; so has a flat cell, whose sphere is infinite. Depths below 1e-4 are 0:
    points of a grid lie on common spheres, but for rounding.
    """
    _check(mesh)
    points = np.asarray(mesh.points, np.float64)
    cells, words = np.asarray(mesh.cells), np.asarray(mesh.neighbors)
    # a power of two, exactly undone: keeps products in range for coordinates of any size
    exponent = int(np.frexp(np.abs(points).max())[1])
    points = np.ldexp(points, -exponent)
    out = np.empty(len(cells))
    for i in range(0, len(cells), _CHUNK):
        w = words[i : i + _CHUNK]
        q = points[cells[i : i + _CHUNK]]
        apex = points[cells[cell_of(w), corner_of(w)]]  # of some cell for -1
        depth = np.where(w >= 0, _relative_depths(q, apex), 0.0).max(1)
        out[i : i + _CHUNK] = np.where(depth > _SHALLOW, depth, 0.0)
    return out


def _relative_depths(q: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Depths (n, 4) of points in circumspheres by radius. q, p (n, 4, 3): cells, four points each.

    From q0, with edges a, b, c to the other vertices and D = a . (b x c), the centre is x = N / 2D,
    where N = |a|^2 b x c + |b|^2 c x a + |c|^2 a x b, and r = |x|. The depth r - |p - x| is
    (r^2 - |p - x|^2) / (r + |p - x|), and hence, by r,

        2 D (p . N - |p|^2 D) / (|N| (|N|/2 + |N/2 - p D|))        for D > 0 (else D, N negated)

    which does not divide by D nor subtract two large radii: as a cell gets flat this goes to 0.
    """
    a, b, c = np.moveaxis(q[:, 1:] - q[:, :1], 1, 0)
    bc, ca, ab = np.cross(b, c), np.cross(c, a), np.cross(a, b)
    aa, bb, cc = ((v * v).sum(1, keepdims=True) for v in (a, b, c))
    d = (a * bc).sum(1)
    n = np.where(d < 0, -1.0, 1.0)[:, None] * (aa * bc + bb * ca + cc * ab)
    d, n = np.abs(d)[:, None], n[:, None]
    p = p - q[:, :1]
    above = 2.0 * d * ((p * n).sum(2) - (p * p).sum(2) * d)
    size = np.linalg.norm(n, axis=2)
    below = size * (0.5 * size + np.linalg.norm(0.5 * n - p * d[:, :, None], axis=2))
    return np.divide(above, below, out=np.zeros_like(above), where=below > 0)


class _Cuts(NamedTuple):
    """Cells round edges, (n,) each: the cell, its local vertices i < j at the ends of the edge, and
    the edge's number."""

    cell: np.ndarray
    i: np.ndarray
    j: np.ndarray
    edge: np.ndarray

    def only(self, keep: np.ndarray) -> _Cuts:
        """Those of the edges in the mask `keep`."""
        here = keep[self.edge]
        return _Cuts(*(x[here] for x in self))


def _round(mesh: TetMesh, share: float, deviation: float) -> TetMesh:
    """One round of `refine`; `mesh` itself if nothing is cut."""
    points, cells, values = (np.asarray(x) for x in (mesh.points, mesh.cells, mesh.values))
    welded = np.arange(len(points))
    welded[np.asarray(mesh.duplicates)[:, 0]] = np.asarray(mesh.duplicates)[:, 1]
    longest, square = _longest(points, welded[cells])
    worst = np.flatnonzero(delaunay_deviation(mesh) >= deviation)
    worst = worst[np.argsort(-square[worst], kind="stable")[: math.ceil(share * len(cells))]]
    cuts = _terminal_cuts(welded[cells], longest, worst)
    cuts = cuts.only(_possible(points, welded, cells, cuts))
    if len(cuts.cell) == 0:
        return mesh

    a, b, middle = _middles(len(points), cells, cuts)
    parent = np.r_[np.arange(len(cells)), cuts.cell]
    if mesh.location == "point":
        values = np.r_[values, _mean(values[a], values[b])]
    elif mesh.location == "cell":
        values = values[parent]
    else:
        mean = _mean(values[cuts.cell, cuts.i], values[cuts.cell, cuts.j])
        values = _halve(values, cuts, mean)
    cells = _halve(cells, cuts, middle)
    points = np.concatenate([points, _mean(points[a], points[b])])

    # rows are not sorted by orientation: none is to count as given the wrong way round
    swap = signed_volumes(points, cells)[1] < 0
    cells[swap, 2], cells[swap, 3] = cells[swap, 3], cells[swap, 2]
    order = np.argsort(parent, kind="stable")
    if mesh.location == "corner":
        values[swap, 2], values[swap, 3] = values[swap, 3], values[swap, 2]
    if mesh.location != "point":
        values = values[order]
    old, blocks = mesh.report, {"tetra": cells[order]}
    made = _from_cells(
        *(TetMesh, points, blocks, values, mesh.location, mesh.dtype, old.field),
        stacklevel=4,
        flat_before=old.flat > 0,
        origin=mesh.origin,
        offset=mesh.offset,
    )
    report = dataclasses.replace(
        made.report,
        input_cells=old.input_cells,
        reduced=old.reduced,
        ignored=old.ignored,
        degenerate=old.degenerate + made.report.degenerate,
        crowded=old.crowded + made.report.crowded,
        inverted=old.inverted,
    )
    return dataclasses.replace(made, report=report)


def _keys(rows: np.ndarray) -> np.ndarray:
    """The edges (n, 6) of rows (n, 4) of ids, as one number each."""
    return (rows[:, _EDGES[:, 0]].astype(np.int64) << 32) | rows[:, _EDGES[:, 1]]


def _longest(points: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The longest edge of each cell: its key (T,), of equals the lowest, and its length squared,
    in a unit of its own. rows (T, 4): welded ids, whose order and coordinates all cells round an
    edge have in common."""
    points, _ = scaled_to_one(points)
    keys, squares = np.empty(len(rows), np.int64), np.empty(len(rows))
    for i in range(0, len(rows), _CHUNK):
        r = rows[i : i + _CHUNK]
        q = points[r]
        square = ((q[:, _EDGES[:, 1]] - q[:, _EDGES[:, 0]]) ** 2).sum(2)
        squares[i : i + _CHUNK] = most = square.max(1)
        best = square == most[:, None]
        keys[i : i + _CHUNK] = np.where(best, _keys(r), np.iinfo(np.int64).max).min(1)
    return keys, squares


def _cuts_of(rows: np.ndarray, edges: np.ndarray) -> _Cuts:
    """All cells round edges. rows (T, 4): welded ids, ascending; edges (E,): keys, ascending."""
    ends = np.zeros(int(rows.max()) + 1, bool)
    ends[edges >> 32] = ends[edges & 0xFFFFFFFF] = True
    near = np.flatnonzero(ends[rows].sum(1) >= 2)
    key = _keys(rows[near])
    place = np.searchsorted(edges, key)
    n, e = np.nonzero(np.r_[edges, -1][place] == key)
    return _Cuts(near[n], _EDGES[e, 0], _EDGES[e, 1], place[n, e])


def _terminal_cuts(rows: np.ndarray, longest: np.ndarray, chosen: np.ndarray) -> _Cuts:
    """The edges at the ends of the paths from chosen cells: each is the longest of all its cells.

    Every step of a path leads to a longer edge, or to one as long with a lower key, so it ends.
    """
    todo = seen = np.unique(longest[chosen])
    ended = [todo[:0]]
    while len(todo):
        cuts = _cuts_of(rows, todo)
        onward = longest[cuts.cell] != todo[cuts.edge]
        ended.append(np.delete(todo, cuts.edge[onward]))
        todo = np.setdiff1d(longest[cuts.cell[onward]], seen)
        seen = np.union1d(seen, todo)
    return _cuts_of(rows, np.sort(np.concatenate(ended)))


def _possible(points: np.ndarray, welded: np.ndarray, cells: np.ndarray, cuts: _Cuts) -> np.ndarray:
    """A mask of edges (E,): whether all halves lie as the whole cells do, unless those have no
    volume, and the midpoint falls on no other point."""
    out = np.ones(int(cuts.edge.max(initial=-1)) + 1, bool)
    a, b, middle = _middles(len(points), cells, cuts)
    points = np.concatenate([points, _mean(points[a], points[b])])
    whole = cells[cuts.cell]
    halves = _halve(whole, cuts._replace(cell=np.arange(len(whole))), middle)
    sign = signed_volumes(points, halves)[1].reshape(2, -1)
    same = (sign == signed_volumes(points, whole)[1]).all(0) | flat_cells(points, whole)
    first = np.full(len(out), len(points))
    np.minimum.at(first, cuts.edge, middle)
    alone = weld(points)[0][middle] == first[cuts.edge]
    out[cuts.edge[~(same & alone)]] = False
    return out


def _middles(
    n_points: int, cells: np.ndarray, cuts: _Cuts
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ends a, b (M,) of the new midpoints, by own ids, and the id of the midpoint (n,) of each cut.
    They are more than edges where a seam's coincident points keep several copies of an edge."""
    a, b = cells[cuts.cell, cuts.i].astype(np.int64), cells[cuts.cell, cuts.j]
    key, place = np.unique((a << 32) | b, return_inverse=True)
    return key >> 32, key & 0xFFFFFFFF, n_points + place


def _mean(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 0.5 * x + 0.5 * y  # the same bits either way round, and no overflow


def _halve(rows: np.ndarray, cuts: _Cuts, new: np.ndarray) -> np.ndarray:
    """Rows (T, 4) of cells with `new` (n,) in place of vertex j, then (n, 4) with it for i."""
    out = np.concatenate([rows, rows[cuts.cell]])
    out[cuts.cell, cuts.j] = new
    out[len(rows) + np.arange(len(new)), cuts.i] = new
    return out
