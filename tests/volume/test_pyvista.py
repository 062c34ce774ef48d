"""Grids of PyVista and VTK to meshes and back."""

import importlib
import warnings
from typing import Any

import numpy as np
import pytest
import vtk

from jaxvr.volume import TetMesh, datasets, read_mesh, write_mesh

with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)  # in what PyVista imports
    pyvista: Any = importlib.import_module("pyvista")  # its types are unions of unions

RNG = np.random.default_rng(0)


def box_grid(**arrays):
    """Image data of 2 x 3 x 2 voxels with point fields."""
    grid = pyvista.ImageData(dimensions=(3, 4, 3), spacing=(0.5, 0.25, 1.0), origin=(1, 2, 3))
    for name, a in arrays.items():
        grid.point_data[name] = a
    return grid


def zoo_grid():
    """A hexahedron, a wedge, a pyramid, a tetrahedron and a triangle, with all sorts of fields."""
    points = np.array(
        [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1],
         [2, 0, 0], [2, 0, 1], [0.5, 0.5, 2], [1, 1, 2.5]], float,
    )  # fmt: skip
    kinds = [12, 5, 13, 14, 10]
    cells = [[8, *range(8)], [3, 0, 1, 2], [6, 1, 2, 8, 5, 6, 9], [5, 4, 5, 6, 7, 10], [4, 5, 6, 10, 11]]  # noqa: E501  # fmt: skip
    grid = pyvista.UnstructuredGrid(np.concatenate(cells), kinds, points)
    grid.point_data["v"] = RNG.normal(size=(12, 3))
    grid.point_data["t"] = np.arange(12.0)
    grid.point_data["a.b"] = np.arange(12.0) + 1
    grid.point_data["words"] = ["x"] * 12
    grid.cell_data["c"] = np.arange(5.0)
    grid.cell_data["t"] = np.arange(5) + 10
    return grid


def test_fields_as_in_files(tmp_path):
    grid = zoo_grid()
    del grid.point_data["words"]  # meshio reads no file with strings
    grid.save(tmp_path / "zoo.vtu")
    for field, location in (
        ("t", "point"), ("t", "cell"), ("c", None), ("v.x", None), ("v.magnitude", None),
        ("a.b", None),
    ):  # fmt: skip
        mesh = TetMesh.from_pyvista(grid, field, location=location)
        same = read_mesh(tmp_path / "zoo.vtu", field, location=location)
        assert mesh.report == same.report and mesh.location == same.location
        np.testing.assert_array_equal(mesh.points, same.points)
        np.testing.assert_array_equal(mesh.values, same.values)
        # meshio has another order for wedges, so their tetrahedra come in another one
        cells, others = (np.unique(m.cells, axis=0) for m in (mesh, same))
        np.testing.assert_array_equal(cells, others)
    assert mesh.report.ignored == (("triangle", 1),)
    assert dict(mesh.report.input_cells) == {"hexahedron": 1, "wedge": 1, "pyramid": 1, "tetra": 1}


def test_active_scalars_are_the_default():
    grid = zoo_grid()
    for name, where in (("a.b", "point"), ("c", "cell"), ("t", "point")):
        grid.set_active_scalars(name, preference=where)
        mesh = TetMesh.from_pyvista(grid)
        assert (mesh.report.field, mesh.location) == (name, where)
    grid.set_active_scalars("t", preference="point")
    assert TetMesh.from_pyvista(grid, location="cell").location == "cell"
    grid.set_active_scalars("v")  # no scalar: the first one is taken
    assert TetMesh.from_pyvista(grid).report.field == "t"


