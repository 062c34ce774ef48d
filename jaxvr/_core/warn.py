"""Warnings that point at the user's line, however deep in the package they are found."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path
from types import FrameType

_ROOT = str(Path(__file__).resolve().parents[1])


def warn(message: str, category: type[Warning]) -> None:
    """Warns at the innermost line that is not of this package."""
    level, frame = 1, sys._getframe()
    while frame.f_back is not None and _is_ours(frame):
        level, frame = level + 1, frame.f_back
    warnings.warn(message, category, stacklevel=level)


def _is_ours(frame: FrameType) -> bool:
    file = frame.f_code.co_filename
    # `dataclasses` makes methods in no file.
    made = file == "<string>" and frame.f_globals.get("__name__", "").startswith("jaxvr.")
    return made or file.startswith(_ROOT)
