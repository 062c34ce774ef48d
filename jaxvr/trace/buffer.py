"""The k-buffer itself: entries of rays, which two make a segment, and what leaves (see `kbuffer`).

Entries are kept unsorted. Everything is arithmetic on all k + 1 entries of all rays at once, chosen
by masks: k is small, and that is vectorised where a gather or a scatter is not.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxvr.trace.face import Crossing
from jaxvr.volume import packing

Array = jax.Array


class Entry(NamedTuple):
    """Fragments, (..., R) each; a buffer has k + 1 of them a ray, (..., k + 1, R).

    depth (2, ...): a pair, from the eye; times -1 where the farthest comes first; infinite where
    there is no fragment. values (V, ...): the scalar in each of the two cells that the face lies
    between, or one for both. words (2, ...) int32: packed cell and corner of the face in each, with
    `turned` of the cell; -1 where there is none, -2 where the segment in it has been given. The
    flag is set where a path ends, if it starts where rays do: at the boundary, seen from inside.
    """

    depth: Array
    values: Array
    words: Array


class Pair(NamedTuple):
    """first, second: entries (R,) of a buffer by number; found (R,): whether there is a second.
    mine, theirs (R,) int32: which of their two cells the segment is in."""

    first: Array
    second: Array
    found: Array
    mine: Array
    theirs: Array


def used_entries(depth: Array) -> Array:
    """Entries (K, R) that hold a fragment, by their depths (K, R)."""
    return jnp.isfinite(depth)


def least(depth: Array, valid: Array) -> Array:
    """Number (R,) of the closest, by depths (2, K, R), among valid entries (K, R)."""
    high, low = depth
    high = jnp.where(valid, high, jnp.inf)
    tied = high == jnp.min(high, axis=0)[None]
    return jnp.argmin(jnp.where(tied & valid, low, jnp.inf), axis=0).astype(jnp.int32)


def is_number(number: Array, size: int) -> Array:
    """One-hot (K, R)."""
    return jnp.arange(size, dtype=jnp.int32)[:, None] == number[None]


def pick(number: Array, rows: Array) -> Array:
    """The entry (..., R) of a number (R,) from rows (..., K, R). By a sum, which is vectorised."""
    chosen = is_number(number, rows.shape[-2])
    return jnp.sum(jnp.where(chosen, rows, jnp.zeros_like(rows)), axis=-2, dtype=rows.dtype)


def ready_entries(depth: Array, words: Array) -> Array:
    """Entries (K, R) that a path has come to, or that start one: not more than one cell is left of
    their two, and not that before the boundary that a path ends at."""
    left = words >= 0
    return used_entries(depth[0]) & ~(left[0] & left[1]) & ~path_ends(words)


def path_ends(words: Array) -> Array:
    """Entries (K, R) at a boundary that a path ends at."""
    return jnp.any((words >= 0) & (packing.flag_of(words) == 1), axis=0)


def cell_pair(depth: Array, words: Array, first: Array, only: Array) -> Pair:
    """The entry that makes a segment with the first: the closest that has a cell in common with it,
    the cell `only` (R,) unless that is negative."""
    rest = used_entries(depth[0]) & ~is_number(first, depth.shape[1])
    # Cells are equal where words are, but for the corner.
    ours, cells = packing.cell_of(pick(first, words)), packing.cell_of(words)
    ours = jnp.where((only < 0)[None] | (ours == only[None]), ours, -1)
    shared = rest & _know(ours[:, None], cells)
    second = least(depth, shared)
    theirs = pick(second, cells)
    mine = jnp.where(_know(ours[:1], theirs), 0, 1).astype(jnp.int32)
    same = jnp.where(mine == 0, ours[0], ours[1])
    other = jnp.where((theirs[0] == same) & (same >= 0), 0, 1).astype(jnp.int32)
    return Pair(first, second, jnp.any(shared, axis=0), mine, other)


def closest_pair(depth: Array, words: Array, last: Array, slack: Array) -> tuple[Pair, Array]:
    """The closest two entries, and whether (R,) a cell lies between them.

    Depths that differ by no more than `slack` (R,) are equal. Among equals the first is the end of
    the segment before, which has `last` (R,) for its word, or else a boundary that a path starts
    at; and the second has a cell in common with the first, or is such a boundary. So cells without
    volume, which make all of their faces equal, are passed in the order in which they lie.
    """
    used = used_entries(depth[0])
    starts = jnp.any(words == -1, axis=0) & ~path_ends(words)

    def among(valid: Array, preferred: Array) -> Array:
        closest = jnp.min(jnp.where(valid, depth[0], jnp.inf), axis=0)
        equal = valid & (depth[0] <= (closest + slack)[None])
        for some in (starts, preferred):
            chosen = equal & some
            valid = jnp.where(jnp.any(chosen, axis=0)[None], chosen, valid)
        return least(depth, valid)

    first = among(used, words[0] == last[None])
    rest = used & ~is_number(first, used.shape[0])
    ours, cells = packing.cell_of(pick(first, words)), packing.cell_of(words)
    second = among(rest, _know(ours[:, None], cells))
    theirs = pick(second, cells)
    found = jnp.any(rest, axis=0)
    mine = jnp.where(_know(ours[:1], theirs), 0, 1).astype(jnp.int32)
    same = jnp.where(mine == 0, ours[0], ours[1])
    other = jnp.where((theirs[0] == same) & (same >= 0), 0, 1).astype(jnp.int32)
    # They may have no cell in common: take the last side that exists.
    other = jnp.where(theirs[1] < 0, 0, other)
    mine = jnp.where(ours[1] < 0, 0, mine)
    return Pair(first, second, found, mine, other), _know(ours, theirs)


def _know(ours: Array, theirs: Array) -> Array:
    """Whether any of our cells (N, ...) is one of theirs (2, ...)."""
    known = [(a == b) & (a >= 0) for a in ours for b in theirs]
    out = known[0]
    for other in known[1:]:
        out = out | other
    return out


def on_side(which: Array, both: Array) -> Array:
    """both[which], ray by ray; what all cells share if there is one for both."""
    return both[0] if both.shape[0] == 1 else jnp.where(which == 0, both[0], both[1])


def crossing_of(entry: Entry, which: Array) -> Crossing:
    """Where a fragment is, with the scalar in one of its two cells (R,)."""
    return Crossing(entry.depth[0], entry.depth[1], on_side(which, entry.values))


def forget(buffer: Entry, words: Array, pair: Pair, give: Array, found: Array, by_cells: bool):
    """Both ends forget the cell of the segment that was given. An end that has another cell to give
    a segment of stays for it. Returns the buffer, the cells (2, R) that the first entry has left,
    and which rays drop it."""
    if not by_cells:
        return buffer, jnp.full_like(words, -1), give
    side = jnp.arange(2, dtype=jnp.int32)[:, None]
    left = jnp.where(found[None] & (side == pair.mine[None]), -2, words)
    drop = give & ~(found & jnp.any(left >= 0, axis=0))
    size = buffer.words.shape[1]
    by_second = (is_number(pair.second, size) & found[None])[None] & (side == pair.theirs[None])[
        :, None
    ]
    by_first = (is_number(pair.first, size) & found[None])[None] & (side == pair.mine[None])[
        :, None
    ]
    return buffer._replace(words=jnp.where(by_first | by_second, -2, buffer.words)), left, drop


def settle(buffer: Entry, first: Array, drop: Array, filling: Array, count: Array) -> Entry:
    """What arrived moves to the place of what is dropped, or to the next one that is free."""
    size = buffer.words.shape[1]
    place = jnp.where(drop, first, jnp.maximum(count - 1, 0))
    move = drop | (filling & jnp.isfinite(buffer.depth[0, -1]))
    target = is_number(place, size) & move[None]
    empty = Entry(
        jnp.array([jnp.inf, 0], buffer.depth.dtype)[:, None],
        jnp.zeros((1, 1), buffer.values.dtype),
        jnp.full((1, 1), -1, jnp.int32),
    )

    def settled(rows, none):
        moved = jnp.where(target[None], rows[:, -1:], rows)
        last = jnp.where(move[None], jnp.broadcast_to(none, rows[:, -1].shape), moved[:, -1])
        return moved.at[:, -1].set(last)

    return jax.tree.map(settled, buffer, empty)
