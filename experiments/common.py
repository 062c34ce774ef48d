"""What experiments share: transfer functions with features, and folders for results."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

import jaxvr

# Centre, width and height of shells of density, as parts of the range and of the highest.
PEAKS = (
    (0.10, 0.05, 0.10),
    (0.30, 0.04, 0.25),
    (0.52, 0.05, 0.45),
    (0.72, 0.04, 0.7),
    (0.92, 0.06, 1.0),
)


def diagonal(volume: Any) -> float:
    """Of the bounding box, in world units."""
    lo, hi = (np.asarray(x, np.float64) for x in volume.bounds())
    return float(np.linalg.norm(hi - lo))


def shells(
    volume: Any,
    points: int,
    colormap: Any = "turbo",
    depth: float = 40.0,
    floor: float = 0.01,
    peaks: Any = PEAKS,
) -> jaxvr.TransferFunction:
    """A transfer function of five translucent shells over the range of a volume's values.

    points: control points, evenly spaced. depth: optical depth along the diagonal of the box at the
    highest peak. floor: extinction between the peaks, as part of the highest. peaks: centre, width
    and height of each, as parts of the range and of the highest.
    """
    values = np.asarray(volume.values, np.float64)
    t = np.linspace(0, 1, points)
    density = floor + sum(h * np.exp(-(((t - c) / w) ** 2)) for c, w, h in peaks)
    positions = values.min() + (values.max() - values.min()) * t
    dtype = volume.points.dtype
    extinctions = np.asarray(depth / diagonal(volume) * density, dtype)
    return jaxvr.TransferFunction.from_colormap(colormap, positions, extinctions, dtype=dtype)


def write_json(path: Any, data: Any) -> Path:
    file = Path(path)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(data, indent=2) + "\n")
    return file
