"""Cells without volume, and cells that rounding or moved points turned over: no crack, no chord
twice, and derivatives that telescope as chords do."""

from __future__ import annotations

import warnings

import flat_meshes as flat
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvr
from jaxvr.volume import TetMesh, packing
from jaxvr.volume.connectivity import FACES

pytestmark = pytest.mark.usefixtures("loops")

RAYS = 1024
TOLERANCE = {"float64": 1e-10, "float32": 2e-5}
# By JAX's loops, which take long to compile, only some.
NAMES = {"compiled": tuple(flat.MESHES), "jax": ("lattice",)}


def build(mesh: flat.FlatMesh, dtype: str = "float64", field=None) -> TetMesh:
    values = mesh.points[:, 0] if field is None else field(mesh.points)
    cells = {"tetra": mesh.cells}
    with pytest.warns(UserWarning):  # Qhull's cells lie either way round
        return TetMesh.from_cells(mesh.points, cells, values, location="point", dtype=dtype)


def check_lengths(mesh: TetMesh, shape: flat.FlatMesh, dtype: str, seed: int = 0) -> None:
    """Sums of chords by features of a mesh against the chord of the hull, which it fills."""
    tf = jaxvr.TransferFunction(
        jnp.zeros(1, dtype), jnp.ones((1, 3), dtype), jnp.full(1, 0.5, dtype)
    )
    planes = flat.hull_planes(np.asarray(shape.points, dtype).astype(np.float64))
    for aim in (flat.rays_at_features, flat.rays_along_features):
        origins, directions = (x.astype(dtype) for x in aim(shape, RAYS, seed=seed))
        rgba = np.asarray(jaxvr.render_rays(mesh, origins, directions, tf), np.float64)
        found = -np.log1p(-rgba[:, 3]) / 0.5
        want = flat.hull_chords(planes, origins, directions)
        np.testing.assert_allclose(found, want, rtol=0, atol=TOLERANCE[dtype])


@pytest.mark.optimised
def test_chords_add_up_to_the_hull(dtype, loops):
    for name in NAMES[loops]:
        shape = flat.MESHES[name]()
        mesh = build(shape, dtype)
        # the squashed mesh is lower than float32 tells, not than float64
        assert (mesh.report.flat > 0) == (name != "squashed" or dtype == "float32"), name
        assert mesh.report.folded == mesh.report.one_sided == mesh.report.degenerate == 0
        # all boundary faces are on the hull: no crack inside
        cell, corner = packing.cell_of(mesh.boundary), packing.corner_of(mesh.boundary)
        faces = np.asarray(mesh.cells)[np.asarray(cell)[:, None], FACES[np.asarray(corner)]]
        normals, offsets = flat.hull_planes(shape.points)
        away = np.abs(shape.points[faces] @ normals.T - offsets)
        assert (away.max(1).min(1) < 1e-9).all(), name
        check_lengths(mesh, shape, dtype)
        if name == "lattice":  # and after moves that turn cells over: holes, without flat cells
            check_lengths(mesh.replace(points=flat.moved(shape)), shape, dtype)


TRANSFER = ([0, 0.37, 1.3], [[0, 0, 1.0], [0, 1, 0], [1, 0, 0]], [0.5, 2.0, 4.0])


def field(p):
    return p[:, 0] + 0.3 * p[:, 1] ** 2 - 0.2 * p[:, 2] * p[:, 0]


def test_gradient_by_points_across_overturned_cells():
    """Cells turned over for good: the depth reached is that of an earlier face, and moves with it.
    Points and rays move together."""
    rng = np.random.default_rng(3)
    shape = flat.lattice(4)
    mesh = build(shape, field=field).replace(points=flat.moved(shape))
    tf = jaxvr.TransferFunction(*TRANSFER)
    target, direction = rng.uniform(0.1, 0.9, (16, 3)), rng.normal(size=(16, 3))
    origins = target - 3 * direction
    move, shift = (
        rng.normal(size=mesh.points.shape) * shape.inner[:, None],
        rng.normal(size=(16, 3)),
    )
    weights = rng.normal(size=(16, 4))

    @jax.jit
    def f(h):
        moved = mesh.replace(points=mesh.points + h * move)
        rgba = jaxvr.render_rays(moved, origins + 0.1 * h * shift, direction, tf)
        return (rgba * weights).sum()

    found = float(jax.grad(f)(0.0))
    for h in (1e-5, -1e-5):
        assert found == pytest.approx(flat.one_sided(f, h), rel=1e-6)


def test_gradient_by_points_at_a_flat_cell_is_that_of_the_side_with_volume():
    """One flat cell between two pairs: moving one of its corners up or down is a kink, since the
    scalar jumps across the flat cell, and the derivative is that of the side where it has volume.
    """
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.4, 0.5, 1], [0.6, 0.5, -1.0]])
    tets = np.array([[0, 1, 2, 4], [0, 2, 3, 4], [0, 3, 1, 5], [1, 3, 2, 5], [0, 1, 2, 3]])
    values = np.array([0.1, 0.9, 0.3, 1.2, 0.5, 0.7])

    def meshed(z):
        moved = points + np.eye(6)[0][:, None] * [0, 0, z]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return TetMesh.from_cells(moved, {"tetra": tets}, values, location="point")

    mesh = meshed(0.0)
    assert mesh.report.flat == 1 and mesh.n_boundary == 8
    proper = 1.0 if meshed(1e-3).report.folded == 0 else -1.0
    assert meshed(-proper * 1e-3).report.folded == 1
    rng = np.random.default_rng(0)
    target = np.column_stack([rng.uniform(0.1, 0.9, (16, 2)), np.zeros(16)])
    direction = rng.normal(size=(16, 3)) * [0.3, 0.3, 1]
    tf = jaxvr.TransferFunction(*TRANSFER)

    @jax.jit
    def f(z):
        moved = mesh.replace(points=mesh.points.at[0, 2].add(z))
        return jaxvr.render_rays(moved, target - 2 * direction, direction, tf)[:, :3].sum()

    found = float(jax.grad(f)(0.0))
    assert found == pytest.approx(flat.one_sided(f, proper * 1e-5), rel=1e-6)
    assert found != pytest.approx(flat.one_sided(f, -proper * 1e-5), rel=1e-3)
