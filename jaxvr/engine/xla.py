"""XLA's own loops, written in JAX: the readable reference, and what accelerators run."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jax import lax

from jaxvr.adjoint.base import (
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
        tracer, integrator = pipeline.tracer, pipeline.integrator
        scene_bar, rays_bar, table_bar = _walk_again(pipeline, operands, final, cotangent, asked)
        if table_bar is not None:
            table_bar = integrator.gradient_finish(operands.table, table_bar)
        return Operands(tracer.scene_cotangent(operands.scene, scene_bar), rays_bar, table_bar)

    def count(self, tracer, scene, rays):
        return record(tracer, scene, rays)

    def fill(self, tracer, scene, rays, start, total):
        shape = jax.tree.leaves(rays)[0].shape
        start = jnp.pad(start, (0, shape[0] * shape[1] - start.shape[0]), mode="edge")
        return fill(tracer, scene, rays, start.reshape(shape), total)


def _walk_again(
    pipeline: Pipeline,
    operands: Operands,
    finals: Any,
    state_bar: Any,
    asked: Operands,
) -> tuple[Any, Any, Any]:
    """Gradients of the scene and the table as they are accumulated, and cotangents of the rays."""
    tracer, integrator, compositor = pipeline.tracer, pipeline.integrator, pipeline.compositor
    geometric = any(jax.tree.leaves((asked.scene, asked.rays)))
    optical = any(jax.tree.leaves(asked.table))

    def batch(carry, inputs):
        scene_bar, table_bar = carry
        rays, final, pixel_bar = inputs
        one = operands._replace(rays=rays)
        _, rays_bar = tracer.gradient_start(one.scene, rays, (asked.scene, asked.rays))

        def body(loop):
            march, table_bar, trace_bar = loop
            pixel, cursor, finished, piece, cut = shade_piece(pipeline, one, march)
            segment, live = march.trace.segment, march.trace.active
            bar = compositor.pull_back(piece, march.pixel, pixel, final, pixel_bar)
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
            if geometric:
                trace_bar = tracer.pull_back(one.scene, rays, march.trace, segment_bar, trace_bar)
            march = advance(pipeline, one, March(march.trace, cursor, pixel), finished)
            return march, table_bar, trace_bar

        # A small table's gradient is summed batch by batch first: a sum of millions of terms in
        # float32 is then ten times as exact. A large one would cost more to clear than to add to.
        own = small and integrator.gradient_start(operands.table)
        loop = (begin(pipeline, one), own if small else table_bar, (scene_bar, rays_bar))
        loop = lax.while_loop(lambda loop: busy(loop[0]), body, loop)
        _, own, (scene_bar, rays_bar) = loop
        table_bar = jax.tree.map(jnp.add, table_bar, own) if small else own
        return (scene_bar, table_bar), tracer.rays_cotangent(rays, rays_bar)

    first = jax.tree.map(lambda x: x[0], operands.rays)
    scene_bar, _ = tracer.gradient_start(operands.scene, first, (asked.scene, asked.rays))
    table_bar = integrator.gradient_start(operands.table) if optical else None
    small = optical and sum(x.size for x in jax.tree.leaves(table_bar)) <= _SMALL_TABLE
    (scene_bar, table_bar), rays_bar = lax.scan(
        batch, (scene_bar, table_bar), (operands.rays, finals, state_bar)
    )
    return scene_bar, rays_bar, table_bar


def _sum(a: Any, b: Any) -> Any:
    return a if b is None else jax.tree.map(jnp.add, a, b)
