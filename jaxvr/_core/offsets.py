"""Offsets: what float32 numbers are held relative to where they lie far from 0 and close together.

A float x of p bits is rounded by up to |x| 2^-p, so numbers of a range w round a middle c keep
|c| / w times less of it than of a range about 0: of 101325 Pa + 0.01 Pa f float32 keeps two values,
and coordinates of some kilometres from a reference 5,000 km away come in steps of half a metre.
Where data come in they are float64 still. There an offset in their middle is taken off, in float64,
and what is left is rounded: the numbers on the device are relative to it. It is a plain float of
the object that holds them (`TetMesh.origin` and `offset`, `TransferFunction.offset`,
`Camera.origin`, `Segments.offset`), part of its structure and no leaf. Whoever brings two objects
together takes the difference of their offsets, in float64 again.

An offset is 0 for most data, and for all in float64. It is a multiple of the power of two below the
range, so that in another unit by a power of two pictures keep their bits, and two objects made of
about the same numbers agree.
"""

from __future__ import annotations

import copy
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .checks import is_concrete

Origin = tuple[float, float, float]

NOWHERE: Origin = (0.0, 0.0, 0.0)

# Numbers this many times farther from 0 than their range is wide are held relative to an offset.
# Below it float32 rounds them by less than 2e-6 of their range, above it pictures lose digits that
# rendering in float32 else keeps: see "Numbers far from 0" in notebooks/accuracy.md.
FAR = 32.0

# What steps of float32 may be as a part of what they are to tell apart.
COARSE = 1e-3


def offset_between(low: float, high: float, dtype: Any, width: float | None = None) -> float:
    """What to take off numbers from `low` to `high`: one near their middle, or 0.0 where `dtype`
    holds them well. width: the length that their rounding counts against, if not theirs."""
    width = high - low if width is None else width
    largest = max(abs(low), abs(high))
    if np.dtype(dtype) != np.float32 or not 0 < width < math.inf or largest <= FAR * width:
        return 0.0
    unit = math.ldexp(1.0, math.frexp(width)[1] - 1)
    return round((low + (high - low) / 2) / unit) * unit


def origin_between(low: np.ndarray, high: np.ndarray, dtype: Any) -> Origin:
    """The same for points in a box (3,), (3,): each coordinate by itself."""
    x, y, z = (offset_between(float(a), float(b), dtype) for a, b in zip(low, high, strict=True))
    return x, y, z


def added(said: Any, more: Any) -> tuple[Any, Any]:
    """An offset, or an origin, for numbers that are relative to `said`, from which `more` is to be
    taken: their sum, and what that takes of the numbers, to the last bit."""
    total = np.asarray(said, np.float64) + np.asarray(more, np.float64)
    whole = origin_of(total) if total.ndim else float(total)
    return whole, total - np.asarray(said, np.float64)


def is_single(x: Any) -> bool:
    """Whether numbers come in floats of less than 64 bits: what float32 loses is lost already."""
    dtype = getattr(x, "dtype", None)
    return dtype is not None and jnp.issubdtype(dtype, jnp.floating) and dtype.itemsize < 8


def digits_of(x: Any) -> Any:
    """JAX's known arrays of more digits than float32 has as NumPy's, since an offset is taken off
    of these; anything else as it is."""
    if isinstance(x, jax.Array) and is_concrete(x) and not is_single(x):
        return np.asarray(x)
    return x


def coarse_step(x: Any, width: float) -> float | None:
    """The step of float32 among known numbers that came in it, if it is more than a thousandth of
    `width`; else None. Of multiples of sixteen steps none was rounded (whole numbers, say)."""
    if not is_single(x) or not is_concrete(x) or not np.size(x) or not 0 < width < math.inf:
        return None
    numbers = np.asarray(x, np.float32)
    step = float(np.spacing(np.abs(numbers).max()))
    rounded = step > COARSE * width and np.fmod(numbers, np.float32(16 * step)).any()
    return step if rounded else None


def bare(x: Any) -> Any:
    """What is held relative to an offset without it. Compiled functions need not know of it: for
    another one they are not compiled again."""
    made = copy.copy(x)
    for name, none in (("origin", NOWHERE), ("offset", 0.0)):
        if getattr(x, name, none) != none:
            object.__setattr__(made, name, none)
    return made