def test_errors_say_what_there_is():
    grid = zoo_grid()
    with pytest.raises(ValueError, match="no field 'nothing'.*'v' \\(point, 3 components\\).*'c'"):
        TetMesh.from_pyvista(grid, "nothing")
    with pytest.raises(ValueError, match='v.magnitude"'):
        TetMesh.from_pyvista(grid, "v")
    with pytest.raises(ValueError, match="location must be"):
        TetMesh.from_pyvista(grid, location="corner")
    for bad in (None, "file.vtu", pyvista.MultiBlock([grid]), vtk.vtkXMLUnstructuredGridReader()):
        with pytest.raises(ValueError, match="grid of VTK or PyVista is needed"):
            TetMesh.from_pyvista(bad)
    sphere = pyvista.Sphere(theta_resolution=4, phi_resolution=4)
    with pytest.raises(ValueError, match="no solid cells \\(found: .* triangle"):
        TetMesh.from_pyvista(sphere.elevation())
    with pytest.raises(ValueError, match="no scalar field"):
        TetMesh.from_pyvista(pyvista.UnstructuredGrid())
    cube = [30, 6, 4, 0, 1, 2, 3, 4, 4, 5, 6, 7, 4, 0, 1, 5, 4, 4, 1, 2, 6, 5, 4, 2, 3, 7, 6, 4, 3, 0, 4, 7]  # noqa: E501  # fmt: skip
    points = zoo_grid().points[:8]
    poly = pyvista.UnstructuredGrid([len(cube) - 1, *cube[1:]], [42], points)
    poly.point_data["t"] = np.arange(8.0)
    mesh = TetMesh.from_pyvista(poly)
    assert mesh.n_tets == 12 and mesh.report.input_cells == (("polyhedron parts", 12),)
    poly.points[6] = 0.3, 0.3, 0.3
    with pytest.raises(ValueError, match="1 of 1 polyhedra are not convex.*cells 0"):
        TetMesh.from_pyvista(poly)


@pytest.mark.parametrize("kind", ["image", "rectilinear", "structured", "plain vtk"])
def test_regular_grids(kind):
    x = RNG.normal(size=36)
    grid = box_grid(x=x)
    grid.cell_data["c"] = np.arange(12.0)
    points = np.array(grid.points)
    if kind == "rectilinear":
        grid = grid.cast_to_rectilinear_grid()
    elif kind == "structured":
        grid = grid.cast_to_structured_grid()
    elif kind == "plain vtk":
        plain = vtk.vtkImageData()
        plain.ShallowCopy(grid)
        grid = plain
    mesh = TetMesh.from_pyvista(grid, "x")
    np.testing.assert_array_equal(mesh.points, points)
    np.testing.assert_array_equal(mesh.values, x)
    cells = "hexahedron" if kind == "structured" else "voxel"
    assert mesh.report.input_cells == ((cells, 12),) and mesh.n_tets == 72
    assert mesh.report.inverted == 0 and mesh.n_boundary == 2 * 2 * (6 + 4 + 6)
    by_cell = TetMesh.from_pyvista(grid, "c")
    np.testing.assert_array_equal(by_cell.values, np.repeat(np.arange(12.0), 6))
    middle = np.asarray(mesh.points)[np.asarray(mesh.cells)].mean(1)
    inside = ((middle - points.min(0)) / (0.5, 0.25, 1.0)).astype(int)
    np.testing.assert_array_equal(inside @ (1, 2, 6), by_cell.values)


def test_cells_that_vtk_hides_are_left_out():
    grid = box_grid(x=np.arange(36.0)).cast_to_structured_grid()
    grid.hide_cells([0, 5], inplace=True)
    mesh = TetMesh.from_pyvista(grid)
    assert mesh.report.field == "x" and mesh.report.input_cells == (("hexahedron", 10),)
    grid = box_grid(x=np.arange(36.0)).cast_to_unstructured_grid()
    grid.cell_data["c"] = np.arange(12.0)
    ghosts = np.zeros(12, np.uint8)
    ghosts[[1, 2, 3]] = 1, 32, 16
    grid.cell_data["vtkGhostType"] = ghosts
    mesh = TetMesh.from_pyvista(grid, "c")
    assert sorted(set(np.asarray(mesh.values))) == [0, *range(3, 12)]


