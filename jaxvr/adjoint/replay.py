"""Reverse mode at constant memory: the rays are walked again.

The forward pass keeps its operands and each ray's final sums, nothing along the ray. The backward
pass makes the same walk with the same arithmetic, front to back. At a piece with colour c_i and
depth S_i, the light from behind is the final sum minus the prefix (see `composite.over`), so the
piece's cotangents are known there and then; they are pulled back through the slab integral to the
slab's two control points and to the segment, and through the segment to the cell's four vertices
and the ray. Only such local operands are differentiated, and their cotangents are scattered.
Numbers of the integrator's and the compositor's own are operands of every piece: their cotangents
are summed.

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

from jaxvr._core.modes import constant, reverse_only
from jaxvr._core.warn import warn
from jaxvr.adjoint.base import AbstractAdjoint, Asked, Operands, Pipeline

Array = jax.Array

_FORWARD_MODE = (
    "Replay gives reverse mode (grad, vjp, jacrev) only. For forward mode (jvp, jacfwd, linearize) "
    "render with adjoint=Forward(), or with adjoint=Direct(max_steps) on small problems."
)
_SECOND = (
    "Replay gives first derivatives only. Second ones by colours and extinctions are given by "
    "adjoint=Direct(max_steps) in any mode, and by adjoint=Forward() in forward mode (jvp of jvp)."
)


@dataclasses.dataclass(frozen=True)
class Replay(AbstractAdjoint):
    """Reverse mode (`grad`, `vjp`, `value_and_grad`); forward mode is an error.

    Memory: the result, its operands, and one gradient; it does not grow with cells per ray. Time:
    the render plus a walk that also differentiates, about two to four renders for the transfer
    function. Gradients that are not asked for are not computed. First derivatives only.

    native: deprecated: pass `engine=jaxvr.engine.C()` for True, `engine=jaxvr.engine.XLA()` for
        False, to `render` and its like.
    """

    native: bool | None = None
    no_forward_mode: ClassVar[str] = _FORWARD_MODE

    def __post_init__(self):
        if self.native is not None:
            warn(deprecated(f"Replay(native={self.native})", self.native), DeprecationWarning)

    def run(self, pipeline, operands, engine):
        leaves, structure = jax.tree.flatten((pipeline, operands))
        return _replay(engine, structure, reverse_only(tuple(leaves), _FORWARD_MODE))


def deprecated(given: str, native: bool) -> str:
    """What is said of an argument that named compiled loops (True) or JAX's own."""
    name = "C" if native else "XLA"
    return f"{given} is deprecated: pass engine=jaxvr.engine.{name}() to render and its like."


def _flags(asked: Sequence[bool]) -> tuple[Array, ...]:
    """Flags as the shapes (0 or 1, 0) of empty arrays: see the module. Two axes, so that a sharded
    loop has one to name."""
    return tuple(jnp.zeros((int(flag), 0), bool) for flag in asked)


def _run(engine: Any, pipeline: Pipeline, operands: Operands):
    operands = operands._replace(table=pipeline.integrator.shorten(operands.table, True))
    return engine.march(pipeline, operands)


# The leaves of (pipeline, operands) go in flat: JAX would rebuild nouns of users with its own
# objects in place of numbers, which their constructors may refuse.
@partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def _replay(engine: Any, structure: Any, leaves: tuple[Array, ...]) -> tuple[Any, Array]:
    return _run(engine, *structure.unflatten(leaves))


def _forward(engine: Any, structure: Any, primals: Any):
    leaves = tuple(leaf.value for leaf in primals)
    found = _run(engine, *structure.unflatten(constant(leaves, _SECOND)))
    return found, (leaves, found[0], _flags([leaf.perturbed for leaf in primals]))


