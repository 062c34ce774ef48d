"""Adjacency against brute force, and every bit of the words by its definition."""

import itertools

import numpy as np
import pytest

from jaxvr.volume import TetMesh, datasets, packing
from jaxvr.volume import connectivity as conn
from jaxvr.volume.weld import weld

MESHES = {
    "tetra": lambda: datasets.box((2, 3, 2), 0.2, 1, "tetra", shuffle=True),
    "hexahedron": lambda: datasets.box((2, 2, 3), 0.2, 2, "hexahedron", shuffle=True),
    "wedge": lambda: datasets.box((2, 2, 2), 0.2, 3, "wedge", shuffle=True),
    "pyramid": lambda: datasets.box((1, 2, 2), 0.2, 4, "pyramid", shuffle=True),
    "seam": lambda: datasets.cylinder_flow((2, 5, 2), closed=False),
    "heat sink": lambda: datasets.heat_sink(1),
}


def check_mesh(mesh):
    """All invariants of a TetMesh by their definitions; slow."""
    points, cells = np.asarray(mesh.points, float), np.asarray(mesh.cells)
    words, boundary = np.asarray(mesh.neighbors), np.asarray(mesh.boundary)
    welded, duplicates = weld(np.asarray(mesh.points))
    assert np.array_equal(duplicates, mesh.duplicates)
    rows = welded[cells]
    assert (np.diff(rows, axis=1) > 0).all()
    faces = {}
    for c, row in enumerate(rows.tolist()):
        for k in range(4):
            faces.setdefault(tuple(row[:k] + row[k + 1 :]), []).append((c, k))
    det = np.linalg.det(points[cells[:, 1:]] - points[cells[:, :1]])
    turned = np.zeros(len(cells), bool)
    outside = []
    for sides in faces.values():
        assert len(sides) <= 2
        if len(sides) == 1:
            outside += sides
            assert words[sides[0]] == -1
            continue
        for (c, k), (n, f) in (sides, sides[::-1]):
            w = int(words[c, k])
            assert (packing.cell_of(w), packing.corner_of(w)) == (n, f)
            turned[n] = packing.turned_of(w)
            own, other = np.delete(cells[c], k), np.delete(cells[n], f)
            assert packing.flag_of(w) == int((own != other).any())
            # the two opposite vertices lie on different sides, unless just one cell is turned
            apart = np.sign(det[c]) * np.sign(det[n]) * (-1) ** (k + f) == -1
            other_turned = packing.turned_of(int(words[n, f]))
            assert apart == (packing.turned_of(w) == other_turned)
    found = [(int(packing.cell_of(w)), int(packing.corner_of(w))) for w in boundary]
    assert sorted(found) == sorted(outside)
    for w, (c, f) in zip(boundary.tolist(), found, strict=True):
        tau = np.sign(det[c]) * (-1 if packing.turned_of(w) else 1)
        assert packing.flag_of(w) == int((tau if f % 2 else -tau) > 0)
        if not packing.turned_of(w):
            # entry by geometry: with q the sorted face, (q1 - q0) x (q2 - q0) against outwards
            q = points[np.delete(cells[c], f)]
            inwards = points[cells[c, f]] - q[0]
            normal = np.cross(q[1] - q[0], q[2] - q[0])
            assert (normal @ inwards > 0) == ((det[c] > 0) == (f % 2 == 1))
    return turned


@pytest.mark.parametrize("name", MESHES)
def test_definitions(name):
    assert not check_mesh(MESHES[name]()).any()


def test_folded_cell_is_marked():
    # a fan round the edge 0-1; the last vertex is pushed through the first cell's far side
    mesh = datasets.box((3, 3, 3))
    points = np.asarray(mesh.points).copy()
    inner = int(np.flatnonzero(np.abs(points - 1 / 3).max(1) < 1e-9)[0])
    points[inner] = [0.9, 0.1, 0.5]
    with pytest.warns(UserWarning, match="inverted"):
        folded = TetMesh.from_cells(points, {"tetra": mesh.cells}, mesh.values, location="point")
    turned = check_mesh(folded)
    # the given rows are not oriented, so only the fold bits tell which cells are
    assert 0 < turned.sum() == folded.report.folded < folded.n_tets / 2


def test_wrong_node_order_alone_is_no_fold():
    mesh = datasets.box((2, 2, 2))
    cells = np.asarray(mesh.cells)
    with pytest.warns(UserWarning, match="inverted tetrahedra turned"):
        again = TetMesh.from_cells(mesh.points, {"tetra": cells}, mesh.values, location="point")
    assert again.report.inverted > 0 and again.report.folded == 0
    assert np.array_equal(again.cells, mesh.cells)
    assert np.array_equal(again.neighbors, mesh.neighbors)


