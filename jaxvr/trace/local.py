"""The segment of one cell, and its derivative.

Its derivative is with respect to the cell's four vertices, their scalars and the ray.

A segment is two crossings of faces, of the entry face (a, b, c) and of the exit face, which has the
apex d in place of one of them. Written here as one function of the four projected vertices, it is
differentiated by JAX, and the cotangents go back through the projection by hand, since that is
linear:

    x = (p - o)_kx - S_x (p - o)_kz      y alike      z = sign (p - o)_kz
    p_bar_kx = x_bar     p_bar_ky = y_bar     p_bar_kz = sign z_bar - S_x x_bar - S_y y_bar
    o_bar = -sum p_bar   S_x_bar = -sum x_bar (p - o)_kz

and are scattered to where the vertices were gathered from.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxvr.optics.partition import Segment
from jaxvr.trace.face import Face, choose, crossing, edge, is_positive, opposite_edges
from jaxvr.trace.scene import Scene, entry_corners, local_ids, value_slots
from jaxvr.trace.shear import VALUE, ShearedRays, X, Y, Z
from jaxvr.volume import packing

Array = jax.Array


class Exit(NamedTuple):
    """drop (R,), weights (3, R) of the exit face's vertices, lost (R,): no face is an exit."""

    drop: Array
    weights: Array
    lost: Array


def leave_by(positive: Array, weights: Array, to_apex: Array) -> Exit:
    """Which face a ray leaves by, from the edges (3, R) that join a, b and c to the apex."""
    side = is_positive(to_apex) == positive[None]
    to_a, to_b, to_c = side
    drop = jnp.where(to_c & ~to_b, 0, jnp.where(to_a & ~to_c, 1, 2)).astype(jnp.int32)
    sizes = jnp.where(is_positive(to_apex), to_apex, -to_apex)
    lost = (to_a == to_b) & (to_b == to_c)
    return Exit(drop, exit_sizes(weights, sizes, drop), lost)


def exit_sizes(weights: Array, to_apex: Array, drop: Array) -> Array:
    """Barycentric weights (3, R) of the exit face, from sizes of edges.

    The weight of a vertex is the area across from it: with d in place of the dropped vertex, the
    other two swap their edges to d, and d inherits the dropped vertex's weight.
    """
    w_a, w_b, w_c = to_apex
    kept = jnp.where(drop == 0, weights[0], jnp.where(drop == 1, weights[1], weights[2]))
    return jnp.stack([jnp.where(drop == 2, w_b, w_c), jnp.where(drop == 0, w_b, w_a), kept])


def edges_to_apex(face: Face, apex: Array, corner: Array) -> Array:
    """The edges (a, d), (b, d), (c, d), (3, R); the apex stands at `corner` in the order."""
    return jnp.stack([edge(v, apex, corner > k) for k, v in enumerate(face)])


def exit_face(face: Face, apex: Array, drop: Array) -> Face:
    """The vertices of the exit face: two of the entry face, in order, and the apex."""
    a, b, c = face
    return choose(drop == 0, b, a), choose(drop == 2, b, c), apex


def make_segment(depth, front: Array, out, turned: Array, stretch: Array):
    """From the entry depth and scalar to the exit, with what lies behind the eye cut off.

    A depth that rounding puts before the entry counts as the entry, so that chords add up to the
    distance from the first face to the last. In a turned cell depth runs backwards.
    """
    advance = (out.z - depth[0]) + (out.z_low - depth[1])
    proper = jnp.where(turned, advance < 0, advance > 0)
    end = jnp.where(proper[None], jnp.stack([out.z, out.z_low]), depth)
    chord = jnp.where(proper, jnp.where(turned, -advance, advance), 0.0)
    return _clip_at_eye(depth, end, front, out.value, chord, stretch), end


def _clip_at_eye(start, end, front: Array, back: Array, chord: Array, stretch: Array) -> Segment:
    """The part of a segment at depths above zero, as a world length."""
    z_0, z_1 = start[0] + start[1], end[0] + end[1]
    cuts = (z_0 < 0) != (z_1 < 0)
    whole = jnp.where(cuts, z_1 - z_0, 1.0)
    at_eye = front + (back - front) * (-z_0 / whole)
    length = jnp.where(cuts, jnp.maximum(z_0, z_1), jnp.where(z_0 < 0, 0.0, chord))
    return Segment(
        jnp.where(cuts & (z_0 < 0), at_eye, front),
        jnp.where(cuts & (z_1 < 0), at_eye, back),
        length * stretch,
    )


def _segment(vertices, stretch, corner, drop, turned) -> Segment:
    """The segment of a cell from its vertices (a, b, c, d), in the manner of the walk."""
    face, apex = vertices[:3], vertices[3]
    edges = opposite_edges(*face)
    sizes = jnp.where(is_positive(edges), edges, -edges)
    enter = crossing(face, sizes)
    to_apex = edges_to_apex(face, apex, corner)
    # The same exit as the walk's: `drop` is handed over, and the signs here only give sizes.
    exit_weights = exit_sizes(sizes, jnp.where(is_positive(to_apex), to_apex, -to_apex), drop)
    leave = crossing(exit_face(face, apex, drop), exit_weights)
    depth = jnp.stack([enter.z, enter.z_low])
    return make_segment(depth, enter.value, leave, turned, stretch)[0]


def pull_back_cell(scene: Scene, rays: ShearedRays, state, cotangent: Segment, gradient):
    """See `AbstractTracer.pull_back`; `gradient` is ((values, coordinates), rays), or Nones."""
    (values, coordinates), by_rays = gradient
    cell = state.cell
    number, corner = packing.cell_of(cell.word), packing.corner_of(cell.word)
    turned = packing.turned_of(cell.word) == 1
    vertices = (*cell.face, cell.apex)
    _, pull = jax.vjp(
        lambda v, s: _segment(v, s, corner, cell.drop, turned), vertices, rays.stretch
    )
    live = state.active
    cotangent = Segment(*(jnp.where(live, g, 0) for g in cotangent))
    bars, stretch_bar = pull(cotangent)
    corners = (*entry_corners(corner), corner)
    ids = [local_ids(scene, number, k) for k in corners]
    if values is not None:
        slots = [
            value_slots(scene, number, k, point) for k, point in zip(corners, ids, strict=True)
        ]
        values = values.at[jnp.concatenate(slots)].add(
            jnp.concatenate([bar[VALUE] for bar in bars])
        )
    if coordinates is None and by_rays is None:
        return (values, coordinates), by_rays

    p_bars = []
    for bar in bars:
        z = rays.sign * bar[Z] - rays.shear_x * bar[X] - rays.shear_y * bar[Y]
        p_bars.append((bar[X], bar[Y], z))
    if coordinates is not None:
        count = coordinates.shape[0] // 3
        axes = (rays.axis_x, rays.axis_y, rays.axis_z)
        where = [axis * count + point for point in ids for axis in axes]
        what = [component for p_bar in p_bars for component in p_bar]
        coordinates = coordinates.at[jnp.concatenate(where)].add(jnp.concatenate(what))
    if by_rays is not None:
        o_x, o_y, o_z = (sum(p[k] for p in p_bars) for k in range(3))
        s_x = sum(bar[X] * v[Z] for bar, v in zip(bars, vertices, strict=True)) * rays.sign
        s_y = sum(bar[Y] * v[Z] for bar, v in zip(bars, vertices, strict=True)) * rays.sign
        change = (-o_x, -o_y, -o_z, -s_x, -s_y, stretch_bar)
        by_rays = tuple(g + c for g, c in zip(by_rays, change, strict=True))
    return (values, coordinates), by_rays
