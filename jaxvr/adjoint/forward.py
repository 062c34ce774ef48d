"""A while loop that JAX differentiates in forward mode."""

from __future__ import annotations

import dataclasses

from jaxvr._core.modes import forward_only
from jaxvr.adjoint.base import AbstractAdjoint, march_while, result, run_batches

_REVERSE = (
    "Forward gives forward mode (jvp, jacfwd, linearize) only. For reverse mode (grad, vjp, "
    "jacrev) render with adjoint=Replay(), the default, or with adjoint=Direct(max_steps) on small "
    "problems."
)


@dataclasses.dataclass(frozen=True)
class Forward(AbstractAdjoint):
    """`jvp`, `jacfwd` and `linearize`-free forward mode; reverse mode is an error.

    Costs one render and about as much again for each tangent, at constant memory. Use it for a
    handful of parameters (a camera, one light), for Jacobian-vector products, and to check the
    others. For many parameters use `Replay`.
    """

    def run(self, pipeline, operands):
        found = run_batches(lambda one: result(march_while(pipeline, one)), operands)
        return forward_only(found, _REVERSE)
