"""`TetMesh.from_cells`, `replace`, `describe`: what comes in, where values go, what is repaired."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvr.volume import TetMesh, datasets
from jaxvr.volume.quality import quality

TET = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
PAIR = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], float)
PAIR_CELLS = np.array([[0, 1, 2, 3], [4, 2, 1, 3]])


def pair(values, **kwargs):
    return TetMesh.from_cells(PAIR, {"tetra": PAIR_CELLS}, values, **kwargs)


def corner_values(mesh):
    """What each cell holds at its corners, by coordinates: {cell's points: {point: value}}."""
    cells, values = np.asarray(mesh.cells), np.asarray(mesh.values)
    if mesh.location == "point":
        values = values[cells]
    elif mesh.location == "cell":
        values = np.repeat(values[:, None], 4, 1)
    points = np.asarray(mesh.points).tolist()
    return {
        frozenset(c.tolist()): {tuple(points[p]): float(x) for p, x in zip(c, v, strict=True)}
        for c, v in zip(cells, values, strict=True)
    }


def test_dtypes(dtype):
    mesh = TetMesh.from_cells(TET.astype(dtype), {"tetra": [[0, 1, 2, 3]]}, np.arange(4.0))
    assert mesh.dtype == np.dtype(dtype) == mesh.values.dtype
    assert mesh.cells.dtype == mesh.neighbors.dtype == mesh.boundary.dtype == jnp.int32
    assert mesh.duplicates.dtype == jnp.int32 and mesh.duplicates.shape == (0, 2)
    assert isinstance(mesh.points, jax.Array) and isinstance(mesh.values, jax.Array)
    other = "float64" if dtype == "float32" else "float32"
    forced = TetMesh.from_cells(
        TET.astype(dtype), {"tetra": [[0, 1, 2, 3]]}, np.arange(4), dtype=other
    )
    assert forced.dtype == np.dtype(other)


@pytest.fixture
def without_x64():
    jax.config.update("jax_enable_x64", False)  # jax 0.7 has no jax.enable_x64
    yield
    jax.config.update("jax_enable_x64", True)


def test_float64_needs_x64(without_x64):
    mesh = TetMesh.from_cells(TET, {"tetra": [[0, 1, 2, 3]]}, np.arange(4))
    assert mesh.dtype == np.float32
    with pytest.raises(ValueError, match="jax_enable_x64"):
        TetMesh.from_cells(TET, {"tetra": [[0, 1, 2, 3]]}, np.arange(4), dtype="float64")


def test_point_cell_and_corner_values_go_to_their_tets():
    points = corner_values(pair(np.arange(5.0)))
    assert points[frozenset({1, 2, 3, 4})][(1.0, 1.0, 1.0)] == 4.0
    cell = pair([7.0, 8.0])
    assert cell.location == "cell"
    assert set(corner_values(cell)[frozenset({0, 1, 2, 3})].values()) == {7.0}
    given = np.arange(8.0).reshape(2, 4)
    corner = pair(given)
    assert corner.location == "corner"
    expected = {
        frozenset(c.tolist()): {tuple(PAIR[p]): x for p, x in zip(c, v, strict=True)}
        for c, v in zip(PAIR_CELLS, given.tolist(), strict=True)
    }
    assert corner_values(corner) == expected


def test_cell_values_of_a_zoo_by_array_and_by_dict():
    sink = {
        "hexahedron": [[0, 1, 2, 3, 4, 5, 6, 7]],
        "wedge": [[1, 8, 2, 5, 9, 6]],
        "triangle": [[0, 1, 2]],
    }
    cube = np.array(
        [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]
        + [[2, 0, 0], [2, 0, 1]],
        float,
    )
    by_array = TetMesh.from_cells(cube, sink, [3.0, 5.0])
    by_dict = TetMesh.from_cells(cube, sink, {"wedge": [5.0], "hexahedron": np.array([[3.0]])})
    assert np.array_equal(by_array.values, [3.0] * 6 + [5.0] * 3)
    assert np.array_equal(by_array.values, by_dict.values)
    assert by_array.report.input_cells == (("hexahedron", 1), ("wedge", 1))
    assert by_array.report.ignored == (("triangle", 1),)
    assert by_array.n_boundary == 2 * 5 + 2 * 2 + 2
    with pytest.raises(ValueError, match="no entry for 'wedge'"):
        TetMesh.from_cells(cube, sink, {"hexahedron": [3.0]})
    with pytest.raises(ValueError, match="tetra10"):
        TetMesh.from_cells(cube, sink, {"hexahedron": [1], "wedge": [1], "tetra10": [1]})
    with pytest.raises(ValueError, match=r"shape \(2,\) for 1 cells"):
        TetMesh.from_cells(cube, sink, {"hexahedron": [1, 2], "wedge": [1]})


def test_ambiguous_values_ask_for_the_location():
    points = np.concatenate([TET, -TET[1:]])
    # 7 points; two cells do not match, so add cells until the counts do
    cells = np.array([[0, 1, 2, 3], [0, 4, 2, 3], [0, 1, 5, 3], [0, 1, 2, 6]])
    cells = np.concatenate([cells, [[0, 4, 5, 3], [0, 4, 2, 6], [0, 1, 5, 6]]])
    fix = np.linalg.det(points[cells[:, 1:]] - points[cells[:, :1]]) < 0
    cells[fix] = cells[fix][:, [0, 2, 1, 3]]
    with pytest.raises(ValueError, match="point, cell.*location="):
        TetMesh.from_cells(points, {"tetra": cells}, np.arange(7))
    for where in ("point", "cell"):
        mesh = TetMesh.from_cells(points, {"tetra": cells}, np.arange(7), location=where)
        assert mesh.location == where
        assert mesh.replace(values=np.ones(7)).location == where
    with pytest.raises(ValueError, match="corner data or a point field of four"):
        TetMesh.from_cells(points, {"tetra": cells}, np.ones((7, 4)))
    mesh = TetMesh.from_cells(points, {"tetra": cells}, np.ones((7, 4)), location="corner")
    assert mesh.values.shape == (7, 4)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.ones((5, 3)), "components"),
        (np.ones(4), r"must have shape \(5,\) for location='point', \(2,\) for"),
        ("density", "must hold numbers"),
        (["a"] * 5, "must hold numbers"),
        ([1, 2, np.nan, np.inf, 5], r"2 NaN or infinite entries, the first at index 2"),
        (np.ones(5) * 1j, "must hold numbers"),
        ([[1], [2, 3]], "cannot be read as an array"),
        (1.0, "must have shape"),
        (None, "must hold numbers"),
    ],
)
def test_bad_values(values, message):
    with pytest.raises(ValueError, match=message):
        pair(values)


