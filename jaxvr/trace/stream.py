"""The fragments of a batch of rays, face after face in the order of their keys: a rasteriser.

A frame buffer would need all pixels at once, and lists of fragments memory without a bound. Here a
batch of rays (a tile of the image, say) draws faces by itself, in three stages of bounded size:

1. `trace.select`: the next faces of the tile that its beam may meet, sorted by their keys.
2. `trace.cover`: a chunk of them at a time, which rays may meet which face, as one bit each.
3. `next_fragments`: each ray takes the next of its bits, gathers that face and decides exactly.

The decision is that of the walk of `RayCast`, by exact signs that all faces share: an edge is
crossed on one side or the other by all faces round it alike, and a ray through an edge or a vertex
meets exactly the faces that a slightly shifted ray would. So each ray crosses a closed surface an
even number of times, and no pixel centre on a shared edge is covered twice or not at all.

Depth and scalar of a fragment come from its three vertices as the ray sees them: interpolation is
linear in space, hence correct in perspective, and differentiable.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxvr._core.gather import load, take
from jaxvr._core.once import once
from jaxvr._core.pytree import pytree
from jaxvr._core.stage import stage
from jaxvr.trace.beam import Beam, beam_of
from jaxvr.trace.cover import Cover, next_cover, no_cover
from jaxvr.trace.face import Crossing, Face, crossing, is_positive, opposite_edges, sizes_of
from jaxvr.trace.scene import project
from jaxvr.trace.select import FaceSource, Selection, Sort, next_selection, start_selection
from jaxvr.trace.shear import ShearedRays, shear_rays
from jaxvr.view.rays import Rays

Array = jax.Array


@pytree
class BeamRays:
    """R rays twice: sheared, and as origins and directions (3, R) in the source's units, from which
    integers are found."""

    sheared: ShearedRays
    origins: Array
    directions: Array


def beam_rays(rays: Rays, scale: Array) -> BeamRays:
    """Rays in world units."""
    held = lax.stop_gradient((rays.origins * scale, rays.directions))
    return BeamRays(shear_rays(rays, scale), *(x.T for x in held))


def beam(rays: BeamRays) -> Beam:
    return beam_of(rays.origins, rays.directions)


class Stream(NamedTuple):
    """Where R rays stand in the stream of fragments.

    Of each ray, as bits (R,) uint32: groups, the groups of the cover that it has not begun; words,
    of the group begun; bits, faces of the word begun. group, word (R,): which these are.
    """

    selection: Selection
    cover: Cover
    groups: Array
    words: Array
    bits: Array
    group: Array
    word: Array


class Hits(NamedTuple):
    """A fragment of each ray, or none: hit (R,), whether it met a face; slot (R,) of that; face and
    weights (3, R) and positive (R,) as in `trace.raycast.Ahead`; at: depth and scalar."""

    hit: Array
    slot: Array
    face: Face
    weights: Array
    positive: Array
    at: Crossing


def start_stream(source: FaceSource, rays: int) -> Stream:
    """Before the first selection."""
    selection = start_selection(source)
    none, zero = jnp.zeros(rays, jnp.uint32), jnp.zeros(rays, jnp.int32)
    return Stream(selection, no_cover(selection, rays), none, none, none, zero, zero)


def drawn(stream: Stream) -> Array:
    """Rays (R,) that have no bits left in the current chunk."""
    return (stream.groups | stream.words | stream.bits) == 0


def over(stream: Stream) -> Array:
    """Whether no face () is left behind the current chunk."""
    return ~stream.selection.more & (stream.cover.end >= stream.selection.count)


def refill(stream: Stream, wanted: Array, source: FaceSource, rays: BeamRays, sort: Sort) -> Stream:
    """The next chunk's bits, if `wanted` () and there is one."""
    source, rays = lax.stop_gradient((source, rays))

    def select(selection, source, rays):
        return next_selection(selection, source, beam(rays), sort)

    def cover(stream, source, rays):
        cover, groups = next_cover(stream.cover, stream.selection, source, beam(rays))
        none = jnp.zeros_like(stream.bits)
        return stream._replace(cover=cover, groups=groups, words=none, bits=none)

    again = wanted & (stream.cover.end >= stream.selection.count) & stream.selection.more
    selection = once(again, select, stream.selection, source, rays)
    first, end = (jnp.where(again, 0, x) for x in (stream.cover.first, stream.cover.end))
    chunk = stream.cover._replace(first=first, end=end)
    stream = stream._replace(selection=selection, cover=chunk)
    return once(wanted & (end < selection.count), cover, stream, source, rays)


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
    found = load(wanted, find, stream.cover.marks.reshape(-1), group)
    words = jnp.where(next_group, found, stream.words)
    word = jnp.where(next_word, _lowest(words), stream.word)
    words = jnp.where(next_word, _without_lowest(words), words)
    found = load(wanted, find, stream.cover.masks.reshape(-1), 32 * group + word)
    bits = jnp.where(next_word, found, stream.bits)
    place = jnp.where(go, (32 * group + word) * 32 + _lowest(bits), 0)
    bits = jnp.where(go, _without_lowest(bits), bits)

    strips, size = stream.cover.slots.shape
    strip = lane // (go.shape[0] // strips)
    slot = load(wanted, take, stream.cover.slots.reshape(-1), strip * size + place)
    stream = stream._replace(groups=groups, words=words, bits=bits, group=group, word=word)
    face = face_at(source, rays, slot, wanted)
    edges = stage(wanted, opposite_edges, *face)
    a, b, c = (is_positive(edge) for edge in edges)
    weights = sizes_of(edges)
    at = stage(wanted, crossing, face, weights, rays.eye)
    return stream, Hits(go & (a == b) & (b == c), slot, face, weights, a, at)


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
