"""The over operator, carried as optical depth.

    rgb = sum_i T_i c_i      alpha = 1 - exp(-sum_i S_i)      T_i = exp(-sum_{j < i} S_j)

for pieces with premultiplied colours c_i and optical depths S_i, front to back. Both sums are
compensated, and transmittance is exp of minus a sum, never a product: thin volumes keep their
digits, and opaque ones can be differentiated, since nothing is divided by a transmittance.

    d rgb / d c_i = T_i           d rgb / d S_i = -(rgb - sum_{j <= i} T_j c_j)

The second is the light from behind piece i: final minus prefix, with the arithmetic of the
forward pass, so that the difference cancels to zero where nothing is behind.

What is behind piece i is seen through T_{i+1} = exp(-sum_{j <= i} S_j), so a ray may end there once
that is small (early ray termination, Levoy 1990, doi:10.1145/78964.78965). With colours of at most
C in size, the sums are then short of

    |sum_{j > i} T_j c_j| <= C (T_{i+1} - T_end) <= C T_{i+1}        0 <= T_{i+1} - T_end <= T_{i+1}

since a piece of depth S emits at most C (1 - exp(-S)), which telescopes.

Back to front the same is a recurrence, R_i = c_i + exp(-S_i) R_{i+1}, with what lies in front of a
piece seen last. Once all depths are known, so is T_i = exp(-(sum_j S_j - sum_{j >= i} S_j)), and

    d rgb / d c_i = T_i           d rgb / d S_i = -T_i exp(-S_i) R_{i+1} = -T_{i+1} R_{i+1}

in which R_{i+1} is the state before the piece: again nothing is divided. The recurrence in floats:
where a piece hides less than half, 1 - exp(-S_i) of R_{i+1} is taken from a compensated sum, so
that many thin pieces cost no digits; else R_{i+1} is multiplied by exp(-S_i), since the difference
would cancel. Roundings then are those of what is left, and halve with each such piece.
"""

from __future__ import annotations

import math
import numbers
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp

from jaxvr._core.checks import is_concrete
from jaxvr._core.pytree import held, noun, static
from jaxvr.composite.base import AbstractCompositor, Piece
from jaxvr.numerics import compensated
from jaxvr.numerics.compensated import Sum
from jaxvr.numerics.moments import opacity
from jaxvr.optics.analytic import Analytic

Array = jax.Array
Direction = Literal["front to back", "back to front"]


_STEPS = (
    "As a function of Over's termination a picture is made of steps: there is no derivative by it. "
    "Take differences of pictures."
)


class OverState(NamedTuple):
    """depth: sums (R,), rgb: sums (3, R)."""

    depth: Sum
    rgb: Sum


