"""Colour maps as functions from [0, 1] to linear RGB, and interpolation in other colour spaces.

Beside `jaxvr.plot` this is the one place that touches matplotlib, and only its table of named
colour maps (`matplotlib.colormaps`), imported when a name is looked up.
"""

from __future__ import annotations

import difflib
import functools
from typing import Any

import numpy as np


def sample(colormap: Any, x: np.ndarray, *, srgb: bool = False) -> np.ndarray:
    """Colours (n, 3) float64 of a colour map at `x` (n,) in [0, 1].

    `colormap` is a name known to matplotlib, a callable, or a table (m, 3) or (m, 4) with its first
    entry at 0 and its last at 1. The numbers are taken as they stand, unless `srgb`: then they are
    decoded to linear light. Raises ValueError for unknown names and malformed tables.
    """
    if isinstance(colormap, str):
        colors = _named(colormap)(x)
    elif callable(colormap):
        colors = colormap(x)
    else:
        colors = _table(colormap, x)
    colors = np.asarray(colors, np.float64)
    if colors.ndim != 2 or colors.shape[0] != len(x) or colors.shape[1] not in (3, 4):
        raise ValueError(
            f"The colour map gave shape {colors.shape} for {len(x)} numbers; "
            f"it must give ({len(x)}, 3) or ({len(x)}, 4)."
        )
    return srgb_to_linear(colors[:, :3]) if srgb else colors[:, :3]


def srgb_to_linear(c: np.ndarray) -> np.ndarray:
    """Decodes sRGB (IEC 61966-2-1) to linear light."""
    return np.where(
        c <= 0.04045, c / 12.92, (np.maximum(c, 0.04045) / 1.055 + 0.055 / 1.055) ** 2.4
    )


def _named(name: str) -> Any:
    import matplotlib

    if name not in matplotlib.colormaps:
        near = difflib.get_close_matches(name, list(matplotlib.colormaps), n=3)
        hint = f" Did you mean {' or '.join(near)}?" if near else ""
        raise ValueError(f"matplotlib has no colour map {name!r}.{hint}")
    return matplotlib.colormaps[name]


def _table(table: Any, x: np.ndarray) -> np.ndarray:
    try:
        table = np.asarray(table, np.float64)
    except (TypeError, ValueError) as e:
        raise ValueError(f"The colour map is neither a name, a function nor a table: {e}") from e
    if table.ndim != 2 or table.shape[1] not in (3, 4) or len(table) == 0:
        raise ValueError(f"A colour table must have shape (n, 3) or (n, 4), but has {table.shape}.")
    knots = np.linspace(0.0, 1.0, len(table)) if len(table) > 1 else np.zeros(1)
    return np.stack([np.interp(x, knots, column) for column in table.T], axis=1)


# Interpolation as VTK's colour transfer function does it, between colours a and b (n, 3) at t (n,).


