"""Transfer functions from VTK's objects, which are PyVista's too, and back.

vtkColorTransferFunction and vtkPiecewiseFunction are read node by node, with midpoints, sharpness,
colour space and jumps, and sampled as ParaView's colour maps are (`transfer_json.sample_curves`):
all nodes of both become control points. What that has no formula for is asked of VTK itself, at
`points` places: colour spaces CIEDE2000 and ProLab, and curves over a logarithmic scale.

An opacity's sharpness above 0.99 is a step, as VTK documents it; VTK 9.7 draws it merely steep.
Outside its nodes a function with clamping on, the default, keeps its ends' values; with clamping
off it is 0, which becomes a jump at either end. Left out: colours for NaN and for values out of
range, discretization into bands, shading and opacity by gradient.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxvr._core.checks import default_float, float_dtype
from jaxvr.optics.transfer_json import sample_curves

if TYPE_CHECKING:
    from jaxvr.optics.transfer import TransferFunction

SPACES = {0: "RGB", 1: "HSV", 2: "Lab", 3: "Diverging", 5: "Step"}  # VTK_CTF_*
_SHAPE = (0.5, 0.0)  # midpoint and sharpness of a straight line


def read(
    color: Any,
    opacity: Any = None,
    unit_distance: float | None = None,
    *,
    convention: str = "unstructured",
    points: int = 256,
    dtype: Any = None,
) -> TransferFunction:
    """See `TransferFunction.from_vtk`."""
    from jaxvr.optics.transfer import TransferFunction  # it imports this module

    color, opacity, unit = _parts(color, opacity, unit_distance)
    if points < 1:
        raise ValueError(f"points must be at least 1, but is {points}.")
    nodes, space = _color_nodes(color, points)
    curve = _opacity_nodes(opacity, points)
    # On unstructured grids an opacity is an extinction over the unit, which may be above 1.
    top = max(1.0, float(curve[:, 1].max()))
    if top > 1 and convention != "unstructured":
        raise ValueError(f"Opacities lie between 0 and 1, but the function's reach {top:g}.")
    curve[:, 1] /= top
    positions, colors, opacities = sample_curves(nodes, space, curve, points, dtype)
    make = TransferFunction.from_opacity
    dtype = default_float() if dtype is None else float_dtype(dtype)
    return make(positions, colors, opacities, unit / top, convention, dtype=dtype)


def write(tf: TransferFunction, unit_distance: float = 1.0) -> tuple[Any, Any]:
    """See `TransferFunction.to_vtk`."""
    try:
        from vtkmodules.vtkCommonDataModel import vtkPiecewiseFunction
        from vtkmodules.vtkRenderingCore import vtkColorTransferFunction
    except ImportError as e:
        raise ImportError("to_vtk needs VTK: pip install vtk") from e
    x, colors, extinctions = (
        np.asarray(a, np.float64) for a in (tf.absolute_positions(), tf.colors, tf.extinctions)
    )
    if not 0 < unit_distance < math.inf:
        raise ValueError(f"unit_distance must be a length above 0, but is {unit_distance}.")
    opacities = extinctions * unit_distance
    if opacities.max() > 1:
        raise ValueError(
            f"With unit_distance={unit_distance:g} opacities would reach {opacities.max():g}, but "
            f"VTK's end at 1. Pass unit_distance={_below(1 / extinctions.max())} or less."
        )
    color, opacity = vtkColorTransferFunction(), vtkPiecewiseFunction()
    if (x[1:] == x[:-1]).any():  # else VTK keeps the last of two nodes at one place
        color.AllowDuplicateScalarsOn()
        opacity.AllowDuplicateScalarsOn()
    for at, rgb, o in zip(x.tolist(), colors.tolist(), opacities.tolist(), strict=True):
        color.AddRGBPoint(at, *rgb)
        opacity.AddPoint(at, o)
    return color, opacity


def _below(x: float) -> str:
    """A number of three digits that is not above `x`."""
    step = 10.0 ** (math.floor(math.log10(x)) - 2)
    return f"{math.floor(x / step * (1 - 1e-12)) * step:.3g}"


def _is(x: Any, name: str) -> bool:
    """Whether `x` is an object of this VTK class, without importing VTK."""
    return bool(hasattr(x, "IsA") and x.IsA(name))


def _parts(color: Any, opacity: Any, unit: float | None) -> tuple[Any, Any, float]:
    """The two functions and the unit distance."""
    if _is(color, "vtkVolume"):  # what PyVista's `add_volume` returns
        color = color.GetProperty()
    if _is(color, "vtkVolumeProperty"):
        if opacity is not None:
            raise ValueError(
                "A volume property has its opacity function: pass one or the other, not both."
            )
        look = color
        gray = look.GetColorChannels() == 1
        color = look.GetGrayTransferFunction() if gray else look.GetRGBTransferFunction()
        opacity = look.GetScalarOpacity()
        unit = look.GetScalarOpacityUnitDistance() if unit is None else unit
    elif opacity is None and _is(color, "vtkLookupTable"):
        opacity = color
    for name, x, classes in (
        ("color", color, ("vtkColorTransferFunction", "vtkPiecewiseFunction", "vtkLookupTable")),
        ("opacity", opacity, ("vtkPiecewiseFunction", "vtkLookupTable")),
    ):
        if not any(_is(x, c) for c in classes):
            raise ValueError(
                f"{name} must be a {' or '.join(classes)}, but is {type(x).__name__}. (Or pass a "
                "vtkVolumeProperty or a volume alone, which have both.)"
            )
    return color, opacity, 1.0 if unit is None else float(unit)


def _color_nodes(color: Any, points: int) -> tuple[np.ndarray, str]:
    """(n, 6): x, r, g, b, midpoint, sharpness; and the colour space."""
    if _is(color, "vtkLookupTable"):
        table = _table(color)
        return np.column_stack([table[:, :4], np.tile(_SHAPE, (len(table), 1))]), "RGB"
    if _is(color, "vtkPiecewiseFunction"):  # a gray map
        rows = _opacity_nodes(color, points)
        return rows[:, [0, 1, 1, 1, 2, 3]], "RGB"
    rows = _rows("colour function", color, 6)
    logarithmic = color.GetScale() == 1 and rows[0, 0] > 0
    space = SPACES.get(color.GetColorSpace())
    if space is None or logarithmic:

        def between(low: float, high: float, n: int) -> np.ndarray:
            flat = [0.0] * (3 * n)
            color.GetTable(low, high, n, flat)  # in CIEDE2000 one call takes as long as one colour
            return np.reshape(flat, (n, 3))

        rows, space = _followed(rows, between, points, logarithmic), "RGB"
    elif space == "HSV" and color.GetHSVWrap():
        space = "HSVWrap"
    return rows if color.GetClamping() else _ending(rows), space


def _opacity_nodes(opacity: Any, points: int) -> np.ndarray:
    """(n, 4): x, opacity, midpoint, sharpness."""
    if _is(opacity, "vtkLookupTable"):
        table = _table(opacity)
        return np.column_stack([table[:, [0, 4]], np.tile(_SHAPE, (len(table), 1))])
    rows = _rows("opacity function", opacity, 4)
    if (rows[:, 1] < 0).any():
        raise ValueError(f"Opacities must not be negative, but the least is {rows[:, 1].min():g}.")
    if opacity.GetUseLogScale() and rows[0, 0] > 0:

        def between(low: float, high: float, n: int) -> list[list[float]]:
            return [[opacity.GetValue(x)] for x in np.geomspace(low, high, n).tolist()]

        rows = _followed(rows, between, points, True)
    return rows if opacity.GetClamping() else _ending(rows)


def _rows(name: str, function: Any, width: int) -> np.ndarray:
    rows = np.zeros((function.GetSize(), width))
    if len(rows) == 0:
        raise ValueError(f"The {name} has no nodes. Add two or more.")
    for k, row in enumerate(rows):
        node = [0.0] * width
        function.GetNodeValue(k, node)
        row[:] = node
    if not np.isfinite(rows).all():
        raise ValueError(f"The {name} has nodes with NaN or infinite numbers: {rows.tolist()}.")
    return rows


def _table(table: Any) -> np.ndarray:
    """(n, 5): x, r, g, b, alpha of a lookup table, its colours spread over its range."""
    table.Build()
    n, (low, high) = table.GetNumberOfTableValues(), table.GetTableRange()
    if n == 0 or not high > low:
        raise ValueError(f"The lookup table has {n} colours over the range {low:g} to {high:g}.")
    spread = np.geomspace if table.GetScale() == 1 and low > 0 else np.linspace
    return np.column_stack([spread(low, high, n), [table.GetTableValue(i) for i in range(n)]])


def _followed(
    rows: np.ndarray, between: Callable[[float, float, int], Any], points: int, logarithmic: bool
) -> np.ndarray:
    """The nodes, with more between them where VTK evaluates its curve; straight lines join them.

    between: from two positions and a number n to values (n, k), spread as the scale has it.
    """
    spread = np.geomspace if logarithmic else np.linspace
    n = -(-points // max(len(rows) - 1, 1)) + 2
    out = []
    for k, row in enumerate(rows):
        out.append([*row[:-2], *_SHAPE])
        if k + 1 < len(rows) and rows[k + 1, 0] > row[0]:
            low, high = float(row[0]), float(rows[k + 1, 0])
            inner = zip(spread(low, high, n), between(low, high, n), strict=True)
            out += [[x, *value, *_SHAPE] for x, value in list(inner)[1:-1]]
    return np.array(out)


def _ending(rows: np.ndarray) -> np.ndarray:
    """With a jump to 0 at either end."""
    ends = rows[[0, -1]].copy()
    ends[:, 1:-2] = 0
    ends[:, -2:] = _SHAPE
    return np.concatenate([ends[:1], rows, ends[1:]])
