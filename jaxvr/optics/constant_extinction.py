"""Constant extinction and linear colour along a segment."""

from __future__ import annotations

from math import factorial

import jax
import jax.numpy as jnp

from jaxvr._core.pytree import noun
from jaxvr.numerics.moments import opacity
from jaxvr.optics.whole import AbstractEndIntegrator

Array = jax.Array

# Below this the series is used, with a remainder below rounding in float64.
_THIN = 0.5
_TERMS = 16


def _back_weight(depth: Array) -> Array:
    """int_0^1 t S exp(-S t) dt = (1 - exp(-S)) / S - exp(-S) = sum_n (-1)^n S^(n+1) (n+1)/(n+2)!,
    by the sum where the difference would cancel. Both operands are guarded: no 0 / 0."""
    thin = depth < _THIN
    small, large = jnp.where(thin, depth, 0), jnp.where(thin, 1, depth)
    series = 0.0
    for n in reversed(range(_TERMS)):
        series = (-1) ** n * (n + 1) / factorial(n + 2) + series * small
    return jnp.where(thin, series * small, opacity(large) / large - jnp.exp(-large))


@noun
class ConstantExtinction(AbstractEndIntegrator):
    """Extinction constant along a segment, at the mean of its two ends, and colour linear.

    The extinction is that of Stein, Becker and Max 1994 (doi:10.1145/197938.197971); the colour's
    integral is exact for it. Here to compare with: where extinction rises towards the back, too
    much of the front is shown, and the other way round; peaks of the transfer function between the
    two ends are missed.
    """

    def weights(self, a, b):
        depth = 0.5 * (a + b)
        return opacity(depth), _back_weight(depth)
