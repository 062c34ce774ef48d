"""What a fit makes small. A loss is a function of (predicted, target), both (..., C), to a scalar.

The smoothness prior is that of DiffDVR (Weiss and Westermann, "Differentiable direct volume
rendering", 2021): the mean squared difference of neighbouring colours, 0.4 times in their fits.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import jax
import jax.numpy as jnp

from jaxvr._core.checks import refuse_bytes

Array = jax.Array
Loss = Callable[[Array, Array], Array]


def l1(predicted: Array, target: Array) -> Array:
    """Mean absolute difference (); its derivative is 0 where the two agree exactly. Bytes are a
    ValueError: their differences wrap round."""
    _require_floats(predicted, target)
    return jnp.mean(jnp.abs(predicted - target))


def l2(predicted: Array, target: Array) -> Array:
    """Mean squared difference (). Bytes are a ValueError, as for `l1`."""
    _require_floats(predicted, target)
    return jnp.mean((predicted - target) ** 2)


def _require_floats(predicted: Any, target: Any) -> None:
    refuse_bytes("predicted", predicted)
    refuse_bytes("target", target)


def smoothness(x: Array) -> Array:
    """Mean squared difference () of neighbours along the first axis of x (K, ...); 0 for K = 1."""
    return jnp.mean((x[1:] - x[:-1]) ** 2) if x.shape[0] > 1 else jnp.zeros((), x.dtype)


LOSSES: dict[str, Loss] = {"l1": l1, "l2": l2}


def loss_of(loss: Any) -> Loss:
    """The loss of a name, or the function itself."""
    if not isinstance(loss, str) and callable(loss):
        return cast(Loss, loss)
    if loss not in LOSSES:
        raise ValueError(f"loss must be one of {sorted(LOSSES)} or a function, but is {loss!r}.")
    return LOSSES[loss]
