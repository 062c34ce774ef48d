"""The over operator: thin, thick, and backwards."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvr.composite import Over


def fold(rgb, depth):
    """Pieces (N, 3, R) and (N, R) composited front to back."""
    over = Over()

    def body(state, piece):
        return over.add(state, *piece), None

    state, _ = jax.lax.scan(body, over.start(depth.shape[1], depth.dtype), (rgb, depth))
    return state


def pieces(size, n=200, dtype: Any = np.float32):
    rng = np.random.default_rng(0)
    depth = rng.uniform(0, 2 * size, (n, 4)).astype(dtype)
    color = rng.uniform(0, 1, (n, 3, 4)).astype(dtype)
    return (color * -np.expm1(-depth.astype(np.float64))[:, None]).astype(dtype), depth


@pytest.mark.parametrize("size", [1e-8, 1e-3, 0.05, 5.0])
def test_float32_keeps_its_digits_from_thin_to_opaque(size):
    rgb, depth = pieces(size)
    before = np.cumsum(depth, 0, dtype=np.float64) - depth
    want = (np.exp(-before)[:, None] * rgb).sum(0)
    got = np.asarray(Over().finish(fold(rgb, depth)))
    assert np.max(np.abs(got[:3] / want - 1)) < 1e-6
    assert np.max(np.abs(got[3] / -np.expm1(-depth.sum(0, dtype=np.float64)) - 1)) < 5e-7


@pytest.mark.parametrize("opaque", [None, 1e4])
def test_pull_back_is_the_derivative_even_behind_an_opaque_piece(opaque):
    rgb, depth = pieces(0.2, n=12, dtype=np.float64)
    if opaque:
        depth[5] = opaque
    over = Over()
    weights = jnp.asarray(np.random.default_rng(1).normal(size=(4, 4)))

    def loss(rgb, depth):
        return jnp.sum(weights * over.finish(fold(rgb, depth)))

    want = jax.grad(loss, argnums=(0, 1))(rgb, depth)
    final, before = fold(rgb, depth), over.start(4, np.float64)
    for i in range(12):
        after = over.add(before, jnp.asarray(rgb[i]), jnp.asarray(depth[i]))
        rgb_bar, depth_bar = over.pull_back(before, after, final, weights)
        assert np.allclose(rgb_bar, want[0][i], atol=1e-15)
        assert np.allclose(depth_bar, want[1][i], atol=1e-14)
        before = after
