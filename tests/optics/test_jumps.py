"""Jumps of the transfer function: no width, a place that is differentiated, and the upper side
where a segment meets one exactly."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import quick

import jaxvr
from jaxvr.optics import Segment, TransferFunction
from tests.optics.segments import check_slopes, integrate, random_segments, segment_of

# Three jumps, two of them the ends; JUMPS: which control points go together.
POSITIONS = np.array([0.0, 0.0, 0.3, 0.5, 0.5, 0.7, 0.9, 0.9])
JUMPS = np.array([0, 0, 1, 2, 2, 3, 4, 4])
_RNG = np.random.default_rng(3)
COLORS, EXTINCTIONS = _RNG.uniform(0, 1, (8, 3)), _RNG.uniform(0.3, 4, 8)
TF = TransferFunction(POSITIONS, COLORS, EXTINCTIONS)

SLABS = [
    (jaxvr.Analytic(), 1e-7),
    (jaxvr.Quadrature(samples=20), 1e-7),
    (jaxvr.PartialPreIntegration(), 1e-5),
    (jaxvr.PartialPreIntegration(crossings="texture", texture_size=3), 1e-5),
]


@pytest.mark.parametrize("integrator, rtol", SLABS, ids=lambda x: type(x).__name__)
def test_place_of_a_jump_is_differentiated(integrator, rtol):
    """By everything, up and down, through one and through all jumps; the two points together."""

    def function(moves, colors, extinctions, *segment):
        tf = TransferFunction(jnp.asarray(POSITIONS) + moves[JUMPS], colors, extinctions)
        return integrate(integrator, tf, Segment(*segment))[:2]

    args = (jnp.zeros(5), TF.colors, TF.extinctions, *random_segments(24))
    check_slopes(function, args, rtol=rtol)


def test_a_table_knows_where_the_jump_is():
    """Full pre-integration: the derivative is that of its table, which is exact at its nodes."""
    integrator = jaxvr.PreIntegration((16, 16, 4), incremental=False)
    segment = random_segments(8, 0.1, 0.8)

    def function(moves, colors, extinctions):
        tf = TransferFunction(jnp.asarray(POSITIONS) + moves[JUMPS], colors, extinctions)
        return integrate(integrator, tf, segment)[:2]

    moves = jnp.array([0.011, 0.0, 0.003, 0.0, 0.007])  # between nodes
    check_slopes(function, (moves, TF.colors, TF.extinctions), rtol=1e-6, steps=(1e-6, 5e-7))


@pytest.mark.parametrize("integrator", [jaxvr.AverageColor(), jaxvr.ConstantExtinction()])
def test_integrators_of_ends_see_no_jump_between_them(integrator):
    """Only the ramps that the ends lie on lead to a derivative by its place."""
    segment = segment_of([(0.4, 0.6, 1.0), (0.6, 0.4, 2.0)])

    def value(move):
        tf = TransferFunction(jnp.asarray(POSITIONS) + move[JUMPS], TF.colors, TF.extinctions)
        return integrate(integrator, tf, segment)[0].sum()

    check_slopes(value, (jnp.zeros(5),), rtol=1e-6)


def slopes(cases, field):
    """Of the sum of rgb and depth (R,), by POSITIONS (R, 8) and by both ends (R, 2)."""

    def each(positions, case):
        tf = TransferFunction(positions, TF.colors, TF.extinctions)
        segment = Segment(*(x[None] for x in case))
        rgb, depth, _ = integrate(jaxvr.Analytic(), tf, segment)
        return (rgb.sum() + depth.sum())[()]

    cases = jnp.asarray(cases)
    function = {"value": each, "slope": jax.grad(each, (0, 1))}[field]
    return quick.jit(jax.vmap(function, (0, 0)))


def one_sided(function, positions, cases, move, shift, h=1e-6):
    """The derivative along (move, shift) from that side, extrapolated to step 0."""

    def at(step):
        return np.asarray(function(positions + step * move, cases + step * shift))

    return (4 * at(h) - at(2 * h) - 3 * at(0.0)) / (2 * h)


EXACT = np.array(
    [
        (0.35, 0.5, 1.0),  # up to the jump
        (0.5, 0.65, 1.0),  # from it, upwards
        (0.65, 0.5, 1.0),  # down to it
        (0.5, 0.35, 1.0),  # from it, downwards
        (0.5, 0.5, 1.0),  # along it
        (0.0, 0.9, 2.0),  # between those at both ends
        (0.9, 0.0, 2.0),
        (0.5, 0.9, 1.0),  # from one to the next
        (0.9, 0.5, 1.0),
    ]
)


def test_exactly_at_a_jump_the_derivative_is_that_of_the_jump_moving_down():
    """A scalar at a jump belongs to its upper side, so that nothing breaks off that way; the field
    moving up is the same."""
    positions = jnp.asarray(np.tile(POSITIONS, (len(EXACT), 1)))
    cases = jnp.asarray(EXACT)
    value = slopes(EXACT, "value")
    by_positions, by_case = slopes(EXACT, "slope")(positions, cases)
    zero = jnp.zeros_like(cases)
    for jump in ((0, 1), (3, 4), (6, 7)):
        move = np.zeros_like(positions)
        move[:, jump] = -1.0
        found = one_sided(value, positions, cases, jnp.asarray(move), zero)
        np.testing.assert_allclose(-np.asarray(by_positions)[:, jump].sum(1), found, atol=2e-6)
    up = jnp.asarray(np.tile([1.0, 1.0, 0.0], (len(EXACT), 1)))
    found = one_sided(value, positions, cases, jnp.zeros_like(positions), up)
    np.testing.assert_allclose(np.asarray(by_case)[:, :2].sum(1), found, atol=2e-6)


def test_each_point_of_a_jump_has_the_derivative_of_drawing_them_apart():
    cases = np.array([(0.35, 0.65, 1.0), (0.65, 0.35, 1.0), (-0.1, 1.1, 2.0)])
    positions = jnp.asarray(np.tile(POSITIONS, (len(cases), 1)))
    cases = jnp.asarray(cases)
    value = slopes(cases, "value")
    by_positions, _ = slopes(cases, "slope")(positions, cases)
    for point, way in ((3, -1.0), (4, 1.0), (0, -1.0), (7, 1.0)):
        move = jnp.zeros_like(positions).at[:, point].set(way)
        found = one_sided(value, positions, cases, move, jnp.zeros_like(cases))
        np.testing.assert_allclose(way * by_positions[:, point], found, atol=2e-6)


@pytest.mark.parametrize("exponent", [-90, -70, -60, 0, 60, 90])
def test_a_jump_has_no_width_in_any_unit(exponent, dtype):
    """Two points one rounding apart are no jump, two equal ones take nothing of a segment."""
    unit = np.dtype(dtype).type(2.0**exponent)
    near = np.array([0.25, 0.5, np.nextafter(np.float32(0.5), np.float32(1)), 0.75], dtype)
    segment = segment_of([(0.25, 0.75, 1.0), (0.7, 0.3, 1.0)], dtype)
    compiled = quick.jit(integrate, static_argnums=0)
    for positions in (near, np.array([0.25, 0.5, 0.5, 0.75], dtype)):
        tf = TransferFunction(positions * unit, COLORS[:4], EXTINCTIONS[:4], dtype=dtype)
        rgb, depth, _ = compiled(
            jaxvr.Analytic(), tf, Segment(segment.front * unit, segment.back * unit, segment.length)
        )
        mean = [(a + b) / 2 for a, b in zip(EXTINCTIONS[:3], EXTINCTIONS[1:4])]
        assert float(depth[0]) == pytest.approx((mean[0] + mean[2]) / 2, rel=1e-6)
        assert np.isfinite(rgb).all()


@pytest.fixture
def lattice():
    """Whose layers of points lie exactly at the jump of `AT_POINTS`, and rays along the field."""
    mesh = jaxvr.datasets.box((4, 2, 2), field=lambda p: p[:, 0], dtype="float64")
    tf = TransferFunction([0.0, 0.5, 0.5, 1.0], COLORS[:4], EXTINCTIONS[:4])
    return mesh, tf


@pytest.mark.usefixtures("quick_code")
@pytest.mark.parametrize("eye", [3.0, -3.0])
def test_faces_at_a_jump(lattice, eye):
    """Segments start and end exactly at it: both kinds of loops agree, and are right where the
    field is smooth; in both directions, and composited from behind."""
    mesh, tf = lattice
    origins = np.stack(np.broadcast_arrays(eye, *np.meshgrid([0.21, 0.66], [0.13, 0.72])), -1)
    rays = origins, np.broadcast_to([-np.sign(eye), 0.011, 0.007], origins.shape)
    segments = jaxvr.trace(mesh, rays)

    def loss(move, scalar, engine, compositor=None):
        moved = TransferFunction(tf.positions + move * jnp.array([0, 1, 1, 0]), tf.colors, EXT)
        played = dataclasses.replace(segments, scalar=scalar)
        return jaxvr.shade(played, moved, engine=engine, compositor=compositor).sum()

    EXT = tf.extinctions
    start = jnp.asarray(0.0), segments.scalar
    want = [float(loss(jnp.asarray(h), segments.scalar, None)) for h in (-1e-5, 1e-5)]
    behind = jaxvr.Over(direction="back to front")
    kinds = [(None, None), (jaxvr.engine.XLA(), None), (None, behind)]
    found = [jax.grad(loss, (0, 1))(*start, *kind) for kind in kinds]
    for by_move, by_scalar in found:
        assert float(by_move) == pytest.approx((want[1] - want[0]) / 2e-5, rel=1e-4)
        np.testing.assert_allclose(by_scalar, found[0][1], atol=1e-13)


@pytest.mark.usefixtures("quick_code")
def test_render_across_jumps():
    """By values, points, eye and positions against differences, through the compiled loops (JAX's
    agree with them: test_registry)."""
    mesh = jaxvr.datasets.box(
        (2, 2, 2), jitter=0.2, seed=1, field=lambda p: 0.9 * p[:, 0] + 0.2 * np.sin(3 * p[:, 1]),
        dtype="float64",
    )  # fmt: skip
    camera = jaxvr.Camera.look_at(
        (1.9, 1.4, 2.3), (0.5, 0.5, 0.5), fov=35.0, width=6, height=5, dtype="float64"
    )
    weights = np.random.default_rng(5).normal(size=(5, 6, 4))

    def function(moves, values, points, eye):
        tf = TransferFunction(jnp.asarray(POSITIONS) + moves[JUMPS], COLORS, EXTINCTIONS)
        volume = mesh.replace(values=values, points=points)
        return (jaxvr.render(volume, camera.replace(eye=eye), tf) * weights).sum()

    args: list[Any] = [jnp.zeros(5), mesh.values, mesh.points, camera.eye]
    slope = jax.grad(function, (0, 1, 2, 3))(*args)
    rng = np.random.default_rng(0)
    for k, x in enumerate(args):
        way = jnp.asarray(rng.normal(size=x.shape))

        def at(h, k=k, x=x, way=way):
            moved: Any = [*args[:k], x + h * way, *args[k + 1 :]]
            return float(function(*moved))

        coarse, fine = ((at(h) - at(-h)) / (2 * h) for h in (2e-5, 1e-5))
        assert float((slope[k] * way).sum()) == pytest.approx((4 * fine - coarse) / 3, rel=1e-6)
