"""Ray casting from cell to cell (Bunyk, Kaufman and Silva 1997; Espinha and Celes 2005).

"Simple, fast, and robust ray casting of irregular grids", Scientific Visualization Conference,
Dagstuhl 1997, 30-36; doi:10.1109/SIBGRAPI.2005.29

A ray inside a tetrahedron has come in through the face (a, b, c), whose vertices are listed in the
order of the mesh, and sees the fourth vertex d. The signs of the three edges that d makes with a,
b and c tell the exit: with the face's own orientation taken as positive, it is the face that
replaces the vertex between an edge that d passes on the negative side and the next, passed on the
positive side. Among three signs that are not all equal there is exactly one such place.

They never are all equal, since signs are exact (`jaxvr.numerics.exact`): projected onto the plane
across the ray, with vertices where they were rounded to, a tetrahedron has either no faces that
contain the origin or two. Therefore faces that contain a ray form paths, each from one boundary
face to another: a walk cannot be lost, cannot stop inside, and cannot enter a loop, whether it
meets vertices, runs along edges or lies in faces, in float32 as in float64. Rounding of depths has
no say in it.

Cost: a step gathers two words of topology, one vertex and its scalar (24 bytes in float32), and
projects that vertex only. Nothing depends on the camera but the entry points.

What is defined for input that intersects itself: a path from entry to exit is composited whole, and
paths in the order of their entry depth. A cell that is inverted against its neighbours (a fold) is
walked backwards in depth, contributes its chord like any other cell, and stands in the path where
the connectivity has it. A cell that only moved points or rounding turned over (`turned` is 0) does
not: the ray waits at the depth that it has reached, and what follows is cut off there, so chords go
on adding up to the distance from entry to exit (`local.make_segment`).

A few cells round a fold can form a closed ring that a ray pierces without touching the boundary; a
walk from the boundary does not reach it, and it is left out. On the crushed can of the VTK data (77
inverted cells in 28,800) that is one ray in 700.
"""

from __future__ import annotations

import dataclasses
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxvr._core import status as bits
from jaxvr._core.gather import load, take
from jaxvr._core.once import once
from jaxvr._core.pytree import noun, pytree, static
from jaxvr._core.stage import stage
from jaxvr.optics.partition import Segment
from jaxvr.trace.base import AbstractTracer
from jaxvr.trace.entry import Boxes, Entries, build_boxes, no_entries, search
from jaxvr.trace.face import Face, choose, crossing, is_positive, opposite_edges, sizes_of
from jaxvr.trace.local import (
    Reached,
    Side,
    as_rays,
    as_scene,
    edges_to_apex,
    exit_face,
    gradient_zeros,
    in_order,
    leave_by,
    make_segment,
    pull_back_cell,
    side_of,
)
from jaxvr.trace.scene import (
    Scene,
    entry_corners,
    fetch,
    longest_edge,
    make_scene,
    values_at,
)
from jaxvr.trace.shear import VALUE, ShearedRays, shear_rays
from jaxvr.view.rays import Rays
from jaxvr.volume import packing
from jaxvr.volume.mesh import TetMesh

Array = jax.Array


@pytree
class CastScene:
    """The mesh and the hierarchy over its boundary."""

    mesh: Scene
    boxes: Boxes


class Cell(NamedTuple):
    """The cell that a ray is in, with the face that it came in by.

    word (R,): packed cell and local index of the apex. positive (R,): sign of the entry face.
    face: its three vertices (4, R). weights (3, R): their barycentric weights. exit_corner (R,):
    local index of the vertex that the exit face does not have. lead, reached: as they were ahead.
    side: where the depth reached ahead lay; depth (R,): that depth.
    """

    word: Array
    positive: Array
    face: Face
    weights: Array
    exit_corner: Array
    lead: Array
    reached: Array
    side: Side
    depth: Array


class Ahead(NamedTuple):
    """The face that a ray crosses next: the exit of the cell that it is in, or an entry.

    word (R,): packed cell behind it and local index of the apex there, -1 outside of the mesh.
    positive (R,), face, weights (3, R): its sign, vertices and weights, as in a `Cell`.
    depth (2, R), a pair: where the ray crosses it, or how far it has come, if that is farther by
    lead (R,), see `local.Reached`; then reached (R,) is the word of the face where that was.
    value (R,): the scalar where the ray crosses it; a segment that is cut has another at its back.
    """

    word: Array
    positive: Array
    face: Face
    weights: Array
    depth: Array
    value: Array
    lead: Array
    reached: Array


