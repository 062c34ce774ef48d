"""What data and programs are, in 32 characters: two that differ have different digests.

Data are leaves of pytrees with their dtypes, shapes and bits, and numbers, texts, nested. A program
is a function as JAX traces it at given shapes: its operations with all their constants, arrays that
it closes over included, so that a learning rate or a loss written in place is seen as well as one
of another name. What it calls back in Python while it runs (`jax.pure_callback`) counts by name.
"""

from __future__ import annotations

import dataclasses
import enum
import functools
import hashlib
import re
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

_ADDRESS = re.compile(r"0x[0-9a-fA-F]+")


def data(x: Any) -> str:
    """Of arrays, numbers, texts, and dataclasses, tuples, lists and dicts of them. Functions and
    other objects count by their names."""
    digest = hashlib.blake2b(digest_size=16)
    _feed(digest.update, x, {})
    return digest.hexdigest()


def program(function: Callable[..., Any], *arguments: Any) -> str:
    """Of a function of pytrees of arrays, or of their shapes and dtypes.

    One that is jitted is traced once for this and for its next call.
    """
    return data(_traced(function, arguments))


def _traced(function: Any, arguments: tuple[Any, ...]) -> Any:
    given = function
    while isinstance(given, functools.partial) and not given.keywords:
        given, arguments = given.func, (*given.args, *arguments)
    trace = getattr(given, "trace", None)
    if trace is not None:
        return trace(*arguments).jaxpr
    fixed = len(function.args) if isinstance(function, functools.partial) else 0
    return jax.make_jaxpr(function)(*arguments[fixed:])


def plain(x: Any) -> str:
    """A repr without addresses, which are others in each process."""
    return _ADDRESS.sub("0x", repr(x))


def name_of(x: Any) -> str:
    """Of a function or a class."""
    x = getattr(x, "__wrapped__", x)
    return f"{getattr(x, '__module__', '')}.{getattr(x, '__qualname__', type(x).__qualname__)}"


def _feed(update: Callable[[Any], Any], x: Any, known: dict[int, Any]) -> None:
    """known: digests of the programs met before, by their ids, with what keeps them alive."""

    def say(text: str) -> None:
        update(text.encode(errors="surrogateescape") + b"\0")

    def feed(*parts: Any) -> None:
        for part in parts:
            _feed(update, part, known)

    if x is None or isinstance(x, bool | int | float | complex | str | bytes | enum.Enum):
        say(f"{type(x).__qualname__} {x!r}")
    elif isinstance(x, type):
        say(f"class {name_of(x)}")
    elif isinstance(x, np.dtype):
        say(f"dtype {x}")
    elif hasattr(x, "__array__") and hasattr(x, "dtype") and hasattr(x, "shape"):
        array = raw(x)
        say(f"array {x.dtype} {x.shape}")
        update(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
    elif isinstance(x, Mapping):
        say(f"dict of {len(x)}")
        for key in sorted(x, key=lambda k: (type(k).__qualname__, plain(k))):
            feed(key, x[key])
    elif isinstance(x, tuple | list):
        say(f"{type(x).__qualname__} of {len(x)}")
        feed(*x)
    elif isinstance(x, set | frozenset):
        say(f"set of {len(x)}")
        feed(*sorted(data(part) for part in x))
    elif hasattr(x, "consts") and getattr(x, "jaxpr", x) is not x:  # jax.extend.core.ClosedJaxpr
        say("closed")
        feed(x.jaxpr, list(x.consts))
    elif hasattr(x, "eqns") and hasattr(x, "invars"):  # jax.extend.core.Jaxpr
        if id(x) not in known:
            inner = hashlib.blake2b(digest_size=16)
            _feed_jaxpr(inner.update, x, known)
            # Newer versions of JAX have one class for both.
            _feed(inner.update, list(getattr(x, "consts", ())), known)
            known[id(x)] = inner.hexdigest(), x
        say(f"program {known[id(x)][0]}")
    elif dataclasses.is_dataclass(x):
        say(f"fields of {name_of(type(x))}")
        for field in dataclasses.fields(x):
            feed(field.name, getattr(x, field.name))
    elif callable(x) or hasattr(x, "f_transformed"):
        say(f"function {name_of(x)}")
    else:
        say(f"{name_of(type(x))} {plain(x)}")


def raw(x: Any) -> np.ndarray:
    """An array as NumPy has it; of random keys, what they are made of."""
    if isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
        x = jax.random.key_data(x)
    return np.asarray(x)


def _feed_jaxpr(update: Callable[[bytes], Any], jaxpr: Any, known: dict[int, Any]) -> None:
    """Variables count by the order in which they come up."""
    numbers: dict[Any, int] = {}

    def atom(x: Any) -> Any:
        if hasattr(x, "val"):  # a literal
            return "literal", str(x.aval), x.val
        return numbers.setdefault(x, len(numbers))

    def bound(variables: Any) -> list[Any]:
        return [(atom(v), str(v.aval)) for v in variables]

    _feed(update, [bound(jaxpr.constvars), bound(jaxpr.invars)], known)
    for equation in jaxpr.eqns:
        inputs = [atom(v) for v in equation.invars]
        _feed(update, [equation.primitive.name, inputs, dict(equation.params)], known)
        _feed(update, bound(equation.outvars), known)
    _feed(update, [atom(v) for v in jaxpr.outvars], known)
