"""What a volume is: arrays with a field, which fills a part of space.

The doors (`render`, `trace`, `fit`, ...) ask a volume for what stands in `AbstractVolume` and for
nothing else; only the tracer that walks through it knows more. To add one, write a frozen dataclass
that JAX takes apart (`jax.tree_util.register_dataclass`), derive it from `AbstractVolume`, and say
which of its fields are `lengths` and which are `scalars`: by these names doors check them, know the
dtype, and bring them to units in which nothing under- or overflows. Left to write are `bounds` and
`default_tracer`. What more there is has a default, which a volume that knows better replaces.
"""

from __future__ import annotations

import abc
import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from .._core.checks import is_concrete, require_finite
from .._core.offsets import NOWHERE, Origin, absolute
from .._core.status import BROKEN
from .._core.units import norm
from .integrity import found_right, remember

if TYPE_CHECKING:
    from jaxvr.trace.base import AbstractTracer

Array = jax.Array


class AbstractVolume(abc.ABC):
    """A field in a part of space, as a pytree with named arrays.

    lengths: names of fields that are coordinates or lengths, in one unit; which are multiplied by a
        power of two before a picture is computed, and rays with them.
    scalars: names of fields that are values of the field, which are multiplied by another one.
        All of both are float32, or all float64. Fields that are neither stay as they are.
    origin (3,), offset: plain numbers, static, 0 unless a volume has them: what its lengths, and
        its scalars, are relative to. Doors take rays and transfer functions relative to them.
    """

    lengths: ClassVar[tuple[str, ...]] = ()
    scalars: ClassVar[tuple[str, ...]] = ()
    origin: Origin = NOWHERE
    offset: float = 0.0

    @abc.abstractmethod
    def bounds(self) -> tuple[Any, Any]:
        """Lower and upper corner (3,), (3,) of a box that holds all of it, relative to `origin`."""

    @abc.abstractmethod
    def default_tracer(self) -> AbstractTracer:
        """The tracer that serves where the user names none."""

    @property
    def dtype(self) -> np.dtype:
        """That of lengths and scalars, and so of pictures."""
        return np.dtype(self.named(self.scalars)[0].dtype)

    def named(self, names: tuple[str, ...]) -> tuple[Any, ...]:
        """The fields of these names."""
        return tuple(getattr(self, name) for name in names)

    def replace(self, **changes: Any) -> Any:
        """The same volume with other fields; works under `jit` and `grad`."""
        return dataclasses.replace(self, **changes)  # type: ignore[type-var]

    def diagonal(self) -> float:
        """Length of the diagonal of the box."""
        low, high = (np.asarray(x, np.float64) for x in self.bounds())
        return norm(high - low)

    # Checks.

    def require(self) -> None:
        """ValueError for what no picture can be made of, with the field's name. Of numbers that are
        traced only the dtype is looked at."""
        kind = type(self).__name__
        self._require_names()
        for name in (*self.lengths, *self.scalars):
            x = getattr(self, name)
            found = getattr(x, "dtype", type(x).__name__)
            if found not in (np.float32, np.float64) or np.dtype(found) != self.dtype:
                raise ValueError(
                    f"{kind}.{name} is {found}, but lengths and scalars of a volume must be arrays "
                    "of one dtype, float32 or float64."
                )
            if is_concrete(x) and not found_right((x,)):
                require_finite(f"{kind}.{name}", x)
                remember((x,))

    def _require_names(self) -> None:
        """What is named twice would be scaled twice, and a string is a list of its letters."""
        kind = type(self).__name__
        see = "see jaxvr.volume.AbstractVolume."
        for what in ("lengths", "scalars"):
            names = getattr(self, what)
            if not names:
                raise ValueError(
                    f"{kind}.{what} must name the fields of {kind} that are {what}, but is empty: "
                    f"{see}"
                )
            if isinstance(names, str):
                raise ValueError(
                    f"{kind}.{what} must be a tuple of names, ({names!r},), but is a string: {see}"
                )
            for name in names:
                if not hasattr(self, name):
                    raise ValueError(f"{kind}.{what} names {name!r}, which {kind} has not: {see}")
        every = (*self.lengths, *self.scalars)
        for name in every:
            if every.count(name) > 1:
                raise ValueError(
                    f"{kind}.lengths and {kind}.scalars must name a field once, but name {name!r} "
                    f"{every.count(name)} times: {see}"
                )

    def hold(self, bits: Array) -> Array:
        """Status bits of any shape, with BROKEN where what `require` would refuse is traced."""
        for x in self.named(self.lengths):
            if not is_concrete(x):
                bits = jnp.where(jnp.isfinite(x).all(), bits, bits | BROKEN)
        return bits

    def unasked(self, image: Array, bits: Array) -> Array:
        """An image (..., 4) whose status (...) nobody asks for, as under a user's own `jit`: NaN,
        and so are gradients, where `hold` found the volume broken. Without that a wrong picture
        would look like another."""
        if is_concrete(bits) or is_concrete(*jax.tree.leaves(self)):
            return image
        broken = (bits & BROKEN) != 0
        return image * jnp.where(broken, jnp.nan, 1).astype(image.dtype)[..., None]

    def in_range(self, compiled: bool) -> Any:
        """Whether () integers name what the volume has, asked inside of compiled functions.

        compiled: whether C walks, whose loops look at what they load themselves.
        """
        return True

    # What is in it, for hints, default transfer functions and plots (NumPy; not inside `jit`).

    def value_range(self) -> tuple[float, float]:
        """The least and the largest value of the field, with the offset."""
        values = self.weighted_values()[0]
        return float(values.min()), float(values.max())

    def weighted_values(self) -> tuple[np.ndarray, np.ndarray]:
        """Values (n,), with the offset, and the part (n,) float64 of the volume that each stands
        for; the parts add up to 1. By default all count alike."""
        flat = [np.asarray(x).reshape(-1) for x in self.named(self.scalars)]
        values = np.concatenate(flat)
        values = absolute(values, self.offset) if self.offset else values
        return values, np.full(len(values), 1 / max(len(values), 1))

    def levels(self) -> np.ndarray | None:
        """All values (n,) that the field takes, where these are some and no interval."""
        return None

    def hull(self) -> np.ndarray:
        """Points (P, 3) float64 whose convex hull holds the volume, relative to `origin`. By
        default the corners of the box."""
        low, high = (np.asarray(x, np.float64) for x in self.bounds())
        corner = np.stack(np.meshgrid(*[[False, True]] * 3, indexing="ij"), -1).reshape(-1, 3)
        return np.where(corner, high, low)

    def dots(self) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Places (n, 3), volumes (n,) and values (n,), float64, of parts that it consists of, for a
        rough picture; None where there is no such list."""
        return None

    def glance(self) -> tuple[Array | None, Array, Array]:
        """What a cheap look at every picture reduces: rows of numbers of values or None, values,
        and points (P, 3) in whose box it lies."""
        values = jnp.concatenate([jnp.reshape(x, -1) for x in self.named(self.scalars)])
        return None, values, jnp.asarray(self.hull(), self.dtype)

    @property
    def parts(self) -> int:
        """About how many cells, or samples, it consists of."""
        return max(sum(x.size for x in self.named(self.scalars)), 1)

    @property
    def field_name(self) -> str:
        """What the scalar is called, "" if it has no name."""
        return ""
