"""Which rays of a batch may meet which of the selected faces: a chunk of faces at a time, one bit
for each face and ray.

Strips of neighbouring rays have lists of the faces whose images overlap theirs; from there on it
is dense, branch-free arithmetic: edge functions of `trace.beam`, a strip's rays times all faces
listed.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxvr._core.gather import take
from jaxvr.trace.beam import Beam, Outline, may_meet, outline, overlaps
from jaxvr.trace.scene import coordinates_of
from jaxvr.trace.select import FaceSource, Selection, places

Array = jax.Array

GROUP = 1 << 10  # faces that are covered at once: 32 words of 32
STRIP = 64  # neighbouring rays with a list of faces of their own
BITS = 1 << 24  # of a chunk, for all rays together, unless that is less than a group's


class Cover(NamedTuple):
    """first () and end (): the chunk's faces, by number in the selection. slots (strips, 1024 G):
    of each strip of rays, those whose images overlap its own, in order. masks (G, 32, R) uint32:
    bit b of word w of group g is set if the ray may meet its strip's face number
    (32 g + w) 32 + b. marks (G, R) uint32: which words are not empty."""

    first: Array
    end: Array
    slots: Array
    masks: Array
    marks: Array


def no_cover(selection: Selection, rays: int) -> Cover:
    """Of no face, with room for as many as `BITS` and the selection allow."""
    groups = max(1, min(32, BITS // (GROUP * rays), selection.faces.shape[0] // GROUP))
    masks = jnp.zeros((groups, 32, rays), jnp.uint32)
    slots = jnp.zeros((strips_of(rays), groups * GROUP), jnp.int32)
    zero = jnp.zeros((), jnp.int32)
    return Cover(zero, zero, slots, masks, masks[:, 0])


def strips_of(rays: int) -> int:
    """Number of strips that this many rays make."""
    return rays // STRIP if rays % STRIP == 0 else 1


def next_cover(
    old: Cover, selection: Selection, source: FaceSource, beam: Beam
) -> tuple[Cover, Array]:
    """The faces behind `old`, and of each ray the groups that have any bit, as bits (R,)."""
    first = old.end
    end = jnp.minimum(first + old.slots.shape[1], selection.count)
    listed = _list_faces(old.slots, selection, source, beam, first, end)
    groups = (jnp.max(listed.count) + GROUP - 1) // GROUP

    def body(loop):
        group, masks, marks = loop
        words = _cover_group(listed, beam, group * GROUP)
        masks = lax.dynamic_update_index_in_dim(masks, words, group, 0)
        return group + 1, masks, lax.dynamic_update_index_in_dim(marks, _marks(words), group, 0)

    loop = (jnp.zeros((), jnp.int32), old.masks, old.marks)
    _, masks, marks = lax.while_loop(lambda x: x[0] < groups, body, loop)
    number = jnp.arange(marks.shape[0], dtype=jnp.int32)[:, None]
    used = jnp.where(number < groups, marks, 0)
    # All groups of a chunk are bits of one word, too.
    used = jnp.concatenate([used, jnp.zeros((32 - used.shape[0], used.shape[1]), used.dtype)])
    return Cover(first, end, listed.slots, masks, marks), _marks(used)


class _Listed(NamedTuple):
    """faces (9, N): outlines of a chunk's faces. numbers (strips, N): of each strip, those that may
    be met, as many as count (strips,); slots (strips, N): where they come from."""

    faces: Array
    numbers: Array
    slots: Array
    count: Array


def _list_faces(
    slots: Array, selection: Selection, source: FaceSource, beam: Beam, first: Array, end: Array
) -> _Listed:
    """The faces of the selection from number `first` () to `end` (), for each strip. slots
    (strips, N): to be written over."""
    strips, size = slots.shape
    place = beam.place.reshape(2, strips, -1)
    low, high = place.min(2), place.max(2)
    strip = jnp.arange(strips, dtype=jnp.int32)[:, None]
    dtype = beam.place.dtype

    def body(loop):
        begin, out = loop
        number = begin + jnp.arange(GROUP, dtype=jnp.int32)
        live = first + number < end
        row = jnp.minimum(first + number, selection.faces.shape[0] - 1)
        slot = selection.faces[row, 1]
        ids = source.corners(jnp.where(live, slot, 0))
        points = coordinates_of(source.vertices, ids) - beam.origin[:, None, None]
        face, box = outline(beam, points)
        valid = overlaps(box, low, high) & live[None]
        ranks, found = jax.vmap(places)(valid)
        to = strip * size + jnp.where(valid, out.count[:, None] + ranks, strips * size)
        some = [jnp.broadcast_to(x[None], valid.shape) for x in (number, slot)]
        numbers, slots = (
            x.reshape(-1).at[to].set(y, mode="drop").reshape(x.shape)
            for x, y in zip((out.numbers, out.slots), some, strict=True)
        )
        faces = lax.dynamic_update_slice(
            out.faces, jnp.concatenate(face), (jnp.zeros_like(begin), begin)
        )
        return begin + GROUP, _Listed(faces, numbers, slots, out.count + found)

    zeros = jnp.zeros((strips, size), jnp.int32)
    none = _Listed(jnp.zeros((9, size), dtype), zeros, slots, zeros[:, 0])
    loop = (jnp.zeros((), jnp.int32), none)
    return lax.while_loop(lambda x: first + x[0] < end, body, loop)[1]


def _marks(words: Array) -> Array:
    """Which words (32, R) are not empty, as bits (R,)."""
    bit = jnp.arange(32, dtype=jnp.uint32)[:, None]
    return jnp.sum((words != 0).astype(jnp.uint32) << bit, axis=0, dtype=jnp.uint32)


def _cover_group(listed: _Listed, beam: Beam, begin: Array) -> Array:
    """Words (32, R): which rays may meet which of the faces from number `begin` () of their list
    on."""
    strips, size = listed.numbers.shape
    number = begin + jnp.arange(GROUP, dtype=jnp.int32)
    row = lax.dynamic_slice_in_dim(listed.numbers, begin, GROUP, axis=1)
    column = jnp.arange(9, dtype=jnp.int32)[:, None, None] * size
    faces = take(listed.faces.reshape(-1), column + row[None])
    # What is not in the list has constant edge functions of both signs.
    used = number[None] < listed.count[:, None]
    never = jnp.array([0, 0, 0, 0, 0, 0, 2, -2, 0], faces.dtype)
    faces = jnp.where(used[None], faces, never[:, None, None])
    # Bit by bit: face 32 w + b is at (b, strip, w).
    by_bit = jnp.moveaxis(faces.reshape(3, 3, strips, 32, 32), -1, 0)[..., None]
    place = beam.place.reshape(2, strips, 1, -1)

    def body(bit, words):
        meets = may_meet(Outline(*by_bit[bit]), place)
        return words | (meets.astype(jnp.uint32) << bit.astype(jnp.uint32))

    words = jnp.zeros((strips, 32, place.shape[-1]), jnp.uint32)
    words = lax.fori_loop(0, 32, body, words)
    return jnp.moveaxis(words, 0, 1).reshape(32, -1)
