"""Points that coincide exactly count as one: the welded id is the smallest index among them.

Only connectivity uses welded ids; a cell keeps its own points and their values, so data that
differ across a seam stay as they are. Nothing is merged by a tolerance, since a tolerance closes
gaps that are meant to be open; -0.0 equals 0.0.
"""

from __future__ import annotations

import numpy as np


def weld(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """points (P, 3), finite: welded ids (P,) int64 and duplicates (n, 2) int32.

    welded[p] <= p, with equality for the first of its group; duplicates lists (p, welded[p]) where
    they differ, by ascending p.
    """
    n = len(points)
    p = points + np.zeros((), points.dtype)  # -0.0 becomes 0.0
    order = np.lexsort((p[:, 2], p[:, 1], p[:, 0]))  # stable: within a group by index
    q = p[order]
    first = np.ones(n, bool)
    first[1:] = (q[1:] != q[:-1]).any(1)
    welded = np.empty(n, np.int64)
    welded[order] = order[np.maximum.accumulate(np.where(first, np.arange(n), 0))]
    dup = np.flatnonzero(welded != np.arange(n))
    return welded, np.stack([dup, welded[dup]], 1).astype(np.int32)
