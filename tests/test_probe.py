"""`probe` against the mesh itself: each segment lies in the cell that it names, with the scalars of
that cell at its ends, and the contributions add up to the picture."""

from __future__ import annotations

import warnings

import jax
import numpy as np
import pytest

import jaxvr
from jaxvr import testing

pytestmark = pytest.mark.usefixtures("quick_code")


def scene(dtype, size=6):
    mesh = jaxvr.datasets.box((2, 2, 2), jitter=0.2, dtype=dtype)
    camera = jaxvr.Camera.orbit(mesh, zoom=1.3, width=size, height=size)
    values = np.asarray(mesh.values)
    positions = np.linspace(values.min(), values.max(), 4)
    colors = np.random.default_rng(0).uniform(0, 1, (4, 3))
    return mesh, camera, jaxvr.TransferFunction(positions, colors, [0.5, 3, 1, 4], dtype=dtype)


def inside(mesh, probe):
    """Barycentric coordinates (S, 2, 4) of the ends in the cells that they name."""
    corners = np.asarray(mesh.points, np.float64)[np.asarray(mesh.cells)[probe.cells]]
    edges = np.moveaxis(corners[:, 1:] - corners[:, :1], 1, 2)
    offset = np.moveaxis(probe.positions - corners[:, :1], 1, 2)
    rest = np.linalg.solve(edges, offset)
    return np.moveaxis(np.concatenate([1 - rest.sum(1, keepdims=True), rest], 1), 1, 2)


@pytest.mark.parametrize("tracer", [jaxvr.RayCast(), jaxvr.KBuffer(k=12)], ids=repr)
def test_segments_lie_in_their_cells_and_add_up_to_the_picture(tracer, dtype):
    mesh, camera, transfer = scene(dtype)
    found = jaxvr.probe(mesh, camera, transfer, tracer=tracer)
    eps = np.finfo(dtype).eps
    shares = inside(mesh, found)
    assert len(found) == 36 and len(found.cells) > 100
    assert shares.min() > -200 * eps
    values = np.asarray(mesh.values)[np.asarray(mesh.cells)[found.cells]]
    np.testing.assert_allclose(
        np.einsum("sek,sk->se", shares, values), found.scalars, atol=500 * eps
    )
    image = np.asarray(jaxvr.render(mesh, camera, transfer))
    np.testing.assert_allclose(found.rgba.reshape(image.shape), image, atol=40 * eps)
    assert found.contributions.min() > -8 * eps
    # Segments follow each other without a gap: the box is convex.
    ray = np.repeat(np.arange(36), np.diff(found.start))
    same = ray[1:] == ray[:-1]
    gaps = (found.distances[1:, 0] - found.distances[:-1, 1])[same]
    np.testing.assert_allclose(gaps, 0, atol=100 * eps)
    assert (found.lengths > 0).all()


def test_where_a_folded_cell_leads_back():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the fold
        mesh = testing.nasty_meshes("float64", ["folded"])["folded"]
    assert mesh.report.folded
    rays = testing.nasty_rays(mesh, count=12)["through a centroid"]
    found = jaxvr.probe(mesh, rays, testing.nasty_transfers()["two points"])
    back = found.distances[:, 1] < found.distances[:, 0]
    assert back.any() and not back.all() and (found.lengths > 0).all()
    shares = inside(mesh, found)
    assert shares.min() > -1e-10
    values = np.asarray(mesh.values)[np.asarray(mesh.cells)[found.cells]]
    np.testing.assert_allclose(
        np.einsum("sek,sk->se", shares, values), found.scalars, rtol=0, atol=1e-10
    )


def test_pixels_and_rays_are_parts_of_the_whole():
    mesh, camera, transfer = scene("float32")
    whole = jaxvr.probe(mesh, camera, transfer)
    some = jaxvr.probe(mesh, camera, transfer, pixels=[(2, 3), (0, 0), (3, 2)])
    for k, number in enumerate((15, 0, 20)):
        np.testing.assert_array_equal(some[k].cells, whole[number].cells)
        for name in ("distances", "scalars", "contributions"):
            a, b = getattr(some[k], name), getattr(whole[number], name)
            np.testing.assert_allclose(a, b, atol=1e-6)
    origins, directions = (np.asarray(x) for x in camera.rays())
    rays = jaxvr.probe(mesh, (origins[2, 3], 5 * directions[2, 3]), transfer)
    np.testing.assert_array_equal(rays.cells, some[0].cells)
    np.testing.assert_allclose(rays.distances, some[0].distances, rtol=1e-6)
    assert len(some[-2].cells) == 0 and some[1].rgba.tolist() == [[0, 0, 0, 0]]
    assert repr(some[0]) == f"Probe(1 rays, {len(some[0].cells)} segments)"


def test_an_eye_inside_sees_what_lies_before_it():
    mesh, camera, transfer = scene("float64")
    target = np.asarray(camera.target)
    found = jaxvr.probe(mesh, (target, np.array([1.0, 0.2, 0.1])), transfer)
    assert found.distances[0, 0] == 0 and found.distances.min() >= 0
    assert inside(mesh, found).min() > -1e-12


def test_bad_calls_say_what_is_wrong():
    mesh, camera, transfer = scene("float32")
    with pytest.raises(ValueError, match=r"6 rows and 6 columns; 1 of 2 .* \[6, 0\]"):
        jaxvr.probe(mesh, camera, transfer, pixels=[(5, 5), (6, 0)])
    with pytest.raises(ValueError, match="whole numbers"):
        jaxvr.probe(mesh, camera, transfer, pixels=(1.5, 2.0))
    with pytest.raises(ValueError, match="belong to a camera"):
        jaxvr.probe(mesh, camera.rays(), transfer, pixels=(1, 2))
    with pytest.raises(IndexError, match="36 rays"):
        jaxvr.probe(mesh, camera, transfer)[36]
    with pytest.raises(ValueError, match="inside jit"):
        jax.jit(lambda c: jaxvr.probe(mesh, c, transfer))(camera)
