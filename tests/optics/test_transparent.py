"""Runs of transparent slabs: which control points go, and that nothing else changes."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import quick

from jaxvr.optics import Analytic, PartialPreIntegration, Quadrature, Segment, TransferFunction
from jaxvr.optics.partition import merge_transparent, nodes_of
from tests.optics.segments import random_segments, segment_of

X = np.array([0.1, 0.2, 0.3, 0.4, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9])
# Transparent: below 0.3, in (0.5, 0.7) with both ends, and above 0.8. There is a jump at 0.4.
TAU = np.array([0, 0, 0, 2.0, 3.0, 0, 0, 0, 0, 0]) + np.array([0] * 8 + [4.0, 4.0])
LATE = np.where(X > 0.75, 0, TAU)
INTEGRATORS = [
    Analytic(),
    Quadrature(samples=4),
    PartialPreIntegration(),
    PartialPreIntegration(crossings="texture", texture_size=16),
]


def transfer(extinctions, dtype="float64"):
    k = len(extinctions)
    colors = np.random.default_rng(0).uniform(0, 1, (k, 3))
    positions = X if k == len(X) else np.linspace(0, 1, k)
    return TransferFunction(positions, colors, np.asarray(extinctions, float), dtype=dtype)


@pytest.mark.parametrize(
    "extinctions, left",
    [
        (TAU, [0.3, 0.4, 0.4, 0.5, 0.7, 0.8, 0.9]),
        (LATE, [0.3, 0.4, 0.4, 0.5]),
        (np.zeros(10), []),
        (np.ones(10), list(X)),
        ([0.0], []),
        ([1.0], [0.0]),
        ([0.0, 1.0], [0.0, 1.0]),
        ([0.0, 0.0], []),
        (np.eye(255)[100], [99 / 254, 100 / 254, 101 / 254]),
    ],
)
def test_control_points_inside_of_runs_go(extinctions, left, dtype):
    nodes = nodes_of(transfer(extinctions), dtype)
    got = merge_transparent(nodes)
    assert got.position.shape == nodes.position.shape and got.position.dtype == dtype
    assert np.isfinite(got.position).all()
    kept = np.asarray(got.position) < np.finfo(dtype).max
    assert np.allclose(got.position[kept], left) and kept[: len(left)].all()
    before = np.asarray(nodes.optical)[:, np.isin(nodes.position, got.position)]
    assert np.array_equal(np.asarray(got.optical)[:, kept], before)


@functools.partial(quick.rounded_jit, static_argnums=(0, 3))
def walk(integrator, tf, segment, how):
    """Whole segments with a shortened table or the original one: rgb and depth (4, R), pieces and
    the slab's control points (2, R) around the end."""
    table = integrator.prepare(tf, segment.front.dtype, jnp.max(segment.length))
    if how != "original":
        table = integrator.shorten(table, how == "image")

    def body(carry):
        cursor, total, depth, done, count = carry
        rgb, tau, new, finished, _ = integrator.step(table, segment, cursor)
        piece = jnp.concatenate([jnp.exp(-depth)[None] * rgb, tau[None]])
        total = jnp.where(done[None], total, total + piece)
        cursor = jax.tree.map(lambda a, b: jnp.where(done, b, a), new, cursor)
        return cursor, total, total[3], done | finished, count + ~done

    size = segment.front.shape
    zero = jnp.zeros(size, segment.front.dtype)
    loop = (
        integrator.start(table, segment.front),
        *(jnp.zeros((4, *size), zero.dtype), zero, jnp.zeros(size, bool)),
        jnp.zeros(size, jnp.int32),
    )
    cursor, total, _, done, count = jax.lax.while_loop(lambda c: ~jnp.all(c[3]), body, loop)
    inner = jnp.concatenate([table.position - jnp.inf, table.position + jnp.inf])
    ends = jnp.concatenate([inner[:1], table.position, inner[-1:]])
    return total, count, cursor.scalar, jnp.stack([ends[cursor.slab], ends[cursor.slab + 1]])