class CastState(NamedTuple):
    """One state of R rays. left (R,): how many more cells each may be in. Only `pull_back` and
    `locate` read `cell`: loops without them do not carry it, since XLA drops what nothing depends
    on."""

    cell: Cell
    ahead: Ahead
    segment: Segment
    active: Array
    waiting: Array
    fresh: Array
    status: Array
    entries: Entries
    last: tuple[Array, Array]
    left: Array


@noun
class RayCast(AbstractTracer):
    """Cell to cell by adjacency, in lock step. Exact order; no ray is lost (see the module).

    Gradients: with respect to point positions, values, ray origins and directions. They are those
    of the image with the order of cells held fixed, which is the gradient wherever it exists: not
    on rays that only touch an edge or a vertex of the boundary. Zero by convention where a ray lies
    in a face's plane.

    reverse: the farthest segments first; an `Over` that composites back to front sets it. A ray
        from behind is a ray: it comes the other way, and ends at the eye.
    """

    takes: ClassVar[type] = TetMesh
    cuts: ClassVar[bool] = True

    reverse: bool = static(default=False, repr=False)

    def reversed(self) -> RayCast:
        return RayCast(not self.reverse)

    def prepare(self, volume: TetMesh) -> CastScene:
        scene = make_scene(volume)
        return CastScene(scene, build_boxes(scene))

    def longest(self, scene: CastScene) -> Array:
        return longest_edge(scene.mesh)

    def prepare_rays(self, scene: CastScene, rays: Rays) -> ShearedRays:
        sheared = shear_rays(rays.reversed() if self.reverse else rays, scene.mesh.scale)
        return stopping(scene.mesh, sheared)

    def start(self, scene: CastScene, rays: ShearedRays) -> CastState:
        dtype = rays.origin_x.dtype
        count = rays.origin_x.shape[0]
        zero, no = jnp.zeros(count, dtype), jnp.zeros(count, bool)
        integer = jnp.zeros(count, jnp.int32)
        vertex = jnp.zeros((4, count), dtype)
        face, ones = (vertex, vertex, vertex), jnp.ones((3, count), dtype)
        none = Side(no, None if rays.far is None else no)
        return CastState(
            cell=Cell(integer, no, face, ones, integer, zero, integer, none, zero),
            ahead=Ahead(
                *(integer, no, face, ones, jnp.zeros((2, count), dtype), zero, zero, integer)
            ),
            segment=Segment(zero, zero, zero),
            active=no,
            waiting=~no,
            fresh=no,
            status=integer,
            entries=no_entries(count, dtype, more=True),
            last=(zero - jnp.inf, integer - 1),
            left=integer + scene.mesh.neighbors.shape[0] // 4,
        )

    def step(self, scene: CastScene, rays: ShearedRays, state: CastState, move: Array) -> CastState:
        with jax.named_scope("raycast_step"):
            move = move & state.active
            through = _is_through(rays, state.ahead)
            inside = move & (state.ahead.word >= 0) & ~through
            gone = move & ~inside
            # A ray that waits for nothing is done.
            left = (state.entries.face[0] >= 0) | state.entries.more
            active, waiting = state.active & ~gone, state.waiting | (gone & left)
            # Entering is rare and costly, so it waits until no ray of the batch is inside.
            enter = ~jnp.any(active)
            door = _Door(state.ahead, inside, waiting, state.entries, state.last)
            ahead, moved, waiting, entries, last = once(enter, _enter, door, scene, rays)
            state = state._replace(
                ahead=ahead, active=active, waiting=waiting, entries=entries, last=last
            )
            return _cross(scene.mesh, rays, state, moved, enter)

    def locate(self, scene: CastScene, rays: ShearedRays, state: CastState):
        back = (state.ahead.depth[0] + state.ahead.depth[1]) * rays.stretch
        front = state.cell.depth * rays.stretch
        if self.reverse:
            front, back = -front, -back
        return packing.cell_of(state.cell.word), front, back

    def gradient_start(self, scene, rays, perturbed):
        by_rays = any(jax.tree.leaves(perturbed[1]))
        return gradient_zeros(scene.mesh, rays, perturbed[0].mesh, by_rays)

    def pull_back(self, scene, rays, state, cotangent, gradient):
        return pull_back_cell(scene.mesh, rays, state, cotangent, gradient)

    def scene_cotangent(self, scene, gradient):
        zero = jax.tree.map(jnp.zeros_like, scene)
        return dataclasses.replace(zero, mesh=as_scene(scene.mesh, gradient))

    def rays_cotangent(self, rays, gradient):
        return as_rays(rays, gradient)


