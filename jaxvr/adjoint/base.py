"""What an adjoint is, and the march along rays that all of them share.

One iteration takes the piece at each ray's cursor, composites it, and moves the rays whose segment
is finished to their next. A ray that needs nothing from behind, as the compositor says, stops at
the end of its segment, with every adjoint alike. Rays in a batch go in lock step; a batch ends with
its last ray.
"""

from __future__ import annotations

import abc
import contextlib
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxvr._core.modes import custom_vjp_refused
from jaxvr._core.pytree import noun
from jaxvr.composite.base import AbstractCompositor, Piece
from jaxvr.optics.integrator import AbstractIntegrator
from jaxvr.optics.partition import Cursor
from jaxvr.trace.base import AbstractTracer

Array = jax.Array


@noun
class Pipeline:
    """What renders: nouns, whose numbers are its leaves. integrator, compositor: None where
    segments are only recorded."""

    tracer: AbstractTracer
    integrator: AbstractIntegrator | Any
    compositor: AbstractCompositor | Any


class Operands(NamedTuple):
    """What it renders: pytrees of arrays. Leaves of `rays` have the shape (batches, R)."""

    scene: Any
    rays: Any
    table: Any


class Asked(NamedTuple):
    """What cotangents are wanted of. scene, rays, table: bools in place of leaves of `Operands`.
    integrator, compositor: whether those of their own numbers are."""

    scene: Any
    rays: Any
    table: Any
    integrator: bool
    compositor: bool


class Cotangents(NamedTuple):
    """Of operands and of nouns, each in the form of what it is of, with anything in place of
    integers and of what is not asked for; None for a part of which nothing is."""

    scene: Any
    rays: Any
    table: Any
    integrator: Any
    compositor: Any


class March(NamedTuple):
    """The state of a batch of R rays."""

    trace: Any
    cursor: Cursor
    pixel: Any


class AbstractAdjoint(abc.ABC):
    """Says how what an engine runs is differentiated.

    no_forward_mode: one with a `custom_vjp` says here what gives forward mode instead.
    """

    no_forward_mode: ClassVar[str | None] = None

    def refuses(self, engine: Any) -> str | None:
        """None where it can work with an engine, else why not: a sentence for users."""
        return None

    @abc.abstractmethod
    def run(self, pipeline: Pipeline, operands: Operands, engine: Any) -> tuple[Any, Array]:
        """The compositor's state at the end of each ray, leaves (batches, ..., R), and status
        (batches, R). What `finish` makes of the state is differentiated by JAX.

        engine: an `AbstractEngine`, which runs the loops.
        """


def traced_only(adjoint: Any, engine: Any) -> str | None:
    """`AbstractAdjoint.refuses` of one that leaves all derivatives to JAX."""
    if engine.traceable:
        return None
    return (
        f"{type(adjoint).__name__} has JAX differentiate the loop along the rays, and this "
        "engine's is not written in JAX: take engine=jaxvr.engine.XLA(), or adjoint=jaxvr.Replay()."
    )


def refusing(adjoint: Any) -> contextlib.AbstractContextManager[None]:
    """Round a call of a compiled function with that adjoint, or a user's own, which needs no base:
    errors of derivatives that it cannot give are in its words."""
    return custom_vjp_refused(getattr(adjoint, "no_forward_mode", None))


def begin(pipeline: Pipeline, operands: Operands) -> March:
    """All rays before their first segment. Here and below, `operands.rays` is one batch (R,)."""
    trace = pipeline.tracer.start(operands.scene, operands.rays)
    front = trace.segment.front
    cursor = pipeline.integrator.start(operands.table, front)
    return March(trace, cursor, pipeline.compositor.init(front.shape[0], front.dtype))


def busy(march: March) -> Array:
    return jnp.any(march.trace.active | march.trace.waiting)


def shade_piece(pipeline: Pipeline, operands: Operands, march: March):
    """Composites the current pieces: the pixel behind them, the cursor, what is finished, the
    pieces, and what the integrator wants to know of them."""
    with jax.named_scope("shade"):
        segment = march.trace.segment
        rgb, depth, cursor, finished, cut = pipeline.integrator.step(
            operands.table, segment, march.cursor
        )
        live = march.trace.active
        piece = Piece(
            jnp.where(live[None], rgb, 0), jnp.where(live, depth, 0), segment, live & finished
        )
        piece = piece.only(pipeline.compositor.needs)
        pixel = pipeline.compositor.add(march.pixel, piece)
    return pixel, cursor, finished, piece, cut


def advance(pipeline: Pipeline, operands: Operands, march: March, finished: Array) -> March:
    """The next segments of finished and waiting rays, with cursors at their starts.

    Args:
      march: pixel and cursor are those behind the current pieces. finished (R,): by these pieces.
    """
    trace, cursor, pixel = march
    ended = pipeline.compositor.done(pixel)
    if ended is not None:
        # Not inside of a segment: the derivative with respect to where a piece ends is left out,
        # since it cancels between the pieces of a segment (see `optics.partition`).
        trace = trace._replace(active=trace.active & ~(ended & finished))
    idle = ~trace.active
    trace = pipeline.tracer.step(operands.scene, operands.rays, trace, finished)
    front = lax.stop_gradient(trace.segment.front)
    cursor = Cursor(jnp.where(finished | idle, front, cursor.scalar), cursor.slab)

    def found(cursor: Cursor) -> Cursor:
        anew = pipeline.integrator.start(operands.table, front)
        return jax.tree.map(lambda a, b: jnp.where(trace.fresh, a, b), anew, cursor)

    cursor = lax.cond(jnp.any(trace.fresh), found, lambda c: c, cursor)
    return March(trace, cursor, pixel)


def iterate(pipeline: Pipeline, operands: Operands, march: March) -> March:
    pixel, cursor, finished, *_ = shade_piece(pipeline, operands, march)
    return advance(pipeline, operands, March(march.trace, cursor, pixel), finished)


def march_while(pipeline: Pipeline, operands: Operands) -> March:
    """One batch, by a while loop: as many iterations as its longest ray needs."""
    return lax.while_loop(busy, lambda m: iterate(pipeline, operands, m), begin(pipeline, operands))


def result(march: March) -> tuple[Any, Array]:
    """What `run` gives, of one batch."""
    return march.pixel, march.trace.status


def run_batches(one: Any, operands: Operands) -> tuple[Any, Array]:
    """`one(operands with one batch of rays)` for each batch, one after the other."""
    return lax.map(lambda rays: one(operands._replace(rays=rays)), operands.rays)
