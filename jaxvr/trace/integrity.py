"""Whether `Segments` are those of a trace: they are a pytree, and pytrees are computed with.

As with a mesh (`volume.integrity`): concrete ones are looked at once for each array; where integers
are traced, a picture of integers that fit nothing is NaN. Runs that ascend within the nodes are
taken for right: nothing tells which run a node was made for.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from jaxvr._core.checks import is_concrete, require_finite
from jaxvr.trace.recorded import Segments
from jaxvr.volume.integrity import found_right, remember

Array = jax.Array

_ADVICE = (
    "What jaxvr.trace gave can be computed with in `scalar` and `length` only: "
    "dataclasses.replace(segments, scalar=...)."
)


def require_segments(segments: Segments) -> None:
    """ValueError that names the array that is wrong. Of numbers that are traced only kinds and
    shapes are looked at."""
    rays, nodes = int(np.prod(segments.shape)), segments.scalar.shape[:1]
    dtype = np.dtype(segments.scalar.dtype)
    wanted = {
        "scalar": (dtype if dtype in (np.float32, np.float64) else np.dtype("float32"), nodes),
        "length": (dtype, nodes),
        "start": (np.dtype("int32"), (rays + 1,)),
        "order": (np.dtype("int32"), (rays,)),
    }
    for name, (kind, shape) in wanted.items():
        x = getattr(segments, name)
        if x.dtype != kind or x.shape != shape:
            raise ValueError(
                f"segments.{name} must be {kind} of shape {shape}, but is {x.dtype} of "
                f"{x.shape}. {_ADVICE}"
            )
    for name in ("scalar", "length"):
        x = getattr(segments, name)
        if is_concrete(x) and not found_right((x,)):
            require_finite(f"segments.{name}", x)
            remember((x,))
    integers = (segments.start, segments.order)
    if is_concrete(*integers) and not found_right(integers, nodes[0]):
        if not _fit(np.asarray(integers[0]), np.asarray(integers[1]), nodes[0]):
            raise ValueError(
                "segments.start and segments.order are not those of a trace: runs of nodes that "
                f"follow each other, and each ray's place in the image, once. {_ADVICE}"
            )
        remember(integers, nodes[0])


def unfit(segments: Segments, image: Array) -> Array:
    """An image (...), NaN where traced integers are not those of a trace; and so are gradients."""
    integers = (segments.start, segments.order)
    if is_concrete(*integers):
        return image
    good = _fit(*integers, segments.scalar.shape[0])
    return image * jnp.where(good, 1, jnp.nan).astype(image.dtype)


def _fit(start, order, nodes: int):
    """Whether () runs (R + 1,) ascend within the nodes, and places (R,) are a permutation."""
    xp = jnp if isinstance(start, jax.Array) else np
    runs = (start[0] == 0) & (start[-1] <= nodes) & xp.all(start[1:] >= start[:-1])
    return runs & xp.all(xp.sort(order) == xp.arange(len(order)))