def stopping(scene: Scene, rays: ShearedRays) -> ShearedRays:
    """Rays that end go no farther, unless cells are folded: there a path comes back."""
    if rays.far is None:
        return rays
    words = jnp.concatenate([scene.neighbors, scene.faces])
    folded = jnp.any((words >= 0) & (packing.turned_of(words) == 1))
    stop = jnp.where(folded, jnp.inf, lax.stop_gradient(rays.far))
    return dataclasses.replace(rays, stop=stop)


def _is_through(rays: ShearedRays, ahead: Ahead) -> Array:
    """Rays (R,) that have come farther on their path than where anything is seen."""
    if rays.stop is None:
        return jnp.zeros_like(ahead.positive)
    return lax.stop_gradient(ahead.depth[0] + ahead.depth[1]) > rays.stop


class _Door(NamedTuple):
    """What rays that enter change."""

    ahead: Ahead
    moved: Array
    waiting: Array
    entries: Entries
    last: tuple[Array, Array]


def _enter(door: _Door, scene: CastScene, rays: ShearedRays) -> _Door:
    """Waiting rays go to their next entry, if there is one."""
    mesh = scene.mesh
    exhausted = door.waiting & (door.entries.face[0] < 0) & door.entries.more
    entries = once(
        jnp.any(exhausted), _again, door.entries, mesh, rays, scene.boxes, exhausted, door.last
    )
    word = entries.face[0]
    entering = door.waiting & (word >= 0)
    if rays.stop is not None:  # another path may begin before it, where a mesh overlaps itself
        entering = entering & ~(entries.depth[0] > rays.stop)
    last = (
        jnp.where(entering, entries.depth[0], door.last[0]),
        jnp.where(entering, word, door.last[1]),
    )
    rest = Entries(
        (*entries.depth[1:], jnp.full_like(entries.depth[0], jnp.inf)),
        (*entries.face[1:], jnp.full_like(entries.face[0], -1)),
        entries.more,
    )
    entries = choose(entering, rest, entries)
    word = jnp.maximum(word, 0)
    cell, corner = packing.cell_of(word), packing.corner_of(word)
    wanted = jnp.any(entering)
    a, b, c = fetch(mesh, rays, cell, entry_corners(corner), wanted)
    face = (a, b, c)
    edges = stage(wanted, opposite_edges, *face)
    sizes = sizes_of(edges)
    at = stage(wanted, crossing, face, sizes, rays.eye)
    word = packing.pack(cell, corner, packing.turned_of(word))
    none = jnp.zeros_like(at.z)
    new = Ahead(word, is_positive(edges[2]), face, sizes, jnp.stack(at[:2]), at.value, none, word)
    ahead = choose(entering, new, door.ahead)
    return _Door(ahead, entering, jnp.zeros_like(entering), entries, last)


def _again(entries: Entries, mesh, rays, boxes, exhausted, last) -> Entries:
    return choose(exhausted, search(mesh, rays, boxes, exhausted, last), entries)


