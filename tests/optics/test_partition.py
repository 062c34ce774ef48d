"""Segments cut at control points: values, derivatives, jumps, and cursors that are lost."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import quick
from jax.test_util import check_grads

from jaxvr.optics import Analytic, Quadrature, Segment, TransferFunction
from jaxvr.optics.partition import Cursor
from tests.optics.segments import CASES, TF, check_slopes, integrate, segment_of

compiled = quick.jit(integrate, static_argnums=0)


def sampled(tf: TransferFunction, front, back, length, n=20001):
    """rgb and depth of one segment by midpoint sampling of the transfer function itself."""
    s = front + (back - front) * (np.arange(n) + 0.5) / n
    color, tau = (np.asarray(x) for x in tf(s))
    depth = tau * length / n
    before = np.concatenate([[0], np.cumsum(depth)[:-1]])
    weight = np.exp(-before) * -np.expm1(-depth)
    return (weight[:, None] * color).sum(0), depth.sum()


@pytest.mark.parametrize(
    "integrator", [Analytic(), Quadrature(samples=24)], ids=lambda i: type(i).__name__
)
def test_pieces_add_up_to_the_segment(integrator, dtype):
    segment = segment_of(CASES, dtype)
    tf = TF.astype(dtype)
    rgb, depth, done = compiled(integrator, tf, segment)
    assert np.all(done)
    for i, case in enumerate(CASES):
        front, back, length = (float(x[i]) for x in segment)
        want_rgb, want_depth = sampled(tf.astype("float64"), front, back, length)
        if case[:2] in ((0.3, 0.5), (0.5, 0.3)):  # the sampled end may see the other side
            want_rgb, want_depth = sampled(tf.astype("float64"), 0.3, 0.5 - 1e-9, length)
            if case[0] > case[1]:
                want_rgb, want_depth = sampled(tf.astype("float64"), 0.5 - 1e-9, 0.3, length)
        assert np.allclose(rgb[:, i], want_rgb, atol=3e-4), case
        assert np.allclose(depth[i], want_depth, atol=3e-4), case


def test_a_lost_cursor_finds_its_slab():
    segment = segment_of(CASES, "float64")
    right = integrate_all(None, segment)
    for slab in (0, 2, 5):
        lost = Cursor(segment.front, jnp.full(len(CASES), slab, jnp.int32))
        assert np.allclose(integrate_all(lost, segment), right, atol=1e-15)


def integrate_all(start, segment):
    rgb, depth, done = compiled(Analytic(), TF, segment, start)
    assert np.all(done)
    return np.concatenate([rgb, depth[None]])


def test_gradients_with_respect_to_everything():
    """Away from kinks, against finite differences; both points of the jump move together."""
    segment = segment_of([(0.2, 0.7, 2.0), (0.75, 0.15, 1.0), (0.45, 0.52, 3.0)], "float64")

    def colors_and_depths(move, colors, extinctions, front, back, length):
        positions = TF.positions + jnp.array([0.0, 1.0, 2.0, 2.0, -1.0]) * move
        tf = TransferFunction(positions, colors, extinctions)
        return integrate(Analytic(), tf, Segment(front, back, length))[:2]

    args = (jnp.array(0.0), TF.colors, TF.extinctions, *segment)
    check_slopes(colors_and_depths, args, rtol=1e-6)


def test_constant_scalars_have_finite_gradients_in_both_precisions(dtype):
    segment = segment_of([(0.4, 0.4, 1.0), (0.5, 0.5, 1.0), (0.3, 0.3, 1.0)], dtype)

    def loss(tf, segment):
        rgb, depth, _ = integrate(Analytic(), tf, segment)
        return rgb.sum() + depth.sum()

    grads = quick.jit(jax.grad(loss, argnums=(0, 1)))(TF.astype(dtype), segment)
    assert all(np.isfinite(g).all() for g in jax.tree.leaves(grads))
    assert float(jnp.abs(grads[0].extinctions).sum()) > 0


def test_slab_accepts_single_and_batched_slabs():
    rgb, alpha = Analytic().slab(1.0, 2.0, jnp.ones(3), jnp.zeros(3), 0.5)
    assert rgb.shape == (3,) and alpha.shape == ()
    assert float(alpha) == pytest.approx(-np.expm1(-0.75), rel=1e-15)
    many, _ = Analytic().slab(jnp.ones((4, 1)), jnp.ones(5), jnp.ones((4, 1, 3)), jnp.ones(3), 1.0)
    assert many.shape == (4, 5, 3)
    check, _ = Quadrature(samples=30).slab(1.0, 2.0, jnp.ones(3), jnp.zeros(3), 0.5)
    assert np.allclose(rgb, check, atol=1e-14)


def test_slab_is_differentiable_twice():
    def loss(tau_f, tau_b, c_f, c_b, length):
        rgb, alpha = Analytic().slab(tau_f, tau_b, c_f, c_b, length)
        return jnp.sum(rgb**2) + alpha

    args = (jnp.array(0.7), jnp.array(2.0), jnp.array([0.1, 0.5, 0.9]), jnp.ones(3), jnp.array(1.3))
    check_grads(loss, args, order=2, modes=["fwd", "rev"], rtol=1e-6)
