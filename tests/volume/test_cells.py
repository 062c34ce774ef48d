"""Zoo subdivision: names, signs, volumes, and conformity for every numbering."""

import itertools

import numpy as np
import pytest

from jaxvr.volume import cells as zoo
from jaxvr.volume.geometry import signed_volumes

VOLUME = {"tetra": 1 / 6, "hexahedron": 1.0, "wedge": 0.5, "pyramid": 1 / 3}
RNG = np.random.default_rng(0)


def numberings(kind, limit=2000):
    n = kind.n_corners
    if n <= 6:
        return [np.array(p) for p in itertools.permutations(range(n))]
    return [RNG.permutation(n) for _ in range(limit)]


def cut(kind, welded):
    """The tets of one reference cell, as local corners, under this numbering."""
    tets, _ = zoo.subdivide(kind, np.arange(kind.n_corners)[None], welded)
    return tets


@pytest.mark.parametrize("kind", zoo.KINDS.values(), ids=zoo.KINDS)
def test_every_numbering_fills_the_cell_with_positive_tets(kind):
    reference = np.array(kind.reference, float)
    for welded in numberings(kind):
        tets = cut(kind, welded)
        det, sign = signed_volumes(reference, tets)
        assert (sign == 1).all()
        assert det.sum() / 6 == pytest.approx(VOLUME[kind.name], abs=1e-14)


@pytest.mark.parametrize("kind", zoo.KINDS.values(), ids=zoo.KINDS)
def test_inner_faces_are_shared_twice_and_outer_ones_are_the_cut_quads(kind):
    for welded in numberings(kind, 300):
        count = {}
        for tet in cut(kind, welded):
            for face in itertools.combinations(sorted(tet.tolist()), 3):
                count[face] = count.get(face, 0) + 1
        assert set(count.values()) <= {1, 2}
        outer = {face for face, n in count.items() if n == 1}
        expected = {tuple(sorted(t)) for t in kind.triangles}
        for q in kind.quads:
            i = int(np.argmin(welded[list(q)]))
            a, b, c, d = q[i:] + q[:i]
            expected |= {tuple(sorted((a, b, c))), tuple(sorted((a, c, d)))}
        assert outer == expected


def test_hexahedra_give_five_exactly_where_no_far_diagonal_ends_opposite():
    seen = set()
    for welded in numberings(zoo.HEXAHEDRON):
        a = int(np.argmin(welded))
        g = (6, 7, 4, 5, 2, 3, 0, 1)[a]
        ends = 0
        for q in zoo.HEXAHEDRON.quads:
            if a not in q:
                i = int(np.argmin(welded[list(q)]))
                ends += g in (q[i], q[(i + 2) % 4])
        n = len(cut(zoo.HEXAHEDRON, welded))
        assert n == (5 if ends == 0 else 6)
        seen.add((a, ends))
    assert seen == set(itertools.product(range(8), range(4)))


def test_counts_of_the_other_kinds():
    for kind, n in ((zoo.WEDGE, 3), (zoo.PYRAMID, 2), (zoo.TETRA, 1)):
        assert all(len(cut(kind, w)) == n for w in numberings(kind))


def test_parents_ascend_and_keep_each_cell_together():
    cells = np.array([RNG.permutation(30)[:8] for _ in range(50)])
    tets, parent = zoo.subdivide(zoo.HEXAHEDRON, cells, np.arange(30))
    assert (np.diff(parent) >= 0).all() and set(parent) == set(range(50))
    assert all(set(t) <= set(cells[p]) for t, p in zip(tets, parent, strict=True))


@pytest.mark.parametrize(
    ("name", "kind", "nodes"),
    [
        ("tetra", "tetra", 4),
        ("Hexahedron", "hexahedron", 8),
        ("VTK_WEDGE", "wedge", 6),
        ("vtkPyramid", "pyramid", 5),
        (10, "tetra", 4),
        ("12", "hexahedron", 8),
        ("tetra10", "tetra", 10),
        ("VTK_QUADRATIC_TETRA", "tetra", 10),
        ("hexahedron20", "hexahedron", 20),
        ("hexahedron27", "hexahedron", 27),
        ("wedge15", "wedge", 15),
        ("pyramid13", "pyramid", 13),
        ("pyramid14", "pyramid", 14),
        ("VTK_LAGRANGE_TETRAHEDRON", "tetra", None),
    ],
)
def test_names_of_solid_cells(name, kind, nodes):
    found, n, corners = zoo.canonical(name)
    assert found is zoo.KINDS[kind] and n == nodes
    assert corners == tuple(range(zoo.KINDS[kind].n_corners))


@pytest.mark.parametrize(
    "name", ["vertex", "line", "line3", "triangle", "triangle6", "quad", "quad9", "polygon5", 5, 23]
)
def test_names_of_flat_cells(name):
    assert zoo.canonical(name) == (None, None, None)


@pytest.mark.parametrize("name", ["polyhedron", "polyhedron12", "octahedron", 42, "", "tetra3"])
def test_unknown_cells_are_named(name):
    with pytest.raises(ValueError, match=repr(name)):
        zoo.canonical(name)


def test_voxels_are_reordered():
    kind, nodes, corners = zoo.canonical("VTK_VOXEL")
    x = np.array([[i, j, k] for k in (0, 1) for j in (0, 1) for i in (0, 1)])
    assert kind is zoo.HEXAHEDRON and nodes == 8
    assert np.array_equal(x[list(corners or ())], zoo.HEXAHEDRON.reference)