@noun
class Over(AbstractCompositor):
    """Emission and absorption (the density emitter of Williams and Max 1992).

    termination: a ray ends behind the first segment where its transmittance is at most this; None,
    or 0, which becomes None, never ends one before its last segment, and costs nothing. What is
    left out is bounded, whatever lies behind: |rgb - exact| is at most `termination` times the
    largest colour, and exact alpha - alpha is from 0 to `termination`, both to rounding. 1/255
    cannot be seen in 8 bits. Rays of a batch go in lock step, so time is saved where all of them
    end early. All that is of segments in order; a `KBuffer` with too small a k skips some, and of a
    ray that ends early it cannot always tell.

    Gradients are those of the image that is rendered, with the cells where rays end held fixed:
    what lies behind them has none. As a function of the parameters that image has steps, of the
    size of the bound, where a ray comes to end one cell sooner. As a function of `termination` it
    is steps and nothing else, with a derivative of 0 that says nothing: one that is asked for is a
    TypeError. Another number compiles nothing anew.

    direction: "front to back", or "back to front" as projected cells are composited: the same image
    and gradients to rounding, and no faster. It asks for a tracer that can stream segments from
    behind, by `reversed`: all of the package's can.

    Raises:
      ValueError: if `termination` is not a number in [0, 1), for another direction, and for both at
        once: from behind, nothing is hidden yet.
    """

    termination: Any = held(_STEPS, default=None)
    direction: Direction = static(default="front to back")

    def __post_init__(self):
        if not _is_fraction(self.termination):
            raise ValueError(
                f"termination must be a number in [0, 1), but is {self.termination!r}. It is the "
                "transmittance at which a ray ends: 0 follows every ray to its last segment, "
                "1 / 255 leaves out what 8 bits cannot show."
            )
        if self.direction not in get_args(Direction):
            raise ValueError(
                f"direction must be one of {list(get_args(Direction))}, but is {self.direction!r}."
            )
        if isinstance(self.termination, numbers.Real) and self.termination == 0:
            object.__setattr__(self, "termination", None)
        if self.backwards and self.termination is not None:
            raise ValueError(
                f"termination is {self.termination} and direction 'back to front', but a ray that "
                "comes from behind cannot end early: what hides the rest is seen last. Leave "
                "termination out, or go front to back."
            )

    @property
    def backwards(self) -> bool:
        """Whether pieces are to be added farthest first."""
        return self.direction == "back to front"

    @property
    def needs(self):
        return frozenset({"rgb", "optical_depth"})

    def default_integrator(self):
        return Analytic()

    def init(self, rays, dtype):
        zero, zeros = jnp.zeros(rays, dtype), jnp.zeros((3, rays), dtype)
        return OverState((zero, zero), (zeros, zeros))

    def add(self, state, piece):
        rgb, depth = piece.rgb, piece.optical_depth
        if self.backwards:
            return _add_in_front(state, rgb, depth)
        through = compensated.exp_minus(state.depth)
        return OverState(
            compensated.add(state.depth, depth),
            compensated.add(state.rgb, through[None] * rgb),
        )

    @property
    def enough(self) -> Any:
        """The optical depth () at which a ray ends; infinite if none ends so."""
        return math.inf if self.termination is None else -jnp.log(self.termination)

    def done(self, state):
        if self.termination is None:
            return None
        return compensated.value(state.depth) >= self.enough

    def finish(self, state, transfer, scale):
        alpha = opacity(compensated.value(state.depth))
        rgba = jnp.concatenate([compensated.value(state.rgb), alpha[None]])
        if self.termination is None:
            return rgba
        # A number that was traced, or put in place by JAX, passed no constructor.
        good = (self.termination >= 0) & (self.termination < 1)
        return jnp.where(good, rgba, jnp.nan)

    def merge(self, front, back):
        through = compensated.exp_minus(front.depth)[None]
        light = through * back.rgb[0], through * back.rgb[1]
        return OverState(
            compensated.join(front.depth, back.depth), compensated.join(front.rgb, light)
        )

    def pull_back(self, piece, before, after, final, cotangent):
        rgb_bar, depth_bar = cotangent.rgb[0], cotangent.depth[0]
        if self.backwards:
            return _pull_back_in_front(before, after, final, rgb_bar, depth_bar), None
        behind = compensated.difference(final.rgb, after.rgb)
        through = compensated.exp_minus(before.depth)[None]
        piece_bar = Piece(
            through * rgb_bar, depth_bar - jnp.sum(rgb_bar * behind, axis=0), None, None
        )
        return piece_bar, None


def _is_fraction(x: Any) -> bool:
    """Whether it is None or a number in [0, 1), as far as that is known."""
    if x is None:
        return True
    if isinstance(x, numbers.Real):
        return 0 <= float(x) < 1
    if getattr(x, "shape", None) != () or not hasattr(x, "dtype") or x.dtype.kind not in "fiu":
        return False
    return not is_concrete(x) or 0 <= float(x) < 1


def _add_in_front(state: OverState, rgb: Array, depth: Array) -> OverState:
    """The state with a piece in front of all others."""
    hides = opacity(depth)
    thin = hides < 0.5
    factor = jnp.where(thin, 1, jnp.exp(-depth))[None]
    old = (factor * state.rgb[0], factor * state.rgb[1])
    taken = jnp.where(thin, hides, 0)[None] * compensated.value(old)
    return OverState(compensated.add(state.depth, depth), compensated.add(old, rgb - taken))


def _pull_back_in_front(
    before: OverState, after: OverState, final: OverState, rgb_bar: Array, depth_bar: Array
) -> Piece:
    """`Over.pull_back` for such a piece: T_i by what is in front of it, T_{i+1} with itself."""
    to, past = (jnp.exp(-compensated.difference(final.depth, s.depth)) for s in (after, before))
    behind = past[None] * compensated.value(before.rgb)
    return Piece(to[None] * rgb_bar, depth_bar - jnp.sum(rgb_bar * behind, axis=0), None, None)
