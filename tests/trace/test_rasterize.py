"""Fragments of triangles: each crossing once, whatever edges and vertices pixel centres lie on."""

from __future__ import annotations

import numpy as np
import pytest
from jax.test_util import check_grads

import jaxvr
from jaxvr.volume import datasets

FACES = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])


# All inputs have the same shapes, so that one compiled function serves: those of a box's surface.
POINTS, TRIANGLES = 125, 192
PIXELS = {"width": 12, "height": 12}


def sheet(lift: float = 0.0):
    """Points and triangles of a sheet of 12 x 8 squares of side 1 at z = 0, and spare points."""
    x, y = np.meshgrid(np.arange(13.0), np.arange(9.0), indexing="ij")
    z = lift * np.random.default_rng(0).normal(size=x.shape)
    first = (np.arange(12)[:, None] * 9 + np.arange(8)).ravel()
    lower = np.stack([first, first + 9, first + 10], 1)
    upper = np.stack([first, first + 10, first + 1], 1)
    points = np.stack([x, y, z], -1).reshape(-1, 3)
    spare = np.zeros((POINTS - len(points), 3))
    return np.concatenate([points, spare]), np.concatenate([lower, upper])


def test_shared_edges_and_vertices_are_drawn_once(dtype):
    points, triangles = sheet()
    points = points.astype(dtype)
    # Half of the pixel centres lie on diagonals, every second of them on a vertex.
    camera = jaxvr.Camera.orthographic((4, 4, 5), (4, 4, 0), extent=6.0, dtype=dtype, **PIXELS)
    found = jaxvr.rasterize(points, triangles, camera, points[:, 0])
    assert np.array_equal(np.asarray(found.pixel), np.arange(144))
    assert found.depth.dtype == np.dtype(dtype) and np.all(np.asarray(found.depth) == 5)
    across = 4 + (np.arange(12) - 5.5) / 2
    assert np.allclose(np.asarray(found.scalar).reshape(12, 12), across)
    assert np.allclose(found.locate(points, points[:, 0], camera)[1], found.scalar)


def test_perspective_is_correct():
    """A sheet seen at a slant: depth and scalar are those of the plane."""
    points, triangles = sheet()
    camera = jaxvr.Camera.look_at(
        (6.3, -5, 3), (6, 3, 0), up=(0, 0, 1), fov=40, dtype="float64", **PIXELS
    )
    found = jaxvr.rasterize(points, triangles, camera, points @ [1.0, 2.0, 0.0])
    origins, directions = (np.asarray(x).reshape(-1, 3) for x in camera.rays())
    depth = -origins[:, 2] / directions[:, 2]
    at = origins + depth[:, None] * directions
    inside = (depth > 0) & (at[:, :2] > 0).all(1) & (at[:, :2] < [12, 8]).all(1)
    assert 50 < inside.sum() < len(inside)
    pixel = np.asarray(found.pixel)
    assert np.array_equal(pixel, np.flatnonzero(inside))
    assert np.allclose(found.depth, depth[pixel], rtol=1e-13)
    assert np.allclose(found.scalar, at[pixel] @ [1.0, 2.0, 0.0], rtol=1e-12)


def test_closed_surfaces_are_crossed_in_pairs():
    """Along the axes of a lattice, where rays run in faces and edges and through vertices."""
    mesh = datasets.box((4, 4, 4), dtype="float64")
    words = np.asarray(mesh.boundary)
    triangles = np.asarray(mesh.cells)[(words >> 4)[:, None], FACES[words & 3]]
    camera = jaxvr.Camera.orthographic(
        (0.5, 0.5, 3), (0.5, 0.5, 0), extent=1.5, dtype="float64", **PIXELS
    )
    found = jaxvr.rasterize(mesh.points, triangles, camera)
    count = np.bincount(np.asarray(found.pixel), minlength=144)
    assert set(count) == {0, 2} and (count == 2).sum() == 64


def test_depth_and_scalar_have_derivatives():
    points, triangles = sheet(lift=0.2)
    values = np.random.default_rng(1).normal(size=len(points))
    camera = jaxvr.Camera.look_at((5.4, 3.6, 4), (5.5, 3.5, 0), fov=40, dtype="float64", **PIXELS)
    found = jaxvr.rasterize(points, triangles, camera, values)
    assert len(found.face) >= 144
    check_grads(found.locate, (points, values, camera), order=1, eps=1e-6)
    other = jaxvr.Camera.look_at((5.4, 3.6, 4), (5.5, 3.5, 0), width=12, height=13)
    with pytest.raises(ValueError, match="an image of 12 x 12 pixels, but the camera's has 13 x"):
        found.locate(points, values, other)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"triangles": np.array([[0, 1, 999]])}, "refer to points 0 to 999, but there are 125"),
        ({"triangles": np.array([[0, 1, 1]])}, "1 triangle.* have a point twice, the first is 0"),
        ({"triangles": np.zeros((0, 3), int)}, "There are no triangles"),
        ({"triangles": np.zeros((2, 3))}, "must be integers with shape"),
        ({"points": np.full((125, 3), np.nan)}, "points has 375 NaN or infinite"),
        ({"camera": None}, "must be a jaxvr.Camera"),
    ],
)
def test_bad_input(change, message):
    points, triangles = sheet()
    given = {
        "points": points,
        "triangles": triangles,
        "camera": jaxvr.Camera.look_at((0, 0, 5), (0, 0, 0)),
    }
    with pytest.raises(ValueError, match=message):
        jaxvr.rasterize(**(given | change))
