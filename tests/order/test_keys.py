"""Keys by centroid and by first vertex: against numpy, and along rays."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxvr.order import AbstractOrder, Centroid, Faces, FirstVertex

FORWARD = np.array([2.0, -1.0, 2.0]) / 3
ORDERS = [Centroid(), FirstVertex()]
both = pytest.mark.parametrize("order", ORDERS, ids=lambda order: type(order).__name__)
views = pytest.mark.parametrize("pinhole", [True, False], ids=["pinhole", "parallel"])
dtypes = pytest.mark.parametrize("dtype", ["float32", "float64"])


def faces_of(corners, pinhole, dtype="float64"):
    """Faces of corners (N, 3, xyz)."""
    a, b, c = (jnp.asarray(corners[:, i].T, dtype) for i in range(3))
    slot = jnp.arange(len(corners), dtype="int32")
    return Faces(slot, (a, b, c), jnp.asarray(FORWARD, dtype), jnp.array(pinhole))


def random_corners(n=50):
    return np.random.default_rng(0).normal(size=(n, 3, 3))


def sorted_by(order, corners):
    """The points (N, 3) that the order goes by."""
    return corners.mean(1) if isinstance(order, Centroid) else corners[:, 0]


@dtypes
@views
@both
def test_against_numpy(order, pinhole, dtype):
    corners = random_corners()
    points = sorted_by(order, corners)
    depth = points @ FORWARD
    want = np.linalg.norm(points, axis=1) ** 2 if pinhole else depth
    keys = order.keys(faces_of(corners, pinhole, dtype))
    assert keys.dtype == dtype
    bound = 8 * np.finfo(dtype).eps * (points**2).sum(1).max()
    assert np.abs(np.asarray(keys) - want).max() < bound


@dtypes
@views
@both
def test_grows_along_rays(order, pinhole, dtype):
    """One small face carried along each of some rays, away from where they start."""
    rng = np.random.default_rng(1)
    along = np.linspace(0, 2, 30)
    for _ in range(20):
        shape = 0.01 * rng.normal(size=(3, 3))
        shape -= sorted_by(order, shape[None])
        if pinhole:  # all rays that are less than 60 degrees off
            side = np.cross(FORWARD, rng.normal(size=3))
            direction = FORWARD + np.tan(np.deg2rad(rng.uniform(0, 60))) * side / np.linalg.norm(
                side
            )
            start = np.zeros(3)
        else:
            direction, start = FORWARD, np.cross(FORWARD, rng.normal(size=3))
        places = start + along[:, None] * direction
        keys = np.asarray(order.keys(faces_of(places[:, None] + shape, pinhole, dtype)))
        assert (np.diff(keys) > 0).all()


def test_the_first_vertex_alone_decides():
    corners = random_corners()
    moved = corners.copy()
    moved[:, 1:] += 1.0
    faces, others = faces_of(corners, True), faces_of(moved, True)
    assert np.array_equal(FirstVertex().keys(faces), FirstVertex().keys(others))
    assert not np.array_equal(Centroid().keys(faces), Centroid().keys(others))


@both
def test_equal_orders_are_one_static_argument(order):
    assert isinstance(order, AbstractOrder)
    assert order == type(order)() and hash(order) == hash(type(order)())
    assert ORDERS[0] != ORDERS[1]
