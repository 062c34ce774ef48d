"""No ray is lost: chords add up to what geometry says, wherever a ray meets the mesh's features.

With a constant extinction the length recovered from alpha is the length inside the mesh. All rays
of the session have one shape per dtype, so that there are two compilations.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

import jaxvr
from jaxvr.volume import datasets

pytestmark = [pytest.mark.optimised, pytest.mark.usefixtures("loops")]

N = 4
RAYS = 512
TOLERANCE = {"float64": 1e-13, "float32": 2e-6}


@pytest.fixture(scope="module", params=["float64", "float32"])
def box(request):
    """A regular lattice with corners that are exact in binary, and its dtype."""
    return datasets.box((N, N, N), dtype=request.param), request.param


def _lengths(mesh, origins, directions):
    """Recovered lengths of any number of rays up to RAYS; every status must be clear."""
    dtype = mesh.points.dtype
    count = len(origins)
    assert count <= RAYS
    fill = np.minimum(np.arange(RAYS), count - 1)
    tf = jaxvr.TransferFunction(
        jnp.zeros(1, dtype), jnp.ones((1, 3), dtype), jnp.full(1, 0.5, dtype)
    )
    origins, directions = (np.asarray(x)[fill].astype(dtype) for x in (origins, directions))
    rgba = np.asarray(jaxvr.render_rays(mesh, origins, directions, tf), np.float64)[:count]
    np.testing.assert_allclose(rgba[:, 0], rgba[:, 3], rtol=0, atol=4e-7)
    return -np.log1p(-rgba[:, 3]) / 0.5


def _in_unit_cube(origins, directions):
    """Length of rays (R, 3) in the unit cube, by slabs."""
    origins, directions = np.asarray(origins, float), np.asarray(directions, float)
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = -origins / directions, (1 - origins) / directions
    parallel = directions == 0
    within = (origins >= 0) & (origins <= 1)
    enter = np.where(parallel, np.where(within, -np.inf, np.inf), np.minimum(a, b)).max(1)
    leave = np.where(parallel, np.where(within, np.inf, -np.inf), np.maximum(a, b)).min(1)
    return np.maximum(leave - np.maximum(enter, 0), 0)


def _check(box, origins, directions):
    mesh, dtype = box
    origins, directions = (np.asarray(x).astype(dtype) for x in (origins, directions))
    found = _lengths(mesh, origins, directions)
    np.testing.assert_allclose(
        found, _in_unit_cube(origins, directions), rtol=0, atol=TOLERANCE[dtype]
    )


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [-1, 1])
def test_along_an_axis_through_vertices_edges_and_faces(box, axis, sign):
    # quarters of a block: lattice lines, face diagonals and plain points; not the cube's surface
    g = np.arange(1, 4 * N, 2) / (4 * N) if axis == 1 else np.arange(1, 2 * N) / (2 * N)
    u, v = np.meshgrid(g, g)
    origins = np.zeros((u.size, 3))
    origins[:, (axis + 1) % 3], origins[:, (axis + 2) % 3] = u.ravel(), v.ravel()
    origins[:, axis] = -1.0 if sign > 0 else 2.0
    directions = np.tile(sign * np.eye(3)[axis], (u.size, 1))
    _check(box, origins, directions)


def test_diagonals_through_vertices(box):
    """Exactly along face and space diagonals of the blocks, through vertices and along edges."""
    steps = [s for s in np.ndindex(3, 3, 3) if s != (1, 1, 1)]
    directions, origins = [], []
    for step in np.array(steps) - 1.0:
        for vertex in np.array([(1, 2, 1), (2, 2, 2), (3, 1, 2), (2, 1, 3), (1, 1, 1)]) / N:
            directions.append(step)
            origins.append(vertex - 2 * step)
    _check(box, origins, directions)


def test_from_vertices_to_vertices(box):
    """Origins on vertices, inside and on the surface, aimed at other vertices."""
    mesh, _ = box
    points = np.asarray(mesh.points, float)
    rng = np.random.default_rng(0)
    inner = points[((points > 0) & (points < 1)).all(1)]
    start = points[rng.integers(0, len(points), RAYS)]
    target = inner[rng.integers(0, len(inner), RAYS)]
    apart = (start != target).any(1)
    _check(box, start[apart], (target - start)[apart])


def test_from_inside_anywhere(box):
    mesh, _ = box
    rng = np.random.default_rng(1)
    corners = np.asarray(mesh.points, float)[np.asarray(mesh.cells)]
    weight = rng.dirichlet(np.ones(4), RAYS)
    # a third of the origins in faces, a third on edges
    weight[: RAYS // 3, 0] = 0
    weight[RAYS // 3 : 2 * RAYS // 3, :2] = 0
    weight /= weight.sum(1, keepdims=True)
    cell = corners[rng.integers(0, len(corners), RAYS)]
    _check(box, (weight[..., None] * cell).sum(1), rng.normal(size=(RAYS, 3)))


def test_aimed_at_features_from_outside(box):
    """Towards vertices, midpoints of edges and centres of faces, from eyes at many distances."""
    mesh, _ = box
    rng = np.random.default_rng(2)
    corners = np.asarray(mesh.points, float)[np.asarray(mesh.cells)]
    cell = corners[rng.integers(0, len(corners), RAYS)]
    used = 1 + np.arange(RAYS) % 3
    weight = (np.arange(4)[None] < used[:, None]) / used[:, None]
    target = (cell * weight[..., None]).sum(1)
    target = np.clip(target, 1 / 64, 63 / 64)
    away = rng.normal(size=(RAYS, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    origins = target + away * rng.uniform(1.8, 5.0, RAYS)[:, None]
    _check(box, origins, target - origins)


def test_rays_that_miss_see_nothing(box):
    origins = [(2.0, 0.5, 0.5), (0.5, 0.5, -0.5), (0.5, 3.0, 0.5), (-1.0, -1.0, -1.0)]
    directions = [(1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (1.0, 0.1, 0.0), (1.0, 1.0, -1.0)]
    mesh, _ = box
    np.testing.assert_array_equal(_lengths(mesh, origins, directions), 0)


def test_hole_and_second_piece_are_entered_again(dtype):
    """Two cubes with a gap: a ray leaves one and enters the other."""
    hexahedron = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1)]
    one = np.array([*hexahedron, (0, 1, 1)], dtype)
    points = np.concatenate([one, one + np.asarray([2, 0, 0], dtype)])
    cells = {"hexahedron": np.arange(16).reshape(2, 8)}
    mesh = jaxvr.TetMesh.from_cells(points, cells, points[:, 0], location="point", dtype=dtype)
    y = np.linspace(0.03, 0.97, 31)
    origins = np.stack([np.full(31, -1.0), y, y[::-1] * 0.5], 1)
    found = _lengths(mesh, origins, np.tile([1.0, 0, 0], (31, 1)))
    np.testing.assert_allclose(found, 2.0, atol=TOLERANCE[dtype])
    # from the gap only the second is seen
    origins[:, 0] = 1.5
    found = _lengths(mesh, origins, np.tile([1.0, 0, 0], (31, 1)))
    np.testing.assert_allclose(found, 1.0, atol=TOLERANCE[dtype])
