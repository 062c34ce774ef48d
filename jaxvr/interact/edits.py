"""Edits of a transfer function by hand: control points are moved, added, removed, recoloured.

Each edit is a new `TransferFunction`. A point does not pass its neighbours; it may reach one, which
makes a jump, unless there is a jump already.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxvr.optics.transfer import TransferFunction

SMALLEST = 8


def apply(transfer: TransferFunction, edit: Mapping[str, Any]) -> TransferFunction:
    """One edit as a message: {"edit": "move" | "add" | "remove" | "color", ...arguments}."""
    arguments = dict(edit)
    name = arguments.pop("edit", None)
    if name not in EDITS:
        raise ValueError(f"edit must be one of {sorted(EDITS)}, but is {name!r}.")
    return EDITS[name](transfer, **arguments)


def move(
    transfer: TransferFunction, index: int, position: float, extinction: float
) -> TransferFunction:
    """Point `index` moves to a position between its neighbours, and an extinction of at least 0."""
    x, colors, e = _arrays(transfer)
    _require_point(index, len(x))
    _require_finite(position, extinction)
    low = x[index - 1] if index > 0 else -np.inf
    high = x[index + 1] if index + 1 < len(x) else np.inf
    # Three equal positions are none of a transfer function.
    if index > 1 and x[index - 2] == low:
        low = np.nextafter(low, high)
    if index + 2 < len(x) and x[index + 2] == high:
        high = np.nextafter(high, low)
    x[index] = min(max(x.dtype.type(position - transfer.offset), low), high)
    e[index] = max(extinction, 0)
    return TransferFunction(x, colors, e, offset=transfer.offset)


def add(transfer: TransferFunction, position: float, extinction: float) -> TransferFunction:
    """A new point, in the colour that is there already."""
    x, colors, e = _arrays(transfer)
    _require_finite(position, extinction)
    position = x.dtype.type(position - transfer.offset)
    while (x == position).sum() > 1:
        position = np.nextafter(position, x.dtype.type(np.inf))
    index = int(np.searchsorted(x, position, side="right"))
    color = [np.interp(position, x, channel) for channel in colors.T]
    return TransferFunction(
        np.insert(x, index, position),
        np.insert(colors, index, color, axis=0),
        np.insert(e, index, max(extinction, 0)),
        offset=transfer.offset,
    )


def remove(transfer: TransferFunction, index: int) -> TransferFunction:
    """Without point `index`; the last one stays."""
    x, colors, e = _arrays(transfer)
    _require_point(index, len(x))
    if len(x) == 1:
        raise ValueError("A transfer function needs a control point: the last one stays.")
    return TransferFunction(
        np.delete(x, index),
        np.delete(colors, index, axis=0),
        np.delete(e, index),
        offset=transfer.offset,
    )


def color(transfer: TransferFunction, index: int, color: str) -> TransferFunction:
    """Point `index` in a colour "#rrggbb", whose numbers are taken as they are."""
    x, colors, e = _arrays(transfer)
    _require_point(index, len(x))
    if not isinstance(color, str) or not re.fullmatch("#[0-9a-fA-F]{6}", color):
        raise ValueError(f"color must be #rrggbb, but is {color!r}.")
    colors[index] = [int(color[k : k + 2], 16) / 255 for k in (1, 3, 5)]
    return TransferFunction(x, colors, e, offset=transfer.offset)


EDITS = {"move": move, "add": add, "remove": remove, "color": color}


def padded(transfer: TransferFunction) -> TransferFunction:
    """The same function with 8, 16, 32 ... control points, so that adding one seldom compiles.

    Those added lie above the last one, where the function is constant anyway.
    """
    x, colors, e = _arrays(transfer)
    size = SMALLEST
    while size < len(x):
        size *= 2
    more = size - len(x)
    step = max(float(x[-1]) - float(x[0]), abs(float(x[-1]))) or 1.0
    if more == 0 or not float(x[-1]) + step * more < float(np.finfo(x.dtype).max):
        return transfer
    above = (float(x[-1]) + step * np.arange(1, more + 1)).astype(x.dtype)
    return TransferFunction(
        np.concatenate([x, above]),
        np.concatenate([colors, np.repeat(colors[-1:], more, axis=0)]),
        np.concatenate([e, np.repeat(e[-1:], more)]),
        offset=transfer.offset,
    )


def _arrays(transfer: TransferFunction) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return (
        np.array(transfer.positions),
        np.array(transfer.colors),
        np.array(transfer.extinctions),
    )


def _require_point(index: Any, k: int) -> None:
    if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < k:
        raise ValueError(f"There is no control point {index!r} among {k}.")


def _require_finite(*numbers: Any) -> None:
    for x in numbers:
        if not isinstance(x, int | float) or not math.isfinite(x):
            raise ValueError(f"A control point is placed by finite numbers, but one is {x!r}.")
