"""The units that pictures are computed in: those of no user, so that they depend on none.

Three units are the user's: of length (points, eye, extent, and one over it in extinctions), of the
scalar (values and positions of control points), and none of colours. A picture is the same in any
of them; floats are not, since squares, reciprocals and differences of numbers near the ends of
their range under- and overflow. So verbs compute with points that are near 1, and with control
points that are: both are multiplied by powers of two, which is exact, and so are derivatives.

What is left is a range for the numbers themselves. With B = 100 in float32 and 960 in float64

    2^-B <= largest coordinate of the points <= 2^B        (8e-31 to 1e30; 1e-289 to 1e289)
    2^-B <= largest of the scalars and positions           (up to the largest float)

or all of them are 0. Below, some of the numbers are subnormal, which XLA takes for 0; above, some
of the extinctions, which are one over a length, are. Then the status of every ray says so.

Derivatives by scalars are one over a scalar, so they need more: the largest of the scalars and
positions is to be at most 2^B as well. Pictures above are right, but derivatives by values and
positions are NaN there (a transform of JAX has no status to show, and 0 would be no one's notice).
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxvr._core.status import LENGTHS, SCALARS, UNSORTED
from jaxvr._core.units import exponent_of, is_large, is_none, is_small, power_of_two, times_told
from jaxvr.optics import TransferFunction
from jaxvr.view.rays import Rays
from jaxvr.volume import AbstractVolume

Array = jax.Array


class Units(NamedTuple):
    """length, scalar (): what the user's numbers are multiplied with, powers of two. status ():
    bits for all rays. smooth (): whether derivatives by scalars are in range."""

    length: Array
    scalar: Array
    status: Array
    smooth: Array

    def of_scalars(self, x: Array) -> Array:
        """Values or positions in such units."""
        return times_told(x, self.scalar, self.smooth)


def units_of(lengths: Array, scalars: Array, positions: Array | None = None, parts=0) -> Units:
    """Those for coordinates, scalars and control points of any shape; or for lengths of segments,
    which may be parts of 2^-parts of what the user's range is told of."""
    dtype = lengths.dtype
    size, field = exponent_of(lengths), exponent_of(scalars)
    points = field if positions is None else exponent_of(positions)
    most = jnp.maximum(points, field)
    least = jnp.where(is_none(size), size, size + parts)
    bits = jnp.where(is_small(least, dtype) | is_large(size, dtype), LENGTHS, 0)
    bits = bits | jnp.where(is_small(most, dtype), SCALARS, 0)
    if positions is not None:
        bits = bits | jnp.where(_is_ascending(positions), 0, UNSORTED)
    # Control points near 1, unless scalars overflow then.
    room = int(jnp.finfo(dtype).maxexp) - 2
    scale = jnp.where(is_none(points), -field, jnp.minimum(-points, room - field))
    return Units(
        power_of_two(jnp.where(is_none(size), 0, -size), dtype),
        power_of_two(jnp.where(is_none(most), 0, scale), dtype),
        bits.astype(jnp.int32),
        ~is_large(most, dtype),
    )


def units_in(volume: AbstractVolume, positions: Array | None = None) -> Units:
    """Those for a volume, and for control points."""
    return units_of(
        _joined(volume.named(volume.lengths)), _joined(volume.named(volume.scalars)), positions
    )


def _joined(arrays: tuple[Array, ...]) -> Array:
    if len(arrays) == 1:
        return arrays[0]
    return jnp.concatenate([jnp.reshape(x, -1) for x in arrays])


def _is_ascending(positions: Array) -> Array:
    held = lax.stop_gradient(positions)
    return jnp.all(held[1:] >= held[:-1]) & jnp.all(jnp.isfinite(held))


def _ascending(positions: Array) -> Array:
    """Positions (K,) that ascend and are finite, made of any."""
    held = lax.stop_gradient(positions)
    return lax.cummax(jnp.where(jnp.isfinite(held), held, 0))


def volume_in(units: Units, volume: Any) -> Any:
    """A volume in such units."""
    lengths = {name: getattr(volume, name) * units.length for name in volume.lengths}
    scalars = {name: units.of_scalars(getattr(volume, name)) for name in volume.scalars}
    return dataclasses.replace(volume, **lengths, **scalars)


def rays_in(units: Units, rays: Rays) -> Rays:
    """Rays in such units."""
    near, far = (None if x is None else x * units.length for x in (rays.near, rays.far))
    return Rays(rays.origins * units.length, rays.directions, near, far)


def transfer_in(units: Units, transfer: TransferFunction) -> TransferFunction:
    """A transfer function in such units, which are those of its own positions: their status says
    whether these ascend. An extinction that overflows there hides all behind it within no length at
    all, and stays finite."""
    most = jnp.asarray(jnp.finfo(transfer.extinctions.dtype).max / 8, transfer.extinctions.dtype)
    # Pieces of a segment go from one position to the next, which would not end among these.
    unsorted = (units.status & UNSORTED) != 0
    positions = jnp.where(unsorted, _ascending(transfer.positions), transfer.positions)
    return dataclasses.replace(
        transfer,
        positions=units.of_scalars(positions),
        extinctions=jnp.minimum(transfer.extinctions / units.length, most),
        offset=0.0,
    )
