"""The segment of one cell, and its derivative.

A segment is two crossings of faces, of the entry face (a, b, c) and of the exit face, which has the
apex d in place of one of them. Its derivative is with respect to the cell's four vertices, their
scalars and the ray, and is local.

At the crossing of a face with barycentric coordinates l_i, any f that is linear on the face (depth
z, scalar s) has the value f = sum l_i f_i, and the foot of the ray stays at the origin, so that

    df = sum_i l_i (df_i - f_x dx_i - f_y dy_i)

with (f_x, f_y) the gradient of f over the projected face. Cotangents z_bar, s_bar of a crossing
therefore reach vertex i as l_i q, with one q for the whole face:

    q_x = -(z_bar z_x + s_bar s_x)    q_y = -(z_bar z_y + s_bar s_y)    q_z = z_bar    q_s = s_bar

The projection is linear in the points (see `shear`), so with sums over both faces

    p_bar_kx = q_x    p_bar_ky = q_y    p_bar_kz = sign q_z - S_x q_x - S_y q_y    (times l_i)
    o_bar = -p_bar    S_x_bar = -sign q_x z    S_y_bar = -sign q_y z    (z at the crossing)

since the l_i add up to one. Points and scalars get theirs scattered to where they came from.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxvr._core.once import once
from jaxvr._core.stage import stage
from jaxvr.optics.partition import Segment
from jaxvr.trace.face import (
    Crossing,
    Face,
    barycentric,
    choose,
    crossing_at,
    edges,
    is_positive,
    opposite_edges,
    sizes_of,
    sum_of,
)
from jaxvr.trace.scene import Scene, entry_corners, fetch, points_at, value_slots
from jaxvr.trace.shear import VALUE, Interval, ShearedRays, X, Y, Z
from jaxvr.volume import packing

Array = jax.Array


class Exit(NamedTuple):
    """drop (R,), weights (3, R) of the exit face's vertices, lost (R,): no face is an exit."""

    drop: Array
    weights: Array
    lost: Array


def leave_by(positive: Array, weights: Array, to_apex: tuple[Array, Array, Array]) -> Exit:
    """Which face a ray leaves by, from the edges (R,) that join a, b and c to the apex."""
    to_a, to_b, to_c = (is_positive(edge) == positive for edge in to_apex)
    drop = jnp.where(to_c & ~to_b, 0, jnp.where(to_a & ~to_c, 1, 2)).astype(jnp.int32)
    lost = (to_a == to_b) & (to_b == to_c)
    return Exit(drop, exit_sizes(weights, tuple(map(sizes_of, to_apex)), drop), lost)


def exit_sizes(weights: Array, to_apex: tuple[Array, ...], drop: Array) -> Array:
    """Barycentric weights (3, R) of the exit face, from sizes of edges.

    The weight of a vertex is the area across from it: with d in place of the dropped vertex, the
    other two swap their edges to d, and d inherits the dropped vertex's weight.
    """
    w_a, w_b, w_c = to_apex
    kept = jnp.where(drop == 0, weights[0], jnp.where(drop == 1, weights[1], weights[2]))
    return jnp.stack([jnp.where(drop == 2, w_b, w_c), jnp.where(drop == 0, w_b, w_a), kept])


def edges_to_apex(face: Face, apex: Array, corner: Array) -> tuple[Array, Array, Array]:
    """The edges (a, d), (b, d), (c, d), (R,) each; the apex stands at `corner` in the order."""
    d = apex[: Y + 1]
    a, b, c = (edges(v[: Y + 1], d, corner > k) for k, v in enumerate(face))
    return a, b, c


def exit_face(face: Face, apex: Array, drop: Array) -> Face:
    """The vertices of the exit face: two of the entry face, in order, and the apex."""
    a, b, c = face
    return choose(drop == 0, b, a), choose(drop == 2, b, c), apex


def in_order(three: Any, place: Array) -> Any:
    """(p, q, d) with d at `place` (0, 1, 2), where it stands in the mesh's order."""
    p, q, d = three
    front, back = place == 0, place == 2
    return choose(front, d, p), choose(front, p, choose(back, q, d)), choose(back, d, q)


# Depths of the scene, whose coordinates are below 1, that are this close may differ by rounding: a
# few units in the last place of coordinates.
ROUNDING = 16


@jax.custom_jvp
def _moving_as(x: Array, other: Array) -> Array:
    """x, with the derivative of `other`."""
    return x


@_moving_as.defjvp
def _moving_as_jvp(primals, tangents):
    return primals[0], tangents[1]


