"""`render`, `render_rays`, `trace` and `shade`: the whole architecture in one call.

    volume, camera -- tracer --> segments -- integrator --> colours -- compositor --> pixels

`render` is `shade(trace(...))` without storing the segments. Rays go in batches, square tiles
of the image, so that the rays of a batch stay together. Integers and floats of volume,
camera, transfer function and nouns are arguments of one compiled function: a new camera, transfer
function, field or number of a noun does not compile again, a new mesh size, image size or number of
control points does.
"""

from __future__ import annotations

import dataclasses
import math
from functools import partial
from typing import Any, Literal, overload

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxvr import hints
from jaxvr._core.checks import is_concrete
from jaxvr._core.compiling import compiled
from jaxvr._core.offsets import bare
from jaxvr._core.pytree import refusing_derivatives, with_leaves_of
from jaxvr._core.status import BROKEN, LOST, check
from jaxvr._core.warn import warn
from jaxvr.adjoint import AbstractAdjoint, Pipeline
from jaxvr.adjoint.base import Operands, refusing
from jaxvr.adjoint.replay import deprecated
from jaxvr.arguments import (
    adjoint_of,
    at_the_door,
    background_of,
    between,
    camera_of,
    compositor_of,
    dtype_of,
    engine_of,
    integrator_of,
    is_rays,
    offset_of,
    rays_of,
    require_cuts,
    segments_of,
    tracer_of,
    transfer_of,
    volume_of,
)
from jaxvr.composite import AbstractCompositor, Scale
from jaxvr.engine import XLA, AbstractEngine, C
from jaxvr.optics import AbstractIntegrator, TransferFunction
from jaxvr.trace import AbstractTracer, Recorded, Segments
from jaxvr.trace.beam import are_rays
from jaxvr.trace.integrity import unfit
from jaxvr.trace.recorded import Nodes, Runs
from jaxvr.units import rays_in, transfer_in, units_in, units_of, volume_in
from jaxvr.view.camera import HasRays
from jaxvr.view.rays import Rays, flat
from jaxvr.view.tiles import batch_size, batches, tile, tile_order, untile
from jaxvr.volume import AbstractVolume

Array = jax.Array

# Accelerators want many more at once; not measured yet.
ACCELERATOR_BATCH = 1 << 18
# Numbers that XLA keeps for each ray of a batch: 89 to render, 207 for all gradients at once
# (differences of its own reports between batches of 2^9 and 2^16 rays; JAX's loops).
NUMBERS_PER_RAY = 212
# Segments of a mesh in range are not in range themselves: they may be shorter than coordinates are
# large by this power of two.
_PARTS = 20


@overload
def render(
    volume: AbstractVolume,
    camera: HasRays,
    transfer: TransferFunction | None,
    *,
    tracer: AbstractTracer | None = None,
    integrator: AbstractIntegrator | None = None,
    compositor: AbstractCompositor | None = None,
    adjoint: AbstractAdjoint | None = None,
    engine: AbstractEngine | None = None,
    background: Any = None,
    budget: int | None = None,
    status: Literal[False] = False,
) -> Array: ...


@overload
def render(
    volume: AbstractVolume,
    camera: HasRays,
    transfer: TransferFunction | None,
    *,
    tracer: AbstractTracer | None = None,
    integrator: AbstractIntegrator | None = None,
    compositor: AbstractCompositor | None = None,
    adjoint: AbstractAdjoint | None = None,
    engine: AbstractEngine | None = None,
    background: Any = None,
    budget: int | None = None,
    status: Literal[True],
) -> tuple[Array, Array]: ...


@overload
def render(
    volume: AbstractVolume,
    camera: HasRays,
    transfer: TransferFunction | None,
    *,
    tracer: AbstractTracer | None = None,
    integrator: AbstractIntegrator | None = None,
    compositor: AbstractCompositor | None = None,
    adjoint: AbstractAdjoint | None = None,
    engine: AbstractEngine | None = None,
    background: Any = None,
    budget: int | None = None,
    status: bool = False,
) -> Array | tuple[Array, Array]: ...


