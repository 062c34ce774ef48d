"""Layouts of a mesh for ray casting, raced: planes and gradients, or vertices projected on the way.

    python -m experiments.layouts bluntfin.vtu oxygen_post.vtu [--size 512] [--repeat 5] [--json F]

planes: Espinha and Celes 2005, Table 1 and Figure 6. A record for each cell of its four planes, the
gradient and offset of its scalar, and its neighbours: 96 bytes. The exit is the nearest plane that
faces away. The record follows from points and scalars, and is built again when they change.

plain: the one new vertex of a cell is brought into the ray's frame, where its three edges to the
entry face tell the exit, its depth and its scalar (Platis and Theoharis 2003; Aman et al. 2022). 32
bytes a cell, 16 a vertex, and nothing to build but their interleaving. In plain float32.

exact: the same with the projection and the signs of `jaxvr.trace`, so that no ray is lost; the
difference from plain is the price of exactness.

RayCast: the tracer itself. It takes the same paths as exact, and also keeps depths as pairs, cuts
at the eye, goes on to the next entry, and holds back rays that are not to move.

All walk the same rays of `experiments.speed`'s view in one loop, from the same entry faces, found
beforehand, to where they first leave the mesh. Shading is a sum of chords and one of mean scalar
times chord, so the layout is what differs. Coincident points are welded before. What is kind to
planes in float32: the origin of each ray is moved next to the mesh (as for plain), both sides of a
face compute its plane from one order of vertices, and orientations come from float64. A walk that
takes more than `BOUND` times the steps of the longest of RayCast is stopped.

Printed for each layout: medians, in turns, of seconds for a picture and of nanoseconds for a ray
and step; both beside planes and RayCast; milliseconds to build (RayCast's has the hierarchy over
the boundary in it); bytes kept and gathered. Then, for the picture's rays and for as many as
`--aimed` that go to random vertices, midpoints of edges and centres of faces: rays that got lost
(no exit, or stopped), that crossed another number of cells than with RayCast, whose chord differs
from RayCast's by more than 1e-4 of the mesh's diagonal, or whose sum differs by more than 1e-3 of
the largest; the worst of both.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

import jaxvr
from experiments.common import camera_of, diagonal, median_of, read_volume, table, write_json
from jaxvr._core import status as bits
from jaxvr._core.stage import stage
from jaxvr.optics.partition import Segment
from jaxvr.trace.entry import build_boxes, no_entries, search
from jaxvr.trace.face import Face, choose, opposite_edges, sizes_of
from jaxvr.trace.local import edges_to_apex, exit_face, leave_by
from jaxvr.trace.scene import entry_corners, make_scene, merged_points
from jaxvr.trace.shear import ShearedRays, shear_points, shear_rays
from jaxvr.view import tiles
from jaxvr.view.rays import Rays
from jaxvr.volume import packing

BATCH = tiles.batch_size("float32")

Array = jax.Array

BOUND = 4
CHORD, SUM = 1e-4, 1e-3  # tolerances


class Start(NamedTuple):
    """Rays (R, 3), and for each the boundary face (R,) that it enters by, a packed word or -1, and
    at which distance (R,)."""

    origins: Array
    directions: Array
    face: Array
    distance: Array


class Walk(NamedTuple):
    """What rays (R,) crossed: sum of chords, sum of mean scalar times chord, cells; whether they
    found no exit or were stopped."""

    chord: Array
    total: Array
    steps: Array
    lost: Array


class Layout(NamedTuple):
    """builder(mesh) -> (mesh with the same integers -> scene). start(scene, Start) -> rays, state.
    step(scene, rays, state) -> state, with what loops read of a tracer's state.

    kept: bytes a cell and a vertex. gathered: bytes a ray and step.
    """

    builder: Callable[[jaxvr.TetMesh], Callable[[jaxvr.TetMesh], Any]]
    start: Callable[[Any, Start], tuple[Any, Any]]
    step: Callable[[Any, Any, Any], Any]
    kept: tuple[int, int]
    gathered: int


def take(array: Array, index: Array) -> Array:
    return array.at[index].get(mode="promise_in_bounds")


def centred(origins: Array, directions: Array, centre: Array) -> tuple[Array, Array]:
    """Origins (R, 3) moved along their rays to the points nearest to `centre`, and how far (R,)."""
    shift = jnp.sum((centre[None] - origins) * directions, -1)
    return origins + shift[:, None] * directions, shift


def middle(points: Array) -> Array:
    return 0.5 * (points.min(0) + points.max(0))


# -- planes ----------------------------------------------------------------------------------------


class PlaneScene(NamedTuple):
    """record (20 T,): four planes that face outwards, and gradient and offset of the scalar, as
    (a, b, c, d) of a x + b y + c z + d each. neighbors (4 T,): packed words. centre (3,)."""

    record: Array
    neighbors: Array
    centre: Array


class PlaneRays(NamedTuple):
    """(3, R) each."""

    origin: Array
    direction: Array


class PlaneState(NamedTuple):
    """word (R,): the next cell. depth, value (R,): where the ray enters it."""

    word: Array
    depth: Array
    value: Array
    segment: Segment
    active: Array
    waiting: Array
    status: Array


def orientations(mesh: jaxvr.TetMesh) -> np.ndarray:
    """+1 or -1 (T,), of each cell's row of vertices. Integers: they stay when points move."""
    q = np.asarray(mesh.points, np.float64)[np.asarray(mesh.cells)]
    a, b, c = (q[:, k] - q[:, 0] for k in (1, 2, 3))
    return np.where(np.einsum("ti,ti->t", np.cross(a, b), c) > 0, 1, -1).astype(np.float32)