def interpolate(space: str, a: np.ndarray, b: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Colours (n, 3) between `a` and `b` (n, 3) at `t` (n,) in [0, 1], in a colour space.

    `space` is a name of `SPACES`. CIELAB has the white point D65; "Diverging" is the Msh space of
    Moreland, "Diverging color maps for scientific visualization" (2009), which passes through white
    between two saturated colours of different hue.
    """
    if space not in SPACES:
        raise ValueError(f"Colour space {space!r} is not known, only {', '.join(SPACES)}.")
    return SPACES[space](a, b, t[:, None])


def _rgb(a: np.ndarray, b: np.ndarray, t: np.ndarray) -> np.ndarray:
    return a + t * (b - a)


def _step(a: np.ndarray, b: np.ndarray, t: np.ndarray) -> np.ndarray:
    return b + 0 * t


def _hsv(a: np.ndarray, b: np.ndarray, t: np.ndarray, wrap: bool = True) -> np.ndarray:
    import colorsys

    a, b = (np.array([colorsys.rgb_to_hsv(*c) for c in ab.tolist()]) for ab in (a, b))
    if wrap:  # the short way round the circle of hues
        gap = a[:, 0] - b[:, 0]
        a[:, 0] -= gap > 0.5
        b[:, 0] -= gap < -0.5
    hsv = _rgb(a, b, t)
    hsv[:, 0] %= 1.0
    return np.array([colorsys.hsv_to_rgb(*c) for c in hsv.tolist()])


def _lab(a: np.ndarray, b: np.ndarray, t: np.ndarray) -> np.ndarray:
    return _lab_to_rgb(_rgb(_rgb_to_lab(a), _rgb_to_lab(b), t))


def _diverging(a: np.ndarray, b: np.ndarray, t: np.ndarray) -> np.ndarray:
    a, b = _lab_to_msh(_rgb_to_lab(a)), _lab_to_msh(_rgb_to_lab(b))
    turn = np.abs(a[:, 2] - b[:, 2]) % (2 * np.pi)
    turn = np.where(turn > np.pi, 2 * np.pi - turn, turn)
    through = ((a[:, 1] > 0.05) & (b[:, 1] > 0.05) & (turn > 0.33 * np.pi))[:, None]
    white = np.zeros_like(a)
    white[:, 0] = np.maximum(88.0, np.maximum(a[:, 0], b[:, 0]))
    first = t < 0.5
    a, b = np.where(through & ~first, white, a), np.where(through & first, white, b)
    t = np.where(through, np.where(first, 2 * t, 2 * t - 1), t)
    # A colour without saturation has no hue of its own: it takes the other's, spun for evenness.
    grey_a, grey_b = a[:, 1] < 0.05, b[:, 1] < 0.05
    hue_a = np.where(grey_a & (b[:, 1] > 0.05), _spun_hue(b, a[:, 0]), a[:, 2])
    hue_b = np.where(grey_b & (a[:, 1] > 0.05), _spun_hue(a, b[:, 0]), b[:, 2])
    gap = hue_b - hue_a
    a[:, 2], b[:, 2] = hue_a, hue_a + gap - 2 * np.pi * np.rint(gap / (2 * np.pi))
    m, s, h = _rgb(a, b, t).T
    lab = np.stack([m * np.cos(s), m * np.sin(s) * np.cos(h), m * np.sin(s) * np.sin(h)], axis=1)
    return _lab_to_rgb(lab)


def _spun_hue(msh: np.ndarray, unsaturated: np.ndarray) -> np.ndarray:
    m, s, h = msh.T
    spins = (m < unsaturated - 0.1) & (s > 0.05)
    m, s = np.where(spins, m, 1.0), np.where(spins, s, 1.0)
    rise = np.sqrt(np.maximum(unsaturated**2 - m**2, 0.0))
    spin = np.where(spins, s * rise / (m * np.sin(s)), 0.0)
    return h + np.where(h > -0.3 * np.pi, spin, -spin)


_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
_RGB = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])
_WHITE = np.array([0.9505, 1.0, 1.089])


def _rgb_to_lab(c: np.ndarray) -> np.ndarray:
    v = srgb_to_linear(c) @ _XYZ.T / _WHITE
    x, y, z = np.where(v > 0.008856, np.cbrt(v), 7.787 * v + 16 / 116).T
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=1)


def _lab_to_rgb(lab: np.ndarray) -> np.ndarray:
    y = (lab[:, 0] + 16) / 116
    v = np.stack([y + lab[:, 1] / 500, y, y - lab[:, 2] / 200], axis=1)
    xyz = np.where(v**3 > 0.008856, v**3, (v - 16 / 116) / 7.787) * _WHITE
    c = xyz @ _RGB.T
    c = np.where(c > 0.0031308, 1.055 * np.maximum(c, 0.0031308) ** (1 / 2.4) - 0.055, 12.92 * c)
    return np.maximum(c / np.maximum(c.max(axis=1, keepdims=True), 1.0), 0.0)


def _lab_to_msh(lab: np.ndarray) -> np.ndarray:
    m = np.linalg.norm(lab, axis=1)
    safe = np.where(m > 0.001, m, 1.0)
    s = np.where(m > 0.001, np.arccos(np.clip(lab[:, 0] / safe, -1, 1)), 0.0)
    h = np.where(s > 0.001, np.arctan2(lab[:, 2], lab[:, 1]), 0.0)
    return np.stack([m, s, h], axis=1)


SPACES = {
    "RGB": _rgb,
    "Step": _step,
    "HSV": functools.partial(_hsv, wrap=False),
    "HSVWrap": _hsv,
    "Lab": _lab,
    "Diverging": _diverging,
}
"""The colour spaces of `interpolate`; "HSVWrap" takes the short way round the hues."""
