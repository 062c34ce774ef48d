"""What verbs are given, checked and in the volume's dtype: the same words for the same mistake.

Each raises a `ValueError` that says what was found.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, TypeGuard

import jax
import jax.numpy as jnp
import numpy as np

from jaxvr._core.checks import (
    as_floats,
    as_light,
    is_concrete,
    require_finite,
    require_kind,
)
from jaxvr._core.offsets import FAR, Origin, is_single, relative, said
from jaxvr._core.pytree import registered, with_leaves_of
from jaxvr._core.warn import warn
from jaxvr.adjoint import AbstractAdjoint, Pipeline, Replay
from jaxvr.composite import AbstractCompositor, Over
from jaxvr.engine import ENGINES, XLA, AbstractEngine, C
from jaxvr.optics import AbstractIntegrator, Analytic, TransferFunction
from jaxvr.optics.transfer import tell_coarse
from jaxvr.optics.unshaded import Unshaded
from jaxvr.trace import AbstractTracer, RayCast, Segments
from jaxvr.trace.integrity import require_segments
from jaxvr.view.camera import Camera, RayImage
from jaxvr.view.rays import Rays
from jaxvr.volume import AbstractVolume

Array = jax.Array

NOUNS = ("tracer", "integrator", "compositor")


def background_of(background: Any) -> Array | None:
    """RGB (3,), or None."""
    if background is None:
        return None
    shape = as_floats("background", background).shape
    if shape != (3,):
        raise ValueError(f"background must be RGB with shape (3,), but has {shape}.")
    return jnp.asarray(as_light("background", background))


def dtype_of(volume: Any) -> Any:
    """Of a mesh or of segments."""
    return volume.scalar.dtype if isinstance(volume, Segments) else volume.dtype


def volume_of(volume: Any) -> Any:
    """A volume, checked. One of another maker derives from `AbstractVolume`."""
    if not isinstance(volume, AbstractVolume):
        hint = "Read files with jaxvr.read_mesh."
        if dataclasses.is_dataclass(volume):
            hint = "Another kind of volume derives from jaxvr.volume.AbstractVolume."
        what = repr(volume) if isinstance(volume, type) else f"a {type(volume).__name__}"
        raise ValueError(f"volume must be a jaxvr.TetMesh, but is {what}. {hint}")
    _require_place(volume)
    volume.require()
    return volume


def _require_place(volume: AbstractVolume) -> None:
    """What a volume is relative to is compared and subtracted outside of all tracing."""
    origin, offset, kind = volume.origin, volume.offset, type(volume).__name__
    if not (isinstance(origin, tuple) and len(origin) == 3 and all(map(_is_plain, origin))):
        raise ValueError(
            f"{kind}.origin must be three plain numbers, a static field: it is what a volume's "
            f"lengths are relative to. But it is {origin!r}; name an array otherwise."
        )
    if not _is_plain(offset):
        raise ValueError(
            f"{kind}.offset must be a plain number, a static field: it is what a volume's scalars "
            f"are relative to. But it is {offset!r}; name an array otherwise."
        )


def _is_plain(x: Any) -> bool:
    return isinstance(x, int | float) and math.isfinite(x)


def is_camera(x: Any) -> bool:
    """Whether it gives rays, as a camera does."""
    return callable(getattr(x, "rays", None)) and not isinstance(x, type)


def is_rays(x: Any) -> TypeGuard[tuple[Any, Any]]:
    """Whether it is (origins, directions), and no camera."""
    return isinstance(x, tuple | list) and not is_camera(x)


def camera_of(camera: Any, volume: Any) -> Camera | RayImage:
    """The camera relative to the volume's origin: what has `local_rays()`, `height`, `width`."""
    if not isinstance(camera, Camera):
        return _image_of(camera, volume)
    for name in ("eye", "target", "up", "fov", "extent"):
        part = getattr(camera, name)
        if part is not None:
            require_finite(f"camera.{name}", part)
    dtype = dtype_of(volume)
    if camera.origin != volume.origin:
        _require_digits(camera, volume.origin)
    return camera.relative_to(volume.origin, dtype)


