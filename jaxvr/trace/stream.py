"""The fragments of a batch of rays, face after face in the order of their keys: a rasteriser.

A frame buffer would need all pixels at once, and lists of fragments memory without a bound. Here a
batch of rays (a tile of the image, say) draws faces by itself, in three stages of bounded size:

1. `select`: the next faces of the tile. Blocks of faces whose boxes the beam may meet are looked
   through, and of the faces that the beam may meet those with the smallest keys are kept, at most
   `LIST`, sorted. If there are more, the next selection starts behind the last key: it is a window
   that moves over the sorted faces, without ever having them all.
2. `cover`: a chunk of them at a time, which rays may meet which face, as one bit each. Strips of
   neighbouring rays have lists of the faces whose images overlap theirs; from there on it is dense,
   branch-free arithmetic: edge functions of `trace.beam`, a strip's rays times all faces listed.
3. `next_fragments`: each ray takes the next of its bits, gathers that face and decides exactly.

The decision is that of the walk of `RayCast`, by exact signs that all faces share: an edge is
crossed on one side or the other by all faces round it alike, and a ray through an edge or a vertex
meets exactly the faces that a slightly shifted ray would. So each ray crosses a closed surface an
even number of times, and no pixel centre on a shared edge is covered twice or not at all.

Depth and scalar of a fragment come from its three vertices as the ray sees them: interpolation is
linear in space, hence correct in perspective, and differentiable.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jax import lax

from jaxvr._core.gather import load, take
from jaxvr._core.once import once
from jaxvr._core.pytree import pytree
from jaxvr._core.stage import stage
from jaxvr.order import AbstractOrder, Faces
from jaxvr.trace.beam import (
    Beam,
    Outline,
    Sides,
    beam_of,
    may_meet,
    meets_boxes,
    outline,
    outside,
    overlaps,
    sides,
)
from jaxvr.trace.face import Crossing, Face, crossing, is_positive, opposite_edges, sizes_of
from jaxvr.trace.scene import coordinates_of, project
from jaxvr.trace.shear import ShearedRays, shear_rays

Array = jax.Array

BLOCK = 128  # face slots with one box round them
LOOK = 8  # blocks that are looked through at once
LIST = 1 << 17  # faces that are selected at once, at most
SAMPLE = 1 << 10  # of a full list, from which its quantiles are estimated
GROUP = 1 << 10  # faces that are covered at once: 32 words of 32
STRIP = 64  # neighbouring rays with a list of faces of their own
BITS = 1 << 24  # of a chunk, for all rays together, unless that is less than a group's
_INT = jnp.iinfo(jnp.int32)


@pytree
class BeamRays:
    """R rays twice: sheared, and as origins and directions (3, R) in the source's units, from which
    integers are found."""

    sheared: ShearedRays
    origins: Array
    directions: Array


def beam_rays(origins: Array, directions: Array, scale: Array) -> BeamRays:
    """Rays (R, 3) in world units."""
    held = lax.stop_gradient((origins * scale, directions))
    return BeamRays(shear_rays(origins, directions, scale), *(x.T for x in held))


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


class Stream(NamedTuple):
    """Where R rays stand in the stream of fragments.

    chunk: first () and end (): its faces, by number in the selection. slots (strips, 1024 G): of
    each strip of rays, those whose images overlap its own, in order. masks (G, 32, R) uint32: bit b
    of word w of group g is set if the ray may meet its strip's face number (32 g + w) 32 + b.
    marks (G, R) uint32: which words are not empty. Of each ray, as bits (R,) uint32: groups, the
    groups that it has not begun; words, of the group begun; bits, faces of the word begun. group,
    word (R,): which these are.
    """

    selection: Selection
    chunk: Place
    slots: Array
    masks: Array
    marks: Array
    groups: Array
    words: Array
    bits: Array
    group: Array
    word: Array


class Hits(NamedTuple):
    """A fragment of each ray, or none: hit (R,), whether it met a face; slot (R,) of that; face and
    weights (3, R) as in `trace.raycast.Ahead`; at: depth and scalar."""

    hit: Array
    slot: Array
    face: Face
    weights: Array
    at: Crossing


def start_stream(source: FaceSource, rays: int) -> Stream:
    """Before the first selection."""
    zero, unsigned = jnp.zeros((), jnp.int32), jnp.zeros(rays, jnp.uint32)
    # Room for all faces that there are (a list that is never full), or for `LIST`.
    size = min(LIST, (source.boxes[0].shape[1] + 2 * LOOK) * BLOCK)
    none = (jnp.full((), _INT.min, jnp.int32), jnp.full((), -1, jnp.int32))
    selection = Selection(jnp.zeros((size, 2), jnp.int32), zero, none, jnp.ones((), bool))
    # All groups of a chunk are bits of one word, too.
    groups = max(1, min(32, BITS // (GROUP * rays), size // GROUP))
    masks = jnp.zeros((groups, 32, rays), jnp.uint32)
    slots = jnp.zeros((strips_of(rays), groups * GROUP), jnp.int32)
    integer = zero + jnp.zeros(rays, jnp.int32)
    return Stream(
        *(selection, (zero, zero), slots, masks, masks[:, 0]),
        *(unsigned, unsigned, unsigned, integer, integer),
    )


def drawn(stream: Stream) -> Array:
    """Rays (R,) that have no bits left in the current chunk."""
    return (stream.groups | stream.words | stream.bits) == 0


def over(stream: Stream) -> Array:
    """Whether no face () is left behind the current chunk."""
    return ~stream.selection.more & (stream.chunk[1] >= stream.selection.count)


def refill(stream: Stream, wanted: Array, source: FaceSource, rays: BeamRays, sort: Sort) -> Stream:
    """The next chunk's bits, if `wanted` () and there is one."""
    source, rays = lax.stop_gradient((source, rays))
    again = wanted & (stream.chunk[1] >= stream.selection.count) & stream.selection.more
    selection = once(again, _select(sort), stream.selection, source, rays)
    first, end = (jnp.where(again, 0, x) for x in stream.chunk)
    stream = stream._replace(selection=selection, chunk=(first, end))
    return once(wanted & (end < selection.count), _cover, stream, source, rays)


