"""Rays in batches: square tiles of an image, so that the rays of a batch stay together.

Reshapes and transposes only: their derivatives are the same.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

Array = jax.Array

# Rows and columns of pixels, and so the rays of a batch in float32: enough to hide the cost of
# starting a kernel, few enough that they take about as many steps and their state stays in cache.
TILE = (16, 32)


def batch_size(dtype: Any) -> int:
    """Rays of a batch. In float64 half as many: XLA hands larger kernels to several threads, at a
    loss."""
    return TILE[0] * TILE[1] * 4 // np.dtype(dtype).itemsize


def batches(most: int, arrays: Any) -> tuple[Any, int]:
    """A tree of arrays (R, ...) as one of batches (n, size, ...), the last filled up with copies;
    and R."""
    count = jax.tree.leaves(arrays)[0].shape[0]
    size = min(most, max(count, 1))
    number = -(-count // size)

    def split(x):
        x = jnp.concatenate([x, jnp.broadcast_to(x[-1:], (number * size - count, *x.shape[1:]))])
        return x.reshape(number, size, *x.shape[1:])

    return jax.tree.map(split, arrays), count


def tile(x: Array) -> Array:
    """An image (height, width, C) as rays (R, C), tile after tile, with its rim repeated to fill
    the last ones. Reshapes and transposes only: their derivatives are the same."""
    (rows, columns), (height, width, channels) = TILE, x.shape
    x = jnp.pad(x, ((0, -height % rows), (0, -width % columns), (0, 0)), mode="edge")
    x = x.reshape(x.shape[0] // rows, rows, x.shape[1] // columns, columns, channels)
    return x.transpose(0, 2, 1, 3, 4).reshape(-1, channels)


def untile(x: Array, height: int, width: int) -> Array:
    """Back from `tile`: (R, C) to (height, width, C)."""
    rows, columns = TILE
    x = x.reshape(-(-height // rows), -(-width // columns), rows, columns, x.shape[-1])
    x = x.transpose(0, 2, 1, 3, 4)
    return x.reshape(x.shape[0] * rows, -1, x.shape[-1])[:height, :width]


def tile_order(height: int, width: int) -> np.ndarray:
    """Pixel numbers (height * width,), tile after tile."""
    rows, columns = (x.ravel() for x in np.mgrid[0:height, 0:width])
    return np.lexsort((columns, rows, columns // TILE[1], rows // TILE[0])).astype(np.int32)
