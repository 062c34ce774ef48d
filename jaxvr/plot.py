"""Pictures and plots with matplotlib: files, notebooks, comparisons.

Nothing here needs a display or changes pyplot's state: figures are `matplotlib.figure.Figure`
objects, which notebooks show and `figure.savefig(path)` writes. Images are premultiplied linear
RGBA (H, W, 4), as `render` returns them, or opaque RGB (H, W, 3).

Colour maps are made for display, and `TransferFunction.from_colormap` takes their numbers as they
are; so pictures, too, are shown as they are by default. With `srgb=True` linear light is coded as
sRGB first.
"""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as _MatplotlibFigure
from matplotlib.image import imsave

from jaxvr._core.checks import as_floats, require_finite
from jaxvr.optics.transfer import TransferFunction
from jaxvr.view import images as _images


class Figure(_MatplotlibFigure):
    """A matplotlib figure that a notebook shows without pyplot."""

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        self.savefig(buffer, format="png")
        return buffer.getvalue()


def save_png(
    path: str | os.PathLike[str], image: Any, background: Any = None, srgb: bool = False
) -> None:
    """Writes a PNG file with the image's pixels, eight bits a channel.

    A transparent image becomes a PNG with straight alpha, as the format wants it; with `background`
    (linear RGB (3,)) an opaque one.
    """
    imsave(path, _bytes(image, background, srgb), format="png")


def show(
    image: Any,
    *,
    title: str | None = None,
    background: Any = None,
    srgb: bool = False,
    ax: Axes | None = None,
) -> Any:
    """A figure with one picture, its pixels unsmoothed; returns the figure.

    With `ax` it is drawn there instead. Transparency shows the page, or `background` (3,).
    """
    if ax is None:
        ax = _figure(1, 1, 4.0)[0]
    ax.imshow(_bytes(image, background, srgb), interpolation="nearest")
    ax.set_axis_off()
    if title:
        ax.set_title(title)
    return ax.figure


def comparison(
    images: Sequence[Any],
    titles: Sequence[str] | None = None,
    *,
    background: Any = None,
    srgb: bool = False,
) -> Figure:
    """A figure with pictures side by side."""
    if len(images) == 0:
        raise ValueError("comparison needs at least one image.")
    if titles is not None and len(titles) != len(images):
        raise ValueError(f"There are {len(images)} images, but {len(titles)} titles.")
    axes = _figure(1, len(images), 3.2)
    for k, (ax, image) in enumerate(zip(axes, images, strict=True)):
        title = titles[k] if titles is not None else None
        show(image, title=title, background=background, srgb=srgb, ax=ax)
    return _own(axes[0])


def difference(a: Any, b: Any, *, scale: float | None = None, title: str | None = None) -> Figure:
    """A figure of the largest channel difference a - b in each pixel, with its sign.

    The colour bar runs from -scale to scale; by default scale is the largest difference. The title
    gives the largest and the mean absolute difference.
    """
    a, b = (np.asarray(as_floats(n, x, ndim=3), np.float64) for n, x in (("a", a), ("b", b)))
    if a.shape != b.shape:
        raise ValueError(f"The images must have one shape, but have {a.shape} and {b.shape}.")
    require_finite("a", a)
    require_finite("b", b)
    gap = a - b
    worst = np.take_along_axis(gap, np.abs(gap).argmax(axis=-1)[..., None], axis=-1)[..., 0]
    largest = float(np.abs(gap).max())
    if scale is None:
        scale = largest or 1.0  # equal images: any scale will do
    if not 0 < scale < np.inf:
        raise ValueError(f"scale must be above 0, but is {scale:g}.")
    ax = _figure(1, 1, 4.0, width=5.2)[0]
    drawn = ax.imshow(worst, cmap="RdBu_r", vmin=-scale, vmax=scale, interpolation="nearest")
    ax.set_axis_off()
    numbers = f"max {largest:.2e}, mean {np.abs(gap).mean():.2e}, scale ±{scale:.2e}"
    ax.set_title(f"{title}\n{numbers}" if title else numbers, fontsize="small")
    figure = _own(ax)
    figure.colorbar(drawn, ax=ax, shrink=0.8, format="%.1e")
    return figure


def against(
    images: Sequence[Any],
    reference: Any,
    titles: Sequence[str],
    *,
    scale: float | None = None,
    window: tuple[int, int, int] | None = None,
    background: Any = (0.0, 0.0, 0.0),
    srgb: bool = False,
) -> Figure:
    """A figure with pictures in a row, the reference last, and below each how it differs from it.

    Differences are picture - reference as seen over the background, the mean of r, g and b with
    its sign, all in one scale: red is brighter, blue darker. By default it reaches to the 99.5 %
    quantile of all of them, and what lies beyond has the last colour. The numbers above them are
    over r, g and b of all pixels.

    titles: one each, and one for the reference. window (row, column, size): a square that is framed
    in each picture and shown again below it, its contrast raised alike in all.
    """
    if len(images) == 0 or len(titles) != len(images) + 1:
        raise ValueError(
            f"against needs images, and a title for each and for the reference, but there are "
            f"{len(images)} images and {len(titles)} titles."
        )
    shown = [_opaque(x, background) for x in (*images, reference)]
    gaps = [x - shown[-1] for x in shown[:-1]]
    signed = [gap.mean(-1) for gap in gaps]
    if scale is None:
        scale = float(np.quantile(np.abs(signed), 0.995)) or 1.0
    rows = 2 if window is None else 3
    figure = Figure(figsize=(3.2 * len(shown), 3.5 * rows), dpi=100, layout="constrained")
    axes = figure.subplots(rows, len(shown), squeeze=False)
    for ax in axes.flat:
        ax.set_axis_off()
    for ax, image, title in zip(axes[0], shown, titles, strict=True):
        show(image, title=title, srgb=srgb, ax=ax)
    if window is not None:
        row, column, size = window
        part = np.s_[row : row + size, column : column + size]
        low, high = shown[-1][part].min(), shown[-1][part].max()
        for ax, below, image in zip(axes[0], axes[1], shown, strict=True):
            corners = (
                column + size * np.array([0, 1, 1, 0, 0]),
                row + size * np.array([0, 0, 1, 1, 0]),
            )
            ax.plot(*(x - 0.5 for x in corners), color="white", linewidth=1)
            stretched = np.clip((image[part] - low) / ((high - low) or 1.0), 0, 1)
            show(stretched, title="the frame, contrast raised", srgb=srgb, ax=below)
    for ax, gap, part in zip(axes[-1], gaps, signed, strict=False):
        drawn = ax.imshow(part, cmap="RdBu_r", vmin=-scale, vmax=scale, interpolation="nearest")
        ax.set_title(
            f"difference: max {np.abs(gap).max():.1e}, rms {np.sqrt((gap**2).mean()):.1e}",
            fontsize="small",
        )
    bar = axes[-1, -1].inset_axes((0.05, 0.1, 0.07, 0.8))
    figure.colorbar(drawn, cax=bar, extend="both", format="%.1e")
    legend = "mean of r, g, b: red is brighter, blue darker"
    axes[-1, -1].set_title(legend, fontsize="small", loc="left")
    return figure


