"""Where rays enter a mesh: all boundary faces that the line of a ray crosses inwards, by depth.

A bounding volume hierarchy over the boundary faces, in Morton order, as a perfect binary tree in
heap order: node i has the children 2 i and 2 i + 1. A visit looks at both of a node's children; of
two that a ray meets, it goes to the first and sets a bit for the other, one for each level of the
tree, so that a ray's stack is one number. Boxes are computed from the points at every call, since
points may have moved.

The search is in two phases, so that the costly exact test is not run in lock step with the cheap
one: first boxes, until a ray has collected a few candidates, then the candidates. It keeps the
`PEEL` nearest entries behind a given one; a ray that leaves the mesh and has more searches again.
This is depth peeling (Bernardon et al. 2004; Weiler et al. 2004), several layers at a time.

The inclusion test is the walk's own exact one. With it, the faces that contain a ray are paired by
the walk: each inward one starts a path of cells that ends at one outward one, whatever the
boundary's shape. Holes, several components and cracks need no care.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxvr._core.gather import load, take
from jaxvr._core.stage import stage
from jaxvr.trace.face import crossing, face_edges, is_positive, sizes_of
from jaxvr.trace.scene import Scene, entry_corners, local_ids, project
from jaxvr.trace.shear import ShearedRays
from jaxvr.volume import packing

Array = jax.Array

PEEL = 4  # entries kept by one search
BATCH = 16  # candidates collected before they are tested


class Entries(NamedTuple):
    """The next entries of each ray: PEEL depths (R,), inf where there is none, and PEEL faces
    (R,), packed words or -1; more (R,): whether there are others behind them."""

    depth: tuple[Array, ...]
    face: tuple[Array, ...]
    more: Array


def no_entries(count: int, dtype: Any, more: bool = False) -> Entries:
    """Of `count` rays, with more to come or not."""
    depth, face = jnp.full(count, jnp.inf, dtype), jnp.full(count, -1, jnp.int32)
    return Entries((depth,) * PEEL, (face,) * PEEL, jnp.full(count, more))


class Boxes(NamedTuple):
    """Bounds of heap nodes: low and high corners (3 * 2 L,), axis by axis.

    corners (3 * 3 L,): of the vertices of each leaf's face, axis by axis, then vertex by vertex.
    Coordinates lie apart, not in records: rays of a batch are in few nodes at a time, and those
    share cache lines.
    """

    low: Array
    high: Array
    corners: Array


def build_boxes(scene: Scene) -> Boxes:
    """Boxes of all nodes, leaves first and then each level from the one below."""
    count = scene.coordinates.shape[0] // 3
    used = scene.faces >= 0
    faces = jnp.maximum(scene.faces, 0)
    cell, corner = packing.cell_of(faces), packing.corner_of(faces)
    ids = local_ids(scene, cell[None], entry_corners(corner))
    points = lax.stop_gradient(scene.coordinates).reshape(3, count)[:, ids]
    low = jnp.where(used[None], points.min(1), jnp.inf)
    high = jnp.where(used[None], points.max(1), -jnp.inf)
    lows, highs = [low], [high]
    while low.shape[1] > 1:
        low = low.reshape(3, -1, 2).min(-1)
        high = high.reshape(3, -1, 2).max(-1)
        lows.append(low)
        highs.append(high)
    pad = jnp.zeros((3, 1), low.dtype)  # heap nodes are counted from 1
    return Boxes(
        jnp.concatenate([pad, *reversed(lows)], 1).reshape(-1),
        jnp.concatenate([pad, *reversed(highs)], 1).reshape(-1),
        points.reshape(-1),
    )


def _meet(boxes: Boxes, rays: ShearedRays, node: Array, slack: Array, wanted: Array) -> Array:
    """Whether the line of a ray may pass the boxes of its node's children (2, R): never a wrong
    no. wanted (): whether any ray asks."""
    count = boxes.low.shape[0] // 3

    def find(low, high, node, *axes):
        child = 2 * node[None] + jnp.arange(2, dtype=jnp.int32)[:, None]
        return [[take(x, count * axis[None] + child) for x in (low, high)] for axis in axes]

    axes = (rays.axis_x, rays.axis_y, rays.axis_z)
    found = load(wanted, find, boxes.low, boxes.high, node, *axes)

    def meet(found, rays, slack):
        origins = (rays.origin_x, rays.origin_y, rays.origin_z)
        (x_low, x_high), (y_low, y_high), (z_low, z_high) = (
            [bound - origin[None] for bound in pair]
            for pair, origin in zip(found, origins, strict=True)
        )

        def passes(low: Array, high: Array, shear: Array) -> Array:
            a, b = shear[None] * z_low, shear[None] * z_high
            nearer, farther = low - jnp.maximum(a, b), high - jnp.minimum(a, b)
            return (nearer <= slack[None]) & (farther >= -slack[None])

        return passes(x_low, x_high, rays.shear_x) & passes(y_low, y_high, rays.shear_y)

    return stage(wanted, meet, found, rays, slack)


class _Visit(NamedTuple):
    """node (R,): an inner node whose children are next, 0 for none. pending (R,): bit k is set if
    the sibling of the node k levels up is still to visit. candidates (BATCH, R), found (R,)."""

    node: Array
    pending: Array
    candidates: Array
    found: Array


def _collect(boxes: Boxes, rays: ShearedRays, node: Array, pending: Array, leaves: int) -> _Visit:
    """Visits nodes until every ray is through (node 0) or has candidates enough for a test."""
    count = node.shape[0]
    eps = jnp.finfo(boxes.low.dtype).eps
    reach = jnp.maximum(jnp.max(jnp.abs(boxes.low[count_root(boxes)])), 1.0)
    far = jnp.maximum(
        jnp.maximum(jnp.abs(rays.origin_x), jnp.abs(rays.origin_y)), jnp.abs(rays.origin_z)
    )
    slack = 16 * eps * (far + reach)

    def going(visit: _Visit) -> Array:
        return (visit.node > 0) & (visit.found < BATCH - 1)

    def step(visit: _Visit) -> _Visit:
        go = going(visit)
        node, pending, candidates, found = visit
        left, right = 2 * node, 2 * node + 1
        in_left, in_right = go[None] & _meet(boxes, rays, node, slack, jnp.any(go))
        leaf = left >= leaves  # both are
        rows = jnp.arange(BATCH)[:, None]
        take_left, take_right = in_left & leaf, in_right & leaf
        second = found + take_left.astype(jnp.int32)
        candidates = jnp.where((rows == found[None]) & take_left[None], left[None], candidates)
        candidates = jnp.where((rows == second[None]) & take_right[None], right[None], candidates)
        down = (in_left | in_right) & ~leaf
        # Down to one child, the other is pending if both are met; or back to the last one pending.
        below = pending * 2 + (in_left & in_right).astype(jnp.int32)
        up = lax.population_count((pending & -pending) - 1)
        back = jnp.where(pending == 0, 0, lax.shift_right_logical(node, up) ^ 1)
        after = jnp.where(pending == 0, 0, lax.shift_right_logical(pending, up) & -2)
        return _Visit(
            jnp.where(go, jnp.where(down, jnp.where(in_left, left, right), back), node),
            jnp.where(go, jnp.where(down, below, after), pending),
            candidates,
            second + take_right.astype(jnp.int32),
        )

    start = _Visit(node, pending, jnp.zeros((BATCH, count), jnp.int32), jnp.zeros_like(node))
    return lax.while_loop(lambda visit: jnp.any(going(visit)), step, start)


def count_root(boxes: Boxes) -> Array:
    """Indices of the root's low corner, one an axis."""
    return jnp.arange(3) * (boxes.low.shape[0] // 3) + 1


def _test(boxes: Boxes, rays: ShearedRays, leaf: Array, inwards: Array, valid: Array):
    """Whether a ray's line crosses the face of a leaf (R,) inwards, and at which depth."""
    wanted = jnp.any(valid)

    def find(corners, rays, leaf):
        count = corners.shape[0] // 9
        places = [3 * count * axis + leaf for axis in (rays.axis_x, rays.axis_y, rays.axis_z)]
        return [[take(corners, at + count * k) for at in places] for k in range(3)]

    none = jnp.zeros_like(rays.origin_z)  # entries need no scalar
    found = load(wanted, find, boxes.corners, rays, leaf)
    face = tuple(project(rays, (*vertex, none), wanted) for vertex in found)
    edges = stage(wanted, face_edges, *face)
    a, b, c = (is_positive(edge) == inwards for edge in edges)

    def depth_of(face, edges, eye):
        return crossing(face, jnp.stack([sizes_of(edge) for edge in edges]), eye).z

    return a & b & c, stage(wanted, depth_of, face, edges, rays.eye)


def search(
    scene: Scene, rays: ShearedRays, boxes: Boxes, wanted: Array, last: tuple[Array, Array]
) -> Entries:
    """The PEEL nearest entries behind `last` (depth (R,), packed face (R,)).

    Args:
      wanted: bool (R,), rays that search.
    """
    leaves = scene.faces.shape[0]
    dtype = scene.coordinates.dtype
    count = wanted.shape[0]
    rays = lax.stop_gradient(rays)
    scene = lax.stop_gradient(scene)
    last_depth, last_face = lax.stop_gradient(last)

    def insert(entries: Entries, depth: Array, face: Array, valid: Array) -> Entries:
        """A sorted list, by (depth, face); what falls off its end is remembered in `more`."""
        depths, faces, more = entries
        new_depths, new_faces = [], []
        depth = jnp.where(valid, depth, jnp.inf)
        face = jnp.where(valid, face, -1)
        for k in range(PEEL):
            before = (depth < depths[k]) | ((depth == depths[k]) & (face < faces[k]))
            before = before & valid
            new_depths.append(jnp.where(before, depth, depths[k]))
            new_faces.append(jnp.where(before, face, faces[k]))
            depth, face, valid = (
                jnp.where(before, depths[k], depth),
                jnp.where(before, faces[k], face),
                jnp.where(before, faces[k] >= 0, valid),
            )
        return Entries(tuple(new_depths), tuple(new_faces), more | valid)

    def round_(carry):
        node, pending, entries = carry
        node, pending, candidates, found = _collect(boxes, rays, node, pending, leaves)

        def one(k, entries):
            leaf = jnp.maximum(candidates[k] - leaves, 0)
            word = take(scene.faces, leaf)
            valid = (k < found) & (word >= 0)
            inwards = packing.flag_of(word) == 1
            contained, depth = _test(boxes, rays, leaf, inwards, valid)
            behind = (depth > last_depth) | ((depth == last_depth) & (word > last_face))
            valid = valid & contained & behind
            return lax.cond(jnp.any(valid), insert, lambda e, *_: e, entries, depth, word, valid)

        return node, pending, lax.fori_loop(0, jnp.max(found), one, entries)

    entries = no_entries(count, dtype)
    node = jnp.where(wanted, 1, 0).astype(jnp.int32)
    *_, entries = lax.while_loop(
        lambda carry: jnp.any(carry[0] > 0), round_, (node, jnp.zeros_like(node), entries)
    )
    return entries
