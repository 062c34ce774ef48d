"""Engines: what runs the loops along the rays.

An engine marches a pipeline over batches of rays, makes the same walk again for cotangents, and
records segments for `trace`: the same results to rounding, whichever engine runs. Adjoints say what
is differentiated and how; this is the only room that knows how loops run.

| engine | what it runs | where |
|---|---|---|
| `XLA()` | all nouns: the readable reference | everywhere; what accelerators run |
| `C()` | `RayCast`, `Recorded`, `Analytic`, compositors of this package | CPUs with a C compiler |

`render(..., engine=None)`, and so for all verbs, takes `C()` where it does not refuse, else
`XLA()`. That is asked at every call, outside of the verb's own `jit`; under yours it is asked while
tracing, and the answer is compiled in. An engine that is named and refuses is a ValueError with the
reason.

To add one: a class that derives from `AbstractEngine`, in a file here, and a line in `ENGINES` if
it is to be taken without being named.
"""

from jaxvr.engine.base import AbstractEngine
from jaxvr.engine.compiled import C
from jaxvr.engine.xla import XLA

# Those that serve where none is named: the first that does not refuse. The last never does.
ENGINES: tuple[AbstractEngine, ...] = (C(), XLA())

__all__ = ["XLA", "AbstractEngine", "C"]