@jax.jit
def plane_scene(mesh: jaxvr.TetMesh, orientation: Array) -> PlaneScene:
    centre = middle(mesh.points)
    corners = [take(mesh.points - centre[None], mesh.cells[:, k]) for k in range(4)]
    values = [take(mesh.values, mesh.cells[:, k]) for k in range(4)]
    planes, heights = [], []
    for k in range(4):
        p, q, r = (corners[i] for i in range(4) if i != k)
        # Both cells of a face list its vertices alike, so their planes differ by the sign at most.
        normal = jnp.cross(q - p, r - p) * (-orientation if k % 2 else orientation)[:, None]
        planes.append(jnp.concatenate([normal, -jnp.sum(normal * p, -1, keepdims=True)], 1))
        heights.append(jnp.sum(normal * (corners[k] - p), -1))
    # A plane over its value at the vertex across from it is that vertex's barycentric coordinate.
    scalar = jnp.zeros_like(planes[0])
    for plane, height, value in zip(planes, heights, values, strict=True):
        slope = jnp.where(height == 0, 0, (value - values[0]) / jnp.where(height == 0, 1, height))
        scalar = scalar + slope[:, None] * plane
    scalar = scalar.at[:, 3].add(values[0])
    record = jnp.stack([*planes, scalar], 1)
    return PlaneScene(record.reshape(-1), mesh.neighbors.reshape(-1), centre)


def plane_builder(mesh: jaxvr.TetMesh) -> Callable[[jaxvr.TetMesh], PlaneScene]:
    return partial(plane_scene, orientation=jnp.asarray(orientations(mesh)))


def plane_start(scene: PlaneScene, start: Start) -> tuple[PlaneRays, PlaneState]:
    origins, shift = centred(start.origins, start.directions, scene.centre)
    rays = PlaneRays((origins - scene.centre[None]).T, start.directions.T)
    word, depth = start.face, start.distance - shift
    along, at = plane_fetch(scene, rays, packing.cell_of(jnp.maximum(word, 0)), jnp.any(word >= 0))
    zero, no = jnp.zeros_like(depth), jnp.zeros_like(word, bool)
    state = PlaneState(
        *(word, depth, at[4] + depth * along[4], Segment(zero, zero, zero)),
        *(no, word >= 0, jnp.zeros_like(word)),
    )
    return rays, state


def plane_fetch(scene: PlaneScene, rays: PlaneRays, cell: Array, wanted: Array):
    """The five functions of a cell along a ray, (5, R): their slopes, and what they are at 0."""

    def load(record, cell):
        return take(record, 20 * cell[None] + jnp.arange(20, dtype=jnp.int32)[:, None])

    def dot(record, rays):
        a, b, c, d = record[0::4], record[1::4], record[2::4], record[3::4]
        (x, y, z), (u, v, w) = rays.origin[:, None], rays.direction[:, None]
        return a * u + b * v + c * w, a * x + b * y + c * z + d

    return stage(wanted, dot, stage(wanted, load, scene.record, cell), rays)


