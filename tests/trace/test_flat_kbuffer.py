"""Cells without volume, and cells that moves turned over, in a k-buffer: the picture and gradients
of ray casting, or a status. All meshes of `flat_meshes` stand in one, so that few functions are
compiled."""

from __future__ import annotations

import functools
from typing import Any

import flat_meshes as flat
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvr
from jaxvr._core import status as bits
from jaxvr.volume import TetMesh

pytestmark = pytest.mark.usefixtures("quick_code")

ENOUGH = 24
TOLERANCE = {"float64": 1e-11, "float32": 2e-5}
TRANSFER = ([0, 0.37, 1.3], [[0, 0, 1.0], [0, 1, 0], [1, 0, 0]], [0.5, 2.0, 4.0])
SMALL = {
    "lattice": lambda: flat.lattice(3),
    "lattice, jitter 1e-12": lambda: flat.lattice(3, 1e-12),
    "lattice, jitter 1e-7": lambda: flat.lattice(3, 1e-7),
    "cospherical": lambda: flat.cospherical(2, 6),
    "slivers": lambda: flat.slivers(3),
    "prisms": lambda: flat.prisms(4, 2),
}
# None is in front of another along a direction of the lattices.
PLACES = 4.0 * np.array([(0, 0, 0), (1, 2, 0), (2, 0, 1), (0, 1, 2), (-1, -2, 0), (-2, 0, -1)])


@functools.cache
def shapes() -> flat.FlatMesh:
    """All of them in one, side by side."""
    points, cells, inner, count = [], [], [], 0
    for make, place in zip(SMALL.values(), PLACES, strict=True):
        shape = make()
        points.append(shape.points + place)
        cells.append(shape.cells + count)
        inner.append(shape.inner)
        count += len(shape.points)
    return flat.FlatMesh(np.concatenate(points), np.concatenate(cells), np.concatenate(inner))


def field(p):
    x, y, z = p.T
    return 0.5 + 0.5 * np.sin(2.3 * x + 0.4) * np.cos(1.7 * y - 0.9 * z)


@functools.cache
def mesh_of(dtype: str, turned_over: bool, location: str = "point") -> TetMesh:
    shape = shapes()
    with pytest.warns(UserWarning):  # Qhull's cells lie either way round
        mesh = TetMesh.from_cells(
            shape.points, {"tetra": shape.cells}, field(shape.points), dtype=dtype
        )
    assert mesh.report.flat > 50 and mesh.report.folded == mesh.report.degenerate == 0
    if turned_over:
        mesh = mesh.replace(points=flat.moved(shape).astype(dtype))
    if location == "point":
        return mesh
    count = (mesh.n_tets,) if location == "cell" else (mesh.n_tets, 4)
    values = np.random.default_rng(0).uniform(0, 1.3, count).astype(dtype)
    return mesh.replace(values=values, location=location)


@functools.cache
def rays_of(dtype: str):
    """By features of each mesh, and from eyes inside of cells."""
    origins, directions = [], []
    for make, place in zip(SMALL.values(), PLACES, strict=True):
        shape = make()
        o, d = flat.rays_at_features(shape, 40, seed=3)
        o[:5] = shape.points[shape.cells[:5]].mean(1)
        origins.append(o + place)
        directions.append(d)
    return tuple(np.concatenate(x).astype(dtype) for x in (origins, directions))


def transfer_of(dtype: str):
    return jaxvr.TransferFunction(*TRANSFER, dtype=dtype)


def compared(mesh, dtype, direction: Any = "front to back", **how):
    """The largest difference of each ray from ray casting, and its status."""
    (origins, directions), tf = rays_of(dtype), transfer_of(dtype)
    exact = jaxvr.render_rays(mesh, origins, directions, tf)
    found, status = jaxvr.render_rays(
        mesh,
        origins,
        directions,
        tf,
        tracer=jaxvr.KBuffer(**how),
        compositor=jaxvr.Over(direction=direction),
        status=True,
    )
    assert np.asarray(exact)[:, 3].max() > 0.5
    return np.abs(np.asarray(found) - np.asarray(exact)).max(1), np.asarray(status)


CASES = [
    ("float64", "front to back", "point", jaxvr.order.Centroid()),
    ("float64", "back to front", "corner", jaxvr.order.Centroid()),
    ("float32", "front to back", "cell", jaxvr.order.FirstVertex()),
    ("float32", "back to front", "point", jaxvr.order.FirstVertex()),
]


@pytest.mark.parametrize("dtype, direction, location, order", CASES)
def test_same_picture_as_ray_casting(dtype, direction, location, order):
    for turned_over in (False, True):
        mesh = mesh_of(dtype, turned_over, location)
        error, status = compared(mesh, dtype, direction, k=ENOUGH, order=order)
        assert not status.any()
        assert error.max() < TOLERANCE[dtype]


