"""Derivatives that a function cannot give: refused in words that say what can.

JAX's own words name a primitive deep inside (`custom_lin`, `while`, a call of foreign code), or
nothing at all: a rule that was written for first derivatives is differentiated again without
complaint, whatever it holds fixed. Arrays that pass through these functions stay as they are.

`forward_only` and `reverse_only` rest on a linear primitive that is the identity. In forward mode
tangents are computed, so its evaluation is what `reverse_only` refuses; in reverse mode they are
unknown and the primitive is transposed, which is what `forward_only` refuses.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir


def forward_only(tree: Any, message: str) -> Any:
    """`tree`; raises TypeError(message) where it is differentiated in reverse mode."""
    return _floats(lambda x: _linear(x, message, False), tree)


def reverse_only(tree: Any, message: str) -> Any:
    """`tree`; raises TypeError(message) where it is differentiated in forward mode."""
    return _floats(lambda x: _linear(x, message, True), tree)


def constant(tree: Any, message: str) -> Any:
    """`tree`; raises TypeError(message) where it is differentiated at all.

    In a rule for derivatives of a function, where its arguments are perturbed only if derivatives
    of second order are taken.
    """
    return _floats(lambda x: _constant(x, message), tree)


def once_by(x: jax.Array, tree: Any, message: str) -> jax.Array:
    """`x`; raises TypeError(message) where it is differentiated with respect to `tree`.

    In a rule for derivatives that is right for first ones only: `x` is what tangents are multiplied
    by, held fixed, and `tree` what it would depend on were it not. Other derivatives of `x` go
    through. (Not for tangents: in reverse mode JAX drops the rules of what is unknown.)
    """
    return _once_by(x, jax.tree.leaves(tree), message)


@contextlib.contextmanager
def custom_vjp_refused(message: str | None) -> Iterator[None]:
    """Round a call of a function with a `custom_vjp`: JAX's error of forward mode becomes
    TypeError(message); None leaves it as it is. For what `reverse_only` cannot refuse: `jacfwd`
    under a user's own jit, where batched tangents are looked at before any is computed."""
    try:
        yield
    except TypeError as error:
        if message is None or "custom_vjp" not in str(error):
            raise
        raise TypeError(message) from error


def _floats(function: Callable[[jax.Array], jax.Array], tree: Any) -> Any:
    return jax.tree.map(lambda x: function(x) if jnp.issubdtype(x.dtype, jnp.floating) else x, tree)


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def _constant(x: jax.Array, message: str) -> jax.Array:
    return x


@_constant.defjvp
def _constant_jvp(message: str, primals: Any, tangents: Any) -> Any:
    raise TypeError(message)


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def _once_by(x: jax.Array, leaves: Any, message: str) -> jax.Array:
    return x


def _once_by_jvp(message: str, primals: Any, tangents: Any) -> Any:
    x_dot, leaves_dot = tangents
    if not all(isinstance(t, jax.custom_derivatives.SymbolicZero) for t in leaves_dot):
        raise TypeError(message)
    if isinstance(x_dot, jax.custom_derivatives.SymbolicZero):
        x_dot = jnp.zeros_like(primals[0])
    return primals[0], x_dot


_once_by.defjvp(_once_by_jvp, symbolic_zeros=True)


@partial(jax.custom_jvp, nondiff_argnums=(1, 2))
def _linear(x: jax.Array, message: str, reverse: bool) -> jax.Array:
    return x


@_linear.defjvp
def _linear_jvp(message: str, reverse: bool, primals: Any, tangents: Any) -> Any:
    return primals[0], _mode.bind(tangents[0], message=message, reverse=reverse)


_mode = Primitive("jaxvr_mode")


def _evaluate(x: Any, *, message: str, reverse: bool) -> Any:
    if reverse:
        raise TypeError(message)
    return x


def _lower(_: Any, x: Any, *, message: str, reverse: bool) -> Any:
    return [_evaluate(x, message=message, reverse=reverse)]


def _transpose(cotangent: Any, x: Any, *, message: str, reverse: bool) -> Any:
    if not reverse:
        raise TypeError(message)
    return (cotangent,)


def _batch(operands: Any, axes: Any, **params: Any) -> Any:
    return _mode.bind(*operands, **params), axes[0]


def _jvp(primals: Any, tangents: Any, **params: Any) -> Any:
    out = _mode.bind(*primals, **params)
    (tangent,) = tangents
    return out, tangent if type(tangent) is ad.Zero else _mode.bind(tangent, **params)


_mode.def_impl(_evaluate)
_mode.def_abstract_eval(lambda x, **_: x)
mlir.register_lowering(_mode, _lower)
ad.primitive_transposes[_mode] = _transpose
ad.primitive_jvps[_mode] = _jvp
batching.primitive_batchers[_mode] = _batch