def plane_step(scene: PlaneScene, rays: PlaneRays, state: PlaneState) -> PlaneState:
    active = state.waiting
    wanted = jnp.any(active)
    cell = packing.cell_of(jnp.maximum(state.word, 0))
    along, at = plane_fetch(scene, rays, cell, wanted)

    def nearest(along, at):
        away = along[:4] > 0
        t = jnp.where(away, -at[:4] / jnp.where(away, along[:4], 1), jnp.inf)
        second, fourth = t[1] < t[0], t[3] < t[2]
        low, high = jnp.minimum(t[0], t[1]), jnp.minimum(t[2], t[3])
        k = jnp.where(high < low, 2 + fourth.astype(jnp.int32), second.astype(jnp.int32))
        return jnp.minimum(low, high), k

    depth, k = stage(wanted, nearest, along, at)
    lost = active & ~jnp.isfinite(depth)
    word = jnp.where(active & ~lost, take(scene.neighbors, 4 * cell + k), -1)
    value = at[4] + depth * along[4]
    segment = Segment(state.value, value, jnp.where(lost, 0, depth - state.depth))
    status = jnp.where(lost, bits.LOST, state.status).astype(jnp.int32)
    return PlaneState(word, depth, value, segment, active & ~lost, word >= 0, status)


# -- projected vertices ----------------------------------------------------------------------------


class VertexScene(NamedTuple):
    """vertices (4 P,): x, y, z and scalar of each. cells, neighbors (4 T,). centre (3,)."""

    vertices: Array
    cells: Array
    neighbors: Array
    centre: Array


class VertexRays(NamedTuple):
    """sheared: the rays' frames. rows (4, R): their axes and 3, the order of a vertex's rows."""

    sheared: ShearedRays
    rows: Array


class VertexState(NamedTuple):
    """word (R,): the next cell. face: three vertices (x, y, z, scalar) (4, R) by which the ray
    enters it, with sign `positive` (R,) and weights (3, R); there depth and value (R,)."""

    word: Array
    face: Face
    positive: Array
    weights: Array
    depth: Array
    value: Array
    segment: Segment
    active: Array
    waiting: Array
    status: Array


@jax.jit
def vertex_scene(mesh: jaxvr.TetMesh) -> VertexScene:
    vertices = jnp.concatenate([mesh.points, mesh.values[:, None]], 1).reshape(-1)
    cells, neighbors = mesh.cells.reshape(-1), mesh.neighbors.reshape(-1)
    return VertexScene(vertices, cells, neighbors, middle(mesh.points))


def vertex_fetch(
    exact: bool, scene: VertexScene, rays: VertexRays, slot: Array, wanted: Array
) -> Array:
    """The vertices (4, R) at entries of `cells`, as rays see them."""

    def load(vertices, cells, rows, slot):
        return take(vertices, rows + 4 * take(cells, slot)[None])

    def project(at, r):
        if exact:
            return shear_points(r, *at[:3])[:3]
        x, y, z = at[0] - r.origin_x, at[1] - r.origin_y, at[2] - r.origin_z
        return x - r.shear_x * z, y - r.shear_y * z, r.sign * z

    at = stage(wanted, load, scene.vertices, scene.cells, rays.rows, slot)
    return jnp.stack([*stage(wanted, project, at, rays.sheared), at[3]])


def area(i: Array, j: Array) -> Array:
    return i[0] * j[1] - j[0] * i[1]


def face_edges(a: Array, b: Array, c: Array) -> Array:
    """As `opposite_edges`, rounded."""
    return jnp.stack([area(b, c), area(c, a), area(a, b)])


def apex_edges(face: Face, apex: Array, _corner: Array) -> Array:
    """As `edges_to_apex`, rounded."""
    return jnp.stack([area(v, apex) for v in face])


def cross_at(face: Face, weights: Array) -> tuple[Array, Array]:
    """Depth and scalar of the ray in a face."""
    whole = jnp.sum(weights, 0)
    share = weights / jnp.where(whole == 0, 1, whole)[None]
    a, b, c = (v[2:] for v in face)
    z, s = a + (share[1][None] * (b - a) + share[2][None] * (c - a))
    return z, s


