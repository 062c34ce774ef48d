"""A batch of rays as one beam: what of the mesh it may meet, and where its rays stand in it.

Rays that share an origin (a tile of a pinhole camera's image) or a direction (of an orthographic
one) are points (x, y) of a plane across them. In the beam's own axes, with z along its middle, a
vertex is seen at

    pinhole:  (X, Y) / W = (q_x, q_y) / q_z        parallel:  W = 1

with q from the origin. A line meets a triangle where it passes its three edges on the same side,

    E_ij(x, y) = (x_j - x_i) (y - y_i) - (y_j - y_i) (x - x_i).

That rounds, so it serves to find which rays *may* meet a face: a vertex is seen within d of where
it is, which changes E by at most about 2 d (size of the face) for rays that meet it, and within a
bound of that E counts as zero. Which rays do meet the face is decided by exact signs
(`trace.face`). A face of which part is beside the eye or behind it has no such image; any ray may
meet it. So may rays that share neither origin nor direction, which is slow and right.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

Array = jax.Array

# Units in the last place by which a point's image may be off: of a difference, a scalar product and
# a quotient, and as much again for the ray's own.
ROUNDINGS = 4


class Beam(NamedTuple):
    """R rays. All floats are constants to derivatives.

    origin (3,): of the first ray, in the scene's units. axes (3, 3): rows x, y, z.
    pinhole (): whether rays come from one point; else W = 1. narrow (): whether (x, y) mean
    anything. place (2, R): x and y of each ray. low, high (2,): bounds of them.
    """

    origin: Array
    axes: Array
    pinhole: Array
    narrow: Array
    place: Array
    low: Array
    high: Array


def are_rays(origins: Array, directions: Array) -> Array:
    """Which (R,) of rays (3, R) are any: finite, and with a direction."""
    finite = jnp.isfinite(origins) & jnp.isfinite(directions)
    return jnp.all(finite, axis=0) & jnp.any(directions != 0, axis=0)


def beam_of(origins: Array, directions: Array) -> Beam:
    """The beam of rays (3, R) in the scene's units, where coordinates are below 1 in size. What are
    no rays stand for one that is, so that they do not hide what others meet."""
    origins, directions = lax.stop_gradient((origins, directions))
    there = are_rays(origins, directions)
    one = jnp.argmax(there)
    origins, directions = (jnp.where(there, x, x[:, one, None]) for x in (origins, directions))
    origin, direction = origins[:, :1], directions[:, :1]
    parallel = jnp.all(directions == direction)
    pinhole = jnp.all(origins == origin) & ~parallel
    size = jnp.max(jnp.abs(directions), axis=0)
    unit = directions / size[None]
    unit = unit / jnp.sqrt(jnp.sum(unit * unit, axis=0))[None]
    forward = _unit(jnp.sum(unit, axis=1))
    across = jnp.zeros_like(forward).at[jnp.argmin(jnp.abs(forward))].set(1)
    right = _unit(jnp.cross(forward, across))
    axes = jnp.stack([right, jnp.cross(right, forward), forward])
    ahead = _apply(axes, unit)
    # A beam as wide as half a turn has no plane across it.
    narrow = parallel | (pinhole & jnp.all(ahead[2] > 0.1))
    deep = jnp.where(narrow & pinhole, ahead[2], 1)
    place = jnp.where(pinhole, ahead[:2] / deep[None], _apply(axes, origins - origin)[:2])
    return Beam(origin[:, 0], axes, pinhole, narrow, place, place.min(1), place.max(1))


def _unit(v: Array) -> Array:
    size = jnp.sqrt(jnp.sum(v * v))
    # Directions that cancel have no mean; then the beam is not narrow, and any axis will do.
    axis = jnp.zeros_like(v).at[2].set(1)
    return jnp.where(size > 0, v / jnp.where(size > 0, size, 1), axis)


def _apply(axes: Array, points: Array) -> Array:
    """axes (N, 3) times points (3, ...), term by term: a matrix product may round more."""
    x, y, z = points
    return jnp.stack([a[0] * x + a[1] * y + a[2] * z for a in axes])


class Sides(NamedTuple):
    """Half spaces (4,) round a beam: n . q + c >= 0 for all q from its origin that its rays meet
    ahead of them. normals (4, 3), offsets (4,), and slack () for each unit of |q|."""

    normals: Array
    offsets: Array
    slack: Array


def sides(beam: Beam) -> Sides:
    """All of space, for a beam that is not narrow."""
    right, up, forward = beam.axes
    normals, offsets = [], []
    for axis, bound, sign in ((right, 0, 1), (right, 0, -1), (up, 1, 1), (up, 1, -1)):
        at = (beam.low if sign > 0 else beam.high)[bound]
        normals.append(sign * jnp.where(beam.pinhole, axis - at * forward, axis))
        offsets.append(jnp.where(beam.pinhole, 0, -sign * at))
    reach = 1 + jnp.max(jnp.abs(beam.place))
    slack = 2 * ROUNDINGS * jnp.finfo(right.dtype).eps * reach
    return Sides(
        jnp.where(beam.narrow, jnp.stack(normals), 0),
        jnp.where(beam.narrow, jnp.stack(offsets), 1),
        slack,
    )


def meets_boxes(beam: Beam, low: Array, high: Array) -> Array:
    """Whether the beam may meet boxes with corners (3, N): never a wrong no."""
    normals, offsets, slack = sides(beam)
    middle, half = 0.5 * (low + high) - beam.origin[:, None], 0.5 * (high - low)
    size = jnp.sum(jnp.abs(middle) + half, axis=0)
    met = jnp.ones(low.shape[1:], bool)
    for normal, offset in zip(normals, offsets, strict=True):
        farthest = offset + sum(
            n * m + jnp.abs(n) * h for n, m, h in zip(normal, middle, half, strict=True)
        )
        met = met & (farthest >= -slack * (1 + size))
    return met


def outside(around: Sides, q: Array) -> Array:
    """On which sides (4, ...) of a beam points q (3, ...), from its origin, surely lie."""
    x, y, z = q
    size = jnp.abs(x) + jnp.abs(y) + jnp.abs(z)
    out = [
        n[0] * x + n[1] * y + n[2] * z + offset < -around.slack * (1 + size)
        for n, offset in zip(around.normals, around.offsets, strict=True)
    ]
    return jnp.stack(out)


class Outline(NamedTuple):
    """Faces (N,) as the beam sees them: coefficients (3, N) of the three edge functions a x + b y +
    c, in units of what is taken for zero."""

    a: Array
    b: Array
    c: Array


class Box(NamedTuple):
    """Where the beam sees faces (N,): bounds (2, N) of x and y, with room for rounding; all of the
    plane for a face without an image."""

    low: Array
    high: Array


def outline(beam: Beam, corners: Array) -> tuple[Outline, Box]:
    """Outlines of faces, and boxes round them.

    corners (3, 3, N): coordinates, by corner, from the beam's origin.
    """
    # Barriers keep XLA from computing all of this again for each of the twelve numbers.
    held = lax.optimization_barrier
    eps = jnp.finfo(corners.dtype).eps
    right, up, depth = held(_apply(beam.axes, corners))
    reach = 1 + jnp.max(jnp.abs(beam.place))
    size = jnp.sum(jnp.abs(corners), axis=0)
    w = jnp.where(beam.pinhole, depth, 1)
    near = w > 1e-3 * size  # or its image is too far off to be of use
    ahead = beam.narrow & (jnp.all(near, axis=0) | ~beam.pinhole)
    w = jnp.where(near, w, 1)
    x, y = right / w, up / w
    blur = ROUNDINGS * eps * (size / w + 1) * (reach + jnp.abs(x) + jnp.abs(y))
    x, y, d, ahead = held((x, y, jnp.max(blur, axis=0), ahead))
    low_x, high_x, low_y, high_y = x.min(0), x.max(0), y.min(0), y.max(0)
    # Edges opposite each of the corners.
    x_i, x_j, y_i, y_j = (jnp.roll(v, shift, axis=0) for v in (x, y) for shift in (-1, -2))
    to_x, to_y = x_j - x_i, y_j - y_i
    length = jnp.abs(to_x) + jnp.abs(to_y)
    slack = 4 * d[None] * (length + d[None])
    slack = slack + 4 * eps * (jnp.abs(to_x * y_i) + jnp.abs(to_y * x_i))
    slack = slack + 4 * (d * (high_x - low_x + high_y - low_y))[None]
    # Without an image all three are zero, and any ray may meet the face.
    scale = held(jnp.where(ahead[None], 1 / slack, 0))
    a, b, c = -to_y * scale, to_x * scale, (to_y * x_i - to_x * y_i) * scale
    box = Box(
        jnp.where(ahead[None], jnp.stack([low_x, low_y]) - 2 * d[None], -jnp.inf),
        jnp.where(ahead[None], jnp.stack([high_x, high_y]) + 2 * d[None], jnp.inf),
    )
    return Outline(a, b, c), box


def overlaps(box: Box, low: Array, high: Array) -> Array:
    """Whether boxes (2, N) overlap those with bounds (2, S): (S, N)."""
    apart = (box.low[:, None] > high[..., None]) | (box.high[:, None] < low[..., None])
    return ~(apart[0] | apart[1])


def may_meet(face: Outline, place: Array) -> Array:
    """Whether rays at place (2, ..., 1, R) may meet faces (..., N, 1): (..., N, R)."""
    x, y = place
    e = [a * x + b * y + c for a, b, c in zip(face.a, face.b, face.c, strict=True)]
    left = jnp.minimum(jnp.minimum(e[0], e[1]), e[2]) >= -1
    right = jnp.maximum(jnp.maximum(e[0], e[1]), e[2]) <= 1
    return left | right
