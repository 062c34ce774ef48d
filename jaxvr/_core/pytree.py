"""Pytrees are frozen dataclasses: arrays are leaves, everything else is marked `static()`.

Constructors and factory functions validate; nothing happens in `__post_init__`, which JAX runs
again whenever it rebuilds an object from its leaves (those may be tracers, `None` or `object()`).
Equality is identity (`eq=False`), since comparing arrays has no single truth value.
"""

from __future__ import annotations

import dataclasses
from typing import Any, TypeVar, dataclass_transform

import jax

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
