"""Error-free arithmetic, and an orientation predicate whose sign is always right.

A walk through a mesh stays on the track only if two cells that share an edge agree on which side
of the ray it passes. Here they agree to the bit, because the answer is exact:

- `two_sum` (Knuth) gives a sum and its rounding error.
- `split` cuts a number into two halves of at most 12 (float32) or 26 (float64) bits, by rounding
  its bits as an integer. Products of halves are exact, and so it does not matter whether the
  compiler fuses them with a sum (FMA) or not: the same bits come out of every kernel.
- `edge_side` is the sign of x_i y_j - x_j y_i. Two correctly rounded products that differ compare
  like the exact ones; if they are equal, their exact rounding errors decide (Dekker 1971); and if
  those are equal too, the origin lies on the edge's line and a consistent infinitesimal shift
  decides (simulation of simplicity, Edelsbrunner and Muecke 1990,
  doi:10.1145/77635.77639).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

Array = jax.Array


def two_sum(a: Array, b: Array) -> tuple[Array, Array]:
    """s = fl(a + b) and e with s + e = a + b exactly."""
    s = a + b
    t = s - a
    return s, (a - (s - t)) + (b - t)


def split(x: Array) -> tuple[Array, Array]:
    """high + low = x exactly, with at most half of the significant bits each."""
    if x.dtype == jnp.float64:
        bits, word, drop = jnp.int64, np.int64, 27
    else:
        bits, word, drop = jnp.int32, np.int32, 12
    pattern = lax.bitcast_convert_type(x, bits)
    pattern = (pattern + word(1 << (drop - 1))) & word(-(1 << drop))
    high = lax.bitcast_convert_type(pattern, x.dtype)
    return high, x - high


def head(x: Array) -> Array:
    """The high half of x."""
    return split(x)[0]


def _rounded(x: Array) -> Array:
    """x, kept from being fused into a following sum: a maximum that no compiler can remove."""
    return jnp.maximum(x, jnp.finfo(x.dtype).min)


class Halves(NamedTuple):
    """A number with its two halves, so that they are computed once."""

    value: Array
    high: Array
    low: Array


def halves(x: Array) -> Halves:
    return Halves(x, *split(x))


def two_product(a: Halves, b: Halves) -> tuple[Array, Array]:
    """p = fl(a b) and e with p + e = a b exactly (barring underflow)."""
    p = _rounded(a.value * b.value)
    e = ((a.high * b.high - p) + a.high * b.low + a.low * b.high) + a.low * b.low
    return p, e


def edge_side(
    xi: Halves, yi: Halves, xj: Halves, yj: Halves, i_first: Array | bool
) -> tuple[Array, Array]:
    """Twice the signed area of (origin, i, j) and whether it is positive, exactly.

    Where x_i y_j = x_j y_i exactly, the origin is thought moved to (e, e^2) and vertex number k
    by (0, e_k), with infinitesimal e >> ... >> e_2 >> e_1: expanding the determinant in e, the
    first coefficient that is not zero decides. `i_first` says whether i comes before j in the
    order of vertices.

    Returns:
      area: the determinant, within an ulp or two of itself.
      positive: its sign after the shift; swapping i and j always flips it.
    """
    p, p_low = two_product(xi, yj)
    q, q_low = two_product(xj, yi)
    greater = (p > q) | ((p == q) & (p_low > q_low))
    equal = (p == q) & (p_low == q_low)
    same_y = yi.value == yj.value
    same = same_y & (xi.value == xj.value)
    shifted = (yi.value > yj.value) | (same_y & (xj.value > xi.value))
    shifted = jnp.where(same, (xi.value > 0) == i_first, shifted)
    return (p - q) + (p_low - q_low), jnp.where(equal, shifted, greater)