def _image_of(camera: Any, volume: Any) -> RayImage:
    """The rays of a camera of another maker, who gives them in the world."""
    if not is_camera(camera):
        what = repr(camera) if isinstance(camera, type) else f"a {type(camera).__name__}"
        raise ValueError(
            f"camera must be a jaxvr.Camera, but is {what}. A camera of your own has width, "
            "height, and rays() that gives origins and directions (height, width, 3)."
        )
    kind = type(camera).__name__
    shape = tuple(getattr(camera, name, None) for name in ("height", "width"))
    if not all(isinstance(n, int | np.integer) and n > 0 for n in shape):
        raise ValueError(
            f"{kind}.height and {kind}.width must be whole numbers of pixels, but are {shape[0]!r} "
            f"and {shape[1]!r}."
        )
    rays = camera.rays()
    if not (isinstance(rays, tuple | list) and len(rays) == 2):
        raise ValueError(
            f"{kind}.rays() must give two arrays, origins and directions, but gives "
            f"a {type(rays).__name__}."
        )
    world = rays_of(rays[0], rays[1], volume)
    if world.origins.shape != (*shape, 3):
        raise ValueError(
            f"{kind}.rays() gives rays of shape {world.origins.shape[:-1]}, but {kind} is "
            f"{shape[0]} x {shape[1]} pixels high and wide."
        )
    return RayImage(world.origins, world.directions)


def _require_digits(camera: Camera, origin: Origin) -> None:
    """Warns of a camera in float32 whose place beside a volume far from 0 is rounded, since it was
    made inside `jit` or of JAX's arrays."""
    if any(camera.origin) or camera.dtype != np.float32:
        return
    if is_concrete(camera.eye, camera.target):
        eye, target = camera.absolute()
        if np.abs(origin).max() <= FAR * np.abs(eye - target).max():
            return
    step = np.spacing(np.float32(np.abs(origin).max()))
    warn(
        f"The camera's eye and target are float32, with steps of {step:.2g} beside a volume at "
        f"{said(origin)}. Make it outside jit of plain numbers or NumPy's float64, or with "
        "Camera.orbit(volume), and move it with camera.replace(eye=..., origin=camera.origin).",
        UserWarning,
    )


def transfer_of(
    transfer: Any, volume: Any, compositor: AbstractCompositor | None = None
) -> TransferFunction:
    """The transfer function with positions relative to the offset of a mesh or of segments.

    compositor: what it is for; one that does not look at it gets a point in its place, for None as
        well.
    """
    if compositor is not None and not compositor.reads_transfer:
        if transfer is not None:
            require_kind("transfer", transfer, TransferFunction)
        return TransferFunction([0.0], [[0.0] * 3], [0.0], dtype=dtype_of(volume))
    require_kind("transfer", transfer, TransferFunction)
    # Its numbers may have been computed with since it was made: the same checks once more.
    transfer = TransferFunction(
        transfer.positions, transfer.colors, transfer.extinctions, offset=transfer.offset
    )
    require_positions(transfer, volume)
    return transfer.relative_to(volume.offset, dtype_of(volume))


def require_positions(transfer: TransferFunction, volume: Any) -> None:
    """Warns of positions that have no offset, and too few digits, beside a mesh or segments that
    have one: they came out of `jit`, or were passed in float32 with offset=0."""
    if volume.offset and not transfer.offset:
        tell_coarse(transfer.positions)


def offset_of(volume: Any) -> Array | None:
    """What scalars of a mesh or of segments are relative to (); None if to 0."""
    return jnp.asarray(volume.offset, dtype_of(volume)) if volume.offset else None


def segments_of(segments: Any) -> Segments:
    hint = "Make them with jaxvr.trace(volume, camera), or pass the volume to jaxvr.render."
    require_kind("segments", segments, Segments, hint)
    require_segments(segments)
    return segments