@pytest.mark.parametrize("direction", ["front to back", "back to front"])
def test_what_a_small_k_misses_is_told(direction):
    """Also where what a ray has reached comes too late to be known."""
    for turned_over in (False, True):
        error, status = compared(mesh_of("float64", turned_over), "float64", direction, k=3)
        told = (status & bits.K_TOO_SMALL) != 0
        assert 0 < told.sum() < told.size
        assert error[~told].max() < TOLERANCE["float64"]


@pytest.mark.parametrize("direction", ["front to back", "back to front"])
def test_the_closest_two_are_the_ends_of_a_segment_or_it_is_told(direction):
    """Without volume, cells are passed in the order in which they lie. Where cells are overturned,
    the closest two fragments are of different cells, and no picture is right by the paper's way."""
    error, status = compared(
        mesh_of("float64", False), "float64", direction, k=ENOUGH, pairs="closest"
    )
    told = status != 0
    assert told.mean() < 0.02 and error[~told].max() < TOLERANCE["float64"]
    error, status = compared(
        mesh_of("float64", True), "float64", direction, k=ENOUGH, pairs="closest"
    )
    told = status != 0
    assert (status[told] & bits.TANGLED).all() and 0.1 < told.mean() < 0.9
    assert error[~told].max() < TOLERANCE["float64"]
    with pytest.raises(jaxvr.RenderError, match="fragments that no order by depth puts right"):
        jaxvr.check(status)


@pytest.mark.parametrize("direction", ["front to back", "back to front"])
def test_gradients_across_flat_and_overturned_cells(direction, quick_jit):
    """By points, values and rays: those of ray casting and, where cells are overturned for good, of
    differences to either side. Flat cells are kinks, with the derivative that ray casting takes."""
    rng = np.random.default_rng(3)
    mesh, shape = mesh_of("float64", False), shapes()
    origins, directions = (x[::4] for x in rays_of("float64"))
    shift = rng.normal(size=origins.shape)
    origins = origins + 1e-3 * shift
    move = rng.normal(size=shape.points.shape) * shape.inner[:, None]
    change, weights = rng.normal(size=mesh.values.shape), rng.normal(size=(len(origins), 4))

    def loss(tracer, compositor):
        def f(points, values, origins):
            moved = mesh.replace(points=points, values=values)
            rgba = jaxvr.render_rays(
                *(moved, origins, directions, transfer_of("float64")),
                tracer=tracer,
                compositor=compositor,
            )
            return (rgba * weights).sum()

        return f

    f = loss(jaxvr.KBuffer(k=ENOUGH), jaxvr.Over(direction=direction))
    # Differences take the values that come with the gradients: no other program is compiled.
    both, wanted = (
        jax.jit(jax.value_and_grad(f, (0, 1, 2))),
        jax.jit(jax.grad(loss(jaxvr.RayCast(), jaxvr.Over()), (0, 1, 2))),
    )

    def found(*args):
        return both(*args)[1]

    for points in (mesh.points, jnp.asarray(flat.moved(shape))):
        ours, theirs = (g(points, mesh.values, origins) for g in (found, wanted))
        # On the outside, flat cells stay: of faces in one place, either may be the one that is met.
        for i, (a, b) in enumerate(zip(ours, theirs, strict=True)):
            scale = np.abs(b).max()
            assert scale > 0.1
            a, b = (x[shape.inner] if i == 0 else x for x in (a, b))
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-8 * scale)

    def along(h):
        return both(points + h * move, mesh.values + h * change, origins + 0.1 * h * shift)[0]

    slope = sum((g * x).sum() for g, x in zip(ours, (move, change, 0.1 * shift), strict=True))
    for h in (1e-6, -1e-6):
        assert float(slope) == pytest.approx(flat.one_sided(along, h), rel=1e-6)
    # From eyes in faces, where what ends at the eye moves as what begins there. Where rays lie in
    # faces, these have no derivative to compare.
    cells = shape.cells[: len(flat.lattice(3).cells)]  # whose middles are exact
    p, q, r = shape.points[rng.choice(cells, len(origins))[:, :3]].swapaxes(0, 1)
    sizes = np.sort(np.abs(directions), axis=1)
    free = (np.diff(sizes, axis=1, prepend=0) > 0.01).all(1)
    eyes = p / 2 + (q + r) / 4
    free &= ((eyes > 0) & (eyes < 1)).all(1)  # not on the hull, where the light begins
    assert free.sum() > 10
    eyes = jnp.where(free[:, None], eyes, origins)
    ours, theirs = (g(mesh.points, mesh.values, eyes) for g in (found, wanted))
    for i, (a, b) in enumerate(zip(ours, theirs, strict=True)):
        a, b = (x[shape.inner] if i == 0 else x for x in (a, b))
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-8 * np.abs(b).max())
