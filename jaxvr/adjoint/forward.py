"""A while loop that JAX differentiates in forward mode."""

from __future__ import annotations

import dataclasses

from jaxvr._core.modes import forward_only
from jaxvr.adjoint.base import AbstractAdjoint, traced_only

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

    def refuses(self, engine):
        return traced_only(self, engine)

    def run(self, pipeline, operands, engine):
        return forward_only(engine.march(pipeline, operands), _REVERSE)