def vertex_start(exact: bool, scene: VertexScene, start: Start) -> tuple[VertexRays, VertexState]:
    origins, shift = start.origins, jnp.zeros_like(start.distance)
    if not exact:  # exact paths are those of the very rays whose entries were found
        origins, shift = centred(origins, start.directions, scene.centre)
    r = shear_rays(Rays(origins, start.directions), jnp.ones((), origins.dtype))
    rows = jnp.stack([r.axis_x, r.axis_y, r.axis_z, jnp.full_like(r.axis_x, 3)])
    rays = VertexRays(r, rows)
    word = jnp.maximum(start.face, 0)
    slots = 4 * packing.cell_of(word)[None] + entry_corners(packing.corner_of(word))
    wanted = jnp.any(start.face >= 0)
    a, b, c = (vertex_fetch(exact, scene, rays, slot, wanted) for slot in slots)
    weights = sizes_of((opposite_edges if exact else face_edges)(a, b, c))
    value = cross_at((a, b, c), weights)[1]
    depth = (start.distance - shift) / r.stretch
    zero, no = jnp.zeros_like(depth), jnp.zeros_like(word, bool)
    state = VertexState(
        *(start.face, (a, b, c), packing.flag_of(word) == 1, weights, depth, value),
        *(Segment(zero, zero, zero), no, start.face >= 0, jnp.zeros_like(word)),
    )
    return rays, state


def vertex_step(
    exact: bool, scene: VertexScene, rays: VertexRays, state: VertexState
) -> VertexState:
    active, face = state.waiting, state.face
    wanted = jnp.any(active)
    word = jnp.maximum(state.word, 0)
    cell, corner = packing.cell_of(word), packing.corner_of(word)
    apex = vertex_fetch(exact, scene, rays, 4 * cell + corner, wanted)
    edges = stage(wanted, edges_to_apex if exact else apex_edges, face, apex, corner)
    leave = stage(wanted, leave_by, state.positive, state.weights, edges)

    def cross(face, apex, leave):
        return cross_at(exit_face(face, apex, leave.drop), leave.weights)

    depth, value = stage(wanted, cross, face, apex, leave)
    # The next face, as in `jaxvr.trace.raycast`: its vertices in the order of the mesh.
    drop = leave.drop
    exit_corner = drop + (corner <= drop).astype(jnp.int32)
    place = corner - (corner > drop).astype(jnp.int32)

    def insert(p, q, d):
        front, back = place == 0, place == 2
        return choose(front, d, p), choose(front, p, choose(back, q, d)), choose(back, d, q)

    lost = active & leave.lost
    word = jnp.where(active & ~lost, take(scene.neighbors, 4 * cell + exit_corner), -1)
    return VertexState(
        word=word,
        face=insert(*exit_face(face, apex, drop)),
        positive=state.positive ^ (((corner + exit_corner) & 1) == 0),
        weights=jnp.stack(insert(*leave.weights)),
        depth=depth,
        value=value,
        segment=Segment(state.value, value, (depth - state.depth) * rays.sheared.stretch),
        active=active & ~lost,
        waiting=word >= 0,
        status=jnp.where(lost, bits.LOST, state.status).astype(jnp.int32),
    )


# -- RayCast ---------------------------------------------------------------------------------------

CAST = jaxvr.RayCast()


def cast_start(scene: Any, start: Start) -> tuple[Any, Any]:
    rays = CAST.prepare_rays(scene, Rays(start.origins, start.directions))
    entries = no_entries(start.face.shape[0], start.origins.dtype)
    depth = start.distance / rays.stretch
    entries = entries._replace(
        depth=(depth, *entries.depth[1:]), face=(start.face, *entries.face[1:])
    )
    return rays, CAST.start(scene, rays)._replace(entries=entries)


def cast_step(scene: Any, rays: Any, state: Any) -> Any:
    return CAST.step(scene, rays, state, jnp.ones_like(state.active))


# -- the race --------------------------------------------------------------------------------------

LAYOUTS = {
    "planes": Layout(plane_builder, plane_start, plane_step, (96, 0), 84),
    **{
        name: Layout(
            lambda _: vertex_scene,
            partial(vertex_start, exact),
            partial(vertex_step, exact),
            *((32, 16), 24),
        )
        for name, exact in (("plain", False), ("exact", True))
    },
    "RayCast": Layout(lambda _: jax.jit(CAST.prepare), cast_start, cast_step, (32, 16), 24),
}


