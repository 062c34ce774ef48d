"""A change that is rarely made: where nothing is copied if it is not."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def once(wanted: jax.Array, function: Callable[..., Any], carry: Any, *operands: Any) -> Any:
    """`function(carry, *operands)` if `wanted` (a bool scalar), else `carry`.

    A conditional, but as a loop of at most one turn: XLA stores a loop's result where its operand
    was, while the idle branch of a conditional copies all that passes through it. Differentiable in
    both modes, by a conditional. `function` must not close over traced arrays.
    """

    def body(loop: tuple[jax.Array, Any]) -> tuple[jax.Array, Any]:
        return jnp.zeros_like(wanted), function(loop[1], *operands)

    return lax.while_loop(lambda loop: loop[0], body, (wanted, carry))[1]


@once.defjvp
def _once_jvp(function: Callable[..., Any], primals: Any, tangents: Any) -> Any:
    wanted, *rest = primals

    def branch(*operands: Any) -> Any:
        return lax.cond(wanted, function, lambda carry, *_: carry, *operands)

    return jax.jvp(branch, tuple(rest), tuple(tangents[1:]))