def tracer_of(tracer: Any, volume: Any) -> AbstractTracer:
    """A tracer for a volume, its default one if that is None. volume: checked; None if there is
    none, but segments that were traced."""
    if tracer is None and volume is not None:
        tracer = volume.default_tracer()
    found = _noun("tracer", tracer, "prepare_rays", RayCast)
    _require_methods("tracer", found, ("prepare", "start", "step", "longest"), AbstractTracer)
    if getattr(found, "reverse", False):
        raise ValueError(
            f"tracer is a {type(found).__name__} with reverse=True, and which end comes first is "
            'for the compositor to say: leave it out, and take Over(direction="back to front").'
        )
    takes = getattr(found, "takes", AbstractVolume)
    if volume is not None and not isinstance(volume, takes):
        kind = type(volume).__name__
        default = volume.default_tracer()
        instead = (
            f"which its default_tracer() gives: it must give one for a {kind}."
            if type(default) is type(found)
            else f"leave tracer out, which takes {default!r}."
        )
        raise ValueError(
            f"{type(found).__name__} traces a {takes.__name__}, and volume is a {kind}: {instead}"
        )
    return found


def require_cuts(tracer: Any, near: Any, far: Any) -> None:
    """ValueError for ends of rays that a tracer would not look at."""
    given = [name for name, x in (("near", near), ("far", far)) if x is not None]
    if given and not getattr(tracer, "cuts", False):
        raise ValueError(
            f"{type(tracer).__name__} does not cut segments at {' and '.join(given)}. If it does, "
            "its class says cuts = True (see jaxvr.trace.AbstractTracer)."
        )


def integrator_of(
    integrator: Any, compositor: AbstractCompositor | None = None
) -> AbstractIntegrator:
    default = Analytic if compositor is None else compositor.default_integrator
    integrator = _noun("integrator", integrator, "slab", Analytic, default)
    if compositor is not None and compositor.shades and isinstance(integrator, Unshaded):
        raise ValueError(
            f"{type(compositor).__name__} composites light, and Unshaded() gives none: take "
            "another integrator, or leave it out."
        )
    return integrator


def compositor_of(compositor: Any) -> AbstractCompositor:
    found = _noun("compositor", compositor, "finish", Over)
    names = (
        "needs",
        "shades",
        "reads_transfer",
        "backwards",
        "default_integrator",
        "init",
        "add",
        "done",
    )
    _require_methods("compositor", found, names, AbstractCompositor)
    return found


def _require_methods(noun: str, found: Any, names: tuple[str, ...], base: type) -> None:
    missing = [name for name in names if not hasattr(found, name)]
    if missing:
        room = "composite" if noun == "compositor" else "trace"
        raise ValueError(
            f"{noun} is a {type(found).__name__}, which has no {', '.join(missing)}: derive it "
            f"from jaxvr.{room}.{base.__name__}."
        )


def adjoint_of(adjoint: Any) -> AbstractAdjoint:
    return _noun("adjoint", adjoint, "run", Replay)


def engine_of(
    engine: Any, adjoint: AbstractAdjoint | None, pipeline: Pipeline, dtype: Any
) -> AbstractEngine:
    """The engine that runs a call. Asked outside of `jit`: a compiled function would keep the
    answer that the environment and the backend gave once.

    adjoint: None where nothing is differentiated. dtype: of the volume.
    """

    def refusal(chosen: Any) -> str | None:
        # A user's own adjoint needs no base.
        by_adjoint = getattr(adjoint, "refuses", lambda _: None)(chosen)
        return by_adjoint or chosen.refuses(pipeline, dtype)

    native = getattr(adjoint, "native", None)  # of Replay, deprecated
    if native is not None:
        if engine is not None:
            raise ValueError(f"Pass engine=, or {adjoint!r}, which is deprecated, but not both.")
        engine = C() if native else XLA()
    if engine is None:
        return next(e for e in ENGINES if e is ENGINES[-1] or refusal(e) is None)
    engine = _noun("engine", engine, "march", XLA)
    if reason := refusal(engine):
        raise ValueError(f"engine={engine!r} cannot be used here: {reason}")
    return engine


