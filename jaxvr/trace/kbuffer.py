"""Hardware-assisted visibility sorting (Callahan, Ikits, Comba and Silva 2005), as a scan.

Faces are rasterised in an order that is nearly right (`jaxvr.order`, `trace.stream`), and each
pixel puts its fragments right in a buffer of k entries. A fragment that arrives at a full buffer
dislodges the closest of the k + 1, and the closest two are the ends of a segment (section 3.2 and
Figure 3). Entries are kept unsorted, as in section 4: the closest is found by a minimum over them.
At first the buffer only fills; at the end it is emptied without anything arriving.

Which two. The paper takes the closest two, and needs two tags, since not all that lies between two
fragments is inside of the mesh (section 4): whether a fragment is on the boundary, and whether the
pixel is inside or outside. Behind a boundary fragment that ends a segment it is outside; the next
two are then no segment, and it is inside again. That is right if fragments come out sorted and the
boundary does not touch itself (`pairs="closest"`). Here fragments also know the two cells that
their face lies between, -1 for outside, which carries the same tags and more: the segment of a cell
is between its two fragments (`pairs="cells"`, the default). A cell belongs to each pair of
neighbours in a sorted list, so that the two ways agree where the paper's is right; by cells it is
right too where boundaries touch and roundings decide who is first, where the mesh overlaps itself,
and where a cell is inverted. And it is known whether every cell that a ray crossed got its segment.

What a k that is too small does. A fragment whose partner has not arrived leaves the buffer without
one, and the segment is missing. That is seen, and sets the status `K_TOO_SMALL` of the ray, as does
a fragment that arrives behind its turn. A ray that is followed to its end without it has every
segment, in order. A ray that ends early (`Over(termination=...)`) has those that it has gone by in
order, and says what was missing until then; not what would have turned out to be missing later,
since faces behind are no longer drawn for it. How many entries an image needs is what `measure_k`
tells.

Floats are those of `RayCast`, from the same vertices by the same arithmetic. The two share the
decision whether a ray meets a face, and differ in how they find faces, and in their order.
"""

from __future__ import annotations

import dataclasses
import numbers
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxvr._core import status as bits
from jaxvr._core.gather import load, take
from jaxvr._core.stage import stage
from jaxvr.optics.partition import Segment, turned
from jaxvr.order import AbstractOrder, Centroid
from jaxvr.trace.base import AbstractTracer
from jaxvr.trace.beam import are_rays
from jaxvr.trace.buffer import Entry, choose_pair, crossing_of, forget, on_side, pick, settle
from jaxvr.trace.face import Crossing, barycentric
from jaxvr.trace.faces import CellFaces, cell_faces
from jaxvr.trace.local import (
    as_rays,
    as_scene,
    crossing_of_face,
    gradient_zeros,
    pull_back_pair,
    segment_between,
)
from jaxvr.trace.scene import Scene, entry_corners, longest_edge, make_scene, values_at
from jaxvr.trace.select import Sort
from jaxvr.trace.stream import (
    BeamRays,
    Hits,
    Stream,
    beam_rays,
    drawn,
    next_fragments,
    over,
    refill,
    start_stream,
    tolerance,
)
from jaxvr.volume import packing

Array = jax.Array


class BufferState(NamedTuple):
    """One state of R rays.

    buffer: the last entry is the place of the fragment that arrives. count (R,): entries in use.
    outside (R,): the paper's tag of a pixel. reach (R,): depth before which nothing may arrive any
    more. owed: a cell (R,) that lacks a fragment, -1 if none does, and the depth (R,) of its other.
    wrong (R,): bits of status that stay; the status has what is owed at the time, too.
    ends: words (R,) of the segment's faces, the nearer one first. begun (R,): had a segment.
    """

    stream: Stream
    buffer: Entry
    count: Array
    outside: Array
    reach: Array
    owed: tuple[Array, Array]
    wrong: Array
    ends: tuple[Array, Array]
    begun: Array
    segment: Segment
    active: Array
    waiting: Array
    fresh: Array
    status: Array


