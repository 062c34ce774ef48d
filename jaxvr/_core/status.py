"""What goes wrong inside a compiled loop is data: bits in the result, read outside.

`render` and `trace` read them after every call that is not itself being traced. Inside your own
`jit`, call `jaxvr.check(status)` on the concrete status that `render_rays(..., status=True)`
returns.
"""

from __future__ import annotations

from typing import Any

import numpy as np

LOST = 1
STEPS = 2
K_TOO_SMALL = 4
BROKEN = 8
UNSORTED = 16
TANGLED = 32
LENGTHS = 64
SCALARS = 128

_MEANING = {  # what explains others first
    LENGTHS: (
        "The lengths are too small or too large for the dtype.",
        "The largest coordinate of the points has to lie between 2^-100 = 7.9e-31 and 2^100 = "
        "1.3e30 in float32, 2^-960 = 1e-289 and 2^960 = 1e289 in float64. Take another unit of "
        "length, for points, camera and extinctions (which are one over a length), or float64.",
    ),
    SCALARS: (
        "The scalars are too small for the dtype.",
        "The largest of the field and the control points has to be at least 2^-100 = 7.9e-31 in "
        "float32, 2^-960 = 1e-289 in float64. Take another unit, for `values` and for the "
        "transfer function's `positions`, or float64.",
    ),
    UNSORTED: (
        "The transfer function's positions are not in ascending order, or not finite.",
        "They were when it was made: keep them so in what changes them, for instance by summing up "
        "positive steps.",
    ),
    LOST: (
        "found no way out of a cell",
        "Its coordinates are NaN or infinite, or the ray is: check `points`, the camera and what "
        "you changed since the mesh was made.",
    ),
    STEPS: (
        "reached the maximum number of steps",
        "Increase `max_steps` of the adjoint.",
    ),
    K_TOO_SMALL: (
        "needed a k-buffer with more entries",
        "Increase `k` of `KBuffer` (`jaxvr.measure_k` tells how many the view needs), or take the "
        "image as it is with `render(..., status=True)`.",
    ),
    TANGLED: (
        "met fragments that no order by depth puts right",
        "Cells overlap there or are overturned. Take `RayCast()`; `KBuffer` has trouble with them "
        'only with `pairs="closest"`, or at an eye inside of several of them.',
    ),
    BROKEN: (
        "met integers that are out of range or do not fit together, or not the points",
        "Integers of a mesh are names of points, cells and faces, and not to be computed with: "
        "average, step or scale its `points` and `values` only, with `mesh.replace`. Points that "
        "mirror the mesh go through it outside of `jit`, where the integers follow them.",
    ),
}


class RenderError(RuntimeError):
    """A ray could not be followed to its end."""


def check(status: Any) -> None:
    """Raise `RenderError` if any ray has a status bit set.

    Args:
      status: integer bits of any shape, one for each ray; 0 is success.
    """
    bits = np.asarray(status)
    if not bits.any():
        return
    for bit, (what, advice) in _MEANING.items():
        hit = (bits & bit) != 0
        if hit.any() and bit in (LENGTHS, SCALARS, UNSORTED):  # of the whole picture
            raise RenderError(f"{what} {advice}")
        if hit.any():
            first = tuple(int(i) for i in np.argwhere(hit)[0])
            raise RenderError(
                f"{int(hit.sum())} ray(s) {what}, the first at index {first}. {advice}"
            )
