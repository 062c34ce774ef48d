"""Pytrees are frozen dataclasses: arrays are leaves, everything else is marked `static()`.

Of these, `pytree` is for data, whose equality is identity (`eq=False`), since comparing arrays has
no single truth value, and `noun` for what is swapped: a tracer, an integrator, a compositor. Those
are told apart by their words and numbers.

Constructors and factory functions validate; nothing happens in `__post_init__`, which JAX runs
again whenever it rebuilds data from its leaves (those may be tracers, `None` or `object()`).
"""

from __future__ import annotations

import dataclasses
import threading
import weakref
from typing import Any, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np

from jaxvr._core.modes import constant

T = TypeVar("T")


def static(**kwargs: Any) -> Any:
    """A field that is part of the tree's structure: hashable, compared by `==`, never an array."""
    return dataclasses.field(metadata={"static": True}, **kwargs)


@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(static,))
def pytree(cls: type[T]) -> type[T]:
    """Class decorator: a frozen dataclass that JAX can take apart and put together again."""
    made = dataclasses.dataclass(frozen=True, eq=False)(cls)
    fields = dataclasses.fields(made)  # type: ignore[arg-type]
    data = [f.name for f in fields if not f.metadata.get("static", False)]
    meta = [f.name for f in fields if f.metadata.get("static", False)]
    jax.tree_util.register_dataclass(made, data_fields=data, meta_fields=meta)
    return made


def held(words: str, **kwargs: Any) -> Any:
    """A field of a `noun` that is a number without a derivative; words: of the TypeError that is
    raised where one is asked for (see `refusing_derivatives`)."""
    return dataclasses.field(metadata={"held": words}, **kwargs)


@dataclass_transform(frozen_default=True, field_specifiers=(static, held))
def noun(cls: type[T]) -> type[T]:
    """Class decorator for what can be swapped (a tracer, an integrator, a compositor): a frozen
    dataclass with numbers as leaves, and words, counts and shapes as `static()`.

    Two are equal if their fields are, and can be hashed as far as those are Python's own numbers.
    Constructors check; JAX goes past them when it rebuilds one.
    """
    made = dataclasses.dataclass(frozen=True)(cls)
    fields = dataclasses.fields(made)  # type: ignore[arg-type]
    meta = [f.name for f in fields if f.metadata.get("static", False)]
    data = [f.name for f in fields if f.name not in meta]
    keys = [jax.tree_util.GetAttrKey(name) for name in data]

    def parts(noun: Any) -> tuple[list[Any], tuple[Any, ...]]:
        return [getattr(noun, k) for k in data], tuple(getattr(noun, k) for k in meta)

    def parts_by_key(noun: Any) -> tuple[list[Any], tuple[Any, ...]]:
        leaves, words = parts(noun)
        return list(zip(keys, leaves, strict=True)), words

    def rebuilt(words: Any, leaves: Any) -> Any:
        new = object.__new__(made)
        for name, value in (*zip(data, leaves), *zip(meta, words)):
            object.__setattr__(new, name, value)
        return new

    jax.tree_util.register_pytree_with_keys(made, parts_by_key, rebuilt, parts)
    return made


_registering = threading.Lock()
_made_static: weakref.WeakSet[type] = weakref.WeakSet()


def registered(name: str, given: Any) -> Any:
    """A noun as a pytree. One whose class nobody registered is static from now on: a node without
    leaves, by its `==` and its hash.

    name: what it is to the user. Raises ValueError if it can be neither.
    """
    kind = type(given)
    if kind not in _made_static:
        if not jax.tree_util.all_leaves([given]):
            return given
        _require_static(name, given)
        with _registering:
            if jax.tree_util.all_leaves([given]):
                jax.tree_util.register_static(kind)
                _made_static.add(kind)
        return given
    _require_static(name, given)
    return given


def _require_static(name: str, given: Any) -> None:
    """Raises ValueError for an object that holds arrays, or has no hash: what is differentiated
    would be taken for a constant."""
    why = "holds arrays" if _holds_arrays(given) else None
    if why is None:
        try:
            hash(given)
            return
        except TypeError as error:
            why = f"cannot be hashed ({error})"
    raise ValueError(
        f"{name} is a {type(given).__name__} that {why}, and no pytree. If its arrays or numbers "
        "are to have derivatives, make them leaves: put @jax.tree_util.register_dataclass on the "
        "class, above @dataclasses.dataclass(frozen=True), and metadata={'static': True} on fields "
        "that are no numbers."
    )


def _holds_arrays(given: Any) -> bool:
    return any(
        isinstance(x, jax.Array) or (dataclasses.is_dataclass(x) and _holds_arrays(x))
        for x in jax.tree.leaves(dict(getattr(given, "__dict__", {})))
    )


def with_leaves_of(name: str, given: Any, dtype: Any) -> Any:
    """A noun whose numbers are arrays of a dtype; arrays of integers or bools stay what they are.
    Python's and NumPy's become NumPy's, which costs less than JAX's and is the same to `jit`.

    Raises ValueError for a leaf that is neither a number nor an array.
    """
    leaves, structure = jax.tree.flatten(given)
    if not leaves:
        return given
    return structure.unflatten([_as_array(name, x, dtype) for x in leaves])


def _as_array(name: str, x: Any, dtype: Any) -> Any:
    if isinstance(x, int | float) and not isinstance(x, bool):  # np.float64 is a float
        return np.asarray(x, dtype)
    if not (hasattr(x, "dtype") and hasattr(x, "shape")) and not isinstance(x, bool):
        raise ValueError(
            f"{name} has {x!r} in a field, which is neither a number nor an array: mark the field "
            "with dataclasses.field(metadata={'static': True})."
        )
    if not isinstance(x, jax.Array):
        x = np.asarray(x)
    return x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x


def refusing_derivatives(given: T) -> T:
    """A noun that raises TypeError where it is differentiated by a field that is `held`."""
    if not dataclasses.is_dataclass(given):
        return given
    words = {f.name: f.metadata["held"] for f in dataclasses.fields(given) if "held" in f.metadata}
    # A class that is not registered is static, and its numbers are no arrays.
    held = {k: x for k in words if hasattr(x := getattr(given, k), "dtype")}
    parts = {k: constant(x, words[k]) for k, x in held.items()}
    return dataclasses.replace(given, **parts) if parts else given  # type: ignore[type-var]
