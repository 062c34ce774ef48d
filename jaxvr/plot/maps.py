"""Numbers of pixels as pictures: differences and gradients, with their sign; k-buffer entries."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Patch

from jaxvr._core.checks import as_floats, require_finite, require_kind
from jaxvr.optics.transfer import TransferFunction
from jaxvr.plot.axes import color_as, ink, legend_of, picture_axes, set_title, whole
from jaxvr.trace import KMap

# Nothing, few entries, more, most. For people who see red and green alike they differ in lightness.
K_COLORS = np.array([[0, 0, 0], [20, 120, 60], [250, 210, 40], [200, 20, 30]], np.uint8)
# Inches for a colour bar and its numbers.
BAR = 0.95


def difference(
    a: Any,
    b: Any,
    ax: Axes | None = None,
    *,
    scale: float | None = None,
    title: str | None = None,
) -> Any:
    """The largest channel difference a - b in each pixel, with its sign; returns the axes.

    a, b: images (H, W, C) of one shape. The colour bar runs from -scale to scale; by default scale
    is the largest difference. The title gives the largest and the mean absolute difference. Raises
    ValueError for other shapes, NaN, and a scale that is not above 0.
    """
    a, b = (np.asarray(as_floats(n, x, ndim=3), np.float64) for n, x in (("a", a), ("b", b)))
    if a.shape != b.shape:
        raise ValueError(f"The images must have one shape, but have {a.shape} and {b.shape}.")
    require_finite("a", a)
    require_finite("b", b)
    gap = a - b
    largest = float(np.abs(gap).max())
    if scale is None:
        scale = largest or 1.0  # equal images: any scale will do
    require_scale(scale)
    numbers = f"max {largest:.2e}, mean {np.abs(gap).mean():.2e}, scale ±{scale:.2e}"
    return _signed_picture(ax, strongest(gap), scale, title, numbers)


def gradient(
    x: Any,
    ax: Axes | None = None,
    *,
    channel: int | None = None,
    scale: float | None = None,
    title: str | None = None,
) -> Any:
    """The derivative of a number by the pixels of an image, red above 0, blue below; returns axes.

    x: (H, W), or (H, W, C), of which the channel of the largest size is shown, or `channel`. The
    colour bar runs from -scale to scale; by default 99.5 % of the pixels lie within, and those
    beyond have the last colour. The title gives the largest and the mean size of what is shown.
    Raises ValueError for other shapes, NaN, and a scale that is not above 0.
    """
    if isinstance(x, TransferFunction):
        raise ValueError(
            "gradient shows the pixels of an image, but was given a TransferFunction: use "
            "transfer_gradient(transfer, gradient)."
        )
    x = np.asarray(as_floats("x", x), np.float64)
    if x.ndim not in (2, 3) or 0 in x.shape:
        raise ValueError(f"A gradient is (H, W) or (H, W, C), but this one is {x.shape}.")
    require_finite("x", x)
    if channel is not None and x.ndim == 2:
        raise ValueError(f"This gradient has no channels (its shape is {x.shape}): leave them out.")
    if channel is not None and not -x.shape[-1] <= channel < x.shape[-1]:
        raise ValueError(f"There are {x.shape[-1]} channels, but channel is {channel}.")
    if x.ndim == 3:
        x = strongest(x) if channel is None else x[..., channel]
    size = np.abs(x)
    if scale is None:
        scale = float(np.quantile(size, 0.995)) or float(size.max()) or 1.0
    require_scale(scale)
    numbers = f"max {size.max():.2e}, mean {size.mean():.2e}, scale ±{scale:.2e}"
    return _signed_picture(ax, x, scale, title, numbers)


def k_map(
    kmap: Any,
    ax: Axes | None = None,
    limits: tuple[int, int] = (2, 6),
    *,
    title: str | None = None,
) -> Any:
    """How many entries a k-buffer needs in each pixel; returns the axes.

    kmap: a `jaxvr.KMap`, as `measure_k` returns it. As in Figure 6 of Callahan et al., "Hardware-
    assisted visibility sorting for unstructured volume rendering" (2005): green where limits[0]
    entries do, yellow where limits[1] do, red where more are needed, and nothing where there is
    nothing. The legend counts the pixels. Raises ValueError for what is no `KMap`.
    """
    require_kind("kmap", kmap, KMap, "Make one with jaxvr.measure_k.")
    few, many = limits
    if not 1 <= few < many:
        raise ValueError(f"limits must be two numbers, 1 <= first < second, but are {limits}.")
    entries, seen = np.asarray(kmap.entries), np.asarray(kmap.fragments) > 0
    kind = np.where(seen, 1 + (entries > few).astype(int) + (entries > many), 0)
    shown = np.concatenate([K_COLORS[kind], 255 * seen[..., None].astype(np.uint8)], axis=-1)
    if ax is None:
        ax = picture_axes([kind.shape], 4.0, titles=[title], bottom=0.95)[0]
    else:
        set_title(ax, title)
    show_pixels(ax, shown)
    names = [f"up to {few}", f"{few + 1} to {many}", f"{many + 1} or more"]
    names[1] = names[1] if many > few + 1 else f"{many}"
    names = [f"{name}: {(kind == k).sum():,} pixels" for k, name in enumerate(names, 1)]
    legend_of(
        ax,
        handles=[
            Patch(facecolor=color / 255, edgecolor=ink(ax), linewidth=0.5, label=name)
            for color, name in zip(K_COLORS[1:], names, strict=True)
        ],
        title=f"entries needed, at most {int(entries.max())}",
        loc="upper center",
        bbox_to_anchor=(0.5, -0.01),
        frameon=False,
        fontsize="small",
        title_fontsize="small",
    )
    return ax


def show_pixels(ax: Axes, pixels: np.ndarray) -> Any:
    """A picture with its pixels unsmoothed and no axis round it."""
    drawn = ax.imshow(pixels, interpolation="nearest", origin="upper", aspect="equal")
    ax.set_axis_off()
    return drawn


def show_signed(ax: Axes, values: np.ndarray, scale: float) -> Any:
    """Numbers (H, W) from -scale in blue to scale in red."""
    drawn = show_pixels(ax, values)
    drawn.set_cmap("RdBu_r")
    drawn.set_clim(-scale, scale)
    return drawn


def color_bar(ax: Axes, drawn: Any, box: Any, beyond: bool) -> None:
    """A colour bar for what was drawn, in a part of the axes; `beyond` points its ends."""
    bar = ax.inset_axes(box)
    made = whole(ax).colorbar(drawn, cax=bar, extend="both" if beyond else "neither", format="%.1e")
    color_as(bar, ink(ax))
    made.outline.set_edgecolor(ink(ax))


def strongest(x: np.ndarray) -> np.ndarray:
    """Of the numbers (H, W, C) of each pixel that of the largest size, with its sign: (H, W)."""
    return np.take_along_axis(x, np.abs(x).argmax(axis=-1)[..., None], axis=-1)[..., 0]


def require_scale(scale: Any) -> None:
    if not 0 < scale < np.inf:
        raise ValueError(f"scale must be above 0, but is {scale:g}.")


def _signed_picture(
    ax: Axes | None, values: np.ndarray, scale: float, title: str | None, numbers: str
) -> Any:
    text = f"{title}\n{numbers}" if title else numbers
    if ax is None:
        ax = picture_axes([(values.shape[0], values.shape[1])], 4.0, titles=[text], right=BAR)[0]
    set_title(ax, text, size="small")
    drawn = show_signed(ax, values, scale)
    color_bar(ax, drawn, (1.03, 0.0, 0.05, 1.0), bool(np.abs(values).max() > scale))
    return ax
