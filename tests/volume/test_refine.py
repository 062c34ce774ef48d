"""`refine` and `delaunay_deviation`: the same volume and field, closed, in better cells."""

import warnings
from typing import Any

import jax
import numpy as np
import pytest
from scipy.spatial import Delaunay

import jaxvr
from jaxvr.volume import TetMesh, datasets, delaunay_deviation, packing, quality, refine

EDGES = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))


def delaunay(n=120, squeeze=1.0, dtype="float64", seed=0):
    """The Delaunay mesh of random points without slivers of its hull, then squeezed along z."""
    points = np.random.default_rng(seed).random((n, 3)).astype(dtype).astype(float)
    cells = Delaunay(points).simplices
    det = np.linalg.det(points[cells[:, 1:]] - points[cells[:, :1]])
    cells[det < 0] = cells[det < 0][:, [0, 1, 3, 2]]
    points[:, 2] *= squeeze
    return TetMesh.from_cells(points, {"tetra": cells[abs(det) > 1e-4]}, points[:, 0], dtype=dtype)


def seam(dtype="float64"):
    """A jittered box whose halves have points of their own, with a field that jumps there."""
    box = datasets.box((4, 2, 2), 0.29, seed=3, shuffle=True, dtype=dtype)
    points, cells = np.asarray(box.points), np.asarray(box.cells)
    right = points[cells].mean(1)[:, 0] > 0.5
    cells = cells + right[:, None] * len(points)
    values = np.r_[points[:, 1], 2.0 + points[:, 1] * points[:, 2]]
    det = np.linalg.det(points[cells[:, 1:] % len(points)] - points[cells[:, :1] % len(points)])
    cells[det < 0] = cells[det < 0][:, [0, 1, 3, 2]]
    return TetMesh.from_cells(np.r_[points, points], {"tetra": cells}, values, dtype=dtype)


def box(location, dtype="float64"):
    values = None
    if location != "point":
        values = np.random.default_rng(5).random((162,) if location == "cell" else (162, 4))
    return datasets.box(
        (3, 3, 3), 0.29, seed=4, shuffle=False, field=values, location=location, dtype=dtype
    )


def corners(mesh):
    """Coordinates (T, 4, 3) and values (T, 4)."""
    cells, values = np.asarray(mesh.cells), np.asarray(mesh.values, float)
    if mesh.location == "point":
        values = values[cells]
    elif mesh.location == "cell":
        values = np.repeat(values[:, None], 4, 1)
    return np.asarray(mesh.points, float)[cells], values


def locate(mesh, x):
    """The cell (N,) in which places x (N, 3) lie deepest, and their barycentric coordinates."""
    q, _ = corners(mesh)
    inverse = np.linalg.inv(np.moveaxis(q[:, 1:] - q[:, :1], 1, 2))
    b = np.einsum("tij,ntj->nti", inverse, x[:, None] - q[None, :, 0])
    b = np.concatenate([1 - b.sum(2, keepdims=True), b], 2)
    cell = b.min(2).argmax(1)
    n = np.arange(len(x))
    assert (b[n, cell].min(1) > -1e-6).all()
    return cell, b[n, cell]


def field(mesh, x):
    cell, weights = locate(mesh, x)
    return (weights * corners(mesh)[1][cell]).sum(1)


def length_at(mesh, x):
    """The longest edge (N,) of the cells round places x (N, 3)."""
    return edge_lengths(corners(mesh)[0]).max(1)[locate(mesh, x)[0]]


def places(mesh, n, seed=6):
    """Points in cells of the mesh, (n, 3)."""
    rng = np.random.default_rng(seed)
    q = corners(mesh)[0][rng.integers(mesh.n_tets, size=n)]
    return (rng.dirichlet(np.ones(4), n)[:, :, None] * q).sum(1)


