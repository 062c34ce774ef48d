"""XLA's own loops, written in JAX: the readable reference, and what accelerators run."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jax import lax

from jaxvr.adjoint.base import (
    Asked,
    Cotangents,
    March,
    Operands,
    Pipeline,
    advance,
    begin,
    busy,
    march_while,
    result,
    run_batches,
    shade_piece,
)
from jaxvr.adjoint.by_rows import reverse_of
from jaxvr.engine.base import AbstractEngine
from jaxvr.trace.recorded import fill, record

Array = jax.Array

# Numbers in a table whose gradient is summed batch by batch.
_SMALL_TABLE = 1 << 16


@dataclasses.dataclass(frozen=True)
class XLA(AbstractEngine):
    """Loops that XLA compiles, for every noun and every device. Batches march one after the other,
    the rays of a batch in lock step."""

    traceable: ClassVar[bool] = True

    def refuses(self, pipeline, dtype):
        return None

    def march(self, pipeline, operands):
        return run_batches(lambda one: result(march_while(pipeline, one)), operands)

    def pull_back(self, pipeline, operands, final, cotangent, asked):
        geometric = any(jax.tree.leaves((asked.scene, asked.rays)))
        tracer, integrator = reverse_of(pipeline.tracer, geometric), pipeline.integrator
        bars = _walk_again(pipeline, operands, final, cotangent, asked)
        scene_bar = tracer.scene_cotangent(operands.scene, bars.scene)
        if bars.table is None:
            return bars._replace(scene=scene_bar)
        table_bar = integrator.gradient_finish(operands.table, bars.table)
        return bars._replace(scene=scene_bar, table=table_bar)

    def count(self, tracer, scene, rays):
        return record(tracer, scene, rays)

    def fill(self, tracer, scene, rays, start, total):
        batches, *_, size = jax.tree.leaves(rays)[0].shape
        start = jnp.pad(start, (0, batches * size - start.shape[0]), mode="edge")
        return fill(tracer, scene, rays, start.reshape(batches, size), total)


def _walk_again(
    pipeline: Pipeline, operands: Operands, finals: Any, state_bar: Any, asked: Asked
) -> Cotangents:
    """Gradients of the scene and the table as they are accumulated, the rest as it is to be."""
    integrator, compositor = pipeline.integrator, pipeline.compositor
    geometric = any(jax.tree.leaves((asked.scene, asked.rays)))
    tracer = reverse_of(pipeline.tracer, geometric)
    optical = any(jax.tree.leaves(asked.table))
    none_of_own = (
        _zeros(integrator) if asked.integrator else None,
        _zeros(compositor) if asked.compositor else None,
    )

    def batch(carry, inputs):
        scene_bar, table_bar, own_bar = carry
        rays, final, pixel_bar = inputs
        one = operands._replace(rays=rays)
        _, rays_bar = tracer.gradient_start(one.scene, rays, (asked.scene, asked.rays))

        def body(loop):
            march, table_bar, trace_bar, (by_integrator, by_compositor) = loop
            pixel, cursor, finished, piece, cut = shade_piece(pipeline, one, march)
            segment, live = march.trace.segment, march.trace.active
            bar, own = compositor.pull_back(piece, march.pixel, pixel, final, pixel_bar)
            by_compositor = _plus(by_compositor, own, compositor)
            segment_bar = bar.segment
            if compositor.shades:
                none = jnp.zeros_like(segment.length)
                piece_bar = (
                    jnp.stack([none] * 3) if bar.rgb is None else jnp.where(live, bar.rgb, 0),
                    none if bar.optical_depth is None else jnp.where(live, bar.optical_depth, 0),
                )
                by_light, table_bar = integrator.pull_back(
                    one.table, segment, cut, piece_bar, table_bar
                )
                segment_bar = _sum(by_light, segment_bar)
                if by_integrator is not None:

                    def light(own, march=march):
                        return own.step(one.table, march.trace.segment, march.cursor)[:2]

                    own = jax.vjp(light, integrator)[1](piece_bar)[0]
                    by_integrator = _plus(by_integrator, own, integrator)
            if geometric:
                trace_bar = tracer.pull_back(one.scene, rays, march.trace, segment_bar, trace_bar)
            march = advance(pipeline, one, March(march.trace, cursor, pixel), finished)
            return march, table_bar, trace_bar, (by_integrator, by_compositor)

        # A small table's gradient is summed batch by batch first: a sum of millions of terms in
        # float32 is then ten times as exact. A large one would cost more to clear than to add to.
        share = small and integrator.gradient_start(operands.table)
        start = begin(pipeline, one), share if small else table_bar
        loop = (*start, (scene_bar, rays_bar), none_of_own)
        loop = lax.while_loop(lambda loop: busy(loop[0]), body, loop)
        _, share, (scene_bar, rays_bar), more = loop
        table_bar = jax.tree.map(jnp.add, table_bar, share) if small else share
        own_bar = jax.tree.map(jnp.add, own_bar, more)
        return (scene_bar, table_bar, own_bar), tracer.rays_cotangent(rays, rays_bar)

    first = jax.tree.map(lambda x: x[0], operands.rays)
    scene_bar, _ = tracer.gradient_start(operands.scene, first, (asked.scene, asked.rays))
    table_bar = integrator.gradient_start(operands.table) if optical else None
    small = optical and sum(x.size for x in jax.tree.leaves(table_bar)) <= _SMALL_TABLE
    carry = scene_bar, table_bar, none_of_own
    carry, rays_bar = lax.scan(batch, carry, (operands.rays, finals, state_bar))
    scene_bar, table_bar, own_bar = carry
    return Cotangents(scene_bar, rays_bar, table_bar, *own_bar)


def _zeros(noun: Any) -> list[Array]:
    """Of the floats of a noun."""
    return [jnp.zeros_like(x) for x in _floats(noun)]


def _plus(sums: list[Array] | None, noun: Any, of: Any) -> list[Array] | None:
    """With the floats of one more; None where none are asked for. of: whose they are."""
    if sums is None:
        return None
    if noun is None:
        raise TypeError(
            f"{type(of).__name__}'s pull_back gives no cotangent of its own numbers, which a "
            "gradient is asked for by: give a compositor with cotangents in their place."
        )
    return [a + b for a, b in zip(sums, _floats(noun), strict=True)]


def _floats(tree: Any) -> list[Array]:
    return [x for x in jax.tree.leaves(tree) if jnp.issubdtype(x.dtype, jnp.floating)]


def _sum(a: Any, b: Any) -> Any:
    return a if b is None else jax.tree.map(jnp.add, a, b)
