"""Hardware-assisted visibility sorting (Callahan, Ikits, Comba and Silva 2005), as a scan.

IEEE Transactions on Visualization and Computer Graphics, May/June 2005

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
The paper's way tells (`TANGLED`) where no cell lies between the closest two.

Flat and overturned cells. Depths are not those of a walk where moved points or rounding turned
cells over: a ray comes to a face, goes back to a nearer one, and on from there. `RayCast` waits at
the depth that it has reached (`local.make_segment`), and so do rays here. By cells fragments form
paths (`trace.path`), whose direction is known from the boundary on. A fragment that no path has
come to yet waits in the buffer, whatever its depth; the end of a path that leads back is followed
first, until it is as far again, and the segment there starts in the depth reached. From behind,
that depth is looked for in the buffer, among the faces in front. So paths give the segments of
`RayCast`, and only where several overlap their order is that of depths. Rings of overturned cells
hold nothing. All that waits takes entries: such views need a larger k.

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
from typing import Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxvr._core import status as bits
from jaxvr._core.gather import load, take
from jaxvr._core.pytree import noun, static
from jaxvr._core.stage import stage
from jaxvr.optics.partition import Segment, turned
from jaxvr.order import AbstractOrder, Centroid
from jaxvr.trace.base import AbstractTracer
from jaxvr.trace.beam import are_rays
from jaxvr.trace.buffer import (
    Entry,
    Pair,
    cell_pair,
    closest_pair,
    crossing_of,
    forget,
    is_number,
    least,
    on_side,
    pick,
    ready_entries,
    settle,
    used_entries,
)
from jaxvr.trace.face import Crossing, barycentric, choose
from jaxvr.trace.faces import CellFaces, cell_faces
from jaxvr.trace.local import (
    ROUNDING,
    Between,
    Side,
    are_out,
    as_rays,
    as_scene,
    crossing_of_face,
    gradient_zeros,
    pull_back_pair,
    segment_from,
    side_of,
)
from jaxvr.trace.path import Choice, deepest, follow, untangle
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
from jaxvr.view.rays import Rays
from jaxvr.volume import TetMesh, packing

Array = jax.Array


class Held(NamedTuple):
    """A path that leads back, of R rays: word of the face that it has come to, with the cell behind
    it, -1 if none does; the depth that was reached before, a crossing, and the word of that face.
    void (R,): it is a ring that holds nothing, and the depth is beyond all of it.
    """

    word: Array
    at: Crossing
    face: Array
    void: Array


class BufferState(NamedTuple):
    """One state of R rays.

    buffer: the last entry is the place of the fragment that arrives. count (R,): entries in use.
    outside (R,): the paper's tag of a pixel; last (R,): word of the last segment's farther end.
    reach (R,): depth before which nothing may arrive any more, or no path start. held: what path
    is followed first. ringed (R,): whether the ray met a ring. seen_from (R,): whether a path leads
    past the eye, and whether another starts that may. owed: a cell (R,) that lacks a
    fragment, -1 if none does, and the depth (R,) of its other. wrong (R,): bits of status that
    stay; the status has what is owed at the time, too. faces: of the segment. begun (R,): had one.
    """

    stream: Stream
    buffer: Entry
    count: Array
    outside: Array
    last: Array
    reach: Array
    held: Held
    ringed: Array
    seen_from: tuple[Array, Array]
    owed: tuple[Array, Array]
    wrong: Array
    faces: Between
    begun: Array
    segment: Segment
    active: Array
    waiting: Array
    fresh: Array
    status: Array


@noun
class KBuffer(AbstractTracer):
    """Faces sorted roughly, fragments sorted by a buffer of k entries a pixel (see the module).

    k: entries. A ray that would have needed more has the status `K_TOO_SMALL`, an error outside
    jit; `render(..., status=True)` gives the image and the status instead, and `measure_k` the k
    that a view needs. Time grows with it. Rays that end early, by `Over(termination=...)`, know
    less: see the module.
    order: a `jaxvr.order.AbstractOrder`; the better it sorts, the smaller k may be.
    pairs: "cells" or "closest", which two fragments make a segment; "closest" is the paper's.
    reverse: the farthest segments first; an `Over` that composites back to front sets it.

    Equal to `RayCast` where k suffices, gradients too, also where cells have no volume or moved
    points have turned some over. Where a mesh overlaps itself, segments of several paths come by
    the depth of their nearer ends, while `RayCast` takes whole paths; the rings of folded cells
    that it misses there are found here. With pairs="closest", rays that meet overturned cells have
    the status `TANGLED`, and so have those from an eye inside of several cells at once.

    Rays that share an origin (pinhole) or a direction (orthographic) with their batch are fast. Any
    others are tested against every face, in an order that suits them only roughly.

    Raises:
      ValueError: if k is not a positive integer, or order or pairs are not what they may be.
    """

    takes: ClassVar[type] = TetMesh
    cuts: ClassVar[bool] = True

    k: int = static(default=6)
    order: AbstractOrder = static(default=Centroid())
    pairs: Literal["cells", "closest"] = static(default="cells")
    reverse: bool = static(default=False)

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

    def prepare_rays(self, scene: CellFaces, rays: Rays) -> BeamRays:
        return beam_rays(rays, scene.scene.scale)

    def start(self, scene: CellFaces, rays: BeamRays) -> BufferState:
        dtype, count = rays.origins.dtype, rays.origins.shape[1]
        zero, no = jnp.zeros(count, dtype), jnp.zeros(count, bool)
        integer, rows = jnp.zeros(count, jnp.int32), (self.k + 1, count)
        inside = Side(no, None if rays.sheared.far is None else no)
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
            last=integer - 1,
            reach=zero - jnp.inf,
            held=Held(integer - 1, Crossing(zero, zero, zero), integer, no),
            ringed=no,
            seen_from=(no, no),
            owed=(integer - 1, zero),
            wrong=wrong,
            faces=Between(integer, integer, integer, no, no, (inside, inside)),
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
            entry = _entry(scene, rays, new, self)
            return _give(rays, _arrive(rays, state, new.hit, entry, self), go, done, self)

    def locate(self, scene: CellFaces, rays: BeamRays, state: BufferState):
        faces, wanted = state.faces, jnp.any(state.active)
        first = jnp.where(faces.cut, faces.start, faces.enter)
        distances = []
        for word in (first, faces.leave):
            word = jnp.where(state.active, word, 0)
            at = crossing_of_face(scene.scene, rays.sheared, word, wanted)
            distances.append((at.z + at.z_low) * rays.sheared.stretch)
        if self.reverse:
            distances.reverse()
        return packing.cell_of(jnp.where(state.active, faces.enter, 0)), *distances

    def gradient_start(self, scene, rays, perturbed):
        by_rays = any(jax.tree.leaves(perturbed[1]))
        return gradient_zeros(scene.scene, rays.sheared, perturbed[0].scene, by_rays)

    def pull_back(self, scene, rays, state, cotangent, gradient):
        if self.reverse:
            cotangent = turned(cotangent)
        return pull_back_pair(
            scene.scene, rays.sheared, state.faces, state.active, cotangent, gradient
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


def _entry(scene: CellFaces, rays: BeamRays, new: Hits, how: KBuffer) -> Entry:
    """Fragments as entries of a buffer."""
    wanted = jnp.any(new.hit)

    def find(scene, slot):
        return take(scene.scene.neighbors, slot), scene.turned(slot // 4), scene.inwards(slot)

    across, turned, inwards = load(wanted, find, scene, new.slot)
    # The seam bit is dropped.
    there, corner = packing.cell_of(across), packing.corner_of(across)
    beyond = jnp.where(across < 0, -1, packing.pack(there, corner, packing.turned_of(across)))
    # Of a path from the eye, the last face is the one that leads outwards.
    ends = (across < 0) & ((new.positive != inwards) != how.reverse)
    own = packing.pack(new.slot // 4, new.slot % 4, turned, ends.astype(jnp.int32))
    words = jnp.stack([own, beyond])
    mesh = scene.scene
    values = new.at.value[None] if one_value(mesh) else _values(mesh, words, new, wanted)
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
    wrong = state.wrong
    if how.pairs == "closest":
        depth = lax.stop_gradient(new.depth[0])
        late = hit & (depth < state.reach - tolerance(depth, rays.sheared))
        wrong = wrong | _bits(late, bits.K_TOO_SMALL)
    buffer = jax.tree.map(
        lambda rows, x: rows.at[..., -1, :].set(jnp.where(hit, x, rows[..., -1, :])),
        state.buffer,
        new,
    )
    return state._replace(buffer=buffer, count=state.count + hit.astype(jnp.int32), wrong=wrong)


def _bits(where: Array, bit: int) -> Array:
    return jnp.where(where, bit, 0).astype(jnp.int32)


class Chosen(NamedTuple):
    """Two entries of R rays. found (R,): there are two. shared (R,): a cell lies between them. new
    (R,): the first starts a path; loose (R,): inside of the mesh. follows (R,): it goes on with a
    path that is held. void (R,): it starts a ring that holds nothing. ring (R,): it starts one that
    does. late (R,): see `path.Choice`. ready (K, R): see `buffer.ready_entries`."""

    pair: Pair
    found: Array
    shared: Array
    new: Array
    loose: Array
    follows: Array
    void: Array
    ring: Array
    late: Array
    ready: Array


def _choose_closest(rays: BeamRays, state: BufferState, give: Array) -> Chosen:
    """The closest two, as in the paper."""
    depth, words = lax.stop_gradient(state.buffer.depth), state.buffer.words
    near = jnp.min(jnp.where(used_entries(depth[0]), jnp.abs(depth[0]), jnp.inf), axis=0)
    slack = tolerance(jnp.where(jnp.isfinite(near), near, 0), rays.sheared)
    pair, shared = stage(jnp.any(give), closest_pair, depth, words, state.last, slack)
    no = jnp.zeros_like(give)
    return Chosen(pair, give & pair.found, shared, no, no, no, no, no, no, words[0] >= 0)


def _choose_by_cells(state: BufferState, give: Array, how: KBuffer) -> Chosen:
    """The closest of the entries that paths have come to, and the next of its path."""
    depth, words = lax.stop_gradient(state.buffer.depth), state.buffer.words
    wanted, word = jnp.any(give), state.held.word
    follows = give & (word >= 0)

    def turns(depth, words, word):
        ready, used = ready_entries(depth, words), used_entries(depth[0])
        held = used & jnp.any(words == word[None, None], axis=0)
        number = jnp.argmax(held, axis=0).astype(jnp.int32)
        return ready, least(depth, used), least(depth, ready), number

    ready, closest, waiting, held = stage(wanted, turns, depth, words, word)
    odd = give & ~follows & (pick(closest, ready.astype(jnp.int32)) == 0)
    true = _true_depths(depth[0], how)
    choice: Choice = stage(
        jnp.any(odd), untangle, depth[0], true, words, ready, closest, waiting, odd
    )
    first = jnp.where(follows, held, jnp.where(odd, choice.first, closest))
    sides, void = pick(first, words), odd & choice.void
    only = jnp.where(void, packing.cell_of(sides[0]), -1)
    pair = stage(wanted, cell_pair, depth, words, first, only)
    found = give & pair.found
    new = found & (jnp.all(sides >= 0, axis=0) | jnp.any(sides == -1, axis=0))
    ring = odd & choice.ring & ~void
    loose = found & jnp.all(sides >= 0, axis=0) & ~choice.ring
    return Chosen(
        pair, found, found, new, loose, follows, void, ring, found & odd & choice.late, ready
    )


def _true_depths(depth: Array, how: KBuffer) -> Array:
    """Depths (K, R) from the eye, infinite where an entry holds none."""
    return jnp.where(used_entries(depth), -depth if how.reverse else depth, jnp.inf)


class Start(NamedTuple):
    """Where segments of R rays start, if cut (R,): at a crossing, that of the face of a word."""

    at: Crossing
    word: Array
    cut: Array


def _crossing(buffer: Entry, number: Array, how: KBuffer) -> tuple[Crossing, Array]:
    """The crossing of an entry (R,), and a word of its face."""
    depth = pick(number, buffer.depth)
    depth = -depth if how.reverse else depth
    depth = jnp.where(jnp.isfinite(depth), depth, 0)
    word = jnp.max(pick(number, buffer.words), axis=0)
    return Crossing(depth[0], depth[1], jnp.zeros_like(depth[0])), jnp.maximum(word, 0)


def _start(state: BufferState, chosen: Chosen, onward: Array, how: KBuffer) -> Start:
    """Where the segments of paths start: in the depth reached, if that is not the entry face's.

    onward (R,): word of the second entry's other cell. From behind, what a ray has reached on its
    way is looked for in the buffer. That takes faces that lie farther than the second entry though
    no path has come to them, or a turned cell, and is rare.
    """
    buffer, pair, held = state.buffer, chosen.pair, state.held
    true = _true_depths(lax.stop_gradient(buffer.depth[0]), how)
    beyond = jnp.max(jnp.where(jnp.isfinite(true), true, -jnp.inf), axis=0) + 1
    beyond = jnp.where(chosen.void, beyond, 0)
    at = choose(chosen.follows, held.at, Crossing(beyond, beyond * 0, beyond * 0))
    known = Start(at, held.face, chosen.found & (chosen.follows | chosen.void))
    if not how.reverse:
        return known
    depth, words = lax.stop_gradient(buffer.depth), buffer.words
    used, size = used_entries(depth[0]), depth.shape[1]
    others = used & ~is_number(pair.first, size) & ~is_number(pair.second, size)
    second = pick(pair.second, depth)[0]
    farther = jnp.any(others & ~chosen.ready & (depth[0] < second[None]), axis=0)
    turned = jnp.any((words >= 0) & (packing.turned_of(words) == 1), axis=(0, 1))
    void = known.cut & (chosen.void | (chosen.follows & held.void))
    doubt = chosen.found & (farther | turned | chosen.follows) & ~void

    def look(true, words, ready, second, onward, doubt):
        return deepest(follow(true, words, ready, second, onward, doubt, known=True))

    number = stage(jnp.any(doubt), look, true, words, chosen.ready, pair.second, onward, doubt)
    number = jnp.where(doubt, number, pair.second)
    at, word = _crossing(buffer, number, how)
    lead = lax.stop_gradient(at.z) + second
    cut = doubt & (jnp.abs(lead) > ROUNDING * jnp.finfo(lead.dtype).eps)
    return Start(*(choose(void, x, y) for x, y in zip(known, (at, word, cut), strict=True)))


def _give(rays: BeamRays, state: BufferState, go: Array, done: Array, how: KBuffer):
    """Full buffers give the segment of their first fragment, and drop it. So do those of rays that
    are `done`, to which nothing arrives any more, until they are empty."""
    buffer, count = state.buffer, state.count
    by_cells = how.pairs == "cells"
    give = go & ((count == how.k + 1) | (done & (count > 0)))
    if by_cells:
        chosen = _choose_by_cells(state, give, how)
    else:
        chosen = _choose_closest(rays, state, give)
    pair, found = chosen.pair, chosen.found
    first = jax.tree.map(lambda rows: pick(pair.first, rows), buffer)
    second = jax.tree.map(lambda rows: pick(pair.second, rows), buffer)
    words = on_side(pair.mine, first.words), on_side(pair.theirs, second.words)
    # Empty entries are infinitely far: guarded here, or 0 times that is the derivative.
    one, two = (
        Crossing(*(jnp.where(found, x, 0) for x in crossing_of(entry, which)))
        for entry, which in ((first, pair.mine), (second, pair.theirs))
    )
    if how.reverse:
        one, two = (c._replace(z=-c.z, z_low=-c.z_low) for c in (two, one))
        words = words[::-1]

    ringed, no = state.ringed | chosen.ring, jnp.zeros_like(go)
    onward = on_side(1 - pair.theirs, second.words)
    start, backwards = Start(one, words[0], no), no
    if by_cells:
        start = _start(state, chosen, onward, how)
        # Which way a ring is run through is not known: by depth.
        backwards = found & (packing.turned_of(words[0]) == 1) & ~ringed
    interval = rays.sheared.interval
    segment, after = segment_from(start.at, one, two, start.cut, backwards, interval)
    at = choose(start.cut, start.at, one)
    sides = side_of((at.z, at.z_low), interval), side_of(after.depth, interval)
    faces = Between(*words, start.word, start.cut, backwards, sides)

    inside, outside = found, state.outside
    if not by_cells:
        # The tags: a segment that ends on the boundary leads outside, and the next two inside.
        inside = found & ~outside
        outside = jnp.where(found, inside & (second.words[1] < 0), outside)
    begin, end = lax.stop_gradient(at.z), lax.stop_gradient(two.z)
    # A segment of no length has a derivative, where that is not a matter of more than rounding: so
    # has one that ends at the eye, which the next makes up for.
    flat = (segment.length == 0) & (after.lead == 0) & ~are_out(sides)
    given = inside & ((segment.length > 0) | flat)

    buffer, left, drop = forget(buffer, first.words, pair, give, found, by_cells)
    buffer = settle(buffer, pair.first, drop, go & ~give, count)
    count = count - drop.astype(jnp.int32)
    slack = tolerance(end, rays.sheared)
    solid = given & (
        lax.stop_gradient(segment.length) > slack * lax.stop_gradient(interval.stretch)
    )
    if by_cells:
        state = _in_order(state, chosen, faces, (begin, end), solid, slack, how)
        state = _hold(state, chosen, start, after, faces, onward, give, how)
        state = _account(rays, state, first, left, drop, how)
    else:
        reach = lax.stop_gradient(second.depth[0])
        state = state._replace(
            last=jnp.where(found, second.words[0], state.last),
            reach=jnp.where(drop, jnp.maximum(state.reach, reach), state.reach),
            wrong=state.wrong | _bits(inside & ~chosen.shared & (end >= 0), bits.TANGLED),
        )
    finished = done & (count == 0)
    # A ray may end here, so what is owed now is told; it is taken back if it turns out to be paid.
    owing = _bits(state.owed[0] >= 0, bits.K_TOO_SMALL)

    if how.reverse:
        segment = turned(segment)
    # A ray without a segment stands at the end of its last.
    active = jnp.where(go, given, state.active)
    back = state.segment.back
    old = Segment(jnp.where(go, back, state.segment.front), back, state.segment.length)
    new = choose(given, segment, old)
    return state._replace(
        buffer=buffer,
        count=count,
        outside=outside,
        ringed=ringed,
        faces=choose(given, faces, state.faces),
        begun=state.begun | given,
        segment=new._replace(length=jnp.where(active, new.length, 0)),
        active=active,
        waiting=jnp.where(go, ~given & ~finished, state.waiting),
        fresh=given & (~state.begun | (segment.front != back)),
        status=jnp.where(go, state.wrong | owing, state.status),
    )


def _hold(state: BufferState, chosen: Chosen, start: Start, after, faces, onward, give, how):
    """Paths that are not as far as they have been go on before all others."""
    there = chosen.found & (onward >= 0)
    if how.reverse:
        hold, at, face = there & start.cut, start.at, start.word
    else:
        hold = there & (after.lead != 0)
        at = Crossing(after.depth[0], after.depth[1], jnp.zeros_like(after.lead))
        face = jnp.where(start.cut, start.word, faces.enter)
    word = jnp.where(hold, onward, jnp.where(give, -1, state.held.word))
    face = jnp.where(hold, face, state.held.face)
    void = hold & (chosen.void | (chosen.follows & state.held.void))
    return state._replace(held=Held(word, choose(hold, at, state.held.at), face, void))


def _in_order(state: BufferState, chosen: Chosen, faces: Between, between, solid, slack, how):
    """Status bits of rays that give the start of a path behind a segment that lies farther on.

    And from behind, of those whose path turns out to have been farther at a face than it was said
    to be when the segment behind that face was given.
    """
    begin, end = between
    near = jnp.minimum(-begin, -end) if how.reverse else jnp.minimum(begin, end)
    wrong = chosen.late | (solid & chosen.new & (near < state.reach - slack))
    # Faces behind the eye are drawn only of cells that may be round it. If several paths lead past
    # it, they may be parts of one, and nothing tells which is first.
    crossed, another = state.seen_from
    crosses = chosen.found & ((begin < 0) != (end < 0))
    another = another | (chosen.loose & (crossed | how.reverse))
    tangled = crosses & another & crossed
    if how.reverse:
        known = jnp.where(chosen.follows, lax.stop_gradient(state.held.at.z), end)
        more = jnp.where(faces.turned, known - begin, begin - known)
        goes_on = chosen.found & ~chosen.new & ~state.ringed & ~chosen.ring
        wrong = wrong | (goes_on & (more > slack))
    return state._replace(
        reach=jnp.where(solid, near, state.reach),
        seen_from=(crossed | crosses, another),
        wrong=state.wrong | _bits(wrong, bits.K_TOO_SMALL) | _bits(tangled, bits.TANGLED),
    )


def _account(rays: BeamRays, state: BufferState, first: Entry, left: Array, drop, how: KBuffer):
    """Status bits of rays that drop an entry with a cell left, whose segment is missing.

    Its other fragment is yet to come, or came too late and left before. If they turn out to be in
    the same place, as where a ray goes through an edge, the segment has no length, and nothing is
    missing. One such cell is remembered; a second at the same time counts as missing.
    """
    depth = lax.stop_gradient(first.depth[0])
    # The order behind the eye matters only where each fragment leads inside or outside.
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
    return state._replace(owed=(owed, where), wrong=state.wrong | _bits(missing, bits.K_TOO_SMALL))