def _select(sort: Sort) -> Any:
    """The next selection; see the module."""

    def select(old: Selection, source: FaceSource, rays: BeamRays) -> Selection:
        size, beam = old.faces.shape[0], beam_of(rays.origins, rays.directions)
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
            place, found = _places(valid)
            place = jnp.where(valid, count + place, size)
            faces = faces.at[place].set(jnp.stack([key, slot], 1), mode="drop")
            state = faces, count + found, ceiling
            if bounded:
                state = lax.while_loop(lambda x: x[1] + LOOK * BLOCK > size, _shrink, state)
            return index + LOOK, *state

        zero = jnp.zeros((), jnp.int32)
        loop = (zero, old.faces, zero, ceiling)
        _, faces, count, ceiling = lax.while_loop(lambda x: x[0] < total, body, loop)
        return Selection(_sort_first(faces, count), count, floor, ceiling[0] < _INT.max)

    return select


def _before(a: Place, b: Place) -> Array:
    """By key, then by slot."""
    return (a[0] < b[0]) | ((a[0] == b[0]) & (a[1] < b[1]))


def _places(valid: Array) -> Place:
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
    place, found = _places(near)
    return faces.at[jnp.where(near, place, size)].set(faces, mode="drop"), found, bound


def _sort_first(faces: Array, count: Array) -> Array:
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


def strips_of(rays: int) -> int:
    """Number of strips that this many rays make."""
    return rays // STRIP if rays % STRIP == 0 else 1


def _cover(stream: Stream, source: FaceSource, rays: BeamRays) -> Stream:
    """The bits of the next chunk."""
    beam = beam_of(rays.origins, rays.directions)
    selection, (_, first) = stream.selection, stream.chunk
    end = jnp.minimum(first + stream.slots.shape[1], selection.count)
    listed = _list_faces(stream, source, beam, first, end)
    groups = (jnp.max(listed.count) + GROUP - 1) // GROUP

    def body(loop):
        group, masks, marks = loop
        words = _cover_group(listed, beam, group * GROUP)
        masks = lax.dynamic_update_index_in_dim(masks, words, group, 0)
        return group + 1, masks, lax.dynamic_update_index_in_dim(marks, _marks(words), group, 0)

    loop = (jnp.zeros((), jnp.int32), stream.masks, stream.marks)
    _, masks, marks = lax.while_loop(lambda x: x[0] < groups, body, loop)
    number = jnp.arange(marks.shape[0], dtype=jnp.int32)[:, None]
    used = jnp.where(number < groups, marks, 0)
    used = jnp.concatenate([used, jnp.zeros((32 - used.shape[0], used.shape[1]), used.dtype)])
    zero = jnp.zeros_like(stream.bits)
    return Stream(
        *(selection, (first, end), listed.slots, masks, marks, _marks(used), zero, zero),
        *(stream.group, stream.word),
    )