def welded(mesh: jaxvr.TetMesh) -> jaxvr.TetMesh:
    """The mesh with one point in place of those that coincide."""
    to = np.arange(mesh.n_points, dtype=np.int32)
    copies = np.asarray(mesh.duplicates)
    to[copies[:, 0]] = copies[:, 1]
    return dataclasses.replace(
        mesh,
        points=merged_points(mesh),
        cells=jnp.asarray(to[np.asarray(mesh.cells)]),
        duplicates=mesh.duplicates[:0],
    )


def rays_of(camera: jaxvr.Camera) -> tuple[Array, Array]:
    """Origins and directions (R, 3), tile after tile as in `jaxvr.render`."""
    order = tiles.tile_order(camera.height, camera.width)
    origins, directions = (x.reshape(-1, 3)[order] for x in camera.rays())
    return origins, directions


def batches(array: Array) -> Array:
    """(R, ...) as (n, BATCH, ...), filled up with copies of the last."""
    fill = jnp.broadcast_to(array[-1:], (-array.shape[0] % BATCH, *array.shape[1:]))
    return jnp.concatenate([array, fill]).reshape(-1, BATCH, *array.shape[1:])


@jax.jit
def first_entries(mesh: jaxvr.TetMesh, origins: Array, directions: Array) -> Start:
    """Batches of rays with the first boundary face that each enters by."""
    scene = make_scene(mesh)
    boxes = build_boxes(scene)

    def one(rays: tuple[Array, Array]) -> Start:
        sheared = shear_rays(Rays(*rays), scene.scale)
        none = jnp.full(BATCH, -jnp.inf, mesh.dtype), jnp.full(BATCH, -1, jnp.int32)
        entries = search(scene, sheared, boxes, jnp.ones(BATCH, bool), none)
        return Start(*rays, entries.face[0], entries.depth[0] * sheared.stretch)

    return lax.map(one, (batches(origins), batches(directions)))


@partial(jax.jit, static_argnums=0)
def walk(layout: Layout, scene: Any, start: Start, bound: Array) -> Walk:
    """Batch after batch, each until its last ray is out or has taken `bound` steps."""

    def one(start: Start) -> Walk:
        rays, state = layout.start(scene, start)
        zero = jnp.zeros_like(start.distance)
        sums = Walk(zero, zero, jnp.zeros_like(start.face), jnp.zeros_like(start.face, bool))

        def busy(carry):
            n, state, _ = carry
            return (n < bound) & jnp.any(state.active | state.waiting)

        def body(carry):
            n, state, sums = carry
            state = layout.step(scene, rays, state)
            front, back, length = state.segment
            active = state.active
            sums = Walk(
                sums.chord + jnp.where(active, length, 0),
                sums.total + jnp.where(active, 0.5 * (front + back) * length, 0),
                sums.steps + active.astype(jnp.int32),
                sums.lost,
            )
            return n + 1, state, sums

        _, state, sums = lax.while_loop(busy, body, (jnp.zeros((), jnp.int32), state, sums))
        return sums._replace(lost=(state.status != 0) | state.active & state.waiting)

    return lax.map(one, start)


def differences(walk: Walk, reference: Walk, size: float) -> dict[str, Any]:
    """How many rays were lost or differ from those of `reference`; size: the mesh's diagonal."""
    chord = np.abs(walk.chord - reference.chord) / size
    total = np.abs(walk.total - reference.total) / max(np.abs(reference.total).max(), 1e-30)
    return {
        "lost": int(walk.lost.sum()),
        "other cells": int((walk.steps != reference.steps).sum()),
        "chord off": int((chord > CHORD).sum()),
        "sum off": int((total > SUM).sum()),
        "worst chord": float(chord.max()),
        "worst sum": float(total.max()),
    }


def aimed_rays(mesh: jaxvr.TetMesh, count: int) -> tuple[Array, Array]:
    """Rays (count, 3) from a sphere of 1.5 diagonals to vertices, midpoints of edges and centres of
    faces of random cells, as close as the dtype lets them."""
    rng = np.random.default_rng(0)
    corners = np.asarray(mesh.points, np.float64)[np.asarray(mesh.cells)]
    corners = corners[rng.integers(mesh.n_tets, size=count)]
    used = rng.integers(1, 4, count)[:, None]
    target = np.sum(corners * ((np.arange(4)[None] < used) / used)[..., None], 1)
    away = rng.normal(size=(count, 3))
    away *= 1.5 * diagonal(mesh) / np.linalg.norm(away, axis=1, keepdims=True)
    origin = (np.asarray(middle(mesh.points), np.float64)[None] + away).astype(mesh.dtype)
    direction = target - origin
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return jnp.asarray(origin), jnp.asarray(direction, mesh.dtype)


