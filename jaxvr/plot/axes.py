"""Axes that show themselves, on figures without pyplot, and the colours of what is on them."""

from __future__ import annotations

import io
import math
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager
from typing import Any

import matplotlib.style
from matplotlib.axes import Axes
from matplotlib.figure import Figure as _MatplotlibFigure

# Inches between pictures and round them.
GAP = 0.12


class Figure(_MatplotlibFigure):
    """A matplotlib figure that a notebook shows without pyplot."""

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        self.savefig(buffer, format="png")
        return buffer.getvalue()


class PlotAxes(Axes):
    """Axes that a notebook shows, with the whole figure that they are on."""

    def savefig(self, path: Any, **options: Any) -> None:
        """Writes the figure; options as for matplotlib's `Figure.savefig`."""
        whole(self).savefig(path, **options)

    def _repr_png_(self) -> bytes:
        return whole(self)._repr_png_()


class AxesTuple(tuple[PlotAxes, ...]):
    """Several axes of one figure, shown as that."""

    @property
    def figure(self) -> Figure:
        """The figure that they are on."""
        return whole(self[0])

    def savefig(self, path: Any, **options: Any) -> None:
        """Writes the figure; options as for matplotlib's `Figure.savefig`."""
        self.figure.savefig(path, **options)

    def _repr_png_(self) -> bytes:
        return self.figure._repr_png_()


def dark() -> AbstractContextManager[None]:
    """New axes made inside `with dark():` are black, with light lines and text.

    It is matplotlib's style "dark_background" for as long; what was made inside stays dark.
    """
    return matplotlib.style.context("dark_background")


def new_axes(width: float, height: float) -> PlotAxes:
    """Axes for a plot, on a new figure of so many inches."""
    figure = Figure(figsize=(width, height), layout="constrained")
    return _own(figure.add_subplot(axes_class=PlotAxes))


def grid_axes(rows: int, columns: int, width: float, height: float) -> AxesTuple:
    """rows x columns of axes, row by row, each on so many inches of a new figure."""
    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, subplot_kw={"axes_class": PlotAxes})
    return AxesTuple(_own(ax) for ax in axes.ravel())


def picture_axes(
    sizes: Sequence[tuple[int, int]],
    inches: float,
    *,
    titles: Sequence[str | None] | None = None,
    left: float = 0.0,
    right: float = 0.0,
    bottom: float = 0.0,
) -> AxesTuple:
    """A row of axes for pictures of (height, width) pixels, on a new figure.

    The longest side of each is about `inches`. At the figure's own resolution a pixel of a picture
    is a square of whole pixels: it is as it is, where scaling would blur it, repeat it or leave it
    out. `left`, `right` and `bottom` are inches to leave free for what else there is.
    """
    longest = max(max(size) for size in sizes)
    dpi = longest * max(1, math.ceil(inches * 100 / longest)) / inches
    scales = [max(1, round(inches * dpi / max(size))) for size in sizes]
    widths = [w * k for (_, w), k in zip(sizes, scales, strict=True)]
    heights = [h * k for (h, _), k in zip(sizes, scales, strict=True)]
    gap, lines = round(GAP * dpi), max(_lines(title) for title in titles or [None])
    above = round((0.04 + 0.21 * lines) * dpi) if lines else 0
    margins = [round(x * dpi) for x in (left, right, bottom)]
    across = margins[0] + margins[1] + sum(widths) + gap * (len(sizes) + 1)
    up = margins[2] + max(heights) + above + 2 * gap
    # A little more than whole pixels, since what is less is cut off; and axes a little smaller than
    # whole pixels, since what is more gets another pixel.
    figure = Figure(figsize=((across + 1e-3) / dpi, (up + 1e-3) / dpi), dpi=dpi)
    out, at = [], margins[0] + gap
    for k, (w, h) in enumerate(zip(widths, heights, strict=True)):
        low = margins[2] + gap + (max(heights) - h) // 2
        position = (
            *((at + 0.005) / across, (low + 0.005) / up),
            *((w - 0.01) / across, (h - 0.01) / up),
        )
        ax = _own(figure.add_axes(position, axes_class=PlotAxes))
        if titles is not None:
            set_title(ax, titles[k], room=w + gap)
        out.append(ax)
        at += w + gap
    return AxesTuple(out)


def set_title(ax: Axes, title: str | None, *, size: Any = None, room: float | None = None) -> None:
    """A title, in smaller letters where it is wider than `room` pixels."""
    if not title:
        return
    text: Any = ax.set_title(title, color=ink(ax), **({} if size is None else {"fontsize": size}))
    if room is not None:
        wide = text.get_window_extent().width
        text.set_fontsize(max(5.0, text.get_fontsize() * min(1.0, room / max(wide, 1.0))))


def given(axes: Any, count: int, what: str) -> tuple[Axes, ...]:
    """The axes that a user passes for several pictures: so many, in any shape."""
    flat = getattr(axes, "flat", axes)
    found = tuple(flat) if isinstance(flat, Iterable) else (flat,)
    if len(found) != count:
        raise ValueError(f"{what} needs {count} axes, but was given {len(found)}.")
    return found


def ink(ax: Axes) -> Any:
    """The colour of the labels of axes, which stands out from what is behind them."""
    return ax.xaxis.label.get_color()


def color_as(ax: Any, color: Any) -> None:
    """Frame, ticks and labels in one colour."""
    ax.tick_params(which="both", color=color, labelcolor=color)
    for axis in (ax.xaxis, ax.yaxis):
        axis.label.set_color(color)
        axis.get_offset_text().set_color(color)
    for spine in ax.spines.values():
        spine.set_edgecolor(color)


def legend_of(ax: Axes, **options: Any) -> Any:
    """A legend in the colours of the axes."""
    legend = ax.legend(facecolor=ax.get_facecolor(), labelcolor=ink(ax), **options)
    legend.get_title().set_color(ink(ax))
    return legend


def whole(ax: Any) -> Any:
    """The figure that axes are on, even if they are on a part of it."""
    return ax.figure.figure


def _own(ax: Any) -> Any:
    """Ticks are made when they are drawn, in the style of then: keep them in that of now."""
    color_as(ax, ink(ax))
    return ax


def _lines(title: str | None) -> int:
    return title.count("\n") + 1 if title else 0
