"""`grid.jaxvr` and `plotter.jaxvr`: the same as by hand, and nothing left out without a word."""

from __future__ import annotations

import importlib
import warnings
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import jaxvr

with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)  # in what PyVista imports
    pyvista: Any = importlib.import_module("pyvista")  # its types are unions of unions
    accessors: Any = importlib.import_module("jaxvr.accessors")

pytestmark = pytest.mark.usefixtures("quick_code")
RAMP = [0.0, 0.3, 0.8]


def lattice(points: int = 4) -> Any:
    grid = pyvista.ImageData(dimensions=(points,) * 3, spacing=(0.5, 0.25, 1.0))
    x, y, z = np.asarray(grid.points).T
    grid.point_data["t"] = 300 + x - 2 * y * z
    grid.point_data["u"] = z
    grid.cell_data["c"] = np.arange(grid.n_cells) / grid.n_cells
    grid.set_active_scalars("t")
    return grid


def plotter_of(*things: Any, **options: Any) -> tuple[Any, list[Any]]:
    plotter = pyvista.Plotter(off_screen=True, window_size=[16, 12])
    options = {"opacity": RAMP, "show_scalar_bar": False, **options}
    return plotter, [plotter.add_volume(thing, **options) for thing in things]


@pytest.mark.parametrize("kind", ["image", "unstructured"])
def test_a_grid_is_drawn_as_by_hand(kind):
    grid = lattice() if kind == "image" else lattice().cast_to_unstructured_grid()
    mesh = jaxvr.TetMesh.from_pyvista(grid, "u")
    camera = jaxvr.Camera.orbit(mesh, up=(0, 0, 1), width=16, height=12)
    transfer = jaxvr.default_transfer(mesh, "turbo")
    want = jaxvr.render(mesh, camera, transfer, background=(1, 1, 1))
    image = grid.jaxvr.render("u", "turbo", camera, background=(1, 1, 1))
    np.testing.assert_array_equal(image, want)
    np.testing.assert_array_equal(
        grid.jaxvr.mesh("c").values, jaxvr.TetMesh.from_pyvista(grid, "c").values
    )
    assert grid.jaxvr.mesh().report.field == "t"
    found = grid.jaxvr.probe(camera, transfer, (6, 8), field="u")
    np.testing.assert_array_equal(found.rgba, jaxvr.probe(mesh, camera, transfer, (6, 8)).rgba)
    assert grid.jaxvr.explore("u", camera=camera).camera.width == 16


def test_what_is_changed_in_a_grid_is_seen():
    grid = lattice()
    before = grid.jaxvr.mesh("t").values
    np.asarray(grid.point_data["t"])[:] += 1  # which PyVista is not told of
    np.testing.assert_array_equal(grid.jaxvr.mesh("t").values, before + 1)


@pytest.mark.parametrize("kind", ["image", "unstructured"])
def test_a_plotter_is_drawn_with_its_own_camera_colours_and_opacities(kind):
    grid = lattice() if kind == "image" else lattice().cast_to_unstructured_grid()
    plotter, (volume,) = plotter_of(grid, scalars="t", cmap="turbo", opacity_unit_distance=0.7)
    plotter.camera.position, plotter.camera.focal_point = (4.0, 3.0, 2.0), (0.6, 0.4, 1.5)
    plotter.camera.view_angle, plotter.camera.up = 40.0, (0, 0, 1)
    mesh, camera, transfer = plotter.jaxvr.scene()
    assert mesh.report.field == "t" and mesh.location == ("cell" if kind == "image" else "point")
    assert (camera.width, camera.height, float(camera.fov)) == (16, 12, 40)
    np.testing.assert_allclose(camera.eye, (4, 3, 2))
    low, high = 300 - 4.5, 301.5
    np.testing.assert_allclose(transfer.positions[np.array([0, -1])], (low, high), rtol=1e-6)
    look = volume.GetProperty()
    for at in np.linspace(low, high, 7).tolist():
        rgb, extinction = transfer(np.asarray(at))
        o = look.GetScalarOpacity().GetValue(at)
        want = -np.log1p(-o) / 0.7 if kind == "image" else o / 0.7
        np.testing.assert_allclose(rgb, look.GetRGBTransferFunction().GetColor(at), atol=2e-3)
        np.testing.assert_allclose(extinction, want, rtol=0.01, atol=1e-3)
    drawn = jaxvr.render(mesh, camera, transfer)
    np.testing.assert_array_equal(plotter.jaxvr.render(), drawn)
    assert float(np.asarray(drawn)[..., 3].max()) > 0.3


