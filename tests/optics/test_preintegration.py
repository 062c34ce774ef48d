"""Full pre-integration: exact entries, tables made of earlier slices, and looking them up."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import quick

from jaxvr.optics import Analytic, PreIntegration, Segment, TransferFunction
from jaxvr.optics.partition import nodes_of
from jaxvr.optics.preintegration import _rounded
from jaxvr.optics.preintegration_table import direct, doubling, exact_slice, halves, one_by_one
from tests.optics.segments import TF, check_slopes, colors_of, random_segments, segment_of

# From 0 to 1, with a jump. `UNIT` has nodes that are multiples of 1 / (n - 1), without rounding.
UNIT = TransferFunction(
    np.array([0.0, 0.3, 0.55, 0.55, 1.0]), np.asarray(TF.colors), np.asarray(TF.extinctions)
)
CONSTANT = TransferFunction(
    np.array([0.0, 0.2, 0.3, 0.7, 1.0]), np.full((5, 3), [0.2, 0.5, 0.9]), np.full(5, 2.0)
)
SIZE = (6, 5, 4)


def test_exact_slice_is_the_integral():
    """Rising, falling and constant, from and to the jump, and at the first and last point."""
    cases = np.array(
        [(x, y, 1.5) for x in (0.1, 0.3, 0.4, 0.5, 0.8) for y in (0.1, 0.3, 0.4, 0.5, 0.8)]
    )
    some = random_segments(175, 0.1, 0.8)
    segment = jax.tree.map(lambda x, y: jnp.concatenate([x, y]), segment_of(cases), some)
    got = jax.jit(exact_slice)(nodes_of(TF, "float64"), *segment)
    want = colors_of(Analytic(), TF, segment)
    assert np.allclose(got[:3], want[:3], atol=3e-15)
    assert np.allclose(got[3], -np.expm1(-want[3]), atol=3e-15)


@functools.cache
def built(n_f, n_b, count=32, constant=False):
    """Slices (count, 4, n_f, n_b) of lengths 1, 2, ... by each way to make them, and powers of two
    in the last."""
    nodes = nodes_of(CONSTANT if constant else UNIT, "float64")

    @quick.jit
    def make(nodes):
        scalars = jnp.arange(n_f) / (n_f - 1.0), jnp.arange(n_b) / (n_b - 1.0)
        unit = 2.0 / count
        want = direct(nodes, scalars, unit * jnp.arange(1, count + 1))
        lengths = unit * jnp.array([1, 1.5, 2, 3, 4, 6, 8]) * 4
        far = direct(nodes, scalars, lengths)
        return want, one_by_one(want[0], count), halves(want[0], count), far, doubling(far[:2], 7)

    return [np.asarray(x) for x in make(nodes)]


def table_errors(n, quantity):
    want, slow, quick, far, doubled = built(n, n)
    pairs = (slow - want)[-1], (quick - want)[-1], (doubled - far)[-1]
    return np.array([quantity(np.abs(x)) for x in pairs])


def test_composed_slices_come_nearer_with_more_nodes():
    """On average; next to the jump, the largest error stays. Halves err less than one by one."""
    errors = np.array([table_errors(n, np.mean) for n in (9, 33)])
    assert np.all(errors[0] > 4 * errors[1]) and np.all(errors[1] < [7e-3, 3e-3, 2e-3])
    slow, quick, _ = errors.T
    assert np.all(quick < 0.9 * slow) and quick[1] < 0.5 * slow[1]


def test_composed_slices_of_a_constant_are_exact():
    want, slow, quick, far, doubled = built(5, 8, constant=True)
    assert want.shape == (32, 4, 5, 8) and doubled.shape == (7, 4, 5, 8)
    for x, y in ((slow, want), (quick, want), (doubled, far)):
        assert np.allclose(x, y, rtol=1e-13)


def test_front_and_back_may_have_different_sizes():
    """A table of 17 x 9 nodes errs about as one of 9 x 9, and not as if they were mixed up."""
    want, slow, quick, far, doubled = built(17, 9)
    bound = table_errors(9, np.mean)
    for x, y, b in zip((slow, quick, doubled), (want, want, far), bound):
        assert np.mean(np.abs(x - y)[-1]) < 1.3 * b
    # one slice of a table is the other's where both have nodes
    assert np.allclose(want[:, :, ::2], built(9, 9)[0], atol=1e-15)


@pytest.mark.parametrize("scale", ["linear", "log"])
def test_lookups_at_nodes_and_outside_the_control_points_are_exact(scale):
    """From node to node with the length of a slice; also with a part outside; and outside only."""
    integrator = PreIntegration(SIZE, scale, incremental=False)
    n_f, n_b, n_l = SIZE
    lengths = np.asarray(integrator._length(jnp.arange(n_l), jnp.float64(5.0)))
    assert lengths[0] == 0 and lengths[-1] == 5
    grid = np.meshgrid(np.arange(n_f) / (n_f - 1), np.arange(n_b) / (n_b - 1), lengths)
    half = 2 * lengths[1]  # one half of which is inside
    cases = [(-1.0, 1.0, half), (1.0, -1.0, half), (-0.5, 1.5, half)]
    cases += [(1.75, 0.25, half), (0.6, -0.6, half), (1.5, -0.5, half)]
    cases += [(-0.5, -0.1, 1.3), (-0.1, -0.1, 5.0), (1.2, 1.7, 0.7), (3.0, 2.0, 0.7), (2.0, 2.0, 1)]
    cases += [(-0.3, 0.0, 1.3), (0.0, -0.3, 1.3), (1.0, 1.3, 2.0), (1.3, 1.0, 0.4), (1.0, 1.0, 0.3)]
    segment = segment_of(np.concatenate([np.stack([x.ravel() for x in grid], 1), cases]))
    got, want = (colors_of(i, UNIT, segment) for i in (integrator, Analytic()))
    assert np.allclose(got[:3], want[:3], rtol=0, atol=3e-14)
    assert np.allclose(np.exp(-got[3]), np.exp(-want[3]), rtol=0, atol=3e-14)


def test_lookups_come_near_the_integral():
    """Of first order in the distance of nodes, as there is a jump; and inside between them."""
    segment = random_segments(120)
    want = colors_of(Analytic(), UNIT, segment)
    errors = []
    for n in (9, 33):
        got = colors_of(PreIntegration((n, n, n), incremental=False), UNIT, segment)
        errors.append(np.mean(np.abs(got[:3] - want[:3])))
    assert errors[1] < errors[0] / 6 and errors[1] < 3e-3


@pytest.mark.parametrize("count", [1, 2])
def test_all_control_points_at_one_position(count):
    """A single one, or a jump: there is nothing between the first and the last."""
    tf = TransferFunction(
        np.full(count, 0.5), np.asarray(TF.colors)[:count], np.array([2.0, 0.7])[:count]
    )
    cases = [(x, y, 1.5) for x in (0.2, 0.5, 0.7) for y in (0.2, 0.5, 0.7)]
    segment = segment_of([*cases, (0.4, 0.4, 0.0)])
    got = colors_of(PreIntegration(SIZE, incremental=False), tf, segment)
    assert np.allclose(got, colors_of(Analytic(), tf, segment), atol=1e-14)


@pytest.mark.parametrize("n_l", [8, 18])
def test_logarithmic_lengths_follow_equation_1(n_l):
    """Kraus et al. 2004: r n - 1/2 = max(log2(l / D), 0) + min(l / D, 1), D = 2^(2 - n) l_max. At
    slices, and between them as to which two are blended; the blend is linear in length here."""
    integrator = PreIntegration((2, 2, n_l), "log")
    longest = jnp.float64(3.0)
    first = 2.0 ** (2 - n_l) * 3.0
    lengths = np.asarray(integrator._length(jnp.arange(n_l), longest))
    assert np.allclose(lengths[1:], first * 2.0 ** np.arange(n_l - 1), rtol=1e-14)
    assert lengths[0] == 0
    rng = np.random.default_rng(0)
    between = np.concatenate([3.0 * 2.0 ** rng.uniform(1 - n_l, 0, 200), first * rng.random(20)])
    for sample in (lengths, between):
        left, way = (np.asarray(x) for x in integrator._slice(jnp.asarray(sample), longest))
        at = np.maximum(np.log2(np.maximum(sample, 1e-300) / first), 0) + np.minimum(
            sample / first, 1
        )
        if sample is lengths:
            assert np.allclose(left + way, at, atol=1e-12)
        else:
            assert np.array_equal(left, np.floor(at))
            assert np.allclose(lengths[left] + way * np.diff(lengths)[left], sample, rtol=1e-13)


def test_larger_logarithmic_tables_have_several_slices_an_octave():
    integrator = PreIntegration((2, 2, 34), "log")
    lengths = np.asarray(integrator._length(jnp.arange(34), jnp.float64(1.0)))
    assert np.allclose(lengths[2:] / lengths[1:-1], np.sqrt(2), rtol=1e-14)
    assert lengths[-1] == 1 and lengths[1] == pytest.approx(2.0**-16)


@functools.partial(jax.jit, static_argnums=0)
def rows(integrator):
    return integrator.prepare(UNIT, "float64", 2.0).rows


def test_bits_round_to_levels_and_derivatives_do_not_see_it():
    fine = rows(PreIntegration(SIZE, incremental=False))
    for bits in (8, 16):
        top = 2**bits - 1
        rounded = rows(PreIntegration(SIZE, incremental=False, bits=bits))
        assert np.allclose(rounded * top, np.round(rounded * top), rtol=0, atol=1e-9)
        assert 0.4 < np.max(np.abs(rounded - fine)) * top <= 0.5000001
        (slope,) = jax.vjp(lambda x: _rounded(x, bits), fine)[1](jnp.ones_like(fine))
        assert np.all(slope == 1)  # at 0 and 1 too


def segment_colors(integrator, tf, front, back, length):
    table = integrator.prepare(tf, "float64", 2.0)
    segment = Segment(front, back, length)
    return integrator.step(table, segment, integrator.start(table, front))[:2]


INNER = [(0.13, 0.77, 1.9), (0.71, 0.23, 0.9), (0.37, 0.47, 1.7), (1.2, 1.4, 1.1)]


def test_gradients_with_respect_to_everything():
    """Both points of the jump move together. Segments are inside or outside: where one is in part,
    the derivative is that of the integral, which the table only comes near to."""

    def colors(move, tf_colors, extinctions, front, back, length):
        positions = UNIT.positions + jnp.array([0.3, 1.0, 2.0, 2.0, -1.0]) * move
        tf = TransferFunction(positions, tf_colors, extinctions)
        return segment_colors(PreIntegration(SIZE), tf, front, back, length)

    args = (jnp.array(0.0), UNIT.colors, UNIT.extinctions, *segment_of(INNER))
    check_slopes(colors, args, rtol=1e-6)


def test_gradients_of_a_logarithmic_table():
    """Of colours, through slices that are doubled, and of segments."""
    integrator = PreIntegration(SIZE, "log")

    def colors(tf_colors, *segment):
        return segment_colors(integrator, UNIT.replace(colors=tf_colors), *segment)

    check_slopes(colors, (UNIT.colors, *segment_of(INNER)), rtol=1e-6)


def test_saturated_opacity_has_finite_depth_and_gradients():
    tf = UNIT.replace(extinctions=UNIT.extinctions * 1e5).astype("float32")
    segment = segment_of(
        [(0.1, 0.9, 1.5), (0.4, 0.4, 1.0), (-0.2, 0.3, 2.0), (0.0, 0.3, 0.0)], "float32"
    )
    integrator = PreIntegration(SIZE)

    @quick.jit
    def both(tf, segment):
        def loss(tf, segment):
            table = integrator.prepare(tf, "float32", jnp.asarray(2.0))
            rgb, depth = integrator.step(table, segment, integrator.start(table, segment.front))[:2]
            return jnp.sum(rgb) + jnp.sum(1 - jnp.exp(-depth)), depth

        (_, depth), slopes = jax.value_and_grad(loss, argnums=(0, 1), has_aux=True)(tf, segment)
        return depth, slopes

    depth, slopes = both(tf, segment)
    assert np.all(np.isfinite(depth)) and np.all(np.asarray(depth)[:3] > 15) and depth[3] == 0
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(slopes))


def test_slab_comes_near_the_exact_one():
    """Single and batched; its error is that of the slices, of second order in their distance."""
    rgb, alpha = PreIntegration(SIZE).slab(1.0, 2.0, jnp.ones(3), jnp.zeros(3), 0.5)
    assert rgb.shape == (3,) and alpha.shape == ()
    assert float(alpha) == pytest.approx(-np.expm1(-0.75), rel=1e-15)  # the longest is a slice
    rng = np.random.default_rng(0)
    tau = rng.uniform(0, 3, (2, 7, 50))
    inputs = (tau[0], tau[1, 0], rng.random((7, 50, 3)), rng.random(3), rng.uniform(0, 2, (7, 1)))
    slab = quick.jit(lambda integrator, *inputs: integrator.slab(*inputs), static_argnums=0)
    want = slab(Analytic(), *inputs)
    errors = []
    for n in (9, 33):
        got = slab(PreIntegration((2, 2, n)), *inputs)
        assert got[0].shape == (7, 50, 3) and got[1].shape == (7, 50)
        errors.append(max(np.mean(np.abs(x - y)) for x, y in zip(got, want, strict=True)))
    assert errors[0] > 12 * errors[1] and errors[1] < 3e-4
    got = PreIntegration((2, 2, 4), bits=8).slab(1.0, 2.0, jnp.ones(3), jnp.ones(3), 0.5)
    assert got[1] == pytest.approx(round(255 * -np.expm1(-0.75)) / 255)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"size": (2, 2)}, "three integers"),
        ({"size": (2, 1, 3)}, r"from \(2, 2, 3\) on, but is \(2, 1, 3\)"),
        ({"size": (2, 2, 2)}, "three integers"),
        ({"size": (8.0, 8, 8)}, "three integers"),
        ({"size": (1024, 1024, 512)}, "too large for 32-bit"),
        ({"scale": "cubic"}, "scale must be 'linear' or 'log', but is 'cubic'"),
        ({"schedule": "thirds"}, "schedule must be one of .* but is 'thirds'"),
        ({"bits": 12}, "bits must be None, 8 or 16, but is 12"),
    ],
)
def test_wrong_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        PreIntegration(**options)


@pytest.mark.parametrize("n", [6, 128])
def test_last_node_is_the_last_control_point(n):
    """These ends round so that low + (high - low) lies above high."""
    ends = [-0.3339630499555324, 0.0022911998550493307]
    tf = TransferFunction(ends, np.ones((2, 3)), [1.0, 1.0])
    got = colors_of(PreIntegration((n, n, 4)), tf, segment_of([(0.0022, 0.0022, 1.0)]))
    assert np.allclose(got[3], 1.0)