def bulk(x: np.ndarray) -> tuple[float, float]:
    """Where most of the numbers (n,) lie: from 1 to 99 % of them, or all where that is one."""
    few = x
    if len(x) >= 1 << 16:
        # A prime's multiples, whose steps go with those of no grid.
        few = x[np.arange(1 << 15, dtype=np.int64) * 2654435761 % len(x)]
    low, high = (float(v) for v in np.quantile(few, (0.01, 0.99)))
    return (low, high) if high > low else (float(x.min()), float(x.max()))


def relative(x: Any, offset: Any, dtype: Any) -> Any:
    """x - offset in `dtype`; NumPy subtracts in float64 and stays NumPy, JAX as wide as x is."""
    offset = np.asarray(offset, np.float64)
    if not isinstance(x, jax.Array):
        return (np.asarray(x, np.float64) - offset).astype(dtype)
    offset = offset.reshape((1,) * (x.ndim - offset.ndim) + offset.shape)
    wide = jnp.promote_types(x.dtype, dtype)
    first = offset.astype(wide)  # of float32 not all of it: the rest goes after
    return ((x.astype(wide) - first) - (offset - first).astype(wide)).astype(dtype)


def moved(x: Any, here: Any, there: Any, dtype: Any) -> Any:
    """What is relative to `here`, relative to `there` and in `dtype`: x itself where they agree."""
    by = np.asarray(there, np.float64) - np.asarray(here, np.float64)
    return relative(x, by, dtype) if by.any() else jnp.asarray(x).astype(dtype)


def absolute(x: Any, offset: Any) -> np.ndarray:
    """x + offset in float64."""
    return np.asarray(x, np.float64) + np.asarray(offset, np.float64)


# Fewer steps of float32 than these between two numbers, and between all of them, are too few.
_STEPS, _ALL_STEPS = 16, 1000


def coarse(x: Any) -> str | None:
    """What to say of sorted, finite numbers (n,) that come in less than float64, far from 0 and so
    close together that digits are lost; None where all are kept, and for numbers that are traced.

    Whole multiples of 16 steps are taken for what was meant: 101325 and 101326 lose nothing.
    """
    dtype = getattr(x, "dtype", None)
    if dtype not in (np.float16, np.float32) or not is_concrete(x) or len(x) == 0:
        return None
    x = np.asarray(x, np.float64)
    low, high = float(x[0]), float(x[-1])
    if not offset_between(low, high, np.float32):
        return None
    step = float(np.spacing(np.asarray(max(abs(low), abs(high)), dtype)))
    gaps = np.diff(x)
    if min(gaps[gaps > 0]) >= _STEPS * step and high - low >= _ALL_STEPS * step:
        return None
    if not (x % (_STEPS * step)).any():
        return None
    return (
        f"come in {np.dtype(dtype)}, which has steps of {step:.2g} there: they lie from {low:.9g} "
        f"to {high:.9g}, {(high - low) / step:.0f} steps. What was lost is not to be had back: "
        "pass plain numbers or NumPy's float64, or less an offset that is said with offset=."
    )


def said(offset: Any) -> str:
    """An offset or an origin for people, with all of its digits."""
    if isinstance(offset, tuple):
        return "(" + ", ".join(said(x) for x in offset) + ")"
    return f"{offset:.17g}" if abs(offset) >= 1e16 else repr(float(offset)).removesuffix(".0")


def origin_of(x: Any) -> Origin:
    """A place (3,) of known, finite numbers as a tuple, or a ValueError. 0 stands for (0, 0, 0)."""
    try:
        place = np.broadcast_to(np.asarray(x, np.float64), (3,))
    except (TypeError, ValueError):
        place = np.full(3, np.nan)
    if not np.isfinite(place).all():
        raise ValueError(f"origin must be three finite numbers or 0, but is {x!r}.")
    return (float(place[0]), float(place[1]), float(place[2]))


def offset_of(x: Any) -> float:
    """A known, finite number, or a ValueError."""
    try:
        number = float(x)
    except Exception:
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"offset must be a finite number that is known, but is {x!r}.")
    return number


def require_said(name: str, offset_name: str, offset: Any) -> None:
    """ValueError where new numbers may be relative to an offset, or as they are."""
    if np.any(offset):
        raise ValueError(
            f"{name} are held relative to {offset_name} = {said(offset)}, since float32 keeps too "
            f"few digits of them otherwise. Say what these are relative to: {offset_name}=0 for "
            f"numbers as they are, or the {offset_name} of the object for what was made from its "
            f"own {name}."
        )