def render(
    volume: AbstractVolume,
    camera: HasRays,
    transfer: TransferFunction | None,
    *,
    tracer: AbstractTracer | None = None,
    integrator: AbstractIntegrator | None = None,
    compositor: AbstractCompositor | None = None,
    adjoint: AbstractAdjoint | None = None,
    engine: AbstractEngine | None = None,
    background: Any = None,
    budget: int | None = None,
    status: bool = False,
) -> Array | tuple[Array, Array]:
    """An image of a volume.

    Args:
      volume: a `TetMesh`, or what derives from `jaxvr.volume.AbstractVolume`.
      camera: where from, and how many pixels: a `Camera`, or what gives rays as one does (see
        `jaxvr.view.HasRays`).
      transfer: colour and extinction of each scalar. May be None with a compositor that does not
        look at it, as `XRay()`.
      tracer: `volume.default_tracer()` if None, `RayCast()` for meshes. compositor: `Over()`, or
        `MaximumIntensity()`, `XRay()`. integrator: what the compositor has by default, `Analytic()`
        for light.
      adjoint: `Replay()`, for reverse mode; `Forward()` for forward mode, `Direct(...)` for both.
      engine: what runs the loops, `jaxvr.engine.C()` or `jaxvr.engine.XLA()`; None takes C where it
        does not refuse, asked at every call, or while tracing under your own `jit`.
      background: opaque linear RGB (3,) behind the volume; None leaves it transparent.
      budget: bytes for the state of the rays that march at once, beside the volume and the image;
        None takes what measured fastest, 0.5 MB on CPUs and 220 MB on accelerators in float32.
        Loops in C need 0.2 MB a core whatever it is.
      status: also return the status bits (height, width) int32 of the pixels, instead of raising
        what they say: see `jaxvr.check`.

    Returns:
      image (height, width, 4): premultiplied linear RGBA in the volume's dtype, row 0 on top.

    Raises:
      ValueError: for NaN or infinite operands, a budget below one byte, a compositor that goes
        back to front with a tracer that cannot, or an engine that refuses. RenderError: if a ray
        could not be followed, and for scalars and lengths out of the range that `jaxvr.units`
        states. Of values only where they are concrete, not inside your own `jit`.

    Warns, also only there, with a `jaxvr.ViewWarning` that says what a blank picture comes from, or
    that the field's range and the transfer function's do not fit, that the numbers may be opacities
    instead of extinctions, or that the eye is in the volume.

    Differentiable in `volume.values`, `volume.points`, `transfer` (positions, colors, extinctions),
    `camera` (eye, target, up, fov or extent) and `background`. Notes on kinks are with `RayCast`,
    `jaxvr.optics.partition` and the adjoints.
    """
    volume = volume_of(volume)
    pipeline = _pipeline(tracer_of(tracer, volume), integrator, compositor)
    view = camera_of(camera, volume)
    transfer = transfer_of(transfer, volume, pipeline.compositor)
    how = _how(pipeline, adjoint, engine, budget, volume)
    with refusing(how[1]):
        scene = bare(volume), bare(view), bare(transfer)
        last = offset_of(volume), background_of(background)
        image, bits, seen = _render(*how, *scene, *last)
    bits = volume.hold(bits)
    if status:
        return image, bits
    if is_concrete(bits):
        check(bits)
        hints.look(volume, view, transfer, seen, pipeline.compositor, stacklevel=2)
    return volume.unasked(image, bits)


@overload
def render_rays(
    volume: AbstractVolume,
    origins: Any,
    directions: Any,
    transfer: TransferFunction | None,
    *,
    near: Any = None,
    far: Any = None,
    tracer: AbstractTracer | None = None,
    integrator: AbstractIntegrator | None = None,
    compositor: AbstractCompositor | None = None,
    adjoint: AbstractAdjoint | None = None,
    engine: AbstractEngine | None = None,
    background: Any = None,
    budget: int | None = None,
    status: Literal[False] = False,
) -> Array: ...


@overload
def render_rays(
    volume: AbstractVolume,
    origins: Any,
    directions: Any,
    transfer: TransferFunction | None,
    *,
    near: Any = None,
    far: Any = None,
    tracer: AbstractTracer | None = None,
    integrator: AbstractIntegrator | None = None,
    compositor: AbstractCompositor | None = None,
    adjoint: AbstractAdjoint | None = None,
    engine: AbstractEngine | None = None,
    background: Any = None,
    budget: int | None = None,
    status: Literal[True],
) -> tuple[Array, Array]: ...


@overload
def render_rays(
    volume: AbstractVolume,
    origins: Any,
    directions: Any,
    transfer: TransferFunction | None,
    *,
    near: Any = None,
    far: Any = None,
    tracer: AbstractTracer | None = None,
    integrator: AbstractIntegrator | None = None,
    compositor: AbstractCompositor | None = None,
    adjoint: AbstractAdjoint | None = None,
    engine: AbstractEngine | None = None,
    background: Any = None,
    budget: int | None = None,
    status: bool = False,
) -> Array | tuple[Array, Array]: ...


