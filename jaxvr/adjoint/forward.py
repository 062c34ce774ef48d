"""A while loop that JAX differentiates in forward mode."""

from __future__ import annotations

import dataclasses

from jaxvr.adjoint.base import AbstractAdjoint, finish, march_while, run_batches


@dataclasses.dataclass(frozen=True)
class Forward(AbstractAdjoint):
    """`jvp`, `jacfwd` and `linearize`-free forward mode; reverse mode is an error of JAX.

    Costs one render and about as much again for each tangent, at constant memory. Use it for a
    handful of parameters (a camera, one light), for Jacobian-vector products, and to check the
    others. For many parameters use `Replay`.
    """

    def run(self, pipeline, operands):
        return run_batches(lambda one: finish(pipeline, march_while(pipeline, one)), operands)
