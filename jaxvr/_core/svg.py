"""Small pictures and tables as HTML for notebooks: text, no files, no scripts.

Lines and letters have the page's own colour (`currentColor`), so they read on light and dark pages.
"""

from __future__ import annotations

import hashlib
import html
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

BINS = 64
# Of more values than this every n-th is counted: a histogram is for the eye.
SAMPLE = 1_000_000


def histogram(values: Any, low: float, high: float, bins: int = BINS) -> tuple[np.ndarray, int]:
    """Counts (bins,) of values between low and high, and n where every n-th value was counted.

    NaN, infinities and values outside are left out; of equal bounds all fall into the middle bin.
    """
    flat = np.asarray(values).reshape(-1)
    every = -(-flat.size // SAMPLE) or 1
    # As parts of the largest, whose difference cannot overflow.
    scale = max(abs(low), abs(high)) or 1.0
    x, a, b = flat[::every].astype(np.float64) / scale, low / scale, high / scale
    x = x[(x >= a) & (x <= b)]
    if not b > a:
        return np.bincount(np.full(len(x), bins // 2), minlength=bins), every
    place = np.minimum((bins * ((x - a) / (b - a))).astype(int), bins - 1)
    return np.bincount(place, minlength=bins), every


def bars(heights: Any, width: float, height: float) -> str:
    """The path of a bar chart on the bottom of a width x height box; the largest bar fills it."""
    h = np.asarray(heights, np.float64)
    tops = height * (1 - h / (h.max() or 1.0))
    x = np.linspace(0, width, len(h) + 1)
    steps = (f"V{y:.1f}H{right:.1f}" for y, right in zip(tops, x[1:], strict=True))
    return f"M0,{height:g}{''.join(steps)}V{height:g}Z"


def polyline(points: Iterable[Sequence[float]]) -> str:
    """Points (x, y) as they stand in `points` attributes."""
    return " ".join(f"{x:.2f},{y:.2f}" for x, y in points)


def hex_color(rgb: Any) -> str:
    """RGB (3,) as #rrggbb, clipped to what a display has; the numbers are taken as they are."""
    r, g, b = (int(v) for v in np.rint(np.clip(np.asarray(rgb, np.float64), 0, 1) * 255))
    return f"#{r:02x}{g:02x}{b:02x}"


def gradient(offsets: Any, colors: Any, left: float, right: float) -> tuple[str, str]:
    """A horizontal gradient and its id: colours (n, 3) at offsets (n,) in [0, 1] from x = left to
    right. Two equal offsets make a jump."""
    stops = "".join(
        f'<stop offset="{offset:.6f}" stop-color="{hex_color(color)}"/>'
        for offset, color in zip(np.asarray(offsets, np.float64), colors, strict=True)
    )
    text = f'gradientUnits="userSpaceOnUse" x1="{left:g}" x2="{right:g}" y1="0" y2="0">{stops}'
    # All outputs of a notebook share one space of names: equal gradients may share one, others not.
    name = "jaxvr-" + hashlib.sha256(text.encode()).hexdigest()[:12]
    return f'<linearGradient id="{name}" {text}</linearGradient>', name


def picture(width: float, height: float, parts: Iterable[str], label: str) -> str:
    """An <svg> of that many pixels with what is in it, and a label for those who cannot see it."""
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:g}" height="{height:g}" '
        f'viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{html.escape(label)}" '
        'style="color:inherit;background:transparent;max-width:100%">'
        f"{''.join(parts)}</svg>"
    )


def caption(x: float, y: float, text: str, anchor: str = "start") -> str:
    """Small letters in the page's colour."""
    return (
        f'<text x="{x:g}" y="{y:g}" text-anchor="{anchor}" font-size="11" fill="currentColor" '
        f'fill-opacity="0.75" font-family="sans-serif">{html.escape(text)}</text>'
    )


def table(rows: Iterable[tuple[str, str]]) -> str:
    """Labels and facts in two columns."""
    cell = "text-align:left;background:transparent;border:none;padding:1px 12px 1px 0;"
    body = "".join(
        f'<tr style="background:transparent"><th style="{cell}font-weight:normal;opacity:0.7">'
        f'{html.escape(label)}</th><td style="{cell}">{html.escape(text)}</td></tr>'
        for label, text in rows
    )
    return f'<table style="border:none;margin:4px 0"><tbody>{body}</tbody></table>'