@dataclasses.dataclass(frozen=True)
class KBuffer(AbstractTracer):
    """Faces sorted roughly, fragments sorted by a buffer of k entries a pixel (see the module).

    k: entries. A ray that would have needed more has the status `K_TOO_SMALL`, an error outside
    jit; `render(..., status=True)` gives the image and the status instead, and `measure_k` the k
    that a view needs. Time grows with it. Rays that end early, by `Over(termination=...)`, know
    less: see the module.
    order: a `jaxvr.order.AbstractOrder`; the better it sorts, the smaller k may be.
    pairs: "cells" or "closest", which two fragments make a segment; "closest" is the paper's.
    reverse: the farthest segments first; an `Over` that composites back to front sets it.

    Equal to `RayCast` where k suffices, gradients too. Where a mesh overlaps itself, segments come
    by the depth of their nearer ends, while `RayCast` takes whole paths; the rings of cells that it
    misses there are found here.

    Rays that share an origin (pinhole) or a direction (orthographic) with their batch are fast. Any
    others are tested against every face, in an order that suits them only roughly.

    Raises:
      ValueError: if k is not a positive integer, or order or pairs are not what they may be.
    """

    k: int = 6
    order: AbstractOrder = Centroid()
    pairs: Literal["cells", "closest"] = "cells"
    reverse: bool = False

    def __post_init__(self):
        number = isinstance(self.k, numbers.Integral) and not isinstance(self.k, bool)
        if not number or self.k < 1:
            raise ValueError(f"k must be a positive integer, but is {self.k!r}.")
        object.__setattr__(self, "k", int(self.k))
        if not isinstance(self.order, AbstractOrder):
            raise ValueError(
                "order must be an order of faces, such as jaxvr.order.Centroid(), but is "
                f"{self.order!r}."
            )
        if self.pairs not in ("cells", "closest"):
            raise ValueError(f'pairs must be "cells" or "closest", but is {self.pairs!r}.')

    def reversed(self) -> KBuffer:
        return dataclasses.replace(self, reverse=not self.reverse)

    def prepare(self, volume: Any) -> CellFaces:
        return cell_faces(make_scene(volume))

    def longest(self, scene: CellFaces) -> Array:
        return longest_edge(scene.scene)

    def prepare_rays(self, scene: CellFaces, origins: Array, directions: Array) -> BeamRays:
        return beam_rays(origins, directions, scene.scene.scale)

    def start(self, scene: CellFaces, rays: BeamRays) -> BufferState:
        dtype, count = rays.origins.dtype, rays.origins.shape[1]
        zero, no = jnp.zeros(count, dtype), jnp.zeros(count, bool)
        integer, rows = jnp.zeros(count, jnp.int32), (self.k + 1, count)
        values = 1 if one_value(scene.scene) else 2
        # Points without a place may be behind any segment that is missing, not a small k.
        broken = ~jnp.all(jnp.isfinite(jnp.stack(scene.boxes)))
        wrong = integer + jnp.where(broken, bits.LOST, 0).astype(jnp.int32)
        return BufferState(
            stream=start_stream(scene, count),
            buffer=Entry(
                jnp.stack([jnp.full(rows, jnp.inf, dtype), jnp.zeros(rows, dtype)]),
                jnp.zeros((values, *rows), dtype),
                jnp.full((2, *rows), -1, jnp.int32),
            ),
            count=integer,
            outside=no,
            reach=zero - jnp.inf,
            owed=(integer - 1, zero),
            wrong=wrong,
            ends=(integer, integer),
            begun=no,
            segment=Segment(zero, zero, zero),
            active=no,
            waiting=are_rays(rays.origins, rays.directions),
            fresh=no,
            status=wrong,
        )

    def step(self, scene: CellFaces, rays: BeamRays, state: BufferState, move: Array):
        with jax.named_scope("kbuffer_step"):
            alive = state.active | state.waiting
            go = (move & state.active) | state.waiting
            sort = Sort(self.order, self.reverse)
            stream, more = state.stream, ~over(state.stream)
            idle = drawn(stream) | ~alive
            stream = refill(stream, more & jnp.all(idle) & jnp.any(alive), scene, rays, sort)
            # A ray whose place for an arrival is taken has another segment to give first.
            free = jnp.isinf(state.buffer.depth[0, -1])
            stream, new = next_fragments(stream, scene, rays.sheared, go & free)
            done = go & over(stream) & drawn(stream)
            state = state._replace(stream=stream)
            entry = _entry(scene.scene, rays, new, self)
            return _give(rays, _arrive(rays, state, new.hit, entry, self), go, done, self)

    def locate(self, scene: CellFaces, rays: BeamRays, state: BufferState) -> tuple[Array, Array]:
        near, far = (jnp.where(state.active, word, 0) for word in state.ends)
        at = crossing_of_face(scene.scene, rays.sheared, far, jnp.any(state.active))
        return packing.cell_of(near), (at.z + at.z_low) * rays.sheared.stretch

    def gradient_start(self, scene, rays, perturbed):
        by_rays = any(jax.tree.leaves(perturbed[1]))
        return gradient_zeros(scene.scene, rays.sheared, perturbed[0].scene, by_rays)

    def pull_back(self, scene, rays, state, cotangent, gradient):
        if self.reverse:
            cotangent = turned(cotangent)
        return pull_back_pair(
            scene.scene, rays.sheared, state.ends, state.active, cotangent, gradient
        )

    def scene_cotangent(self, scene, gradient):
        zero = jax.tree.map(jnp.zeros_like, scene)
        return dataclasses.replace(zero, scene=as_scene(scene.scene, gradient))

    def rays_cotangent(self, rays, gradient):
        zero = jax.tree.map(jnp.zeros_like, rays)
        return dataclasses.replace(zero, sheared=as_rays(rays.sheared, gradient))


