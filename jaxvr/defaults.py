"""A transfer function and a view to start from, for people who have a file and want a picture."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxvr.arguments import volume_of
from jaxvr.optics import TransferFunction
from jaxvr.view.camera import Camera
from jaxvr.volume import AbstractVolume, statistics

# Optical depth along the diagonal of the volume's box where the extinction is largest: the cells of
# the highest values hide each other, and those of the lowest can be looked through.
DEPTH = 15.0
# Parts of the volume whose values the control points span.
QUANTILES = (0.01, 0.99)
# A part of the range that is rounding, and no field to look at.
NOISE = 1e-6
UPS = {"y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0), "x": (1.0, 0.0, 0.0)}


def default_transfer(
    volume: AbstractVolume,
    colormap: Any = "viridis",
    *,
    depth: float = DEPTH,
    points: int = 33,
    quantiles: tuple[float, float] = QUANTILES,
) -> TransferFunction:
    """A colour map over the values that fill the volume, with extinction that rises from 0.

    The control points span the field's quantiles by volume, from 1 to 99 % of it, so that a few
    cells of extreme values do not take the colours of all others. What lies beyond has the colour
    and the extinction of the nearer end. Where these two are one value but for rounding (less than
    1e-6 of the range), as in a field that is 0 nearly everywhere, the whole range is spanned.

    Args:
      volume: whose values and size in space are taken; points that no cell uses do not count.
      colormap: as `TransferFunction.from_colormap` takes it, such as the name of matplotlib's.
      depth: optical depth along the diagonal of the volume's box where the field is highest.
      points: control points.
      quantiles: parts of the volume, from 0 to 1; (0, 1) spans the whole range.

    Returns:
      a transfer function in the volume's dtype. Of a constant field: one point.

    Raises:
      ValueError: for what is no volume, for a depth below 0, and for quantiles that do not rise
        between 0 and 1.
    """
    if not 0 <= depth < np.inf:
        raise ValueError(f"depth must be an optical depth of 0 or more, but is {depth!r}.")
    if not (len(quantiles) == 2 and 0 <= quantiles[0] < quantiles[1] <= 1):
        raise ValueError(
            f"quantiles must be two rising numbers from 0 to 1, but are {quantiles!r}."
        )
    volume = volume_of(volume)
    low, high = statistics.quantiles(volume, quantiles)
    least, most = volume.value_range()
    if not high - low > NOISE * (most - least):
        low, high = least, most
    # Where few numbers lie between the two, there are fewer points.
    positions = np.linspace(low, high, points) - volume.offset
    positions = np.unique(positions.astype(volume.dtype))
    ramp = np.linspace(0, 1, len(positions)) if len(positions) > 1 else np.ones(1)
    extinctions = (depth / volume.diagonal() * ramp).astype(volume.dtype)
    return TransferFunction.from_colormap(
        colormap, positions, extinctions, offset=volume.offset, dtype=volume.dtype
    )


def best_up(volume: AbstractVolume, transfer: TransferFunction, **view: Any) -> str:
    """Which of the axes "y", "z" and "x", turned upwards, shows most of a volume.

    view: azimuth and elevation in degrees, fov and zoom, as for `Camera.orbit`, whose view it is.

    What a view shows is how much its picture varies: the variance of premultiplied colours and
    alpha over the pixels. Pictures are rough ones that compile nothing: each cell is a dot with its
    volume's optical depth, up to 32 x 32 pixels, fewer where there are few cells. An axis must
    show a twentieth more than those before it in that order. Of a volume that has no list of its
    parts (`AbstractVolume.dots`), "y".
    """
    dots = volume.dots()
    if dots is None:
        return "y"
    middles, size, values = dots
    x = transfer.absolute_positions()
    columns = [*np.asarray(transfer.colors, np.float64).T, np.asarray(transfer.extinctions)]
    numbers = np.stack([np.interp(values, x, np.asarray(c, np.float64)) for c in columns], axis=1)
    n = int(np.clip(np.cbrt(len(middles)), 4, 32))
    best, most = "y", 0.0
    for name in ("y", "z", "x"):
        shown = _variety(middles, size, numbers, n, _orbit(volume, name, n, view))
        if shown > 1.05 * most:
            best, most = name, shown
    return best


def _orbit(volume: AbstractVolume, name: str, n: int, view: dict[str, Any]) -> Camera:
    return Camera.orbit(volume, up=UPS[name], width=n, height=n, **view)


def _variety(
    centers: np.ndarray, size: np.ndarray, numbers: np.ndarray, n: int, camera: Camera
) -> float:
    """See `best_up`. centers (N, 3), size (N,), numbers (N, 4): colours and extinctions."""
    right, up, forward = (np.asarray(v, np.float64) for v in camera.basis())
    offset = centers - np.asarray(camera.eye, np.float64)
    away = offset @ forward
    half = away * np.tan(np.deg2rad(float(np.asarray(camera.fov))) / 2)
    seen = away > 0
    with np.errstate(divide="ignore", invalid="ignore"):
        column = np.floor((offset @ right / half + 1) * n / 2)
        row = np.floor((1 - offset @ up / half) * n / 2)
    seen &= (column >= 0) & (column < n) & (row >= 0) & (row < n)
    pixel = (row[seen] * n + column[seen]).astype(int)
    area = (2 * half[seen] / n) ** 2  # of a pixel, where the cell is
    weight = numbers[seen, 3] * size[seen] / area
    depth = np.bincount(pixel, weight, n * n)
    alpha = 1 - np.exp(-depth)
    light = [np.bincount(pixel, weight * c, n * n) for c in numbers[seen, :3].T]
    shown = alpha / np.maximum(depth, np.finfo(float).tiny)
    return float(sum(np.var(channel) for channel in (*(shown * x for x in light), alpha)))
