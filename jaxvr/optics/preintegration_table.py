"""How a pre-integrated table is built: directly, and incrementally.

A table holds, for a segment with scalars s_f and s_b at its ends and length l, the premultiplied
colour and the opacity, (r, g, b, alpha). Scalars lie on n nodes from the first control point to the
last, lengths on slices, slice 0 being l = 0.

*Directly*: every entry is the exact integral, slab after slab: O(n^2 n_l K) slabs for K control
points.

*Incrementally*: a segment is its front part followed by its back part, and if both are in the table
already, the entry costs one composition (Weiler et al. 2003; Callahan et al. 2005, section 4.1):

    C(s_f, s_b, l) = C(s_f, s_p, l_1) + (1 - alpha(s_f, s_p, l_1)) C(s_p, s_b, l_2)
    l = l_1 + l_2,   s_p = s_f + (s_b - s_f) l_1 / l.

s_p falls between nodes, so each step interpolates linearly, and errors add up. Which earlier
slices make a new one is a choice:

    one by one   l_m from l_1 and l_(m-1)      Callahan et al., a base slice and the one before
    halves       l_m from its two halves       as many compositions, but log n_l of them deep
    doubling     l_m from l_(m-p) twice        Kraus et al. 2004, p slices an octave; p = 1 there
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxvr.numerics.moments import emission_weights, opacity
from jaxvr.optics.partition import Nodes

Array = jax.Array


def exact_slice(nodes: Nodes, front: Array, back: Array, length: Array) -> Array:
    """Exact (r, g, b, alpha) (4, R) of segments (R,) whose scalars lie between the control points.

    Segments are cut by clipping their scalars to each interval of control points; at a jump, a
    constant scalar takes the upper side's value. Differentiable, first derivatives and more.
    """
    change = back - front
    flat = change == 0
    per_change = 1 / jnp.where(flat, 1, change)
    first, last = nodes.position[0], nodes.position[-1]

    def body(carry, slab):
        rgb, depth = carry
        low, high, start, end = slab
        width = high - low
        per_width = jnp.where(width > 0, 1 / jnp.where(width > 0, width, 1), 0)
        s_0, s_1 = (jnp.clip(s, low, high) for s in (front, back))
        holds = ((front >= low) | (low == first)) & ((front < high) | (high == last)) & (low < high)
        share = jnp.where(flat, holds.astype(front.dtype), (s_1 - s_0) * per_change) * length
        color = [
            start[:, None] + ((s - low) * per_width)[None] * (end - start)[:, None]
            for s in (s_0, s_1)
        ]
        a, b = color[0][0] * share, color[1][0] * share
        alpha, w_back = emission_weights(a, b)
        here = color[0][1:] * alpha[None] + (color[1][1:] - color[0][1:]) * w_back[None]
        # Intervals come in ascending order: a descending segment meets this one before the others.
        before = jnp.where(change >= 0, depth, 0)
        behind = jnp.where(change >= 0, 0, 0.5 * (a + b))
        rgb = jnp.exp(-behind)[None] * rgb + jnp.exp(-before)[None] * here
        return (rgb, depth + 0.5 * (a + b)), None

    slabs = (
        *(nodes.position[:-1], nodes.position[1:]),
        *(nodes.optical[:, :-1].T, nodes.optical[:, 1:].T),
    )
    zero = jnp.zeros_like(front)
    (rgb, depth), _ = lax.scan(body, (jnp.zeros((3, *zero.shape), zero.dtype), zero), slabs)
    return jnp.concatenate([rgb, opacity(depth)[None]])


def direct(nodes: Nodes, scalars: tuple[Array, Array], lengths: Array) -> Array:
    """Slices (L, 4, n_f, n_b) of exact entries, one after the other."""
    shape = (scalars[0].shape[0], scalars[1].shape[0])
    front = jnp.broadcast_to(scalars[0][:, None], shape).reshape(-1)
    back = jnp.broadcast_to(scalars[1][None], shape).reshape(-1)

    @jax.checkpoint  # in reverse mode, one slice at a time is held
    def one(length):
        return exact_slice(nodes, front, back, jnp.full_like(front, length)).reshape(4, *shape)

    return lax.map(one, lengths)


def join(first: Array, second: Array, way: Array) -> Array:
    """Slice (4, n_f, n_b) of segments made of those in `first` and, behind them, in `second`.

    way (): length in `first`, as part of the sum.
    """
    _, n_f, n_b = first.shape
    u = np.arange(n_f)[:, None] / max(n_f - 1, 1)
    v = np.arange(n_b)[None] / max(n_b - 1, 1)
    middle = jnp.asarray(u, first.dtype) + way * jnp.asarray(v - u, first.dtype)

    def place(size):
        at = jnp.clip(middle * (size - 1), 0, size - 1)
        left = jnp.minimum(at.astype(jnp.int32), max(size - 2, 0))
        return left, jnp.minimum(left + 1, size - 1), at - left.astype(at.dtype)

    left, right, t = place(n_b)
    row = n_b * np.arange(n_f, dtype=np.int32)[:, None]
    flat = first.reshape(4, -1)
    front = flat[:, row + left]
    front = front + t[None] * (flat[:, row + right] - front)

    left, right, t = place(n_f)
    column = np.arange(n_b, dtype=np.int32)[None]
    flat = second.reshape(4, -1)
    back = flat[:, n_b * left + column]
    back = back + t[None] * (flat[:, n_b * right + column] - back)
    return front + (1 - front[3:]) * back


def one_by_one(base: Array, count: int) -> Array:
    """Slices of lengths 1, 2, ..., `count` from `base` (4, n_f, n_b), the slice of length 1."""

    def body(last, m):
        new = join(base, last, 1 / m)
        return new, new

    lengths = jnp.arange(2, count + 1).astype(base.dtype)
    _, rest = lax.scan(body, base, lengths)
    return jnp.concatenate([base[None], rest])


def halves(base: Array, count: int) -> Array:
    """What `one_by_one` gives, with each slice from its two halves."""
    slices = base[None]
    while slices.shape[0] < count:
        have = slices.shape[0]
        m = np.arange(have + 1, min(2 * have, count) + 1)
        first, second = (m + 1) // 2, m // 2
        way = jnp.asarray(first / m, base.dtype)
        new = jax.vmap(join)(slices[first - 1], slices[second - 1], way)
        slices = jnp.concatenate([slices, new])
    return slices


def doubling(base: Array, count: int) -> Array:
    """`count` slices, of which `base` (p, 4, n_f, n_b) are the first; each next one is of twice the
    length of the one p before it."""

    def body(block, _):
        new = jax.vmap(partial(join, way=jnp.asarray(0.5, base.dtype)))(block, block)
        return new, new

    blocks = -(-count // base.shape[0])
    _, rest = lax.scan(body, base, length=blocks - 1)
    return jnp.concatenate([base, rest.reshape(-1, *base.shape[1:])])[:count]
