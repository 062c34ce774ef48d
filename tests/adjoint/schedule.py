"""How many iterations a batch takes: for tests of the schedule, not only of its answer."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax.numpy as jnp
import quick
from jax import lax

from jaxvr.adjoint import Pipeline
from jaxvr.adjoint.base import Operands, begin, busy, iterate
from jaxvr.trace import RayCast, Recorded, Segments
from jaxvr.trace.recorded import Runs
from jaxvr.view.rays import Rays


@partial(quick.jit, static_argnums=(0, 1, 2))
def iterations(integrator, compositor, shorten: bool, volume: Any, rays: Any, transfer: Any):
    """Iterations () of one batch of rays, by the loop of `march_while`.

    volume: a mesh with rays (origins, directions) (R, 3), or segments. shorten: with the table of
    `Replay`'s forward pass.
    """
    tracer: Any = Recorded() if isinstance(volume, Segments) else RayCast()
    if isinstance(volume, Segments):
        rays = Runs(volume.start[:-1], volume.start[1:])
    else:
        rays = Rays(*rays)
    pipeline, scene = Pipeline(tracer, integrator, compositor), tracer.prepare(volume)
    rays = tracer.prepare_rays(scene, rays)
    table = integrator.prepare(transfer, transfer.positions.dtype, tracer.longest(scene))
    if shorten:
        table = integrator.shorten(table, True)
    operands = Operands(scene, rays, table)

    def body(carry):
        march, count = carry
        return iterate(pipeline, operands, march), count + 1

    loop = begin(pipeline, operands), jnp.zeros((), jnp.int32)
    return lax.while_loop(lambda carry: busy(carry[0]), body, loop)[1]