def test_the_array_that_the_mapper_takes():
    """PyVista averages cell data to points; a mapper of VTK may take them as they are."""
    plotter, (volume,) = plotter_of(lattice())
    volume.mapper.SetInputData(lattice())
    volume.mapper.SetScalarModeToUseCellFieldData()
    volume.mapper.SelectScalarArray("c")
    mesh = plotter.jaxvr.scene()[0]
    assert (mesh.report.field, mesh.location) == ("c", "cell")


def turned() -> Any:
    grid = lattice()
    grid.origin, grid.extent = (1.0, -2.0, 0.5), (2, 5, -1, 2, 0, 3)
    c, s = np.cos(0.5), np.sin(0.5)
    grid.direction_matrix = [[c, -s, 0], [s, c, 0], [0, 0, 1]]
    grid.point_data["t"] = 300.0 + np.arange(grid.n_points) % 7
    return grid


def rectilinear() -> Any:
    grid = pyvista.RectilinearGrid([0.0, 1.0, 1.5], [0.0, 0.1, 2.0, 2.5], [-1.0, 0.0])
    grid.point_data["t"] = np.arange(grid.n_points) ** 2 % 11
    return grid


@pytest.mark.parametrize("make", [lattice, turned, rectilinear])
def test_interpolation_by_the_nearest_is_the_value_of_the_nearest_point(make):
    """As VTK draws image data unless told otherwise; compared with a search for that point."""
    grid = make()
    plotter, (volume,) = plotter_of(grid, scalars="t")
    mesh = plotter.jaxvr.scene()[0]
    assert mesh.location == "cell" and mesh.report.field == "t"
    middle = np.asarray(mesh.points, np.float64)[np.asarray(mesh.cells)].mean(axis=1)
    shown = volume.mapper.GetInput()
    near = [shown.FindPoint(p) for p in middle]
    np.testing.assert_allclose(mesh.values, np.asarray(shown.point_data["t"])[near], rtol=1e-6)
    low, high = np.reshape(shown.bounds, (3, 2)).T
    np.testing.assert_allclose(mesh.bounds()[0], low, atol=1e-5)
    np.testing.assert_allclose(mesh.bounds()[1], high, atol=1e-5)
    volume.prop.interpolation_type = "linear"
    assert plotter.jaxvr.scene()[0].location == "point"
    volume.prop.interpolation_type = "nearest"


def inside_hull(points: Any, pixels: Any) -> Any:
    """Which pixels (n, 2) lie in the convex hull of points (P, 2), and how far from its edge."""
    from scipy.spatial import ConvexHull

    a = ConvexHull(points).equations
    return (pixels @ a[:, :2].T + a[:, 2]).max(axis=1)


@pytest.mark.parametrize("parallel", [False, True])
@pytest.mark.parametrize("kind", ["image", "unstructured"])
def test_a_screenshot_covers_the_pixels_that_vtk_projects_the_grid_to(kind, parallel):
    """The silhouette of a box, by VTK's own matrix, to a hundredth of a pixel."""
    grid = lattice() if kind == "image" else lattice().cast_to_unstructured_grid()
    plotter, (volume,) = plotter_of(grid, opacity=1.0)
    plotter.window_size = [40, 24]
    plotter.camera.position, plotter.camera.focal_point = (4.0, 3.0, 2.0), (0.3, 0.6, 1.2)
    plotter.camera.up, plotter.camera.roll = (0, 0, 1), 23.7
    plotter.camera.parallel_projection, plotter.camera.parallel_scale = parallel, 2.13
    matrix = np.diag([1.0, 2, 1, 1])
    matrix[:3, 3] = 0.1, -0.2, 0.3
    volume.user_matrix = matrix
    shot = plotter.jaxvr.screenshot(transparent_background=True)
    seen = plotter.jaxvr.render()[..., 3] > 0
    m = plotter.camera.GetCompositeProjectionTransformMatrix(40 / 24, -1, 1)
    m = np.array([[m.GetElement(i, j) for j in range(4)] for i in range(4)]) @ matrix
    corners = np.concatenate([np.asarray(grid.points), np.ones((grid.n_points, 1))], 1) @ m.T
    display = (corners[:, :2] / corners[:, 3:] + 1) / 2 * (40, 24)
    y, x = np.mgrid[:24, :40]
    depth = inside_hull(display, np.stack([x.ravel() + 0.5, 23.5 - y.ravel()], 1)).reshape(24, 40)
    clear = np.abs(depth) > 0.01
    np.testing.assert_array_equal(seen[clear], (depth < 0)[clear])
    assert 150 < seen.sum() < 850 and (~clear).sum() < 5
    assert (shot[..., 3] > 0)[depth < -1].all() and not (shot[..., 3] > 0)[depth > 0.01].any()


