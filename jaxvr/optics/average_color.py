"""Projected tetrahedra as Shirley and Tuchman coloured them."""

from __future__ import annotations

from jaxvr._core.pytree import noun
from jaxvr.numerics.moments import opacity
from jaxvr.optics.whole import AbstractEndIntegrator


@noun
class AverageColor(AbstractEndIntegrator):
    """The mean of a segment's two end colours, behind the mean of its two extinctions.

        rgb = (C_front + C_back) / 2 * alpha,    alpha = 1 - exp(-(a + b) / 2)

    Shirley and Tuchman 1990 (doi:10.1145/99308.99322) colour the thick vertex of a projected
    tetrahedron like this; Stein, Becker and Max 1994 (doi:10.1145/197938.197971) take the
    exponential at every pixel. Here to compare with: an opaque segment shows half of the colour
    that it hides, and peaks of the transfer function that lie between the two ends are missed.
    """

    def weights(self, a, b):
        alpha = opacity(0.5 * (a + b))
        return alpha, 0.5 * alpha
