"""`assert_gradients`: every operand's gradient, against differences, forward mode, and history.

Differences of a function have two errors, of the step and of rounding, and no step is right for
all. Ridders' method ("Accurate computation of F'(x) and F'(x) F''(x)", Advances in Engineering
Software 4, 1982; Numerical Recipes, section 5.7) makes central differences with ever smaller steps,
extrapolates them to step 0, and takes the entry of the table that agrees best with its neighbours;
by how much those differ is its error bar, here never below that of rounding:

    D(h) = (f(x + h u) - f(x - h u)) / 2h,    T[i, 0] = D(h / c^i),
    T[i, j] = T[i, j - 1] + (T[i, j - 1] - T[i - 1, j - 1]) / (c^2j - 1).

JAX keeps for the life of a process what it has traced, and rules of a `custom_vjp` can leave in it
what later gradients read: a gradient may be right alone and 0 in company. So each is made alone,
with JAX's caches cleared, and once more in random orders, by random subsets of the operands, with
pullbacks alive at once.
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

RATIO = 2.0
# Rounding of one evaluation, in epsilons of the sum of the magnitudes of all outputs.
ROUNDING = 8.0
# A difference that is not known to this share of itself, or of all outputs, decides nothing.
KNOWN = 1e-3
FLOOR = 1e-7
# Between the orders of a process nothing but the order of sums over threads may differ.
SAME = 1e-10


@dataclasses.dataclass(frozen=True)
class GradientCheck:
    """The derivative along one direction.

    operand: whose. reverse: by the pullback. difference, error: by differences, and their error
    bar. forward: by forward mode, or None where the function does not support it.
    """

    operand: str
    reverse: float
    difference: float
    error: float
    forward: float | None


def assert_gradients(
    fn: Callable[..., Any],
    operands: Any,
    *,
    rtol: float = 1e-6,
    forward: Callable[..., Any] | bool | None = None,
    directions: int = 2,
    step: float = 1e-3,
    levels: int = 8,
    orders: int = 2,
    seed: int = 0,
) -> list[GradientCheck]:
    """Asks for right gradients of a function with respect to each of its operands.

    Args:
      fn: from operands to an array or a pytree of arrays, such as an image.
      operands: a dict of float64 arrays or pytrees, for keyword arguments of `fn` (or for its one
        argument, if it takes the dict as such), or a tuple, for positional ones. Integer leaves are
        handed on.
      rtol: how far reverse mode may be from differences, beside three times their error bar, and
        from forward mode; relative to the derivative.
      forward: the same function in a form that supports forward mode, as `render` does with
        `adjoint=jaxvr.Forward()`. None tries `fn` itself and reports where that cannot be done;
        True insists on it, False leaves it out.
      directions: how many random directions for each operand.
      step: the first and largest step, relative to the operand's root mean square. A function with
        kinks wants it below the distance of the nearest one.
      levels: steps in all, each half of the one before.
      orders: how many random orders to make all gradients in, alone and by subsets, each with JAX's
        caches cleared, since what was traced once hides how. 0 leaves this out, and clears nothing.
      seed: of all that is random. The outputs are summed with random weights from 0.5 to 1.5.

    Returns:
      What was compared, one entry for each operand and direction.

    Raises:
      ValueError: without x64, for operands that are not float64, or where there is nothing to
        differentiate. AssertionError: which operand, the derivative in all modes, and the error
        bar; or that the differences decide nothing (choose another `step`).
    """
    call, names, values = _bind(fn, operands)
    _require_double(names, values)
    rng = np.random.default_rng(seed)
    outputs = [np.asarray(x, np.float64) for x in jax.tree.leaves(call(values))]
    if not all(np.isfinite(x).all() for x in outputs):
        raise AssertionError("The function itself is NaN or infinite at the operands.")
    weights = [rng.uniform(0.5, 1.5, x.shape) for x in outputs]
    size = float(sum(np.abs(w * x).sum() for w, x in zip(weights, outputs, strict=True)))

    def total(out: Any) -> Any:
        return sum((w * x).sum() for w, x in zip(weights, jax.tree.leaves(out), strict=True))

    gradients = Gradients(lambda xs: total(call(xs)), names, values)
    alone = {}
    for name in names:
        if orders:
            jax.clear_caches()
        alone[name] = gradients.pullback((name,))()[name]
    us = [(name, direction(values[name], rng)) for name in names for _ in range(directions)]
    found = [_check(gradients, n, alone[n], u, size, rtol, step, levels) for n, u in us]
    along = _forward_of(fn, forward, operands, total)
    if along is not None:
        pairs = zip(found, us, strict=True)
        found = [_check_forward(along, check, u, size, rtol) for check, (_, u) in pairs]
    for number in range(orders):
        _check_order(gradients, alone, np.random.default_rng([seed, number]))
    return found


class Gradients:
    """Pullbacks of a scalar function by subsets of its operands. values: by name, all of them."""

    def __init__(self, scalar: Callable[..., Any], names: Sequence[str], values: dict[str, Any]):
        self.scalar, self.names, self.values = scalar, names, values

    def at(self, name: str, by: Any) -> float:
        """The function with one operand moved by a tree of its structure."""
        moved = jax.tree.map(lambda x, d: x if d is None else x + d, self.values[name], by)
        return float(self.scalar({**self.values, name: moved}))

    def pullback(self, names: tuple[str, ...]) -> Callable[[], dict[str, Any]]:
        """A function without arguments that gives the gradients by some operands."""
        parts = {n: _split(self.values[n]) for n in names}

        def chosen(floats):
            joined = {n: parts[n][1](floats[n]) for n in names}
            return self.scalar({**self.values, **joined})

        out, pull = jax.vjp(chosen, {n: parts[n][0] for n in names})
        return lambda: {
            n: [np.asarray(x, np.float64) for x in g]
            for n, g in pull(np.ones((), out.dtype))[0].items()
        }


def difference(
    f: Callable[[float], float], step: float, levels: int = 8, noise: float = 0.0
) -> tuple[float, float]:
    """The derivative of f(t) at t = 0 by Ridders' method, and its error bar.

    step: the first and largest. levels: how many, each half of the one before. noise: the error of
    one evaluation by rounding.
    """
    table = np.zeros((levels, levels))
    best, error = np.nan, np.inf
    for i in range(levels):
        h = step / RATIO**i
        table[i, 0] = (f(h) - f(-h)) / (2 * h)
        rounding = noise / h
        for j in range(1, i + 1):
            factor = RATIO ** (2 * j)
            table[i, j] = table[i, j - 1] + (table[i, j - 1] - table[i - 1, j - 1]) / (factor - 1)
            apart = max(abs(table[i, j] - table[i, j - 1]), abs(table[i, j] - table[i - 1, j - 1]))
            if max(apart, rounding) <= error:
                best, error = table[i, j], max(apart, rounding)
    return float(best), float(error)


def direction(operand: Any, rng: np.random.Generator) -> Any:
    """A random tree of the operand's structure: normal numbers times the root mean square of each
    leaf (1 where that is 0), so that derivatives along it have the function's own unit. None for
    integer leaves."""

    def one(x):
        if not _is_float(x):
            return None
        x = np.asarray(x)
        u = rng.normal(size=x.shape)
        scale = float(np.sqrt(np.mean(x * x))) if x.size else 1.0
        return u / max(float(np.sqrt(np.mean(u * u))), 1e-300) * (scale or 1.0)

    return jax.tree.map(one, operand)


def _check(gradients, name, gradient, u, size, rtol, step, levels) -> GradientCheck:
    floats = [np.asarray(d) for d in jax.tree.leaves(u)]
    reverse = float(sum((g * d).sum() for g, d in zip(gradient, floats, strict=True)))
    noise = ROUNDING * float(np.finfo(np.float64).eps) * size

    def along(t: float) -> float:
        return gradients.at(name, jax.tree.map(lambda d: t * d, u))

    value, error = difference(along, step, levels, noise)
    scale = max(abs(value), abs(reverse) if np.isfinite(reverse) else 0.0)
    told = f"reverse mode gives {reverse:.9g}, differences give {value:.9g} +- {error:.2g}"
    if not np.isfinite(reverse) or not all(np.isfinite(g).all() for g in gradient):
        raise AssertionError(f"The gradient by {name!r} is not finite: {told}.")
    if error > max(KNOWN * scale, FLOOR * size):
        raise AssertionError(
            f"Differences by {name!r} decide nothing: {told}. Choose another step, or an operand "
            "away from kinks."
        )
    if reverse == 0 and abs(value) > max(3 * error, FLOOR * size):
        raise AssertionError(f"The gradient by {name!r} is 0, but should not be: {told}.")
    if abs(reverse - value) > rtol * scale + 3 * error:
        raise AssertionError(f"The gradient by {name!r} is wrong: {told}.")
    return GradientCheck(name, reverse, value, error, None)


def _forward_of(fn, forward, operands, total) -> Callable[..., float] | None:
    """The derivative along a direction of an operand by forward mode, or None."""
    if forward is False:
        return None
    call, names, values = _bind(forward if callable(forward) else fn, operands)

    def along(name: str, u: Any) -> float:
        floats, join = _split(values[name])
        tangents = [np.asarray(d) for d in jax.tree.leaves(u)]
        _, out = jax.jvp(lambda xs: total(call({**values, name: join(xs)})), (floats,), (tangents,))
        return float(out)

    if forward is None:
        try:
            along(names[0], direction(values[names[0]], np.random.default_rng(0)))
        except TypeError as error:
            if "custom_vjp" not in str(error) and "forward" not in str(error).lower():
                raise
            return None
        except ValueError as error:  # FFI calls, and messages of our own
            if "differentia" not in str(error) and "forward" not in str(error).lower():
                raise
            return None
    return along


def _check_forward(along, check: GradientCheck, u: Any, size: float, rtol: float) -> GradientCheck:
    value = along(check.operand, u)
    scale = max(abs(value), abs(check.reverse), 1e-6 * size)
    if not abs(value - check.reverse) <= rtol * scale:
        raise AssertionError(
            f"The derivative by {check.operand!r} is {check.reverse:.12g} in reverse mode and "
            f"{value:.12g} in forward mode; differences give {check.difference:.9g} +- "
            f"{check.error:.2g}."
        )
    return dataclasses.replace(check, forward=value)


def _check_order(gradients: Gradients, alone: dict[str, Any], rng: np.random.Generator) -> None:
    """All operands by themselves, all together and one random subset, pullbacks alive at once."""
    names = list(gradients.names)
    subsets = {(n,) for n in names} | {tuple(names)}
    subsets.add(tuple(sorted(n for n in names if rng.random() < 0.5)) or (names[0],))
    made = sorted(subsets)
    made = [made[i] for i in rng.permutation(len(made))]
    jax.clear_caches()
    alive: list[tuple[tuple[str, ...], Any]] = []
    history: list[str] = []

    def call(number: int) -> None:
        subset, pull = alive.pop(number)
        history.append("call " + "+".join(subset))
        for name, got in pull().items():
            for a, b in zip(got, alone[name], strict=True):
                bound = SAME * max(float(np.abs(b).max(initial=0.0)), 1e-300)
                if not np.all(np.abs(a - b) <= bound):
                    what = "0" if not a.any() else "another"
                    raise AssertionError(
                        f"The gradient by {name!r} is {what} in this order, though it is right "
                        f"alone: {'; '.join(history)}. Largest difference "
                        f"{float(np.abs(a - b).max()):.3g} of {float(np.abs(b).max()):.3g}."
                    )

    for subset in made:
        alive.append((subset, gradients.pullback(subset)))
        history.append("make " + "+".join(subset))
        if rng.random() < 0.3:
            call(int(rng.integers(len(alive))))
    while alive:
        call(int(rng.integers(len(alive))))


def _bind(fn: Callable[..., Any], operands: Any) -> tuple[Any, list[str], dict[str, Any]]:
    """`fn` as a function of a dict by names, the names, and that dict."""
    if isinstance(operands, Mapping):
        values = dict(operands)
        keywords = _fits(fn, (), values)
        return (lambda xs: fn(**xs)) if keywords else fn, list(values), values
    if not isinstance(operands, tuple | list):
        operands = (operands,)
    names = [str(i) for i in range(len(operands))]
    kind = type(operands)
    if _fits(fn, operands, {}):
        call = lambda xs: fn(*[xs[n] for n in names])  # noqa: E731
    else:
        call = lambda xs: fn(kind([xs[n] for n in names]))  # noqa: E731
    return call, names, dict(zip(names, operands, strict=True))


def _fits(fn: Callable[..., Any], positional: Any, keywords: Any) -> bool:
    try:
        inspect.signature(fn).bind(*positional, **keywords)
    except TypeError:
        return False
    except ValueError:  # a function that does not say
        return True
    return True


def _require_double(names: list[str], values: dict[str, Any]) -> None:
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise ValueError(
            "assert_gradients needs float64, since differences in float32 have hardly a digit: "
            'call jax.config.update("jax_enable_x64", True) first.'
        )
    if not names:
        raise ValueError("There are no operands to differentiate by.")
    for name in names:
        floats = [x for x in jax.tree.leaves(values[name]) if _is_float(x)]
        if not floats:
            raise ValueError(f"The operand {name!r} has no floats to differentiate by.")
        for x in floats:
            if np.asarray(x).dtype != np.float64:
                raise ValueError(
                    f"The operand {name!r} has a leaf of {np.asarray(x).dtype}: pass float64."
                )


def _is_float(x: Any) -> bool:
    return np.issubdtype(np.asarray(x).dtype, np.floating)


def _split(tree: Any) -> tuple[list[Any], Callable[[Sequence[Any]], Any]]:
    """The float leaves of a tree, and what puts others in their place."""
    leaves, structure = jax.tree.flatten(tree)
    where = [i for i, x in enumerate(leaves) if _is_float(x)]

    def join(floats: Sequence[Any]) -> Any:
        new = list(leaves)
        for i, x in zip(where, floats, strict=True):
            new[i] = x
        return structure.unflatten(new)

    return [jax.numpy.asarray(leaves[i]) for i in where], join
