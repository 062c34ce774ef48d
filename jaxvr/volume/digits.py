"""How many digits of what was given are left in a mesh of float32, where an offset cannot help.

Offsets make up for numbers far from 0 (`_core.offsets`), but not for numbers in two places that are
far from each other, nor for digits that were lost before, in files and arrays of float32.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .._core.offsets import COARSE, FAR, bulk, coarse_step, is_single, offset_between

# The part of the different values that has to stay different. Of millions, so dense that it does
# not matter, a tenth falls together.
_KEPT = 0.75
# Bits of the largest value below which there is noise in float64.
_BITS = 40
# More distinct values than this may fall together and be dense all the same.
_MANY = 1 << 21


def coarse_cells(
    given: Any, exact: np.ndarray, held: np.ndarray, origin: np.ndarray, cells: np.ndarray
) -> int:
    """Cells, of which rounding moves a corner by more than a thousandth of their shortest edge.

    given, exact, held (P, 3): points as they came; in float64, relative to the origin; and in the
    mesh's dtype. Of points that came in float32 far from 0 the rounding is that which they have.
    """
    if origin.any() and is_single(given):
        rounding = np.spacing(np.abs(np.asarray(given, np.float32))).max(axis=1) / 2
    elif held.dtype == np.float64:
        return 0
    else:
        rounding = np.abs(held - exact).max(axis=1)
    if not rounding.any():
        return 0
    corners = exact[cells]
    shortest = np.full(len(cells), np.inf)
    for i in range(4):
        for j in range(i):
            size = np.abs(corners[:, i] - corners[:, j]).max(axis=1)
            shortest = np.minimum(shortest, size)
    return int((rounding[cells].max(axis=1) > COARSE * shortest).sum())


def lost_values(given: Any, numbers: np.ndarray, offset: float, dtype: np.dtype) -> str | None:
    """What to say of numbers (n,), float64 and as they are, of which too few digits are left."""
    low, high = bulk(numbers)
    if is_single(given):
        step = coarse_step(np.asarray([low, high], np.float32), high - low)
        if not offset_between(low, high, np.float32) or step is None:
            return None
        return (
            f"values come in float32, which has steps of {step:.2g} there: most of them lie from "
            f"{low:.9g} to {high:.9g}, {(high - low) / step:.0f} steps. What was lost is not to be "
            "had back: write them in float64, or less an offset."
        )
    largest = float(np.abs(numbers).max())
    if dtype == np.float64 or not 0 < largest < float(np.finfo(dtype).max):
        return None
    # Values of float64 that are one but for noise of its own count once. By powers of two, which
    # have no reciprocal to overflow where all values are below the normal numbers.
    unit = math.frexp(largest)[1] - _BITS
    distinct = np.ldexp(np.unique(np.round(np.ldexp(numbers, -unit))), unit)
    if len(distinct) > _MANY:
        return None
    small = largest < float(np.finfo(dtype).tiny)
    where, else_ = (
        ("are too near 0 for it", "scale them")
        if small
        else ("lie in places far from each other", "leave out what is far")
    )
    # An offset for most of them takes digits from those that lie elsewhere, however few.
    elsewhere = np.abs(distinct - offset) > FAR * (high - low)
    for some, what in (
        (distinct, "different"),
        (distinct[elsewhere] if offset else distinct[:0], "different outlying"),
    ):
        held = np.unique((some - offset).astype(dtype))
        kept = len(held) if offset or held.any() else 0
        if len(some) and kept <= _KEPT * len(some):
            return (
                f"float32 keeps {kept} of the {len(some)} {what} values: they {where}, from "
                f"{numbers.min():.9g} to {numbers.max():.9g}. Turn on x64 "
                f'(jax.config.update("jax_enable_x64", True)) and pass dtype="float64", or {else_}.'
            )
    return None