def boundary_area(mesh):
    words = np.asarray(mesh.boundary)
    cells, k = np.asarray(mesh.cells)[packing.cell_of(words)], packing.corner_of(words)
    faces = np.stack([np.delete(c, i) for c, i in zip(cells, k, strict=True)])
    a, b, c = np.moveaxis(np.asarray(mesh.points, float)[faces], 1, 0)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2


def edge_lengths(q):
    return np.stack([np.linalg.norm(q[:, j] - q[:, i], axis=1) for i, j in EDGES], 1)


MESHES = {
    "point": lambda dtype: box("point", dtype),
    "cell": lambda dtype: box("cell", dtype),
    "corner": lambda dtype: box("corner", dtype),
    "seam": seam,
    "squeezed": lambda dtype: delaunay(60, 0.1, dtype),
}


@pytest.mark.parametrize("name", MESHES)
def test_the_same_volume_and_field_and_closed(name, dtype):
    mesh = MESHES[name](dtype)
    finer = refine(mesh, share=0.1, rounds=3)
    tol = 1e-5 if dtype == "float32" else 1e-12
    assert mesh.n_tets < finer.n_tets < 3 * mesh.n_tets
    assert finer.dtype == mesh.dtype == finer.values.dtype and finer.location == mesh.location
    assert np.array_equal(finer.points[: mesh.n_points], mesh.points)
    was, now = (quality(m.points, m.cells) for m in (mesh, finer))
    assert now.volume == pytest.approx(was.volume, rel=tol)
    # a face without a partner inside would add to the area
    assert boundary_area(finer) == pytest.approx(boundary_area(mesh), rel=tol)
    assert finer.report.folded == 0 and finer.report.one_sided == 0
    x = places(mesh, 200)
    assert np.allclose(field(finer, x), field(mesh, x), rtol=0, atol=30 * tol)


def test_both_sides_of_a_seam_get_midpoints_of_their_own():
    mesh = seam()
    finer = refine(mesh, share=0.2, rounds=3)
    assert finer.report.seams > mesh.report.seams > 0
    assert len(finer.duplicates) > len(mesh.duplicates)
    q, values = corners(finer)
    right = q.mean(1)[:, 0] > 0.5
    assert values[~right].max() <= 1.0 and values[right].min() >= 2.0


def test_the_image_is_the_same():
    transfer = jaxvr.TransferFunction(
        np.array([0.0, 0.5, 1.0]), np.eye(3), np.array([0.5, 3.0, 1.0])
    )
    mesh = box("corner")
    finer = refine(mesh, share=0.1, rounds=2)
    camera = jaxvr.Camera.orbit(mesh, azimuth=31.0, elevation=17.0, width=9, height=8)
    was, now = (np.asarray(jaxvr.render(m, camera, transfer)) for m in (mesh, finer))
    assert was.dtype == np.float64 and was[..., 3].max() > 0.3
    assert abs(now - was).max() < 1e-12


def test_deviation_is_zero_for_a_delaunay_mesh(dtype):
    mesh = delaunay(300, dtype=dtype)
    assert mesh.n_tets > 1000
    found = delaunay_deviation(mesh)
    assert found.dtype == np.float64 and found.shape == (mesh.n_tets,) and not found.any()
    assert refine(mesh) is mesh
    # corners of a block lie on one sphere, to rounding
    grid = datasets.box((3, 4, 5), shuffle=True, dtype=dtype)
    assert refine(grid) is grid


def test_deviation_by_its_definition():
    mesh = box("point")
    q, _ = corners(mesh)
    centre = np.linalg.solve(
        2 * (q[:, 1:] - q[:, :1]), ((q[:, 1:] ** 2).sum(2) - (q[:, :1] ** 2).sum(2))[..., None]
    )[..., 0]
    r = np.linalg.norm(q[:, 0] - centre, axis=1)
    words = np.asarray(mesh.neighbors)
    apex = q[packing.cell_of(words), packing.corner_of(words)]
    depth = 1 - np.linalg.norm(apex - centre[:, None], axis=2) / r[:, None]
    want = np.where(words >= 0, depth, 0).max(1).clip(0)
    assert np.allclose(delaunay_deviation(mesh), want, atol=1e-4) and want.max() > 0.1
    deep = want > 2e-4
    assert np.allclose(delaunay_deviation(mesh)[deep], want[deep], rtol=1e-9, atol=0)


