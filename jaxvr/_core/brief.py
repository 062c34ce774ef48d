"""Arrays in a few characters, for reprs, which must not fail whatever stands in a tree's leaves."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from jaxvr._core.checks import is_concrete


def is_known(*leaves: Any) -> bool:
    """True if all leaves are arrays of real numbers that can be looked at: no tracers, placeholders
    or deleted buffers."""
    return all(
        isinstance(x, jax.Array | np.ndarray)
        and is_concrete(x)
        and getattr(x.dtype, "kind", "?") in "fiu"
        and not (isinstance(x, jax.Array) and x.is_deleted())
        for x in leaves
    )


def brief(x: Any) -> str:
    """A number or a short vector by its numbers, any other array by dtype and shape, else "?"."""
    if is_known(x) and x.ndim < 2 and x.size <= 4:
        numbers = ", ".join(f"{float(v):.6g}" for v in np.asarray(x).reshape(-1))
        return numbers if x.ndim == 0 else f"({numbers})"
    dtype, shape = getattr(x, "dtype", None), getattr(x, "shape", None)
    if dtype is None or not isinstance(shape, tuple):
        return "?"
    return f"{dtype}[{', '.join(map(str, shape))}]"


def spanned(low: Any, high: Any, digits: int = 6) -> str:
    """Two numbers as "low to high", with as many digits as tell them apart, so many at least."""
    return " to ".join(ends(low, high, digits))


def ends(low: Any, high: Any, digits: int = 6) -> tuple[str, str]:
    """The same as two texts."""
    low, high = float(low), float(high)
    while digits < 17 and low != high and _part(low, high, digits) > 1e-3:
        digits += 1
    return f"{low:.{digits}g}", f"{high:.{digits}g}"


def _part(low: float, high: float, digits: int) -> float:
    """How much of the difference so many digits round away."""
    wrong = max(abs(float(f"{x:.{digits}g}") - x) for x in (low, high))
    return wrong / abs(high - low) if max(abs(low), abs(high)) > 100 * abs(high - low) else 0.0


def length_of(x: Any) -> str:
    """Entries along the first axis as text, "?" where there is none."""
    shape = getattr(x, "shape", None)
    return f"{shape[0]:,}" if isinstance(shape, tuple) and shape else "?"


def dtype_of(x: Any) -> str:
    """Name of the dtype, "?" where there is none."""
    return str(getattr(x, "dtype", "?"))
