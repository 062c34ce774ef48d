"""Which faces a beam of rays may meet, sorted, and no more of them at a time than a list holds.

Blocks of faces whose boxes the beam may meet are looked through, and of the faces that the beam may
meet those with the smallest keys are kept, at most `LIST`, sorted. If there are more, the next
selection starts behind the last key: it is a window that moves over the sorted faces, without ever
having them all.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jax import lax

from jaxvr.order import AbstractOrder, Faces
from jaxvr.trace.beam import Beam, Sides, meets_boxes, outside, sides

Array = jax.Array

BLOCK = 128  # face slots with one box round them
LOOK = 8  # blocks that are looked through at once
LIST = 1 << 17  # faces that are selected at once, at most
SAMPLE = 1 << 10  # of a full list, from which its quantiles are estimated
_INT = jnp.iinfo(jnp.int32)


@dataclasses.dataclass(frozen=True)
class Sort:
    """The order of faces; `reverse` has the farthest first."""

    order: AbstractOrder
    reverse: bool = False


class FaceSource(Protocol):
    """Where faces come from: slots, in blocks of `BLOCK`, some of them empty."""

    @property
    def vertices(self) -> Array:
        """(4 P,): x, y, z and scalar of each point, coordinates below 1 in size."""
        ...

    @property
    def boxes(self) -> tuple[Array, Array]:
        """Low and high corners (3, blocks) of the faces in each block."""
        ...

    def look(self, blocks: Array) -> tuple[Array, tuple[Array, Array, Array], Array]:
        """Of blocks (B,): slots (N,), the coordinates (3, N) of the three corners, and which slots
        hold a face."""
        ...

    def corners(self, slot: Array) -> Array:
        """Point ids (3, N), in the mesh's order, of the faces in slots (N,)."""
        ...

    def keep(self, origin: Array, slot: Array) -> Array:
        """Faces (N,) that are wanted wherever they lie, for a beam that starts at origin (3,)."""
        ...


Place = tuple[Array, Array]


class Selection(NamedTuple):
    """faces (L, 2) int32: keys and slots of the faces in hand, the first `count` () in order; the
    rest is scratch. last: key and slot () of the last face of earlier selections. more (): whether
    faces behind these were left out."""

    faces: Array
    count: Array
    last: Place
    more: Array


def start_selection(source: FaceSource) -> Selection:
    """Before the first one: no face, and all of them to come."""
    # Room for all faces that there are (a list that is never full), or for `LIST`.
    size = min(LIST, (source.boxes[0].shape[1] + 2 * LOOK) * BLOCK)
    none = (jnp.full((), _INT.min, jnp.int32), jnp.full((), -1, jnp.int32))
    zero = jnp.zeros((), jnp.int32)
    return Selection(jnp.zeros((size, 2), jnp.int32), zero, none, jnp.ones((), bool))


def next_selection(old: Selection, source: FaceSource, beam: Beam, sort: Sort) -> Selection:
    """The faces behind those of `old`, as many as the list holds; see the module."""
    size = old.faces.shape[0]
    around, met = sides(beam), meets_boxes(beam, *source.boxes)
    blocks = met.shape[0]
    bounded = size < (blocks + LOOK) * BLOCK
    (numbers,) = jnp.nonzero(met, size=blocks + LOOK, fill_value=blocks)
    numbers, total = numbers.astype(jnp.int32), jnp.sum(met, dtype=jnp.int32)
    # Behind the last face of the selection before, and before the first that was left out.
    last = old.faces[jnp.maximum(old.count - 1, 0)]
    none = old.count == 0
    floor = jnp.where(none, old.last[0], last[0]), jnp.where(none, old.last[1], last[1])
    ceiling = (jnp.full((), _INT.max, jnp.int32),) * 2

    def body(loop):
        index, faces, count, ceiling = loop
        at = lax.dynamic_slice(numbers, (index,), (LOOK,))
        key, slot, valid = _look(source, beam, around, sort, at)
        valid = valid & _before(floor, (key, slot)) & _before((key, slot), ceiling)
        place, found = places(valid)
        place = jnp.where(valid, count + place, size)
        faces = faces.at[place].set(jnp.stack([key, slot], 1), mode="drop")
        state = faces, count + found, ceiling
        if bounded:
            state = lax.while_loop(lambda x: x[1] + LOOK * BLOCK > size, _shrink, state)
        return index + LOOK, *state

    zero = jnp.zeros((), jnp.int32)
    loop = (zero, old.faces, zero, ceiling)
    _, faces, count, ceiling = lax.while_loop(lambda x: x[0] < total, body, loop)
    return Selection(sort_first(faces, count), count, floor, ceiling[0] < _INT.max)


