"""The over operator, carried as optical depth.

    rgb = sum_i T_i c_i      alpha = 1 - exp(-sum_i S_i)      T_i = exp(-sum_{j < i} S_j)

for pieces with premultiplied colours c_i and optical depths S_i, front to back. Both sums are
compensated, and transmittance is exp of minus a sum, never a product: thin volumes keep their
digits, and opaque ones can be differentiated, since nothing is divided by a transmittance.

    d rgb / d c_i = T_i           d rgb / d S_i = -(rgb - sum_{j <= i} T_j c_j)

The second is the light from behind piece i: final minus prefix, with the arithmetic of the
forward pass, so that the difference cancels to zero where nothing is behind.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxvr.numerics import compensated
from jaxvr.numerics.compensated import Sum
from jaxvr.numerics.moments import opacity

Array = jax.Array


class OverState(NamedTuple):
    """depth: sums (R,), rgb: sums (3, R)."""

    depth: Sum
    rgb: Sum


@dataclasses.dataclass(frozen=True)
class Over:
    """Emission and absorption (the density emitter of Williams and Max 1992), front to back."""

    def start(self, rays: int, dtype: Any) -> OverState:
        zero, zeros = jnp.zeros(rays, dtype), jnp.zeros((3, rays), dtype)
        return OverState((zero, zero), (zeros, zeros))

    def add(self, state: OverState, rgb: Array, depth: Array) -> OverState:
        """The state behind a piece with premultiplied rgb (3, R) and optical depth (R,)."""
        through = compensated.exp_minus(state.depth)
        return OverState(
            compensated.add(state.depth, depth),
            compensated.add(state.rgb, through[None] * rgb),
        )

    def finish(self, state: OverState) -> Array:
        """Premultiplied RGBA (4, R)."""
        alpha = opacity(compensated.value(state.depth))
        return jnp.concatenate([compensated.value(state.rgb), alpha[None]])

    def pull_back(
        self, before: OverState, after: OverState, final: OverState, cotangent: Array
    ) -> tuple[Array, Array]:
        """Cotangents of one piece's rgb (3, R) and depth (R,), given that of the RGBA (4, R)."""
        behind = compensated.difference(final.rgb, after.rgb)
        through = compensated.exp_minus(final.depth)
        depth_bar = cotangent[3] * through - jnp.sum(cotangent[:3] * behind, axis=0)
        return compensated.exp_minus(before.depth)[None] * cotangent[:3], depth_bar
