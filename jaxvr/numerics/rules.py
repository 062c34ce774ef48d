"""Generalised Gauss rules on [0, 1] for moments of exp(-(a u + (b - a) u^2 / 2)).

For weights u^k (1 - u)^(n - k), n <= 4, and every a, b >= 0 with (a + b)/2 <= depth, a rule's sum
agrees with the integral to the working precision (relative), which Gauss-Legendre needs about
twice as many nodes for. Found by Gauss-Newton elimination of nodes in the manner of Bremer,
Gimbutas and Rokhlin, "A nonlinear optimization procedure for generalized Gaussian quadratures",
SIAM J. Sci. Comput. 32 (2010). All weights are positive.
"""

from __future__ import annotations

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True)
class Rule:
    """Nodes and weights (n,) of a rule, good to optical depth `depth` of the whole interval."""

    depth: float
    nodes: tuple[float, ...]
    weights: tuple[float, ...]


# 23 nodes: relative error of psi 4e-16, of its partial derivatives 8e-16.
DOUBLE = Rule(
    55.0,
    (
        0.0012952713705349642,
        0.006845129820650065,
        0.016911591564803576,
        0.031630659453201954,
        0.05117976096915181,
        0.07575826062352463,
        0.10555688479917913,
        0.14072048429100442,
        0.18131310951514462,
        0.2272982027656293,
        0.27854289036283497,
        0.3348423060511352,
        0.3959441284150893,
        0.46154360969998776,
        0.531217675387868,
        0.6042721875191437,
        0.6794946005690697,
        0.7548484915545798,
        0.8272235718360459,
        0.8924330568134462,
        0.9456361044860139,
        0.9821730248621604,
        0.9986250499090619,
    ),
    (
        0.0033264277884179558,
        0.0077894061449149425,
        0.012366219413365706,
        0.017101826755009195,
        0.022030120382297513,
        0.027159309068306003,
        0.03246269702736548,
        0.03787553299109265,
        0.04330354455804551,
        0.04864404075954207,
        0.05381070669984324,
        0.05874607690284318,
        0.06340780900631372,
        0.06772315766624483,
        0.07151347762251678,
        0.07439881122333176,
        0.0757112688158371,
        0.07447868477261642,
        0.06956665670825792,
        0.06003084129348879,
        0.04558141065218257,
        0.026896367813705146,
        0.006075605934461519,
    ),
)

# 13 nodes: relative error of psi 2e-7 in float32, of its partial derivatives 4e-7.
SINGLE = Rule(
    30.0,
    (
        0.003758682531334242,
        0.01998403828625902,
        0.04987718771986338,
        0.09448814439784259,
        0.15486246460851003,
        0.23146633006889575,
        0.3237811577039918,
        0.430436556539092,
        0.549320714680829,
        0.6764058335517542,
        0.8027472265001486,
        0.9118161306807229,
        0.9823220930198768,
    ),
    (
        0.009666745411328354,
        0.022906251035807228,
        0.037060692594948805,
        0.05234611481293438,
        0.0684884453971878,
        0.08462917320684632,
        0.0997665817458606,
        0.11320981673449108,
        0.12394134234225955,
        0.1287982885124114,
        0.12108944686897126,
        0.0933176728173067,
        0.044779428517493156,
    ),
)

# 7 nodes: relative error of psi 8.5e-6, of its partial derivatives 2.3e-5 (front) and 9.2e-5.
# Exact in the thin limit, like the next.
FAST = Rule(
    17.0,
    (
        0.011867085497077896,
        0.06432205817839239,
        0.16452333807047165,
        0.3153967241645407,
        0.5123564553387062,
        0.7413684993715619,
        0.9409487160550843,
    ),
    (
        0.03066906547513641,
        0.07530092338219677,
        0.12572738658891885,
        0.17511491225256323,
        0.21713863690157686,
        0.23157855804071295,
        0.14447051735889488,
    ),
)

# 5 nodes: relative error of psi 4.7e-4, of its partial derivatives 1.3e-3 and 3.1e-3.
DRAFT = Rule(
    12.0,
    (
        0.021707730232270586,
        0.12039768454557072,
        0.3135310494101481,
        0.5935295353868295,
        0.8956605863262443,
    ),
    (
        0.056446344781396006,
        0.1442966312273511,
        0.24051145116468212,
        0.3126209539297295,
        0.24612461889684137,
    ),
)


def rule_for(dtype: np.dtype) -> Rule:
    """The rule that reaches rounding in this dtype."""
    return DOUBLE if np.dtype(dtype) == np.float64 else SINGLE


def thin_rule(dtype: np.dtype) -> Rule:
    """A rule of fewer nodes that reaches rounding where neither end of a slab has a depth above
    `depth`: Gauss-Legendre, whose error falls with the depth's power of twice the nodes.

    5 nodes in float32 (relative error of the moments of degree 2 5e-8), 9 in float64 (1e-15).
    """
    nodes, weights = np.polynomial.legendre.leggauss(9 if np.dtype(dtype) == np.float64 else 5)
    return Rule(1.0, tuple((nodes + 1) / 2), tuple(weights / 2))
