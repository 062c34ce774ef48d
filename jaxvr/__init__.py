"""Differentiable volume rendering of unstructured meshes.

    volume -+
            +- trace --> segments -- optics --> (colour, depth) -- composite --> pixel -- fit
    camera -+                                                      gradients flow back <---+

`render(volume, camera, transfer)` is the whole line. Each place in it has a noun that can be
swapped: a *tracer* turns rays into segments, an *integrator* segments into colour and optical
depth, a *compositor* those into a pixel, and an *adjoint* says how gradients get back. Two ideas
carry the rest. Integers are found, floats are derived: which cell and which face is discrete and
has no gradient, depths and scalars are arithmetic on local data and have one. And: trace once,
shade many, since segments do not depend on the transfer function.

Rooms, each importing only from those before it: `_core`, `numerics`, `volume`, `view`, `optics`,
`order`, `trace`, `composite`, `native`, `adjoint`, `engine`, `units`, `defaults`, `hints`,
`render`, `probe`, `fit`, `files`, `testing`, `plot`, `pictures`, `interact`, `accessors`, `cli`.
An *engine* runs the loops: those of JAX, or those in C of `native`, which serve where they can with
the same results. No other room imports from `testing`.
"""

from typing import TYPE_CHECKING

import jaxvr._core.quiet  # noqa: F401, I001 (first, before anything imports JAX)
from jaxvr import engine, native, order, testing
from jaxvr._core.status import RenderError, check
from jaxvr.adjoint import Direct, Forward, Replay
from jaxvr.composite import MaximumIntensity, Over, XRay
from jaxvr.defaults import default_transfer
from jaxvr.files import save_animation, save_image, turntable
from jaxvr.fit import FitError, FitResult, fit, fit_parameters
from jaxvr.hints import ViewWarning
from jaxvr.interact import explore, load_ipython_extension, unload_ipython_extension
from jaxvr.optics import (
    Analytic,
    AverageColor,
    ConstantExtinction,
    PartialPreIntegration,
    PreIntegration,
    Quadrature,
    TransferFunction,
)
from jaxvr.probe import Probe, probe
from jaxvr.render import render, render_rays, shade, trace
from jaxvr.trace import (
    Fragments,
    KBuffer,
    KMap,
    RayCast,
    Segments,
    measure_k,
    rasterize,
)
from jaxvr.view import Camera, load_image, psnr, ssim
from jaxvr.volume import (
    TetMesh,
    datasets,
    list_fields,
    read_mesh,
    read_plot3d,
    refine,
    write_mesh,
)

__all__ = [
    "Analytic",
    "AverageColor",
    "Camera",
    "ConstantExtinction",
    "Direct",
    "FitError",
    "FitResult",
    "Forward",
    "Fragments",
    "KBuffer",
    "KMap",
    "MaximumIntensity",
    "Over",
    "PartialPreIntegration",
    "PreIntegration",
    "Probe",
    "Quadrature",
    "RayCast",
    "RenderError",
    "Replay",
    "Segments",
    "TetMesh",
    "TransferFunction",
    "ViewWarning",
    "XRay",
    "check",
    "datasets",
    "default_transfer",
    "engine",
    "explore",
    "fit",
    "fit_parameters",
    "list_fields",
    "load_image",
    "load_ipython_extension",
    "measure_k",
    "native",
    "order",
    "probe",
    "psnr",
    "rasterize",
    "read_mesh",
    "read_plot3d",
    "refine",
    "render",
    "render_rays",
    "save_animation",
    "save_image",
    "shade",
    "ssim",
    "testing",
    "trace",
    "turntable",
    "unload_ipython_extension",
    "write_mesh",
]
__version__ = "0.1.0"

if TYPE_CHECKING:
    from jaxvr import plot as plot
else:

    def __getattr__(name):
        """`jaxvr.plot`, imported where it is first used: it needs matplotlib, which takes a while
        to load. For the same reason it is not in `__all__`."""
        if name == "plot":
            import importlib

            return importlib.import_module("jaxvr.plot")
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
