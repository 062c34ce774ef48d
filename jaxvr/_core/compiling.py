"""How the verbs are compiled: `jax.jit`, with compiler options that can be set from outside.

`OPTIONS` is empty for users. What compiles many small functions once each, as tests do, may set
XLA's options there that compile in a third of the time.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax

from jaxvr._core.checks import is_concrete

OPTIONS: dict[str, Any] = {}


def compiled(*static: int) -> Callable[[Callable[..., Any]], Compiled]:
    """A decorator like `jax.jit`. static: numbers of the arguments that are static."""
    return lambda function: Compiled(function, static)


class Compiled:
    """A function, compiled. What is traced already is left to the caller's own `jit` or `grad`,
    since options are those of the outermost."""

    def __init__(self, function: Callable[..., Any], static: tuple[int, ...]):
        functools.update_wrapper(self, function)
        self._compile = functools.partial(jax.jit, function, static_argnums=static)
        self._own: Any = self._compile()
        self._with: dict[Any, Any] = {}

    def __call__(self, *args: Any) -> Any:
        if not OPTIONS or not is_concrete(*jax.tree.leaves(args)):
            return self._own(*args)
        key = tuple(sorted(OPTIONS.items()))
        if key not in self._with:
            self._with[key] = self._compile(compiler_options=dict(OPTIONS))
        return self._with[key](*args)

    def lower(self, *args: Any) -> Any:
        """As that of `jax.jit`, with its own options."""
        return self._own.lower(*args)

    def _cache_size(self) -> int:
        """How many it has compiled, for tests that count."""
        return sum(one._cache_size() for one in (self._own, *self._with.values()))
