"""Transforms between the numbers that an optimiser moves and those of a transfer function.

An optimiser's numbers are raw: any real number is allowed. A transform is a pytree that holds its
own constants, with `to_value(raw)` and its inverse `to_raw(value)`. The inverse is finite for every
allowed value, those on the border included: they are moved inside by a small margin first.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from jaxvr._core.checks import as_floats, require_finite
from jaxvr._core.pytree import pytree
from jaxvr.optics.transfer import TransferFunction

Array = jax.Array

FIELDS = ("positions", "colors", "extinctions")


class Transform(Protocol):
    """Raw numbers to values and back; both are arrays of one shape."""

    def to_value(self, raw: Array) -> Array: ...

    def to_raw(self, value: Array) -> Array: ...


@pytree
class Sigmoid:
    """Values between two bounds: low + (high - low) / (1 + exp(-raw)).

    low, high (): the bounds. Values are kept away from both by 1e-4 of the range.
    """

    low: Any = 0.0
    high: Any = 1.0

    def to_value(self, raw: Array) -> Array:
        return self.low + (self.high - self.low) * jax.nn.sigmoid(raw)

    def to_raw(self, value: Array) -> Array:
        part = jnp.clip((value - self.low) / (self.high - self.low), 1e-4, 1 - 1e-4)
        return jnp.log(part) - jnp.log1p(-part)


@pytree
class Softplus:
    """Values >= 0: unit * log(1 + exp(raw)), which is about unit * raw for large raw.

    unit (): the size of a raw step of 1, that is of the values to be expected. Values are kept
    above 1e-4 units.
    """

    unit: Any = 1.0

    def to_value(self, raw: Array) -> Array:
        return self.unit * jax.nn.softplus(raw)

    def to_raw(self, value: Array) -> Array:
        x = jnp.maximum(value / self.unit, 1e-4)
        return x + jnp.log(-jnp.expm1(-x))


@pytree
class Ordered:
    """Ascending values (K,) from `first` to `last`, whose gaps are a softmax of raw (K - 1,).

    Gaps are kept above 1e-6 of the range, so a jump becomes a steep ramp. The ends stay.
    """

    first: Any
    last: Any

    def to_value(self, raw: Array) -> Array:
        gaps = 1e-6 + (1 - 1e-6 * raw.shape[0]) * jax.nn.softmax(raw)
        inner = self.first + (self.last - self.first) * jnp.cumsum(gaps)[:-1]
        ends = [jnp.asarray(x, raw.dtype)[None] for x in (self.first, self.last)]
        return jnp.concatenate([ends[0], inner.astype(raw.dtype), ends[1]])

    def to_raw(self, value: Array) -> Array:
        gaps = jnp.diff(value) / (self.last - self.first)
        share = (gaps - 1e-6) / (1 - 1e-6 * gaps.shape[0])
        return jnp.log(jnp.maximum(share, 1e-6))


@pytree
class Parameters:
    """A transfer function, and which of its fields move by which transform.

    transfer: the start, and what the fields that do not move stay at. transforms: from field name
    ("positions", "colors", "extinctions") to transform.
    """

    transfer: TransferFunction
    transforms: dict[str, Any]

    @staticmethod
    def of(
        transfer: TransferFunction, free: Any = ("colors", "extinctions"), size: float = 1.0
    ) -> Parameters:
        """Checked. `free`: names of fields, or a dict from name to transform. `size`: of the
        volume, a length.

        Defaults: `Sigmoid()` for colours, `Softplus(unit)` for extinctions with the mean of those
        that are positive as unit (one over `size` if none is), `Ordered` for positions between the
        first and the last.
        """
        names = [free] if isinstance(free, str) else list(free)
        if unknown := [n for n in names if n not in FIELDS]:
            raise ValueError(f"free names {unknown}, but a transfer function has {list(FIELDS)}.")
        if not names:
            raise ValueError(f"free is empty: name some of {list(FIELDS)}.")
        given = free if isinstance(free, Mapping) else {}
        transforms = {n: given[n] if n in given else _default(n, transfer, size) for n in names}
        return Parameters(transfer, transforms)

    def raw(self) -> dict[str, Array]:
        """The start, as the optimiser sees it."""
        raw = {n: t.to_raw(getattr(self.transfer, n)) for n, t in self.transforms.items()}
        for name, x in raw.items():
            require_finite(f"the raw {name} of the start", x)
        return raw

    def transfer_of(self, raw: dict[str, Array]) -> TransferFunction:
        """The transfer function of raw numbers; not checked, so that it works under jit."""
        new = {
            n: t.to_value(raw[n]).astype(self.transfer.dtype) for n, t in self.transforms.items()
        }
        leaves = [new.get(n, getattr(self.transfer, n)) for n in FIELDS]
        return jax.tree.unflatten(jax.tree.structure(self.transfer), leaves)


def noise(positions: Any, extinction: Any, seed: int = 0, *, dtype: Any = None) -> TransferFunction:
    """A transfer function to start from: colours sigmoid(n), extinctions extinction * softplus(n).

    positions (K,); n standard normal, from `seed`. `extinction` (): per unit of length, of the size
    expected; a few divided by the volume's diagonal is a good choice. dtype: that of positions if
    None.
    """
    floats = as_floats("positions", positions, ndim=1)
    if not isinstance(positions, jax.Array):
        positions = np.asarray(as_floats("positions", positions, dtype=np.float64))
    rng = np.random.default_rng(seed)
    colors = 1 / (1 + np.exp(-rng.standard_normal((len(positions), 3))))
    extinctions = float(extinction) * np.log1p(np.exp(rng.standard_normal(len(positions))))
    dtype = floats.dtype if dtype is None else dtype
    return TransferFunction(positions, colors, extinctions, dtype=dtype)


def _default(name: str, transfer: TransferFunction, size: float) -> Any:
    if name == "positions":
        first, last = transfer.positions[0], transfer.positions[-1]
        if not first < last:
            raise ValueError("Free positions need a first one below the last one.")
        return Ordered(first, last)
    if name == "extinctions":
        e = np.asarray(transfer.extinctions, np.float64)
        unit = float(e[e > 0].mean()) if (e > 0).any() else 1 / size
        return Softplus(jnp.asarray(unit, transfer.dtype))
    colors = np.asarray(transfer.colors)
    if colors.min() < 0 or colors.max() > 1:
        raise ValueError(
            f"Colours from {colors.min():g} to {colors.max():g} do not fit between 0 and 1. Pass "
            'free={"colors": Sigmoid(low, high), ...} with bounds round them.'
        )
    return Sigmoid()
