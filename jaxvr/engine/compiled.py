"""Loops in C, compiled on this machine: see `jaxvr.native`."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp

from jaxvr import native
from jaxvr.adjoint.base import Cotangents
from jaxvr.engine.base import AbstractEngine
from jaxvr.native.nouns import unwritten

Array = jax.Array


@dataclasses.dataclass(frozen=True)
class C(AbstractEngine):
    """Compiled loops for the pipelines that most renders are: the same results to rounding, many
    times as fast, on all cores.

    Refuses what `jaxvr.native.nouns` does not list, tracers and compositors that go from behind,
    accelerators, and machines where nothing can be compiled (`jaxvr.native.missing` says why).
    """

    confirms_cells: ClassVar[bool] = True

    def refuses(self, pipeline, dtype):
        nouns = (pipeline.tracer, pipeline.integrator, pipeline.compositor)
        return unwritten(*nouns) or native.missing(dtype)

    def march(self, pipeline, operands):
        state, status = native.kernels.composite(pipeline, operands)
        shape = jax.tree.leaves(operands.rays)[0].shape
        return jax.tree.map(lambda x: _by_batch(x, shape), state), status.reshape(shape)

    def pull_back(self, pipeline, operands, final, cotangent, asked):
        optical = any(jax.tree.leaves(asked.table))
        scene_bar, rays_bar, table_bar = native.kernels.pull_back(
            *(pipeline, operands),
            final=jax.tree.map(_flat, final),
            cotangent=jax.tree.map(_flat, cotangent),
            asked=(asked.scene, asked.rays, optical),
        )
        tracer = pipeline.tracer
        if optical:
            table_bar = pipeline.integrator.gradient_finish(operands.table, table_bar)
        # Nouns in C have no numbers with derivatives of their own.
        return Cotangents(
            tracer.scene_cotangent(operands.scene, scene_bar),
            tracer.rays_cotangent(operands.rays, rays_bar),
            table_bar,
            None,
            None,
        )

    def count(self, tracer, scene, rays):
        shape = jax.tree.leaves(rays)[0].shape
        return tuple(x.reshape(shape) for x in native.kernels.count_nodes(scene, rays))

    def fill(self, tracer, scene, rays, start, total):
        return native.kernels.fill_nodes(scene, rays, start, total)


def _by_batch(x: Array, shape: tuple[int, ...]) -> Array:
    """(..., N) of N rays as (batches, ..., R) of batches of R."""
    return jnp.moveaxis(x.reshape(*x.shape[:-1], *shape), -2, 0)


def _flat(x: Array) -> Array:
    """Back again."""
    return jnp.moveaxis(x, 0, -2).reshape(*x.shape[1:-1], -1)
