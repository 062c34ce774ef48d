"""Cameras from VTK's and PyVista's, and back.

Both describe a view by the same things: position, focal point and view up are eye, target and up;
the view angle is the full vertical angle, as `fov` is; a parallel scale is half the height of the
picture in world units, so `extent` is twice that. Not carried over: clipping planes (jaxvr shows
all that lies in front of the eye), and lens and stereo settings.

Pixels. jaxvr's rays go through the centres of pixels, as VTK draws surfaces. VTK's ray caster for
unstructured grids pierces a pixel's lower left corner, half a pixel left of and below its centre.
Images of VTK have their bottom row first, jaxvr's and PyVista's screenshots the top row.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from jaxvr.view.camera import Camera

SIZE = 512  # pixels, where nothing says how many


def read(
    source: Any, width: int | None = None, height: int | None = None, dtype: Any = None
) -> Camera:
    """See `Camera.from_vtk`."""
    from jaxvr.view.camera import Camera  # it imports this module

    view, (w, h) = _view(source), _size(source)
    _require_plain(view)
    width, height = w if width is None else width, h if height is None else height
    where = view.GetPosition(), view.GetFocalPoint(), view.GetViewUp()
    if view.GetParallelProjection():
        extent = 2 * view.GetParallelScale()
        return Camera.orthographic(*where, extent, width, height, dtype=dtype)
    angle = view.GetViewAngle()
    if view.GetUseHorizontalViewAngle():
        half = math.tan(math.radians(angle) / 2) * height / width
        angle = math.degrees(2 * math.atan(half))
    return Camera.look_at(*where, angle, width, height, dtype=dtype)


def write(camera: Camera, into: Any = None) -> Any:
    """See `Camera.to_vtk`."""
    if into is None:
        try:
            from vtkmodules.vtkRenderingCore import vtkCamera
        except ImportError as e:
            raise ImportError("to_vtk needs VTK: pip install vtk") from e
        into = vtkCamera()
    view = _view(into)
    eye, target = camera.absolute()
    view.SetPosition(*eye.tolist())
    view.SetFocalPoint(*target.tolist())
    view.SetViewUp(*np.asarray(camera.up, float).tolist())
    view.SetUseHorizontalViewAngle(0)
    view.SetParallelProjection(camera.fov is None)
    if camera.fov is not None:
        view.SetViewAngle(float(camera.fov))
    else:
        assert camera.extent is not None
        view.SetParallelScale(float(camera.extent) / 2)
    # A pyvista.Camera remembers these two itself.
    if hasattr(view, "parallel_projection"):
        view.parallel_projection = camera.fov is None
    if hasattr(view, "is_set"):
        view.is_set = True
    if _is_plotter(into):
        into.window_size = [camera.width, camera.height]
        into.renderer.ResetCameraClippingRange()
    elif into is not view:
        into.ResetCameraClippingRange()
    return view


def _is(x: Any, name: str) -> bool:
    """Whether `x` is an object of this VTK class, without importing VTK."""
    return bool(hasattr(x, "IsA") and x.IsA(name))


def _is_plotter(x: Any) -> bool:
    return hasattr(x, "window_size") and _is(getattr(x, "renderer", None), "vtkRenderer")


def _view(source: Any) -> Any:
    """The vtkCamera of a camera, a renderer, or a PyVista plotter (of its active renderer)."""
    if _is(source, "vtkCamera"):
        return source
    if _is(source, "vtkRenderer"):
        return source.GetActiveCamera()
    if _is_plotter(source):
        return source.camera  # a plotter places its camera when it is first asked for it
    raise ValueError(
        "A vtkCamera, a vtkRenderer, a pyvista.Camera or a pyvista.Plotter is needed, not "
        f"{type(source).__name__}."
    )


def _size(source: Any) -> tuple[int, int]:
    """Width and height in pixels of the part of the window that the renderer has."""
    if _is_plotter(source):
        renderer, window = source.renderer, source.window_size
    elif _is(source, "vtkRenderer") and source.GetRenderWindow() is not None:
        renderer, window = source, source.GetRenderWindow().GetSize()
    else:
        return SIZE, SIZE
    left, bottom, right, top = renderer.GetViewport()
    size = round((right - left) * window[0]), round((top - bottom) * window[1])
    return size if min(size) > 0 else (SIZE, SIZE)


def _require_plain(view: Any) -> None:
    """ValueError for a projection that a jaxvr camera does not have."""
    found = {
        "a window centre": tuple(view.GetWindowCenter()) != (0.0, 0.0),
        "a view shear": tuple(view.GetViewShear()[:2]) != (0.0, 0.0),
        "an off-axis projection": view.GetUseOffAxisProjection(),
        "an explicit projection matrix": view.GetUseExplicitProjectionTransformMatrix(),
        "a user view transform": view.GetUserViewTransform() is not None,
        "a user transform": view.GetUserTransform() is not None,
        "a model transform": not view.GetModelTransformMatrix().IsIdentity(),
    }
    if bad := [name for name, is_set in found.items() if is_set]:
        raise ValueError(
            f"This camera has {' and '.join(bad)}, which jaxvr's cameras do not. Remove it: jaxvr "
            "looks straight at the focal point."
        )