def _before(a: Place, b: Place) -> Array:
    """By key, then by slot."""
    return (a[0] < b[0]) | ((a[0] == b[0]) & (a[1] < b[1]))


def places(valid: Array) -> Place:
    """The rank (N,) of each element among those that are valid, and their number ().

    By bits, in words of 32: an eighth of the time of a cumulative sum."""
    bit = jnp.arange(32, dtype=jnp.uint32)[None]
    marks = valid.reshape(-1, 32)
    words = jnp.sum(marks.astype(jnp.uint32) << bit, axis=1, dtype=jnp.uint32)
    each = lax.population_count(words).astype(jnp.int32)
    through = jnp.cumsum(each, dtype=jnp.int32)
    below = lax.population_count(words[:, None] & ((jnp.uint32(1) << bit) - 1))
    rank = (through - each)[:, None] + below.astype(jnp.int32)
    return rank.reshape(-1), through[-1]


def _look(source: FaceSource, beam: Beam, around: Sides, sort: Sort, blocks: Array) -> Any:
    """Keys, slots (N,) and which faces of some blocks the beam may meet."""
    slot, corners, valid = source.look(blocks)
    a, b, c = (corner - beam.origin[:, None] for corner in corners)
    off = jnp.any(jnp.all(outside(around, jnp.stack([a, b, c], 1)), axis=1), axis=0)
    key = sort.order.keys(Faces(slot, (a, b, c), beam.axes[2], beam.pinhole))
    return _as_integers(key, sort.reverse), slot, valid & (~off | source.keep(beam.origin, slot))


def _as_integers(key: Array, reverse: bool) -> Array:
    """Keys as int32 in the same order, or in reverse."""
    if jnp.issubdtype(key.dtype, jnp.floating):
        pattern = lax.bitcast_convert_type(key.astype(jnp.float32), jnp.int32)
        key = jnp.where(pattern < 0, pattern ^ jnp.int32(0x7FFFFFFF), pattern)
    return ~key.astype(jnp.int32) if reverse else key.astype(jnp.int32)


def _shrink(state: Any) -> Any:
    """About the nearer three quarters of a full list; the rest is left for the next selection.

    The bound is that quantile of a sample: sorting the list takes twenty times as long. No two
    faces are equal, so a quarter of the sample goes at least."""
    faces, count, _ = state
    size = faces.shape[0]
    sample = faces[: size - LOOK * BLOCK : max(1, size // SAMPLE)]
    keys, slots = lax.sort((sample[:, 0], sample[:, 1]), num_keys=2)
    bound = keys[3 * keys.size // 4], slots[3 * keys.size // 4]
    near = (jnp.arange(size) < count) & _before((faces[:, 0], faces[:, 1]), bound)
    place, found = places(near)
    return faces.at[jnp.where(near, place, size)].set(faces, mode="drop"), found, bound


def sort_first(faces: Array, count: Array) -> Array:
    """The first `count` () in order. In one of a few sizes, so that few are sorted fast."""
    sizes = [faces.shape[0]]
    while sizes[0] > 1024:
        sizes.insert(0, sizes[0] // 4)
    which = jnp.sum(jnp.stack([count > size for size in sizes]), dtype=jnp.int32)
    sorts = [partial(_sorted_part, size=size) for size in sizes]
    return lax.switch(which, sorts, faces, count)


def _sorted_part(faces: Array, count: Array, size: int) -> Array:
    """The first `count` () of the first `size` in order."""
    used = jnp.arange(size) < count
    key = jnp.where(used, faces[:size, 0], _INT.max)
    first = lax.sort((key, faces[:size, 1]), num_keys=2)
    return lax.dynamic_update_slice(faces, jnp.stack(first, 1), (0, 0))
