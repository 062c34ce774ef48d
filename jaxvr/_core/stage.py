"""Stages of a loop body: where intermediates are written down."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax


def stage(wanted: jax.Array, function: Callable[..., Any], *operands: Any) -> Any:
    """`function(*operands)` if `wanted` (a bool scalar), else zeros; in kernels of its own.

    For what it skips, and for what it keeps apart: XLA's CPU backend gives each fused kernel one
    output and repeats in it whatever leads there, so that a loop body without such borders had its
    exit test compiled into seventeen kernels, and ran ten times slower. Operands and results of a
    conditional are stored. (An optimization barrier is dissolved before kernels are formed.)
    """
    shapes = jax.eval_shape(function, *operands)

    def nothing(*_: Any) -> Any:
        return jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)

    return lax.cond(wanted, function, nothing, *operands)
