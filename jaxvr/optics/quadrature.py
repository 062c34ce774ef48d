"""Gauss-Legendre quadrature of the slab integral: an independent check of `Analytic`."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np

from jaxvr.optics.integrator import AbstractSlabIntegrator


@dataclasses.dataclass(frozen=True)
class Quadrature(AbstractSlabIntegrator):
    """`order` Gauss-Legendre points on each slab (Davis and Rabinowitz 1984, section 2.7).

    Knows nothing of moments or error functions: it samples extinction, colour and transmittance.
    The error falls geometrically with `order` for slabs of moderate optical depth; a slab of
    depth 30 needs some 20 points for eight digits. Costs `order` exponentials a slab.

    Raises:
      ValueError: if `order` is not a positive integer.
    """

    order: int = 16

    def __post_init__(self):
        if not isinstance(self.order, int) or self.order < 1:
            raise ValueError(f"order must be a positive integer, but is {self.order!r}.")

    def slab_integral(self, piece):
        nodes, weights = np.polynomial.legendre.leggauss(self.order)
        a, b = piece.front[0] * piece.length, piece.back[0] * piece.length
        rgb = jnp.zeros_like(piece.front[1:])
        number = a.dtype.type
        for x, w in zip((nodes + 1) / 2, weights / 2, strict=True):
            t, w = number(x), number(w)
            depth = t * (a + (b - a) * (t / 2))
            emitted = w * (a + (b - a) * t) * jnp.exp(-depth)
            rgb += emitted[None] * (piece.front[1:] + (piece.back[1:] - piece.front[1:]) * t)
        return rgb, 0.5 * (a + b)
