"""Vertices as a ray sees them: sheared so that the ray is the depth axis.

With k_z the largest component of the direction d, and k_x, k_y the other two so that the frame is
right-handed about d, a point p goes to (Woop, Benthin and Wald 2013, "Watertight Ray/Triangle
Intersection", section 3)

    x = (p - o)_kx - S_x (p - o)_kz      S_x = d_kx / d_kz
    y = (p - o)_ky - S_y (p - o)_kz      S_y = d_ky / d_kz      z = sign(d_kz) (p - o)_kz

so that the ray is the line x = y = 0 and z |d| / |d_kz| is the distance along it. Lines become
lines, so a face contains the ray's foot if its 2D image contains the origin.

Departing from the paper, x and y are computed with about one and a half times the working
precision and then rounded: relative to their own size and not to the distance of the eye, which
is what keeps grazing rays right in float32. Every product in it is exact, so that all compiled
kernels give the same bits with FMA or without, and two faces that share a vertex agree on where
it is. z is a pair whose sum is exact.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxvr._core.pytree import pytree
from jaxvr.numerics.exact import Halves, halves, head, split, two_product, two_sum
from jaxvr.view.rays import Rays

Array = jax.Array


class Interval(NamedTuple):
    """What of R rays is seen, and how long it is: near, far and stretch of `ShearedRays`."""

    near: Array | None
    far: Array | None
    stretch: Array


@pytree
class ShearedRays:
    """R rays, with their axes permuted. All arrays are (R,).

    axis_x, axis_y, axis_z: int32, the permutation (k_x, k_y, k_z).
    origin_x, origin_y, origin_z: origins in the permuted axes, in the scene's units.
    shear_x, shear_y: S_x, S_y; shear_x_low, shear_y_low: what rounding them lost.
    sign: of d_kz. stretch: world length for one unit of z. near, far: depths between which a ray
    is seen, None for 0 and for no end. stop: depth behind which nothing can be seen any more, at
    `far` or farther; None with `far`.
    """

    axis_x: Array
    axis_y: Array
    axis_z: Array
    origin_x: Array
    origin_y: Array
    origin_z: Array
    shear_x: Array
    shear_y: Array
    shear_x_low: Array
    shear_y_low: Array
    sign: Array
    stretch: Array
    near: Array | None = None
    far: Array | None = None
    stop: Array | None = None

    @property
    def interval(self) -> Interval:
        return Interval(self.near, self.far, self.stretch)

    @property
    def eye(self) -> Array:
        """Depth of the eye from the scene's origin."""
        return self.sign * self.origin_z


# Rows of a vertex (4, R) as R rays see it: projected coordinates, depth from the scene's origin
# (`sign` times the coordinate along k_z, which is exact; `eye` is that of the eye), and scalar.
# One array and not four, so that a selection between vertices is one kernel.
X, Y, Z, VALUE = range(4)


def shear_rays(rays: Rays, scale: Array) -> ShearedRays:
    """Rays in the scene's units, which are world units times `scale` (a power of two). Those that
    end do so at `far`: see `stopping`."""
    d = rays.directions
    # d is scaled by a power of two, exactly, so that squares and residuals cannot underflow.
    largest = jnp.max(jnp.abs(lax.stop_gradient(d)), axis=-1)
    axis_z = jnp.argmax(jnp.abs(lax.stop_gradient(d)), axis=-1).astype(jnp.int32)
    forward = jnp.take_along_axis(d, axis_z[:, None], -1)[:, 0] >= 0
    first, second = (axis_z + 1) % 3, (axis_z + 2) % 3
    axis_x = jnp.where(forward, first, second)
    axis_y = jnp.where(forward, second, first)

    def pick(v: Array, axis: Array) -> Array:
        return jnp.take_along_axis(v, axis[:, None], -1)[:, 0]

    o = rays.origins * scale
    d_x, d_y, d_z = pick(d, axis_x), pick(d, axis_y), pick(d, axis_z)
    s_x, s_y = d_x / d_z, d_y / d_z

    def lost(numerator: Array, quotient: Array) -> Array:
        p, e = two_product(halves(quotient), halves(d_z))
        return lax.stop_gradient(((numerator - p) - e) / d_z)

    norm = jnp.sqrt(jnp.sum((d / largest[:, None]) ** 2, -1)) * largest
    stretch = norm / jnp.abs(d_z) / scale
    near, far = (None if x is None else _depth(x, stretch) for x in (rays.near, rays.far))
    return ShearedRays(
        axis_x,
        axis_y,
        axis_z,
        pick(o, axis_x),
        pick(o, axis_y),
        pick(o, axis_z),
        s_x,
        s_y,
        lost(d_x, s_x),
        lost(d_y, s_y),
        jnp.where(forward, 1.0, -1.0).astype(d.dtype),
        stretch,
        near,
        far,
        None if far is None else lax.stop_gradient(far),
    )


def _depth(distance: Array, stretch: Array) -> Array:
    """Where distances along rays lie. What is infinitely far does not move with the ray."""
    known = jnp.isfinite(distance)
    return jnp.where(known, jnp.where(known, distance, 0) / stretch, distance)


def _accurate(a: Array, a_low: Array, z: Halves, z_low: Array, s: Array, s_low: Array) -> Array:
    """(a + a_low) - (s + s_low) (z + z_low), by exact products of halves."""
    s_high, s_rest = split(s)
    first, lost = two_sum(a, -(s_high * z.high))
    low = ((lost - s_high * z.low) - s_rest * z.high) - s_rest * z.low
    return first + (((low + a_low) - s_high * head(z_low)) - head(s_low) * z.high)


@jax.custom_jvp
def _shear(p_x, p_y, p_z, o_x, o_y, o_z, s_x, s_y, s_x_low, s_y_low, sign):
    a_x, a_x_low = two_sum(p_x, -o_x)
    a_y, a_y_low = two_sum(p_y, -o_y)
    a_z, a_z_low = two_sum(p_z, -o_z)
    z = halves(a_z)
    return (
        _accurate(a_x, a_x_low, z, a_z_low, s_x, s_x_low),
        _accurate(a_y, a_y_low, z, a_z_low, s_y, s_y_low),
        sign * a_z,
        sign * a_z_low,
    )


@_shear.defjvp
def _shear_jvp(primals, tangents):
    _, _, p_z, _, _, o_z, s_x, s_y, _, _, sign = primals
    dp_x, dp_y, dp_z, do_x, do_y, do_z, ds_x, ds_y, _, _, _ = tangents
    z, dz = p_z - o_z, dp_z - do_z
    out = _shear(*primals)
    dx = dp_x - do_x - ds_x * z - s_x * dz
    dy = dp_y - do_y - ds_y * z - s_y * dz
    return out, (dx, dy, sign * dz, jnp.zeros_like(dz))


def shear_points(rays: ShearedRays, p_x: Array, p_y: Array, p_z: Array):
    """x, y, z, z_low of points given by coordinates in each ray's permuted axes, (R,) each."""
    r = rays
    return _shear(
        *(p_x, p_y, p_z, r.origin_x, r.origin_y, r.origin_z),
        *(r.shear_x, r.shear_y, r.shear_x_low, r.shear_y_low, r.sign),
    )