class _Listed(NamedTuple):
    """faces (9, N): outlines of a chunk's faces. numbers (strips, N): of each strip, those that may
    be met, as many as count (strips,); slots (strips, N): where they come from."""

    faces: Array
    numbers: Array
    slots: Array
    count: Array


def _list_faces(stream: Stream, source: FaceSource, beam: Beam, first, end) -> _Listed:
    """The faces of the selection from number `first` () to `end` (), for each strip."""
    selection, (strips, size) = stream.selection, stream.slots.shape
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
        ranks, found = jax.vmap(_places)(valid)
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
    none = _Listed(jnp.zeros((9, size), dtype), zeros, stream.slots, zeros[:, 0])
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


def _lowest(bits: Array) -> Array:
    """Number of the lowest bit that is set, as int32."""
    return lax.population_count((bits & -bits) - 1).astype(jnp.int32)


def _without_lowest(bits: Array) -> Array:
    return bits & (bits - 1)


def next_fragments(
    stream: Stream, source: FaceSource, rays: ShearedRays, go: Array
) -> tuple[Stream, Hits]:
    """The next face that each ray in `go` (R,) may meet, and whether it does."""
    go = go & ~drawn(stream)
    wanted, lane = jnp.any(go), jnp.arange(go.shape[0], dtype=jnp.int32)
    next_word = go & (stream.bits == 0)
    next_group = next_word & (stream.words == 0)

    def find(table, row):
        return take(table, row * go.shape[0] + lane)

    group = jnp.where(next_group, _lowest(stream.groups), stream.group)
    groups = jnp.where(next_group, _without_lowest(stream.groups), stream.groups)
    found = load(wanted, find, stream.marks.reshape(-1), group)
    words = jnp.where(next_group, found, stream.words)
    word = jnp.where(next_word, _lowest(words), stream.word)
    words = jnp.where(next_word, _without_lowest(words), words)
    found = load(wanted, find, stream.masks.reshape(-1), 32 * group + word)
    bits = jnp.where(next_word, found, stream.bits)
    place = jnp.where(go, (32 * group + word) * 32 + _lowest(bits), 0)
    bits = jnp.where(go, _without_lowest(bits), bits)

    strips, size = stream.slots.shape
    strip = lane // (go.shape[0] // strips)
    slot = load(wanted, take, stream.slots.reshape(-1), strip * size + place)
    stream = stream._replace(groups=groups, words=words, bits=bits, group=group, word=word)
    face = face_at(source, rays, slot, wanted)
    edges = stage(wanted, opposite_edges, *face)
    a, b, c = (is_positive(edge) for edge in edges)
    weights = sizes_of(edges)
    at = stage(wanted, crossing, face, weights, rays.eye)
    return stream, Hits(go & (a == b) & (b == c), slot, face, weights, at)


def draw(source: FaceSource, rays: BeamRays, sort: Sort, carry: Any, add: Any) -> Any:
    """`add(carry, hits)` for all fragments, one of each ray at a time; the last carry."""
    size = rays.origins.shape[1]

    def going(loop):
        return ~(over(loop[0]) & jnp.all(drawn(loop[0])))

    def body(loop):
        stream, carry = loop
        stream = refill(stream, jnp.all(drawn(stream)), source, rays, sort)
        stream, new = next_fragments(stream, source, rays.sheared, jnp.ones(size, bool))
        return stream, add(carry, new)

    return lax.while_loop(going, body, (start_stream(source, size), carry))[1]


def tolerance(depth: Array, rays: ShearedRays) -> Array:
    """What rounding may do to a depth (R,) from the eye."""
    eps = jnp.finfo(depth.dtype).eps
    return 16 * eps * (jnp.abs(depth) + jnp.abs(lax.stop_gradient(rays.eye)))


def face_at(source: FaceSource, rays: ShearedRays, slot: Array, wanted: Array) -> Face:
    """The vertices of faces in slots (R,), as each ray sees them."""

    def find(source, rays, slot):
        ids = source.corners(slot)
        rows = jnp.stack([rays.axis_x, rays.axis_y, rays.axis_z, jnp.full_like(rays.axis_x, 3)])
        return take(source.vertices, rows[:, None] + 4 * ids[None])

    found = load(wanted, find, source, rays, slot)
    a, b, c = (project(rays, (*(found[j, k] for j in range(4)),), wanted) for k in range(3))
    return a, b, c
