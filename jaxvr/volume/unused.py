"""Which points cells use, and what to do with others that would spoil their numbers.

Verbs compute in units in which the largest coordinate is near 1. A fill value among coordinates
(1e20, 9.97e36) of a point without a cell would take all digits from those of cells.
"""

from __future__ import annotations

import numpy as np

from .._core.warn import warn

# Times as far from the origin as points of cells: where float32 begins to lose products of these.
FAR = 2.0**40


def used_by(n: int, *cells: np.ndarray) -> np.ndarray:
    """Which of n points (n,) bool cells use. cells: ids, one array of any shape for each type."""
    used = np.zeros(n, bool)  # a mark for each is quicker than a copy of each corner
    for ids in cells:
        used[ids.reshape(-1)] = True
    return used


def gathered(points: np.ndarray, used: np.ndarray) -> np.ndarray:
    """The points (P, 3), those that no cell uses and that lie far out in the middle of the others,
    with a warning. used (P,): from `used_by`."""
    if used.all() or not used.any():
        return points
    size = np.abs(points).max(axis=1)
    reach = float(size[used].max())
    far = ~used & (size > FAR * reach)
    if reach == 0 or not far.any():
        return points
    n = int(far.sum())
    warn(
        f"{n} point{'s' if n > 1 else ''} that no cell uses, out to {size[far].max():.3g}, where "
        f"those of cells reach {reach:.3g}: moved to the middle of these. Are they fill values?",
        UserWarning,
    )
    low, high = points[used].min(axis=0), points[used].max(axis=0)
    return np.where(far[:, None], low / 2 + high / 2, points)
