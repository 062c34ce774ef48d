"""Zoo cells and their subdivision into tetrahedra (paper: Max, Williams, Silva and Cook, "Volume
rendering for curvilinear and unstructured grids", section IV).

Every quadrilateral is cut along the diagonal that starts at its smallest vertex. The decision
looks at those four vertices only, so two cells that share the face cut it alike, whatever they
are. A cell is then pulled from its smallest vertex A: A is joined to every triangle of the faces
that do not contain it. That gives 2 tetrahedra for a pyramid, 3 for a wedge and 6 for a
hexahedron. The hexahedron has one other case: where none of the diagonals of the three faces
without A ends at G, the vertex farthest from A, those diagonals and the three from A are the edges
of a central tetrahedron; it and the four corners that it leaves are 5 in all.

"Smallest" is by welded id (see `weld`), ties by the place in the cell, so both sides of a seam of
coincident points are cut alike. A cell with coincident vertices (a hexahedron collapsed to a wedge)
needs no special case: those of its tetrahedra that repeat a welded id are dropped later.
Grids numbered along i, j, k always give 6, since there G is the largest vertex of each far face.
"""

from __future__ import annotations

import dataclasses
import re
from typing import Any

import numpy as np


@dataclasses.dataclass(frozen=True)
class CellKind:
    """A linear cell in VTK's node order. `reference` (n, 3): positive volume means this order."""

    name: str
    reference: tuple[tuple[int, int, int], ...]
    triangles: tuple[tuple[int, int, int], ...]
    quads: tuple[tuple[int, int, int, int], ...]

    @property
    def n_corners(self) -> int:
        return len(self.reference)


_BASE = ((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0))

TETRA = CellKind(
    "tetra",
    ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)),
    ((0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)),
    (),
)
HEXAHEDRON = CellKind(
    "hexahedron",
    _BASE + ((0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)),
    (),
    ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)),
)
# VTK's wedge has its first triangle facing outwards; meshio and gmsh have it facing inwards. The
# cell is the same, only the sign of its volume differs (see `build`, which accepts both).
WEDGE = CellKind(
    "wedge",
    ((0, 0, 0), (0, 1, 0), (1, 0, 0), (0, 0, 1), (0, 1, 1), (1, 0, 1)),
    ((0, 1, 2), (3, 5, 4)),
    ((0, 3, 4, 1), (1, 4, 5, 2), (2, 5, 3, 0)),
)
PYRAMID = CellKind(
    "pyramid",
    _BASE + ((0, 0, 1),),
    ((0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)),
    ((0, 3, 2, 1),),
)
KINDS = {k.name: k for k in (TETRA, HEXAHEDRON, WEDGE, PYRAMID)}

# Orders that other programs write, as the columns that make VTK's of them. Counted with x fastest
# (deal.II, DOLFINx, VTK's voxel) and with z fastest (NumPy's ravel), the two faces by turns, and
# the second face the other way round.
ORDERS = {
    "hexahedron": (
        (0, 1, 3, 2, 4, 5, 7, 6),
        (0, 4, 6, 2, 1, 5, 7, 3),
        (0, 2, 4, 6, 1, 3, 5, 7),
        (0, 1, 2, 3, 4, 7, 6, 5),
    ),
    "wedge": ((0, 2, 4, 1, 3, 5), (0, 1, 2, 3, 5, 4)),
    "pyramid": ((0, 1, 3, 2, 4),),
}
ORDER_WORDS = {
    "hexahedron": "one face counter-clockwise as seen from the opposite one, then that one in the "
    "same order",
    "wedge": "one triangle, then the opposite one in the same order",
    "pyramid": "the base counter-clockwise as seen from the apex, then the apex",
}

_ALIASES = {
    "tet": "tetra", "tetrahedron": "tetra", "hex": "hexahedron", "hexa": "hexahedron",
    "prism": "wedge", "penta": "wedge", "pyra": "pyramid",
    "quadratictetra": "tetra10", "quadratichexahedron": "hexahedron20",
    "triquadratichexahedron": "hexahedron27", "quadraticwedge": "wedge15",
    "biquadraticquadraticwedge": "wedge18", "quadraticpyramid": "pyramid13",
    "triquadraticpyramid": "pyramid19", "lagrangetetrahedron": "tetra",
    "lagrangehexahedron": "hexahedron", "lagrangewedge": "wedge", "lagrangepyramid": "pyramid",
    "polyhedronparts": "tetra",  # what `io.polyhedra` makes
    "10": "tetra", "11": "voxel", "12": "hexahedron", "13": "wedge", "14": "pyramid",
    "24": "tetra10", "25": "hexahedron20", "26": "wedge15", "27": "pyramid13",
    "29": "hexahedron27", "31": "wedge12", "32": "wedge18", "33": "hexahedron24", "37": "pyramid19",
    "quadraticlinearwedge": "wedge12", "biquadraticquadratichexahedron": "hexahedron24",
}  # fmt: skip
# VTK's cells of any order, by number: Lagrange's, and Bezier's, whose corners are such too.
_HIGH = {
    str(first + k): f"lagrange{name}"
    for first in (68, 75)
    for k, name in enumerate(
        ("curve", "triangle", "quadrilateral", "tetrahedron", "hexahedron", "wedge", "pyramid")
    )
}
_FLAT = re.compile(
    r"(empty|vertex|polyvertex|line|polyline|curve|edge|triangle|trianglestrip|quad|pixel|polygon"
    r"|lagrangecurve|lagrangetriangle|lagrangequadrilateral|quadratic(edge|triangle|quad)"
    r"|biquadratic(triangle|quad)|[0-9]$|2[1238]$|3[0456]$)\d*$"
)
_SOLID = re.compile(r"(tetra|hexahedron|wedge|pyramid)(\d*)$")
_VOXEL = (0, 1, 3, 2, 4, 5, 7, 6)  # VTK's voxel counts x fastest; as a hexahedron