def test_combinatorial_signs_by_brute_force():
    rng = np.random.default_rng(5)
    mesh = datasets.box((2, 2, 2))
    pairs = conn.match_faces(np.asarray(mesh.cells, np.int64))
    points = np.asarray(mesh.points)[np.asarray(mesh.cells)]
    sign = np.sign(np.linalg.det(points[:, 1:] - points[:, :1])).astype(np.int8)
    wrong = rng.random(len(sign)) < 0.2
    turned, one_sided = conn.combinatorial(np.where(wrong, -sign, sign), pairs)
    assert one_sided == 0 and np.array_equal(turned, wrong)
    turned, _ = conn.combinatorial(np.where(wrong, sign, -sign), pairs)  # most decide
    assert np.array_equal(turned, wrong)


def test_components_are_signed_one_by_one():
    pairs = np.array([[0, 0, 1, 1], [1, 0, 2, 1], [3, 0, 4, 1], [4, 0, 5, 1]])
    # across faces 0 and 1 consistent cells have equal signs
    turned, _ = conn.combinatorial(np.array([1, -1, 1, -1, -1, 1], np.int8), pairs)
    assert turned.tolist() == [False, True, False, False, False, True]
    # of two cells the larger one decides, of three the one that outweighs the others
    sizes = np.array([1.0, 2.5, 1.0, 1.0, 2.0, 0.0])
    turned, _ = conn.combinatorial(np.array([1, -1, 1, -1, -1, 1], np.int8), pairs, sizes)
    assert turned.tolist() == [True, False, True, False, False, True]


def test_one_sided_chain():
    # three cells in a ring with an odd number of disagreements
    pairs = np.array([[0, 0, 1, 1], [1, 0, 2, 1], [2, 0, 0, 2]])
    turned, one_sided = conn.combinatorial(np.ones(3, np.int8), pairs)
    assert one_sided == 1 and not turned.any()


def test_two_word_keys_agree_with_one():
    rows = np.sort(np.random.default_rng(6).permutation(40)[:24].reshape(6, 4), 1)
    tets = np.asarray(datasets.box((2, 2, 2)).cells, np.int64)
    for cells in (rows, tets):
        small, same = conn._face_order(cells)
        large, same_large = conn._face_order(cells + (1 << 22))
        assert np.array_equal(same, same_large)

        def groups(order, same):
            parts = np.split(order, np.flatnonzero(~same) + 1)
            return {frozenset(p.tolist()) for p in parts}

        assert groups(small, same) == groups(large, same_large)


def test_components_count():
    mesh = datasets.box((1, 1, 2))
    points = np.asarray(mesh.points)
    two = np.concatenate([points, points + 2.0])
    cells = np.asarray(mesh.cells)
    with pytest.warns(UserWarning):
        pair = TetMesh.from_cells(
            two,
            {"tetra": np.concatenate([cells, cells + len(points)])},
            two[:, 0],
            location="point",
        )
    assert "2, the largest of 12 tetrahedra" in pair.describe()


def test_three_cells_at_a_face():
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1], [1, 1, 1.0]])
    cells = [[0, 1, 2, 3], [0, 1, 2, 4], [0, 1, 2, 5]]
    with pytest.raises(ValueError) as error:
        TetMesh.from_cells(points, {"tetra": cells}, points[:, 0])
    text = str(error.value)
    assert "1 face(s)" in text and "(0, 1, 2)" in text
    assert all(f"tetra {i}" in text for i in range(3))


def test_cell_given_twice_names_both_even_at_other_points():
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    points = np.concatenate([points, points])
    with pytest.raises(ValueError, match=r"1 cell\(s\) are given twice.*tetra 0, tetra 1"):
        TetMesh.from_cells(points, {"tetra": [[0, 1, 2, 3], [4, 5, 6, 7]]}, points[:, 0])


def test_morton_order_is_a_permutation_and_local():
    p = np.random.default_rng(7).random((4096, 3))
    order = conn.morton_order(p)
    assert np.array_equal(np.sort(order), np.arange(4096))
    step = np.linalg.norm(np.diff(p[order], axis=0), axis=1).mean()
    assert step < 0.25 * np.linalg.norm(np.diff(p, axis=0), axis=1).mean()
    corners = np.array(list(itertools.product((0.0, 1.0), repeat=3)))[:, ::-1]  # x fastest
    assert conn.morton_order(corners).tolist() == list(range(8))
    assert conn.morton_order(np.zeros((0, 3))).shape == (0,)
