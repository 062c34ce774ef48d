"""How a notebook shows a `TransferFunction`: extinction over the scalar, filled with colours."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from jaxvr._core import svg
from jaxvr._core.brief import ends, is_known

if TYPE_CHECKING:
    from jaxvr.optics.transfer import TransferFunction

WIDTH, HEIGHT = 420.0, 150.0
TOP, FLOOR, STRIP = 18.0, 112.0, 12.0
# Of more control points only some colours are drawn, and no dots.
STOPS, DOTS = 256, 64


def transfer_html(transfer: TransferFunction) -> str | None:
    """HTML of concrete control points; None where leaves are tracers or placeholders."""
    leaves = (transfer.positions, transfer.colors, transfer.extinctions)
    if not is_known(*leaves):
        return None
    x, colors, e = (np.asarray(leaf, np.float64) for leaf in leaves)
    if x.ndim != 1 or len(x) == 0 or colors.shape != (len(x), 3) or e.shape != x.shape:
        return None
    if not all(np.isfinite(a).all() for a in (x, colors, e)) or (np.diff(x) < 0).any():
        return None  # of the same structure but no transfer function: a gradient, say
    known = transfer.absolute_positions()
    scalars = ends(known[0], known[-1], 4)
    at, top = _places(x), float(e.max())
    level = FLOOR - (FLOOR - TOP) * np.maximum(e, 0) / (top if top > 0 else 1.0)
    curve = [(0.0, level[0]), *zip(at, level, strict=True), (WIDTH, level[-1])]
    outline = svg.polyline([(0.0, FLOOR), *curve, (WIDTH, FLOOR)])
    some = np.unique(np.linspace(0, len(x) - 1, min(len(x), STOPS)).astype(int))
    definition, name = svg.gradient(at[some] / WIDTH, colors[some], 0, WIDTH)
    parts = [
        f"<defs>{definition}</defs>",
        f'<polygon points="{outline}" fill="url(#{name})"/>',
        f'<polyline points="{svg.polyline(curve)}" fill="none" stroke="currentColor" '
        'stroke-width="1.2"/>',
        # The colours themselves, also of what has no extinction.
        f'<rect x="0" y="{FLOOR + 5:g}" width="{WIDTH:g}" height="{STRIP:g}" fill="url(#{name})"/>',
        f'<line x1="0" x2="{WIDTH:g}" y1="{FLOOR:g}" y2="{FLOOR:g}" stroke="currentColor"/>',
        svg.caption(0, 11, f"extinction up to {top:.4g} per unit length"),
        svg.caption(WIDTH, 11, _count(len(x)), "end"),
    ]
    if len(x) <= DOTS:
        parts += [
            f'<circle cx="{cx:.2f}" cy="{cy:.2f}" r="3" fill="{svg.hex_color(c)}" '
            'stroke="currentColor"/>'
            for cx, cy, c in zip(at, level, colors, strict=True)
        ]
    foot = HEIGHT - 4
    if x[0] == x[-1]:
        parts.append(svg.caption(WIDTH / 2, foot, scalars[0], "middle"))
    else:
        parts.append(svg.caption(at[0], foot, scalars[0]))
        parts.append(svg.caption(at[-1], foot, scalars[1], "end"))
    label = f"Transfer function of {_count(len(x))} from {' to '.join(scalars)}"
    return svg.picture(WIDTH, HEIGHT, parts, label)


def _places(x: np.ndarray) -> np.ndarray:
    """Positions in pixels, with a margin that shows how the function goes on outside."""
    margin = 0.04 * WIDTH
    # As parts of the largest, whose difference cannot overflow.
    x = x / (np.abs(x).max() or 1.0)
    if not x[-1] > x[0]:
        return np.full(len(x), WIDTH / 2)
    return margin + (WIDTH - 2 * margin) * (x - x[0]) / (x[-1] - x[0])


def _count(k: Any) -> str:
    return f"{k} control point" + ("" if k == 1 else "s")