def render_rays(
    volume: AbstractVolume,
    origins: Any,
    directions: Any,
    transfer: TransferFunction | None,
    *,
    near: Any = None,
    far: Any = None,
    tracer: AbstractTracer | None = None,
    integrator: AbstractIntegrator | None = None,
    compositor: AbstractCompositor | None = None,
    adjoint: AbstractAdjoint | None = None,
    engine: AbstractEngine | None = None,
    background: Any = None,
    budget: int | None = None,
    status: bool = False,
) -> Array | tuple[Array, Array]:
    """The colours that rays see.

    Args:
      origins, directions (..., 3): rays from the origins onwards; origins may be in the volume. In
        the world: beside a volume that has an `origin` pass NumPy's float64.
        Directions of any length but zero: optical lengths are world lengths. Neighbours in the
        array should be neighbours in space, for speed.
      near, far: world distances from the origins, numbers or (...,): of each ray what lies between
        them is seen, cut there inside of cells too. None for 0 and for no end. What is before the
        origin is never seen, so that a `near` below 0 is 0; nothing is where `far` is below `near`.
        A ray stops at `far`, which saves time unless the mesh has folded cells. Places are as exact
        as numbers of the dtype are at that distance. What lies on both sides of a cut merges by the
        over operator to the whole; where cells are folded only sums do, as alpha.
      status: also return the status bits (...,) int32 of each ray, for `jaxvr.check`.
      The rest as for `render`.

    Returns:
      rgba (..., 4), premultiplied linear, in the volume's dtype. Differentiable in origins,
      directions, near and far too: by the latter two the light that comes from there, one-sided
      where they lie on a face between two cells whose values differ. Silhouettes are left out: of
      an alpha that steps, as those of `XRay` and `MaximumIntensity`, nothing is said.
    """
    volume = volume_of(volume)
    pipeline = _pipeline(tracer_of(tracer, volume), integrator, compositor)
    require_cuts(pipeline.tracer, near, far)
    rays = rays_of(origins, directions, volume, near, far)
    transfer = transfer_of(transfer, volume, pipeline.compositor)
    how = _how(pipeline, adjoint, engine, budget, volume)
    with refusing(how[1]):
        scene = bare(volume), rays, bare(transfer)
        last = offset_of(volume), background_of(background)
        rgba, bits = _render_rays(*how, *scene, *last)
    bits = volume.hold(bits)
    if status:
        return rgba, bits
    if is_concrete(bits):
        check(bits)
    return volume.unasked(rgba, bits)