def test_bad_location():
    with pytest.raises(ValueError, match="'vertex'"):
        pair(np.ones(5), location="vertex")
    with pytest.raises(ValueError, match=r"\(2,\) for location='cell', but has \(5,\)"):
        pair(np.ones(5), location="cell")
    cube = datasets.box((1, 1, 1), cell="hexahedron")
    with pytest.raises(ValueError, match="tetra cells only"):
        TetMesh.from_cells(
            cube.points, {"hexahedron": [[0, 1, 3, 2, 4, 5, 7, 6]]}, [1.0], location="corner"
        )


def test_inverted_and_degenerate_cells_are_repaired_with_one_warning():
    points = np.concatenate([PAIR, [[2, 2, 2]]])
    cells = {"tetra": [[0, 2, 1, 3], [4, 2, 1, 3], [0, 1, 2, 2], [1, 2, 3, 1], [0, 0, 4, 5]]}
    with pytest.warns(UserWarning) as caught:
        mesh = TetMesh.from_cells(points, cells, np.arange(5.0), location="cell")
    assert len(caught) == 1 and caught[0].filename == __file__
    assert "3 degenerate" in str(caught[0].message) and "1 inverted" in str(caught[0].message)
    assert (mesh.report.degenerate, mesh.report.inverted, mesh.n_tets) == (3, 1, 2)
    assert np.array_equal(mesh.values, [0.0, 1.0])


def test_flat_cells_stay_however_large_or_small(dtype):
    for scale in (1e-12, 1.0, 1e12):
        flat = (
            np.array([[0.1, 0.3, 0.7], [1.1, 0.3, 0.7], [0.1, 1.3, 0.7], [0.9, 0.8, 0.7]]) * scale
        )
        points = np.concatenate([flat, [[0.2 * scale, 0.2 * scale, 5.0 * scale]]])
        cells = {"tetra": [[0, 1, 2, 3], [0, 1, 2, 4]]}
        with pytest.warns(UserWarning, match="^1 flat tetrahedra .* kept, of 2"):
            mesh = TetMesh.from_cells(points, cells, np.ones(5), location="point", dtype=dtype)
        assert (mesh.n_tets, mesh.n_boundary) == (2, 6)
        assert (mesh.report.flat, mesh.report.degenerate, mesh.report.folded) == (1, 0, 0)


