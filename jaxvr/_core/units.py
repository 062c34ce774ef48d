"""Powers of two as units: numbers near 1, whatever the user's unit is, without a rounding.

A product with a power of two is exact as long as nothing under- or overflows, so computing in such
units gives the bits that the user's own would give, if his own had room enough for squares,
reciprocals and differences.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

Array = jax.Array

# The largest number of an array of lengths or of scalars is to be at least 2^-SMALL: what is
# smaller by a rounding is a normal number then. (XLA takes subnormal ones for 0.)
SMALL = {"float32": 100, "float64": 960}
_NONE = -(1 << 20)


def exponent_of(x: Array) -> Array:
    """The exponent e () int32 of the largest size in `x`, which lies in [2^(e - 1), 2^e), or below
    if it is subnormal; `is_none` if all are 0, or one is not finite. A constant to derivatives."""
    info = jnp.finfo(x.dtype)
    # Bits of sizes are ordered as sizes are, and subnormal ones are not taken for 0.
    bits = lax.bitcast_convert_type(lax.stop_gradient(x), f"int{info.bits}")
    largest = jnp.max(bits & np.iinfo(bits.dtype).max, initial=0)
    biased = largest >> info.nmant
    known = (largest > 0) & (biased < (2 << info.nexp - 1) - 1)
    return jnp.where(known, biased + (int(info.minexp)), _NONE).astype(jnp.int32)


def is_none(exponent: Array) -> Array:
    """Whether there is no number to go by."""
    return exponent == _NONE


def is_small(exponent: Array, dtype: Any) -> Array:
    """Whether digits of numbers of that size get lost."""
    return (exponent <= -SMALL[np.dtype(dtype).name]) & ~is_none(exponent)


def is_large(exponent: Array, dtype: Any) -> Array:
    """Whether digits of reciprocals of numbers of that size get lost."""
    return exponent > SMALL[np.dtype(dtype).name]


def is_extreme(x: Array) -> Array:
    """Whether digits of numbers of the size of x (), or of their reciprocals, get lost; also where
    those of x were, as those of a product may be."""
    exponent = exponent_of(x)
    return is_none(exponent) | is_small(exponent, x.dtype) | is_large(exponent, x.dtype)


def power_of_two(exponent: Array, dtype: Any) -> Array:
    """2^exponent (), or the nearest power that is a normal number and has such a reciprocal."""
    info = jnp.finfo(dtype)
    bias = 1 - int(info.minexp)
    bits = (jnp.clip(exponent, 1 - bias, bias - 1) + bias).astype(f"int{info.bits}")
    return lax.bitcast_convert_type(bits << info.nmant, jnp.dtype(dtype))


@jax.custom_jvp
def times_told(x: Array, unit: Array, good: Array) -> Array:
    """x times unit (), with derivatives that are NaN unless good () bool: for units in which they
    would be under- or overflow without a word."""
    del good
    return x * unit


@times_told.defjvp
def _times_told(primals: Any, tangents: Any) -> Any:
    (x, unit, good), (change, *_) = primals, tangents
    return x * unit, change * jnp.where(good, unit, jnp.nan).astype(x.dtype)


def near_one(x: Array) -> Array:
    """The power of two () that brings the largest size in `x` to [1/2, 1); 1 if all are 0."""
    exponent = exponent_of(x)
    return power_of_two(jnp.where(is_none(exponent), 0, -exponent), x.dtype)


def scaled_to_one(x: np.ndarray) -> tuple[np.ndarray, int]:
    """NumPy's numbers times 2^-e in float64, with the largest size in [1/2, 1), and e."""
    x = np.asarray(x, np.float64)
    exponent = int(np.frexp(np.abs(x).max(initial=0.0))[1])
    return np.ldexp(x, -exponent), exponent


def norm(x: np.ndarray) -> float:
    """The Euclidean length of NumPy's numbers, whatever their unit is."""
    x, exponent = scaled_to_one(x)
    return float(np.ldexp(np.linalg.norm(x), exponent))


def require_lengths(name: str, x: Any) -> None:
    """ValueError for lengths out of range; concrete ones, for verbs that have no status."""
    exponent, dtype = exponent_of(jnp.asarray(x)), np.dtype(x.dtype)
    if bool(is_small(exponent, dtype) | is_large(exponent, dtype)):
        b = SMALL[dtype.name]
        raise ValueError(
            f"{name} reach to {np.abs(np.asarray(x)).max():.3g}, but in {dtype} the largest "
            f"coordinate has to lie between 2^-{b} = {2.0**-b:.2g} and 2^{b} = {2.0**b:.2g}. Take "
            "another unit of length, or float64."
        )
