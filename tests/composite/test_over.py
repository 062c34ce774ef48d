"""The over operator: thin, thick, and backwards."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvr.composite import Over, Piece
from jaxvr.composite.over import OverState

OVER = Over()


def piece(rgb, depth) -> Piece:
    """Light alone: `Over` sees nothing else."""
    return Piece(jnp.asarray(rgb), jnp.asarray(depth), None, None)


def fold(rgb, depth, over=OVER):
    """Pieces (N, 3, R) and (N, R), listed front to back, composited in that order or from
    behind."""

    def body(state, light):
        return over.add(state, piece(*light)), None

    start = over.init(depth.shape[1], depth.dtype)
    return jax.lax.scan(body, start, (rgb, depth), reverse=over.backwards)[0]


def pixels(state, over=OVER):
    return over.finish(state, None, None)


def require_derivative(rgb, depth, over):
    """`pull_back`, piece by piece, against the derivative of the whole by JAX."""
    weights = jnp.asarray(np.random.default_rng(1).normal(size=(4, 4)))

    def loss(rgb, depth):
        return jnp.sum(weights * pixels(fold(rgb, depth, over), over))

    want = jax.grad(loss, argnums=(0, 1))(rgb, depth)
    final, before = fold(rgb, depth, over), over.init(4, np.float64)
    bar: OverState = jax.grad(lambda s: jnp.sum(weights * pixels(s, over)))(final)
    for i in sorted(range(len(depth)), reverse=over.backwards):
        this = piece(rgb[i], depth[i])
        after = over.add(before, this)
        found, own = over.pull_back(this, before, after, final, bar)
        assert own is None
        assert np.allclose(found.rgb, want[0][i], atol=1e-15)
        assert np.allclose(found.optical_depth, want[1][i], atol=1e-14)
        before = after


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
    got = np.asarray(pixels(fold(rgb, depth)))
    assert np.max(np.abs(got[:3] / want - 1)) < 1e-6
    assert np.max(np.abs(got[3] / -np.expm1(-depth.sum(0, dtype=np.float64)) - 1)) < 5e-7


@pytest.mark.parametrize("opaque", [None, 1e4])
def test_pull_back_is_the_derivative_even_behind_an_opaque_piece(opaque):
    rgb, depth = pieces(0.2, n=12, dtype=np.float64)
    if opaque:
        depth[5] = opaque
    require_derivative(rgb, depth, OVER)
