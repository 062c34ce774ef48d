"""The walk: paths, re-entry, origins inside, seams, and fields that jump between cells."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvr
from jaxvr.trace.entry import PEEL
from jaxvr.trace.scene import make_scene, merged_points
from jaxvr.volume import datasets

pytestmark = pytest.mark.usefixtures("quick_code")

TETS = np.array([[0, 1, 2, 3]])
CORNER = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])


def glass(mesh, extinction=1.0):
    """A transfer function of one colour and constant extinction."""
    return jaxvr.TransferFunction([0.0], np.ones((1, 3)), [extinction], dtype=mesh.dtype)


def lengths(mesh, origins, directions, extinction=1.0):
    """World length of each ray inside the mesh, from alpha."""
    rgba = jaxvr.render_rays(mesh, origins, directions, glass(mesh, extinction))
    return -np.log1p(-np.asarray(rgba[..., 3], np.float64)) / extinction


def row_of_boxes(count, gap, dtype):
    """Unit cubes along x with gaps between them: as many components, entries and exits."""
    cube = datasets.box((1, 1, 1), dtype="float64")
    points, cells = np.asarray(cube.points), np.asarray(cube.cells)
    shifts = np.arange(count) * (1 + gap)
    every = np.concatenate([points + [s, 0, 0] for s in shifts])
    tets = np.concatenate([cells + k * len(points) for k in range(count)])
    with np.errstate(all="ignore"):
        return _quiet(every, tets, every[:, 0], dtype)


def _quiet(points, tets, values, dtype):
    """Without the warning about cells that were turned round: rows of `cells` have no sign."""
    a, b, c, d = (points[tets[:, k]] for k in range(4))
    flip = np.einsum("ti,ti->t", np.cross(b - a, c - a), d - a) < 0
    tets = tets.copy()
    tets[flip] = tets[flip][:, [0, 1, 3, 2]]
    return jaxvr.TetMesh.from_cells(points, {"tetra": tets}, values, dtype=dtype)


def test_more_entries_than_one_search_keeps(dtype):
    count = 2 * PEEL + 2
    mesh = row_of_boxes(count, 0.5, dtype)
    origins = np.array([[-1, 0.3, 0.4], [-1, 0.71, 0.2], [0.5, 0.3, 0.4], [40.0, 0.3, 0.4]])
    directions = np.array([[1, 0, 0], [1, 0, 0], [1, 0, 0], [-1, 0, 0.0]])
    tolerance = 1e-5 if dtype == "float32" else 1e-13
    got = lengths(mesh, origins, directions, 0.1)
    assert np.allclose(got, [count, count, count - 0.5, count], rtol=tolerance)


def test_order_of_entries_is_front_to_back():
    mesh = row_of_boxes(PEEL + 3, 0.25, "float64")
    opaque = jaxvr.TransferFunction([0.0, 9.0], [[1, 0, 0], [0, 0, 1.0]], [30.0, 30.0])
    ends = np.array([[-3.0, 0.3, 0.4], [30.0, 0.3, 0.4]])
    rgba = jaxvr.render_rays(mesh, ends, np.array([[1.0, 0, 0], [-1, 0, 0]]), opaque)
    assert rgba[0, 0] > 0.98 and rgba[1, 2] > 0.8 and rgba[1, 0] < 0.2


def test_touching_boxes_without_common_faces_add_up(dtype):
    """Cut differently on both sides of a common square: a crack of no width."""
    mesh = row_of_boxes(2, 0.0, dtype)
    assert mesh.n_boundary >= 20
    rng = np.random.default_rng(0)
    origins = np.concatenate([np.full((64, 1), -2.0), rng.uniform(0.02, 0.98, (64, 2))], 1)
    origins[:5, 1:] = [[0.5, 0.5], [0.25, 0.25], [0.5, 0.25], [0.75, 0.25], [0.3, 0.7]]
    got = lengths(mesh, origins, np.array([1.0, 0, 0]))
    assert np.allclose(got, 2, rtol=1e-6 if dtype == "float32" else 1e-14)


@pytest.mark.parametrize("where", ["inside", "vertex", "edge", "face"])
def test_origins_in_the_mesh(where, dtype):
    mesh = datasets.box((2, 2, 2), dtype=dtype)
    origin = {
        "inside": [0.3, 0.2, 0.6],
        "vertex": [0.5, 0.5, 0.5],
        "edge": [0.5, 0.5, 0.3],
        "face": [0.5, 0.3, 0.2],
    }[where]
    directions = np.array([[0, 0, 1], [1, 0, 0], [-1, 0, 0], [0, -1, 0], [1, 1, 1], [1, 1, 0.0]])
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    far = np.where(unit > 0, 1.0, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(unit == 0, np.inf, (far - origin) / unit).min(1)
    got = lengths(mesh, np.broadcast_to(np.array(origin), unit.shape), unit)
    assert np.allclose(got, t, rtol=2e-6 if dtype == "float32" else 1e-13)


def test_the_part_behind_the_eye_has_no_gradient():
    mesh = jaxvr.TetMesh.from_cells(CORNER, {"tetra": TETS}, np.arange(4.0))
    tf = jaxvr.TransferFunction([0.0, 3.0], np.eye(3)[:2], [0.5, 2.0])
    origin, direction = np.array([0.1, 0.2, 0.15]), np.array([0.2, 0.3, 1.0])

    def loss(values, points, origin):
        rgba = jaxvr.render_rays(mesh.replace(values=values, points=points), origin, direction, tf)
        return jnp.sum(rgba * jnp.array([1.0, 2.0, 3.0, 4.0]))

    args = (mesh.values, mesh.points, jnp.asarray(origin))
    grads = jax.grad(loss, argnums=(0, 1, 2))(*args)
    for i, g in enumerate(grads):
        d = np.random.default_rng(i).normal(size=g.shape)
        h = 1e-5

        def at(s, i=i, d=d):
            return float(loss(*(x + s * h * d if j == i else x for j, x in enumerate(args))))

        slope = (8 * (at(1) - at(-1)) - (at(2) - at(-2))) / (12 * h)
        assert float(jnp.sum(g * d)) == pytest.approx(slope, rel=1e-8, abs=1e-10)


def test_cell_data_is_not_averaged(dtype):
    """Two tets with their own colours: a ray sees one, then the other, and nothing between."""
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1.0]])
    tets = np.array([[0, 1, 2, 3], [1, 2, 3, 4]])
    mesh = jaxvr.TetMesh.from_cells(
        points, {"tetra": tets}, [0.0, 1.0], location="cell", dtype=dtype
    )
    tf = jaxvr.TransferFunction([0.0, 1.0], [[1, 0, 0], [0, 0, 1.0]], [1.0, 3.0], dtype=dtype)
    o, d = np.array([-1, -1, -1.0]) * 0.2, np.ones(3)
    rgba = np.asarray(jaxvr.render_rays(mesh, o, d, tf), np.float64)
    first, second = np.sqrt(3) / 3, 2 * np.sqrt(3) / 3
    red, blue = -np.expm1(-first), np.exp(-first) * -np.expm1(-3 * second)
    assert np.allclose(rgba, [red, 0, blue, red + blue], atol=1e-6 if dtype == "float32" else 1e-13)


def seamed(values, dtype="float64"):
    """Two tets on either side of a face whose points are there twice, with values of their own."""
    points = np.array(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1.0]]
    )
    tets = np.array([[0, 1, 2, 3], [4, 5, 6, 7]])
    return jaxvr.TetMesh.from_cells(points, {"tetra": tets}, values, dtype=dtype)


def test_values_that_differ_across_a_seam_stay_as_they_are():
    mesh = seamed(np.array([0.0] * 4 + [1.0] * 4))
    tf = jaxvr.TransferFunction([0.0, 1.0], [[1, 0, 0], [0, 0, 1.0]], [1.0, 3.0])
    rgba = jaxvr.render_rays(mesh, np.full(3, -0.2), np.ones(3), tf)
    first, second = np.sqrt(3) / 3, 2 * np.sqrt(3) / 3
    red, blue = -np.expm1(-first), np.exp(-first) * -np.expm1(-3 * second)
    assert np.allclose(rgba, [red, 0, blue, red + blue], atol=1e-13)
    segments = jaxvr.trace(mesh, (np.full((1, 3), -0.2), np.ones((1, 3))))
    assert np.allclose(jaxvr.shade(segments, tf), rgba, atol=1e-14)


def test_coinciding_points_move_together():
    mesh = seamed(np.arange(8.0))
    moved = mesh.replace(points=mesh.points.at[4].add(jnp.array([0.0, 0.0, 0.2])))
    merged = merged_points(moved)
    assert np.allclose(merged[1], [1, 0, 0.1]) and np.allclose(merged[4], merged[1])
    assert np.array_equal(merged_points(mesh), mesh.points)

    def loss(points):
        rays = jnp.array([[-0.2, -0.1, -0.2], [-0.3, -0.2, 0.0]])
        return jnp.sum(
            jaxvr.render_rays(mesh.replace(points=points), rays, jnp.ones(3), glass(mesh))
        )

    gradient = jax.grad(loss)(mesh.points)
    assert np.allclose(gradient[1], gradient[4]) and float(jnp.abs(gradient).sum()) > 0


@pytest.mark.parametrize("unit", [1e-9, 1e6])
def test_any_unit_of_length(unit):
    mesh = datasets.box((2, 2, 2), jitter=0.2, seed=3, dtype="float32")
    small = mesh.replace(points=mesh.points * np.float32(unit))
    assert float(make_scene(small).scale) != 1
    rng = np.random.default_rng(1)
    target = rng.uniform(0.1, 0.9, (50, 3))
    origin = np.broadcast_to([2.0, 1.5, 3.0], target.shape)
    want = lengths(mesh, origin, target - origin)
    got = lengths(small, origin * unit, target - origin, 1 / unit) / unit
    assert np.allclose(got, want, rtol=1e-5)


def test_rays_that_miss_see_nothing(dtype):
    mesh = datasets.box((1, 1, 1), dtype=dtype)
    o = np.array([[2.0, 2, 2], [0.5, 0.5, 3], [1.5, 0.5, -1]])
    d = np.array([[1.0, 0, 0], [0, 0, 1], [0, 0, 1.0]])
    assert (np.asarray(jaxvr.render_rays(mesh, o, d, glass(mesh))) == 0).all()


def test_every_cell_on_a_random_ray_is_visited_once():
    """Segments against brute force clipping of all cells."""
    mesh = datasets.box((3, 3, 3), jitter=0.25, seed=2, shuffle=True, dtype="float64")
    rng = np.random.default_rng(4)
    target = rng.uniform(0, 1, (40, 3))
    origin = np.broadcast_to([1.7, -1.2, 2.2], target.shape).copy()
    segments = jaxvr.trace(mesh, (origin, target - origin))
    start, length = np.asarray(segments.start), np.asarray(segments.length)
    corners = np.asarray(mesh.points)[np.asarray(mesh.cells)]
    inverse = np.linalg.inv(np.concatenate([corners, np.ones((*corners.shape[:2], 1))], 2))
    for place, ray in enumerate(np.asarray(segments.order)):
        o, d = origin[ray], target[ray] - origin[ray]
        # Barycentric coordinates along the ray are linear: b(t) = p + t q.
        p = np.append(o, 1) @ inverse
        q = np.append(d, 0) @ inverse
        with np.errstate(divide="ignore", invalid="ignore"):
            t = -p / q
        low = np.where(q > 0, t, -np.inf).max(1)
        high = np.where(q < 0, t, np.inf).min(1)
        chord = np.maximum(high - np.maximum(low, 0), 0) * np.linalg.norm(d)
        want = chord[chord > 1e-12][np.argsort(low[chord > 1e-12])]
        got = length[start[place] : start[place + 1]]
        got = got[got > 1e-12]
        assert got.shape == want.shape and np.allclose(got, want, atol=1e-12)