def canonical(name: Any) -> tuple[CellKind | None, int | None, tuple[int, ...] | None]:
    """What a cell type's name means.

    name: meshio's ("tetra10"), VTK's ("VTK_QUADRATIC_TETRA") or VTK's number (24).
    Returns (kind, nodes, corners): nodes is how many indices a cell has (`None`: the corners or
    more), corners which of them are the linear cell's. kind is `None` for points, lines and faces.
    Raises ValueError for a cell that is neither.
    """
    word = re.sub(r"[_\s-]", "", str(name).lower())
    full = word
    word = word.removeprefix("vtk")
    word = _HIGH.get(word, word).replace("bezier", "lagrange")
    lagrange = word.startswith("lagrange")
    word = _ALIASES.get(word, word)
    if word == "voxel":
        return HEXAHEDRON, 8, _VOXEL
    solid = _SOLID.match(word)
    if solid:
        kind = KINDS[solid[1]]
        nodes = int(solid[2]) if solid[2] else kind.n_corners
        if nodes >= kind.n_corners:
            return kind, None if lagrange else nodes, tuple(range(kind.n_corners))
    if not full or not _FLAT.match(word):
        raise ValueError(
            f"Cells of type {name!r} are not supported. jaxvr takes tetra, hexahedron, wedge and "
            "pyramid, and their quadratic forms (tetra10, hexahedron20, ...) reduced to corners."
        )
    return None, None, None


def _signed(points: np.ndarray, tet: tuple[int, ...]) -> float:
    p = points[list(tet)]
    return float(np.linalg.det(p[1:] - p[0]))


def _oriented(kind: CellKind, tets: list[tuple[int, ...]]) -> np.ndarray:
    """The tets as (n, 4) local indices, each positive in the reference cell (none is flat)."""
    ref = np.asarray(kind.reference, float)
    rows = [t if _signed(ref, t) > 0 else (t[0], t[1], t[3], t[2]) for t in tets]
    return np.array(rows, np.intp)


def template(kind: CellKind, a: int, diagonals: tuple[bool, ...]) -> np.ndarray:
    """The tetrahedra (n, 4) of one cell, as local corners.

    a: the smallest corner; diagonals: for each quad whether it is cut from its corner 0 to 2
    (else from 1 to 3). The diagonals must be those of an order whose minimum is `a`.
    """
    if kind is HEXAHEDRON:
        g = (6, 7, 4, 5, 2, 3, 0, 1)[a]
        far = [(q, d) for q, d in zip(kind.quads, diagonals, strict=True) if a not in q]
        # a diagonal of a far face avoids g if it joins the two corners beside g
        if all((q.index(g) % 2 == 0) != d for q, d in far):
            near = sorted({v for q, _ in far for v in q if (q.index(g) - q.index(v)) % 2})
            # the three corners beside g; the other three lie beside a
            beside = [v for v in range(8) if v not in near and v not in (a, g)]
            tets = [(a, *near), (g, *near)]
            for v in beside:
                tets.append((v, a, *[w for w in near if _adjacent(kind, v, w)]))
            return _oriented(kind, tets)
    tets = [(a, *t) for t in kind.triangles if a not in t]
    for (p, q, r, s), d in zip(kind.quads, diagonals, strict=True):
        if a not in (p, q, r, s):
            tets += [(a, p, q, r), (a, p, r, s)] if d else [(a, p, q, s), (a, q, r, s)]
    return _oriented(kind, tets)


def _adjacent(kind: CellKind, v: int, w: int) -> bool:
    return sum(x != y for x, y in zip(kind.reference[v], kind.reference[w], strict=True)) == 1


def subdivide(
    kind: CellKind, cells: np.ndarray, welded: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """All cells of one kind as tetrahedra.

    cells (N, n): point ids in VTK's order; welded (P,): see `weld`.
    Returns tets (T, 4), own point ids and positively oriented where the cell is, and parent (T,),
    the cell that each came from, ascending.
    """
    n = len(cells)
    if kind is TETRA or n == 0:
        return cells.reshape(-1, 4).copy(), np.arange(n)
    # unique within a cell, and ordered as the welded ids are
    order = welded[cells].astype(np.int64) * 8 + np.arange(kind.n_corners)
    a = order.argmin(1)
    code = a.copy()
    for q in kind.quads:
        code = code * 2 + order[:, list(q)].argmin(1) % 2
    sort = np.argsort(code, kind="stable")
    codes, starts = np.unique(code[sort], return_index=True)
    tets, parents = [], []
    for c, group in zip(codes, np.split(sort, starts[1:]), strict=True):
        bits = tuple(not (int(c) >> i) & 1 for i in reversed(range(len(kind.quads))))
        t = template(kind, int(c) >> len(kind.quads), bits)
        tets.append(cells[group][:, t].reshape(-1, 4))
        parents.append(np.repeat(group, len(t)))
    parent = np.concatenate(parents)
    back = np.argsort(parent, kind="stable")
    return np.concatenate(tets)[back], parent[back]
