"""The iterations of a fit, whatever it fits.

One iteration takes a minibatch, a loss with its gradient, and one step of an optax optimiser. The
loss is compiled once. What batch an iteration takes depends on the seed and the iteration alone,
so that a fit resumed from a checkpoint goes on as if it had never stopped, bit for bit.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from jaxvr._core.status import check
from jaxvr.fit import digest, resume
from jaxvr.fit.differences import environment

if TYPE_CHECKING:  # it takes a while to import
    import optax


class FitError(RuntimeError):
    """A fit cannot go on: its loss or gradient is no longer finite."""


@dataclasses.dataclass(frozen=True, eq=False)
class LoopResult:
    """What `fit_parameters` returns.

    parameters: after the last step. loss_history (n,) float64: loss[i] is that of iteration i,
    before its step. seconds (m,): wall time of the iterations made in this call, the first with
    compilation. stopped: why it ended: "iterations", "callback" or "patience".
    """

    parameters: Any
    loss_history: np.ndarray
    seconds: np.ndarray
    stopped: str

    def __repr__(self) -> str:
        losses = self.loss_history
        ends = f"loss {losses[0]:.3g} to {losses[-1]:.3g}, " if len(losses) else ""
        return f"LoopResult({len(losses):,} iterations, {ends}stopped by {self.stopped})"

    @property
    def seconds_per_iteration(self) -> float:
        """Median, without the first iteration, which compiles; NaN if there was no other."""
        return float(np.median(self.seconds[1:])) if len(self.seconds) > 1 else float("nan")


@dataclasses.dataclass(frozen=True)
class Control:
    """When a loop ends, and what it says and writes on the way: see `fit_parameters`."""

    iterations: int = 200
    seed: int = 0
    progress: bool | None = None
    patience: int | None = None
    tolerance: float = 1e-3
    checkpoint: Any = None
    checkpoint_every: int = 50
    resume: bool = False

    def checked(self) -> Control:
        for name in ("iterations", "checkpoint_every", "patience"):
            n = getattr(self, name)
            if n is None and name == "patience":
                continue
            if isinstance(n, bool) or not isinstance(n, int | np.integer) or n < 1:
                raise ValueError(f"{name} must be a whole number of at least 1, but is {n!r}.")
        if not 0 <= self.tolerance < 1:
            raise ValueError(f"tolerance must lie in [0, 1), but is {self.tolerance!r}.")
        if self.resume and self.checkpoint is None:
            raise ValueError("resume=True needs checkpoint=, the file to resume from.")
        seed = self.seed
        if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
            raise ValueError(f"seed must be a whole number of at least 0, but is {seed!r}.")
        return self


def fit_parameters(
    loss: Callable[..., Any],
    parameters: Any,
    *,
    batches: Sequence[Any] | None = None,
    optimizer: optax.GradientTransformation | None = None,
    learning_rate: Any = 0.05,
    iterations: int = 200,
    seed: int = 0,
    progress: bool | None = None,
    callback: Callable[[int, float, Any], Any] | None = None,
    patience: int | None = None,
    tolerance: float = 1e-3,
    checkpoint: Any = None,
    checkpoint_every: int = 50,
    resume: bool = False,
) -> LoopResult:
    """Makes a loss small by gradient steps: the loop under `fit`, for values, points, cameras.

    Args:
      loss: from parameters, or from (parameters, batch) if there are batches, to a scalar. It is
        compiled; call `render` in it as usual.
      parameters: a pytree of float arrays.
      batches: pytrees of arrays of one structure and shape. Each epoch takes every batch once, in
        an order that the seed decides.
      optimizer: any of optax; None is `optax.adam(learning_rate)`.
      learning_rate: of Adam: a number, or a schedule from iteration to number. Adam's first steps
        are of that size in the parameters' own units: divide values, points and extinctions by
        what they are to be seen in, or choose the rate by them.
      progress: a bar with the loss; None shows it only on a terminal.
      callback: called after every step with (iteration, loss, parameters); if it returns True,
        the fit ends there.
      patience, tolerance: end when the mean loss of an epoch has not fallen below (1 - tolerance)
        times its earlier minimum for `patience` iterations.
      checkpoint: a file written every `checkpoint_every` iterations and at the end, whole or not at
        all. What is there is replaced if it is a checkpoint. The place is tried before the first
        step; failures to write are warnings after that.
      resume: go on from that file if it exists: the result is that of a fit that never stopped,
        to the bit, with the same other arguments (`iterations` counts all) on the same machine.
        Other ones are refused: the file holds digests of the start and the batches, and of the loss
        and the optimiser as JAX traces them, with all numbers and arrays in them. What a loss calls
        back in Python (`jax.pure_callback`) counts by its name. Loss and optimiser cannot be
        compared between versions of JAX or machines; then a warning says so.

    Raises:
      FitError: when loss or gradient are not finite, with the iteration. ValueError: for arguments
        out of range, parameters that are no floats, a checkpoint of another fit, and a file that is
        no whole checkpoint. OSError: for a place where no checkpoint can be written.

    Warns with a `jaxvr.fit.CheckpointWarning` of a checkpoint that could not be written, that holds
    more iterations than are asked for, or that was made by other versions or elsewhere.
    """
    control = Control(
        *(iterations, seed, progress, patience, tolerance, checkpoint, checkpoint_every, resume)
    ).checked()
    prepare(control)
    parameters = jax.tree.map(jnp.asarray, parameters)
    leaves = jax.tree.leaves(parameters)
    if not leaves or not all(jnp.issubdtype(x.dtype, jnp.floating) for x in leaves):
        raise ValueError(f"parameters must be float arrays, but are {[x.dtype for x in leaves]}.")
    if batches is not None and len(batches) == 0:
        raise ValueError("batches is empty. Pass None if the loss needs none.")

    def objective(parameters, *batch):
        return loss(parameters, *batch), jnp.zeros((), jnp.int32)

    gradient = jax.jit(jax.value_and_grad(objective, has_aux=True))
    count = 1 if batches is None else len(batches)

    def inputs(iteration: int) -> tuple[Any, ...]:
        return () if batches is None else (batches[batch_number(iteration, count, seed)],)

    def about(_: int) -> dict[str, Any]:
        digests = {"parameters": digest.data(parameters), "batches": digest.data(batches)}
        return {"verb": "fit_parameters", "digests": digests}

    return run(
        gradient, parameters, inputs, count, optimizer, learning_rate, control, callback, about
    )


def prepare(control: Control) -> None:
    """Looks at the checkpoint's place before anything is computed; raises what is wrong with it."""
    resume.prepare(control.checkpoint, control.resume)


