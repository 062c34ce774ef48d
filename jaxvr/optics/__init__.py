"""Optics: what scalars look like, and how a segment turns into a colour. Never sees geometry.

- `TransferFunction`: piecewise linear colour and extinction over control points (K,), with jumps.
- integrators (`integrator.AbstractIntegrator`): a `Segment` has scalars at its two ends and a
  length; an integrator gives its premultiplied rgb (3, R) and optical depth (R,).
  - of slabs, cut at control points: `Analytic` is exact, `PartialPreIntegration` looks the same
    integral up in a table, `Quadrature` is an independent check of both;
  - of whole segments (`whole`): `PreIntegration` looks them up in a table of the transfer function;
    `AverageColor` and `ConstantExtinction` look at their two ends only, for comparison.
- `partition`: where a segment crosses control points.

Invariants: extinction is per unit of world length and >= 0; rgb is linear and premultiplied.
To add an integrator of slabs, write `weights` in a file of its own and list it here and in the
tests' registry, which crosses it with all tracers and adjoints.
"""

from jaxvr.optics.analytic import Analytic
from jaxvr.optics.average_color import AverageColor
from jaxvr.optics.constant_extinction import ConstantExtinction
from jaxvr.optics.integrator import AbstractIntegrator, AbstractSlabIntegrator
from jaxvr.optics.partial import PartialPreIntegration
from jaxvr.optics.partition import Segment
from jaxvr.optics.preintegration import PreIntegration
from jaxvr.optics.quadrature import Quadrature
from jaxvr.optics.transfer import TransferFunction

__all__ = [
    "AbstractIntegrator",
    "AbstractSlabIntegrator",
    "Analytic",
    "AverageColor",
    "ConstantExtinction",
    "PartialPreIntegration",
    "PreIntegration",
    "Quadrature",
    "Segment",
    "TransferFunction",
]
