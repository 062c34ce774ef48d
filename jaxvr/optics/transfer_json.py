"""Transfer functions as JSON: jaxvr's own format, and colour maps exported by ParaView.

jaxvr's format holds each number with as many digits as give the same float back:

    {"format": "jaxvr.TransferFunction", "version": 1, "dtype": "float64",
     "positions": [K], "colors": [[3], K times], "extinctions": [K]}

and, where positions are relative to one (see `TransferFunction`), "offset".

ParaView exports a list of colour maps, each with "RGBPoints" (x, r, g, b, ...), "ColorSpace" (RGB,
HSV, Lab or CIELAB, Diverging, Step), and perhaps "Points" (x, opacity, midpoint, sharpness, ...),
"UseLogScale" (both curves over the logarithm of x), read here as vtkColorTransferFunction and
vtkPiecewiseFunction interpret them (`sample_curves`, which serves `transfer_vtk` too). All nodes of
both become control points, so nothing between two colour nodes is lost; where ParaView's curve is
not linear in RGB and opacity, control points are added between the nodes. Not read are "NanColor"
and "NanOpacity", since scalars are finite (a mesh with NaN is refused), "Discretize", and
"IndexedColors" beside "RGBPoints"; colours for values out of range give a warning.

Two departures from VTK 9.7: a sharpness of 1 is piecewise constant, as VTK's documentation has it,
and not merely steep; and where the hues of a diverging map lie more than half a circle apart, the
short way is taken.
"""

from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxvr._core.checks import BRIGHTEST
from jaxvr._core.offsets import offset_between
from jaxvr._core.warn import warn
from jaxvr._core.writing import place_of, shown, write_whole
from jaxvr.optics import colormaps

if TYPE_CHECKING:
    from jaxvr.optics.transfer import TransferFunction

FORMAT = "jaxvr.TransferFunction"
_KEYS = {"format", "version", "dtype", "offset", "positions", "colors", "extinctions", "brightest"}
_READ = ("RGBPoints", "Points", "ColorSpace", "HSVWrap", "UseLogScale", "IndexedColors", "Name")
# What ParaView calls the colour spaces of `colormaps.SPACES`.
_SPACES = {"CIELAB": "Lab", "LAB": "Lab", "Rgb": "RGB", "Hsv": "HSV"}


def write(tf: TransferFunction, path: str | os.PathLike[str] | None = None) -> str:
    """JSON text of a transfer function; also written to `path` if there is one."""
    document = {
        "format": FORMAT,
        "version": 1,
        "dtype": tf.dtype.name,
        "positions": np.asarray(tf.positions, np.float64).tolist(),
        "colors": np.asarray(tf.colors, np.float64).tolist(),
        "extinctions": np.asarray(tf.extinctions, np.float64).tolist(),
    }
    if tf.offset:
        document["offset"] = tf.offset
    brightest = max(map(max, document["colors"]))
    if brightest > BRIGHTEST:  # or `read` would take them for bytes
        document["brightest"] = brightest
    text = json.dumps(document, allow_nan=False) + "\n"
    if path is not None:
        write_whole(path, text)
    return text


