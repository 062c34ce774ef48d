"""Rendered pictures: one with its pixels as they are, several side by side, against a reference."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes

from jaxvr._core.checks import as_floats, as_light, require_finite, require_kind
from jaxvr.files import pixels
from jaxvr.optics.transfer import TransferFunction
from jaxvr.plot.axes import color_as, given, grid_axes, ink, picture_axes, set_title
from jaxvr.plot.maps import color_bar, require_scale, show_pixels, show_signed
from jaxvr.view.images import composite_over

# The two greys of the chequered ground behind transparent colours.
CHEQUER = (240, 200)


def image(
    image: Any,
    ax: Axes | None = None,
    *,
    title: str | None = None,
    background: Any = None,
    srgb: bool = False,
    transfer: TransferFunction | None = None,
    label: str | None = None,
    axes: bool = False,
) -> Any:
    """One picture, its pixels unsmoothed; returns the axes.

    On a new figure each pixel is a square of whole pixels of the figure, at its own resolution.

    Args:
      image: (H, W, 4) or (H, W, 3).
      background: linear RGB (3,) behind the image; None shows the page where it is transparent.
      srgb: code linear light as sRGB.
      transfer: what the image was rendered with: a bar beside it tells which colour is which
        scalar. Its inner half is as opaque as the extinction is large, relative to its largest,
        over the background or a chequered ground; its outer half is opaque.
      label: of that bar, such as "temperature (K)"; "scalar" if None.
      axes: show rows and columns of pixels.

    Raises ValueError for what is no image, and for NaN.
    """
    if transfer is not None:
        require_kind("transfer", transfer, TransferFunction)
    shown = pixels(image, background, srgb)
    if ax is None:
        (ax,) = picture_axes(
            [(shown.shape[0], shown.shape[1])],
            4.0,
            titles=[title],
            left=0.55 if axes else 0.0,
            bottom=0.45 if axes else 0.0,
            right=0.0 if transfer is None else 1.05,
        )
    else:
        set_title(ax, title)
    show_pixels(ax, shown)
    if axes:
        ax.set_axis_on()
        ax.set_xlabel("column (pixels)")
        ax.set_ylabel("row (pixels)")
    if transfer is not None:
        behind = None if background is None or np.ndim(background) != 1 else background
        _transfer_bar(ax, transfer, label or "scalar", behind, srgb)
    return ax


def compare(
    images: Sequence[Any],
    titles: Sequence[str] | None = None,
    *,
    axes: Any = None,
    background: Any = None,
    srgb: bool = False,
) -> Any:
    """Pictures side by side; returns a tuple of their axes.

    images, titles: one each. axes: one for each picture, in any shape. The rest as for `image`.
    """
    _require_several("compare", images)
    if len(images) == 0:
        raise ValueError("compare needs at least one image.")
    if titles is not None and len(titles) != len(images):
        raise ValueError(f"There are {len(images)} images, but {len(titles)} titles.")
    shown = [pixels(x, background, srgb) for x in images]
    if axes is None:
        found = picture_axes([(x.shape[0], x.shape[1]) for x in shown], 3.2, titles=titles)
    else:
        found = given(axes, len(images), "compare")
        for ax, title in zip(found, titles or [None] * len(found), strict=True):
            set_title(ax, title)
    for ax, x in zip(found, shown, strict=True):
        show_pixels(ax, x)
    return found


def against(
    images: Sequence[Any],
    reference: Any,
    titles: Sequence[str],
    *,
    scale: float | None = None,
    window: tuple[int, int, int] | None = None,
    axes: Any = None,
    background: Any = (0.0, 0.0, 0.0),
    srgb: bool = False,
) -> Any:
    """Pictures in a row, the reference last, and below each how it differs from it.

    Differences are picture - reference as seen over the background, the mean of r, g and b with
    its sign, all in one scale: red is brighter, blue darker. By default it reaches to the 99.5 %
    quantile of all of them, and what lies beyond has the last colour. The numbers above them are
    over r, g and b of all pixels.

    Args:
      titles: one each, and one for the reference.
      window (row, column, size): a square that is framed in each picture and shown again below it,
        its contrast raised alike in all.
      axes: two rows of them, three with a window, with a column for each picture.

    Returns the axes, row by row. Raises ValueError for numbers of titles or axes that do not fit,
    for images of different sizes, and for NaN.
    """
    _require_several("against", images)
    if len(images) == 0 or len(titles) != len(images) + 1:
        raise ValueError(
            f"against needs images, and a title for each and for the reference, but there are "
            f"{len(images)} images and {len(titles)} titles."
        )
    shown = [_opaque(x, background) for x in (*images, reference)]
    for x, title in zip(shown, titles, strict=True):
        if x.shape != shown[-1].shape:
            raise ValueError(
                f"The images must have one size, but {title!r} is {x.shape[:2]} and the reference "
                f"{shown[-1].shape[:2]}."
            )
    gaps = [x - shown[-1] for x in shown[:-1]]
    signed = [gap.mean(-1) for gap in gaps]
    if scale is None:
        scale = float(np.quantile(np.abs(signed), 0.995)) or 1.0
    require_scale(scale)
    columns, rows = len(shown), 2 if window is None else 3
    if axes is None:
        found = grid_axes(rows, columns, 3.2, 3.5)
    else:
        found = given(axes, rows * columns, "against")
    for ax in found:
        ax.set_axis_off()
    first, last = found[:columns], found[-columns:]
    for ax, x, title in zip(first, shown, titles, strict=True):
        image(x, title=title, srgb=srgb, ax=ax)
    if window is not None:
        row, column, size = window
        part = np.s_[row : row + size, column : column + size]
        low, high = shown[-1][part].min(), shown[-1][part].max()
        for ax, below, x in zip(first, found[columns:], shown, strict=False):
            _frame(ax, row, column, size)
            stretched = np.clip((x[part] - low) / ((high - low) or 1.0), 0, 1)
            image(stretched, title="the frame, contrast raised", srgb=srgb, ax=below)
    for ax, gap, part in zip(last, gaps, signed, strict=False):
        drawn = show_signed(ax, part, scale)
        numbers = f"max {np.abs(gap).max():.1e}, rms {np.sqrt((gap**2).mean()):.1e}"
        set_title(ax, f"difference: {numbers}", size="small")
    color_bar(last[-1], drawn, (0.05, 0.1, 0.07, 0.8), beyond=True)
    legend = "mean of r, g, b: red is brighter, blue darker"
    last[-1].set_title(legend, fontsize="small", loc="left", color=ink(last[-1]))
    return found


def _require_several(name: str, images: Any) -> None:
    if getattr(images, "ndim", 4) != 4:
        raise ValueError(
            f"{name} takes a list of images, but was given an array of shape {images.shape}. Pass "
            "[a, b], or show one image with plot.image."
        )


def _frame(ax: Axes, row: int, column: int, size: int) -> None:
    """A square of pixels in white with a black edge, which is seen on any picture."""
    x = column + size * np.array([0, 1, 1, 0, 0]) - 0.5
    y = row + size * np.array([0, 0, 1, 1, 0]) - 0.5
    edge = [patheffects.withStroke(linewidth=2.5, foreground="black")]
    ax.plot(x, y, color="white", linewidth=1, path_effects=edge)


def _transfer_bar(
    ax: Axes, transfer: TransferFunction, label: str, background: Any, srgb: bool
) -> None:
    """The colours of a transfer function from bottom to top, beside a picture."""
    lo, hi = transfer.absolute_positions()[[0, -1]].tolist()
    margin = 0 if hi > lo else 0.5
    lo, hi = lo - margin, hi + margin
    s = lo + (np.arange(512)[::-1] + 0.5) / 512 * (hi - lo)
    colors, extinctions = (np.asarray(x, np.float64) for x in transfer(s))
    alpha = extinctions / (float(np.max(transfer.extinctions)) or 1.0)
    strip = np.concatenate([colors.clip(0, 1) * alpha[:, None], alpha[:, None]], axis=-1)
    bar = ax.inset_axes((1.03, 0.0, 0.06, 1.0))
    rows = max(2, round(4 * ax.bbox.height / (0.06 * ax.bbox.width)))
    ground = np.array(CHEQUER, np.uint8)[np.add.outer(np.arange(rows), np.arange(2)) % 2]
    for left, layer in (
        (0.0, np.stack([ground] * 3, axis=-1)),
        (0.0, pixels(strip[:, None], background, srgb)),
        (0.5, pixels(colors[:, None], None, srgb)),
    ):
        bar.imshow(
            layer,
            extent=(left, left + 0.5, lo, hi),
            aspect="auto",
            origin="upper",
            interpolation="nearest",
        )
    bar.set_xlim(0, 1)
    bar.set_xticks([])
    bar.yaxis.tick_right()
    bar.yaxis.set_label_position("right")
    bar.set_ylabel(label)
    color_as(bar, ink(ax))


def _opaque(image: Any, background: Any) -> np.ndarray:
    """An image over a background, (H, W, 3) in float64."""
    image = as_floats("image", image, ndim=3)
    if image.shape[-1] == 4:
        as_light("background", background)
        image = composite_over(image, background)
    require_finite("image", image)
    return np.asarray(image, np.float64)[..., :3]
