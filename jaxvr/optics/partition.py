"""A segment, cut at every control point that its scalar crosses.

Between two control points the transfer function is linear, so that a piece of a segment has a
closed integral. The K control points x_0 <= ... <= x_{K-1} make K + 1 slabs: slab k spans
[x_{k-1}, x_k], and the first and last reach to infinity with constant values. One loop iteration
handles one piece, as in Espinha and Celes 2005, Figure 6: a `Cursor` remembers where in its
segment each ray stands, and moves to the neighbouring slab when the piece ends there.

Two control points at one position are a slab of no width, a jump. A ray that crosses it gets a
piece of no length there, which contributes nothing but the derivative with respect to where the
jump is.

A slab is transparent if the extinction at both of its control points is 0. A run of adjacent
transparent slabs contributes nothing wherever it is cut, so `merge_transparent` takes the control
points inside of it away, and a segment passes the run in one piece. The image is the same, and so
are derivatives with respect to segments. Those with respect to the transfer function are not: a
control point of extinction 0 that has been taken away has a derivative all the same.

Derivatives hold the partition fixed: the integrand is continuous across the ends of a piece, so
the terms from moving ends cancel between neighbours (Leibniz), and no division by the difference
of the end scalars is left. First derivatives of whole segments are exact, second ones are not.
At kinks (a scalar that stays exactly at a control point) the derivative is the one through the
slab that the value was taken from. Where a segment starts or ends exactly at a jump, the jump's
own derivative is counted only if the segment goes through.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxvr._core.pytree import pytree, static
from jaxvr.optics.transfer import TransferFunction

Array = jax.Array
_hold = lax.stop_gradient

# The width given to a jump, so that slope times width is its height. Anything far below the
# rounding of a scalar does; its square must not underflow in float32.
JUMP_WIDTH = 1e-20


class Segment(NamedTuple):
    """Straight pieces of rays inside one cell, where the scalar is linear.

    front, back (R,): scalar at the two ends, that first which the stream comes to first: nearer the
    eye, or farther from it where segments come from behind. length (R,): world length.
    """

    front: Array
    back: Array
    length: Array


def turned(segment: Segment) -> Segment:
    """The same pieces, passed the other way."""
    return Segment(segment.back, segment.front, segment.length)


class Cursor(NamedTuple):
    """scalar (R,): where the next piece of each segment starts; slab (R,) int32: in which slab."""

    scalar: Array
    slab: Array


@pytree
class Nodes:
    """A transfer function with channels first: position (K,), optical (4, K).

    Rows of `optical` are extinction, red, green, blue. texture (N,) int32, optional: the slab at
    the middle of each of N equal parts of the line from the first position to the last. image_only:
    whether pieces without extinction may be left out, as they may where nothing is differentiated.
    """

    position: Array
    optical: Array
    texture: Array | None = None
    image_only: bool = static(default=False)


class Piece(NamedTuple):
    """A piece of a segment in one slab: what is held fixed when it is differentiated.

    left, right (R,) int32: the slab's control points; the same one in the two outermost slabs.
    t (2, R): where the piece starts and ends, as fractions of the segment.
    place (2, R): the same ends as fractions of the slab, 0 at `left`.
    fraction (R,): its share of the segment's length. width (R,): of the slab.
    """

    left: Array
    right: Array
    t: Array
    place: Array
    fraction: Array
    width: Array


def nodes_of(transfer: TransferFunction, dtype: Any) -> Nodes:
    rows = jnp.concatenate([transfer.extinctions[None], transfer.colors.T])
    return Nodes(transfer.positions.astype(dtype), rows.astype(dtype))


def locate(positions: Array, scalar: Array) -> Array:
    """Number of control points at or below each scalar: its slab (the upper one at a border)."""
    method = "compare_all" if positions.shape[0] <= 32 else "scan_unrolled"
    found = jnp.searchsorted(_hold(positions), _hold(scalar), side="right", method=method)
    return found.astype(jnp.int32)


def merge_transparent(nodes: Nodes) -> Nodes:
    """The nodes without the control points inside of runs of transparent slabs.

    Shapes stay as they are: the control points that are left come first, those taken away follow
    far beyond any scalar, with the values of the outermost slab. Without derivatives.
    """
    position, optical = _hold(nodes.position), _hold(nodes.optical)
    # Slabs k and k + 1 meet at x_k. The neighbour of an outermost control point is itself.
    empty = optical[0] == 0
    below = jnp.concatenate([empty[:1], empty[:-1]])
    above = jnp.concatenate([empty[1:], empty[-1:]])
    inside = below & empty & above
    order = jnp.argsort(inside, stable=True)
    last = inside[order]
    return dataclasses.replace(
        nodes,
        position=jnp.where(last, _beyond(position), position[order]),
        optical=jnp.where(last[None], optical[:, -1:], optical[:, order]),
    )


def _beyond(positions: Array) -> Array:
    """The position () of control points that have been taken away; finite, or 0 times it is not."""
    return jnp.asarray(jnp.finfo(positions.dtype).max, positions.dtype)


def _range(nodes: Nodes) -> tuple[Array, Array]:
    """The first and the last position (), without those taken away."""
    positions = _hold(nodes.position)
    low = positions[0]
    return low, jnp.max(jnp.where(positions < _beyond(positions), positions, low))


def with_texture(nodes: Nodes, size: int) -> Nodes:
    """The same nodes, with a texture of `size` texels."""
    low, high = _range(nodes)
    middles = (jnp.arange(size).astype(low.dtype) + 0.5) / size
    texture = locate(nodes.position, low + (high - low) * middles)
    return dataclasses.replace(nodes, texture=texture)


def look_up(nodes: Nodes, segment: Segment, cursor: Cursor) -> Cursor:
    """The cursor with its slab found anew in the texture, as in Espinha and Celes 2005, Figure 6.

    Their texture over (s_front, s_back) stores the next control point and the one behind it, for
    the case that s_front stands at the first already, or the loop would not end. Which control
    point is next depends on s_back only in so far as it tells the direction, and the one behind it
    is the next index: so a row of slabs holds the same information.

    Where several control points share a texel, both are wrong, and at a jump the loop would not end
    all the same. So the texture is believed where the cursor is strictly inside of the slab that it
    names; else the cursor's own slab stays, if it is a possible one.
    """
    assert nodes.texture is not None
    count, size = nodes.position.shape[0], nodes.texture.shape[0]
    low, high = _range(nodes)
    width, scalar = high - low, cursor.scalar
    texel = (scalar - low) * (size / jnp.where(width > 0, width, 1))
    slab = nodes.texture[jnp.clip(texel.astype(jnp.int32), 0, size - 1)]
    floor, ceiling = _borders(nodes, slab, count)
    inside = (scalar > floor) & (scalar < ceiling)
    rising = _hold(segment.back) >= _hold(segment.front)
    passed = jnp.where(rising, scalar >= ceiling, scalar <= floor)
    slab = slab + jnp.where(passed, jnp.where(rising, 1, -1), 0).astype(jnp.int32)
    floor, ceiling = _borders(nodes, slab, count)
    right = (scalar >= floor) & (scalar <= ceiling)
    floor, ceiling = _borders(nodes, cursor.slab, count)
    possible = (scalar >= floor) & (scalar <= ceiling)
    return Cursor(scalar, jnp.where(inside | (right & ~possible), slab, cursor.slab))


def _borders(nodes: Nodes, slab: Array, count: int) -> tuple[Array, Array]:
    positions = _hold(nodes.position)
    floor = jnp.where(slab == 0, -jnp.inf, positions[jnp.maximum(slab - 1, 0)])
    return floor, jnp.where(slab == count, jnp.inf, positions[jnp.minimum(slab, count - 1)])


def cut(nodes: Nodes, segment: Segment, cursor: Cursor) -> tuple[Piece, Cursor, Array]:
    """The piece at the cursor, the cursor behind it, and whether that was the segment's last.

    A cursor that is in the wrong slab moves by one and its piece is empty, so any cursor gets
    right by itself.
    """
    count = nodes.position.shape[0]
    front, back, (scalar, slab) = _hold(segment.front), _hold(segment.back), cursor
    left, right = jnp.maximum(slab - 1, 0), jnp.minimum(slab, count - 1)
    low, high = _hold(nodes.position)[left], _hold(nodes.position)[right]
    outermost = (slab == 0) | (slab == count)
    floor = jnp.where(slab == 0, -jnp.inf, low)
    ceiling = jnp.where(slab == count, jnp.inf, high)

    change = back - front
    up, flat = change > 0, change == 0
    # A constant scalar at a border belongs to the upper slab: tf(s) takes the upper side's value.
    above = (scalar > ceiling) | (flat & (scalar == ceiling))
    below = scalar < floor
    astray = above | below
    end = jnp.where(up, jnp.minimum(back, ceiling), jnp.maximum(back, floor))
    onward = (jnp.where(up, back > ceiling, back < floor) & ~flat) | astray
    upward = jnp.where(astray, above, up)

    per_scalar = 1 / jnp.where(flat, 1, change)
    jump = (high - low < JUMP_WIDTH) & ~outermost
    fraction = jnp.where(flat, 1.0, (end - scalar) * per_scalar)
    fraction = jnp.where(jump, JUMP_WIDTH * jnp.abs(per_scalar), fraction)
    fraction = jnp.where(astray, 0.0, fraction)
    width = jnp.where(jump | outermost, JUMP_WIDTH, high - low)
    slope = jnp.where(outermost | astray, 0.0, 1 / width)

    def place(at: Array, in_jump: Array) -> Array:
        return jnp.where(jump, in_jump.astype(at.dtype), (at - low) * slope)

    piece = Piece(
        left,
        right,
        jnp.stack([(scalar - front) * per_scalar, jnp.where(flat, 1, (end - front) * per_scalar)]),
        jnp.stack([place(scalar, ~up), place(end, up)]),
        fraction,
        width,
    )
    moved = jnp.where(onward, jnp.where(upward, 1, -1), 0)
    cursor = Cursor(jnp.where(astray, scalar, end), slab + moved.astype(jnp.int32))
    return piece, cursor, ~onward


class Slabs(NamedTuple):
    """The two control points of each piece's slab: position (2, R), optical (2, 4, R)."""

    position: Array
    optical: Array


