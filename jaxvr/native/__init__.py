"""Compiled loops for the pipeline that most renders are: the same results, many times as fast.

XLA runs a loop over rays kernel by kernel, on one thread, with every intermediate stored. Written
in C, one pass over a block of rays is a handful of vector loops whose operands stay in the cache,
and XLA's own threads share the blocks. `src/` follows the JAX code line by line: the same signs of
predicates, the same pieces and sums; numbers agree to rounding. JAX's loops stay the reference, and
serve wherever these do not: on accelerators, for other integrators, tracers and adjoints, and where
no C compiler is found. `jaxvr.engine.C` is how a pipeline gets here.

A loop here is a function of the typed foreign function interface of XLA (`jax.ffi`), so that it
works under a user's `jit` and `grad` (through `Replay`), and one after the other under `vmap`.
Ctrl-C ends these loops within a fraction of a second. It does not end JAX's own: XLA has no way to
stop what it runs, so Python learns of it when the picture is done. Render fewer rays at a time, or
end the process by another signal.

`build` compiles and registers, `kernels` calls, `nouns` lists what is written and how it is packed.
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from jaxvr.native import build, kernels


def missing(dtype: Any = "float32") -> str | None:
    """None where compiled loops for a dtype, float32 or float64, are available on this machine,
    else why not. Compiles them."""
    if jax.default_backend() != "cpu":
        return f"JAX computes on {jax.default_backend()}, and these loops are for CPUs."
    name = np.dtype(dtype).name
    if name not in ("float32", "float64"):
        return f"There are none for {name}."
    return build.load(name)


__all__ = ["kernels", "missing"]
