"""Exact arithmetic against rational numbers."""

from __future__ import annotations

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvr.numerics import compensated
from jaxvr.numerics.exact import edge_side, halves, split, two_product, two_sum


def numbers(dtype, n=4000, seed=0):
    rng = np.random.default_rng(seed)
    return (rng.normal(size=n) * 10.0 ** rng.integers(-6, 6, n)).astype(dtype)


def test_sum_product_and_split_are_exact(dtype):
    a, b = numbers(dtype, seed=1), numbers(dtype, seed=2)

    @jax.jit
    def all_of(a, b):
        return *two_sum(a, b), *two_product(halves(a), halves(b)), *split(a)

    s, e, p, q, high, low = (np.asarray(x) for x in all_of(a, b))
    for i in range(0, a.size, 7):
        x, y = Fraction(float(a[i])), Fraction(float(b[i]))
        assert Fraction(float(s[i])) + Fraction(float(e[i])) == x + y
        assert Fraction(float(p[i])) + Fraction(float(q[i])) == x * y
        assert Fraction(float(high[i])) + Fraction(float(low[i])) == x
    assert np.array_equal((high * high).astype(np.longdouble), high.astype(np.longdouble) ** 2)


def edges(dtype):
    """Pairs of points: random ones, ones on a line with the origin, and nearly so."""
    rng = np.random.default_rng(3)
    lattice = rng.integers(-6, 7, (4, 3000)) * 0.1
    free = rng.normal(size=(4, 1000))
    k = rng.normal(size=1000)
    p = rng.normal(size=(2, 1000)).astype(dtype)
    near = np.stack([p[0], p[1], (k * p[0]).astype(dtype), (k * p[1]).astype(dtype)])
    return np.concatenate([lattice, free, near], 1).astype(dtype)


def side(points, first):
    xi, yi, xj, yj = (halves(x) for x in points)
    return edge_side(xi, yi, xj, yj, first)


def test_side_of_an_edge_is_always_right(dtype):
    points = edges(dtype)
    area, positive = (np.asarray(x) for x in jax.jit(side)(jnp.asarray(points), True))
    eps = float(np.finfo(dtype).eps)
    for i in range(points.shape[1]):
        xi, yi, xj, yj = (Fraction(float(v)) for v in points[:, i])
        exact = xi * yj - xj * yi
        if exact:
            assert positive[i] == (exact > 0)
            assert abs(Fraction(float(area[i])) - exact) <= 2 * eps * abs(exact)
        else:
            assert area[i] == 0
            shifted = (yi - yj) or (xj - xi) or (xi if xi > 0 else -1)
            assert positive[i] == (shifted > 0)


def test_swapping_the_ends_flips_the_side(dtype):
    points = jnp.asarray(edges(dtype))
    for first in (True, False):
        there = jax.jit(side)(points, first)[1]
        back = jax.jit(side)(points[jnp.array([2, 3, 0, 1])], not first)[1]
        assert np.array_equal(there, ~np.asarray(back))


def test_other_kernels_give_the_same_bits(dtype):
    """Alone, inside a loop, and with neighbours to fuse with: no dependence on FMA."""
    points = jnp.asarray(edges(dtype))
    plain = jax.jit(side)(points, True)

    def looped(points):
        def body(i, carry):
            area, _ = side(points * (1 + 0 * i), True)
            return area, area + carry[1] * 3

        start = jnp.zeros(points.shape[1], points.dtype)
        return jax.lax.fori_loop(0, 2, body, (start, start))[0]

    one_by_one = [side(points[:, i : i + 1], True)[0] for i in range(0, 4500, 500)]
    assert np.array_equal(plain[0], jax.jit(looped)(points))
    assert np.array_equal(plain[0][:4500:500], np.concatenate(one_by_one))


@pytest.mark.parametrize("size", [1e-8, 0.1])
def test_compensated_sum_keeps_all_digits(size):
    def body(total, x):
        return compensated.add(total, x), None

    xs = jnp.full(100_000, size, jnp.float32)
    total, _ = jax.lax.scan(body, (jnp.float32(0), jnp.float32(0)), xs)
    exact = 100_000 * float(np.float32(size))
    assert abs(float(compensated.value(total)) / exact - 1) < 1.2e-7
    assert float(compensated.exp_minus(total)) == pytest.approx(np.exp(-exact), rel=3e-7, abs=1e-38)


def test_difference_of_sums_knows_the_excess():
    a = compensated.add((jnp.float32(1.0), jnp.float32(0.0)), jnp.float32(1e-9))
    b = (jnp.float32(1.0), jnp.float32(0.0))
    assert float(compensated.difference(a, b)) == pytest.approx(1e-9, rel=1e-6)