def plot_transfer(
    tf: TransferFunction,
    ax: Axes | None = None,
    reference: TransferFunction | None = None,
) -> Any:
    """Extinction against the scalar, filled with the colours; returns the figure.

    `reference` is drawn dashed over it, and the colours of both as strips on top.
    """
    if ax is None:
        ax = _figure(1, 1, 3.2, width=6.0)[0]
    both = [tf] if reference is None else [tf, reference]
    lo = min(float(f.positions[0]) for f in both)
    hi = max(float(f.positions[-1]) for f in both)
    margin = 0.03 * (hi - lo) or 0.5
    lo, hi = lo - margin, hi + margin
    top = 1.05 * max(float(np.max(f.extinctions)) for f in both) or 1.0
    x, y = _outline(tf, lo, hi)
    band = ax.fill_between(x, y, color="none")
    strip = ax.imshow(_strip(tf, lo, hi), extent=(lo, hi, 0, top), aspect="auto", zorder=0)
    if len(band.get_paths()):
        strip.set_clip_path(band.get_paths()[0], ax.transData)
    ax.plot(x, y, color="black", linewidth=1.2, label="transfer function")
    if len(tf.positions) <= 64:
        ax.plot(tf.positions, tf.extinctions, "o", color="black", markersize=3)
    if reference is not None:
        ax.plot(
            *_outline(reference, lo, hi),
            "--",
            color="tab:red",
            linewidth=1.2,
            label="reference (upper strip)",
        )
        for k, f in enumerate(both):
            level = (top * (1.02 + 0.07 * k), top * (1.08 + 0.07 * k))
            ax.imshow(_strip(f, lo, hi), extent=(lo, hi, *level), aspect="auto")
        top *= 1.17
        ax.legend(fontsize="small", loc="best")
    ax.set_xlim(lo, hi)
    ax.set_ylim(0, top)
    ax.set_xlabel("scalar")
    ax.set_ylabel("extinction per unit length")
    return ax.figure


def _outline(tf: TransferFunction, lo: float, hi: float) -> tuple[np.ndarray, np.ndarray]:
    """The graph as a polyline with its jumps upright, carried on to lo and hi."""
    x, y = np.asarray(tf.positions, np.float64), np.asarray(tf.extinctions, np.float64)
    return np.concatenate([[lo], x, [hi]]), np.concatenate([y[:1], y, y[-1:]])


def _strip(tf: TransferFunction, lo: float, hi: float) -> np.ndarray:
    """The colours from lo to hi as one row of pixels (1, 1024, 3)."""
    s = lo + (np.arange(1024) + 0.5) / 1024 * (hi - lo)
    return np.clip(np.asarray(tf(s)[0], np.float64), 0, 1)[None]


def _bytes(image: Any, background: Any, srgb: bool) -> np.ndarray:
    """An image as bytes with straight alpha (H, W, 4), or without alpha (H, W, 3)."""
    image = np.asarray(as_floats("image", image, ndim=3))
    if image.shape[-1] not in (3, 4) or 0 in image.shape:
        raise ValueError(f"An image is (H, W, 4) or (H, W, 3), but this one is {image.shape}.")
    require_finite("image", image)
    if image.shape[-1] == 4 and background is not None:
        image = np.asarray(_images.composite_over(image, background))[..., :3]
    elif image.shape[-1] == 4:
        image = np.asarray(_images.unpremultiply(image))
    return _images.to_uint8(image, srgb=srgb)


def _opaque(image: Any, background: Any) -> np.ndarray:
    """An image over a background, (H, W, 3) in float64."""
    image = as_floats("image", image, ndim=3)
    if image.shape[-1] == 4:
        image = _images.composite_over(image, background)
    require_finite("image", image)
    return np.asarray(image, np.float64)[..., :3]


def _figure(rows: int, columns: int, size: float, width: float | None = None) -> list[Axes]:
    """Axes of a new figure, `size` inches high each; `width` if they are not square."""
    figure = Figure(figsize=((width or size) * columns, size * rows), dpi=100, layout="constrained")
    return list(figure.subplots(rows, columns, squeeze=False).ravel())


def _own(ax: Axes) -> Figure:
    figure = ax.figure
    assert isinstance(figure, Figure)
    return figure
