"""Tables of the slab integral: Moreland and Angel's psi, and a smoother one.

Moreland and Angel 2004 (so Espinha and Celes 2005, equation 4) tabulate psi(a, b) over

    gamma_a = a / (a + 1),    gamma_b = b / (b + 1),    both in [0, 1].

psi behaves like sqrt(pi / (2 b)), a square-root singularity along gamma_b = 1 which no refinement
cures, and colours made of 1 - psi lose all digits of thin slabs. `Gamma` is kept as that table is,
to compare with the literature.

`Smooth` tabulates the two moments that colours are made of (see `moments`), scaled so that they
stay between positive bounds on the whole domain, over coordinates in which they are smooth:

    s = sqrt(b),  q = a + s,   rho = a / q,   m = q / (1 + q),   both in [0, 1];
    f_1 = (1 + q)^2 B_1,       f_2 = (1 + q)^3 B_2,              w_back = a B_1 / 2 + b B_2.

a = rho q and b = (1 - rho)^2 q^2 are polynomials in (rho, q), so nothing is singular at thin slabs,
and f_k has an expansion in 1 / q at thick ones. As both are positive, w_back has a bounded
*relative* error, and so have the moments that its derivatives consist of. A tensor-product cubic
spline interpolates (de Boor 1978, chapter XVII); derivatives come from the moments in closed form,
not from the spline's own slope, which would have the infinite slope of sqrt(b) at b = 0.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxvr.numerics.moments import opacity, transmittance, weights_tangent
from jaxvr.numerics.rules import DOUBLE

Array = jax.Array

# Stands for infinite depth at the last row of a table: moments there are at their limit to 1e-12.
_FAR = 1e12


def _moments(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, ...]:
    """B_0, B_1, B_2 in float64 and NumPy, whatever JAX's own precision is set to."""
    root = np.sqrt(np.maximum(a * a + 2 * DOUBLE.depth * (b - a), 0))
    visible = np.minimum(2 * DOUBLE.depth / np.maximum(a + root, 1e-300), 1)[..., None]
    t = visible * np.array(DOUBLE.nodes)
    a, b = a[..., None], b[..., None]
    through = np.exp(-(a * t * (1 - t / 2) + b * t * t / 2)) * visible * np.array(DOUBLE.weights)
    return tuple(np.sum(through * w, -1) for w in ((1 - t) ** 2, 2 * t * (1 - t), t * t))


@functools.lru_cache
def psi_table(size: int) -> np.ndarray:
    """psi (size, size) at gamma = 0, 1 / (size - 1), ..., 1, float64; rows are gamma_a."""
    gamma = np.arange(size) / (size - 1)
    depth = np.where(gamma < 1, gamma / np.maximum(1 - gamma, 1e-300), 1e90)
    return np.sum(_moments(*np.meshgrid(depth, depth, indexing="ij")), axis=0)


@functools.lru_cache
def moment_splines(size: int) -> np.ndarray:
    """Spline coefficients (2, (size + 2)^2) of f_1 and f_2 on a size x size grid, float64; the
    grid's rows are rho, its columns m."""
    x = np.arange(size) / (size - 1)
    rho, m = np.meshgrid(x, x, indexing="ij")
    q = np.where(m < 1, m / np.maximum(1 - m, 1e-300), _FAR)
    _, b1, b2 = _moments(rho * q, ((1 - rho) * q) ** 2)
    f = np.stack([(1 + q) ** 2 * b1, (1 + q) ** 3 * b2])
    return np.stack([_coefficients(_coefficients(g).T).T.reshape(-1) for g in f])


def _coefficients(values: np.ndarray) -> np.ndarray:
    """(N, M) -> (N + 2, M): of the cubic spline through columns, on *uniform* B-splines."""
    from scipy.interpolate import make_interp_spline  # here, since it takes a while to import

    size = len(values)
    spline = make_interp_spline(np.arange(size), values, k=3)  # not-a-knot at both ends
    # The blossom of a cubic at three consecutive knots is its coefficient; the pieces next to the
    # ends are extended outwards, which keeps the knots uniform.
    out = np.empty((size + 2, values.shape[1]))
    for k in range(size + 2):
        piece = min(max(k - 2, 0), size - 2)
        u = np.array([k - 2, k - 1, k]) - piece  # relative to the left end of a piece
        c = [spline(piece, nu) / d for nu, d in ((0, 1), (1, 1), (2, 2), (3, 6))]
        e1, e2, e3 = u.sum() / 3, (u[0] * u[1] + u[0] * u[2] + u[1] * u[2]) / 3, u.prod()
        out[k] = c[0] + c[1] * e1 + c[2] * e2 + c[3] * e3
    return out


