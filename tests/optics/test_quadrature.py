"""Textbook rules: they converge to the exact slab, each with its order."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvr.optics import Analytic, Quadrature
from tests.optics.segments import TF, colors_of, random_segments
from tests.stand_ins import named


def error(rule, samples, depth):
    """Largest error of (w, w_back) over slabs up to an optical depth."""
    a, b = jnp.asarray(np.random.default_rng(0).uniform(0, depth, (2, 200)))
    got = jax.jit(Quadrature(rule, samples).weights)(a, b)
    return max(float(jnp.max(jnp.abs(x - y))) for x, y in zip(got, Analytic().weights(a, b)))


def test_gauss_converges_geometrically():
    errors = [error("gauss-legendre", n, 6.0) for n in (2, 4, 6, 8, 12)]
    ratios = np.array(errors[:-1]) / np.array(errors[1:])
    assert np.all(ratios > 20) and errors[-1] < 1e-12


@pytest.mark.parametrize("rule", ["trapezoid", "riemann"])
def test_trapezoid_and_riemann_are_of_second_order(rule):
    more = 1 if rule == "trapezoid" else 0  # as many steps
    errors = [error(rule, n + more, 6.0) for n in (8, 16, 32)]
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.1)
    assert errors[1] / errors[2] == pytest.approx(4, rel=0.05)


def test_whole_segments():
    segment = random_segments(200)
    got = colors_of(Quadrature(samples=24), TF, segment)
    assert np.allclose(got, colors_of(Analytic(), TF, segment), rtol=0, atol=2e-14)


@pytest.mark.parametrize("file", named("vectors/segment_vectors_public.npz", "vectors/slabs.npz"))
def test_slab_against_vectors(file_of, file):
    """Slabs of moderate depth: beyond, a fixed rule does not see where the light comes from."""
    data = np.load(file_of(file))
    depth = 0.5 * (data["tau_f"] + data["tau_b"]) * data["l"]
    rows = depth < 10
    assert rows.sum() > 1000
    inputs = [data[k][rows] for k in ("tau_f", "tau_b", "C_f", "C_b", "l")]
    rgb, alpha = jax.jit(Quadrature(samples=24).slab)(*inputs)
    largest = np.maximum(np.abs(inputs[2]), np.abs(inputs[3])).max(1)
    assert np.max(np.abs(alpha - data["alpha"][rows])) < 1e-15
    assert np.all(np.abs(rgb - data["rgb"][rows]).max(1) <= 1e-13 * largest)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"rule": "simpson"}, "rule must be one of .* but is 'simpson'"),
        ({"samples": 0}, "samples must be an integer >= 1, but is 0"),
        ({"samples": 2.0}, "samples must be an integer"),
        ({"rule": "trapezoid", "samples": 1}, "samples must be an integer >= 2, but is 1"),
    ],
)
def test_wrong_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        Quadrature(**options)