class Side(NamedTuple):
    """Whether depths lie outside of a ray's interval, (R,) each: before its near end, and beyond
    its far end, None if it has none."""

    before: Array
    beyond: Array | None


class Reached(NamedTuple):
    """How far a ray has come: depth (2, R), a pair, and by how much that is farther (R,) than the
    face it stands in; 0 unless that face lies farther back than rounding explains."""

    depth: Array
    lead: Array


def side_of(depth: Any, interval: Interval) -> Side:
    """Where a depth (2, R), a pair, lies."""
    z = depth[0] + depth[1]
    near, far, _ = interval
    return Side(z < (0 if near is None else near), None if far is None else z > far)


def are_out(sides: tuple[Side, Side]) -> Array:
    """Whether both ends (R,) lie outside of the interval on the same side: nothing is seen."""
    (before, beyond), (too, also) = sides
    out = before & too
    return out if beyond is None or also is None else out | (beyond & also)


def make_segment(
    reached: Reached,
    front: Array,
    out: Crossing,
    turned: Array,
    interval: Interval,
    sides: tuple[Side, Side] | None = None,
):
    """The segment from where a ray has come to up to the exit, with what lies outside of the ray's
    interval cut off, and how far the ray has come then. front (R,): the scalar at the entry face.

    An exit before the depth reached ends a segment of no length: the ray stays where it is, so that
    chords add up to the distance from the first face to the last. The next segment then starts
    there as well, and no longer at its own entry: its scalar has moved along its chord. In a turned
    cell all that runs backwards.

    Derivatives telescope as chords do. Where the exit lies behind by no more than rounding, as that
    of a cell without volume may, the depth reached is its, and the length of 0 has the derivative
    of a cell that has volume: of the two sides of that kink it is the one taken, whatever rounding
    made of the cell. Where a cell is overturned for good, the depth reached is still that of an
    earlier face, and moves with it.

    sides: where the two ends lie, where that was found before. A face at the eye, or at another end
    of the interval, ends one segment and starts another. Made anew for derivatives, its depth is
    rounded in another way for each of the two, and neither may have its derivative then.
    """
    depth, lead = reached
    advance = (out.z - depth[0]) + (out.z_low - depth[1])
    ahead = jnp.where(turned, -advance, advance)
    proper = ahead > 0
    near = ahead > -ROUNDING * jnp.finfo(ahead.dtype).eps
    exit_depth = jnp.stack([out.z, out.z_low])
    end = _moving_as(jnp.where(proper[None], exit_depth, depth), exit_depth)
    end = jnp.where(near[None], end, depth)
    chord = jnp.where(near, _moving_as(jnp.maximum(ahead, 0), ahead), 0)
    cut = proper & (lead != 0)
    whole = jnp.where(cut, lead + advance, 1)
    share = jnp.clip(jnp.where(cut, lead, 0) / jnp.where(whole == 0, 1, whole), 0, 1)
    front = jnp.where(cut, front + (out.value - front) * share, front)
    after = Reached(end, jnp.where(near, 0, -advance))
    sides = (side_of(depth, interval), side_of(end, interval)) if sides is None else sides
    return _within(interval, depth, end, front, out.value, chord, sides), after


def _within(interval: Interval, start, end, front: Array, back: Array, chord, sides) -> Segment:
    """The part of a segment in an interval, as a world length. A hard cut: its place moves."""
    z = start[0] + start[1], end[0] + end[1]
    begins, ends = sides
    near = jnp.zeros_like(z[0]) if interval.near is None else interval.near
    outside, cut, at = are_out(sides), [s.before for s in sides], [near, near]
    if interval.far is not None:
        cut = [s.before | s.beyond for s in sides]
        at = [jnp.where(s.before, near, interval.far) for s in sides]
    cut = [c & ~outside for c in cut]
    cuts = cut[0] | cut[1]
    whole = jnp.where(cuts & (z[0] != z[1]), z[1] - z[0], 1.0)
    # Guarded: an end that nothing is cut at may be infinite.
    at = [jnp.where(c, a, z[0]) for c, a in zip(cut, at, strict=True)]
    scalars = [front + (back - front) * ((a - z[0]) / whole) for a in at]
    first, last = (jnp.where(*x) for x in zip(cut, at, z, strict=True))
    # A segment that runs backwards comes in at the far end, or goes out at the near one.
    backwards = ends.before if interval.far is None else ends.before | begins.beyond
    seen = jnp.where(backwards, first - last, last - first)
    length = jnp.where(cuts, seen, jnp.where(outside, 0.0, chord))
    return Segment(
        jnp.where(cut[0], scalars[0], front),
        jnp.where(cut[1], scalars[1], back),
        length * interval.stretch,
    )


