"""`explore`: a volume in a notebook, turned by hand, with an editor of its transfer function."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from jaxvr.interact.viewer import Viewer
from jaxvr.optics import AbstractIntegrator, TransferFunction
from jaxvr.trace import AbstractTracer
from jaxvr.view.camera import Camera
from jaxvr.volume import AbstractVolume

if TYPE_CHECKING:
    from jaxvr.interact.widget import Explorer


def explore(
    volume: AbstractVolume,
    transfer: TransferFunction | None = None,
    camera: Camera | None = None,
    *,
    size: int = 512,
    coarse: int | None = None,
    tracer: AbstractTracer | None = None,
    integrator: AbstractIntegrator | None = None,
    background: Any = (1.0, 1.0, 1.0),
) -> Explorer:
    """A widget that shows a volume, for Jupyter and whatever else shows anywidgets.

    Drag to rotate, scroll to zoom, drag with shift or the right button to shift the picture, double
    click to start again; arrow keys, + and - do the same. Buttons turn another axis up, and look
    from the front (azimuth 0), the right (90), the back, the left, the top and the bottom; a line
    says which axis is up, and from where the view is. Below is the transfer function over a
    histogram of the values: drag its points, double click to add one, right click or Delete to
    remove one. Pictures are coarse while something moves and exact, as `jaxvr.render` gives them,
    as soon as it rests.

    Args:
      volume: as for `jaxvr.render`.
      transfer: to start with; None takes `jaxvr.default_transfer` with six points, which spans the
        field's 1 to 99 % quantiles by volume. The widget says what it spans.
      camera: to start with, and its pixels; None takes `Camera.orbit(volume, up=)` with that of the
        axes y, z and x up which shows most. The widget says which.
      size: pixels of both sides, where no camera is given.
      coarse: pixels of the longer side while something moves; None takes as many as can be drawn
        in 60 ms.
      tracer, integrator: as for `jaxvr.render`.
      background: opaque linear RGB (3,); None shows the page.

    Returns:
      An `Explorer`, with `camera`, `transfer` (which can be set) and `image` of what it shows.

    Raises:
      ImportError: without anywidget. ValueError: for arguments of the wrong kind.
    """
    try:
        from jaxvr.interact.widget import Explorer
    except ModuleNotFoundError as error:
        if error.name not in ("anywidget", "ipywidgets", "traitlets"):
            raise
        raise ImportError(
            f"explore needs {error.name}, which is not installed: pip install anywidget jupyterlab"
        ) from error
    viewer = Viewer(
        volume,
        transfer,
        camera,
        size=size,
        coarse=coarse,
        tracer=tracer,
        integrator=integrator,
        background=background,
    )
    return Explorer(viewer)
