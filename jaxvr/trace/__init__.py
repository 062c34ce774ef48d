"""Tracers: they turn a volume and rays into ordered streams of segments.

A tracer is a frozen dataclass without arrays, split in the manner of an iterative method:

- `prepare(volume)` and `prepare_rays(...)` make the arrays that a step reads, differentiably;
- `start` and `step` move rays (R,) from segment to segment, in lock step: a `state` shows the
  current segment, which rays have one (`active`), and which of those segments do not start at the
  scalar where the one before ended (`fresh`);
- `pull_back` takes the cotangents of the current segment back to the floats of the scene and the
  rays, from the local operands alone. The replaying adjoint needs no more than that.

Integers are found without derivatives; floats are derived from what they gather. A new tracer is
one file, listed here and in the tests' registry.
"""

from jaxvr.trace.base import AbstractTracer
from jaxvr.trace.raycast import RayCast
from jaxvr.trace.recorded import Recorded, Segments

__all__ = ["AbstractTracer", "RayCast", "Recorded", "Segments"]