class _Pulled(NamedTuple):
    """q_x, q_y, q_z, q_s of a face, (R,) each."""

    x: Array
    y: Array
    z: Array
    s: Array


def _pull_back_crossing(face: Face, area: Array, z_bar: Array, s_bar: Array) -> _Pulled:
    """`area` (R,) is twice the face's signed area; where it is zero, the ray lies in the face's
    plane, and by convention the crossing does not move across it."""
    a, b, c = face
    u_x, u_y, v_x, v_y = b[X] - a[X], b[Y] - a[Y], c[X] - a[X], c[Y] - a[Y]
    per_area = jnp.where(area == 0, 0, 1 / jnp.where(area == 0, 1, area))

    def along(row: int) -> tuple[Array, Array]:
        to_b, to_c = b[row] - a[row], c[row] - a[row]
        return (to_b * v_y - to_c * u_y) * per_area, (u_x * to_c - v_x * to_b) * per_area

    (z_x, z_y), (s_x, s_y) = along(Z), along(VALUE)
    return _Pulled(-(z_bar * z_x + s_bar * s_x), -(z_bar * z_y + s_bar * s_y), z_bar, s_bar)


def _crossed(face: Face, weights: Array, eye: Array) -> tuple[Array, Crossing]:
    coordinates = barycentric(face, weights)
    return coordinates, crossing_at(face, coordinates, eye)


def _by_corner(share: Array, corner: Array) -> tuple[Array, ...]:
    """Shares (3, R) of a face's vertices as those of the cell's four, 0 for the one at `corner`."""
    a, b, c = share
    return (
        jnp.where(corner == 0, 0, a),
        jnp.where(corner == 1, 0, jnp.where(corner < 1, a, b)),
        jnp.where(corner == 2, 0, jnp.where(corner < 2, b, c)),
        jnp.where(corner == 3, 0, c),
    )


def gradient_zeros(scene: Scene, rays: ShearedRays, asked: Scene, by_rays: bool) -> Any:
    """`AbstractTracer.gradient_start`: ((values, coordinates), rays), None for what is not asked
    for. asked: True at leaves of the scene whose gradients are."""
    for_scene = (
        jnp.zeros_like(scene.values) if asked.values else None,
        jnp.zeros_like(scene.coordinates) if asked.coordinates else None,
    )
    ends = tuple(None if x is None else jnp.zeros_like(x) for x in (rays.near, rays.far))
    return for_scene, ((jnp.zeros_like(rays.origin_x),) * 6 + ends) if by_rays else None


def as_scene(scene: Scene, gradient: Any) -> Scene:
    """An accumulated gradient of the scene in its form, zero where none was asked for."""
    values, coordinates = gradient
    out = jax.tree.map(jnp.zeros_like, scene)
    if values is not None:
        out = dataclasses.replace(out, values=values)
    if coordinates is not None:
        out = dataclasses.replace(out, coordinates=coordinates)
    return out


def as_rays(rays: ShearedRays, gradient: Any) -> ShearedRays:
    """The same of rays."""
    out = jax.tree.map(jnp.zeros_like, rays)
    if gradient is None:
        return out
    names = ("origin_x", "origin_y", "origin_z", "shear_x", "shear_y", "stretch", "near", "far")
    return dataclasses.replace(out, **dict(zip(names, gradient, strict=True)))


def segment_from(
    start: Crossing,
    enter: Crossing,
    leave: Crossing,
    cut: Array,
    turned: Array,
    interval: Interval,
    sides: tuple[Side, Side] | None = None,
) -> tuple[Segment, Reached]:
    """`make_segment` of a cell between two crossings, from a third on where it is `cut` (R,)."""
    start = choose(cut, start, enter)
    lead = jnp.where(cut, (start.z - enter.z) + (start.z_low - enter.z_low), 0)
    reached = Reached(jnp.stack([start.z, start.z_low]), lead)
    return make_segment(reached, enter.value, leave, turned, interval, sides)


