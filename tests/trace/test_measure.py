"""Needed entries against all faces, all rays and all pairs of fragments in NumPy."""

from __future__ import annotations

import numpy as np
import pytest

import jaxvr
from jaxvr.order import entries_needed, moved
from jaxvr.volume import datasets

pytestmark = pytest.mark.usefixtures("quick_code")

FACES = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])


def fragments(mesh, camera):
    """Depths (pixels, F) of all faces, infinite where a ray misses one, and keys (F,)."""
    cells, words = np.asarray(mesh.cells), np.asarray(mesh.neighbors)
    own = (words < 0) | ((words >> 4) > np.arange(len(cells))[:, None])
    cell, corner = np.nonzero(own)
    p = np.asarray(mesh.points, np.float64)[cells[cell[:, None], FACES[corner]]]
    origins, directions = (np.asarray(x, np.float64).reshape(-1, 1, 3) for x in camera.rays())
    a, u, v = p[:, 0], p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    normal = np.cross(u, v)
    along = (directions * normal).sum(-1)
    depth = ((a - origins) * normal).sum(-1) / along
    at = origins + depth[..., None] * directions - a
    square = (normal * normal).sum(-1)
    by_u = (np.cross(at, v) * normal).sum(-1) / square
    by_v = (np.cross(u, at) * normal).sum(-1) / square
    met = (by_u >= 0) & (by_v >= 0) & (by_u + by_v <= 1)
    key = ((p.mean(1) - np.asarray(camera.eye)) ** 2).sum(-1)
    return np.where(met, depth, np.inf), key


@pytest.mark.parametrize("direction", ["front to back", "back to front"])
@pytest.mark.parametrize("mesh", ["box", "squeezed"])
def test_entries_as_counted_by_hand(mesh, direction):
    volume = datasets.box((3, 3, 3), jitter=0.3, seed=3, dtype="float64", shuffle=True)
    if mesh == "squeezed":  # long cells: far out of order
        volume = volume.replace(points=np.asarray(volume.points) * [1, 1, 0.02])
    camera = jaxvr.Camera.orbit(volume, 25, 15, width=9, height=7, dtype="float64")
    depths, keys = fragments(volume, camera)
    stream = depths[:, np.argsort(keys)]
    if direction == "back to front":
        stream = np.where(np.isinf(stream), np.inf, -stream)[:, ::-1]
    found = jaxvr.measure_k(volume, camera, direction=direction)  # type: ignore[arg-type]
    shape = (camera.height, camera.width)
    assert np.array_equal(found.fragments, np.isfinite(stream).sum(1).reshape(shape))
    assert np.array_equal(found.moved, np.max(moved(stream), axis=1).reshape(shape))
    assert np.array_equal(found.entries, np.asarray(entries_needed(stream)).reshape(shape))
    assert found.k == found.entries.max() and found.count_above(2) == (found.entries > 2).sum()
    assert mesh == "box" or found.k > 8  # more than are remembered at first


def test_not_a_mesh():
    with pytest.raises(ValueError, match="takes a TetMesh and a Camera"):
        jaxvr.measure_k(datasets.box((1, 1, 1)), "camera")  # type: ignore[arg-type]
    camera = jaxvr.Camera.orbit(datasets.box((1, 1, 1)), width=2, height=2)
    with pytest.raises(ValueError, match="direction must be"):
        jaxvr.measure_k(datasets.box((1, 1, 1)), camera, direction="up")  # type: ignore[arg-type]
