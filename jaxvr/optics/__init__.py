"""Optics: what scalars look like, and how a segment turns into a colour. Never sees geometry.

- `TransferFunction`: piecewise linear colour and extinction over control points (K,), with jumps.
- integrators (`integrator.AbstractIntegrator`): a `Segment` has scalars at its two ends and a
  length; an integrator gives its premultiplied rgb (3, R) and optical depth (R,). `Analytic` is
  exact, `Quadrature` an independent check of it.
- `partition`: where a segment crosses control points.

Invariants: extinction is per unit of world length and >= 0; rgb is linear and premultiplied.
To add an integrator of slabs, write `slab_integral` in a file of its own and list it here and in
the tests' registry, which crosses it with all tracers and adjoints.
"""

from jaxvr.optics.analytic import Analytic
from jaxvr.optics.integrator import AbstractIntegrator, AbstractSlabIntegrator
from jaxvr.optics.partition import Segment
from jaxvr.optics.quadrature import Quadrature
from jaxvr.optics.transfer import TransferFunction

__all__ = [
    "AbstractIntegrator",
    "AbstractSlabIntegrator",
    "Analytic",
    "Quadrature",
    "Segment",
    "TransferFunction",
]