def pull_back_cell(
    scene: Scene, rays: ShearedRays, state: Any, cotangent: Segment, gradient: Any
) -> Any:
    """See `AbstractTracer.pull_back`; `gradient` is ((values, coordinates), rays), or Nones."""
    (values, coordinates), by_rays = gradient
    cell, ahead = state.cell, state.ahead
    live, wanted = state.active, jnp.any(state.active)
    number, corner = packing.cell_of(cell.word), packing.corner_of(cell.word)
    turned = packing.turned_of(cell.word) == 1
    share, enter = stage(wanted, _crossed, cell.face, cell.weights, rays.eye)
    exit_share, leave = stage(wanted, _crossed, ahead.face, ahead.weights, rays.eye)

    # The depth reached is that of the entry face, or of one farther on that was left behind.
    cut = live & (cell.lead != 0)
    before = jnp.where(cut, cell.reached, cell.word)
    start = once(jnp.any(cut), _start_at, enter, scene, rays, before, cut)
    sides = cell.side, side_of(ahead.depth, rays.interval)

    def pull_back_segment(enter, start, leave, interval, bar):
        def forward(enter, start, leave, interval):
            return segment_from(start, enter, leave, cut, turned, interval, sides)[0]

        return jax.vjp(forward, enter, start, leave, interval)[1](bar)

    cotangent = Segment(*(jnp.where(live, g, 0) for g in cotangent))
    enter_bar, start_bar, leave_bar, interval_bar = stage(
        wanted, pull_back_segment, enter, start, leave, rays.interval, cotangent
    )
    area, exit_area = sum_of(cell.weights), sum_of(ahead.weights)
    area = jnp.where(cell.positive, area, -area)
    exit_area = jnp.where(ahead.positive, exit_area, -exit_area)
    q = stage(wanted, _pull_back_crossing, cell.face, area, enter_bar.z, enter_bar.value)
    p = stage(wanted, _pull_back_crossing, ahead.face, exit_area, leave_bar.z, leave_bar.value)

    shares = list(
        zip(_by_corner(share, corner), _by_corner(exit_share, cell.exit_corner), strict=True)
    )
    corners = jnp.broadcast_to(jnp.arange(4, dtype=jnp.int32)[:, None], (4, *number.shape))
    ids = points_at(scene, number, corners, wanted)
    if values is not None:
        slots = value_slots(scene, number[None], corners, ids)
        bars = [i * q.s + o * p.s for i, o in shares]
        values = values.at[slots].add(jnp.stack(bars))

    if coordinates is not None:
        coordinates = _to_points(coordinates, rays, ids, shares, q, p)
    by_rays = _to_rays(by_rays, rays, (q, enter), (p, leave), interval_bar)
    moved = (coordinates, by_rays)
    moved = once(jnp.any(cut), _pull_back_start, moved, scene, rays, before, cut, start_bar.z)
    return (values, moved[0]), moved[1]


def _start_at(enter: Crossing, scene: Scene, rays: ShearedRays, word: Array, cut: Array):
    return choose(cut, crossing_of_face(scene, rays, word, jnp.ones((), bool)), enter)


def _pull_back_start(moved: Any, scene: Scene, rays: ShearedRays, word: Array, cut: Array, z_bar):
    """Adds what a cotangent z_bar (R,) of the depth of faces is to points and rays that are cut."""
    coordinates, by_rays = moved
    zero = jnp.zeros_like(z_bar)
    end = _end(scene, rays, word, jnp.ones((), bool))
    q = _pull_back_crossing(end.face, end.area, jnp.where(cut, z_bar, 0), zero)
    none = _Pulled(zero, zero, zero, zero)
    if coordinates is not None:
        shares = [(share, zero) for share in end.share]
        coordinates = _to_points(coordinates, rays, end.ids, shares, q, none)
    still = jax.tree.map(jnp.zeros_like, rays.interval)
    return coordinates, _to_rays(by_rays, rays, (q, end.at), (none, end.at), still)


def _in_space(rays: ShearedRays, v: _Pulled) -> tuple[Array, Array, Array]:
    return v.x, v.y, rays.sign * v.z - rays.shear_x * v.x - rays.shear_y * v.y


def _to_points(coordinates: Array, rays: ShearedRays, ids: Array, shares: Any, q, p) -> Array:
    """Adds what points ids (C, R) get: their shares of q and of p."""
    count = coordinates.shape[0] // 3
    axes = (rays.axis_x, rays.axis_y, rays.axis_z)
    where = [axis * count + point for point in ids for axis in axes]
    q, p = _in_space(rays, q), _in_space(rays, p)
    bars = [i * g + o * h for i, o in shares for g, h in zip(q, p)]
    return coordinates.at[jnp.concatenate(where)].add(jnp.concatenate(bars))


