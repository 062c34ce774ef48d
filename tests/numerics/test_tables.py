"""Tables of the slab's integral: against the moments, over sixteen decades and their limits."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvr.numerics import moments, tables

DEPTHS = np.concatenate([[0.0], np.geomspace(1e-8, 1e8, 81)])
A, B = (x.ravel() for x in np.meshgrid(DEPTHS, DEPTHS, indexing="ij"))
SIZES = (64, 128, 256)


def with_slopes(weights, a, b):
    """alpha, w_back and the slopes of w_back by a and b, (4, N)."""

    @jax.jit
    def all_of(a, b):
        (alpha, back), pull = jax.vjp(weights, a, b)
        return jnp.stack([alpha, back, *pull((jnp.zeros_like(a), jnp.ones_like(a)))])

    return np.asarray(all_of(jnp.asarray(a), jnp.asarray(b)), np.float64)


@functools.cache
def exact(dtype):
    """The same of the exact weights, in float64, and the scale of each: slopes are differences of
    positive terms, and cross 0."""
    a, b = (x.astype(dtype).astype(np.float64) for x in (A, B))
    want = with_slopes(moments.emission_weights, a, b)
    _, b_1, b_2 = (np.asarray(x) for x in moments.bernstein_moments(jnp.asarray(a), jnp.asarray(b)))
    return want, np.stack([want[0], want[1], (b_1 + b_2) / 2, b_2 / 2])


@functools.cache
def smooth(size, dtype):
    return with_slopes(
        functools.partial(tables.smooth_weights, size=size), A.astype(dtype), B.astype(dtype)
    )


def errors(size, dtype):
    """Largest relative errors (4,) over the grid; what should be 0 must be 0."""
    want, scale = exact(dtype)
    assert np.all(smooth(size, dtype)[scale == 0] == 0)
    return np.max(np.abs(smooth(size, dtype) - want) / np.where(scale > 0, scale, 1), 1)


@pytest.mark.parametrize(
    "size, dtype, bounds",
    [
        (64, "float64", (1e-4, 2e-4, 5e-3)),
        (128, "float64", (4e-6, 5e-6, 6e-5)),
        (256, "float64", (2e-7, 3e-7, 3e-6)),
        (256, "float32", (1e-6, 1e-6, 4e-6)),
    ],
)
def test_smooth_table_is_relatively_accurate_everywhere(size, dtype, bounds):
    """w_back, and its slopes of the moments that they are made of."""
    alpha, *others = errors(size, dtype)
    assert alpha < 4 * np.finfo(dtype).eps
    assert np.all(np.array(others) < bounds)


def test_smooth_table_converges_with_the_fourth_power():
    error = [errors(size, "float64")[1] for size in SIZES]
    assert error[0] > 12 * error[1] > 144 * error[2]


def test_smooth_table_in_its_limits():
    """Thin: w_back = a / 6 + b / 3. Thick: 1 / a for a clear back, sqrt(pi / (2 b)) for a clear
    front. At b = 0 the spline itself has an infinite slope, the weight has not."""
    a = np.array([1e-10, 0, 2e-10, 0, 1e7, 1e14, 0, 1e14, 0.5])
    b = np.array([0, 1e-10, 1e-10, 0, 0, 0, 1e14, 1e14, 0])
    got = with_slopes(functools.partial(tables.smooth_weights, size=128), a, b)
    assert np.isfinite(got).all()
    alpha, back, by_a, by_b = got
    assert np.allclose(alpha[:4], (a + b)[:4] / 2, rtol=1e-9, atol=0)
    assert np.allclose(back[:4], (a / 6 + b / 3)[:4], rtol=1e-9, atol=0)
    assert np.allclose([by_a[:4], by_b[:4]], [[1 / 6], [1 / 3]], rtol=1e-9)
    assert np.all(alpha[4:8] == 1)
    thick = [1e-7, 1e-14, np.sqrt(np.pi / 2) * 1e-7, 1e-14]
    assert np.allclose(back[4:8], thick, rtol=1e-6, atol=0)
    far = tables.smooth_weights(jnp.array([1e20, 1e30, 0.0]), jnp.array([1.0, 1.0, 1e60]), 128)
    assert np.all(far[0] == 1) and np.all(far[1] < 1e-11)
    assert np.allclose(got[:, 8:], with_slopes(moments.emission_weights, a[8:], b[8:]), rtol=1e-5)


def test_forward_mode_is_the_transpose_of_reverse_mode():
    @jax.jit
    def slope(a, b):
        ones = jnp.ones_like(a)
        return jax.jvp(lambda a, b: tables.smooth_weights(a, b, 64)[1], (a, b), (ones, 3 * ones))[1]

    _, _, by_a, by_b = smooth(64, "float64")
    found = slope(jnp.asarray(A), jnp.asarray(B))
    assert np.all(np.abs(found - by_a - 3 * by_b) <= 1e-14 * (np.abs(by_a) + np.abs(by_b)))


def test_table_of_psi_holds_psi():
    table = tables.psi_table(33)
    gamma = np.arange(32) / 32
    a, b = (jnp.asarray(x) for x in np.meshgrid(*[gamma / (1 - gamma)] * 2, indexing="ij"))
    assert np.max(np.abs(table[:-1, :-1] / np.asarray(moments.psi(a, b)) - 1)) < 2e-15
    assert np.all(table[-1] < 1e-40) and np.all(table[:, -1] < 1e-40)


@pytest.mark.parametrize(
    "size, nearest, overall, moderate",
    [
        (128, False, 2.8e-2, 5.8e-4),
        (512, False, 1.4e-2, 3.6e-5),
        (128, True, 7.9e-2, 5.2e-2),
        (512, True, 4.0e-2, 1.4e-2),
    ],
)
def test_errors_of_the_gamma_table(size, nearest, overall, moderate):
    """Absolute everywhere, which falls with the root of the size only, and relative for a, b <= 10.
    Bilinear as measured before; they are errors of the method, so more accurate is wrong too."""
    rng = np.random.default_rng(0)
    a, b = (jnp.asarray(10 ** rng.uniform(-3, 8, 40_000), jnp.float32) for _ in "ab")
    want = np.asarray(moments.psi(a.astype("float64"), b.astype("float64")))
    got = jax.jit(tables.gamma_psi, static_argnums=(2, 3))(a, b, size, nearest)
    error = np.abs(np.asarray(got) - want)
    small = np.asarray((a <= 10) & (b <= 10))
    assert 0.8 * overall < error.max() < 1.02 * overall
    assert 0.8 * moderate < (error / want)[small].max() < 1.02 * moderate


def test_gamma_weights_are_those_of_psi():
    gamma = np.array([0.25, 0.5, 0.75])  # nodes of a table of 5
    a, b = jnp.asarray(gamma / (1 - gamma)), jnp.asarray((gamma / (1 - gamma))[::-1])
    for nearest in (False, True):
        got = tables.gamma_weights(a, b, 5, nearest)
        assert np.allclose(got, moments.emission_weights(a, b), rtol=1e-14)


def test_tables_are_the_same_without_x64():
    """They are made in NumPy's float64 and rounded once."""
    want = tables.psi_table(17), tables.moment_splines(17)
    thin = [np.float32(x) for x in (1e-6, 3.0)]
    try:
        jax.config.update("jax_enable_x64", False)
        tables.psi_table.cache_clear()
        tables.moment_splines.cache_clear()
        found = tables.psi_table(17), tables.moment_splines(17)
        a, b = jnp.asarray(A, jnp.float32), jnp.asarray(B, jnp.float32)
        alpha, back = jax.jit(tables.smooth_weights, static_argnums=2)(a, b, 256)
        psi = jax.jit(tables.gamma_psi, static_argnums=(2, 3))(*map(jnp.asarray, thin), 512, False)
    finally:
        jax.config.update("jax_enable_x64", True)
    assert all(np.array_equal(x, y) for x, y in zip(want, found))
    assert alpha.dtype == back.dtype == psi.dtype == np.float32
    assert np.allclose(back, smooth(256, "float32")[1], rtol=5e-7, atol=0)
    assert float(psi) == pytest.approx(float(moments.psi(*(jnp.float64(x) for x in thin))), 4e-5)
