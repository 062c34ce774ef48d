"""Partial pre-integration: its two ways to find crossings, and the errors of its tables."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import quick

from jaxvr.optics import Analytic, PartialPreIntegration, TransferFunction
from tests.optics.segments import (
    CASES,
    TF,
    colors_of,
    random_segments,
    segment_of,
    traced_colors_of,
)

# Without jumps, and with two control points so close that they share a texel.
CLOSE = TransferFunction(
    np.array([0.1, 0.3, 0.301, 0.5, 0.8]), np.asarray(TF.colors), np.asarray(TF.extinctions)
)


SPECIAL = segment_of(CASES + [(0.301, 0.1, 1.0), (0.8, 0.3, 2.0), (0.1, 0.1, 1.0), (0.8, 0.8, 1.0)])
RANDOM = random_segments(len(SPECIAL.front))


@functools.partial(quick.jit, static_argnums=0)
def slopes(integrator, tf, segment):
    """The derivative of a projection of rgb and depth by everything."""

    def projected(tf, segment):
        out = traced_colors_of(integrator, tf, segment)
        return jnp.sum(out * jnp.cos(jnp.arange(out.size)).reshape(out.shape))

    return jax.grad(projected, argnums=(0, 1))(tf, segment)


@pytest.mark.parametrize("texels", [1, 2, 512])
def test_a_texture_changes_nothing(texels):
    """Rising, falling and constant, from and to control points, and across jumps. In one or two
    texels, most slabs are not in the texture."""
    texture = PartialPreIntegration(crossings="texture", texture_size=texels)
    for tf in (TF, CLOSE):
        for segment in (SPECIAL, RANDOM):
            want = colors_of(PartialPreIntegration(), tf, segment)
            assert np.allclose(colors_of(texture, tf, segment), want, rtol=1e-13, atol=1e-15)


def test_one_control_point_has_a_texture_too():
    tf = TransferFunction(np.array([0.4]), np.array([[0.2, 0.5, 0.9]]), np.array([2.0]))
    segment = random_segments(40)
    got = colors_of(PartialPreIntegration(64, crossings="texture"), tf, segment)
    depth = 2 * np.asarray(segment.length)
    assert np.allclose(got[3], depth, rtol=1e-14)
    assert np.allclose(got[:3], -np.expm1(-depth) * np.array([[0.2], [0.5], [0.9]]), rtol=1e-13)


@pytest.mark.parametrize(
    "size, lookup, bound",
    [
        (128, "bicubic", 3e-7),
        (512, "bilinear", 1e-5),
        (128, "bilinear", 2e-4),
        (512, "nearest", 5e-3),
    ],
)
def test_error_of_whole_segments(size, lookup, bound):
    """The depth is exact whatever the table; the colour errs with it, and not much less."""
    segment = random_segments(200)
    got = colors_of(PartialPreIntegration(size, lookup), TF, segment)
    want = colors_of(Analytic(), TF, segment)
    assert np.allclose(got[3], want[3], rtol=1e-13)
    error = np.max(np.abs(got[:3] - want[:3]))
    assert bound / 20 < error < bound


@pytest.mark.parametrize(
    "options, message",
    [
        ({"lookup": "cubic"}, "lookup must be one of .* but is 'cubic'"),
        ({"table_size": 3}, "table_size must be an integer >= 4, but is 3"),
        ({"table_size": 64.0}, "table_size must be an integer"),
        ({"crossings": "both"}, "crossings must be 'slab' or 'texture', but is 'both'"),
        ({"texture_size": 0}, "texture_size must be an integer >= 1, not 0"),
        ({"texture_size": None}, "texture_size must be an integer"),
    ],
)
def test_wrong_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        PartialPreIntegration(**options)


@pytest.mark.parametrize("texels", [1, 512, 513])
def test_a_texture_keeps_derivatives_of_jumps(texels):
    want = slopes(PartialPreIntegration(), TF, RANDOM)
    got = slopes(PartialPreIntegration(crossings="texture", texture_size=texels), TF, RANDOM)
    for x, y in zip(jax.tree.leaves(want), jax.tree.leaves(got), strict=True):
        assert np.allclose(x, y, rtol=1e-10, atol=1e-12)