def pair(apex=-0.75, scale=1.0, dtype="float64", middle=None):
    """A low cell over a triangle, whose sphere (centre (0, 0, -0.75), radius 1.25) reaches below
    it, and the cell below, with its apex on the axis."""
    t = np.radians([0, 120, 240])
    points = np.stack([np.cos(t), np.sin(t), 0 * t], 1)
    points = np.r_[points, [[0, 0, 0.5]], [[0, 0, apex]]]
    if middle is not None:
        points = np.r_[points, [middle(points)]]
    points = points * scale
    cells = {"tetra": [[0, 1, 2, 3], [0, 2, 1, 4]]}
    return TetMesh.from_cells(points, cells, np.arange(len(points)), location="point", dtype=dtype)


@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e30])
def test_deviation_of_a_violation(scale, dtype):
    tol = 1e-5 if dtype == "float32" else 1e-12
    found = delaunay_deviation(pair(-0.75, scale, dtype))
    assert found[0] == pytest.approx(1.0, abs=tol)  # the apex is the centre
    found = delaunay_deviation(pair(-1.75, scale, dtype))
    assert found[0] == pytest.approx(0.2, abs=tol)
    assert found.shape == (2,)
    assert not delaunay_deviation(pair(-2.1, scale, dtype)).any()


def test_a_flat_cell_deviates_by_nothing():
    mesh = pair()
    flat = np.asarray(mesh.points).copy()
    flat[3, 2] = 1e-300
    for height in (1e-300, 0.0):
        flat[3, 2] = height
        assert np.isfinite(delaunay_deviation(mesh.replace(points=flat))).all()


def test_the_longest_of_the_cells_that_deviate_are_bisected():
    mesh = delaunay(80, 0.2)
    deviation, q = delaunay_deviation(mesh), corners(mesh)[0]
    length = edge_lengths(q)
    for least in (0.0, 0.05, 0.3):
        finer = refine(mesh, share=1e-9, rounds=1, deviation=least)
        assert finer.n_points == mesh.n_points + 1
        middle = np.asarray(finer.points)[-1]
        mean = np.stack([(q[:, i] + q[:, j]) / 2 for i, j in EDGES], 1)
        cell, edge = np.nonzero((abs(mean - middle) < 1e-14).all(2))
        assert finer.n_tets == mesh.n_tets + len(cell)
        # the longest edge of all its cells, and at least as long as that of the one chosen
        assert (edge == length[cell].argmax(1)).all()
        chosen = length.max(1)[deviation >= least].max()
        assert length[cell[0], edge[0]] >= chosen


def test_long_cells_get_shorter_and_deviate_less():
    mesh = delaunay(80, 0.2)
    q, deviation = corners(mesh)[0], delaunay_deviation(mesh)
    length = edge_lengths(q).max(1)
    long = np.argsort(np.where(deviation >= 0.05, -length, 0.0))[:20]
    finer = refine(mesh, share=0.1, rounds=6)
    there = length_at(finer, q[long].mean(1))
    assert (there < 0.99 * length[long]).mean() > 0.9
    assert there.mean() < 0.8 * length[long].mean()
    assert edge_lengths(corners(finer)[0]).max() < 0.9 * length.max()
    two = pair()
    assert delaunay_deviation(two).max() == pytest.approx(1.0)
    assert delaunay_deviation(refine(two, 1.0, 4)).max() < 0.9


