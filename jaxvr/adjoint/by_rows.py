"""Reverse mode for tracers that say what their segments hang on.

Of a tracer come two things: `address`, the rows of the scene's arrays that the current segments
were made of, and `segment`, how they were made of them. The rest is alike for all: gather the rows,
`jax.vjp` of `segment`, and add the cotangents to where the rows came from. What found the segment,
the state, is held.

A tracer may do all of that by hand instead, by four methods from `gradient_start` to
`rays_cotangent`: those of tetrahedra do, for speed.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jaxvr.optics.partition import Segment
from jaxvr.trace.base import AbstractTracer, Store, gather

Array = jax.Array


def reverse_of(tracer: Any, geometric: bool) -> Any:
    """A tracer's own way, that by rows, or none.

    geometric: whether derivatives by the scene or the rays are asked for at all.

    Raises:
      ValueError: if they are, and the tracer has no way: a gradient of 0 would be no one's notice.
    """
    if _has(tracer, "pull_back"):
        return tracer
    missing = [name for name in ("address", "segment") if not _has(tracer, name)]
    if geometric and missing:
        raise ValueError(
            f"{type(tracer).__name__} has no {' and no '.join(missing)}, so that reverse mode "
            "knows no way from its segments back to the volume and the rays. Write both (see "
            "jaxvr.trace.AbstractTracer); or differentiate its step as it is, with "
            "adjoint=Direct(max_steps) on small problems, or adjoint=Forward() in forward mode."
        )
    return ByRows(tracer)


def _has(tracer: Any, name: str) -> bool:
    """Whether a tracer writes a method itself."""
    own = getattr(type(tracer), name, None)
    return own is not None and own is not getattr(AbstractTracer, name)


@dataclasses.dataclass(frozen=True)
class ByRows:
    """The way back of a tracer with `address` and `segment`. Gradients are lists of the float
    leaves of (rows, whole), and of the rays, in order; None at those that nobody asks for."""

    tracer: Any

    def gradient_start(self, scene, rays, perturbed):
        return _zeros(scene, perturbed[0]), _zeros(rays, perturbed[1])

    def pull_back(self, scene, rays, state, cotangent, gradient):
        by_scene, by_rays = gradient
        live, held = state.active, jax.tree.map(lax.stop_gradient, state)
        address = self.tracer.address(held)
        rows, whole, held_rays = gather(scene.rows, address), scene.whole, rays
        leaves, structure = jax.tree.flatten((rows, whole, held_rays))
        floats = [k for k, x in enumerate(leaves) if _is_float(x)]

        def forward(values):
            all_of = dict(zip(floats, values, strict=True))
            made = structure.unflatten([all_of.get(k, x) for k, x in enumerate(leaves)])
            return self.tracer.segment(*made, held)

        _, back = jax.vjp(forward, [leaves[k] for k in floats])
        (bars,) = back(Segment(*(jnp.where(live, x, 0) for x in cotangent)))
        bars = dict(zip(floats, bars, strict=True))
        numbers = jax.tree.leaves(address)
        count, shared = len(numbers), len(jax.tree.leaves(whole))
        new: list[Any] = []
        for k, total in enumerate(by_scene):
            if total is not None and k < count:
                where = (numbers[k] >= 0) & live[None]
                bar = jnp.where(_beside(where, bars[k]), bars[k], 0)
                total = total.at[jnp.maximum(numbers[k], 0)].add(bar)
            elif total is not None:
                total = total + bars[k]
            new.append(total)
        after = count + shared
        moved = [
            None if x is None else x + jnp.where(_last(live, x), bars[after + k], 0)
            for k, x in enumerate(by_rays)
        ]
        return new, moved

    def scene_cotangent(self, scene, gradient):
        parts = (scene.rows, scene.whole) if isinstance(scene, Store) else scene
        leaves, structure = jax.tree.flatten(parts)
        filled = structure.unflatten(_filled(leaves, gradient))
        if not isinstance(scene, Store):
            return filled
        held = jax.tree.map(jnp.zeros_like, scene.held)
        rows, whole = filled
        return Store(rows, whole, held)

    def rays_cotangent(self, rays, gradient):
        leaves, structure = jax.tree.flatten(rays)
        return structure.unflatten(_filled(leaves, gradient))


def _is_float(x: Any) -> bool:
    return jnp.issubdtype(x.dtype, jnp.floating)


def _zeros(tree: Any, asked: Any) -> list[Any]:
    if isinstance(tree, Store):
        tree, asked = (tree.rows, tree.whole), (asked.rows, asked.whole)
    pairs = zip(jax.tree.leaves(tree), jax.tree.leaves(asked), strict=True)
    return [jnp.zeros_like(x) if a and _is_float(x) else None for x, a in pairs]


def _filled(leaves: list[Any], gradient: list[Any]) -> list[Any]:
    pairs = zip(leaves, gradient, strict=True)
    return [jnp.zeros_like(x) if g is None else g for x, g in pairs]


def _beside(flag: Array, x: Array) -> Array:
    """A flag (C, R) beside rows (C, R, ...)."""
    return jnp.reshape(flag, flag.shape + (1,) * (x.ndim - flag.ndim))


def _last(flag: Array, x: Array) -> Array:
    """A flag (R,) beside arrays (..., R)."""
    return jnp.reshape(flag, (1,) * (x.ndim - 1) + flag.shape)
