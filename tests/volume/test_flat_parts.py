"""Cells without volume in all that a mesh is asked: zoo cells, seams, faces of three, words about
the mesh, grids of PyVista, and gradients."""

from __future__ import annotations

import importlib
import warnings
from typing import Any

import flat_meshes as flat
import jax
import numpy as np
import pytest

import jaxvr
from jaxvr.volume import TetMesh, packing
from jaxvr.volume import connectivity as conn
from jaxvr.volume.quality import quality

with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)  # in what PyVista imports
    pyvista: Any = importlib.import_module("pyvista")

pytestmark = pytest.mark.usefixtures("quick_code")

CUBE = np.array([[x, y, z] for z in (0, 1.0) for y in (0, 1.0) for x in (0, 1.0)])
FIVE = [[0, 1, 2, 4], [3, 1, 2, 7], [5, 1, 4, 7], [6, 2, 4, 7], [1, 2, 4, 7]]
HEXAHEDRON = [0, 1, 3, 2, 4, 5, 7, 6]
TURN = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
TURN *= np.linalg.det(TURN)
TRANSFER = ([0.0, 0.5, 1.0], np.eye(3), [1.0, 3.0, 2.0])


def build(points, cells, values=None, location="point", dtype="float64"):
    values = points[:, 0] if values is None else values
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of flat and inverted cells
        return TetMesh.from_cells(points, cells, values, location=location, dtype=dtype)


def rays(count=64, seed=0):
    """Through the unit cube from outside, in no special direction."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(count, 3))
    return rng.uniform(0.1, 0.9, (count, 3)) - 3 * direction, direction


def see(mesh, origins, directions, transfer=TRANSFER):
    at, colors, extinctions = (np.asarray(x, mesh.dtype) for x in transfer)
    tf = jaxvr.TransferFunction(at, colors, extinctions)
    origins, directions = (np.asarray(x, mesh.dtype) for x in (origins, directions))
    return jaxvr.render_rays(mesh, origins, directions, tf)


def check_chords(mesh, corners, origins, directions):
    """Against the hull of corners (P, 3), as float64."""
    rgba = see(mesh, origins, directions, ([0.0], np.ones((1, 3)), [0.5]))
    found = -np.log1p(-np.asarray(rgba, np.float64)[:, 3]) / 0.5
    want = flat.hull_chords(flat.hull_planes(corners), origins, directions)
    atol = 1e-11 if mesh.dtype == np.float64 else 5e-6
    np.testing.assert_allclose(found, want, rtol=0, atol=atol)


def layers(kind, heights, n=2):
    """The unit square in n x n blocks of a kind of cell between each two heights."""
    x = np.arange(n + 1) / n
    points = np.array([[a, b, z] for z in heights for b in x for a in x])
    w = n + 1
    first = np.array(
        [k * w * w + j * w + i for k in range(len(heights) - 1) for j in range(n) for i in range(n)]
    )
    square = np.array([0, 1, w + 1, w])
    hexahedra = first[:, None] + np.concatenate([square, square + w * w])
    if kind == "hexahedron":
        return points, hexahedra
    if kind == "wedge":
        halves = ([0, 2, 1, 4, 6, 5], [0, 3, 2, 4, 7, 6])
        return points, np.concatenate([hexahedra[:, half] for half in halves])
    quads = ([0, 1, 2, 3], [7, 6, 5, 4], [4, 5, 1, 0], [2, 6, 7, 3], [3, 7, 4, 0], [5, 6, 2, 1])
    apex = len(points) + np.arange(len(first))[:, None]
    cells = np.concatenate([np.concatenate([hexahedra[:, q], apex], 1) for q in quads])
    return np.concatenate([points, points[hexahedra].mean(1)]), cells


@pytest.mark.parametrize("kind", ["hexahedron", "wedge", "pyramid"])
def test_layers_as_thin_as_rounding(kind, dtype):
    """More flat blocks than solid ones, whose signs are noise where the mesh is turned."""
    eps = float(np.finfo(dtype).eps)
    heights = [0, *(0.3 * (1 + 2 * k * eps) for k in range(4)), 1]
    points, cells = layers(kind, heights)
    origins, directions = rays()
    for turn in (np.eye(3), TURN):
        mesh = build((points @ turn.T).astype(dtype), {kind: cells}, dtype=dtype)
        report = mesh.report
        assert report.flat + report.degenerate + report.crowded >= mesh.n_tets // 2
        assert report.flat > 0 and report.folded == report.one_sided == 0
        check_chords(mesh, CUBE @ turn.T, origins @ turn.T, directions @ turn.T)


def test_a_pyramid_with_its_apex_in_its_base():
    points = np.concatenate([CUBE, [[0.4, 0.6, 1.0]]])
    cells = {"hexahedron": [HEXAHEDRON], "pyramid": [[4, 5, 7, 6, 8]]}
    mesh = build(points, cells)
    assert mesh.report.flat == 2 and mesh.n_boundary == 10 + 4
    check_chords(mesh, CUBE, *rays())
    roof = points + np.eye(9)[8][:, None] * [0, 0, 0.5]  # the apex goes up
    check_chords(mesh.replace(points=roof), roof, *rays())


def test_quadratic_cells_whose_corners_are_coplanar():
    extra = np.random.default_rng(0).uniform(size=(6, 3))
    points = np.concatenate([CUBE, extra])
    tetra10 = [[*cell, *range(8, 14)] for cell in [*FIVE, [0, 1, 2, 3], [4, 5, 6, 7]]]
    mesh = build(points, {"tetra10": tetra10})
    assert mesh.report.reduced == (("tetra10", 7),) and mesh.report.flat == 2
    check_chords(mesh, CUBE, *rays())


def test_a_seam_between_flat_cells(dtype):
    """Two lattices whose common face has points of either's own; its mirror image has its faces."""
    shape = flat.lattice(4)
    points = np.concatenate([shape.points, shape.points * [-1, 1, 1] + [2, 0, 0]]) * [0.5, 1, 1]
    cells = np.concatenate([shape.cells, shape.cells + len(shape.points)])
    mesh = build(points, {"tetra": cells}, dtype=dtype)
    report = mesh.report
    assert report.duplicate_points == 16 and report.seams == 18 and report.flat > 0
    # flat cells in the face, of either side, are the same cell twice: neither is needed
    assert report.crowded == 6 and report.folded == report.one_sided == 0
    there = flat.FlatMesh(points, cells, np.zeros(len(points), bool))
    for aim in (flat.rays_at_features, flat.rays_along_features):
        origins, directions = (x.astype(dtype).astype(np.float64) for x in aim(there, 256))
        check_chords(mesh, points, origins, directions)