def run(
    gradient: Callable[..., Any],
    parameters: Any,
    inputs: Callable[[int], tuple[Any, ...]],
    epoch: int,
    optimizer: Any,
    learning_rate: Any,
    control: Control,
    callback: Any,
    about: Callable[[int], dict[str, Any]],
) -> LoopResult:
    """The loop. `gradient(parameters, *inputs(i))` is ((loss, status bits), gradient), compiled.

    control: checked, its place prepared. about: from a number of iterations to what the state after
    them belongs to, beside the seed and the programs of gradient and optimiser.
    """
    optimizer = adam(learning_rate) if optimizer is None else optimizer
    if not (hasattr(optimizer, "init") and hasattr(optimizer, "update")):
        raise ValueError(
            f"optimizer must be an optax GradientTransformation, but is {type(optimizer).__name__}."
        )
    update = _update_of(optimizer)
    state = parameters, optimizer.init(parameters)
    losses: list[float] = []
    start = state

    @functools.cache
    def programs() -> dict[str, str]:
        optimizing = digest.data([digest.program(update, *start, start[0]), start[1]])
        whole = digest.program(gradient, start[0], *inputs(0))
        return {"the optimiser": optimizing, "the program of the loss": whole}

    def belongs(done: int) -> dict[str, Any]:
        given = about(done)
        shown = {"seed": int(control.seed), "batches in an epoch": epoch}
        more = {"programs": given.get("programs", {}) | programs()}
        return shown | {"environment": environment()} | given | more

    keeper = resume.Keeper(control.checkpoint, control.checkpoint_every, belongs)
    if control.resume:
        state, losses = keeper.restored(state, control.iterations)
    seconds: list[float] = []
    stopped = "iterations"
    with tqdm(
        total=control.iterations,
        initial=min(len(losses), control.iterations),
        disable=None if control.progress is None else not control.progress,
        desc="fit",
        unit="it",
    ) as bar:
        for i in range(len(losses), control.iterations):
            if is_stale(losses, epoch, control.patience, control.tolerance):
                stopped = "patience"
                break
            begin = time.perf_counter()
            (loss, status), slope = gradient(state[0], *inputs(i))
            state, finite = update(*state, slope)
            value = float(loss)
            if status.any():
                check(status)
            if not (np.isfinite(value) and finite):
                raise FitError(_not_finite(i, value, losses))
            losses.append(value)
            seconds.append(time.perf_counter() - begin)
            bar.set_postfix_str(f"loss {value:.3g}", refresh=False)
            bar.update()
            keeper.step(state, losses)
            if callback is not None and callback(i, value, state[0]):
                stopped = "callback"
                break
    keeper.end(state, losses)
    return LoopResult(state[0], np.asarray(losses), np.asarray(seconds), stopped)


