"""`fit`: the transfer function that makes a volume look as it does in given pictures.

As in DiffDVR (Weiss and Westermann, "Differentiable direct volume rendering", 2021), a gradient
descent through the renderer on a loss between images, with colours behind a sigmoid and
extinctions behind a softplus. Unlike there, segments are exact, and they are found once: with fixed
views they do not depend on what is fitted, so that an iteration only shades (`cache=True`).
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxvr import hints
from jaxvr._core.checks import require_kind
from jaxvr._core.pytree import noun, static
from jaxvr._core.status import check
from jaxvr.adjoint import AbstractAdjoint, Pipeline
from jaxvr.arguments import (
    adjoint_of,
    at_the_door,
    background_of,
    compositor_of,
    engine_of,
    integrator_of,
    require_positions,
    tracer_of,
    volume_of,
)
from jaxvr.composite import AbstractCompositor
from jaxvr.engine import AbstractEngine
from jaxvr.fit import digest
from jaxvr.fit.batches import Batch, Views, deal, gather_views, here, listed, make_batches
from jaxvr.fit.belongs import belongs
from jaxvr.fit.loop import Control, batch_number, prepare, run
from jaxvr.fit.losses import loss_of
from jaxvr.fit.losses import smoothness as roughness
from jaxvr.fit.parameters import Parameters
from jaxvr.fit.report import FitResult, likeness, number, timing
from jaxvr.fit.targets import look_at_targets, pictures_of
from jaxvr.optics import AbstractIntegrator, TransferFunction
from jaxvr.render import render_rays, shade
from jaxvr.trace import AbstractTracer, Recorded, Segments

if TYPE_CHECKING:  # it takes a while to import
    import optax

Array = jax.Array


def fit(
    transfer: TransferFunction,
    volume: Any,
    cameras: Any,
    targets: Any,
    *,
    free: Any = ("colors", "extinctions"),
    loss: Any = "l1",
    smoothness: Any = 0.0,
    smoothness_extinctions: Any = 0.0,
    optimizer: optax.GradientTransformation | None = None,
    learning_rate: Any = 0.1,
    iterations: int = 200,
    rays: int | None = None,
    views: int | None = None,
    seed: int = 0,
    background: Any = None,
    cache: bool = True,
    held_out: tuple[Any, Any] | None = None,
    progress: bool | None = None,
    callback: Callable[[int, float, TransferFunction], Any] | None = None,
    patience: int | None = None,
    tolerance: float = 1e-3,
    checkpoint: Any = None,
    checkpoint_every: int = 50,
    resume: bool = False,
    tracer: AbstractTracer | None = None,
    integrator: AbstractIntegrator | None = None,
    compositor: AbstractCompositor | None = None,
    adjoint: AbstractAdjoint | None = None,
    engine: AbstractEngine | None = None,
) -> FitResult:
    """Fits a transfer function to pictures of a volume.

    Args:
      transfer: the start (K control points). Extinctions of about the right size help: their mean
        is the size of the optimiser's steps. `jaxvr.fit.noise` makes a random one.
      volume: a `TetMesh`; None if all cameras are `Segments`.
      cameras: one or more `Camera`s, or `Segments` that `trace` gave for them (for several fits of
        the same views). Sizes may differ.
      targets: a picture for each camera, (height, width, 4) premultiplied linear RGBA floats, or
        (height, width, 3) on an opaque `background`; `jaxvr.load_image` reads them from files.
      free: which fields move: names among "colors", "extinctions", "positions", or a dict from
        names to transforms; see `jaxvr.fit.parameters`. Colours then lie in [0, 1], extinctions
        are >= 0, positions stay sorted and between the first and the last.
      loss: "l1", "l2", or a function of (predicted, target), both (rays, C), to a scalar.
      smoothness: weight of the mean squared difference of neighbouring colours (0.4 in DiffDVR):
        a number, or a schedule from iteration to number. smoothness_extinctions: of neighbouring
        extinctions, in units of the mean extinction of the start.
      optimizer: any of optax, on raw parameters; None is `optax.adam(learning_rate)`.
      learning_rate: of Adam: a number, or a schedule (such as `optax.cosine_decay_schedule`).
        0.8 is DiffDVR's; fits to high precision want a decay to 0.
      iterations: steps, one for each minibatch.
      rays: rays in a minibatch, at random from all views; None takes all. views: whole views in a
        minibatch instead.
      seed: of the minibatches. The result is a function of the arguments, bit for bit, on one
        machine.
      background: opaque linear RGB (3,) behind the volume; None leaves it transparent.
      cache: trace each view once and shade after, with 8 bytes of memory a segment (16 in
        float64). False renders at every iteration.
      held_out: (cameras, targets) that only the report looks at.
      progress, patience, tolerance, checkpoint, checkpoint_every, resume: as `fit_parameters`. What
        a checkpoint belongs to: the volume, the cameras, the targets, the start, what is free and
        its transforms, loss, smoothness, optimiser, background, seed, minibatches, cache, dtype,
        tracer, integrator, compositor, adjoint, engine, and all of it as one traced program.
      callback: called after every step with (iteration, loss, transfer); True ends the fit.
      tracer, integrator, compositor, adjoint, engine: as `render`.

    Returns:
      FitResult: transfer, loss_history, images, report(), save(folder).

    Raises:
      ValueError: for arguments that do not fit each other, what is free but not looked at by the
        compositor, targets of bytes, a checkpoint of another fit or none. FitError: if the loss
        becomes NaN or infinite. OSError: if no checkpoint can be written. RenderError: if a ray
        could not be followed.

    Warns with a `jaxvr.ViewWarning` of cameras that do not see the volume, of control points that
    do not lie where its field does, and of targets that no picture can reach; of checkpoints as
    `fit_parameters`.
    """
    require_kind("transfer", transfer, TransferFunction)
    pixels = compositor_of(compositor)
    _require_seen(pixels, free)
    given = integrator_of(integrator, pixels), pixels, adjoint_of(adjoint)
    nouns = (*given, tracer_of(tracer, None if volume is None else volume_of(volume)))
    begin = time.perf_counter()
    control = Control(
        *(iterations, seed, progress, patience, tolerance, checkpoint, checkpoint_every, resume)
    ).checked()
    prepare(control)
    background = background_of(background)
    cameras, targets = listed(cameras), pictures_of(targets)
    number_seen = len(cameras)
    if len(targets) != number_seen:
        raise ValueError(f"There are {number_seen} cameras, but {len(targets)} targets.")
    if volume is not None:
        hints.look_before_fit(volume, cameras, transfer, stacklevel=2)
    if held_out is not None:
        more, pictures_of_them = _pair(held_out)
        cameras, targets = cameras + listed(more), targets + pictures_of(pictures_of_them)
    every = gather_views(
        volume, cameras, targets, cache=cache, tracer=tracer, engine=engine, background=background
    )
    require_positions(transfer, cameras[0] if volume is None else volume)
    seen, unseen = every.parted(number_seen)
    dtype = seen.targets.dtype
    # A length to measure extinctions by, where the start has none.
    size = max(float(c.length.max()) for c in cameras) if volume is None else volume.diagonal()
    parameters = Parameters.of(transfer.astype(dtype), free, size)
    if pixels.needs & {"rgb", "transfer"}:  # else pictures are no colours, and have no bounds
        look_at_targets(seen.split(seen.targets), parameters, background)
    dealt = deal(seen, rays, views, seed)
    batches, places = make_batches(seen, dealt)
    objective = Objective(loss_of(loss), *_settled(nouns, engine, dtype, cache))
    weights = [_schedule(n, w) for n, w in _weights(smoothness, smoothness_extinctions)]
    mean = jnp.mean(parameters.transfer.extinctions)
    unit = jnp.where(mean > 0, mean, 1 / size).astype(dtype)
    fixed = parameters, unit, None if cache else here(volume), background

    def inputs(iteration: int) -> tuple[Any, ...]:
        batch = batches[batch_number(iteration, len(batches), seed)]
        now = np.asarray([w(iteration) for w in weights], dtype)
        return *fixed, batch, now

    transfer_of = jax.jit(Parameters.transfer_of)

    def told(iteration: int, value: float, raw: Any) -> Any:
        assert callback is not None
        return callback(iteration, value, transfer_of(parameters, raw))

    prepared = time.perf_counter() - begin
    named = {"free": list(parameters.transforms), "rays": len(places[0]), "loss": _name(loss)}
    about = belongs(
        {"verb": "fit", "cache": bool(cache), "dtype": str(dtype)}
        | {"engine": digest.plain(engine)}
        | named,
        objective,
        given,
        (volume, cameras[:number_seen], seen),
        (parameters, background),
        weights,
    )
    result = run(
        objective.gradient,
        parameters.raw(),
        inputs,
        len(batches),
        optimizer,
        learning_rate,
        control,
        told if callback is not None else None,
        about,
    )
    fitted = jax.tree.map(np.asarray, transfer_of(parameters, result.parameters))
    fitted = TransferFunction(
        fitted.positions, fitted.colors, fitted.extinctions, offset=fitted.offset
    )

    def pictures(views: Views, batches: Any, places: Any) -> list[np.ndarray]:
        flat = np.zeros((views.pixels, 4), dtype)
        for batch, place in zip(batches, places, strict=True):
            rgba, status = objective.predict(fitted, fixed[2], background, batch.rays)
            check(status)
            flat[place] = rgba
        return views.split(flat)

    images = pictures(seen, batches, places)
    others: list[np.ndarray] = []
    if unseen.pixels:
        # In batches of the same size, which the function just compiled takes.
        dealt = deal(unseen, len(places[0]), None, 0, fill=True)
        least = batches[0].rays.scalar.size if cache else 0
        others = pictures(unseen, *make_batches(unseen, dealt, least))
    numbers = {
        "control_points": fitted.positions.shape[0],
        "views": [list(s) for s in seen.shapes],
        "rays_per_iteration": len(places[0]),
        "settings": named
        | {
            "smoothness": _name(smoothness),
            "smoothness_extinctions": _name(smoothness_extinctions),
            "optimizer": "adam" if optimizer is None else "given",
            "learning_rate": _name(learning_rate) if optimizer is None else None,
            "iterations": int(iterations),
            "seed": int(seed),
            "cache": bool(cache),
            "dtype": str(dtype),
            "background": None if background is None else np.asarray(background).tolist(),
        },
        "cached_bytes": sum(b.rays.nbytes for b in batches) if cache else 0,
        "iterations": len(result.loss_history),
        "stopped": result.stopped,
        "loss": [number(x) for x in result.loss_history],
        "seconds": {"preparation": prepared} | timing(result),
        "fitted_views": likeness(images, seen.split(seen.targets)),
        "held_out": likeness(others, unseen.split(unseen.targets)) if others else [],
    }
    return FitResult(fitted, result.loss_history, images, others, result.stopped, numbers)


def _require_seen(compositor: AbstractCompositor, free: Any) -> None:
    """What is free is looked at: else it would stay where it is without a word."""
    needs = compositor.needs
    if not compositor.reads_transfer:
        raise ValueError(f"{compositor!r} does not look at the transfer function: nothing to fit.")
    names = [free] if isinstance(free, str) else list(free)
    for name, other, seen in (
        ("extinctions", "colors", compositor.shades),
        ("colors", "extinctions", bool(needs & {"rgb", "transfer"})),
    ):
        if name in names and not seen:
            raise ValueError(
                f"{compositor!r} does not look at {name}, and they would not move: leave them out "
                f"of free, as in free=({other!r},)."
            )


def _settled(nouns: Any, engine: Any, dtype: Any, cache: bool) -> tuple[Any, ...]:
    """The nouns, and the engine that serves, decided on before anything is compiled."""
    integrator, compositor, adjoint, tracer = nouns
    pipeline = Pipeline(Recorded() if cache else tracer, integrator, compositor)
    engine = engine_of(engine, adjoint, pipeline, dtype)
    pipeline = at_the_door(Pipeline(tracer, integrator, compositor), dtype)
    if getattr(adjoint, "native", None) is not None:  # deprecated, and answered
        adjoint = dataclasses.replace(adjoint, native=None)
    return pipeline.integrator, pipeline.compositor, adjoint, pipeline.tracer, engine


@noun
class Objective:
    """The loss of a batch under raw parameters; two of the same nouns compile once."""

    loss: Callable[[Array, Array], Array] = static()
    integrator: AbstractIntegrator
    compositor: AbstractCompositor
    adjoint: AbstractAdjoint = static()
    tracer: AbstractTracer
    engine: AbstractEngine = static()

    @property
    def gradient(self) -> Callable[..., Any]:
        """(raw, parameters, unit, volume, background, batch, weights (2,)) to
        ((loss, status bits), gradient of raw)."""
        return functools.partial(_gradient, self)

    def predict(self, transfer: Any, volume: Any, background: Any, rays: Any) -> tuple[Any, Any]:
        """Colours (R, 4) and status bits () or (R,)."""
        return _predict(self, transfer, volume, background, rays)


def _see(
    objective: Objective, transfer: TransferFunction, volume: Any, background: Any, rays: Any
) -> tuple[Array, Array]:
    nouns: dict[str, Any] = {
        "integrator": objective.integrator,
        "compositor": objective.compositor,
        "adjoint": objective.adjoint,
        "engine": objective.engine,
        "background": background,
    }
    if isinstance(rays, Segments):
        return shade(rays, transfer, **nouns), jnp.zeros((), jnp.int32)
    origins, directions = rays
    return render_rays(
        volume, origins, directions, transfer, tracer=objective.tracer, status=True, **nouns
    )


_predict = jax.jit(_see)


def _value(
    raw: Any,
    objective: Objective,
    parameters: Parameters,
    unit: Array,
    volume: Any,
    background: Any,
    batch: Batch,
    weights: Array,
) -> tuple[Array, Array]:
    transfer = parameters.transfer_of(raw)
    rgba, status = _see(objective, transfer, volume, background, batch.rays)
    loss = objective.loss(rgba[:, : batch.target.shape[1]], batch.target)
    prior = weights[0] * roughness(transfer.colors)
    prior = prior + weights[1] * roughness(transfer.extinctions / unit)
    return loss + prior, status


@jax.jit
def _gradient(objective: Objective, raw: Any, *rest: Any) -> Any:
    return jax.value_and_grad(_value, has_aux=True)(raw, objective, *rest)


def _pair(held_out: Any) -> tuple[Any, Any]:
    if not isinstance(held_out, tuple | list) or len(held_out) != 2:
        raise ValueError("held_out must be (cameras, targets).")
    return held_out[0], held_out[1]


def _weights(colors: Any, extinctions: Any) -> list[tuple[str, Any]]:
    return [("smoothness", colors), ("smoothness_extinctions", extinctions)]


def _schedule(name: str, weight: Any) -> Callable[[int], float]:
    if callable(weight):
        changing: Any = weight
        return lambda i: float(changing(i))
    if not isinstance(weight, int | float | np.number) or not 0 <= float(weight) < np.inf:
        raise ValueError(f"{name} must be a number >= 0 or a schedule, but is {weight!r}.")
    constant = float(weight)
    return lambda i: constant


def _name(x: Any) -> Any:
    return getattr(x, "__name__", type(x).__name__) if callable(x) else x
