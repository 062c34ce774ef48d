"""The paths that cells and faces form in a buffer, where depths do not tell what comes first.

A face of two cells joins them: fragments of a ray form paths from a boundary face to another, and
rings where cells are folded (see `raycast`). Along a path depths grow, except over cells that are
overturned or folded. How far a ray has come at a face is therefore the largest depth of the path
up to it, but over a cell whose neighbours lie the right way round against it (`turned` is 0), and
no more than the depth of a face behind one that does not:

    reached_i = max(reached_i-1, z_i), or min(reached_i-1, z_i) if the cell before face i is turned

Front to back that is known when the ray is there. Back to front it has to be looked for along the
path, from face i towards the eye: a chain of max and min is a clamp, to low and high, which is
composed one face at a time and known as soon as the two are equal.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxvr.trace.buffer import is_number, path_ends, pick, used_entries
from jaxvr.volume import packing

Array = jax.Array


class Path(NamedTuple):
    """Where a search along paths stands, of R rays.

    at (R,): the entry that it has come to. word (R,): of the cell that it goes on through, negative
    if there is none. alive (R,): it goes on. met (R,): it came to an entry that is ready. ring
    (R,): it came back. turned (R,): it went through a turned cell. low, high (R,): entries whose
    depths are the bounds of the clamp, depths (2, R) these.
    """

    at: Array
    word: Array
    alive: Array
    met: Array
    ring: Array
    turned: Array
    low: Array
    high: Array
    depths: tuple[Array, Array]


def follow(
    z: Array, words: Array, ready: Array, start: Array, word: Array, go: Array, known: bool = False
) -> Path:
    """The path from entries `start` (R,) on through the cells of `word` (R,), to its end in the
    buffer, to an entry that is `ready` (K, R), or all round; for rays that `go` (R,).

    z (K, R): depths from the eye, infinite where there is no entry. words (2, K, R). known: whether
    to end where the clamp is known.
    """
    far = jnp.full_like(z[0], jnp.inf)
    none = jnp.zeros_like(go)
    used = used_entries(z)
    begin = Path(start, word, go, none, none, none, start, start, (-far, far))

    def going(loop):
        return jnp.any(loop[1].alive) & (loop[0] <= z.shape[0])

    def body(loop):
        steps, path = loop
        path = _clamped(path, pick(path.at, z))
        alive = path.alive & (path.word >= 0)
        if known:
            alive = alive & (path.depths[0] < path.depths[1])
        cell, cells = packing.cell_of(path.word), packing.cell_of(words)
        other = used & ~is_number(path.at, used.shape[0])
        other = other & jnp.any(cells == cell[None, None], axis=0)
        alive = alive & jnp.any(other, axis=0)
        following = jnp.argmax(other, axis=0).astype(jnp.int32)
        mine = pick(following, words)
        ring = alive & (following == start)
        met = alive & (pick(following, ready.astype(jnp.int32)) == 1)
        onward = jnp.where(packing.cell_of(mine[0]) == cell, mine[1], mine[0])
        return steps + 1, path._replace(
            at=jnp.where(alive, following, path.at),
            word=jnp.where(alive, onward, path.word),
            alive=alive & ~ring & ~met,
            met=path.met | met,
            ring=path.ring | ring,
        )

    return lax.while_loop(going, body, (jnp.zeros((), jnp.int32), begin))[1]


def _clamped(path: Path, z: Array) -> Path:
    """With the face at depths z (R,) that it is at, behind the cell that it goes on through."""
    low, high = path.depths
    there = path.word >= 0
    turned = path.alive & there & (packing.turned_of(path.word) == 1)
    up = path.alive & ~turned & (z > low)
    low_at = jnp.where(up, jnp.where(z >= high, path.high, path.at), path.low)
    low = jnp.where(up, jnp.minimum(z, high), low)
    # Before the first face of a path there is nothing, so its depth is what was reached there.
    down = path.alive & (turned | ~there) & (z < high)
    high_at = jnp.where(down, jnp.where(z <= low, low_at, path.at), path.high)
    high = jnp.where(down, jnp.maximum(z, low), high)
    return path._replace(turned=path.turned | turned, low=low_at, high=high_at, depths=(low, high))


def deepest(path: Path) -> Array:
    """The entry (R,) in whose depth a ray stands after the path: what it has reached there."""
    # Of what came before the path's last face in the buffer nothing is known: nothing farther.
    return jnp.where(jnp.isfinite(path.depths[0]), path.low, path.high)


class Choice(NamedTuple):
    """first (R,): the entry whose turn it is. ring, void (R,): whether it is the first of a ring,
    and of one without turned cells: what such a ring gains on the way there it loses on the way
    back, and a ray has passed all of it on its path. late (R,): whether it is the boundary that a
    path ends at, though where that comes from is not in the buffer."""

    first: Array
    ring: Array
    void: Array
    late: Array


def untangle(
    depth: Array, z: Array, words: Array, ready: Array, least: Array, waiting: Array, odd: Array
) -> Choice:
    """Whose turn it is where the closest entry `least` (R,) has not been come to, for rays that are
    `odd` (R,); `waiting` (R,) is the closest of those that are ready.

    If a path leads from one to the other, it is the latter's. If none does, the closest is part of
    a ring, or starts behind the eye, or what came before it is missing. Then the end of its path
    that is closer is the first one. depth (K, R): of entries in order.
    """
    sides = pick(least, words)
    one, two = (follow(z, words, ready, least, side, odd) for side in sides)
    met, ring = one.met | two.met, one.ring
    closer = pick(one.at, depth) <= pick(two.at, depth)
    start = jnp.where(ring, least, jnp.where(closer, one.at, two.at))
    ring = ring & ~met
    far_end = pick(jnp.where(closer, two.at, one.at), words)
    comes_last = pick(start, path_ends(words).astype(jnp.int32)) == 1
    late = comes_last & ~jnp.any(far_end == -1, axis=0) & ~met & ~ring
    return Choice(jnp.where(met, waiting, start), ring, ring & ~one.turned, late)
