"""Cameras of VTK and PyVista: rays go where VTK's own projection matrix says."""

import importlib
import warnings
from typing import Any

import jax
import numpy as np
import pytest
import vtk

from jaxvr.view import Camera

with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)  # in what PyVista imports
    pyvista: Any = importlib.import_module("pyvista")  # its types are unions of unions

EYE, TARGET, UP = (3.0, -2.0, 5.0), (0.5, 0.25, -1.0), (0.1, 1.0, 0.3)
WIDTH, HEIGHT = 7, 4


def camera_of(parallel=False):
    view = vtk.vtkCamera()
    view.SetPosition(*EYE)
    view.SetFocalPoint(*TARGET)
    view.SetViewUp(*UP)
    view.SetViewAngle(37.0)
    view.SetParallelScale(2.5)
    view.SetParallelProjection(parallel)
    view.SetClippingRange(0.1, 100.0)
    return view


def projected(view, points, width=WIDTH, height=HEIGHT):
    """Normalised device coordinates x, y (..., 2) of world points by VTK's own matrix."""
    m = view.GetCompositeProjectionTransformMatrix(width / height, -1, 1)
    matrix = np.array([[m.GetElement(i, j) for j in range(4)] for i in range(4)])
    q = np.concatenate([points, np.ones((*points.shape[:-1], 1))], -1) @ matrix.T
    return q[..., :2] / q[..., 3:]


def check_rays(camera, view):
    """Every ray passes through the centre of its pixel, near and far."""
    w, h = camera.width, camera.height
    origins, directions = (np.asarray(a, float) for a in camera.rays())
    y, x = 1 - (2 * np.arange(h) + 1) / h, (2 * np.arange(w) + 1) / w - 1
    centres = np.stack(np.broadcast_arrays(x[None, :], y[:, None]), -1)
    for distance in (1.0, 30.0):
        seen = projected(view, origins + distance * directions, w, h)
        np.testing.assert_allclose(seen, centres, atol=1e-12)


@pytest.mark.parametrize("parallel", [False, True])
def test_rays_agree_with_vtk(parallel):
    view = camera_of(parallel)
    camera = Camera.from_vtk(view, WIDTH, HEIGHT)
    assert (camera.width, camera.height) == (WIDTH, HEIGHT)
    assert (camera.fov is None) == parallel
    if parallel:
        assert camera.extent == 5.0
    check_rays(camera, view)
    check_rays(camera, camera.to_vtk())


def test_turned_cameras_and_horizontal_angles():
    view = camera_of()
    view.Azimuth(20)
    view.Elevation(-35)
    view.Roll(50)
    view.Zoom(1.5)
    check_rays(Camera.from_vtk(view, WIDTH, HEIGHT), view)
    view.UseHorizontalViewAngleOn()
    check_rays(Camera.from_vtk(view, WIDTH, HEIGHT), view)


@pytest.mark.parametrize("parallel", [False, True])
def test_round_trip_is_exact(parallel, dtype):
    view = camera_of(parallel)
    camera = Camera.from_vtk(view, WIDTH, HEIGHT, dtype=dtype)
    assert camera.dtype == dtype
    again = Camera.from_vtk(camera.to_vtk(), WIDTH, HEIGHT, dtype=dtype)
    for name in ("eye", "target", "fov", "extent"):
        a, b = getattr(camera, name), getattr(again, name)
        assert (a is None) == (b is None)
        if a is not None:
            np.testing.assert_array_equal(a, b)
    np.testing.assert_allclose(camera.up, again.up, rtol=4 * np.finfo(dtype).eps)
    assert jax.tree.structure(camera) == jax.tree.structure(again)


def test_sizes():
    assert (Camera.from_vtk(camera_of()).width, Camera.from_vtk(camera_of()).height) == (512, 512)
    window, renderer = vtk.vtkRenderWindow(), vtk.vtkRenderer()
    renderer.SetActiveCamera(camera_of())
    window.SetOffScreenRendering(1)
    window.AddRenderer(renderer)
    window.SetSize(200, 100)
    camera = Camera.from_vtk(renderer)
    assert (camera.width, camera.height) == (200, 100)
    renderer.SetViewport(0.5, 0, 1, 1)
    camera = Camera.from_vtk(renderer, height=50)
    assert (camera.width, camera.height) == (100, 50)


def test_plotters_of_pyvista():
    plotter = pyvista.Plotter(off_screen=True, window_size=[64, 48])
    plotter.add_mesh(pyvista.Cube())
    camera = Camera.from_vtk(plotter)  # where `show` would put it
    assert (camera.width, camera.height) == (64, 48)
    np.testing.assert_allclose(camera.target, 0, atol=1e-12)
    check_rays(camera, plotter.camera)

    other = Camera.orthographic(EYE, TARGET, UP, 3.0, 32, 16)
    view = other.to_vtk(plotter)
    assert view is plotter.camera and list(plotter.window_size) == [32, 16]
    assert plotter.camera.parallel_projection and plotter.camera.parallel_scale == 1.5
    check_rays(other, plotter.camera)
    again = Camera.from_vtk(plotter)
    np.testing.assert_array_equal(again.eye, other.eye)
    assert (again.width, again.height, again.extent) == (32, 16, 3.0)

    own = pyvista.Camera()
    own.position, own.focal_point, own.up = EYE, TARGET, UP
    plotter.camera = own
    check_rays(Camera.from_vtk(plotter, WIDTH, HEIGHT), own)
    pinhole = Camera.look_at(EYE, TARGET, UP, 25.0, WIDTH, HEIGHT)
    assert pinhole.to_vtk(own) is own and not own.parallel_projection
    check_rays(pinhole, own)
    plotter.close()


def test_errors():
    for bad in (None, [EYE, TARGET, UP], vtk.vtkRenderWindow()):
        with pytest.raises(ValueError, match="A vtkCamera, a vtkRenderer.* is needed, not"):
            Camera.from_vtk(bad)
    view = camera_of()
    view.SetWindowCenter(0.1, 0)
    view.SetUseOffAxisProjection(1)
    with pytest.raises(ValueError, match="a window centre and an off-axis projection"):
        Camera.from_vtk(view)
    view = camera_of()
    view.SetViewShear(0.1, 0, 1)
    with pytest.raises(ValueError, match="a view shear"):
        Camera.from_vtk(view)
    view = camera_of()
    view.SetViewUp(*(np.array(EYE) - TARGET))
    with pytest.raises(ValueError, match="parallel to the view"):
        Camera.from_vtk(view)
