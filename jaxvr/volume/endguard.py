"""Files that say so when a reader will not stop reading behind their end.

Several of meshio's readers wait in a loop for a line that a file cut short does not have, and would
wait for ever: at the end of a file every read returns nothing at once. `ending` lends meshio's
modules, while it is open, files that allow a number of such reads and then raise.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import threading
from collections.abc import Iterator
from typing import Any

PATIENCE = 1000  # reads of nothing in a row; a well-behaved reader needs a few
# where meshio's readers look up `open`
_MODULES = ("_files", "gmsh.main", "tetgen._tetgen", "vtk._main", "vtu._vtu")
_LOCK = threading.RLock()


class _Counted:
    """Mixed into a file class: counts reads that asked for something and got nothing."""

    _nothing = 0

    def _note(self, got: Any, size: int | None) -> Any:
        if got or size == 0:
            self._nothing = 0
        else:
            self._nothing += 1
            if self._nothing > PATIENCE:
                raise EOFError("the file ends too early")
        return got


class _Bytes(_Counted, io.BufferedReader):
    def read(self, size: int | None = -1, /) -> bytes:
        return self._note(super().read(size), size)

    def readline(self, size: int | None = -1, /) -> bytes:
        return self._note(super().readline(size), size)


class _Text(_Counted, io.TextIOWrapper):
    def read(self, size: int | None = -1, /) -> str:
        return self._note(super().read(size), size)

    def readline(self, size: int = -1, /) -> str:  # type: ignore[override]
        return self._note(super().readline(size), size)


def _open(path: Any, mode: str = "r", *args: Any, **kwargs: Any) -> Any:
    if mode == "rb" and not args and not kwargs:
        return _Bytes(io.FileIO(path))
    if mode in ("r", "rt") and not args and not kwargs:
        return _Text(io.BufferedReader(io.FileIO(path)))
    return open(path, mode, *args, **kwargs)


@contextlib.contextmanager
def ending() -> Iterator[None]:
    """While this is open, what meshio opens for reading ends with an EOFError, not in a loop."""
    modules = [importlib.import_module(f"meshio.{name}") for name in _MODULES]
    with _LOCK:
        for m in modules:
            m.__dict__["open"] = _open
        try:
            yield
        finally:
            for m in modules:
                m.__dict__.pop("open", None)
