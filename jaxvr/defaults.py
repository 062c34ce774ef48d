"""A transfer function to start from, for people who have a file and want a picture."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxvr._core.units import norm
from jaxvr.arguments import volume_of
from jaxvr.optics import TransferFunction
from jaxvr.volume import TetMesh

# Optical depth along the diagonal of the volume's box where the extinction is largest: the cells of
# the highest values hide each other, and those of the lowest can be looked through.
DEPTH = 15.0


def diagonal(volume: TetMesh) -> float:
    """Length of the diagonal of the volume's box, in world units."""
    lo, hi = (np.asarray(x, np.float64) for x in volume.bounds())
    return norm(hi - lo)


def default_transfer(
    volume: TetMesh, colormap: Any = "viridis", *, depth: float = DEPTH, points: int = 33
) -> TransferFunction:
    """A colour map over the field's range, with extinction that rises from 0.

    Args:
      volume: whose range of values and size in space are taken.
      colormap: as `TransferFunction.from_colormap` takes it, such as the name of matplotlib's.
      depth: optical depth along the diagonal of the volume's box where the field is highest.
      points: control points.

    Returns:
      a transfer function in the volume's dtype. Of a constant field: one point.

    Raises:
      ValueError: for what is no `TetMesh`, and for a depth below 0.
    """
    if not 0 <= depth < np.inf:
        raise ValueError(f"depth must be an optical depth of 0 or more, but is {depth!r}.")
    volume = volume_of(volume)
    low, high = (float(x) for x in (volume.values.min(), volume.values.max()))
    positions = np.linspace(low, high, points) if high > low else np.array([low])
    ramp = np.linspace(0, 1, len(positions)) if high > low else np.ones(1)
    extinctions = (depth / diagonal(volume) * ramp).astype(volume.dtype)
    return TransferFunction.from_colormap(colormap, positions, extinctions, dtype=volume.dtype)
