"""Segments as they are: for compositors that look at scalars and not at light."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxvr._core.pytree import noun
from jaxvr.optics.integrator import AbstractIntegrator
from jaxvr.optics.partition import Cursor


@noun
class Unshaded(AbstractIntegrator):
    """One piece a segment, without colour and without optical depth."""

    def slab(self, extinction_front, extinction_back, color_front, color_back, length):
        colors = jnp.asarray(color_front) + jnp.asarray(color_back) + jnp.asarray(length)[..., None]
        return 0 * colors, 0 * colors[..., 0]

    def reversed(self):
        return self

    def prepare(self, transfer, dtype, longest):
        return jnp.zeros(0, dtype)

    def shorten(self, table, image_only):
        return table

    def start(self, table, scalar):
        return Cursor(jax.lax.stop_gradient(scalar), jnp.zeros(scalar.shape, jnp.int32))

    def step(self, table, segment, cursor):
        none = jnp.zeros_like(segment.length)
        return jnp.stack([none, none, none]), none, cursor, jnp.ones_like(none, bool), None

    def gradient_start(self, table):
        return table

    def pull_back(self, table, segment, piece, cotangent, gradient):
        return jax.tree.map(jnp.zeros_like, segment), gradient

    def gradient_finish(self, table, gradient):
        return table
