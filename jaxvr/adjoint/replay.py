"""Reverse mode at constant memory: the rays are walked again.

The forward pass keeps its operands and each ray's final sums, nothing along the ray. The backward
pass makes the same walk with the same arithmetic, front to back. At a piece with colour c_i and
depth S_i, the light from behind is the final sum minus the prefix (see `composite.over`), so the
piece's cotangents are known there and then; they are pulled back through the slab integral to the
slab's two control points and to the segment, and through the segment to the cell's four vertices
and the ray. Only such local operands are differentiated, and their cotangents are scattered.

Where the transfer function is transparent, light is neither added nor lost: the forward pass takes
such a stretch in one piece, whatever control points lie in it. The backward pass does so only if no
gradient of the transfer function is asked for, since extinction has one at 0 too.

What a gradient is asked for is known to the forward rule alone, and the backward rule has to be
told. JAX traces the forward rule once for each pattern of perturbed operands and keeps those
traces, but of the *structure* of residuals, of their number, and of which of them are operands, it
keeps what the trace made last had. So these may depend on nothing but the structure of the
arguments: a flag there would be read by pullbacks of other patterns, whose gradients then are 0
without a word. Flags travel as shapes of empty arrays, which belong to the trace itself.

Path replay is due to Vicini, Speierer and Jakob 2021 (doi:10.1145/3450626.3459804); unlike theirs
and DiffDVR's (Weiss and Westermann 2021, doi:10.1109/TVCG.2021.3114769) it divides by no
transmittance: an opaque cell is no singularity.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxvr import native
from jaxvr._core.modes import constant, reverse_only
from jaxvr.adjoint.base import (
    AbstractAdjoint,
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

Array = jax.Array

_FORWARD_MODE = (
    "Replay gives reverse mode (grad, vjp, jacrev) only. For forward mode (jvp, jacfwd, linearize) "
    "render with adjoint=Forward(), or with adjoint=Direct(max_steps) on small problems."
)
_SECOND = (
    "Replay gives first derivatives only. Second ones by colours and extinctions are given by "
    "adjoint=Direct(max_steps) in any mode, and by adjoint=Forward() in forward mode (jvp of jvp)."
)

# Numbers in a table whose gradient is summed batch by batch.
_SMALL_TABLE = 1 << 16


@dataclasses.dataclass(frozen=True)
class Replay(AbstractAdjoint):
    """Reverse mode (`grad`, `vjp`, `value_and_grad`); forward mode is an error.

    Memory: the result, its operands, and one gradient; it does not grow with cells per ray. Time:
    the render plus a walk that also differentiates, about two to four renders for the transfer
    function. Gradients that are not asked for are not computed. First derivatives only.

    native: whether to use compiled loops (see `jaxvr.native`); None for where they can be used.
        That is asked at every call of `render` and its like, outside of their own `jit`; under
        yours it is asked while tracing, and the answer is compiled in.
    """

    native: bool | None = None
    no_forward_mode: ClassVar[str] = _FORWARD_MODE

    def run(self, pipeline, operands):
        dtype = jax.tree.leaves(operands.table)[0].dtype
        nouns = (pipeline.tracer, pipeline.integrator, pipeline.compositor)
        compiled = native.covers(self.native, dtype, *nouns)
        return _replay(pipeline, compiled, reverse_only(operands, _FORWARD_MODE))


def _flags(asked: Sequence[bool]) -> tuple[Array, ...]:
    """Flags as the shapes (0 or 1, 0) of empty arrays: see the module. Two axes, so that a sharded
    loop has one to name."""
    return tuple(jnp.zeros((int(flag), 0), bool) for flag in asked)


def settle(adjoint: Any, pipeline: Pipeline, dtype: Any) -> Any:
    """The adjoint with the loops that serve decided on: a part of what a compiled function depends
    on, or a cached one would keep the answer that the environment and the backend gave once.

    dtype: of the volume. Raises ValueError as `native.covers`.
    """
    if not isinstance(adjoint, Replay):
        return adjoint
    nouns = (pipeline.tracer, pipeline.integrator, pipeline.compositor)
    return dataclasses.replace(adjoint, native=native.covers(adjoint.native, dtype, *nouns))


def _run(pipeline: Pipeline, compiled: bool, operands: Operands):
    operands = operands._replace(table=pipeline.integrator.shorten(operands.table, True))

    if compiled:
        pixel, status = native.kernels.composite(pipeline, operands)
        shape = jax.tree.leaves(operands.rays)[0].shape
        return jax.tree.map(lambda x: _by_batch(x, shape), pixel), status.reshape(shape)
    return run_batches(lambda one: result(march_while(pipeline, one)), operands)


def _by_batch(x: Array, shape: tuple[int, ...]) -> Array:
    """(..., N) of N rays as (batches, ..., R) of batches of R."""
    return jnp.moveaxis(x.reshape(*x.shape[:-1], *shape), -2, 0)


def _flat(x: Array) -> Array:
    """Back again."""
    return jnp.moveaxis(x, 0, -2).reshape(*x.shape[1:-1], -1)


@partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def _replay(pipeline: Pipeline, compiled: bool, operands: Operands) -> tuple[Any, Array]:
    return _run(pipeline, compiled, operands)


def _forward(pipeline: Pipeline, compiled: bool, primals: Any):
    leaves, structure = jax.tree.flatten(
        primals, is_leaf=lambda x: isinstance(x, jax.custom_derivatives.CustomVJPPrimal)
    )
    operands = structure.unflatten([leaf.value for leaf in leaves])
    found = _run(pipeline, compiled, constant(operands, _SECOND))
    return found, (operands, found[0], _flags([leaf.perturbed for leaf in leaves]))


def _backward(pipeline: Pipeline, compiled: bool, residuals: Any, cotangents: Any):
    operands, finals, asked = residuals
    state_bar = jax.tree.map(_cotangent, finals, cotangents[0])
    integrator = pipeline.integrator
    structure = jax.tree.structure(operands)
    perturbed: Operands = jax.tree.unflatten(structure, [flag.shape[0] == 1 for flag in asked])
    tracer = reverse_of(pipeline.tracer, _is_geometric(perturbed))
    optical = pipeline.compositor.shades and any(jax.tree.leaves(perturbed.table))
    # Where it is transparent, segments have no gradient, but the transfer function has.
    table = operands.table if optical else integrator.shorten(operands.table, False)
    if compiled:
        state_bar = constant(state_bar, _SECOND)
        scene_bar, rays_bar, table_bar = native.kernels.pull_back(
            *(pipeline, operands._replace(table=table)),
            final=jax.tree.map(_flat, finals),
            cotangent=jax.tree.map(_flat, state_bar),
            asked=(perturbed.scene, perturbed.rays, optical),
        )
        rays_bar = _floats(tracer.rays_cotangent(operands.rays, rays_bar))
    else:
        walked = operands._replace(table=table)
        scene_bar, rays_bar, table_bar = _walk_again(
            pipeline, walked, finals, state_bar, perturbed, optical
        )
    scene_bar = _floats(tracer.scene_cotangent(operands.scene, scene_bar))
    if optical:
        table_bar = integrator.gradient_finish(operands.table, table_bar)
    return (
        Operands(
            _as_cotangent(operands.scene, scene_bar),
            _as_cotangent(operands.rays, rays_bar),
            _as_cotangent(operands.table, _floats(table_bar)),
        ),
    )


def _is_geometric(perturbed: Operands) -> bool:
    return any(jax.tree.leaves((perturbed.scene, perturbed.rays)))


def _walk_again(
    pipeline: Pipeline,
    operands: Operands,
    finals: Any,
    state_bar: Any,
    perturbed: Operands,
    optical: bool,
) -> tuple[Any, list[Array], Any]:
    """Gradients of the scene and the table as they are accumulated, and cotangents of the rays."""
    integrator, compositor = pipeline.integrator, pipeline.compositor
    geometric = _is_geometric(perturbed)
    tracer = reverse_of(pipeline.tracer, geometric)

    def batch(carry, inputs):
        scene_bar, table_bar = carry
        rays, final, pixel_bar = inputs
        one = operands._replace(rays=rays)
        _, rays_bar = tracer.gradient_start(one.scene, rays, (perturbed.scene, perturbed.rays))

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
        return (scene_bar, table_bar), _floats(tracer.rays_cotangent(rays, rays_bar))

    first = jax.tree.map(lambda x: x[0], operands.rays)
    scene_bar, _ = tracer.gradient_start(operands.scene, first, (perturbed.scene, perturbed.rays))
    table_bar = integrator.gradient_start(operands.table) if optical else None
    small = optical and sum(x.size for x in jax.tree.leaves(table_bar)) <= _SMALL_TABLE
    (scene_bar, table_bar), rays_bar = lax.scan(
        batch, (scene_bar, table_bar), (operands.rays, finals, state_bar)
    )
    return scene_bar, rays_bar, table_bar


def _cotangent(primal: Array, cotangent: Any) -> Array | None:
    """The cotangent of a leaf of the state; None for integers."""
    if not jnp.issubdtype(primal.dtype, jnp.floating):
        return None
    if isinstance(cotangent, jax.custom_derivatives.SymbolicZero):
        return jnp.zeros_like(primal)
    return cotangent


def _sum(a: Any, b: Any) -> Any:
    return a if b is None else jax.tree.map(jnp.add, a, b)


def _floats(tree: Any) -> list[Array]:
    """The float leaves, in order."""
    return [x for x in jax.tree.leaves(tree) if jnp.issubdtype(x.dtype, jnp.floating)]


def _as_cotangent(primal: Any, floats: list[Array]) -> Any:
    """Puts cotangents at the float leaves of `primal`; zeros where there are none to put."""
    leaves, structure = jax.tree.flatten(primal)
    source = iter(floats)
    out = []
    for leaf in leaves:
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            out.append(np.zeros(leaf.shape, jax.dtypes.float0))
        else:
            out.append(next(source) if floats else jnp.zeros_like(leaf))
    return structure.unflatten(out)


_replay.defvjp(_forward, _backward, symbolic_zeros=True)