def test_quadratic_and_lagrange_cells_are_cut_to_corners():
    source = vtk.vtkCellTypeSource()
    for kind, name in ((24, "tetra10"), (29, "hexahedron27"), (72, "lagrange hexahedron")):
        source.SetCellType(kind)
        source.SetBlocksDimensions(1, 1, 1)
        source.Update()
        grid = source.GetOutput()
        mesh = TetMesh.from_pyvista(grid, "DistanceToCenter")
        n = grid.GetNumberOfCells()
        assert mesh.report.input_cells == ((name, n),) and mesh.report.reduced == ((name, n),)
        p = np.asarray(mesh.points)[np.asarray(mesh.cells)]
        volume = np.abs(np.linalg.det(p[:, 1:] - p[:, :1])).sum() / 6
        assert volume == pytest.approx(1)


def test_unnamed_and_native_arrays():
    grid = vtk.vtkUnstructuredGrid()
    grid.DeepCopy(zoo_grid())
    for data in (grid.GetPointData(), grid.GetCellData()):
        while data.GetNumberOfArrays():
            data.RemoveArray(0)
    ids = vtk.vtkIdTypeArray()
    for i in range(12):
        ids.InsertNextValue(i)
    grid.GetPointData().AddArray(ids)
    mesh = TetMesh.from_pyvista(grid)
    assert mesh.report.field == "Unnamed_0" and np.array_equal(mesh.values, np.arange(12))


@pytest.mark.parametrize("location", ["point", "cell"])
def test_round_trip_is_exact(location, dtype):
    mesh = datasets.box((3, 2, 2), jitter=0.2, cell="wedge", shuffle=True, dtype=dtype)
    if location == "cell":
        mesh = mesh.replace(values=RNG.normal(size=mesh.n_tets), location="cell")
    grid = mesh.to_pyvista()
    assert isinstance(grid, pyvista.UnstructuredGrid) and grid.points.dtype == dtype
    assert grid.n_cells == mesh.n_tets and grid.active_scalars_name == "values"
    assert grid.compute_cell_sizes()["Volume"].min() > 0
    again = TetMesh.from_pyvista(grid)
    assert again.location == location and again.report.inverted == 0 and again.dtype == dtype
    for name in ("points", "values", "cells", "neighbors", "boundary", "duplicates"):
        np.testing.assert_array_equal(getattr(again, name), getattr(mesh, name), name)


def test_corner_data_gets_points_of_its_own(tmp_path):
    mesh = datasets.box((2, 2, 1), shuffle=True)
    mesh = mesh.replace(values=RNG.normal(size=(mesh.n_tets, 4)))
    grid = mesh.to_pyvista()
    assert grid.n_points == 4 * mesh.n_tets
    again = TetMesh.from_pyvista(grid)
    assert again.location == "point" and again.n_boundary == mesh.n_boundary

    def corners(m, values):
        """Position and value of each cell's corners (T, 4, 4), in an order of their own."""
        rows = np.concatenate([np.asarray(m.points)[m.cells], np.asarray(values)[..., None]], 2)
        return np.stack([r[np.lexsort(r.T)] for r in rows])

    here = corners(mesh, mesh.values)
    np.testing.assert_array_equal(corners(again, np.asarray(again.values)[again.cells]), here)
    write_mesh(tmp_path / "corners.vtu", mesh)  # the same as through a file
    file = read_mesh(tmp_path / "corners.vtu")
    np.testing.assert_array_equal(file.values, again.values)
    np.testing.assert_array_equal(file.cells, again.cells)


def test_field_keeps_its_name():
    grid = zoo_grid()
    for field in ("v.magnitude", "c"):
        mesh = TetMesh.from_pyvista(grid, field)
        assert mesh.to_pyvista().active_scalars_name == field
        assert TetMesh.from_pyvista(mesh.to_pyvista()).report.field == field


def test_nothing_is_shared_with_the_grid():
    grid = zoo_grid().extract_cells([0])
    mesh = TetMesh.from_pyvista(grid, "t", location="point")
    points, values = np.array(mesh.points), np.array(mesh.values)
    grid.points[:] = 7
    grid.point_data["t"][:] = 7
    np.testing.assert_array_equal(mesh.points, points)
    np.testing.assert_array_equal(mesh.values, values)
    back = mesh.to_pyvista()
    back.points[:] = 7
    back.point_data["t"][:] = 7
    np.testing.assert_array_equal(mesh.points, points)
    np.testing.assert_array_equal(mesh.values, values)
