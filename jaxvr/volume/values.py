"""Where the values of a field live: on points (P,), in cells (T,), or at cell corners (T, 4).

All three are rendered as they are, without averaging: linear in each cell from its points, constant
in it, or linear in it with jumps from cell to cell.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from .._core.checks import is_concrete
from .._core.offsets import bulk, offset_between
from .build import Built, cast, numbers
from .digits import lost_values
from .unused import used_by

LOCATIONS = ("point", "cell", "corner")


def infer_location(shape: tuple[int, ...], sizes: dict[str, tuple[int, ...]]) -> list[str]:
    """The locations whose shape this is. sizes: location to its shape."""
    return [where for where, size in sizes.items() if shape == size]


def check_location(location: Any) -> None:
    if location is not None and location not in LOCATIONS:
        raise ValueError(f"location must be one of {LOCATIONS} or None, but is {location!r}.")


def _describe(sizes: dict[str, tuple[int, ...]]) -> str:
    return ", ".join(f"{size} for location={where!r}" for where, size in sizes.items())


def choose_location(
    shape: tuple[int, ...], sizes: dict[str, tuple[int, ...]], location: str | None
) -> str:
    """`location` where its shape fits, else the only one that fits, or a ValueError."""
    check_location(location)
    fits = infer_location(shape, sizes)
    if location is not None:
        if location in fits:
            return location
        if location not in sizes:
            raise ValueError(f"location={location!r} needs a mesh of tetra cells only.")
        raise ValueError(
            f"values must have shape {sizes[location]} for location={location!r}, but has {shape}."
        )
    if len(fits) == 1:
        return fits[0]
    if len(fits) > 1:
        raise ValueError(
            f"values of shape {shape} may be any of {', '.join(fits)} data. Say which with "
            "location=..."
        )
    if len(shape) == 2 and shape[0] in (sizes["point"][0], sizes["cell"][0]):
        raise ValueError(
            f"values must be one number each, but has shape {shape}: a field of {shape[1]} "
            "components. Pass one component, or the magnitude."
        )
    raise ValueError(f"values must have shape {_describe(sizes)}, but has {shape}.")


def is_whole(given: Any) -> bool:
    """Whether values are integers, of all types of cells."""
    if isinstance(given, Mapping):
        return all(is_whole(v) for v in given.values())
    try:
        return (
            np.dtype(given.dtype if hasattr(given, "dtype") else np.asarray(given).dtype).kind
            in "iu"
        )
    except ValueError:
        return False  # an entry for points, lines or faces, which nobody reads


def offset_for(given: Any, x: np.ndarray, dtype: np.dtype) -> float:
    """What to hold numbers (n,), float64, relative to: see `offsets`."""
    offset = offset_between(*bulk(x), dtype)
    if not offset and dtype == np.float32 and is_whole(given):
        low, high = float(x.min()), float(x.max())  # whole numbers are to stay what they are
        if max(-low, high) > 2**24 and high - low < 2**24:
            offset = float(round((low + high) / 2))
    return offset


def less_offset(given: Any, used: np.ndarray, dtype: np.dtype) -> tuple[float, str | None]:
    """What to take off values, and what to say of digits that are lost all the same.

    given: the values as they came. used (n,): those of them that count, float64.
    """
    offset = offset_for(given, used, dtype)
    lost = rounded("values", given, dtype, offset)
    if lost is None and not is_whole(given):
        lost = lost_values(given, used, offset, dtype)
    return offset, lost


def place(
    values: Any, built: Built, location: str | None, offset: float | None = None
) -> tuple[np.ndarray, str, float, str | None]:
    """Values given for points or input cells, as those of the built mesh, their location, what they
    are relative to, and a warning of digits that are lost.

    offset: what the given ones are relative to; None for values as they are, which may get one.
    """
    exact, where = _place(values, built, location)
    dtype, lost = built.points.dtype, None
    if offset is None:
        used = exact[used_by(len(exact), built.cells)] if where == "point" else exact.reshape(-1)
        offset, lost = less_offset(values, used, dtype)
        exact = exact - offset
    return cast("values", exact, dtype), where, offset, lost


def _place(values: Any, built: Built, location: str | None) -> tuple[np.ndarray, str]:
    """Values of the built mesh in float64, and their location."""
    check_location(location)
    if isinstance(values, Mapping):
        if location == "point":
            raise ValueError("values as a dict by cell type cannot have location='point'.")
        values = _join(values, built)
        sizes: dict[str, tuple[int, ...]] = {"cell": (built.n_input,)}
    else:
        values = numbers("values", values)
        if values.ndim == 2 and values.shape[1] == 1:
            values = values[:, 0]
        sizes = {"point": (len(built.points),), "cell": (built.n_input,)}
    if built.all_tetra:
        sizes["corner"] = (built.n_input, 4)
        if location is None and values.shape == (len(built.points), 4) == sizes["corner"]:
            raise ValueError(
                f"values of shape {values.shape} may be corner data or a point field of four "
                'components. Say location="corner" if they are corner data.'
            )
    where = choose_location(values.shape, sizes, location)
    if where == "point":
        return values, where
    values = values[built.parent]
    if where == "corner":
        values = np.take_along_axis(values, built.order.astype(np.intp), 1)
    return values, where


def rounded(name: str, values: Any, dtype: np.dtype, offset: float = 0.0) -> str | None:
    """That floats cannot hold some of these integers (ids, labels, counts), or None."""
    if isinstance(values, Mapping):
        found = (rounded(f"{name}[{k!r}]", v, dtype, offset) for k, v in values.items())
        return next((message for message in found if message), None)
    if not is_concrete(values):
        return None
    if np.dtype(getattr(values, "dtype", int)).kind not in "iu":
        return None
    try:
        given = np.asarray(values)
    except ValueError:
        return None  # an entry for points, lines or faces, which nobody reads
    if given.dtype.kind not in "iu" or given.size == 0:
        return None
    wide = given.astype(np.float64)
    if (high := _beyond_float64(given, wide)).any():
        first = int(given[high][0])
        return (
            f"{name} has {int(high.sum())} integers that float64 cannot hold, the first is "
            f"{first}, which becomes {int(float(first))}: above 2**53 whole numbers are rounded. "
            "Subtract an offset, or number them anew (numpy.unique(..., return_inverse=True))."
        )
    if dtype != np.float32:
        return None
    wide = wide - offset
    lost = wide != wide.astype(np.float32)
    if not lost.any():
        return None
    first = int(given[lost][0])
    return (
        f"{name} has {int(lost.sum())} integers that float32 cannot hold, the first is {first}, "
        f"which becomes {int(float(np.float32(first - offset)) + offset)}: above 2**24 = {2**24} "
        "whole numbers are rounded. Subtract an offset, or turn on jax_enable_x64 and pass "
        'dtype="float64".'
    )


def _beyond_float64(given: np.ndarray, wide: np.ndarray) -> np.ndarray:
    """Which integers are others in float64, `wide`."""
    end = 2.0 ** (8 * given.dtype.itemsize - (given.dtype.kind == "i"))  # no integer of this type
    return np.where(wide < end, wide, 0).astype(given.dtype) != given


def _join(values: Mapping[Any, Any], built: Built) -> np.ndarray:
    """A dict from cell type to values as one array in the order of the blocks."""
    given = {str(k): v for k, v in values.items()}
    parts = []
    for name, n in built.block_sizes:
        if name not in given:
            if n == 0:
                continue
            raise ValueError(f"values has no entry for {name!r}; it has {sorted(given)}.")
        part = numbers(f"values[{name!r}]", given[name])
        if part.ndim == 2 and part.shape[1] == 1:
            part = part[:, 0]
        if len(part) != n or part.ndim == 0:
            raise ValueError(f"values[{name!r}] has shape {part.shape} for {n} cells.")
        if n:
            parts.append(part)
    known = {name for name, _ in built.block_sizes} | {t for t, _ in built.report.ignored}
    extra = sorted(set(given) - known)
    if extra:
        raise ValueError(f"values has entries for {extra}, but the mesh has no such cells.")
    if len({p.shape[1:] for p in parts}) > 1:
        raise ValueError(f"values differ in shape: {[p.shape for p in parts]}.")
    return np.concatenate(parts)
