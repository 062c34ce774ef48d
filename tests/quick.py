"""Compiling in a third of the time, for tests of what is computed and not of how it is rounded:
those of exactness, lost rays and speed keep what users get. (What XLA reserves is decided before.)

Compiling is nearly all the time that the tests take. Left out are LLVM's optimiser, and XLA's
emitters by way of MLIR, which set up a compiler for each kernel; its older ones, where there are
any, do the same.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp

from jaxvr._core.checks import is_concrete

PLAIN = jax.jit


def accepted(options: dict[str, Any]) -> dict[str, Any]:
    """Those of some options that the installed XLA has. Options come and go with its versions (the
    older emitters went with jax 0.12), and only compiling tells."""

    def known(name: str) -> bool:
        try:
            PLAIN(jnp.negative, compiler_options={name: options[name]})(1.0)
        except jax.errors.JaxRuntimeError as error:
            if "No such compile option" not in str(error):
                raise
            return False
        return True

    return {name: value for name, value in options.items() if known(name)}


EMITTERS = accepted({"xla_cpu_use_fusion_emitters": False})
UNOPTIMISED = accepted({"xla_backend_optimization_level": 0})
jit = functools.partial(jax.jit, compiler_options=EMITTERS | UNOPTIMISED)
# With LLVM's optimiser, which fuses products and sums: where those may be rounded once or twice.
rounded_jit = functools.partial(
    jax.jit, compiler_options=EMITTERS | {"xla_backend_optimization_level": 3}
)


def outermost_jit(function: Any = None, **options: Any) -> Any:
    """A stand-in for `jax.jit` that compiles quickly what is not called within another `jit`."""
    if function is None:
        return functools.partial(outermost_jit, **options)
    own, quick = PLAIN(function, **options), jit(function, **options)

    @functools.wraps(function)
    def call(*args, **more):
        concrete = is_concrete(*jax.tree.leaves((args, more)))
        return (quick if concrete else own)(*args, **more)

    for name in ("lower", "_cache_size", "clear_cache"):
        setattr(call, name, getattr(quick, name))
    return call