def gather(nodes: Nodes, piece: Piece) -> Slabs:
    both = (piece.left, piece.right)
    return Slabs(
        jnp.stack([nodes.position[k] for k in both]),
        jnp.stack([nodes.optical[:, k] for k in both]),
    )


def is_empty(nodes: Nodes, piece: Piece) -> Array:
    """Pieces (R,) whose extinction is 0 from end to end: in a transparent slab, or constant at a
    control point with extinction 0."""
    left, right = (nodes.optical[0][k] == 0 for k in (piece.left, piece.right))
    return left & (right | jnp.all(piece.place == 0, axis=0))


class Ends(NamedTuple):
    """A piece ready for a slab integral: optical (4, R) at its two ends and its length (R,)."""

    front: Array
    back: Array
    length: Array


@jax.custom_jvp
def _place(place, t, width, front, back, position):
    return place


@_place.defjvp
def _place_jvp(primals, tangents):
    # place = (s(t) - x_left) / (x_right - x_left) at fixed t: it changes by
    # [(1 - t) ds_front + t ds_back - (1 - place) dx_left - place dx_right] / width.
    place, t, width, _, _, _ = primals
    _, _, _, d_front, d_back, d_position = tangents
    moved = (1 - t) * d_front[None] + t * d_back[None]
    moved = moved - (1 - place) * d_position[:1] - place * d_position[1:]
    return place, moved / width[None]


def ends(piece: Piece, segment: Segment, slabs: Slabs) -> Ends:
    """Extinction and colour at the ends of a piece, differentiable with the partition fixed."""
    place = _place(
        *(piece.place, piece.t, piece.width, segment.front, segment.back, slabs.position)
    )
    left, right = slabs.optical
    front, back = (left + p[None] * (right - left) for p in place)
    return Ends(front, back, segment.length * piece.fraction)
