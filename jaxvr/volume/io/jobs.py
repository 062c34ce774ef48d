"""What the process that reads and writes files is asked for: see `child`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from . import fields as choice
from . import registry
from .content import Ask, Content, Field
from .write import write

__all__ = ["fields", "read", "write"]


def fields(said: Callable[[], str], path: str, ask: Ask) -> tuple[list[Field], list[str]]:
    """The fields, and notes."""
    return registry.fields(Path(path), ask, said)


def read(
    said: Callable[[], str],
    path: str,
    ask: Ask,
    field: str | None,
    location: str | None,
    values: bool,
) -> dict[str, Any]:
    """What `fields.arrays_of` gives, and notes. values: the caller has them."""
    file = Path(path)
    content = registry.read(file, ask, said)
    out = choice.arrays_of(content, file.name, field, location, want=not values)
    out["notes"] = [*content.notes, *_steps(content, out.get("steps", content.steps), ask)]
    out["reader"] = content.reader
    return out


def _steps(content: Content, steps: tuple[float, ...], ask: Ask) -> list[str]:
    if len(steps) < 2 or ask.step is not None:
        return []
    return [
        f"It has {len(steps)} time steps, at {steps[0]:g} to {steps[-1]:g}, of which the last was "
        f"taken. Pass step=, an index from 0 to {len(steps) - 1} or a time as a float."
    ]
