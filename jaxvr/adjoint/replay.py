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

from jaxvr._core.modes import constant, reverse_only
from jaxvr._core.warn import warn
from jaxvr.adjoint.base import AbstractAdjoint, Operands, Pipeline

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
        return _replay(engine, pipeline, reverse_only(operands, _FORWARD_MODE))


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


@partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def _replay(engine: Any, pipeline: Pipeline, operands: Operands) -> tuple[Any, Array]:
    return _run(engine, pipeline, operands)


def _forward(engine: Any, pipeline: Pipeline, primals: Any):
    leaves, structure = jax.tree.flatten(
        primals, is_leaf=lambda x: isinstance(x, jax.custom_derivatives.CustomVJPPrimal)
    )
    operands = structure.unflatten([leaf.value for leaf in leaves])
    found = _run(engine, pipeline, constant(operands, _SECOND))
    return found, (operands, found[0], _flags([leaf.perturbed for leaf in leaves]))


def _backward(engine: Any, pipeline: Pipeline, residuals: Any, cotangents: Any):
    operands, finals, asked = residuals
    state_bar = jax.tree.map(_cotangent, finals, cotangents[0])
    structure = jax.tree.structure(operands)
    perturbed: Operands = jax.tree.unflatten(structure, [flag.shape[0] == 1 for flag in asked])
    optical = pipeline.compositor.shades and any(jax.tree.leaves(perturbed.table))
    perturbed = perturbed._replace(table=jax.tree.map(lambda _: optical, perturbed.table))
    # Where it is transparent, segments have no gradient, but the transfer function has.
    table = operands.table if optical else pipeline.integrator.shorten(operands.table, False)
    if not engine.traceable:
        state_bar = constant(state_bar, _SECOND)
    walked = operands._replace(table=table)
    bar = engine.pull_back(pipeline, walked, finals, state_bar, perturbed)
    return (Operands(*map(_as_cotangent, operands, bar)),)


def _cotangent(primal: Array, cotangent: Any) -> Array | None:
    """The cotangent of a leaf of the state; None for integers."""
    if not jnp.issubdtype(primal.dtype, jnp.floating):
        return None
    if isinstance(cotangent, jax.custom_derivatives.SymbolicZero):
        return jnp.zeros_like(primal)
    return cotangent


def _as_cotangent(primal: Any, bar: Any) -> Any:
    """The floats of `bar` at the float leaves of `primal`; zeros where there are none to put."""
    floats = [x for x in jax.tree.leaves(bar) if jnp.issubdtype(x.dtype, jnp.floating)]
    leaves, structure = jax.tree.flatten(primal)
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
    return structure.unflatten(out)


_replay.defvjp(_forward, _backward, symbolic_zeros=True)