def _to_rays(by_rays: Any, rays: ShearedRays, first: Any, second: Any, bar: Interval) -> Any:
    """Adds what the ray gets of two crossings, each with what was pulled back to its face, and of
    its interval."""
    if by_rays is None:
        return None
    (q, enter), (p, leave) = first, second
    in_space = zip(_in_space(rays, q), _in_space(rays, p), strict=True)
    origin = tuple(-(g + h) for g, h in in_space)
    shear_x = -rays.sign * (q.x * enter.z + p.x * leave.z)
    shear_y = -rays.sign * (q.y * enter.z + p.y * leave.z)
    change = (*origin, shear_x, shear_y, bar.stretch, bar.near, bar.far)
    return tuple(None if g is None else g + c for g, c in zip(by_rays, change, strict=True))


class Between(NamedTuple):
    """The faces of a segment, as words of cell and corner (R,): enter and leave, in the order of
    the path; start, where it is cut (R,), that in whose depth it starts; turned (R,): whether the
    path leads back from one to the other; sides: where start and end lie."""

    enter: Array
    leave: Array
    start: Array
    cut: Array
    turned: Array
    sides: tuple[Side, Side]


def pull_back_pair(
    scene: Scene,
    rays: ShearedRays,
    faces: Between,
    live: Array,
    cotangent: Segment,
    gradient: Any,
) -> Any:
    """The same for segments between any two faces.

    Args:
      faces: what the segments are between. live (R,): rays that have one.
      cotangent: of `segment_from`.
    """
    (values, coordinates), by_rays = gradient
    wanted = jnp.any(live)
    words = (faces.enter, faces.leave)
    ends = [_end(scene, rays, jnp.where(live, word, 0), wanted) for word in words]
    cut = live & faces.cut
    before = jnp.where(cut, faces.start, 0)
    start = once(jnp.any(cut), _start_at, ends[0].at, scene, rays, before, cut)

    def pull_back_segment(enter, start, leave, interval, bar):
        def forward(enter, start, leave, interval):
            made = segment_from(start, enter, leave, cut, faces.turned, interval, faces.sides)
            return made[0]

        return jax.vjp(forward, enter, start, leave, interval)[1](bar)

    cotangent = Segment(*(jnp.where(live, g, 0) for g in cotangent))
    enter_bar, start_bar, leave_bar, interval_bar = stage(
        wanted, pull_back_segment, ends[0].at, start, ends[1].at, rays.interval, cotangent
    )
    pulled = [
        stage(wanted, _pull_back_crossing, end.face, end.area, bar.z, bar.value)
        for end, bar in zip(ends, (enter_bar, leave_bar), strict=True)
    ]
    for end, q in zip(ends, pulled, strict=True):
        if values is not None:
            slots = value_slots(scene, end.cell[None], end.corners, end.ids)
            values = values.at[slots].add(end.share * q.s[None])
        if coordinates is not None:
            none = _Pulled(*(jnp.zeros_like(x) for x in q))
            shares = [(share, jnp.zeros_like(share)) for share in end.share]
            coordinates = _to_points(coordinates, rays, end.ids, shares, q, none)
    first, second = zip(pulled, (end.at for end in ends), strict=True)
    by_rays = _to_rays(by_rays, rays, first, second, interval_bar)
    moved = (coordinates, by_rays)
    moved = once(jnp.any(cut), _pull_back_start, moved, scene, rays, before, cut, start_bar.z)
    return (values, moved[0]), moved[1]


class _End(NamedTuple):
    """cell (R,), corners (3, R) and point ids (3, R) of a face; its vertices, the barycentric
    coordinates (3, R), signed area (R,) and crossing of the ray."""

    cell: Array
    corners: Array
    ids: Array
    face: Face
    share: Array
    area: Array
    at: Crossing


def crossing_of_face(scene: Scene, rays: ShearedRays, word: Array, wanted: Array) -> Crossing:
    """Where rays cross faces, given by packed cell and corner (R,)."""
    return _end(scene, rays, word, wanted).at


def _end(scene: Scene, rays: ShearedRays, word: Array, wanted: Array) -> _End:
    cell = packing.cell_of(word)
    corners = entry_corners(packing.corner_of(word))
    a, b, c = fetch(scene, rays, cell, corners, wanted)
    areas = stage(wanted, opposite_edges, a, b, c)
    sizes = sizes_of(areas)
    share, at = stage(wanted, _crossed, (a, b, c), sizes, rays.eye)
    area = jnp.where(is_positive(areas[2]), sum_of(sizes), -sum_of(sizes))
    return _End(cell, corners, points_at(scene, cell, corners, wanted), (a, b, c), share, area, at)