def at_the_door(pipeline: Pipeline, dtype: Any) -> Pipeline:
    """With numbers of nouns as arrays of the volume's dtype."""
    nouns = {name: with_leaves_of(name, getattr(pipeline, name), dtype) for name in NOUNS}
    return Pipeline(**nouns)


def _noun(name: str, given: Any, method: str, usual: type, default: Any = None) -> Any:
    """What was given, or the default if that is None. It is known by a method: a user's own needs
    no base."""
    if given is None:
        found = (default or usual)()
        return registered(name, found) if name in NOUNS else found
    if isinstance(given, type) and hasattr(given, method):
        raise ValueError(
            f"{name} is the class {given.__name__}, not one of its objects: did you forget the ()?"
        )
    if hasattr(given, method) and name in NOUNS:
        return registered(name, given)
    if not hasattr(given, method):
        what = repr(given) if isinstance(given, str) else f"a {type(given).__name__}"
        raise ValueError(f"{name} must be an object such as {_shown(usual)}(), but is {what}.")
    return given


def _shown(kind: type) -> str:
    room = "engine." if issubclass(kind, AbstractEngine) else ""
    return f"jaxvr.{room}{kind.__name__}"


def rays_of(origins: Any, directions: Any, volume: Any, near: Any = None, far: Any = None) -> Rays:
    """Rays with origins and directions of one shape (..., 3), the latter not zero, the former
    relative to the volume's origin."""
    dtype = dtype_of(volume)
    if any(volume.origin) and is_single(origins):
        step = np.spacing(np.float32(np.abs(volume.origin).max()))
        warn(
            f"origins are float32, with steps of {step:.2g} beside a volume at "
            f"{said(volume.origin)}. Pass float64.",
            UserWarning,
        )
    if isinstance(origins, jax.Array):
        origins = as_floats("origins", origins)
    else:
        origins = as_floats("origins", origins, dtype=np.float64)
    directions = as_floats("directions", directions)
    for name, x in (("origins", origins), ("directions", directions)):
        if x.ndim == 0 or x.shape[-1] != 3:
            raise ValueError(f"{name} must have shape (..., 3), but has {x.shape}.")
        require_finite(name, x)
    shape = np.broadcast_shapes(origins.shape, directions.shape)
    if 0 in shape:
        raise ValueError(f"There are no rays: their shape is {shape}.")
    if is_concrete(directions):
        none = ~np.asarray(directions).any(-1)
        if none.any():
            first = tuple(int(i) for i in np.argwhere(none)[0])
            raise ValueError(f"{int(none.sum())} direction(s) are zero, the first at {first}.")
    if any(volume.origin):
        origins = relative(origins, volume.origin, dtype)
    origins, directions = (
        jnp.broadcast_to(jnp.asarray(x, dtype), shape) for x in (origins, directions)
    )
    return between(origins, directions, near, far)


def between(origins: Array, directions: Array, near: Any, far: Any) -> Rays:
    """Rays (..., 3) with an interval, numbers or (...,), in their dtype: `near` at least 0, and
    `far` at least `near`."""
    shape, dtype = origins.shape[:-1], origins.dtype
    near, far = (
        None if x is None else _distance(name, x, shape, dtype)
        for name, x in (("near", near), ("far", far))
    )
    if near is not None:
        near = jnp.where(near < 0, 0, near)
    if far is not None:
        least = 0 if near is None else near
        far = jnp.where(far < least, least, far)
    return Rays(origins, directions, near, far)


def _distance(name: str, x: Any, shape: tuple[int, ...], dtype: Any) -> Array:
    given, x = x, as_floats(name, x)
    if np.dtype(getattr(given, "dtype", None) or np.asarray(given).dtype).kind == "b":
        raise ValueError(f"{name} must be None or hold distances, but holds booleans.")
    if is_concrete(x) and np.isnan(np.asarray(x)).any():
        raise ValueError(f"{name} is NaN for {int(np.isnan(np.asarray(x)).sum())} ray(s).")
    try:
        return jnp.broadcast_to(jnp.asarray(x, dtype), shape)
    except ValueError:
        raise ValueError(
            f"{name} must be a number or have the shape {shape} of the rays, but has {x.shape}."
        ) from None
