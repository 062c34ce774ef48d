"""Rays, and what of them is seen: an interval.

A ray starts at its origin. What lies before `near` or behind `far` is left out: segments are cut
there, inside of cells too, and the two places are differentiated, since what is integrated jumps
at them. So an eye in the volume, clips, layers, and parts of a volume that are rendered elsewhere
are one thing, and the states of a compositor on both sides of a cut merge to that of the whole ray.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxvr._core.pytree import pytree

Array = jax.Array


@pytree
class Rays:
    """R rays.

    origins, directions (R, 3): directions of any length but zero. near, far (R,): distances from
    the origins in units of the volume's lengths, whatever the length of directions; None for 0, and
    for no end.
    """

    origins: Array
    directions: Array
    near: Array | None = None
    far: Array | None = None

    def bounds(self) -> tuple[Array, Array]:
        """near and far (R,), whether or not they are given."""
        none = jnp.zeros_like(self.origins[..., 0])
        return (
            none if self.near is None else self.near,
            none + jnp.inf if self.far is None else self.far,
        )

    def reversed(self) -> Rays:
        """The same lines, run through from behind: what is at the distance t is at -t."""
        none = jnp.zeros_like(self.origins[..., 0])
        return Rays(
            self.origins,
            -self.directions,
            none - jnp.inf if self.far is None else -self.far,
            none if self.near is None else -self.near,
        )


def flat(rays: Rays) -> Rays:
    """Rays of any shape as (R, ...)."""
    ends = (None if x is None else x.reshape(-1) for x in (rays.near, rays.far))
    return Rays(rays.origins.reshape(-1, 3), rays.directions.reshape(-1, 3), *ends)
