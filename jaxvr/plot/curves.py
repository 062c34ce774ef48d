"""Curves: transfer functions and their gradients over the scalar, losses over the iterations."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from jaxvr._core.checks import as_floats, require_finite, require_shape
from jaxvr.optics.transfer import TransferFunction
from jaxvr.plot.axes import color_as, ink, legend_of, new_axes, set_title
from jaxvr.volume import AbstractVolume

# More control points than this are not marked one by one.
MARKED = 64


def transfer(
    tf: TransferFunction,
    ax: Axes | None = None,
    reference: TransferFunction | None = None,
    values: Any = None,
    *,
    title: str | None = None,
) -> Any:
    """Extinction against the scalar, filled with the colours; returns the axes.

    Args:
      tf: the transfer function.
      reference: another one, dashed, with the colours of both as strips on top.
      values: a volume or an array of scalars: how many values there are of each size, as a
        faint histogram with a logarithmic height of its own. A volume
        names the axis after its field.

    Raises ValueError for what is no transfer function, and for NaN in values.
    """
    both = [tf] if reference is None else [tf, reference]
    for f in both:
        _require_transfer(f)
    data = None if values is None else _scalars(values)
    ends = [f.absolute_positions()[k] for f in both for k in (0, -1)]
    ends += [] if data is None else [data.min(), data.max()]
    lo, hi = float(min(ends)), float(max(ends))
    margin = 0.03 * (hi - lo) or 0.5
    lo, hi = lo - margin, hi + margin
    top = 1.05 * max(float(np.max(f.extinctions)) for f in both) or 1.0
    ax = ax or new_axes(6.0, 3.2)
    color = ink(ax)
    x, y = _outline(tf, lo, hi)
    band = ax.fill_between(x, y, color="none")
    strip = ax.imshow(
        _strip(tf, lo, hi), extent=(lo, hi, 0, top), aspect="auto", origin="upper", zorder=0.5
    )
    if len(band.get_paths()):
        strip.set_clip_path(band.get_paths()[0], ax.transData)
    ax.plot(x, y, color=color, linewidth=1.2, label="transfer function")
    if len(tf.positions) <= MARKED:
        ax.plot(tf.absolute_positions(), tf.extinctions, "o", color=color, markersize=3)
    room = top
    if reference is not None:
        outline = _outline(reference, lo, hi)
        label = "reference (upper strip)"
        ax.plot(*outline, "--", color="tab:red", linewidth=1.2, label=label)
        for k, f in enumerate(both):
            level = (top * (1.02 + 0.07 * k), top * (1.08 + 0.07 * k))
            ax.imshow(_strip(f, lo, hi), extent=(lo, hi, *level), aspect="auto", origin="upper")
        room *= 1.17
    if data is not None:
        _histogram(ax, data, 0.95 * top / room)
    ax.set_xlim(lo, hi)
    ax.set_ylim(0, room)
    ax.set_xlabel((isinstance(values, AbstractVolume) and values.field_name) or "scalar")
    ax.set_ylabel("extinction per unit length")
    if len(both) > 1 or data is not None:
        legend_of(ax, fontsize="small", loc="best")
    set_title(ax, title)
    return ax


def transfer_gradient(
    tf: TransferFunction,
    gradient: TransferFunction,
    ax: Axes | None = None,
    *,
    title: str | None = None,
) -> Any:
    """The derivative of a number by a transfer function's control points; returns the axes.

    Args:
      tf: gives the positions. gradient: as `jax.grad` returns it, a `TransferFunction` of
        derivatives. That by the extinctions stands as bars, on the axis on the left, those by
        r, g and b as lines, on the axis on the right; both are 0 at the same height. That by the
        positions is left out.

    Raises ValueError for numbers of control points that differ, and for NaN.
    """
    for f in (tf, gradient):
        _require_transfer(f)
    k = len(tf.positions)
    extinctions, colors = (
        np.asarray(as_floats(f"gradient.{name}", getattr(gradient, name)), np.float64)
        for name in ("extinctions", "colors")
    )
    for name, x, shape in (("extinctions", extinctions, (k,)), ("colors", colors, (k, 3))):
        require_shape(f"gradient.{name}", x, shape)
        require_finite(f"gradient.{name}", x)
    ax = ax or new_axes(6.0, 3.2)
    right, color = ax.twinx(), ink(ax)
    color_as(right, color)
    right.grid(False)
    x, mark = tf.absolute_positions(), "o" if k <= MARKED else ""
    ax.axhline(0, color=color, linewidth=0.8)
    bars = ax.vlines(x, 0, extinctions, color=color, linewidth=2.5, alpha=0.55, label="extinction")
    lines = [
        right.plot(x, part, mark + "-", color=f"tab:{name}", label=name, markersize=3)[0]
        for name, part in zip(("red", "green", "blue"), colors.T, strict=True)
    ]
    for axes, numbers in ((ax, extinctions), (right, colors)):
        most = 1.08 * float(np.abs(numbers).max()) or 1.0
        axes.set_ylim(-most, most)
    ax.set_xlabel("scalar")
    ax.set_ylabel("derivative by extinction (bars)")
    right.set_ylabel("derivative by colour (lines)")
    set_title(ax, title)
    legend = legend_of(ax, handles=[bars, *lines], fontsize="small", loc="best")
    # Above what is drawn on the right, whose axes come later.
    legend.remove()
    right.add_artist(legend)
    return ax


def history(result_or_losses: Any, ax: Axes | None = None, *, title: str | None = None) -> Any:
    """The loss of a fit at each iteration; returns the axes.

    result_or_losses: what `jaxvr.fit` or `fit_parameters` returned, or losses (n,). The scale is
    logarithmic unless a loss is negative; where it is 0 or not finite there is a gap. Without a
    `title`, it gives the PSNR of the views held out, if there are any, and the mean of several.
    """
    losses = getattr(result_or_losses, "loss_history", result_or_losses)
    losses = np.asarray(as_floats("losses", losses, ndim=1), np.float64)
    if len(losses) == 0:
        raise ValueError("There are no losses: the fit has made no step.")
    ax = ax or new_axes(6.0, 3.2)
    known = losses[np.isfinite(losses)]
    mark = "o" if len(losses) == 1 else ""
    ax.plot(np.arange(len(losses)), losses, mark + "-", color=ink(ax), linewidth=1.2)
    if len(known) and known.min() >= 0 and known.max() > 0:
        ax.set_yscale("log", nonpositive="mask")
        # Minor ticks come with the scale.
        color_as(ax, ink(ax))
    ax.set_xlabel("iteration")
    ax.set_ylabel("loss")
    ax.xaxis.set_major_locator(MaxNLocator("auto", steps=[1, 2, 5, 10], integer=True))
    set_title(ax, title or _held_out(result_or_losses))
    return ax


def _held_out(result: Any) -> str | None:
    """What a result says of the views that it was not fitted to."""
    report = result.report() if callable(getattr(result, "report", None)) else {}
    scores = [view["psnr"] for view in report.get("held_out", [])]
    if not scores:
        return None
    unequal = [x for x in scores if x is not None]
    if not unequal:
        return "held out: equal to the target"
    if len(scores) == 1:
        return f"held out: PSNR {scores[0]:.2f} dB"
    if len(unequal) < len(scores):
        return f"held out: PSNR {min(unequal):.2f} dB or more, {len(scores)} views"
    return f"held out: PSNR {np.mean(unequal):.2f} dB, mean of {len(scores)} views"


def _histogram(ax: Axes, data: np.ndarray, height: float) -> None:
    """Faint bars behind a plot, up to a part `height` of the axes' own."""
    counts, edges = np.histogram(data, bins=min(128, max(8, round(len(data) ** 0.5))))
    levels = height * np.log1p(counts) / np.log1p(counts.max())
    where = ax.get_xaxis_transform()  # x in scalars, y as part of the axes
    color = ink(ax)
    ax.stairs(levels, edges, fill=True, color=color, alpha=0.15, transform=where, zorder=0.2)
    ax.stairs(
        *(levels, edges),
        color=color,
        alpha=0.45,
        linewidth=0.7,
        transform=where,
        zorder=0.8,
        label="data, log of the count",
    )


def _scalars(values: Any) -> np.ndarray:
    values = values.weighted_values()[0] if isinstance(values, AbstractVolume) else values
    data = np.asarray(as_floats("values", values), np.float64).ravel()
    if len(data) == 0:
        raise ValueError("There are no values: leave them out.")
    require_finite("values", data)
    return data


def _require_transfer(tf: Any) -> None:
    if not isinstance(tf, TransferFunction):
        raise ValueError(f"This takes a jaxvr.TransferFunction, but got a {type(tf).__name__}.")


def _outline(tf: TransferFunction, lo: float, hi: float) -> tuple[np.ndarray, np.ndarray]:
    """The graph as a polyline with its jumps upright, carried on to lo and hi."""
    x, y = tf.absolute_positions(), np.asarray(tf.extinctions, np.float64)
    return np.concatenate([[lo], x, [hi]]), np.concatenate([y[:1], y, y[-1:]])


def _strip(tf: TransferFunction, lo: float, hi: float) -> np.ndarray:
    """The colours from lo to hi as one row of pixels (1, 1024, 3)."""
    s = lo + (np.arange(1024) + 0.5) / 1024 * (hi - lo)
    return np.clip(np.asarray(tf(s)[0], np.float64), 0, 1)[None]
