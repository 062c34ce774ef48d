"""Tracers: they turn a volume and rays into ordered streams of segments.

A tracer is a frozen dataclass, whose numbers are leaves and the rest static (`_core.pytree.noun`),
split in the manner of an iterative method:

- `prepare(volume)` and `prepare_rays(...)` make the arrays that a step reads, differentiably; what
  a step is to read of the tracer's own numbers goes into the scene, for derivatives by `Replay`;
- `start` and `step` move rays (R,) from segment to segment, in lock step: a `state` shows the
  current segment, which rays have one (`active`), and which of those segments do not start at the
  scalar where the one before ended (`fresh`);
- `reversed` is the tracer of the same segments from behind, where there is one;
- `pull_back` takes the cotangents of the current segment back to the floats of the scene and the
  rays, from the local operands alone. The replaying adjoint needs no more than that.

Integers are found without derivatives; floats are derived from what they gather. A new tracer is
one file, listed here and in the tests' registry.
"""

from jaxvr.trace.base import AbstractTracer
from jaxvr.trace.kbuffer import KBuffer
from jaxvr.trace.measure import KMap, measure_k
from jaxvr.trace.rasterize import Fragments, rasterize
from jaxvr.trace.raycast import RayCast
from jaxvr.trace.recorded import Recorded, Segments

__all__ = [
    "AbstractTracer",
    "Fragments",
    "KBuffer",
    "KMap",
    "RayCast",
    "Recorded",
    "Segments",
    "measure_k",
    "rasterize",
]
