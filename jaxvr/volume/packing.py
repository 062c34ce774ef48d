"""A cell and how it is entered, in one 32-bit word, so that a step of a walk gathers it at once.

    word = cell << 4 | flag << 3 | turned << 2 | corner

`corner` is the local index (0 to 3) of the vertex opposite the face; `turned` marks a cell that
lies the wrong way round among its neighbours (a fold); `flag` is the seam bit in `neighbors` and
the entry bit in `boundary` (see `TetMesh`). Boundaries in `neighbors` are -1. 2**27 cells fit.
"""

from __future__ import annotations

from typing import Any

MAX_CELLS = 1 << 27


def pack(cell: Any, corner: Any, turned: Any = 0, flag: Any = 0) -> Any:
    """All arguments are integers or integer arrays that broadcast together."""
    return (cell << 4) | (flag << 3) | (turned << 2) | corner


def cell_of(word: Any) -> Any:
    return word >> 4


def corner_of(word: Any) -> Any:
    return word & 3


def turned_of(word: Any) -> Any:
    return (word >> 2) & 1


def flag_of(word: Any) -> Any:
    return (word >> 3) & 1
