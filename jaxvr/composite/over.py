"""The over operator, carried as optical depth.

    rgb = sum_i T_i c_i      alpha = 1 - exp(-sum_i S_i)      T_i = exp(-sum_{j < i} S_j)

for pieces with premultiplied colours c_i and optical depths S_i, front to back. Both sums are
compensated, and transmittance is exp of minus a sum, never a product: thin volumes keep their
digits, and opaque ones can be differentiated, since nothing is divided by a transmittance.

    d rgb / d c_i = T_i           d rgb / d S_i = -(rgb - sum_{j <= i} T_j c_j)

The second is the light from behind piece i: final minus prefix, with the arithmetic of the
forward pass, so that the difference cancels to zero where nothing is behind.

What is behind piece i is seen through T_{i+1} = exp(-sum_{j <= i} S_j), so a ray may end there once
that is small (early ray termination, Levoy 1990). With colours of at most C in size, the sums are
then short of

    |sum_{j > i} T_j c_j| <= C (T_{i+1} - T_end) <= C T_{i+1}        0 <= T_{i+1} - T_end <= T_{i+1}

since a piece of depth S emits at most C (1 - exp(-S)), which telescopes.
"""

from __future__ import annotations

import dataclasses
import math
import numbers
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
    """Emission and absorption (the density emitter of Williams and Max 1992), front to back.

    termination: a ray ends behind the first segment where its transmittance is at most this; 0
    never ends one before its last segment, and costs nothing. What is left out is bounded, whatever
    lies behind: |rgb - exact| is at most `termination` times the largest colour, and exact alpha -
    alpha is from 0 to `termination`, both to rounding. 1/255 cannot be seen in 8 bits. Rays of a
    batch go in lock step, so time is saved where all of them end early.

    Gradients are those of the image that is rendered, with the cells where rays end held fixed:
    what lies behind them has none. As a function of the parameters that image has steps, of the
    size of the bound, where a ray comes to end one cell sooner.

    Raises:
      ValueError: if `termination` is not a number in [0, 1).
    """

    termination: float = 0.0

    def __post_init__(self):
        number = isinstance(self.termination, numbers.Real)
        if not (number and 0 <= self.termination < 1):
            raise ValueError(
                f"termination must be a number in [0, 1), but is {self.termination!r}. It is the "
                "transmittance at which a ray ends: 0 follows every ray to its last segment, "
                "1 / 255 leaves out what 8 bits cannot show."
            )

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

    @property
    def enough(self) -> float:
        """The optical depth at which a ray ends; infinite if none ends so."""
        return -math.log(self.termination) if self.termination else math.inf

    def ended(self, state: OverState) -> Array | None:
        """Rays (R,) that need nothing from behind; None if no ray ever ends so."""
        if self.termination == 0:
            return None
        return compensated.value(state.depth) >= self.enough

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
