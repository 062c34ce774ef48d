"""A scan that JAX differentiates as it is: the readable reference for the other adjoints."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
from jax import lax

from jaxvr._core import status
from jaxvr.adjoint.base import (
    AbstractAdjoint,
    begin,
    busy,
    iterate,
    result,
    run_batches,
    traced_only,
)


@dataclasses.dataclass(frozen=True)
class Direct(AbstractAdjoint):
    """Forward and reverse mode of a scan of `max_steps` iterations.

    An iteration handles one piece: a ray needs as many as it crosses cells and control points.
    Reverse mode stores every iteration of every ray, some hundred bytes each, so memory grows with
    the length of the longest ray: do not use it for images of large meshes. It always makes
    `max_steps` iterations. Rays that need more have the status `STEPS`, an error outside jit.

    The loop is its own, of the steps that `jaxvr.engine.XLA` makes: no other engine can run it.
    """

    max_steps: int = 512

    def __post_init__(self):
        if not isinstance(self.max_steps, int) or self.max_steps < 1:
            raise ValueError(f"max_steps must be a positive integer, but is {self.max_steps!r}.")

    def refuses(self, engine):
        return traced_only(self, engine)

    def run(self, pipeline, operands, engine):
        def one(batch):
            def body(march, _):
                march = lax.cond(
                    busy(march), lambda m: iterate(pipeline, batch, m), lambda m: m, march
                )
                return march, None

            march, _ = lax.scan(body, begin(pipeline, batch), length=self.max_steps)
            pixel, bits = result(march)
            late = march.trace.active | march.trace.waiting
            return pixel, bits | jnp.where(late, status.STEPS, 0)

        return run_batches(one, operands)
