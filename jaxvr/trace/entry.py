"""Where rays enter a mesh: all boundary faces that the line of a ray crosses inwards, by depth.

A bounding volume hierarchy over the boundary faces, in Morton order, as a perfect binary tree in
heap order: node i has the children 2 i and 2 i + 1, and the node to visit after a subtree is
(i + 1) without its trailing zero bits, so a ray needs no stack. Its boxes are computed from the
points at every call, since points may have moved.

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

from jaxvr._core.stage import stage
from jaxvr.trace.face import crossing, is_positive, opposite_edges, sizes_of
from jaxvr.trace.scene import Scene, entry_corners, fetch, local_ids
from jaxvr.trace.shear import ShearedRays
from jaxvr.volume import packing

Array = jax.Array

PEEL = 4  # entries kept by one search
BATCH = 12  # candidates collected before they are tested


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
    """Bounds of heap nodes: low and high corners (3 * 2 L,), axis by axis."""

    low: Array
    high: Array


def build_boxes(scene: Scene) -> Boxes:
    """Boxes of all nodes, leaves first and then each level from the one below."""
    count = scene.coordinates.shape[0] // 3
    used = scene.faces >= 0
    cell, corner = packing.cell_of(scene.faces), packing.corner_of(scene.faces)
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
    )


def _meets(boxes: Boxes, rays: ShearedRays, node: Array, slack: Array) -> Array:
    """Whether the line of a ray may pass the box of a node: never a wrong no."""
    count = boxes.low.shape[0] // 3

    def span(axis: Array, origin: Array) -> tuple[Array, Array]:
        at = axis * count + node
        return boxes.low[at] - origin, boxes.high[at] - origin

    z_low, z_high = span(rays.axis_z, rays.origin_z)

    def passes(axis: Array, origin: Array, shear: Array) -> Array:
        low, high = span(axis, origin)
        a, b = shear * z_low, shear * z_high
        return (low - jnp.maximum(a, b) <= slack) & (high - jnp.minimum(a, b) >= -slack)

    return passes(rays.axis_x, rays.origin_x, rays.shear_x) & passes(
        rays.axis_y, rays.origin_y, rays.shear_y
    )


def _collect(boxes: Boxes, rays: ShearedRays, node: Array, leaves: int):
    """Visits nodes until every ray is through (node 0) or has BATCH candidates (BATCH, R)."""
    rays_count = node.shape[0]
    eps = jnp.finfo(boxes.low.dtype).eps
    reach = jnp.maximum(jnp.max(jnp.abs(boxes.low[count_root(boxes)])), 1.0)
    far = jnp.maximum(
        jnp.maximum(jnp.abs(rays.origin_x), jnp.abs(rays.origin_y)), jnp.abs(rays.origin_z)
    )
    slack = 16 * eps * (far + reach)

    def busy(carry):
        node, _, found = carry
        return jnp.any((node > 0) & (found < BATCH))

    def visit(carry):
        node, candidates, found = carry
        go = (node > 0) & (found < BATCH)
        hit = go & _meets(boxes, rays, node, slack)
        leaf = node >= leaves
        take = hit & leaf
        rows = jnp.arange(BATCH)[:, None]
        candidates = jnp.where((rows == found[None]) & take[None], node[None], candidates)
        after = node + 1
        trailing = lax.population_count((after & -after) - 1)
        skip = lax.shift_right_logical(after, trailing)
        skip = jnp.where(skip == 1, 0, skip)
        onward = jnp.where(hit & ~leaf, 2 * node, skip)
        return jnp.where(go, onward, node), candidates, found + take.astype(jnp.int32)

    candidates = jnp.zeros((BATCH, rays_count), jnp.int32)
    node, candidates, found = lax.while_loop(
        busy, visit, (node, candidates, jnp.zeros(rays_count, jnp.int32))
    )
    return node, candidates, found


def count_root(boxes: Boxes) -> Array:
    """Indices of the root's low corner, one an axis."""
    return jnp.arange(3) * (boxes.low.shape[0] // 3) + 1


def _test(scene: Scene, rays: ShearedRays, word: Array, valid: Array):
    """Whether a ray's line crosses a boundary face inwards, and at which depth."""
    cell, corner = packing.cell_of(word), packing.corner_of(word)
    wanted = jnp.any(valid)
    a, b, c = fetch(scene, rays, cell, entry_corners(corner), wanted)
    edges = stage(wanted, opposite_edges, a, b, c)
    inwards = packing.flag_of(word) == 1
    contained = jnp.all(is_positive(edges) == inwards[None], 0)
    crossed = stage(wanted, lambda *x: crossing(x[:3], sizes_of(x[3])), a, b, c, edges)
    return contained, crossed.z


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
        node, entries = carry
        node, candidates, found = _collect(boxes, rays, node, leaves)

        def one(k, entries):
            leaf = candidates[k]
            word = scene.faces[jnp.maximum(leaf - leaves, 0)]
            valid = (k < found) & (word >= 0)
            word = jnp.maximum(word, 0)
            contained, depth = _test(scene, rays, word, valid)
            behind = (depth > last_depth) | ((depth == last_depth) & (word > last_face))
            valid = valid & contained & behind
            return lax.cond(jnp.any(valid), insert, lambda e, *_: e, entries, depth, word, valid)

        return node, lax.fori_loop(0, jnp.max(found), one, entries)

    entries = no_entries(count, dtype)
    _, entries = lax.while_loop(
        lambda carry: jnp.any(carry[0] > 0),
        round_,
        (jnp.where(wanted, 1, 0).astype(jnp.int32), entries),
    )
    return entries