def batch_number(iteration: int, count: int, seed: int) -> int:
    """Which of `count` batches an iteration takes: each once an epoch, in an order of its own."""
    if count == 1:
        return 0
    epoch, place = divmod(iteration, count)
    return int(np.random.default_rng([seed, epoch]).permutation(count)[place])


def is_stale(losses: list[float], epoch: int, patience: int | None, tolerance: float) -> bool:
    """Whether the mean loss of an epoch has not become smaller for `patience` iterations."""
    if patience is None or len(losses) < patience + epoch:
        return False
    means = np.convolve(losses, np.full(epoch, 1 / epoch), "valid")
    return bool(means[-patience:].min() > (1 - tolerance) * means[:-patience].min())


@functools.lru_cache(maxsize=8)
def _adam(learning_rate: Any) -> optax.GradientTransformation:
    import optax

    return optax.adam(learning_rate)


def adam(learning_rate: Any) -> optax.GradientTransformation:
    """Adam; the same object for the same rate, so that its step is compiled once."""
    if not callable(learning_rate) and not (
        isinstance(learning_rate, int | float | np.number) and 0 < learning_rate < np.inf
    ):
        raise ValueError(
            f"learning_rate must be a number above 0 or a schedule, but is {learning_rate!r}."
        )
    return _adam(learning_rate)


@functools.lru_cache(maxsize=8)
def _update_of(optimizer: Any) -> Callable[..., Any]:
    import optax

    @jax.jit
    def update(parameters, state, gradient):
        finite = jnp.stack([jnp.all(jnp.isfinite(g)) for g in jax.tree.leaves(gradient)]).all()
        change, state = optimizer.update(gradient, state, parameters)
        return (optax.apply_updates(parameters, change), state), finite

    return update


def _not_finite(iteration: int, loss: float, losses: list[float]) -> str:
    what = (
        "the gradient has NaN or infinite entries" if np.isfinite(loss) else f"the loss is {loss}"
    )
    before = f" (it was {losses[-1]:.6g} before)" if losses else ""
    return (
        f"At iteration {iteration} {what}{before}. Lower the learning rate, or look at the start "
        "and the targets if this is the first iteration."
    )