def test_collapsed_hexahedra_become_wedges():
    box = datasets.box((2, 1, 1), cell="hexahedron")
    points = np.asarray(box.points).copy()
    hexes = np.array([[0, 1, 4, 3, 6, 7, 10, 9], [1, 2, 5, 4, 7, 8, 11, 10]])
    points[[5, 11]] = points[[2, 8]]  # the far edges meet
    with pytest.warns(UserWarning, match="degenerate"):
        mesh = TetMesh.from_cells(points, {"hexahedron": hexes}, points[:, 0], location="point")
    assert mesh.n_tets == 6 + 3 and mesh.report.duplicate_points == 2
    assert quality(mesh.points, mesh.cells).volume == pytest.approx(0.75)
    assert mesh.n_boundary == 2 * 5 + 2 + 2 * 2 + 2 - 2


def test_both_node_orders_of_wedges_are_taken():
    grid = np.asarray(datasets.box((2, 2, 2)).points)
    first = np.array([[0, 4, 1, 9, 13, 10], [0, 3, 4, 9, 12, 13]])
    swapped = first[:, [0, 2, 1, 3, 5, 4]]
    one = TetMesh.from_cells(grid, {"wedge": first}, grid[:, 0], location="point")
    two = TetMesh.from_cells(grid, {"wedge": swapped}, grid[:, 0], location="point")
    assert one.report.inverted == two.report.inverted == 0
    assert sorted(np.asarray(one.cells).tolist()) == sorted(np.asarray(two.cells).tolist())


def test_quadratic_cells_are_reduced_and_counted():
    points = np.concatenate([TET, np.random.default_rng(0).random((6, 3))])
    mesh = TetMesh.from_cells(points, {"tetra10": [range(10)]}, np.arange(10.0))
    assert mesh.report.reduced == (("tetra10", 1),) and mesh.n_tets == 1
    assert "1 tetra10" in mesh.describe()


@pytest.mark.parametrize(
    ("points", "cells", "message"),
    [
        (TET[:, :2], {"tetra": [[0, 1, 2, 3]]}, r"points must have shape \(P, 3\)"),
        (np.zeros((0, 3)), {"tetra": np.zeros((0, 4), int)}, "empty"),
        ("mesh.vtu", {"tetra": [[0, 1, 2, 3]]}, "points must hold numbers"),
        (TET, {"tetra": [[0, 1, 2, 4]]}, r"1 indices out of range.*\(0, 3\): 4, where 0 to 3"),
        (TET, {"tetra": [[-1, 1, 2, 3]]}, r"out of range, the first at \(0, 0\): -1"),
        (TET, {"tetra": [[0.0, 1.0, 2.0, 3.0]]}, "must hold integers"),
        (TET, {"tetra": [["a", "b", "c", "d"]]}, "must hold integers"),
        (TET, {"tetra": [[True, False, True, True]]}, "must hold integers"),
        (TET, {"tetra": [[0, 1, 2], [0, 1, 2, 3]]}, "cannot be read as an array"),
        (TET, {"tetra": [[0, 1, 2]]}, r"must have shape \(N, 4\), but has \(1, 3\)"),
        (TET, {"tetra": [0, 1, 2, 3]}, r"must have shape \(N, 4\), but has \(4,\)"),
        (TET, {}, "no solid cells"),
        (TET, {"tetra": []}, "no solid cells"),
        (TET, {"triangle": [[0, 1, 2]]}, r"no solid cells \(found: 1 triangle\)"),
        (TET, {"polyhedron4": [[0, 1, 2, 3]]}, "polyhedron4"),
        (TET, {"tetra": [[0, 1, 2, 2]]}, "No cells left: all 1"),
        (TET, np.array([[0, 1, 2, 3]]), "must be a dict"),
        (TET * np.array([1, np.nan, 1]), {"tetra": [[0, 1, 2, 3]]}, r"4 NaN.*\(0, 1\)"),
    ],
)
def test_bad_meshes(points, cells, message):
    with pytest.raises(ValueError, match=message):
        TetMesh.from_cells(points, cells, np.ones(4), location="point")


def test_overflow_in_float32_is_found():
    with pytest.raises(ValueError, match="overflows float32"):
        TetMesh.from_cells(TET * 1e60, {"tetra": [[0, 1, 2, 3]]}, np.ones(4), dtype="float32")
    with pytest.raises(ValueError, match="dtype must be"):
        TetMesh.from_cells(TET, {"tetra": [[0, 1, 2, 3]]}, np.ones(4), dtype="int32")
    with pytest.raises(ValueError, match="dtype must be"):
        TetMesh.from_cells(TET, {"tetra": [[0, 1, 2, 3]]}, np.ones(4), dtype="nonsense")


