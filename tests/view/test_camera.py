"""Cameras against the formulas of their docstrings, written out pixel by pixel."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvr.view.camera import Camera

pytestmark = pytest.mark.optimised


class Box:
    """Stands in for a volume."""

    def __init__(self, lo, hi, dtype="float64"):
        self.corners = np.asarray(lo, dtype), np.asarray(hi, dtype)

    def bounds(self):
        return self.corners


def unit(v):
    v = np.asarray(v, np.float64)
    return v / math.sqrt(sum(float(x) ** 2 for x in v))


def rays_by_hand(eye, target, up, width, height, fov=0.0, extent=0.0):
    eye, target = np.asarray(eye, np.float64), np.asarray(target, np.float64)
    forward = unit(target - eye)
    right = unit(np.cross(forward, np.asarray(up, np.float64)))
    true_up = np.cross(right, forward)
    half = extent / 2 if extent else math.tan(math.radians(fov) / 2)
    origins, directions = np.empty((height, width, 3)), np.empty((height, width, 3))
    for i in range(height):
        for j in range(width):
            x = ((2 * j + 1) / width - 1) * half * width / height
            y = (1 - (2 * i + 1) / height) * half
            offset = x * right + y * true_up
            origins[i, j] = eye + offset if extent else eye
            directions[i, j] = forward if extent else unit(forward + offset)
    return origins, directions


VIEW = dict(eye=(1.0, 2.0, 5.0), target=(-0.5, 0.25, 0.75), up=(0.1, 1.0, -0.3))


@pytest.mark.parametrize("size", [(4, 3), (3, 5), (1, 1), (1, 2)])
@pytest.mark.parametrize("kind", [dict(fov=37.0), dict(extent=2.5)])
def test_rays_follow_the_formula(kind, size, dtype):
    make = Camera.look_at if "fov" in kind else Camera.orthographic
    camera = make(**VIEW, **kind, width=size[0], height=size[1], dtype=dtype)
    want = rays_by_hand(**VIEW, **kind, width=size[0], height=size[1])
    tolerance = 1e-14 if dtype == "float64" else 1e-6
    for got, expected in zip(camera.rays(), want, strict=True):
        assert got.dtype == dtype and got.shape == (size[1], size[0], 3)
        np.testing.assert_allclose(got, expected, rtol=0, atol=tolerance * 6)
    np.testing.assert_allclose(jnp.linalg.norm(camera.rays()[1], axis=-1), 1, rtol=tolerance * 10)


def test_row_zero_is_on_top_and_column_zero_on_the_left():
    camera = Camera.look_at((0.0, 0.0, 3.0), (0.0, 0.0, 0.0), width=4, height=4)
    directions = camera.rays()[1]
    assert directions[0, 0, 1] > 0 > directions[-1, 0, 1]
    assert directions[0, 0, 0] < 0 < directions[0, -1, 0]


def test_dtype_follows_the_arrays():
    narrow = np.zeros(3, np.float32)
    assert Camera.look_at(narrow, (0, 0, 1)).dtype == np.float32
    assert Camera.look_at((0, 0, 0), (0, 0, 1)).dtype == np.float64  # x64 is on in the tests
    assert Camera.look_at(narrow, np.ones(3), up=(0, 1, 0)).dtype == np.float64
    assert Camera.look_at((0, 0, 0), (0, 0, 1), dtype="float32").rays()[0].dtype == np.float32
    assert Camera.orbit(Box((0, 0, 0), (1, 1, 1), "float32")).dtype == np.float32


@pytest.mark.parametrize("azimuth, elevation, zoom", [(0, 0, 1), (30, 20, 1), (200, -65, 2.5)])
def test_orbit_follows_the_formula(azimuth, elevation, zoom, dtype):
    lo, hi = np.array([-1.0, 0.5, 2.0]), np.array([3.0, 1.5, 2.5])
    camera = Camera.orbit(Box(lo, hi, dtype), azimuth, elevation, 40.0, zoom, width=8, height=6)
    az, el = math.radians(azimuth), math.radians(elevation)
    outward = [math.cos(el) * math.sin(az), math.sin(el), math.cos(el) * math.cos(az)]
    distance = np.linalg.norm(hi - lo) / 2 / math.sin(math.radians(20.0)) / zoom
    eye = (lo + hi) / 2 + distance * np.array(outward)
    assert camera.dtype == dtype
    np.testing.assert_allclose(camera.target, (lo + hi) / 2)
    np.testing.assert_allclose(camera.eye, eye, rtol=1e-13 if dtype == "float64" else 2e-6)
    np.testing.assert_array_equal(camera.up, [0, 1, 0])
    assert (camera.width, camera.height) == (8, 6) and camera.fov == 40


def test_orbit_at_zoom_one_sees_the_whole_bounding_ball():
    camera = Camera.orbit(Box((0, 0, 0), (1, 2, 3)), fov=50.0)
    distance = float(jnp.linalg.norm(camera.eye - camera.target))
    radius = math.sqrt(14) / 2
    assert math.degrees(2 * math.asin(radius / distance)) == pytest.approx(50.0)


def test_sphere_spreads_views_evenly():
    cameras = Camera.sphere(Box((-1, -1, -1), (1, 1, 1)), 64, width=2, height=2)
    outward = np.array([c.eye - c.target for c in cameras])
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    assert len(cameras) == 64 and np.linalg.norm(outward.mean(axis=0)) < 0.02
    cosines = outward @ outward.T - 2 * np.eye(64)
    nearest = np.arccos(cosines.max(axis=1))
    assert nearest.min() > 0.8 * math.sqrt(4 * math.pi / 64)  # 1.0 to 1.07 times is the densest
    np.testing.assert_allclose(outward[:, 1], 1 - (2 * np.arange(64) + 1) / 64, atol=1e-12)
    assert len(Camera.sphere(Box((0, 0, 0), (1, 1, 1)), 1)) == 1


@pytest.mark.parametrize("kind", ["fov", "extent"])
def test_gradients_against_finite_differences(kind):
    make = Camera.look_at if kind == "fov" else Camera.orthographic
    camera = make(**VIEW, **{kind: 2.0}, width=5, height=4)
    weights = np.random.default_rng(0).normal(size=(2, 4, 5, 3))

    def loss(camera):
        origins, directions = camera.rays()
        return jnp.sum(weights[0] * origins) + jnp.sum(weights[1] * directions)

    gradient = jax.grad(loss)(camera)
    for name in ("eye", "target", "up", kind):
        value, got = np.asarray(getattr(camera, name)), np.asarray(getattr(gradient, name))
        assert np.isfinite(got).all()
        for index in np.ndindex(value.shape):
            step = np.zeros_like(value)
            step[index] = 1e-5
            ends = [loss(camera.replace(**{name: value + s * step})) for s in (1, -1)]
            want = (ends[0] - ends[1]) / 2e-5
            assert got[index] == pytest.approx(float(want), rel=1e-7, abs=1e-7)


def test_works_under_jit_and_vmap():
    def corner(eye, fov):
        return Camera.look_at(eye, (0, 0, 0), fov=fov, width=3, height=2).rays()[1][0, 0]

    eyes = jnp.array([[0.0, 0.0, 3.0], [1.0, 0.5, 3.0]])
    got = jax.jit(jax.vmap(corner, in_axes=(0, None)))(eyes, 30.0)
    want = jnp.stack([corner(eye, 30.0) for eye in eyes])
    np.testing.assert_allclose(got, want, rtol=1e-14)


def test_rays_compile_once(monkeypatch):
    Camera.look_at((0, 0, 1), (0, 0, 0), width=7, height=9).rays()

    def traced_again(self):
        raise AssertionError("rays() was traced a second time")

    monkeypatch.setattr(Camera, "basis", traced_again)
    Camera.look_at((1, 2, 3), (0, 0, 0), fov=20.0, width=7, height=9).rays()
    with pytest.raises(AssertionError, match="second time"):
        Camera.look_at((1, 2, 3), (0, 0, 0), width=9, height=7).rays()


def test_replace_checks_and_switches_kind():
    camera = Camera.look_at((0, 0, 3), (0, 0, 0), dtype="float32")
    flat = camera.replace(extent=2.0, width=8)
    assert flat.fov is None and flat.extent == 2 and flat.width == 8 and flat.dtype == np.float32
    assert flat.replace(fov=20.0).extent is None
    with pytest.raises(ValueError, match="same point"):
        camera.replace(eye=(0, 0, 0))
    with pytest.raises(ValueError, match="has no \\['zoom'\\]"):
        camera.replace(zoom=2)
    with pytest.raises(ValueError, match="not both"):
        camera.replace(fov=20.0, extent=1.0)


@pytest.mark.parametrize(
    "change, message",
    [
        (dict(eye=(0, 0, np.nan)), "eye has 1 NaN or infinite entries, the first at index 2"),
        (dict(target=(np.inf, 0, 0)), "target has 1 NaN"),
        (dict(eye=(0, 0, 0)), "same point"),
        (dict(up=(0, 0, -2)), "parallel"),
        (dict(up=(0, 0, 0)), "zero vector"),
        (dict(up=(0, 1)), r"up must have shape \(3,\)"),
        (dict(eye="here"), "eye must hold numbers"),
        (dict(eye=[[0, 0], [0]]), "eye"),
        (dict(fov=0), "fov must lie between 0 and 180 degrees, but is 0"),
        (dict(fov=180), "fov"),
        (dict(fov=np.nan), "fov"),
        (dict(fov=None), "needs a fov"),
        (dict(fov=(30.0, 40.0)), "fov"),
        (dict(width=0), "width must be at least 1"),
        (dict(height=2.5), "height must be a whole number"),
        (dict(height=True), "height must be a whole number"),
        (dict(width="many"), "width must be a whole number"),
    ],
)
def test_bad_cameras_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        Camera.look_at(**(dict(eye=(0, 0, 3), target=(0, 0, 0)) | change))


def test_bad_orbits_are_refused():
    box = Box((0, 0, 0), (1, 1, 1))
    for zoom, elevation, fov, azimuth in (
        (0, 20, 30, 30),
        (1, 90, 30, 30),
        (1, 20, -1, 30),
        (1, 20, 30, np.nan),
    ):
        for dtype in ("float32", "float64"):
            with pytest.raises(ValueError):
                Camera.orbit(box, azimuth, elevation, fov, zoom, dtype=dtype)
    with pytest.raises(ValueError, match="same point"):
        Camera.orbit(Box((1, 1, 1), (1, 1, 1)))
    with pytest.raises(ValueError, match="extent must lie"):
        Camera.orthographic((0, 0, 3), (0, 0, 0), extent=-1.0)
    with pytest.raises(ValueError, match="n must be at least 1"):
        Camera.sphere(box, 0)