def test_a_screenshot_has_the_background_and_goes_to_a_file(tmp_path):
    plotter, _ = plotter_of(lattice())
    plotter.set_background((1.0, 0.0, 0.0))
    shot = plotter.jaxvr.screenshot(tmp_path / "a.png")
    assert shot.dtype == np.uint8 and shot.shape == (12, 16, 3)
    assert (shot[0, 0] == (255, 0, 0)).all() and not (shot == (255, 0, 0)).all()
    np.testing.assert_array_equal(pyvista.read(tmp_path / "a.png").dimensions, (16, 12, 1))
    clear = plotter.jaxvr.screenshot(transparent_background=True)
    assert clear.shape == (12, 16, 4) and clear[0, 0, 3] == 0
    plotter.set_background((1.0, 0.0, 0.0), top=(0.0, 0.0, 1.0))
    column = plotter.jaxvr.screenshot()[:, 0].astype(int)
    assert (np.diff(column[:, 0]) > 0).all() and (np.diff(column[:, 2]) < 0).all()


def test_what_is_opaque_on_an_image_is_nearly_so():
    plotter, (volume,) = plotter_of(lattice(), opacity_unit_distance=2.0)
    volume.GetProperty().GetScalarOpacity().AddPoint(301.5, 1.0)
    extinctions = plotter.jaxvr.scene()[2].extinctions
    np.testing.assert_allclose(extinctions.max(), -np.log(1 - accessors.OPAQUE) / 2, rtol=1e-4)


def test_a_volume_that_was_moved():
    plotter, (volume,) = plotter_of(lattice().cast_to_unstructured_grid())
    matrix = np.diag([2.0, 1, 1, 1])
    matrix[:3, 3] = 5, 0, 1
    volume.user_matrix = matrix
    low, high = plotter.jaxvr.scene()[0].bounds()
    np.testing.assert_allclose(low, (5, 0, 1), atol=1e-6)
    np.testing.assert_allclose(high, (8, 0.75, 4), atol=1e-6)


def test_what_jaxvr_does_not_draw_is_told():
    from vtkmodules.vtkCommonDataModel import vtkPlane

    plotter, volumes = plotter_of(lattice(), lattice(3))
    with pytest.raises(ValueError, match="shows 2 volumes"):
        plotter.jaxvr.scene()
    with pytest.warns(UserWarning, match=r"1 other volume\(s\) of the plotter left out"):
        assert plotter.jaxvr.scene(volumes[1])[0].n_points == 64
    volumes[0].SetVisibility(False)
    assert plotter.jaxvr.scene()[0].n_points == 64
    plotter.add_mesh(pyvista.Sphere())
    with pytest.warns(UserWarning, match=r"1 surface\(s\) of the plotter left out"):
        plotter.jaxvr.scene()
    with pytest.raises(ValueError, match="shows no volume"):
        pyvista.Plotter(off_screen=True).jaxvr.scene()
    with pytest.warns(UserWarning, match="no shading"):
        plotter_of(lattice(), shade=True)[0].jaxvr.scene()
    cut, (volume,) = plotter_of(lattice())
    volume.mapper.AddClippingPlane(vtkPlane())
    with pytest.warns(UserWarning, match="no clipping planes"):
        cut.jaxvr.scene()
    cut, (volume,) = plotter_of(lattice())
    volume.mapper.SetCropping(True)
    with pytest.warns(UserWarning, match="no cropping"):
        cut.jaxvr.scene()
    with pytest.raises(ValueError, match="not composited"):
        plotter_of(lattice(), blending="maximum")[0].jaxvr.scene()
    with pytest.raises(ValueError, match="set_background"):
        plotter.jaxvr.screenshot(background=(1, 1, 1))
    with pytest.raises(ValueError, match="no option status"):
        lattice().jaxvr.render(status=True)
    with pytest.raises(ValueError, match="combine"):
        pyvista.MultiBlock([lattice()]).jaxvr.mesh()


def test_an_older_pyvista_has_them_after_an_import():
    class Data:
        pass

    class Plotter:
        pass

    older: Any = SimpleNamespace(DataObject=Data, BasePlotter=Plotter)
    accessors.attach(older)
    data: Any = Data()
    plotter: Any = Plotter()
    assert isinstance(data.jaxvr, accessors.GridAccessor)
    assert isinstance(plotter.jaxvr, accessors.PlotterComponent)