def _cross(
    scene: Scene, rays: ShearedRays, state: CastState, moved: Array, entered: Array
) -> CastState:
    """Through the face ahead: fetches the fourth vertex of the cell behind it, finds the exit, and
    makes the segment. The exit face is the one ahead then."""
    # What stays as it is passes through the stages too, so they are skipped only where none has.
    ahead, wanted = state.ahead, jnp.any(moved | state.active)
    word = jnp.maximum(ahead.word, 0)
    number, corner = packing.cell_of(word), packing.corner_of(word)
    (apex,) = fetch(scene, rays, number, corner[None], wanted)
    face, front, fresh = _values_here(scene, ahead, rays, number, corner, word, moved, wanted)
    to_apex = stage(wanted, edges_to_apex, face, apex, corner)
    leave = stage(wanted, leave_by, ahead.positive, ahead.weights, to_apex)
    drop = leave.drop
    exit_corner = drop + (corner <= drop).astype(jnp.int32)
    # How many of the two vertices that stay come before the apex in the mesh's order.
    place = corner - (corner > drop).astype(jnp.int32)
    # The boundary of a tetrahedron has degree zero: omitting the k-th of its sorted vertices
    # gives a face of sign (-1)^k, and what comes in must go out.
    positive = ahead.positive ^ (((corner + exit_corner) & 1) == 0) & moved

    def look(neighbors, number, exit_corner):
        return take(neighbors, 4 * number + exit_corner)

    behind = load(wanted, look, scene.neighbors, number, exit_corner)

    def onward(face, apex, weights, exit_weights, drop, place, moved):
        new = in_order(exit_face(face, apex, drop), place)
        exit_weights = jnp.stack(in_order(exit_weights, place))
        return choose(moved, new, face), choose(moved, exit_weights, weights)

    new_face, new_weights = stage(
        wanted, onward, face, apex, ahead.weights, leave.weights, drop, place, moved
    )
    out = stage(wanted, crossing, new_face, new_weights, rays.eye)
    turned = packing.turned_of(word) == 1
    reached = Reached(ahead.depth, ahead.lead)
    segment, reached = stage(wanted, make_segment, reached, front, out, turned, rays.interval)
    lost = moved & leave.lost
    # A ray is in a cell once: one that comes back follows words that belong to no mesh.
    astray = moved & (state.left == 0)
    cell = Cell(
        *(word, ahead.positive, face, ahead.weights, exit_corner),
        *(ahead.lead, ahead.reached, side_of(ahead.depth, rays.interval)),
        ahead.depth[0] + ahead.depth[1],
    )
    active = jnp.where(moved, ~(lost | astray), state.active)
    segment = choose(moved, segment, state.segment)
    return CastState(
        cell=choose(moved, cell, state.cell),
        ahead=Ahead(
            jnp.where(moved, behind, ahead.word),
            positive,
            new_face,
            new_weights,
            choose(moved, reached.depth, ahead.depth),
            jnp.where(moved, out.value, ahead.value),
            jnp.where(moved, reached.lead, ahead.lead),
            jnp.where(moved & (ahead.lead == 0), word, ahead.reached),
        ),
        segment=segment._replace(length=jnp.where(active, segment.length, 0)),
        active=active,
        waiting=state.waiting,
        fresh=moved & (fresh | entered | (segment.front != state.segment.back)),
        status=state.status
        | jnp.where(lost, bits.LOST, 0).astype(jnp.int32)
        | jnp.where(astray, bits.BROKEN, 0).astype(jnp.int32),
        entries=state.entries,
        last=state.last,
        left=state.left - moved,
    )


def _values_here(scene: Scene, ahead: Ahead, rays, number, corner, word, moved, wanted):
    """The entry face with this cell's own scalars, the scalar at the entry, and whether it may
    differ from the one behind the face."""
    same, own = (ahead.face, ahead.value), (scene, rays, ahead.weights, number, corner)
    if not scene.continuous:
        return *_own_values(same, *own, moved, wanted), jnp.ones_like(moved)
    if not scene.seams:
        return *same, jnp.zeros_like(moved)
    seam = moved & (packing.flag_of(word) == 1)
    return *once(jnp.any(seam), _own_values, same, *own, seam, wanted), seam


def _own_values(same, scene: Scene, rays, weights, number, corner, where, wanted):
    """The entry face and the scalar there, `same`, with a cell's own scalars for rays `where`."""
    face, front = same
    values = values_at(scene, number, entry_corners(corner), wanted)
    own = tuple(v.at[VALUE].set(value) for v, value in zip(face, values, strict=True))
    face = choose(where, own, face)
    at = stage(wanted, crossing, face, weights, rays.eye)
    return face, jnp.where(where, at.value, front)
