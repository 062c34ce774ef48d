"""Gathers in a loop body: without bounds checks, and by one thread."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jaxvr._core.stage import stage

Array = jax.Array


def take(array: Array, index: Array) -> Array:
    """array[index] for an index >= 0 that is known to be in bounds."""
    # Unsigned, so that there are no negative indices to count from the end.
    return array.at[index.astype(jnp.uint32)].get(mode="promise_in_bounds")


def load(wanted: Array, find: Callable[..., Any], *operands: Any) -> Any:
    """`stage(wanted, find, *operands)`, where `find` gathers a batch (..., R) from large arrays.

    XLA's CPU backend weighs a gather by the size of what it gathers *from* (above 512 KB), and so
    hands the few hundred loads of a batch to all threads: 3 us on an idle machine and 30 us on a
    busy one, for 0.5 us of work. It leaves alone what may be written in place, into a part of a
    buffer. Therefore results are written into buffers that are one too long, at a place that the
    compiler does not know.
    """

    def fill(start: Array, *operands: Any) -> Any:
        def put(found: Array) -> Array:
            room = jnp.zeros((*found.shape[:-1], found.shape[-1] + 1), found.dtype)
            first = jnp.zeros_like(start)
            return lax.dynamic_update_slice(room, found, (first,) * (found.ndim - 1) + (start,))

        return jax.tree.map(put, find(*operands))

    start = jnp.where(wanted, 0, 1).astype(jnp.int32)
    return jax.tree.map(lambda x: x[..., :-1], stage(wanted, fill, start, *operands))
