"""Adjoints: how gradients get back through the loop along a ray.

An adjoint is an object that says how what an engine runs is differentiated (`AbstractAdjoint.run`);
the steps along a ray are the same for all of them (`base`). This is the only room with
`custom_vjp`, which would block forward mode elsewhere.

| adjoint | modes | memory | when |
|---|---|---|---|
| `Replay` (default) | reverse | that of the result | fits of anything |
| `Forward` | forward | that of the result | few parameters, `jvp`, `jacfwd` |
| `Direct` | forward, reverse | grows with cells per ray | small problems, as a check |

All of them give one image and one gradient. Where rays end early (`Over(termination=...)`), that is
the gradient of the truncated image, and all end behind the same segments. Stretches without
extinction are passed in one piece by `Replay` only: the others differentiate the walk that they
make, and extinction has a derivative at 0 too.

A new adjoint is one file with one class, listed here and in the tests' registry.
"""

from jaxvr.adjoint.base import AbstractAdjoint, Pipeline
from jaxvr.adjoint.direct import Direct
from jaxvr.adjoint.forward import Forward
from jaxvr.adjoint.replay import Replay

__all__ = ["AbstractAdjoint", "Direct", "Forward", "Pipeline", "Replay"]