SPECIAL = segment_of(
    [
        *((0.3, 0.05, 1.0), (0.3, 0.3, 1.0), (0.5, 0.7, 1.0), (0.7, 0.5, 1.0), (0.5, 0.5, 1.0)),
        *((0.4, 0.4, 1.0), (0.3, 0.4, 1.0), (0.4, 0.3, 1.0), (0.0, 1.0, 1.0), (1.0, 0.0, 1.0)),
        *((0.2, 0.2, 1.0), (2.0, 0.85, 1.0), (0.6, 0.6, 0.0), (0.9, 0.9, 1.0), (0.25, 0.75, 2.0)),
    ]
)


def both(special, random):
    return Segment(*(jnp.concatenate(x) for x in zip(special, random, strict=True)))


@pytest.mark.parametrize("integrator", INTEGRATORS, ids=lambda x: f"{type(x).__name__}")
def test_nothing_changes_but_the_number_of_pieces(integrator, dtype):
    segment = jax.tree.map(lambda x: x.astype(dtype), both(SPECIAL, random_segments(200)))
    for extinctions in (TAU, LATE, np.zeros(10)):
        tf = transfer(extinctions, dtype)
        want, many, *_ = walk(integrator, tf, segment, "original")
        for how in ("image", "segments"):
            got, few, end, slab = walk(integrator, tf, segment, how)
            # Compiled apart, a product and a sum may be rounded once or twice.
            assert np.allclose(got, want, rtol=4 * np.finfo(dtype).eps, atol=1e-18), how
            assert np.sum(few) < 0.8 * np.sum(many)
            # Two textures need not lead equally fast to the slab where a segment starts.
            assert np.all(few <= many) or integrator is INTEGRATORS[-1]
            assert np.array_equal(end, segment.back)
            assert np.all((slab[0] <= end) & (end <= slab[1]))


@pytest.mark.parametrize("integrator", INTEGRATORS[:2], ids=lambda x: f"{type(x).__name__}")
def test_a_segment_inside_a_run_is_one_piece(integrator, dtype):
    """However many control points it crosses, upwards and downwards."""
    wide = TransferFunction(
        np.linspace(0, 1, 255), np.ones((255, 3)), np.r_[1.0, np.zeros(253), 1.0], dtype=dtype
    )
    rng = np.random.default_rng(1)
    front, back = rng.uniform(1.01 / 254, 252.99 / 254, (2, 100))
    segment = segment_of(np.stack([front, back, np.ones(100)], 1), dtype)
    total, count, end, slab = walk(integrator, wide, segment, "image")
    assert np.all(count == 1) and np.all(total == 0)
    assert np.array_equal(end, segment.back)
    assert np.allclose(slab[0], 1 / 254) and np.allclose(slab[1], 253 / 254)
    _, many, *_ = walk(integrator, wide, segment, "original")
    assert np.max(many) > 100


@pytest.mark.parametrize("how", ["original", "segments"])
def test_derivatives_with_respect_to_segments_are_kept(how):
    """At control points too, where they are those through the upper slab."""
    segment, tf = both(SPECIAL, random_segments(50)), transfer(LATE)
    integrator = Analytic()
    table = integrator.prepare(tf, segment.front.dtype, jnp.max(segment.length))
    if how == "segments":
        table = integrator.shorten(table, False)
    want = slopes(integrator.prepare(tf, segment.front.dtype, jnp.max(segment.length)), segment)
    for got, expected in zip(slopes(table, segment), want, strict=True):
        assert np.allclose(got, expected, rtol=1e-13, atol=1e-16)


@quick.rounded_jit
def slopes(table, segment):
    integrator = Analytic()

    def total(segment):
        def body(carry, _):
            cursor, sums, done = carry
            rgb, tau, new, finished, _ = integrator.step(table, segment, cursor)
            piece = jnp.concatenate([rgb, tau[None]])
            cursor = jax.tree.map(lambda a, b: jnp.where(done, b, a), new, cursor)
            return (cursor, jnp.where(done[None], sums, sums + piece), done | finished), None

        zero = jnp.zeros((4, *segment.front.shape), segment.front.dtype)
        start = integrator.start(table, segment.front), zero, jnp.zeros(zero.shape[1], bool)
        sums = jax.lax.scan(body, start, length=16)[0][1]
        return jnp.sum(sums * jnp.arange(1.0, 5.0)[:, None])

    return jax.grad(total)(segment)