def test_flat_cells_that_crowd_a_face_are_dropped():
    """The face 1, 2, 4 has two solid cells; a flat one there is a third, and one is given twice."""
    points = np.concatenate([CUBE, [[0.5, 0.5, 0.0], (CUBE[1] + CUBE[2]) / 2 * 0.5 + CUBE[4] / 2]])
    third = [1, 2, 4, 9]
    twice = [0, 1, 2, 3]
    cells = {"tetra": [*FIVE, third, twice, twice]}
    with pytest.warns(UserWarning, match="2 flat tetrahedra dropped .three to a face") as caught:
        mesh = TetMesh.from_cells(points, cells, np.arange(8.0), location="cell")
    assert "1 flat tetrahedra (no volume) kept" in str(caught[0].message)
    assert "of 8 in the mesh" in str(caught[0].message)
    assert (mesh.report.crowded, mesh.report.flat, mesh.n_tets) == (2, 1, 6)
    assert sorted(np.asarray(mesh.values)) == [0, 1, 2, 3, 4, 6]
    assert "2 flat dropped, 1 flat kept" in mesh.describe()
    plain = build(CUBE, {"tetra": FIVE}, np.arange(5.0), "cell")
    np.testing.assert_allclose(see(mesh, *rays()), see(plain, *rays()), rtol=0, atol=1e-14)


def test_solid_cells_that_crowd_a_face_are_named_all_the_same():
    points = np.array(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1], [1, 1, 1.0], [1, 1, 0]]
    )
    cells = [[0, 1, 2, 6], [0, 1, 2, 3], [0, 1, 2, 4], [0, 1, 2, 5]]
    with pytest.raises(ValueError, match="three or more cells") as error:
        TetMesh.from_cells(points, {"tetra": cells}, points[:, 0])
    assert all(f"tetra {i}" in str(error.value) for i in (1, 2, 3))


def test_signs_of_flat_cells_by_definition():
    """Whatever sign a flat cell has, faces agree and the others are as they were."""
    shape = flat.lattice(4)
    mesh = build(shape.points, {"tetra": shape.cells})
    tau, label = conn.orientations(np.asarray(mesh.neighbors), np.asarray(mesh.boundary))
    points, cells = np.asarray(mesh.points), np.asarray(mesh.cells)
    det = np.linalg.det(points[cells[:, 1:]] - points[cells[:, :1]])
    solid = np.abs(det) > 1e-12
    assert (~solid).sum() == mesh.report.flat and len(np.unique(label)) == 1
    assert np.array_equal(tau[solid], np.sign(det[solid]))
    # faces k and f of two neighbours agree
    c, k = np.nonzero(np.asarray(mesh.neighbors) >= 0)
    word = np.asarray(mesh.neighbors)[c, k]
    n, f = packing.cell_of(word), packing.corner_of(word)
    assert np.array_equal(tau[c] * tau[n], np.where((k + f) % 2 == 0, -1, 1))
    assert not packing.turned_of(word).any()