def test_replace_keeps_integers_and_works_under_transformations(dtype):
    mesh = datasets.box((2, 2, 2), dtype=dtype)

    @jax.jit
    def total(points, values):
        new = mesh.replace(points=points, values=values)
        return (new.points[:, 0] * new.values).sum()

    g = jax.grad(total, (0, 1))(mesh.points, mesh.values)
    assert np.allclose(g[1], mesh.points[:, 0]) and np.allclose(g[0][:, 0], mesh.values)
    new = mesh.replace(values=np.zeros(mesh.n_points))
    assert new.cells is mesh.cells and new.dtype == mesh.dtype and new.report == mesh.report
    assert jax.tree.structure(new) == jax.tree.structure(mesh)
    assert mesh.replace(values=jnp.zeros(mesh.n_tets)).location == "cell"
    assert mesh.replace(values=jnp.zeros((mesh.n_tets, 4))).location == "corner"


def test_replace_checks_shapes_always_and_numbers_when_it_can():
    mesh = datasets.box((2, 2, 2))
    with pytest.raises(ValueError, match=r"points must have shape \(27, 3\)"):
        mesh.replace(points=np.zeros((26, 3)))
    with pytest.raises(ValueError, match="for location='cell'"):
        mesh.replace(values=np.zeros(5))
    with pytest.raises(ValueError, match="3 components"):
        mesh.replace(values=np.zeros((27, 3)))
    with pytest.raises(ValueError, match="must have shape"):
        jax.jit(lambda v: mesh.replace(values=v).values)(np.zeros(5))
    with pytest.raises(ValueError, match="first at index 3"):
        mesh.replace(values=np.where(np.arange(27) == 3, np.nan, 0.0))
    with pytest.raises(ValueError, match="pass values too"):
        mesh.replace(location="cell")
    with pytest.raises(ValueError, match="must hold numbers"):
        mesh.replace(values="zeros")
    small = datasets.box((1, 1, 1), dtype="float32")
    with pytest.raises(ValueError, match="8 NaN or infinite"):
        small.replace(values=np.full(8, 1e60))
    assert jnp.isnan(jax.jit(lambda v: mesh.replace(values=v).values)(np.full(27, np.nan))).all()
    with pytest.raises(ValueError, match="traced"):
        jax.jit(lambda p: TetMesh.from_cells(p, {"tetra": mesh.cells}, mesh.values).points)(
            mesh.points
        )


def test_mesh_is_a_pytree_and_does_not_recompile():
    mesh = datasets.box((2, 2, 2))
    leaves, structure = jax.tree.flatten(mesh)
    assert len(leaves) == 6 and hash(structure) is not None
    count = 0

    @jax.jit
    def f(m):
        nonlocal count
        count += 1
        return m.values.sum()

    f(mesh)
    f(mesh.replace(values=mesh.values + 1))
    assert count == 1
    assert "TetMesh(" in repr(jax.tree.map(lambda x: None, mesh))
    with pytest.raises(dataclasses.FrozenInstanceError):
        mesh.values = leaves[1]  # type: ignore[misc]


def test_bounds_leave_out_points_without_cells(dtype):
    points = np.concatenate([TET, [[9, 9, 9]]]).astype(dtype)
    lo, hi = TetMesh.from_cells(points, {"tetra": [[0, 1, 2, 3]]}, np.ones(5)).bounds()
    assert lo.tolist() == [0, 0, 0] and hi.tolist() == [1, 1, 1]
    assert isinstance(lo, jax.Array) and lo.dtype == np.dtype(dtype)


def test_quality_of_known_shapes():
    q = quality(TET, np.array([[0, 1, 2, 3]]))
    assert q.max_dihedral == pytest.approx(90) and q.volume == pytest.approx(1 / 6)
    assert q.min_dihedral == pytest.approx(np.degrees(np.arctan(np.sqrt(2))))
    assert q.edge_ratio == pytest.approx(np.sqrt(2))
    regular = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], float)
    q = quality(regular, np.array([[0, 1, 2, 3], [0, 2, 1, 3]]))
    assert q.min_dihedral == pytest.approx(np.degrees(np.arccos(1 / 3))) == q.max_dihedral
    assert q.edge_ratio == pytest.approx(1) and q.min_volume == q.max_volume


def test_describe_is_a_page():
    text = datasets.heat_sink().describe()
    for part in ("hexahedron", "wedge", "pyramid", "tetra", "repaired", "one piece", "boundary"):
        assert part in text
    for part in (
        "box",
        "dihedral",
        "edge ratio",
        "volumes",
        "temperature, point data",
        "bytes per",
    ):
        assert part in text
    assert len(text.splitlines()) < 20 and max(map(len, text.splitlines())) <= 100