def race(mesh: jaxvr.TetMesh, size: int, repeat: int, aimed: int) -> dict[str, Any]:
    """Numbers by layout, and what the picture takes."""
    mesh = welded(mesh)
    builders = {name: layout.builder(mesh) for name, layout in LAYOUTS.items()}
    builds = {name: partial(build, mesh) for name, build in builders.items()}
    scenes = {name: build() for name, build in builds.items()}

    def walks_of(rays: tuple[Array, Array]) -> tuple[Start, Walk, dict[str, Callable[[], Walk]]]:
        start = first_entries(mesh, *rays)
        most = np.int32(np.iinfo(np.int32).max)  # RayCast needs no bound
        reference = jax.device_get(walk(LAYOUTS["RayCast"], scenes["RayCast"], start, most))
        bound = np.int32(BOUND * reference.steps.max())
        walks = {name: partial(walk, x, scenes[name], start, bound) for name, x in LAYOUTS.items()}
        return start, reference, walks

    def against(reference: Walk, walks: dict[str, Callable[[], Walk]]) -> dict[str, Any]:
        size = diagonal(mesh)
        results = {name: jax.device_get(run()) for name, run in walks.items()}
        return {name: differences(one, reference, size) for name, one in results.items()}

    start, reference, walks = walks_of(rays_of(camera_of(mesh, size)))
    to_build = median_of(builds, repeat, quiet=True)
    seconds = median_of(walks, repeat, quiet=True)
    steps = max(int(reference.steps.sum()), 1)
    speed = {
        name: {
            "s": seconds[name],
            "ns a step": 1e9 * seconds[name] / steps,
            "of planes": seconds[name] / seconds["planes"],
            "of RayCast": seconds[name] / seconds["RayCast"],
            "build ms": 1e3 * to_build[name],
            "bytes a cell": layout.kept[0] + layout.kept[1] * mesh.n_points / mesh.n_tets,
            "gathered": layout.gathered,
        }
        for name, layout in LAYOUTS.items()
    }
    return {
        "cells": mesh.n_tets,
        "rays": int((start.face >= 0).sum()),
        "steps": steps,
        # Part of the lanes of a batch that walk, on average.
        "lanes": float(steps / max(reference.steps.max(1).sum() * BATCH, 1)),
        "speed": speed,
        "picture": against(reference, walks),
        "aimed": against(*walks_of(aimed_rays(mesh, aimed))[1:]),
    }


def run(meshes: dict[str, jaxvr.TetMesh], size: int, repeat: int, aimed: int) -> dict[str, Any]:
    """{mesh: numbers}; prints tables for each."""
    result: dict[str, Any] = {}
    for title, mesh in meshes.items():
        result[title] = one = race(mesh, size, repeat, aimed)
        print(
            f"\n{title}, {one['cells']:,} tets, {size} x {size}: {one['rays']:,} rays enter and "
            f"take {one['steps']:,} steps, {100 * one['lanes']:.0f} % of lanes at work"
        )
        for part, what in (
            ("speed", "layout"),
            ("picture", "the picture's rays"),
            ("aimed", f"{aimed:,} aimed rays"),
        ):
            rows = [{what: name, **row} for name, row in one[part].items()]
            print(f"\n{table(rows)}", flush=True)
    return result


def main(arguments: Sequence[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description="layouts of a mesh for ray casting, raced")
    parser.add_argument("meshes", nargs="*", type=Path, help="none: a small box")
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--aimed", type=int, default=200_000, help="rays")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--tiny", action="store_true", help="a few rays, once")
    options = parser.parse_args(arguments)
    meshes = {p.stem: read_volume(p) for p in options.meshes} or {"box": read_volume()}
    if options.tiny:
        options.size, options.repeat, options.aimed = 16, 1, 512
    result = run(meshes, options.size, options.repeat, options.aimed)
    if options.json:
        write_json(options.json, result)
    return result


if __name__ == "__main__":
    main()