def read(
    source: Any,
    *,
    unit_distance: float = 1.0,
    convention: str = "unstructured",
    points: int = 256,
    name: str | None = None,
    srgb: bool = False,
    dtype: Any = None,
) -> TransferFunction:
    """A transfer function from a path, JSON text, or what `json.load` returned.

    dtype: defaults to that of the file (float64 only where JAX allows it), for ParaView's files to
        JAX's default float.

    The rest is for ParaView's files.

    unit_distance, convention: what an opacity means, as in `TransferFunction.from_opacity`.
        Without "Points" the opacity rises from 0 at the first colour to 1 at the last, as in
        ParaView.
    points: about how many control points to add where a curve is not linear, spread evenly over the
        intervals between nodes that need them.
    name: which colour map, if there are several.
    srgb: decode colours from sRGB; else they are taken as they stand.

    Raises ValueError for anything that is not one of the two formats.
    """
    document = _load(source)
    if isinstance(document, dict) and "format" in document:
        return _own(document, dtype)
    entry = _choose(document, name)
    nodes, space = _color_nodes(entry)
    curve = _opacity_nodes(entry, nodes[:, 0])
    log = _flag(entry, "UseLogScale")
    for key, rows in (("RGBPoints", nodes), ("Points", curve)):
        if log and rows[0, 0] <= 0:
            raise ValueError(
                f"UseLogScale needs positions above 0, but {key!r} begins at {rows[0, 0]:g}."
            )
    positions, colors, opacities = sample_curves(nodes, space, curve, points, dtype, log)
    if srgb:
        colors = colormaps.srgb_to_linear(colors)
    make = _transfer_class().from_opacity
    return make(positions, colors, opacities, unit_distance, convention, dtype=_float(dtype))


def _transfer_class() -> type[TransferFunction]:
    from jaxvr.optics.transfer import TransferFunction  # it imports this module

    return TransferFunction