def test_turned_cells_stay_turned_without_a_word():
    mesh = datasets.box((3, 3, 3), 0.1)
    points, cells = np.asarray(mesh.points).copy(), np.asarray(mesh.cells)
    inner = np.flatnonzero(((points > 0.01) & (points < 0.99)).all(1))[0]
    points[inner] = 0.9
    det = np.linalg.det(np.asarray(mesh.points)[cells[:, 1:]] - mesh.points[cells[:, :1]])
    rows = np.where((det < 0)[:, None], cells[:, [0, 1, 3, 2]], cells)
    with pytest.warns(UserWarning, match="inverted"):
        folded = TetMesh.from_cells(points, {"tetra": rows}, points[:, 0])
    assert folded.report.folded > 0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        finer = refine(folded, share=1.0, rounds=5, deviation=0.0)
    assert finer.report.folded > folded.report.folded
    assert finer.report.inverted == folded.report.inverted
    q, _ = corners(folded)
    signed = abs(np.linalg.det(q[:, 1:] - q[:, :1])).sum() / 6
    assert quality(finer.points, finer.cells).volume == pytest.approx(signed)


def test_edges_that_cannot_be_bisected_stay_whole():
    # a cube of one unit in the last place, where midpoints fall on corners
    cube = datasets.box((1, 1, 1), dtype="float32")
    assert refine(cube, 1.0, 1, deviation=0.0).n_tets == 12
    with pytest.warns(UserWarning, match="6 of 6 tetrahedra are so small beside the steps"):
        tiny = cube.replace(points=np.asarray(cube.points) + np.float32(2.0**23), origin=0)
    assert refine(tiny, 1.0, 2, deviation=0.0) is tiny
    # another point is there already
    for ends in ((0, 1), (1, 2), (0, 2)):
        two = pair(middle=lambda p, ends=ends: 0.5 * p[ends[0]] + 0.5 * p[ends[1]])
        finer = refine(two, 1.0, 1)
        assert len(finer.duplicates) == 0
        new = np.asarray(finer.points)[two.n_points :]
        assert not (new == np.asarray(two.points)[-1]).all(1).any()


def test_fields_on_one_mesh_are_refined_alike():
    mesh = seam()
    one = refine(mesh, 0.1, 2)
    two = refine(mesh.replace(values=np.arange(mesh.n_tets) * 1.0), 0.1, 2)
    assert np.array_equal(one.cells, two.cells) and np.array_equal(one.points, two.points)
    assert two.location == "cell"


def test_the_report_tells_of_the_mesh_as_it_was_built():
    mesh = datasets.box((3, 3, 3), 0.29, cell="hexahedron", shuffle=True)
    finer = refine(mesh, 0.1)
    assert finer.report.input_cells == (("hexahedron", 27),)
    assert finer.report.tets == finer.n_tets > mesh.n_tets
    text = finer.describe()
    assert "27 hexahedron" in text and f"{finer.n_tets} tetrahedra" in text


def test_errors_say_what_was_found():
    mesh = pair()
    bads: tuple[tuple[dict[str, Any], str], ...] = (
        ({"share": 0.0}, r"share must be in \(0, 1\], but is 0.0"),
        ({"share": 1.5}, "1.5"),
        ({"share": float("nan")}, "nan"),
        ({"share": "all"}, "'all'"),
        ({"share": True}, "True"),
        ({"rounds": 0}, "rounds must be an integer of at least 1, but is 0"),
        ({"rounds": 2.0}, "2.0"),
        ({"deviation": -0.1}, "deviation must be in"),
        ({"deviation": 2}, "size alone"),
    )
    for bad, match in bads:
        with pytest.raises(ValueError, match=match):
            refine(mesh, **bad)
    for verb in (refine, delaunay_deviation):
        with pytest.raises(ValueError, match="must be a TetMesh, but is ndarray"):
            verb(np.zeros(3))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="outside jit"):
        jax.jit(lambda m: refine(m).points)(mesh)
