"""What a strange picture may come from, as warnings that `jaxvr.render` and `jaxvr.fit` give.

A picture that is empty or of one colour is no error, and it does not say which number is wrong: the
camera may look away, the field may be in other units than the transfer function, or opacities may
stand where extinctions per unit of length belong. After a render outside `jit` and `grad` one small
reduction looks at the largest alpha, the ends of the field and of the transfer function, the
largest extinction, and where the eye stands. Only where one of them is odd is the reason looked
for, in NumPy. Before a fit cameras and ranges are looked at once.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ._core.brief import spanned
from ._core.checks import is_concrete
from ._core.units import near_one, norm
from .arguments import camera_of, is_camera
from .composite import AbstractCompositor
from .optics import TransferFunction
from .view.camera import Camera, RayImage
from .volume import AbstractVolume

Array = jax.Array

# An alpha that is nothing in 8 bits, and one that is hard to see.
BLANK = 1 / 512
FAINT = 1 / 50
# Optical depth over the diagonal of the box below which a faint picture is put down to it.
THIN = 0.05
# The part of a range below which another one is taken for one in other units (the commonest factor
# is 100), if it also shows less than this part of what the transfer function has.
NARROW = 0.03
ONE_COLOR = 0.05
# Optical depths of one cell and over the diagonal of the box above which extinctions of less than
# 1, that is not meant to hide all behind it, are taken for opacities.
DENSE_CELL, DENSE = 5.0, 100.0
# An optical depth that shows a volume well: what the advised numbers aim at.
VISIBLE = 2.0


class ViewWarning(UserWarning):
    """A picture that is probably not the one that was meant, with what it may come from.

    `jaxvr.render` warns of a blank picture, of a field and a transfer function whose ranges do not
    fit each other, of opacities in place of extinctions, and of a camera inside the volume;
    `jaxvr.fit` of ranges, and of cameras that do not see the volume. Where that is meant:
    `warnings.filterwarnings("ignore", category=jaxvr.ViewWarning)`.
    """


def look(
    volume: AbstractVolume,
    camera: Camera | RayImage,
    transfer: TransferFunction,
    seen: Any,
    compositor: AbstractCompositor,
    stacklevel: int,
) -> None:
    """Warn of what is odd about a picture. All operands have the dtype of the volume. camera: of
    another maker's only the rays are known, and what these tell is told.

    seen (): the largest alpha of the picture, before its background. compositor: of one that does
    not see light, only its view and, where it sees the transfer function, ranges are looked at.
    stacklevel: as for `warnings.warn`, counted from the caller: 1 is the line that calls this.
    """
    if not is_concrete(seen, *jax.tree.leaves((volume, camera, transfer))):
        return
    parallel = isinstance(camera, Camera) and camera.extent is not None
    corners, *floats = volume.glance()
    ends = _ends_of(camera)
    floats = (*floats, *ends, transfer.positions, transfer.extinctions)
    glance = np.asarray(_glance(parallel, seen, corners, *floats))
    alpha, low, high, first, last, top, diagonal, cut = (float(x) for x in glance)
    low, high, first, last = (x + volume.offset for x in (low, high, first, last))
    light = compositor.shades
    odd = compositor.reads_transfer and _odd((low, high), (first, last))
    # A cheap look at what `_dense` looks at again.
    dense = (
        "rgb" in compositor.needs  # of optical depths alone nothing hides another
        and top <= 1
        and top * diagonal > max(DENSE, DENSE_CELL * volume.parts ** (1 / 3))
    )
    if not (alpha < FAINT or odd or dense or cut):
        return
    low, high = volume.value_range()
    odd = odd and _odd((low, high), (first, last))
    if light and not np.asarray(transfer.extinctions).any():
        return  # nothing is to be seen, and nothing is
    if alpha < FAINT:
        if light:
            message = _faint(volume, camera, transfer, alpha, (low, high))
        else:
            reason = _out_of_view(volume, camera)
            message = reason and f"The picture is blank. {reason}"
        if message:
            warnings.warn(message, ViewWarning, stacklevel=stacklevel + 1)
            return
    for message in (
        _ranges(volume, transfer, (low, high)) if odd else None,
        _dense(volume, transfer, (low, high)) if dense else None,
        _inside(volume, camera) if cut else None,
    ):
        if message:
            warnings.warn(message, ViewWarning, stacklevel=stacklevel + 1)


def look_before_fit(
    volume: AbstractVolume, cameras: Sequence[Any], transfer: TransferFunction, stacklevel: int
) -> None:
    """Warn of cameras that do not see the volume (segments are passed over), and of a start whose
    control points miss the field. stacklevel: as for `look`."""
    views = {k: c for k, c in enumerate(cameras) if is_camera(c)}
    if not is_concrete(*jax.tree.leaves((volume, list(views.values()), transfer))):
        return
    messages = [_unseen(volume, views), _unfit(volume, transfer)]
    for message in filter(None, messages):
        warnings.warn(message, ViewWarning, stacklevel=stacklevel + 1)


def _unseen(volume: AbstractVolume, views: dict[int, Any]) -> str | None:
    """Which cameras do not see the volume, and why the first of them does not."""
    here = {k: _beside(camera, volume) for k, camera in views.items()}
    reasons = {k: _out_of_view(volume, camera) for k, camera in here.items()}
    blind = [k for k, reason in reasons.items() if reason]
    if not blind:
        return None
    return (
        f"{len(blind)} of {len(views)} cameras do not see the volume, and a fit learns nothing "
        f"from them. The first is cameras[{blind[0]}]: {reasons[blind[0]]}"
    )


def _beside(camera: Any, volume: AbstractVolume) -> Camera | RayImage:
    """In digits of its own, where it can be."""
    if isinstance(camera, Camera):
        return camera.relative_to(volume.origin)
    return camera_of(camera, volume)


def _unfit(volume: AbstractVolume, transfer: TransferFunction) -> str | None:
    """How the control points of a start miss the field. What they hold changes: a ramp over them
    stands for what they can hold."""
    ramp = np.linspace(1, 2, len(transfer.positions))
    colors = np.stack([ramp - 1] * 3, axis=1)
    ramp = TransferFunction(transfer.positions, colors, ramp, offset=transfer.offset)
    field = volume.value_range()
    return _ranges(volume, ramp, field) if _odd(field, _ends(ramp)) else None


def _odd(field: tuple[float, float], ends: tuple[float, float]) -> bool:
    """Whether the two ranges may miss each other: apart, or one much narrower."""
    (low, high), (first, last) = field, ends
    wide = high - low, last - first
    return high < first or low > last or min(wide) < NARROW * max(wide)


def _ends_of(camera: Camera | RayImage) -> tuple[Array, Array]:
    """A point that a picture is taken from, and one that it looks at; of rays, of the first."""
    if isinstance(camera, Camera):
        return camera.eye, camera.target
    first = camera.origins[0, 0]
    return first, first + camera.directions[0, 0]


@partial(jax.jit, static_argnums=0)
def _glance(parallel, seen, corners, values, points, eye, target, positions, extinctions):
    """The largest alpha, the ends of the values, the ends of the positions, the largest extinction,
    the diagonal of the box of the points, and whether the eye lies in it (or the plane of parallel
    rays cuts it).

    corners: the cells (N, 4) that values of points belong to: that of a point without a cell would
    widen the range, which then looks like the transfer function's. The box is of all points: a
    larger one makes more look odd, and that is looked at again.
    """
    if corners is not None:
        values = values.at[corners].get(mode="promise_in_bounds")
    # Eight points a row, which XLA reduces three times as fast as one.
    rows = jnp.pad(points, ((0, -len(points) % 8), (0, 0)), mode="edge").reshape(-1, 24)
    low = rows.min(axis=0).reshape(8, 3).min(axis=0)
    high = rows.max(axis=0).reshape(8, 3).max(axis=0)
    size = high - low
    unit = near_one(size)  # products of lengths may under- or overflow
    if parallel:
        forward, middle = (target - eye) * near_one(target - eye), (low + high) / 2 - eye
        cut = jnp.abs(forward @ (middle * unit)) < jnp.abs(forward) @ (size * unit / 2)
    else:
        cut = ((low < eye) & (eye < high)).all()
    ends = (seen, values.min(), values.max(), positions[0], positions[-1])
    ends = (*ends, extinctions.max(), jnp.linalg.norm(size * unit) / unit, cut)
    return jnp.stack([jnp.asarray(x, points.dtype) for x in ends])


def _faint(
    volume: AbstractVolume,
    camera: Camera | RayImage,
    transfer: TransferFunction,
    alpha: float,
    field: tuple[float, float],
) -> str | None:
    """Why next to nothing is seen; None where nothing is odd."""
    blank = alpha < BLANK
    what = "The picture is blank" if blank else f"The picture is faint (largest alpha {alpha:.2g})"
    if blank:
        reason = _out_of_view(volume, camera) or _ranges(volume, transfer, field)
        if reason:
            return f"{what}. {reason}"
    strongest = float(_shown(volume, transfer, field)[:, 3].max())
    if strongest == 0:
        first, last = _ends(transfer)
        return (
            f"{what}. The transfer function, whose control points lie from {_range(first, last)}, "
            f"has no extinction where the field lies, from {_range(*field)}. Move its positions or "
            "raise its extinctions there."
        )
    diagonal = _diagonal(volume)
    depth = strongest * diagonal
    if depth < THIN or (blank and alpha > 0):
        found = -np.log1p(-alpha) if alpha > 0 else depth
        return (
            f"{what}. Extinction is per unit of length: the largest over the field's range is "
            f"{strongest:.3g} and the volume's diagonal {diagonal:.3g}, which together is an "
            f"optical depth of {depth:.2g}. If the numbers are opacities, use "
            f"TransferFunction.from_opacity(..., unit_distance={_short(diagonal / 10)}); else "
            f"transfer.scaled({_short(VISIBLE / found)}) makes the volume visible."
        )
    return None


def _out_of_view(volume: AbstractVolume, camera: Camera | RayImage) -> str | None:
    """What keeps all of the volume out of the picture: behind the camera, or beyond one side. Of
    rays, that none meets its box."""
    points = volume.hull()
    if isinstance(camera, RayImage):
        return _beside_box(volume, points, camera)
    eye, target, up = (np.asarray(v, np.float64) for v in (camera.eye, camera.target, camera.up))
    forward = _unit(target - eye)
    right = _unit(np.cross(forward, up))
    offset = points - eye
    depth, x, y = offset @ forward, offset @ right, offset @ np.cross(right, forward)
    low, high = points.min(axis=0), points.max(axis=0)
    low, high, place, aim = (x + np.asarray(camera.origin) for x in (low, high, eye, target))
    box = f"its box reaches from {_vector(low)} to {_vector(high)}"
    advice = (
        f"Point it at the middle of the box, target={_vector((low + high) / 2)}, or take "
        "Camera.orbit(volume)."
    )
    if (depth <= 0).all():
        return (
            f"The volume lies behind the camera, which stands at {_vector(place)} and looks along "
            f"{_vector(forward)}; {box}. {advice}"
        )
    if camera.fov is not None:
        reach = depth * np.tan(np.deg2rad(float(camera.fov)) / 2)
    else:
        assert camera.extent is not None
        reach = np.full_like(depth, float(camera.extent) / 2)
    wide = reach * camera.width / camera.height
    # A half-space that holds all points holds their hull, and so every cell.
    sides = {
        "right of": x > wide,
        "left of": x < -wide,
        "above": y > reach,
        "below": y < -reach,
    }
    for side, beyond in sides.items():
        if beyond.all():
            return (
                f"The volume lies {side} the picture; {box}, and the camera at {_vector(place)} "
                f"looks at {_vector(aim)}. {advice}"
            )
    if (depth > 0).all():
        pixel = 2 * reach / camera.height
        size = max(float(np.ptp(x / pixel)), float(np.ptp(y / pixel)))
        if size < 1:
            return (
                f"The volume is {size:.2g} pixels large; {box}, and the camera stands at "
                f"{_vector(place)}. Move it nearer, or take Camera.orbit(volume)."
            )
    return None


def _beside_box(volume: AbstractVolume, points: np.ndarray, rays: RayImage) -> str | None:
    """Whether all rays pass the box of the points, or start behind it."""
    low, high = points.min(axis=0), points.max(axis=0)
    start, along = (np.asarray(x, np.float64).reshape(-1, 3) for x in rays.local_rays())
    slack = 1e-6 * np.abs(np.stack([low, high, *start[:1]])).max()
    with np.errstate(divide="ignore", invalid="ignore"):
        one, other = (low - slack - start) / along, (high + slack - start) / along
    # Beside a side that it is parallel to, a ray is within it always or never.
    within = (low - slack <= start) & (start <= high + slack)
    flat = along == 0
    enter = np.where(flat, np.where(within, -np.inf, np.inf), np.fmin(one, other)).max(axis=1)
    leave = np.where(flat, np.inf, np.fmax(one, other)).min(axis=1)
    if ((enter <= leave) & (leave >= 0)).any():
        return None
    ends = (_vector(x + np.asarray(volume.origin)) for x in (low, high))
    return (
        f"None of the camera's rays meets the volume, whose box reaches from {' to '.join(ends)}. "
        f"The first ray starts at {_vector(start[0] + np.asarray(volume.origin))} and goes along "
        f"{_vector(along[0])}."
    )


def _ranges(
    volume: AbstractVolume, transfer: TransferFunction, field: tuple[float, float]
) -> str | None:
    """How the ranges of field and transfer function miss each other; None where they fit."""
    low, high = field
    first, last = _ends(transfer)
    numbers = _numbers(transfer)
    whole = np.ptp(numbers, axis=0)
    if not whole.any():
        return None  # the same everywhere: any range will do
    ranges = (
        f"The field lies from {_range(low, high)}, the control points of the transfer function "
        f"from {_range(first, last)}"
    )
    advice = (
        f"Are both in the same units? Give the transfer function positions from "
        f"{_range(low, high)}, or convert the field with volume.replace(values=...)."
    )
    if high < first or low > last:
        end, k = ("first", 0) if high < first else ("last", -1)
        clear = " and no extinction" if numbers[k, 3] == 0 else ""
        return f"{ranges}: all of the volume has the colour of the {end}{clear}. {advice}"
    if 0 < high - low < NARROW * (last - first):
        shown = np.ptp(_shown(volume, transfer, field), axis=0)
        if (shown > ONE_COLOR * whole).any():
            return None  # the control points crowd where the field is
        part = 100 * (high - low) / (last - first)
        return f"{ranges}, of which the field takes {part:.2g} %: it is of one colour. {advice}"
    if 0 < last - first < NARROW * (high - low):
        values, weights = volume.weighted_values()
        between = float(weights[(values > first) & (values < last)].sum())
        beyond = float(weights[values < first].sum()), float(weights[values > last].sum())
        # Clear where values lie beyond it, it is a threshold or a peak, narrow on purpose.
        clear = any(beyond[k] > NARROW and numbers[-k, 3] == 0 for k in (0, 1))
        if between < NARROW and not clear:
            return (
                f"{ranges}, where {100 * between:.2g} % of the volume is: the rest has the "
                f"colours of its two ends. {advice}"
            )
    return None


def _dense(
    volume: AbstractVolume, transfer: TransferFunction, field: tuple[float, float]
) -> str | None:
    """That opacities may stand for extinctions: what would let light through hides all behind it
    within one cell."""
    diagonal = _diagonal(volume)
    shown = _shown(volume, transfer, field)[:, 3]
    strongest, cell = shown[shown < 1].max(initial=0.0), diagonal / volume.parts ** (1 / 3)
    if strongest * cell < DENSE_CELL or strongest * diagonal < DENSE:
        return None
    return (
        f"One cell hides what is behind it. Extinction is per unit of length: up to "
        f"{strongest:.3g} over the field's range, and cells are about {cell:.3g} long, which "
        f"together is an optical depth of {strongest * cell:.2g}. If the numbers are opacities, "
        f"use TransferFunction.from_opacity(..., unit_distance={_short(diagonal / 10)}); else "
        f"transfer.scaled({_short(VISIBLE / (strongest * diagonal))}) lets light through."
    )


def _inside(volume: AbstractVolume, camera: Camera | RayImage) -> str | None:
    """That the camera stands in the volume, and what is not seen then. Without the eye's numbers,
    so that a flight through a volume is warned of once: Python tells equal warnings once."""
    low, high = (np.asarray(x, np.float64) for x in volume.bounds())
    eye, target = (np.asarray(x, np.float64) for x in _ends_of(camera))
    ends = (_vector(x + np.asarray(volume.origin)) for x in (low, high))
    box = f"the volume's box, from {' to '.join(ends)}"
    inside = ((low < eye) & (eye < high)).all()
    if isinstance(camera, RayImage):
        what = f"The camera's first ray starts inside {box}: what is behind it is not seen."
        return what if inside else None
    if camera.extent is None:
        if not inside:
            return None  # only points that no cell uses lie around it
        what = f"The camera's eye lies inside {box}: what is behind it is not seen."
    else:
        forward = target - eye
        if abs(forward @ ((low + high) / 2 - eye)) >= abs(forward) @ ((high - low) / 2):
            return None
        what = (
            f"Parallel rays start in the plane through the camera's eye, which cuts {box}: what is "
            "behind it is not seen."
        )
    return f"{what} Move the eye away from the target, or take Camera.orbit(volume)."


def _diagonal(volume: AbstractVolume) -> float:
    """That of the box, in float64."""
    points = volume.hull()
    return norm(points.max(axis=0) - points.min(axis=0))


def _numbers(transfer: TransferFunction) -> np.ndarray:
    """Colours and extinctions of the control points (K, 4), float64."""
    extinctions = np.asarray(transfer.extinctions, np.float64)
    return np.column_stack([np.asarray(transfer.colors, np.float64), extinctions])


def _shown(
    volume: AbstractVolume, transfer: TransferFunction, field: tuple[float, float]
) -> np.ndarray:
    """What the field can take (n, 4) of the colours and extinctions: those at its two ends and
    at the control points between them, or, where it is constant in cells, those at its values."""
    positions, numbers = transfer.absolute_positions(), _numbers(transfer)
    levels = volume.levels()
    at = np.array(field) if levels is None else levels
    shown = np.stack([np.interp(at, positions, column) for column in numbers.T], axis=1)
    within = (positions >= field[0]) & (positions <= field[1])
    return shown if levels is not None else np.concatenate([shown, numbers[within]])


def _ends(transfer: TransferFunction) -> tuple[float, float]:
    positions = transfer.absolute_positions()
    return float(positions[0]), float(positions[-1])


def _unit(v: np.ndarray) -> np.ndarray:
    return v / norm(v)


def _range(low: float, high: float) -> str:
    return spanned(low, high)


def _vector(v: np.ndarray) -> str:
    v = np.where(np.abs(v) > 1e-7 * np.abs(v).max(), v, 0.0)  # rounding, and -0
    return "(" + ", ".join(f"{x:.4g}" if abs(x) < 1e4 else f"{x:.9g}" for x in v) + ")"


def _short(x: float) -> str:
    """With two digits, and without an exponent where it can be."""
    return f"{float(f'{x:.2g}'):g}"