def _load(source: Any) -> Any:
    if isinstance(source, dict | list):
        return source
    if not isinstance(source, str | os.PathLike):
        raise ValueError(f"A path, JSON text, a dict or a list is needed, not {type(source)}.")
    where = "The text"
    if isinstance(source, str) and source.lstrip()[:1] in ("{", "["):
        text = source
    else:
        where = shown(source)
        try:
            place = place_of(source)
            if place.exists() and not place.is_file():
                raise OSError("it is no file")
            text = place.read_text(encoding="utf-8-sig")
        except UnicodeDecodeError as e:
            raise ValueError(f"{where} is not a text file: {e}") from e
        except (OSError, ValueError) as e:
            raise ValueError(f"{where} is neither JSON text nor a readable file: {e}") from e
    try:
        return json.loads(text, object_pairs_hook=_once)
    except (ValueError, RecursionError) as e:
        raise ValueError(f"{where} is not valid JSON: {e}") from e


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object whose names stand there once each; of two, one would be lost in silence."""
    made = dict(pairs)
    if len(made) != len(pairs):
        twice = sorted({k for k, _ in pairs if [n for n, _ in pairs].count(k) > 1})
        raise ValueError(f"{', '.join(map(repr, twice))} stands there twice")
    return made


def _require_light(key: str, colors: np.ndarray, most: float) -> None:
    if colors.size and (colors.max() > most or colors.min() < -BRIGHTEST):
        raise ValueError(
            f"The colours of {key!r} reach from {colors.min():g} to {colors.max():g}, but 1 is "
            "full intensity. Divide 8-bit colours by 255."
        )


def _flag(entry: dict[str, Any], key: str) -> bool:
    value = entry.get(key, False)
    if value not in (True, False, None):
        raise ValueError(f"{key!r} must be true or false, but is {value!r}.")
    return bool(value)


def _own(document: dict[str, Any], dtype: Any) -> TransferFunction:
    if document["format"] != FORMAT or document.get("version") != 1:
        raise ValueError(
            f"format is {document['format']!r}, version {document.get('version')!r}, "
            f"but only {FORMAT!r}, version 1, can be read."
        )
    stored = document.get("dtype", "float64")
    if stored not in ("float32", "float64"):
        raise ValueError(f"dtype must be 'float32' or 'float64', but is {stored!r}.")
    if unknown := sorted(map(str, set(document) - _KEYS)):
        raise ValueError(f"{unknown} are not known; a transfer function has {sorted(_KEYS)}.")
    arrays = [_numbers(document, key) for key in ("positions", "colors", "extinctions")]
    whole = np.asarray(document["colors"]).dtype.kind in "iu"
    stated = document.get("brightest", 0)
    if isinstance(stated, bool) or not isinstance(stated, int | float):
        raise ValueError(f"'brightest' must be a number, but is {stated!r}.")
    _require_light("colors", arrays[1], 1 if whole else max(BRIGHTEST, stated))
    offset = _numbers(document, "offset") if "offset" in document else None
    if offset is not None and offset.ndim:
        raise ValueError(f"'offset' must be one number, but is {document['offset']!r}.")
    away = None if offset is None else float(offset)
    held = arrays[0].astype(stored)
    if stored == "float32" and np.array_equal(held, arrays[0]):
        # As `write` has them: they are to be the same bits, relative to the same offset.
        arrays[0], away = held, away or 0.0
    return _transfer_class()(*arrays, offset=away, dtype=stored if dtype is None else dtype)


def _numbers(document: dict[str, Any], key: str) -> np.ndarray:
    if key not in document:
        raise ValueError(f"{key!r} is missing; there are {sorted(map(str, document))}.")
    try:
        array = np.asarray(document[key])
    except ValueError as e:
        raise ValueError(f"{key!r} is not a regular array: {e}") from e
    if array.dtype.kind not in "iuf":
        raise ValueError(f"{key!r} must hold numbers only.")
    array = array.astype(np.float64)
    if not np.isfinite(array).all():
        raise ValueError(f"{key!r} holds NaN or infinite numbers.")
    return array


def _choose(document: Any, name: str | None) -> dict[str, Any]:
    entries = document if isinstance(document, list) else [document]
    if not entries or not all(isinstance(e, dict) for e in entries):
        raise ValueError("This JSON holds no colour maps: a list of objects is needed.")
    names = [str(e.get("Name", "")) for e in entries]
    if name is not None:
        if name not in names:
            raise ValueError(f"There is no colour map {name!r}, only {names}.")
        return entries[names.index(name)]
    if len(entries) > 1:
        raise ValueError(f"There are {len(entries)} colour maps; choose by name among {names}.")
    return entries[0]


def _color_nodes(entry: dict[str, Any]) -> tuple[np.ndarray, str]:
    """(n, 6): x, r, g, b, midpoint, sharpness, of which ParaView writes the first four."""
    if "RGBPoints" not in entry:
        if "IndexedColors" in entry:
            raise ValueError("This colour map is categorical (IndexedColors): it has no positions.")
        raise ValueError(f"'RGBPoints' is missing; there are {sorted(map(str, entry))}.")
    _look(entry)
    nodes = _quadruples(entry, "RGBPoints")
    # Display colours: above 1 there is none, but for rounding.
    if nodes[:, 1:].max() > 1 + 1e-3 or nodes[:, 1:].min() < -1e-3:
        _require_light("RGBPoints", nodes[:, 1:], -np.inf)
    space = entry.get("ColorSpace", "RGB")
    space = _SPACES.get(space, space) if isinstance(space, str) else space
    if space == "HSV" and _flag(entry, "HSVWrap"):
        space = "HSVWrap"
    if not isinstance(space, str) or space not in colormaps.SPACES:
        known = ", ".join(colormaps.SPACES)
        raise ValueError(
            f"ColorSpace {space!r} cannot be read, only {known}. Where VTK is at hand, "
            "TransferFunction.from_vtk reads what it has made of it."
        )
    return np.column_stack([nodes, np.full(len(nodes), 0.5), np.zeros(len(nodes))]), space


def _look(entry: dict[str, Any]) -> None:
    """Warns of what is not read although it changes the picture."""
    for key in ("UseAboveRangeColor", "UseBelowRangeColor"):
        if _flag(entry, key):
            warn(f"{key} is not read: outside of its nodes a map keeps its ends.", UserWarning)
    for key in entry:
        near = [k for k in _READ if k.lower() == str(key).lower() and k != key]
        if near and near[0] not in entry:
            warn(f"{key!r} is not read; ParaView's name is {near[0]!r}.", UserWarning)


def _opacity_nodes(entry: dict[str, Any], nodes: np.ndarray) -> np.ndarray:
    """(n, 4): x, opacity, midpoint, sharpness, as in "Points"."""
    if entry.get("Points") is None:
        return np.array([[nodes[0], 0.0, 0.5, 0.0], [nodes[-1], 1.0, 0.5, 0.0]])
    curve = _quadruples(entry, "Points")
    if (curve[:, 1] < 0).any() or (curve[:, 1] > 1).any():
        raise ValueError(f"The opacities of 'Points' must lie in [0, 1], but are {curve[:, 1]}.")
    return curve


def _quadruples(entry: dict[str, Any], key: str) -> np.ndarray:
    flat = _numbers(entry, key)
    if flat.ndim != 1 or flat.size == 0 or flat.size % 4:
        raise ValueError(f"{key!r} must be a flat list of 4 numbers a node, but has {flat.shape}.")
    rows = flat.reshape(-1, 4)
    if (np.diff(rows[:, 0]) < 0).any():
        raise ValueError(f"The nodes of {key!r} must be sorted by their first number.")
    return rows


def sample_curves(
    nodes: np.ndarray,
    space: str,
    curve: np.ndarray,
    points: int,
    dtype: Any,
    logarithmic: bool = False,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Control points that follow both curves: positions, colours, opacities.

    Positions are float64, but numbers that `dtype` holds, less the offset that a `TransferFunction`
    takes off.

    nodes (n, 6): x, r, g, b, midpoint, sharpness of vtkColorTransferFunction; space: of `SPACES`.
    curve (m, 4): x, opacity, midpoint, sharpness of vtkPiecewiseFunction. Both ascend by x, and two
    nodes at one x are a jump. points, dtype: as in `read`. logarithmic: the curves are those over
    log10(x), with all x above 0.
    """
    nodes, curve = _bounded(nodes), _bounded(curve)
    places = np.unique(np.concatenate([nodes[:, 0], curve[:, 0]]))
    if logarithmic:
        nodes[:, 0], curve[:, 0] = np.log10(nodes[:, 0]), np.log10(curve[:, 0])
    at, curved = [], []  # control points, and intervals that straight lines would not follow
    for rows, mixing in ((nodes, space), (curve, "RGB")):
        x, mid, sharp = rows[:-1, 0], rows[:-1, -2], rows[:-1, -1]
        following = rows[1:, 0]
        middle = x + mid * (following - x)
        bends = (sharp >= 0.01) & (sharp <= 0.99)
        bends |= (sharp < 0.01) & (mixing not in (("Step",) if logarithmic else ("RGB", "Step")))
        broken = (mid != 0.5) | (sharp >= 0.01) | (mixing == "Diverging")  # at the middle
        at += [rows[:, 0], middle[broken]]
        for k in np.flatnonzero(bends & (following > x)):
            halves = [(x[k], middle[k]), (middle[k], following[k])]
            curved += halves if broken[k] else [(x[k], following[k])]
    if curved:
        if points < 1:
            raise ValueError(f"points must be at least 1, but is {points}.")
        each = -(-points // len(curved))
        at += [np.linspace(lo, hi, each + 2) for lo, hi in curved]
    grid = np.unique(np.concatenate(at))
    both = [
        np.column_stack([_colors_at(nodes, space, grid, side), _opacity_at(curve, grid, side)])
        for side in ("left", "right")
    ]
    jumps = np.abs(both[0] - both[1]).max(axis=1) > 1e-12
    values = np.concatenate([both[0][jumps], both[1]])
    positions = np.concatenate([grid[jumps], grid])
    if logarithmic:
        positions = _powers(positions, places)
    order = np.argsort(positions, kind="stable")  # at a jump the lower side comes first
    positions, values = positions[order], values[order]
    away = offset_between(float(positions[0]), float(positions[-1]), _float(dtype))
    positions = (positions - away).astype(_float(dtype)).astype(np.float64) + away
    # Rounded to float32, neighbours may have become equal: a run keeps its first and its last.
    run = np.concatenate([[False], positions[1:] == positions[:-1]])
    inner = run & np.concatenate([run[1:], [False]])
    positions, values = positions[~inner], values[~inner]
    return positions, values[:, :3], np.clip(values[:, 3], 0, 1)  # clips rounding only


def _powers(exponents: np.ndarray, places: np.ndarray) -> np.ndarray:
    """10^exponents, and `places` themselves, ascending, where an exponent is their logarithm."""
    logs = np.log10(places)
    at = np.clip(np.searchsorted(logs, exponents), 0, len(logs) - 1)
    return np.where(logs[at] == exponents, places[at], 10.0**exponents)


def _float(dtype: Any) -> np.dtype:
    from jaxvr._core.checks import default_float, float_dtype

    return default_float() if dtype is None else float_dtype(dtype)


def _interval(x: np.ndarray, s: np.ndarray, side: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The nodes on both sides of `s`, and the fraction between them, seen from the given side."""
    above = np.searchsorted(x, s, side=side)
    lo, hi = np.clip(above - 1, 0, len(x) - 1), np.clip(above, 0, len(x) - 1)
    width = x[hi] - x[lo]
    return lo, hi, np.where(width > 0, (s - x[lo]) / np.where(width > 0, width, 1), 0.0)


def _bounded(rows: np.ndarray) -> np.ndarray:
    """Rows whose last two numbers are midpoint and sharpness, in the range that VTK keeps to."""
    out = np.array(rows, np.float64)
    out[:, -2] = np.clip(out[:, -2], 1e-5, 1 - 1e-5)
    out[:, -1] = np.clip(out[:, -1], 0, 1)
    return out


def _between(
    rows: np.ndarray, s: np.ndarray, side: str, hermite: bool = True
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The nodes on both sides of `s`, and what part of the second one VTK's curve takes there.

    The midpoint warps the fraction of the interval, the sharpness bends the curve.
    """
    lo, hi, t = _interval(rows[:, 0], s, side)
    mid, sharp = rows[lo, -2], rows[lo, -1]
    at_middle = s == rows[lo, 0] + mid * (rows[hi, 0] - rows[lo, 0])
    t = np.where(t < mid, 0.5 * t / mid, 0.5 + 0.5 * (t - mid) / (1 - mid))
    upper = (t >= 0.5) & ~at_middle if side == "left" else (t >= 0.5) | at_middle
    power = 1.0 + 10.0 * sharp
    bent = np.where(t < 0.5, 0.5 * (2 * t) ** power, 1 - 0.5 * (2 * (1 - t)) ** power)
    if hermite:  # with the ends' slopes flattened by the sharpness
        b2, b3 = bent**2, bent**3
        bent = 3 * b2 - 2 * b3 + (1 - sharp) * (2 * b3 - 3 * b2 + bent)
    part = np.select([lo == hi, sharp < 0.01, sharp > 0.99], [0.0 * t, t, 1.0 * upper], bent)
    return lo, hi, np.clip(part, 0, 1)  # clips rounding only


def _colors_at(nodes: np.ndarray, space: str, s: np.ndarray, side: str) -> np.ndarray:
    """vtkColorTransferFunction between nodes."""
    lo, hi, t = _between(nodes, s, side, hermite=space != "Diverging")
    below, above = nodes[lo, 1:4], nodes[hi, 1:4]
    if space == "Step":  # at the node below, and at the middle if it is sharp
        return np.where(((nodes[lo, 5] > 0.99) & (t < 1))[:, None], below, above)
    mixed = colormaps.interpolate(space, below, above, t)
    # A conversion to another space and back would round the nodes' own colours.
    mixed = np.where((t == 1.0)[:, None], above, mixed)
    return np.where((t == 0.0)[:, None], below, mixed)


def _opacity_at(curve: np.ndarray, s: np.ndarray, side: str) -> np.ndarray:
    """vtkPiecewiseFunction between nodes."""
    lo, hi, t = _between(curve, s, side)
    below, above = curve[lo, 1], curve[hi, 1]
    return np.where(t == 1.0, above, below + t * (above - below))