def _backward(engine: Any, structure: Any, residuals: Any, cotangents: Any):
    leaves, finals, flags = residuals
    state_bar = jax.tree.map(_cotangent, finals, cotangents[0])
    pipeline, operands = structure.unflatten(leaves)
    nouns = (pipeline.tracer, pipeline.integrator, pipeline.compositor)
    asked = _asked(pipeline, operands, [flag.shape[0] == 1 for flag in flags])
    # Where it is transparent, segments have no gradient, but the transfer function has.
    optical = any(jax.tree.leaves(asked.table)) or asked.integrator
    table = operands.table if optical else pipeline.integrator.shorten(operands.table, False)
    if not engine.traceable:
        state_bar = constant(state_bar, _SECOND)
    walked = operands._replace(table=table)
    bar = engine.pull_back(pipeline, walked, finals, state_bar, asked)
    for noun, own, wanted in zip(nouns[1:], bar[3:], asked[3:], strict=True):
        if wanted and own is None:
            raise TypeError(
                f"{type(engine).__name__}'s pull_back gives no derivative by the numbers of "
                f"{type(noun).__name__}: take engine=jaxvr.engine.XLA()."
            )
    found = [_as_cotangent(nouns[0], None)]
    found += map(_as_cotangent, (*nouns[1:], *operands), (*bar[3:], *bar[:3]))
    return (tuple(leaf for part in found for leaf in part),)


def _asked(pipeline: Pipeline, operands: Operands, perturbed: list[bool]) -> Asked:
    """From bools for the leaves of both.

    Raises TypeError where derivatives are asked for that no walk gives.
    """
    tracer, integrator, compositor = (
        [perturbed.pop(0) for _ in jax.tree.leaves(noun)]
        for noun in (pipeline.tracer, pipeline.integrator, pipeline.compositor)
    )
    scene, rays, table = jax.tree.unflatten(jax.tree.structure(operands), perturbed)
    first = jax.tree.map(lambda x: x[0], operands.rays)

    def refuse(noun: Any, where: str, instead: str) -> None:
        raise TypeError(
            f"Replay gives no derivatives by numbers of {type(noun).__name__} that its {where} "
            f"uses: {instead}, or render with adjoint=Direct(max_steps)."
        )

    def moves(noun: Any) -> Any:
        state = noun.start(operands.scene, first)
        return noun.step(operands.scene, first, state, state.active)

    if any(tracer) and _uses(moves, pipeline.tracer, tracer):
        refuse(pipeline.tracer, "start or step", "hand them on in the scene, by prepare")
    dtype = jax.tree.leaves(operands.table)[0].dtype
    count = jax.tree.leaves(first)[0].shape[-1]
    if any(compositor) and _uses(lambda c: c.init(count, dtype), pipeline.compositor, compositor):
        refuse(pipeline.compositor, "init", "use them in add or finish")
    optical = pipeline.compositor.shades and any(jax.tree.leaves(table))
    table = jax.tree.map(lambda _: optical, table)
    return Asked(
        scene, rays, table, pipeline.compositor.shades and any(integrator), any(compositor)
    )


def _uses(function: Any, noun: Any, asked: list[bool]) -> bool:
    """Whether a function of a noun computes with those of its numbers."""
    leaves, structure = jax.tree.flatten(noun)
    traced = jax.make_jaxpr(lambda *x: function(structure.unflatten(x)))(*leaves).jaxpr
    wanted = [v for v, a in zip(traced.invars, asked, strict=True) if a]
    read = [v for equation in traced.eqns for v in equation.invars] + list(traced.outvars)
    return any(v is w for v in read for w in wanted)


def _cotangent(primal: Array, cotangent: Any) -> Array | None:
    """The cotangent of a leaf of the state; None for integers."""
    if not jnp.issubdtype(primal.dtype, jnp.floating):
        return None
    if isinstance(cotangent, jax.custom_derivatives.SymbolicZero):
        return jnp.zeros_like(primal)
    return cotangent


def _as_cotangent(primal: Any, bar: Any) -> list[Any]:
    """Of the leaves of `primal`: the floats of `bar` for floats, zeros where there are none."""
    floats = [x for x in jax.tree.leaves(bar) if jnp.issubdtype(x.dtype, jnp.floating)]
    leaves = jax.tree.leaves(primal)
    wanted = sum(jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in leaves)
    if floats and len(floats) != wanted:
        raise ValueError(
            f"An engine's pull_back gave {len(floats)} cotangents for {wanted} float arrays: give "
            "one for each, or None for all of them."
        )
    source = iter(floats)
    out = []
    for leaf in leaves:
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            out.append(np.zeros(leaf.shape, jax.dtypes.float0))
        else:
            out.append(next(source) if floats else jnp.zeros_like(leaf))
    return out


_replay.defvjp(_forward, _backward, symbolic_zeros=True)