def _cell(x: Array, size: int) -> tuple[Array, Array]:
    """Index of the left node and the way from it, for x in [0, 1] on `size` nodes."""
    at = jax.lax.stop_gradient(x) * (size - 1)
    left = jnp.clip(at.astype(jnp.int32), 0, size - 2)
    return left, x * (size - 1) - left.astype(x.dtype)


def gamma_psi(a: Array, b: Array, size: int, nearest: bool) -> Array:
    """psi looked up in Moreland and Angel's table, bilinear or nearest.

    Differentiable as the interpolant is: piecewise, and not at all where it is `nearest`.
    """
    table = jnp.asarray(psi_table(size).reshape(-1), a.dtype)
    (i, u), (j, v) = _cell(a / (a + 1), size), _cell(b / (b + 1), size)
    if nearest:
        return table[(i + (u > 0.5)) * size + j + (v > 0.5)]
    at = i * size + j
    low = table[at] + v * (table[at + 1] - table[at])
    high = table[at + size] + v * (table[at + size + 1] - table[at + size])
    return low + u * (high - low)


def _spline_weights(t: Array) -> tuple[Array, ...]:
    """The four uniform cubic B-splines that reach into a piece, at t in [0, 1] of it."""
    s = 1 - t
    sixth = t.dtype.type(1 / 6)
    return (
        sixth * s * s * s,
        sixth * (4 - 3 * t * t * (1 + s)),
        sixth * (4 - 3 * s * s * (1 + t)),
        sixth * t * t * t,
    )


def smooth_moments(a: Array, b: Array, size: int) -> tuple[Array, Array]:
    """B_1 and B_2 from the splines; not for differentiation: see `smooth_weights`."""
    table = jnp.asarray(moment_splines(size), a.dtype)
    q = a + jnp.sqrt(b)
    rho = a / jnp.where(q > 0, q, 1)
    per = 1 / (1 + q)
    (i, u), (j, v) = _cell(rho, size), _cell(q * per, size)
    rows, columns = _spline_weights(u), _spline_weights(v)
    sums: list[Any] = [0.0, 0.0]
    for k, row in enumerate(rows):
        at = (i + k) * (size + 2) + j
        for c in range(2):
            line = sum(column * table[c][at + n] for n, column in enumerate(columns))
            sums[c] += row * line
    return sums[0] * per * per, sums[1] * per * per * per


@functools.partial(jax.custom_jvp, nondiff_argnums=(2,))
def smooth_weights(a: Array, b: Array, size: int) -> tuple[Array, Array]:
    """(alpha, w_back) of a slab as `moments.emission_weights` has them, from the smooth table."""
    a, b = _clip(a, b)
    return _weights(a, b, smooth_moments(a, b, size))


@smooth_weights.defjvp
def _smooth_weights_jvp(size, primals, tangents):
    a, b = _clip(*primals)
    b1, b2 = smooth_moments(a, b, size)
    return _weights(a, b, (b1, b2)), weights_tangent(a, b, (None, b1, b2), tangents)


def _clip(a: Array, b: Array) -> tuple[Array, Array]:
    """To where squares and cubes are finite in float32; beyond, all weights are at their limits."""
    return jnp.clip(a, 0, 1e15), jnp.clip(b, 0, 1e30)


def _weights(a: Array, b: Array, moments: tuple[Array, Array]) -> tuple[Array, Array]:
    alpha = opacity(0.5 * (a + b))
    return alpha, jnp.minimum(0.5 * a * moments[0] + b * moments[1], alpha)


def gamma_weights(a: Array, b: Array, size: int, nearest: bool) -> tuple[Array, Array]:
    """(1 - zeta, psi - zeta): the weights 1 - psi and psi - zeta of the papers, as `moments` has
    them, with psi from `gamma_psi`."""
    zeta = transmittance(a, b)
    return 1 - zeta, gamma_psi(a, b, size, nearest) - zeta
