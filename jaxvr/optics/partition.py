"""A segment, cut at every control point that its scalar crosses.

Between two control points the transfer function is linear, so that a piece of a segment has a
closed integral. The K control points x_0 <= ... <= x_{K-1} make K + 1 slabs: slab k spans
[x_{k-1}, x_k], and the first and last reach to infinity with constant values. One loop iteration
handles one piece, as in Espinha and Celes 2005, Figure 6: a `Cursor` remembers where in its
segment each ray stands, and moves to the neighbouring slab when the piece ends there.

Two control points at one position are a slab of no width, a jump; nothing else is one, however near
two points are. A ray that crosses it gets a piece of no length there, which contributes nothing but
a derivative.

A slab is transparent if the extinction at both of its control points is 0. A run of adjacent
transparent slabs contributes nothing wherever it is cut, so `merge_transparent` takes the control
points inside of it away, and a segment passes the run in one piece. The image is the same, and so
are derivatives with respect to segments. Those with respect to the transfer function are not: a
control point of extinction 0 that has been taken away has a derivative all the same.

A soft cut is held, a hard cut moves. At a control point where the transfer function is continuous
the terms from moving ends of pieces cancel between neighbours (Leibniz), so its place is held, and
no division by the difference of the end scalars is left. At a jump the integrand jumps, and the
place is differentiated. With a segment from s_f to s_b, along which s(t) = (1 - t) s_f + t s_b, a
border at the position p is met at t = (p - s_f) / (s_b - s_f), so that

    m  =  (1 - t) ds_f + t ds_b - dp

says how far the scalar at the border has run ahead of it, and

    soft:   the place in the slab, at fixed t, changes by m / width; the piece's share of the
            segment not at all
    hard:   the place in the slab stays at the border; t changes by -m / (s_b - s_f), and with it
            the share of the pieces on both sides.

The two equal positions of a jump are the ends of three pieces: the lower one of that before it
(below), the upper one of that behind it, both of the piece of no length between them, which has the
lower side's values at one end and the upper side's at the other. So moved together they move the
jump, and moved apart they make a ramp: the derivative by each of the two is the one-sided one, in
the only direction in which they may go apart, and their sum is that of the jump.

First derivatives of whole segments are exact. So are second ones of which at most one is by the
scalar (by values, points, camera or positions): the others, for which the moving place of a soft
cut counts, are refused. At kinks (a scalar that stays
exactly at a control point) the derivative is the one through the slab that the value was taken
from. A scalar exactly at a jump belongs to the upper side, as in tf(s), at the ends of a segment as
well: a segment crosses the jump at p if its lower end is below p and its upper end is at p or
above. So where an end lies exactly on a jump, as where a face of the mesh is an isosurface of it,
the derivative is the one-sided one for the jump moving down, or the field moving up.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxvr._core.modes import once_by
from jaxvr._core.pytree import pytree, static
from jaxvr.optics.transfer import TransferFunction

Array = jax.Array
_hold = lax.stop_gradient

_SECOND = (
    "Second derivatives by values, points, camera and positions of control points are given by no "
    "adjoint, since places of cuts are held fixed. Take differences of first derivatives. Those by "
    "colours and extinctions, and by one of these and anything else, are given by Direct()."
)


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
    fraction (R,): its share of the segment's length.
    slope (2, R): at a soft end 1 / width of the slab, 0 outside the control points; at a hard end
    0. rate (2, R): at a hard end, what its fraction loses for each unit by which the scalar runs
    ahead of the border there, 1 / (s_b - s_f) at the piece's end and minus that at its start;
    else 0.
    """

    left: Array
    right: Array
    t: Array
    place: Array
    fraction: Array
    slope: Array
    rate: Array


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
    position = _hold(nodes.position)
    left, right = jnp.maximum(slab - 1, 0), jnp.minimum(slab, count - 1)
    low, high = position[left], position[right]
    first, last = slab == 0, slab == count
    outermost = first | last
    floor = jnp.where(first, -jnp.inf, low)
    ceiling = jnp.where(last, jnp.inf, high)
    # Whether a border is one of the two equal positions of a jump.
    jump = (low == high) & ~outermost
    hard_floor = jump | ((slab >= 2) & (position[jnp.maximum(left - 1, 0)] == low))
    above_high = position[jnp.minimum(right + 1, count - 1)]
    hard_ceiling = jump | ((slab <= count - 2) & (above_high == high))

    change = back - front
    up, flat = change > 0, change == 0
    # A constant scalar at a border belongs to the upper slab: tf(s) takes the upper side's value.
    above = (scalar > ceiling) | (flat & (scalar == ceiling))
    below = scalar < floor
    astray = above | below
    end = jnp.where(up, jnp.minimum(back, ceiling), jnp.maximum(back, floor))
    # To end at a jump from below is to go through it.
    rises = (back > ceiling) | (hard_ceiling & (back == ceiling))
    onward = (jnp.where(up, rises, back < floor) & ~flat) | astray
    upward = jnp.where(astray, above, up)

    per_scalar = 1 / jnp.where(flat, 1, change)
    fraction = jnp.where(flat, 1.0, (end - scalar) * per_scalar)
    fraction = jnp.where(astray | jump, 0.0, fraction)
    width = high - low
    inside = (width > 0) & ~(outermost | astray)
    slope = jnp.where(inside, 1 / jnp.where(inside, width, 1), 0.0)

    def place(at: Array, in_jump: Array) -> Array:
        return jnp.where(jump, in_jump.astype(at.dtype), (at - low) * slope)

    # A segment that starts at a jump comes from its upper side: upwards it has not crossed it.
    from_below = hard_floor & (scalar == floor) & (scalar != front)
    hard_start = jnp.where(up, from_below, hard_ceiling & (scalar == ceiling)) & ~(flat | astray)
    hard_end = jnp.where(up, hard_ceiling, hard_floor) & onward & ~astray
    piece = Piece(
        left,
        right,
        jnp.stack([(scalar - front) * per_scalar, jnp.where(flat, 1, (end - front) * per_scalar)]),
        jnp.stack([place(scalar, ~up), place(end, up)]),
        fraction,
        jnp.stack([jnp.where(hard_start, 0, slope), jnp.where(hard_end, 0, slope)]),
        jnp.stack([jnp.where(hard_start, -per_scalar, 0), jnp.where(hard_end, per_scalar, 0)]),
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
def _moving(place, fraction, t, slope, rate, front, back, position):
    return place, fraction


@_moving.defjvp
def _moving_jvp(primals, tangents):
    # m of the module's text, at both ends of the piece.
    place, fraction, t, slope, rate, *scalars = primals
    *_, d_front, d_back, d_position = tangents
    ahead = (1 - t) * d_front[None] + t * d_back[None]
    ahead = ahead - (1 - place) * d_position[:1] - place * d_position[1:]
    # Asked of what is known in reverse mode, too: rules of tangents are dropped there.
    slope, rate = (once_by(x, scalars, _SECOND) for x in (slope, rate))
    return (place, fraction), (ahead * slope, -jnp.sum(ahead * rate, 0))


def ends(piece: Piece, segment: Segment, slabs: Slabs) -> Ends:
    """Extinction and colour at the ends of a piece, and its length: differentiable with soft cuts
    held and hard cuts moving."""
    place, fraction = _moving(
        *(piece.place, piece.fraction, piece.t, piece.slope, piece.rate),
        *(segment.front, segment.back, slabs.position),
    )
    left, right = slabs.optical
    front, back = (left + p[None] * (right - left) for p in place)
    return Ends(front, back, segment.length * fraction)
