"""Segments that were traced before, played back: the tracer of `shade`.

Segments of a fixed view do not depend on the transfer function. Each ray has a run of nodes in two
flat arrays: node i has a scalar and the length of the piece that leads to it from node i - 1. Where
the scalar jumps, and where a ray (re-)enters the mesh, a node of length 0 carries the new scalar.
So a segment takes 8 bytes in float32 (16 in float64), plus 8 for each jump and 4 for each ray.
Nothing is split at control points, since those belong to the transfer function.

From behind, a ray's nodes are played from its last down to the second: node i leads to node i - 1,
by the same length, and a node of length 0 stays where it is; the next starts anew.
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxvr._core.brief import dtype_of, is_known
from jaxvr._core.pytree import noun, pytree, static
from jaxvr.optics.partition import Segment, turned
from jaxvr.trace.base import AbstractTracer

Array = jax.Array


@pytree
class Segments:
    """What `trace` returns: the segments of R rays, N nodes in all.

    scalar (N,), length (N,): nodes, ray after ray. start (R + 1,) int32: each ray's run.
    status (R,) int32. order (R,) int32: place of each ray in the image, row by row.
    shape: shape of the image, (height, width), or that of the rays. offset: what scalar is relative
    to, that of the mesh.
    """

    scalar: Array
    length: Array
    start: Array
    status: Array
    order: Array
    shape: tuple[int, ...] = static(default=())
    offset: float = static(default=0.0)

    @property
    def count(self) -> int:
        """Number of nodes in use: segments, and one more for each entry or jump."""
        return int(self.start[-1])

    @property
    def nbytes(self) -> int:
        """Bytes on the device."""
        arrays = (self.scalar, self.length, self.start, self.status, self.order)
        return sum(a.size * a.dtype.itemsize for a in arrays)

    def __repr__(self) -> str:
        # leaves may be tracers or placeholders
        nodes = f"{self.count:,}" if is_known(self.start) and self.start.size else "?"
        shape = " x ".join(map(str, self.shape)) or "1"
        return f"Segments({shape} rays, {nodes} nodes, {dtype_of(self.scalar)})"


class Nodes(NamedTuple):
    """scalar, length (N,); in a gradient, None for what is not asked for."""

    scalar: Any
    length: Any


class Runs(NamedTuple):
    """first, end (R,): the nodes of each ray."""

    first: Array
    end: Array


class PlayState(NamedTuple):
    node: Array
    segment: Segment
    active: Array
    waiting: Array
    fresh: Array
    status: Array


@noun
class Recorded(AbstractTracer):
    """Plays back `Segments`. Gradients: with respect to their scalars and lengths.

    reverse: from behind; an `Over` that composites back to front sets it.
    """

    takes: ClassVar[type] = Segments

    reverse: bool = static(default=False)

    def reversed(self) -> Recorded:
        return Recorded(not self.reverse)

    def prepare(self, volume: Segments) -> Nodes:
        return Nodes(volume.scalar, volume.length)

    def longest(self, scene: Nodes) -> Array:
        return jnp.max(scene.length)

    def prepare_rays(self, scene: Nodes, rays: Runs) -> Runs:
        """Here rays are runs of nodes."""
        return rays

    def start(self, scene: Nodes, rays: Runs) -> PlayState:
        zero = jnp.zeros(rays.first.shape, scene.scalar.dtype)
        no = jnp.zeros(rays.first.shape, bool)
        node = rays.end if self.reverse else rays.first
        return PlayState(node, Segment(zero, zero, zero), no, ~no, no, jnp.zeros_like(rays.first))

    def step(self, scene: Nodes, rays: Runs, state: PlayState, move: Array) -> PlayState:
        if self.reverse:
            return _step_back(scene, rays, state, move)
        move = (move & state.active) | state.waiting
        first = move & state.waiting
        node = jnp.where(move, state.node + 1, state.node)
        active = jnp.where(move, node < rays.end, state.active)
        at = jnp.minimum(node, jnp.maximum(rays.end - 1, 0))
        front = jnp.where(first, scene.scalar[jnp.maximum(at - 1, 0)], state.segment.back)
        segment = Segment(
            jnp.where(move, front, state.segment.front),
            jnp.where(move, scene.scalar[at], state.segment.back),
            jnp.where(active, scene.length[at], 0),
        )
        # A node of length 0 is a jump: there is nothing to integrate, only a place to go to.
        jump = move & active & (segment.length == 0)
        segment = segment._replace(front=jnp.where(jump, segment.back, segment.front))
        return PlayState(
            node, segment, active, jnp.zeros_like(first), (first | jump) & active, state.status
        )

    def locate(self, scene, rays, state):
        raise ValueError(
            "Recorded segments know scalars and lengths, but not which cells they came from. "
            "Probe the volume itself."
        )

    def gradient_start(self, scene, rays, perturbed):
        asked = zip(scene, perturbed[0], strict=True)
        return Nodes(*(jnp.zeros_like(x) if p else None for x, p in asked)), None

    def pull_back(self, scene, rays, state, cotangent, gradient):
        (scalar, length), _ = gradient
        live = state.active
        if self.reverse:
            cotangent = turned(cotangent)
        if scalar is not None:
            # A jump takes its front from its own node.
            before = jnp.where(state.segment.length == 0, 0, 1)
            ids = jnp.concatenate([jnp.maximum(state.node - before, 0), state.node])
            bars = jnp.concatenate([cotangent.front, cotangent.back])
            scalar = scalar.at[ids].add(jnp.where(jnp.concatenate([live, live]), bars, 0))
        if length is not None:
            length = length.at[state.node].add(jnp.where(live, cotangent.length, 0))
        return Nodes(scalar, length), None

    def scene_cotangent(self, scene, gradient):
        asked = zip(scene, gradient, strict=True)
        return Nodes(*(jnp.zeros_like(x) if g is None else g for x, g in asked))

    def rays_cotangent(self, rays, gradient):
        return rays


def _step_back(scene: Nodes, rays: Runs, state: PlayState, move: Array) -> PlayState:
    """`Recorded.step` from behind."""
    move = (move & state.active) | state.waiting
    node = jnp.where(move, state.node - 1, state.node)
    active = jnp.where(move, node > rays.first, state.active)
    at = jnp.maximum(node, 0)
    length = jnp.where(active, scene.length[at], 0)
    front = scene.scalar[at]
    # The ends of a jump are both its own scalar, so a jump starts where the one before ended, and
    # what follows it does not. Nor does the first segment, which follows a length of 0 too.
    back = jnp.where(length == 0, front, scene.scalar[jnp.maximum(at - 1, 0)])
    fresh = move & active & (state.segment.length == 0)
    no = jnp.zeros_like(move)
    return PlayState(node, Segment(front, back, length), active, no, fresh, state.status)


def record(tracer: AbstractTracer, scene: Any, rays: Any) -> tuple[Array, Array]:
    """Number of nodes of each ray, and status: the first of two passes. Both are (batches, R)."""

    def one(batch):
        def body(carry):
            state, count = carry
            move = state.active
            state = tracer.step(scene, batch, state, move)
            return state, count + _nodes_of(state)

        state = tracer.start(scene, batch)
        count = jnp.zeros(state.active.shape, jnp.int32)
        state, count = lax.while_loop(_going, body, (state, count))
        return count, state.status

    return lax.map(one, rays)


def fill(tracer: AbstractTracer, scene: Any, rays: Any, start: Array, total: int) -> Nodes:
    """The nodes (total,) of all rays: the second pass, writing from `start` (batches, R) on."""

    def one(nodes, inputs):
        batch, place = inputs

        def body(carry):
            state, place, (scalar, length) = carry
            state = tracer.step(scene, batch, state, state.active)
            segment, number = state.segment, _nodes_of(state)
            jump = jnp.where(number == 2, place, total)
            last = jnp.where(number > 0, place + number - 1, total)
            ids = jnp.concatenate([jump, last])
            scalars = jnp.concatenate([segment.front, segment.back])
            lengths = jnp.concatenate([jnp.zeros_like(segment.length), segment.length])
            scalar = scalar.at[ids].set(scalars, mode="drop")
            length = length.at[ids].set(lengths, mode="drop")
            return state, place + number, (scalar, length)

        loop = (tracer.start(scene, batch), place, nodes)
        return lax.while_loop(_going, body, loop)[2], None

    first = tracer.start(scene, jax.tree.map(lambda x: x[0], rays))
    dtype = first.segment.length.dtype
    nodes = (jnp.zeros(total, dtype), jnp.zeros(total, dtype))
    return Nodes(*lax.scan(one, nodes, (rays, start))[0])


def _going(carry) -> Array:
    return jnp.any(carry[0].active | carry[0].waiting)


def _nodes_of(state: Any) -> Array:
    """A segment is one node, and one more where its front is not the back of the one before."""
    return jnp.where(state.active, 1 + state.fresh.astype(jnp.int32), 0)
