"""Maximum intensity projection: the largest scalar along a ray, coloured.

(Wallis, Miller, Lerner and Kleerup 1989, doi:10.1109/42.41482.) Where the scalar is linear in each
cell, its largest value on a ray is at one of the two ends of a segment, so that the picture is
exact. Of its derivative the state keeps what decides: the number of the segment that has it, and
which of its ends. Scalars are made anew when a ray is replayed, perhaps by other loops, and rounded
in another way: to look for the segment whose scalar equals the largest would lose the gradient of
such rays without a word.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxvr._core.pytree import noun
from jaxvr.composite.base import AbstractCompositor, Piece, seen
from jaxvr.optics.partition import Segment
from jaxvr.optics.unshaded import Unshaded

Array = jax.Array


class MaximumState(NamedTuple):
    """largest (R,): the largest scalar so far, 0 before the first. where (R,) int32: twice the
    number of the segment that has it, and one more if at its back; -1 before the first. passed
    (R,) int32: segments so far."""

    largest: Array
    where: Array
    passed: Array


@noun
class MaximumIntensity(AbstractCompositor):
    """The colour that the transfer function has at the largest scalar along each ray, opaque; rays
    that meet nothing are transparent. Extinctions are not looked at.

    Exact on tetrahedra with fields that are linear in each cell. Of fields that jump from cell to
    cell, the largest of those that the ray passes through.

    Differentiable in values, points and camera, and in positions and colours of the transfer
    function. All of it is by the place of the maximum, held: where two segments have the same
    largest scalar (a kink) the derivative is that of the nearer. The edge of the volume's
    silhouette, where alpha steps, has none.
    """

    @property
    def needs(self):
        return frozenset({"scalar", "transfer"})

    def default_integrator(self):
        return Unshaded()

    def init(self, rays, dtype):
        none = jnp.zeros(rays, jnp.int32)
        return MaximumState(jnp.zeros(rays, dtype), none - 1, none)

    def add(self, state, piece):
        front, back, _ = piece.segment
        at_back = _exceeds(back, front)
        most = jnp.where(at_back, back, front)
        larger = seen(piece) & ((state.where < 0) | _exceeds(most, state.largest))
        return MaximumState(
            jnp.where(larger, most, state.largest),
            jnp.where(larger, 2 * state.passed + at_back, state.where),
            state.passed + piece.last,
        )

    def finish(self, state, transfer, scale):
        hit = state.where >= 0
        colors, _ = transfer(state.largest)
        rgb = jnp.where(hit[None], colors.T, 0)
        return jnp.concatenate([rgb, hit[None].astype(rgb.dtype)])

    def merge(self, front, back):
        larger = (back.where >= 0) & ((front.where < 0) | _exceeds(back.largest, front.largest))
        return MaximumState(
            jnp.where(larger, back.largest, front.largest),
            jnp.where(larger, back.where + 2 * front.passed, front.where),
            front.passed + back.passed,
        )

    def pull_back(self, piece, before, after, final, cotangent):
        here = piece.last & (final.where // 2 == before.passed) & (final.where >= 0)
        at_back = final.where % 2 == 1
        front, back = (jnp.where(here & x, cotangent.largest, 0) for x in (~at_back, at_back))
        return Piece(None, None, Segment(front, back, jnp.zeros_like(front)), None), None


def _exceeds(a: Array, b: Array) -> Array:
    """Whether a > b, with NaN above all numbers: a ray that meets one has a colour of NaN, as with
    other compositors, and not that of the rest of it."""
    return (a > b) | (jnp.isnan(a) & ~jnp.isnan(b))
