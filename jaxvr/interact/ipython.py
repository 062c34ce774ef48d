"""`%load_ext jaxvr`: rendered images show as pictures in notebooks, pixel for pixel.

What counts as an image is a float array (H, W, 4), in NumPy or JAX, with at least 8 pixels a side,
finite, and with an alpha from 0 to 1; other arrays (differences of images, say) are text as before.
Where a picture is transparent the page is seen.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxvr._core.brief import is_known
from jaxvr.interact.png import encode

SMALLEST = 8
# Alpha is computed: it may be above 1 or below 0 by rounding.
ROUNDING = 1e-5

_before: dict[type, Any] = {}


def load_ipython_extension(ipython: Any) -> None:
    """Shows images as pictures in a running IPython, `ipython`: NumPy's and JAX's arrays."""
    printers = ipython.display_formatter.formatters["image/png"]
    for kind in _kinds():
        before = printers.for_type(kind, png)
        if before is not png:
            _before[kind] = before


def unload_ipython_extension(ipython: Any) -> None:
    """Puts back how `ipython` showed arrays before."""
    printers = ipython.display_formatter.formatters["image/png"]
    for kind in _kinds():
        if printers.type_printers.get(kind) is png:
            printers.pop(kind)
            if _before.get(kind) is not None:
                printers.for_type(kind, _before[kind])


def png(array: Any) -> bytes | None:
    """An image as PNG; None, and so its text, for any other array."""
    shape = getattr(array, "shape", ())
    if len(shape) != 3 or shape[2] != 4 or min(shape[:2]) < SMALLEST:
        return None
    if not is_known(array) or array.dtype.kind != "f":
        return None
    pixels = np.asarray(array)
    alpha = pixels[..., 3]
    if not np.isfinite(pixels).all() or alpha.min() < -ROUNDING or alpha.max() > 1 + ROUNDING:
        return None
    return encode(np.clip(pixels, 0, None))


def _kinds() -> tuple[type, type]:
    # jax.Array is an abstract type, which IPython does not look for.
    return np.ndarray, type(jnp.zeros(()))
