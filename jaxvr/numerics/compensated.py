"""Sums that carry their own rounding error (Kahan 1965).

A pair (total, excess) stands for total - excess. A float32 sum of a million equal terms keeps all
its digits, where the plain sum loses four. Optical depth and colour along a ray are such sums, in
the forward pass and, with the same arithmetic, when it is replayed backwards.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

Array = jax.Array
Sum = tuple[Any, Any]


def add(total: Sum, x: Array) -> Sum:
    """The sum with x added. Its derivative is that of a plain sum."""
    value, excess = total
    y = x - excess
    new = value + y
    return new, (new - value) - y


def join(a: Sum, b: Sum) -> Sum:
    """The sum of two sums."""
    total, excess = add(a, b[0])
    return total, excess + b[1]


def value(total: Sum) -> Array:
    return total[0] - total[1]


def difference(a: Sum, b: Sum) -> Array:
    """a - b, without losing what the excesses know."""
    return (a[0] - b[0]) - (a[1] - b[1])


def exp_minus(total: Sum) -> Array:
    """exp(-(total - excess)) to first order in the excess, which is below rounding of the total."""
    return jnp.exp(-total[0]) * (1 + total[1])