def trace(
    volume: AbstractVolume,
    camera: HasRays | tuple[Any, Any],
    *,
    near: Any = None,
    far: Any = None,
    tracer: AbstractTracer | None = None,
    engine: AbstractEngine | None = None,
    budget: int | None = None,
    native: bool | None = None,
) -> Segments:
    """The segments along the rays of a camera, to be shaded as often as you like.

    Args:
      camera: a camera, or rays (origins, directions) with shapes (..., 3).
      near, far: as for `render_rays`; of a camera numbers or (height, width).
      engine, budget: as for `render`.
      native: deprecated: `engine=jaxvr.engine.C()` for True, `engine=jaxvr.engine.XLA()` for False.

    Returns:
      Segments, 8 bytes each in float32 (see `Segments`). They are constants: for gradients with
      respect to the mesh or the camera use `render`.

    Not for use inside `jit`: how many segments there are is known only when they are found.
    """
    if not is_concrete(*jax.tree.leaves((volume, camera))):
        raise ValueError(
            "trace cannot run inside jit or grad, since the number of segments decides the shape "
            "of its result. Call it outside and pass its result in, or use render."
        )
    volume = volume_of(volume)
    tracer = tracer_of(tracer, volume)
    require_cuts(tracer, near, far)
    if is_rays(camera):
        rays = rays_of(*camera, volume, near, far)
        shape, order = rays.origins.shape[:-1], np.arange(rays.origins.size // 3)
    else:
        view = camera_of(camera, volume)
        shape, order = (view.height, view.width), tile_order(view.height, view.width)
        rays = between(*view.local_rays(), near, far)
    rays = jax.tree.map(lambda x: x[order], flat(rays))
    if native is not None:
        warn(deprecated(f"trace(native={native})", native), DeprecationWarning)
        if engine is not None:
            raise ValueError("Pass engine=, or native=, which is deprecated, but not both.")
        engine = C() if native else XLA()
    engine = engine_of(engine, None, Pipeline(tracer, None, None), volume.dtype)
    how = (with_leaves_of("tracer", tracer, volume.dtype), engine, _batch_size(budget, volume))
    offset, volume = volume.offset, bare(volume)
    counts, status = _count(*how, volume, rays)
    check(status)
    # Rays of like length together: then no ray of a batch waits for the others when shaded.
    by_length = np.argsort(np.asarray(counts), kind="stable")
    counts, status, order = np.asarray(counts)[by_length], status[by_length], order[by_length]
    rays = jax.tree.map(lambda x: x[by_length], rays)
    start = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
    if start[-1] >= 2**31:
        raise ValueError(f"{start[-1]} nodes do not fit 32-bit indices. Trace fewer rays at once.")
    # Buffers are rounded up to three leading bits, so that similar views share compiled functions.
    unit = 1 << max(int(start[-1]).bit_length() - 3, 10)
    total = -(-max(int(start[-1]), 1) // unit) * unit
    runs = start[:-1].astype(np.int32)
    nodes = _fill(*how, volume, rays, runs, total)
    return Segments(
        nodes.scalar,
        nodes.length,
        jnp.asarray(start, jnp.int32),
        jnp.asarray(status),
        jnp.asarray(order, jnp.int32),
        shape=tuple(shape),
        offset=offset,
    )


def shade(
    segments: Segments,
    transfer: TransferFunction | None,
    *,
    integrator: AbstractIntegrator | None = None,
    compositor: AbstractCompositor | None = None,
    adjoint: AbstractAdjoint | None = None,
    engine: AbstractEngine | None = None,
    background: Any = None,
    budget: int | None = None,
) -> Array:
    """The image of traced segments: what `render` gives, without the walk.

    Args:
      segments: from `trace`, whose integers are not to be computed with: a ValueError, or under
        your own `jit` a picture of NaN. The rest as for `render`.

    Returns:
      image (height, width, 4), or (..., 4) for segments of rays. Differentiable in `transfer`,
      `segments.scalar`, `segments.length` and `background`.
    """
    segments = segments_of(segments)
    pipeline = _pipeline(Recorded(), integrator, compositor)
    transfer = transfer_of(transfer, segments, pipeline.compositor)
    how = _how(pipeline, adjoint, engine, budget, segments)
    with refusing(how[1]):
        last = offset_of(segments), background_of(background)
        image, bits = _shade(*how, bare(segments), bare(transfer), *last)
    if is_concrete(bits):
        check(bits)
    return unfit(segments, image)


def _how(
    pipeline: Pipeline, adjoint: Any, engine: Any, budget: Any, volume: Any
) -> tuple[Any, Any, Any, int]:
    """What a compiled function depends on beside shapes: nouns, the engine, rays at once."""
    adjoint, dtype = adjoint_of(adjoint), dtype_of(volume)
    engine = engine_of(engine, adjoint, pipeline, dtype)
    pipeline = at_the_door(pipeline, dtype)
    return pipeline, adjoint, engine, _batch_size(budget, volume)


def _pipeline(
    tracer: AbstractTracer,
    integrator: AbstractIntegrator | None,
    compositor: AbstractCompositor | None,
) -> Pipeline:
    """With what the compositor needs: segments from behind, if it goes back to front."""
    compositor = compositor_of(compositor)
    integrator = integrator_of(integrator, compositor)
    if compositor.backwards:
        tracer, integrator = tracer.reversed(), integrator.reversed()
    return Pipeline(tracer, integrator, compositor)


@compiled(1, 2, 3)
def _render(pipeline, adjoint, engine, size, volume, camera, transfer, offset, background):
    # Under a user's own jit operands may be constants: XLA must not compute with them itself.
    volume, camera = lax.optimization_barrier((volume, camera))
    height, width = camera.height, camera.width
    rays = Rays(*(tile(x) for x in camera.local_rays()))
    rgba, status = _run(pipeline, adjoint, engine, size, volume, rays, transfer, offset)
    seen = lax.stop_gradient(rgba[:, 3]).max()  # for `hints`; a background hides it
    rgba = _over(untile(rgba, height, width), background)
    return rgba, untile(status[:, None], height, width)[..., 0], seen


@compiled(1, 2, 3)
def _render_rays(pipeline, adjoint, engine, size, volume, rays, transfer, offset, background):
    shape = rays.origins.shape[:-1]
    volume, rays = lax.optimization_barrier((volume, rays))
    rgba, status = _run(pipeline, adjoint, engine, size, volume, flat(rays), transfer, offset)
    return _over(rgba, background).reshape(*shape, 4), status.reshape(shape)


@compiled(1, 2, 3)
def _shade(pipeline, adjoint, engine, size, segments, transfer, offset, background):
    segments = lax.optimization_barrier(segments)  # as above
    units = units_of(segments.length, segments.scalar, transfer.positions, parts=_PARTS)
    segments = dataclasses.replace(
        segments,
        length=segments.length * units.length,
        scalar=units.of_scalars(segments.scalar),
    )
    transfer = transfer_in(units, transfer)
    scene = pipeline.tracer.prepare(segments)
    # A batch is filled up with runs that are empty: a copy would add to the last run's gradient.
    runs, count = batches(size, Runs(segments.start[:-1], segments.start[1:]))
    number = np.arange(runs.first.size).reshape(runs.first.shape)
    runs = Runs(runs.first, jnp.where(number < count, runs.end, runs.first))
    rays = pipeline.tracer.prepare_rays(scene, runs)
    scale = Scale(units.scalar, units.length, offset)
    rgba = _finish(pipeline, adjoint, engine, scene, rays, transfer, scale, count)[0]
    rgba = jnp.zeros_like(rgba).at[segments.order].set(rgba, unique_indices=True)
    return _over(rgba, background).reshape(*segments.shape, 4), units.status


@compiled(1, 2)
def _count(tracer, engine, size, volume, rays):
    units = units_in(volume)
    volume, rays = volume_in(units, volume), rays_in(units, rays)
    scene = tracer.prepare(volume)
    rays, count = batches(size, rays)
    rays = jax.vmap(partial(tracer.prepare_rays, scene))(rays)
    number, status = (x.reshape(-1)[:count] for x in engine.count(tracer, scene, rays))
    return number, status | units.status


@compiled(1, 2, 6)
def _fill(tracer, engine, size, volume, rays, start, total):
    units = units_in(volume)
    volume, rays = volume_in(units, volume), rays_in(units, rays)
    scene = tracer.prepare(volume)
    rays, _ = batches(size, rays)
    rays = jax.vmap(partial(tracer.prepare_rays, scene))(rays)
    nodes = engine.fill(tracer, scene, rays, start, total)
    return Nodes(nodes.scalar / units.scalar, nodes.length / units.length)


def _run(pipeline, adjoint, engine, size, volume, given, transfer, offset):
    """rgba (R, 4) and status (R,) of R rays."""
    units = units_in(volume, transfer.positions)
    volume, given = volume_in(units, volume), rays_in(units, given)
    transfer = transfer_in(units, transfer)
    scene = pipeline.tracer.prepare(volume)
    rays, count = batches(size, given)
    rays = jax.vmap(partial(pipeline.tracer.prepare_rays, scene))(rays)
    scale = Scale(units.scalar, units.length, offset)
    rgba, status = _finish(pipeline, adjoint, engine, scene, rays, transfer, scale, count)
    for end in (given.near, given.far):
        if end is not None:
            rgba = jnp.where(jnp.isnan(end)[:, None], jnp.nan, rgba)
    good = are_rays(given.origins.T, given.directions.T)
    status = jnp.where(good, status, status | LOST)
    good = volume.in_range(engine.confirms_cells)
    return rgba, jnp.where(good, status, BROKEN) | units.status


def _finish(pipeline, adjoint, engine, scene, rays, transfer, scale, count):
    nouns = (pipeline.tracer, pipeline.integrator, pipeline.compositor)
    pipeline = Pipeline(*map(refusing_derivatives, nouns))
    longest = pipeline.tracer.longest(scene)
    longest = None if longest is None else lax.stop_gradient(longest)
    table = pipeline.integrator.prepare(transfer, transfer.positions.dtype, longest)
    state, status = adjoint.run(pipeline, Operands(scene, rays, table), engine)
    compositor = pipeline.compositor
    shown = transfer if "transfer" in compositor.needs else None
    rgba = jax.vmap(lambda state: compositor.finish(state, shown, scale))(state)
    return jnp.moveaxis(rgba, 1, 2).reshape(-1, 4)[:count], status.reshape(-1)[:count]


def _batch_size(budget: Any, volume: Any) -> int:
    """Rays that march at once."""
    dtype = np.dtype(dtype_of(volume))
    if budget is None:
        return batch_size(dtype) if jax.default_backend() == "cpu" else ACCELERATOR_BATCH
    if not isinstance(budget, int | float | np.number) or not 1 <= budget < math.inf:
        raise ValueError(f"budget must be a number of bytes, at least 1, but is {budget!r}.")
    return max(int(budget) // (NUMBERS_PER_RAY * dtype.itemsize), 1)


def _over(rgba: Array, background: Array | None) -> Array:
    if background is None:
        return rgba
    behind = jnp.concatenate([background.astype(rgba.dtype), jnp.ones(1, rgba.dtype)])
    return rgba + (1 - rgba[..., 3:]) * behind.reshape((1,) * (rgba.ndim - 1) + (4,))
