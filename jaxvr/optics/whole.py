"""Segments taken whole: one step each, whatever control points they cross.

Such an integrator gathers a few rows of a table and blends them. Its derivative is local like that
of a slab: the rows' cotangents are scattered, and no dense gradient of the table is made per step.
"""

from __future__ import annotations

import abc
from typing import Any

import jax
import jax.numpy as jnp

from jaxvr._core.pytree import noun, pytree
from jaxvr._core.stage import stage
from jaxvr.optics.integrator import AbstractIntegrator, shade_slab, slab_of
from jaxvr.optics.partition import Cursor, Ends, Segment, locate, nodes_of, turned

Array = jax.Array


@pytree
class Table:
    """rows (N, C): what segments gather from. frame: floats (any pytree) that all of them share."""

    rows: Array
    frame: Any


class AbstractWholeIntegrator(AbstractIntegrator):
    """Leaves to write: `prepare` makes a `Table`, `address` and `blend` look a segment up in it."""

    @abc.abstractmethod
    def address(self, table: Table, segment: Segment) -> Array:
        """Rows (M, R) int32 of the table that segments (R,) need; without derivatives."""

    @abc.abstractmethod
    def blend(self, frame: Any, rows: Array, segment: Segment) -> tuple[Array, Array]:
        """rgb (3, R), premultiplied, and optical depth (R,) from rows (C, M, R); differentiable in
        all operands."""

    def reversed(self):
        return WholeFromBehind(self)

    def shorten(self, table, image_only):
        return table  # a segment is one piece already

    def start(self, table, scalar):
        return Cursor(jax.lax.stop_gradient(scalar), jnp.zeros(scalar.shape, jnp.int32))

    def step(self, table, segment, cursor):
        wanted = jnp.any(segment.length >= 0)  # those of no length have derivatives
        ids = stage(wanted, self.address, table, segment)
        rows = stage(wanted, _gather, table.rows, ids)
        rgb, depth = stage(wanted, self.blend, table.frame, rows, segment)
        return rgb, depth, cursor, jnp.ones_like(segment.length, bool), (ids, rows)

    def gradient_start(self, table):
        return jax.tree.map(jnp.zeros_like, table)

    def pull_back(self, table, segment, piece, cotangent, gradient):
        def pull(frame, rows, segment, cotangent):
            return jax.vjp(self.blend, frame, rows, segment)[1](cotangent)

        ids, rows = piece
        wanted = jnp.any(segment.length >= 0)
        frame_bar, rows_bar, segment_bar = stage(
            wanted, pull, table.frame, rows, segment, cotangent
        )
        if gradient is not None:
            shares = rows_bar.reshape(rows_bar.shape[0], -1).T
            gradient = Table(
                gradient.rows.at[ids.reshape(-1)].add(shares),
                jax.tree.map(jnp.add, gradient.frame, frame_bar),
            )
        return segment_bar, gradient

    def gradient_finish(self, table, gradient):
        return gradient


@noun
class WholeFromBehind(AbstractWholeIntegrator):
    """The segments of `other`, with light that leaves by the back."""

    other: AbstractWholeIntegrator

    def slab(self, extinction_front, extinction_back, color_front, color_back, length):
        ends = (extinction_back, extinction_front, color_back, color_front)
        return self.other.slab(*ends, length)

    def prepare(self, transfer, dtype, longest):
        return self.other.prepare(transfer, dtype, longest)

    def address(self, table, segment):
        return self.other.address(table, turned(segment))

    def blend(self, frame, rows, segment):
        return self.other.blend(frame, rows, turned(segment))


def _gather(rows: Array, ids: Array) -> Array:
    """(N, C), (M, R) -> (C, M, R). Rows lie together in memory, so each is one cache line."""
    channels = rows.shape[1]
    channel = jnp.arange(channels, dtype=jnp.int32)[:, None, None]
    return rows.reshape(-1)[ids[None] * channels + channel]


class AbstractEndIntegrator(AbstractWholeIntegrator):
    """Sees the transfer function at the two ends of a segment only, and takes extinction and
    colour for linear between them. What it does between control points is invisible to it: this is
    how cells were coloured before pre-integration, and why that was found.
    """

    @abc.abstractmethod
    def weights(self, a: Array, b: Array) -> tuple[Array, Array]:
        """As those of `AbstractSlabIntegrator`."""

    def slab(self, extinction_front, extinction_back, color_front, color_back, length):
        operands = (extinction_front, extinction_back, color_front, color_back, length)
        return slab_of(self.weights, *operands)

    def prepare(self, transfer, dtype, longest):
        nodes = nodes_of(transfer, dtype)
        return Table(jnp.concatenate([nodes.position[None], nodes.optical]).T, ())

    def address(self, table, segment):
        count = table.rows.shape[0]
        above = [locate(table.rows[:, 0], s) for s in (segment.front, segment.back)]
        return jnp.stack(
            [jnp.maximum(above[0] - 1, 0), jnp.minimum(above[0], count - 1)]
            + [jnp.maximum(above[1] - 1, 0), jnp.minimum(above[1], count - 1)]
        )

    def blend(self, frame, rows, segment):
        def at(scalar, low, high):
            width = high[0] - low[0]  # 0 outside the control points; `locate` skips jumps
            inside = width > 0
            step = jnp.where(inside, scalar - low[0], 0) / jnp.where(inside, width, 1)
            return low[1:] + step[None] * (high[1:] - low[1:])

        front = at(segment.front, rows[:, 0], rows[:, 1])
        back = at(segment.back, rows[:, 2], rows[:, 3])
        return shade_slab(self.weights, Ends(front, back, segment.length))