def test_a_flat_cell_does_not_mend_a_one_sided_ring():
    pairs = np.array([[0, 0, 1, 1], [1, 0, 2, 1], [2, 0, 0, 2]])
    sign = conn.fill_signs(np.array([1, 0, 1], np.int8), np.array([1.0, 0.0, 1.0]), pairs)
    assert sign.tolist() == [1, 1, 1]
    turned, one_sided = conn.combinatorial(sign, pairs, np.array([1.0, 0.0, 1.0]))
    assert one_sided == 1 and not turned.any()


def test_folds_are_counted_without_flat_cells():
    points, sides = CUBE.copy(), [[0, 1, 2, 3], [4, 5, 6, 7], [0, 1, 4, 5]]
    points[0] = [0.9, 0.8, 0.9]  # through the cell in the middle
    folded = [build(points, {"tetra": FIVE + more}).report for more in ([], sides[1:2])]
    assert folded[0].folded == folded[1].folded == 1
    assert (folded[0].flat, folded[1].flat) == (0, 1)


def test_words_and_quality():
    shape = flat.lattice(4)
    mesh = build(shape.points, {"tetra": shape.cells})
    assert f"{mesh.report.flat} flat kept" in mesh.describe() and mesh.report.flat > 0
    assert "0 to 180 degrees" in mesh.describe()
    q = quality(mesh.points, mesh.cells)
    assert (q.min_dihedral, q.max_dihedral, q.min_volume) == (0, 180, 0)
    assert q.volume == pytest.approx(1, rel=1e-14) and 1 < q.edge_ratio < 2
    # four points on a line, of which no face has an area either
    line = np.concatenate([CUBE, [[0.5, 0, 0], [0.25, 0, 0]]])
    mesh = build(line, {"tetra": [*FIVE, [0, 8, 9, 1]]})
    assert mesh.report.flat == 1 and "1 flat kept" in mesh.describe()
    assert all(np.isfinite(x) for x in vars(quality(mesh.points, mesh.cells)).values())
    check_chords(mesh, CUBE, *rays())


@pytest.mark.parametrize("location", ["point", "cell", "corner"])
def test_to_pyvista_and_back(location):
    shape = flat.lattice(4)
    rng = np.random.default_rng(0)
    size = {"point": len(shape.points), "cell": len(shape.cells), "corner": (len(shape.cells), 4)}
    values = rng.uniform(size=size[location])
    mesh = build(shape.points, {"tetra": shape.cells}, values, location)
    grid = mesh.to_pyvista()
    with pytest.warns(UserWarning, match=f"^{mesh.report.flat} flat tetrahedra .* kept, of"):
        back = TetMesh.from_pyvista(grid)
    assert (back.report.flat, back.report.inverted, back.n_boundary) == (
        mesh.report.flat,
        0,
        mesh.n_boundary,
    )
    np.testing.assert_allclose(see(back, *rays()), see(mesh, *rays()), rtol=0, atol=1e-14)


def test_gradients_of_cells_without_volume(quick_jit):
    """By its own values a flat cell has none, and by points all are finite and those of the side
    where cells have volume, also where some are turned over."""
    shape = flat.lattice(4)
    rng = np.random.default_rng(4)
    values = rng.uniform(size=(len(shape.cells), 4))
    mesh = build(shape.points, {"tetra": shape.cells}, values, "corner")
    weights = rng.normal(size=(64, 4))

    @jax.jit
    def f(points, values):
        moved = mesh.replace(points=points, values=values, location="corner")
        return (see(moved, *rays()) * weights).sum()

    slopes = jax.jit(jax.grad(f, argnums=(0, 1)))
    by_points, by_values = slopes(mesh.points, mesh.values)
    q = np.asarray(mesh.points)[np.asarray(mesh.cells)]
    flats = np.abs(np.linalg.det(q[:, 1:] - q[:, :1])) < 1e-12
    assert flats.sum() == mesh.report.flat > 0
    assert np.isfinite(by_points).all() and np.abs(by_points).max() > 0.1
    np.testing.assert_allclose(np.asarray(by_values)[flats], 0, rtol=0, atol=1e-14)
    assert np.abs(np.asarray(by_values)[~flats]).max() > 1e-3
    # turned over: differences from both sides
    there = np.asarray(flat.moved(shape))
    u = rng.normal(size=there.shape) * shape.inner[:, None]
    by_points, by_values = slopes(there, mesh.values)
    found = float((np.asarray(by_points) * u).sum())
    for h in (1e-6, -1e-6):
        halves = [
            float(f(there + s * u, mesh.values) - f(there, mesh.values)) / s for s in (h, h / 2)
        ]
        assert found == pytest.approx(2 * halves[1] - halves[0], rel=1e-6)
    v = rng.normal(size=mesh.values.shape)
    up, down = (float(f(there, mesh.values + h * v)) for h in (1e-5, -1e-5))
    assert float((by_values * v).sum()) == pytest.approx((up - down) / 2e-5, rel=1e-6)
