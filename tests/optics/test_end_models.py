"""Integrators that look at the two ends of a segment only."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import quick

from jaxvr.optics import Analytic, AverageColor, ConstantExtinction, Segment, TransferFunction
from tests.optics.segments import (
    CASES,
    TF,
    check_slopes,
    colors_of,
    random_segments,
    segment_of,
    traced_colors_of,
)

MODELS = [AverageColor(), ConstantExtinction()]
model = pytest.mark.parametrize("model", MODELS, ids=lambda m: type(m).__name__)


def expected(model, tf, segment):
    """rgb and depth (4, R) in the model's own optics, with the colour taken numerically."""
    (c_f, tau_f), (c_b, tau_b) = ([np.asarray(x) for x in tf(s)] for s in segment[:2])
    depth = (0.5 * (tau_f + tau_b) * np.asarray(segment.length))[:, None]
    if isinstance(model, AverageColor):
        rgb = 0.5 * (c_f + c_b) * -np.expm1(-depth)
    else:
        x, w = np.polynomial.legendre.leggauss(60)
        t = (x + 1) / 2
        color = c_f[:, None] + t[None, :, None] * (c_b - c_f)[:, None]
        emitted = 0.5 * w[None] * depth * np.exp(-depth * t[None])
        rgb = np.sum(color * emitted[..., None], 1)
    return np.concatenate([rgb, depth], 1).T


@model
def test_colors_are_those_of_the_ends(model):
    """Also outside the control points, and at the jump, where the upper side counts."""
    for segment in (segment_of(CASES), random_segments(len(CASES))):
        got = colors_of(model, TF, segment)
        assert np.allclose(got, expected(model, TF, segment), rtol=1e-13, atol=1e-15)


@model
def test_ends_at_a_jump_take_the_upper_side(model):
    above = 0.5 + 1e-12
    at = segment_of([(0.5, 0.7, 1.0), (0.7, 0.5, 1.0), (0.4, 0.5, 1.0), (0.5, 0.4, 1.0)])
    near = segment_of([(above, 0.7, 1.0), (0.7, above, 1.0), (0.4, above, 1.0), (above, 0.4, 1.0)])
    assert np.allclose(colors_of(model, TF, at), colors_of(model, TF, near), atol=1e-10)


@model
def test_slab(model):
    """Black in front of white, so that the colour is the back weight."""
    depth = np.array([0.0, 1e-9, 0.3, 0.6, 5.0, 800.0])
    rgb, alpha = model.slab(2 * depth, 0 * depth, jnp.zeros(3), jnp.ones(3), 1.0)
    assert np.allclose(alpha, -np.expm1(-depth), rtol=1e-14, atol=0)
    if isinstance(model, AverageColor):
        want = -np.expm1(-depth) / 2
    else:
        safe = np.where(depth > 1e-6, depth, 1)
        want = np.where(depth > 1e-6, -np.expm1(-safe) / safe - np.exp(-safe), depth / 2)
    assert np.allclose(rgb[:, 0], want, rtol=1e-8, atol=0)
    assert np.allclose(rgb[2:, 0], want[2:], rtol=1e-14, atol=0)


@pytest.mark.parametrize("dtype, bound", [("float64", 3e-15), ("float32", 1e-6)])
def test_back_weight_of_constant_extinction_has_no_cancellation(dtype, bound):
    """sum_n (-1)^n S^(n + 1) (n + 1) / (n + 2)! for thin segments, (1 - exp(-S)) / S - exp(-S) for
    others; both in extended precision."""
    depth = np.geomspace(1e-12, 60.0, 3000).astype(dtype)
    got = ConstantExtinction().weights(jnp.asarray(depth), jnp.asarray(depth))[1]
    s = depth.astype(np.longdouble)
    term, series = s / 2, 0
    for n in range(40):
        series = series + term
        term = -term * s * (n + 2) / ((n + 1) * (n + 3))
    want = np.where(s < 1, series, -np.expm1(-s) / s - np.exp(-s))
    assert np.max(np.abs(np.asarray(got) / want - 1)) < bound


@model
def test_a_peak_between_the_ends_is_invisible(model):
    peak = TransferFunction(
        np.array([0.0, 0.4, 0.5, 0.6, 1.0]), np.ones((5, 3)), np.array([0.0, 0.0, 9.0, 0.0, 0.0])
    )
    segment = segment_of([(0.1, 0.9, 1.0), (0.9, 0.1, 1.0)])
    assert np.all(np.asarray(colors_of(model, peak, segment)) == 0)
    assert np.all(np.asarray(colors_of(Analytic(), peak, segment))[0] > 0.5)


@model
def test_gradients_with_respect_to_everything(model):
    """Segments inside, outside, and in part so; both points of the jump move together. One is
    thin, where the weights are a series."""
    cases = [(0.23, 0.71, 1.9), (0.76, 0.17, 0.9), (-0.3, 0.47, 0.01), (0.91, 1.4, 1.1)]

    def colors(move, tf_colors, extinctions, front, back, length):
        positions = TF.positions + jnp.array([0.3, 1.0, 2.0, 2.0, -1.0]) * move
        tf = TransferFunction(positions, tf_colors, extinctions)
        table = model.prepare(tf, "float64", 2.0)
        segment = Segment(front, back, length)
        return model.step(table, segment, model.start(table, front))[:2]

    args = (jnp.array(0.0), TF.colors, TF.extinctions, *segment_of(cases))
    check_slopes(colors, args, rtol=1e-8)


@model
def test_gradients_are_finite_without_length_or_extinction(model):
    tf = TF.replace(extinctions=jnp.zeros(5))
    segment = segment_of([(0.2, 0.7, 0.0), (0.4, 0.4, 1.0), (0.5, 0.5, 0.0)])
    slopes = quick.jit(jax.grad(lambda *x: jnp.sum(traced_colors_of(model, *x)), argnums=(0, 1)))(
        tf, segment
    )
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(slopes))
    assert np.max(np.abs(slopes[0].extinctions)) > 0.1
