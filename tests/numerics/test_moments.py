"""The slab's moments: against an independent quadrature, and by finite differences."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxvr.numerics import moments, rules

EDGES = [0.0, 1e-30, 1e-6, 1e-2, 0.5, 3.0, 25.0, 60.0, 800.0, 1e4, 1e6]


def reference(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """B0, B1, B2 in extended precision: composite Gauss-Legendre on the visible part."""
    x, w = np.polynomial.legendre.leggauss(24)
    x, w = (x + 1) / 2, w / 2
    out = np.zeros((3, a.size), np.longdouble)
    for i, (ai, bi) in enumerate(zip(a.astype(np.longdouble), b.astype(np.longdouble))):
        depth = 60.0
        root = ai + np.sqrt(max(ai * ai + 2 * depth * (bi - ai), 0))
        end = min(1.0, 2 * depth / root) if root > 0 else 1.0
        for k in range(32):
            t = end * (k + x.astype(np.longdouble)) / 32
            weight = end * w / 32 * np.exp(-(ai * t + (bi - ai) * t * t / 2))
            out[:, i] += [
                (weight * (1 - t) ** 2).sum(),
                (weight * 2 * t * (1 - t)).sum(),
                (weight * t * t).sum(),
            ]
    return out


def pairs() -> tuple[np.ndarray, np.ndarray]:
    a, b = (x.ravel() for x in np.meshgrid(EDGES, EDGES))
    rng = np.random.default_rng(0)
    more = 10 ** rng.uniform(-6, 4, (2, 300))
    near = more[0, :50] * (1 + 1e-9)
    return np.concatenate([a, more[0], more[0, :50]]), np.concatenate([b, more[1], near])


@pytest.mark.parametrize("dtype, bound", [("float64", 3e-15), ("float32", 6e-7)])
def test_moments_are_relatively_accurate_everywhere(dtype, bound):
    a, b = (x.astype(dtype) for x in pairs())
    got = np.stack(moments.bernstein_moments(jnp.asarray(a), jnp.asarray(b), 2))
    want = reference(a, b)
    floor = 1e-30  # B1 and B2 of a slab of depth 1e6 come near float32's smallest number
    assert np.max(np.abs(got - want) / (want + floor)) < bound


@pytest.mark.parametrize("dtype, bound", [("float64", 1e-15), ("float32", 4e-7)])
def test_weights_sum_to_opacity_and_stay_below_one(dtype, bound):
    a, b = (x.astype(dtype) for x in pairs())
    weights = moments.emission_weights(jnp.asarray(a), jnp.asarray(b))
    alpha, back = (np.asarray(x) for x in weights)
    exact = -np.expm1(-(a.astype(np.longdouble) + b) / 2)
    assert np.max(np.abs(alpha - exact)) < bound
    assert np.all((back >= 0) & (back <= alpha) & (alpha <= 1))
    thin = exact > 0
    assert np.max(np.abs(alpha[thin] / exact[thin] - 1)) < 4 * bound


def test_infinite_and_huge_depths_are_finite():
    for dtype in (jnp.float32, jnp.float64):
        a = jnp.array([jnp.inf, 0.0, jnp.inf, 1e30], dtype)
        b = jnp.array([0.0, jnp.inf, jnp.inf, 1e30], dtype)
        value, pull = jax.vjp(moments.emission_weights, a, b)
        assert all(np.isfinite(x).all() for x in (*value, *pull(value)))


def test_derivatives_of_second_order_in_both_modes():
    a, b = jnp.array([0.0, 1e-3, 0.7, 4.0, 4.0]), jnp.array([0.3, 2e-3, 0.7, 0.1, 4.0 + 1e-9])
    check_grads(moments.emission_weights, (a + 1e-3, b), order=2, modes=["fwd", "rev"], rtol=1e-6)


def test_derivative_of_opacity_keeps_its_digits():
    for dtype, eps in ((jnp.float32, 3e-7), (jnp.float64, 1e-15)):
        depth = jnp.array([1e-6, 1.0, 30.0, 80.0], dtype)
        slope = np.asarray(jax.vmap(jax.grad(moments.opacity))(depth))
        want = np.exp(-np.asarray(depth, np.longdouble))
        assert np.max(np.abs(slope / want - 1)) < 40 * eps


def test_psi_of_a_constant_slab():
    a = jnp.array([1e-3, 1.0, 50.0])
    assert np.allclose(moments.psi(a, a), -np.expm1(-a) / a, rtol=1e-14)


@pytest.mark.parametrize(
    "rule, value, by_a, by_b, back",
    [(rules.FAST, 8.5e-6, 2.3e-5, 9.2e-5, 1.6e-5), (rules.DRAFT, 4.7e-4, 1.3e-3, 3.1e-3, 4.3e-4)],
    ids=["fast", "draft"],
)
def test_small_rules_err_as_they_say(rule, value, by_a, by_b, back, dtype):
    """Relative errors of psi and its slopes, and what is left of them in the weights of colours:
    alpha is exact whatever the rule, and w_back errs relative to 1."""
    a, b = (jnp.asarray(x.astype(dtype)) for x in pairs())

    def all_of(a, b, rule):
        psi, pull = jax.vjp(lambda a, b: moments.bernstein_moments(a, b, 0, rule)[0], a, b)
        weights, by = jax.vjp(lambda a, b: moments.emission_weights(a, b, rule)[1], a, b)
        alpha = moments.emission_weights(a, b, rule)[0]
        slopes = *pull(jnp.ones_like(a)), *by(jnp.ones_like(a))
        return jnp.stack([psi, *slopes[:2], alpha, weights, *slopes[2:]])

    all_of = jax.jit(all_of, static_argnums=2)
    got = np.asarray(all_of(a, b, rule), np.float64)
    want = np.asarray(all_of(a.astype("float64"), b.astype("float64"), None))
    wrong = np.abs(got - want)
    relative = np.max(wrong[:3] / (np.abs(want[:3]) + 1e-30), axis=1)
    rounding = 1e-7 if dtype == "float32" else 0
    assert np.all(relative <= np.array([value, by_a, by_b]) + rounding)
    assert np.all(relative >= 0.5 * np.array([value, by_a, by_b]))  # it is this rule
    exact = -np.expm1(-(np.asarray(a, np.float64) + np.asarray(b, np.float64)) / 2)
    assert np.allclose(got[3], exact, rtol=2e-15 + 4 * rounding, atol=0)
    assert np.max(wrong[4]) < back
    assert np.all((got[4] >= 0) & (got[4] <= got[3]))
    # slopes of w_back are half those of the moments, beside the transmittance
    assert np.all(wrong[5] <= (by_a + 3 * rounding) * np.abs(want[1]) + 2 * rounding + 1e-15)
    assert np.all(wrong[6] <= (by_b + 3 * rounding) * np.abs(want[2]) + 2 * rounding + 1e-15)


@pytest.mark.parametrize("rule", [rules.FAST, rules.DRAFT], ids=["fast", "draft"])
def test_small_rules_are_exact_for_thin_slabs(rule):
    a, b = jnp.array([0.0, 1e-9, 0.0, 2e-9]), jnp.array([0.0, 0.0, 1e-9, 1e-9])
    (alpha, back), pull = jax.vjp(lambda a, b: moments.emission_weights(a, b, rule), a, b)
    assert np.allclose(alpha, (a + b) / 2, rtol=2e-9, atol=0)
    assert np.allclose(back, a / 6 + b / 3, rtol=2e-9, atol=0)
    by_a, by_b = pull((jnp.zeros(4), jnp.ones(4)))
    assert np.allclose(by_a, 1 / 6, rtol=1e-8) and np.allclose(by_b, 1 / 3, rtol=1e-8)