def one_value(scene: Scene) -> bool:
    """Whether the scalar is the same on both sides of every face."""
    return scene.continuous and not scene.seams


def _entry(scene: Scene, rays: BeamRays, new: Hits, how: KBuffer) -> Entry:
    """Fragments as entries of a buffer."""
    wanted = jnp.any(new.hit)
    across = load(wanted, take, scene.neighbors, new.slot)
    # The turned and the seam bits are dropped.
    across = jnp.where(
        across < 0, -1, packing.pack(packing.cell_of(across), packing.corner_of(across))
    )
    words = jnp.stack([packing.pack(new.slot // 4, new.slot % 4), across])
    values = new.at.value[None] if one_value(scene) else _values(scene, words, new, wanted)
    depth = jnp.stack([new.at.z, new.at.z_low])
    return Entry(-depth if how.reverse else depth, values, words)


def _values(scene: Scene, words: Array, new: Hits, wanted: Array) -> Array:
    """The scalar (2, R) at fragments, as each of the two cells has it."""
    _, of_b, of_c = barycentric(new.face, new.weights)
    out = []
    for word in words:
        known = jnp.maximum(word, 0)
        corners = entry_corners(packing.corner_of(known))
        a, b, c = values_at(scene, packing.cell_of(known), corners, wanted)
        out.append(a + (of_b * (b - a) + of_c * (c - a)))
    return jnp.stack(out)


def _arrive(rays: BeamRays, state: BufferState, hit: Array, new: Entry, how: KBuffer):
    """Fragments (R,) that were hit take the last entry."""
    depth = lax.stop_gradient(new.depth[0])
    # The order behind the eye matters only where each fragment leads inside or outside.
    seen = (depth <= 0 if how.reverse else depth >= 0) | (how.pairs == "closest")
    late = hit & seen & (depth < state.reach - tolerance(depth, rays.sheared))
    buffer = jax.tree.map(
        lambda rows, x: rows.at[..., -1, :].set(jnp.where(hit, x, rows[..., -1, :])),
        state.buffer,
        new,
    )
    wrong = state.wrong | jnp.where(late, bits.K_TOO_SMALL, 0).astype(jnp.int32)
    return state._replace(buffer=buffer, count=state.count + hit.astype(jnp.int32), wrong=wrong)


def _give(rays: BeamRays, state: BufferState, go: Array, done: Array, how: KBuffer):
    """Full buffers give the segment of their first fragment, and drop it. So do those of rays that
    are `done`, to which nothing arrives any more, until they are empty."""
    buffer, count = state.buffer, state.count
    size = how.k + 1
    give = go & ((count == size) | (done & (count > 0)))
    wanted = jnp.any(give)
    depth = lax.stop_gradient(buffer.depth)
    pair = stage(wanted, lambda d, w: choose_pair(d, w, how.pairs == "cells"), depth, buffer.words)
    first = jax.tree.map(lambda rows: pick(pair.first, rows), buffer)
    second = jax.tree.map(lambda rows: pick(pair.second, rows), buffer)
    found = give & pair.found
    inside, outside = found, state.outside
    if how.pairs == "closest":
        # The tags: a segment that ends on the boundary leads outside, and the next two inside.
        inside = found & ~outside
        outside = jnp.where(found, inside & (second.words[1] < 0), outside)

    ends = (on_side(pair.mine, first.words), on_side(pair.theirs, second.words))
    # Empty entries are infinitely far: guarded here, or 0 times that is the derivative.
    one, two = (
        Crossing(*(jnp.where(found, x, 0) for x in crossing_of(entry, which)))
        for entry, which in ((first, pair.mine), (second, pair.theirs))
    )
    if how.reverse:
        one, two = (c._replace(z=-c.z, z_low=-c.z_low) for c in (one, two))
        segment, ends = turned(segment_between(two, one, rays.sheared.stretch)), ends[::-1]
    else:
        segment = segment_between(one, two, rays.sheared.stretch)
    given = inside & (segment.length > 0)

    buffer, left, drop = forget(buffer, first.words, pair, give, found, how.pairs == "cells")
    buffer = settle(buffer, pair.first, drop, go & ~give, count)
    count = count - drop.astype(jnp.int32)
    state = _account(rays, state, first, second, left, drop, how)
    finished = done & (count == 0)
    # A ray may end here, so what is owed now is told; it is taken back if it turns out to be paid.
    owing = jnp.where(state.owed[0] >= 0, bits.K_TOO_SMALL, 0).astype(jnp.int32)

    # A ray without a segment stands at the end of its last.
    active = jnp.where(go, given, state.active)
    back = state.segment.back
    old = Segment(jnp.where(go, back, state.segment.front), back, state.segment.length)
    new = Segment(*(jnp.where(given, a, b) for a, b in zip(segment, old, strict=True)))
    return state._replace(
        buffer=buffer,
        count=count,
        outside=outside,
        ends=tuple(jnp.where(given, a, b) for a, b in zip(ends, state.ends, strict=True)),
        begun=state.begun | given,
        segment=new._replace(length=jnp.where(active, new.length, 0)),
        active=active,
        waiting=jnp.where(go, ~given & ~finished, state.waiting),
        fresh=given & (~state.begun | (segment.front != back)),
        status=jnp.where(go, state.wrong | owing, state.status),
    )


def _account(rays: BeamRays, state: BufferState, first, second, left: Array, drop, how: KBuffer):
    """Status bits of rays that drop an entry with a cell left, whose segment is missing.

    Its other fragment is yet to come, or came too late and left before. If they turn out to be in
    the same place, as where a ray goes through an edge, the segment has no length, and nothing is
    missing. One such cell is remembered; a second at the same time counts as missing.
    """
    depth = lax.stop_gradient(first.depth[0])
    if how.pairs == "closest":
        reach = lax.stop_gradient(second.depth[0])
        return state._replace(reach=jnp.where(drop, jnp.maximum(state.reach, reach), state.reach))
    seen = drop & (depth <= 0 if how.reverse else depth >= 0)
    cell = packing.cell_of(jnp.max(left, axis=0))
    both = seen & jnp.all(left >= 0, axis=0)
    cell = jnp.where(seen, cell, -1)
    owed, where = state.owed
    paid = (cell >= 0) & (cell == owed)
    apart = paid & (jnp.abs(depth - where) > tolerance(depth, rays.sheared))
    another = (cell >= 0) & ~paid & (owed >= 0)
    missing = both | apart | another
    owed = jnp.where(paid, -1, jnp.where(cell >= 0, cell, owed))
    where = jnp.where(cell >= 0, depth, where)
    wrong = state.wrong | jnp.where(missing, bits.K_TOO_SMALL, 0).astype(jnp.int32)
    reach = jnp.where(drop, jnp.maximum(state.reach, depth), state.reach)
    return state._replace(owed=(owed, where), reach=reach, wrong=wrong)
