"""Ray casting from cell to cell (Bunyk, Kaufman and Silva 1997; Espinha and Celes 2005).

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
the connectivity has it. A few cells round such a fold can form a closed ring that a ray pierces
without touching the boundary; a walk from the boundary does not reach it, and it is left out. On
the crushed can of the VTK data (77 inverted cells in 28,800) that is one ray in 700.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxvr._core import status as bits
from jaxvr._core.pytree import pytree
from jaxvr._core.stage import stage
from jaxvr.optics.partition import Segment
from jaxvr.trace.base import AbstractTracer
from jaxvr.trace.entry import Boxes, Entries, build_boxes, no_entries, search
from jaxvr.trace.face import Face, choose, crossing, is_positive, opposite_edges, sizes_of
from jaxvr.trace.local import edges_to_apex, exit_face, leave_by, make_segment, pull_back_cell
from jaxvr.trace.scene import (
    Scene,
    entry_corners,
    fetch,
    local_ids,
    longest_edge,
    make_scene,
    value_slots,
)
from jaxvr.trace.shear import VALUE, ShearedRays, shear_rays
from jaxvr.volume import packing
from jaxvr.volume.mesh import TetMesh

Array = jax.Array


@pytree
class CastScene:
    """The mesh and the hierarchy over its boundary."""

    mesh: Scene
    boxes: Boxes


class Cell(NamedTuple):
    """The cell that a ray is in, with the two faces that it crosses.

    word (R,): packed cell and local index of the apex. positive (R,): sign of the entry face.
    face: three vertices (5, R) of the entry face. weights (3, R): their barycentric weights.
    apex (5, R): the fourth vertex. drop (R,): which vertex (0, 1, 2) of the entry face the exit
    face does not have. exit_weights (3, R): of the two others, in order, and of the apex.
    """

    word: Array
    positive: Array
    face: Face
    weights: Array
    apex: Array
    drop: Array
    exit_weights: Array


class CastState(NamedTuple):
    """One state of R rays; `depth` (2, R), a pair, is where the current segment ends."""

    cell: Cell
    depth: Array
    segment: Segment
    active: Array
    waiting: Array
    fresh: Array
    status: Array
    entries: Entries
    last: tuple[Array, Array]


class _Arrival(NamedTuple):
    """A cell about to be entered: through which face, with which sign, at which depth."""

    word: Array
    positive: Array
    face: Face
    weights: Array
    depth: Array
    value: Array


@dataclasses.dataclass(frozen=True)
class RayCast(AbstractTracer):
    """Cell to cell by adjacency, in lock step. Exact order; no ray is lost (see the module).

    Gradients: with respect to point positions, values, ray origins and directions. They are those
    of the image with the order of cells held fixed, which is the gradient wherever it exists: not
    on rays that only touch an edge or a vertex of the boundary. Zero by convention where a ray lies
    in a face's plane, and through segments of no length.
    """

    def prepare(self, volume: TetMesh) -> CastScene:
        scene = make_scene(volume)
        return CastScene(scene, build_boxes(scene))

    def longest(self, scene: CastScene) -> Array:
        return longest_edge(scene.mesh)

    def prepare_rays(self, scene: CastScene, origins: Array, directions: Array) -> ShearedRays:
        return shear_rays(origins, directions, scene.mesh.scale)

    def start(self, scene: CastScene, rays: ShearedRays) -> CastState:
        dtype = rays.origin_x.dtype
        count = rays.origin_x.shape[0]
        zero, no = jnp.zeros(count, dtype), jnp.zeros(count, bool)
        integer = jnp.zeros(count, jnp.int32)
        vertex = jnp.zeros((5, count), dtype)
        ones = jnp.ones((3, count), dtype)
        cell = Cell(integer, no, (vertex, vertex, vertex), ones, vertex, integer, ones)
        return CastState(
            cell=cell,
            depth=jnp.zeros((2, count), dtype),
            segment=Segment(zero, zero, zero),
            active=no,
            waiting=~no,
            fresh=no,
            status=integer,
            entries=no_entries(count, dtype, more=True),
            last=(zero - jnp.inf, integer - 1),
        )

    def step(self, scene: CastScene, rays: ShearedRays, state: CastState, move: Array) -> CastState:
        with jax.named_scope("raycast_step"):
            move = move & state.active
            arrival = _leave(scene.mesh, state)
            inside = move & (arrival.word >= 0)
            gone = move & ~inside
            # A ray that waits for nothing is done.
            left = (state.entries.face[0] >= 0) | state.entries.more
            state = state._replace(
                active=state.active & ~gone, waiting=state.waiting | (gone & left)
            )
            # Entering is rare and costly, so it waits until no ray of the batch is inside.
            arrival, state, entering = lax.cond(
                jnp.any(state.active),
                lambda s, a: (a, s, jnp.zeros_like(move)),
                lambda s, a: _enter(scene, rays, s, a),
                state,
                arrival,
            )
            return _arrive(scene.mesh, rays, state, arrival, inside | entering, entering)

    def gradient_start(self, scene, rays, perturbed):
        mesh, by_rays = perturbed[0].mesh, any(jax.tree.leaves(perturbed[1]))
        for_scene = (
            jnp.zeros_like(scene.mesh.values) if mesh.values else None,
            jnp.zeros_like(scene.mesh.coordinates) if mesh.coordinates else None,
        )
        return for_scene, (jnp.zeros_like(rays.origin_x),) * 6 if by_rays else None

    def pull_back(self, scene, rays, state, cotangent, gradient):
        return pull_back_cell(scene.mesh, rays, state, cotangent, gradient)

    def scene_cotangent(self, scene, gradient):
        values, coordinates = gradient
        zero = jax.tree.map(jnp.zeros_like, scene)
        mesh = zero.mesh
        if values is not None:
            mesh = dataclasses.replace(mesh, values=values)
        if coordinates is not None:
            mesh = dataclasses.replace(mesh, coordinates=coordinates)
        return dataclasses.replace(zero, mesh=mesh)

    def rays_cotangent(self, rays, gradient):
        zero = jax.tree.map(jnp.zeros_like, rays)
        if gradient is None:
            return zero
        o_x, o_y, o_z, s_x, s_y, stretch = gradient
        return dataclasses.replace(
            zero,
            origin_x=o_x,
            origin_y=o_y,
            origin_z=o_z,
            shear_x=s_x,
            shear_y=s_y,
            stretch=stretch,
        )


def _leave(scene: Scene, state: CastState) -> _Arrival:
    """Through the exit face into the neighbour: only names and selections, one gather."""
    cell = state.cell
    a, b, c = cell.face
    corner, drop = packing.corner_of(cell.word), cell.drop
    exit_corner = drop + (corner <= drop).astype(jnp.int32)
    word = scene.neighbors[4 * packing.cell_of(cell.word) + exit_corner]
    # The boundary of a tetrahedron has degree zero: omitting the k-th of its sorted vertices
    # gives a face of sign (-1)^k, and what comes in must go out.
    positive = cell.positive ^ (((corner + exit_corner) & 1) == 0)
    # How many of the two vertices that stay come before the apex in the mesh's order.
    place = corner - (corner > drop).astype(jnp.int32)
    front, back = place == 0, place == 2

    def insert(p, q, d):
        return (
            choose(front, d, p),
            choose(front, p, choose(back, q, d)),
            choose(back, d, q),
        )

    face = insert(choose(drop == 0, b, a), choose(drop == 2, b, c), cell.apex)
    weights = jnp.stack(insert(*cell.exit_weights))
    return _Arrival(word, positive, face, weights, state.depth, state.segment.back)


def _enter(scene: CastScene, rays: ShearedRays, state: CastState, arrival: _Arrival):
    """Waiting rays go to their next entry, if there is one."""
    mesh = scene.mesh
    exhausted = state.waiting & (state.entries.face[0] < 0) & state.entries.more

    def again(entries):
        return choose(exhausted, search(mesh, rays, scene.boxes, exhausted, state.last), entries)

    entries = lax.cond(jnp.any(exhausted), again, lambda e: e, state.entries)
    word = entries.face[0]
    entering = state.waiting & (word >= 0)
    last = (
        jnp.where(entering, entries.depth[0], state.last[0]),
        jnp.where(entering, word, state.last[1]),
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
    at = stage(wanted, crossing, face, sizes)
    word = packing.pack(cell, corner, packing.turned_of(word))
    new = _Arrival(word, is_positive(edges[2]), face, sizes, jnp.stack(at[:2]), at.value)
    state = state._replace(
        waiting=entering,
        entries=entries,
        last=last,
    )
    return choose(entering, new, arrival), state, entering


def _arrive(
    scene: Scene,
    rays: ShearedRays,
    state: CastState,
    arrival: _Arrival,
    moved: Array,
    entering: Array,
) -> CastState:
    """Fetches the fourth vertex of the new cell, finds the exit, and makes the segment."""
    wanted = jnp.any(moved)
    word = jnp.maximum(arrival.word, 0)
    number, corner = packing.cell_of(word), packing.corner_of(word)
    (apex,) = fetch(scene, rays, number, corner[None], wanted)
    face, front, fresh = _values_here(scene, arrival, number, corner, word, moved)
    to_apex = stage(wanted, edges_to_apex, face, apex, corner)
    leave = stage(wanted, leave_by, arrival.positive, arrival.weights, to_apex)

    def cross(face, apex, leave):
        return crossing(exit_face(face, apex, leave.drop), leave.weights)

    out = stage(wanted, cross, face, apex, leave)
    turned = packing.turned_of(word) == 1
    segment, depth = stage(wanted, make_segment, arrival.depth, front, out, turned, rays.stretch)
    lost = moved & leave.lost
    cell = Cell(word, arrival.positive, face, arrival.weights, apex, leave.drop, leave.weights)
    active = jnp.where(moved, ~lost, state.active)
    segment = choose(moved, segment, state.segment)
    return CastState(
        cell=choose(moved, cell, state.cell),
        depth=choose(moved, depth, state.depth),
        segment=segment._replace(length=jnp.where(active, segment.length, 0)),
        active=active,
        waiting=state.waiting & ~entering,
        fresh=moved & (fresh | entering | (segment.front != front)),
        status=state.status | jnp.where(lost, bits.LOST, 0).astype(jnp.int32),
        entries=state.entries,
        last=state.last,
    )


def _values_here(scene: Scene, arrival: _Arrival, number, corner, word, moved):
    """The entry face with this cell's own scalars, the scalar at the entry, and whether it may
    differ from the one behind the face."""

    def own(face, weights):
        out = []
        for vertex, k in zip(face, entry_corners(corner), strict=True):
            slot = value_slots(scene, number, k, local_ids(scene, number, k))
            out.append(vertex.at[VALUE].set(scene.values[slot]))
        return tuple(out), crossing(tuple(out), weights).value

    if not scene.continuous:
        face, front = stage(jnp.any(moved), own, arrival.face, arrival.weights)
        return face, front, jnp.ones_like(moved)
    if not scene.seams:
        return arrival.face, arrival.value, jnp.zeros_like(moved)
    seam = moved & (packing.flag_of(word) == 1)

    def reload(face, value):
        new, front = own(face, arrival.weights)
        return choose(seam, new, face), jnp.where(seam, front, value)

    face, front = lax.cond(jnp.any(seam), reload, lambda *same: same, arrival.face, arrival.value)
    return face, front, seam
