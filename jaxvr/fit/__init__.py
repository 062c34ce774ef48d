"""Fitting: parameters that make pictures look like given ones.

`fit` finds a transfer function, `fit_parameters` anything that a loss can be written for. Views are
traced once and shaded at every iteration.

- `losses`: scalars from (predicted, target), and the smoothness prior;
- `parameters`: transforms between what an optimiser moves (any number) and what a transfer
  function may hold (colours in [0, 1], extinctions >= 0, sorted positions), one class each;
- `batches`: the rays of all views as minibatches of one shape, so that one function is compiled;
- `loop`: the iterations, with progress, early stop and checkpoints;
- `report`: the result and its numbers.

To add a transform, write a pytree with `to_value` and `to_raw`; to add a loss, pass a function.
"""

from jaxvr.fit.differences import CheckpointWarning
from jaxvr.fit.fit import fit
from jaxvr.fit.loop import FitError, LoopResult, fit_parameters
from jaxvr.fit.losses import l1, l2, smoothness
from jaxvr.fit.parameters import Ordered, Parameters, Sigmoid, Softplus, noise
from jaxvr.fit.report import FitResult

__all__ = [
    "CheckpointWarning",
    "FitError",
    "FitResult",
    "LoopResult",
    "Ordered",
    "Parameters",
    "Sigmoid",
    "Softplus",
    "fit",
    "fit_parameters",
    "l1",
    "l2",
    "noise",
    "smoothness",
]
