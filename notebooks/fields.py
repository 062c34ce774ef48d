"""An extension of griffe, with which mkdocstrings reads docstrings: see `notebooks.site.listed`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import griffe  # pyright: ignore[reportMissingImports]

from notebooks.site import listed


class Fields(griffe.Extension):
    """Rewrites the docstrings of classes and functions, fields and arguments as lists."""

    def on_class(self, *, cls: griffe.Class, **_: Any) -> None:
        self._rewrite(cls, [*cls.members, *(p.name for p in cls.parameters)])

    def on_function(self, *, func: griffe.Function, **_: Any) -> None:
        self._rewrite(func, [p.name for p in func.parameters])

    def _rewrite(self, thing: Any, names: Iterable[str]) -> None:
        if thing.docstring:
            thing.docstring.value = listed(thing.docstring.value, set(names) - {"self"})
