"""The exact integrator.

For linear extinction and linear colour the emission-absorption integral of a slab is known
(Williams, Max and Stein 1998; Moreland and Angel 2004). It is evaluated here to rounding in both
precisions, over the whole domain: see `jaxvr.numerics.moments`.
"""

from __future__ import annotations

import dataclasses

from jaxvr.numerics.moments import emission_weights
from jaxvr.optics.integrator import AbstractSlabIntegrator


@dataclasses.dataclass(frozen=True)
class Analytic(AbstractSlabIntegrator):
    """Exact to rounding: rgb and alpha within 1e-15 (float64) or 5e-7 (float32) of the largest
    colour, and their Jacobian within 5e-15 or 7e-7 of its natural scale.

    `slab` is differentiable twice and more, in forward and reverse mode. Of whole segments the
    first derivatives are exact and the second are not (see `jaxvr.optics.partition`).
    """

    def slab_integral(self, piece):
        # rgb = C_front alpha + (C_back - C_front) w_back stays exact for a constant colour.
        a, b = piece.front[0] * piece.length, piece.back[0] * piece.length
        alpha, w_back = emission_weights(a, b)
        color, change = piece.front[1:], piece.back[1:] - piece.front[1:]
        return color * alpha[None] + change * w_back[None], 0.5 * (a + b)
