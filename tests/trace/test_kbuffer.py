"""The k-buffer against ray casting: the same segments, whatever the mesh and the rays."""

from __future__ import annotations

import functools
import warnings

import jax
import numpy as np
import pytest

import jaxvr
from jaxvr._core import status as bits
from jaxvr.trace import cover, select
from jaxvr.view.rays import Rays, flat
from jaxvr.volume import datasets

pytestmark = pytest.mark.usefixtures("quick_code")

ENOUGH = 64  # more than any ray here has fragments
SIZE = 8


@functools.cache
def fins():
    """A comb of three teeth, 720 cells: not convex, with gaps that rays cross, and with more faces
    than are looked through, or covered, at once."""
    box = datasets.box((9, 4, 4), jitter=0.2, dtype="float64", field=lambda p: p @ [0.5, 0.3, 0.2])
    points, cells = np.asarray(box.points), np.asarray(box.cells)
    column, row, _ = (points[cells].mean(1) * [9, 4, 4]).astype(int).T
    kept = ~(np.isin(column, (2, 6)) & (row > 0))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*inverted")  # rows are sorted, not oriented
        mesh = jaxvr.TetMesh.from_cells(
            points, {"tetra": cells[kept]}, np.asarray(box.values), dtype="float64"
        )
    assert mesh.n_tets == 720 and 2 * mesh.n_tets > max(select.LOOK * select.BLOCK, cover.GROUP)
    return mesh


@functools.cache
def transfer():
    return jaxvr.TransferFunction(
        [0.0, 0.4, 0.4, 1.0], np.eye(4)[:, :3], [0.5, 3.0, 1.0, 2.0], dtype="float64"
    )


def scaled(mesh):
    """Values from 0 to 1, so that one transfer function serves."""
    values = np.asarray(mesh.values)
    return mesh.replace(values=(values - values.min()) / np.ptp(values))


def rays_of(view: str):
    """64 rays: through the mesh from outside, from inside of it, side by side, or without order."""
    mesh = fins()
    lo, hi = (np.asarray(x) for x in mesh.bounds())
    middle, reach = (lo + hi) / 2, np.linalg.norm(hi - lo)
    rng = np.random.default_rng(4)
    towards = rng.normal(size=(SIZE, SIZE, 3))
    if view == "unordered":
        return middle + reach * towards, -towards + 0.2 * rng.normal(size=towards.shape)
    if view == "sphere":  # too wide for a plane across it
        return np.broadcast_to(middle + 0.01, towards.shape), towards
    size = {"width": SIZE, "height": SIZE, "dtype": "float64"}
    if view == "outside":
        return jaxvr.Camera.orbit(mesh, 20, 30, zoom=1.5, **size).rays()
    if view == "inside":
        cell = np.asarray(mesh.points)[np.asarray(mesh.cells)[7]].mean(0)
        return jaxvr.Camera.look_at(cell, middle + 0.01, fov=90, **size).rays()
    return jaxvr.Camera.orthographic(middle, lo - 0.1, extent=0.7 * reach, **size).rays()


@pytest.mark.parametrize("view", ["outside", "inside", "parallel", "sphere", "unordered"])
def test_same_as_ray_casting(view):
    rays = rays_of(view)
    exact = jaxvr.render_rays(scaled(fins()), *rays, transfer())
    tracer = jaxvr.KBuffer(k=ENOUGH)
    found, status = jaxvr.render_rays(scaled(fins()), *rays, transfer(), tracer=tracer, status=True)
    assert not np.asarray(status).any()
    assert np.asarray(exact)[..., 3].max() > 0.2
    assert np.allclose(found, exact, atol=1e-13)


@pytest.mark.parametrize("direction", ["front to back", "back to front"])
@pytest.mark.parametrize("pairs", ["cells", "closest"])
def test_both_ways_to_pair_and_to_composite(pairs, direction):
    origins, directions = rays_of("outside")
    exact = jaxvr.render_rays(scaled(fins()), origins, directions, transfer())
    found = jaxvr.render_rays(
        *(scaled(fins()), origins, directions, transfer()),
        tracer=jaxvr.KBuffer(k=ENOUGH, pairs=pairs, order=jaxvr.order.FirstVertex()),
        compositor=jaxvr.Over(direction=direction),
    )
    assert np.allclose(found, exact, atol=1e-13)


def test_rays_end_early_at_the_same_places():
    rays, over = rays_of("outside"), jaxvr.Over(termination=0.5)
    exact = jaxvr.render_rays(scaled(fins()), *rays, transfer(), compositor=over)
    found = jaxvr.render_rays(
        scaled(fins()), *rays, transfer(), compositor=over, tracer=jaxvr.KBuffer(k=ENOUGH)
    )
    assert np.allclose(found, exact, atol=1e-13)


@functools.cache
def squeezed():
    """Long cells, far out of order: a box and a view of it."""
    mesh = datasets.box((3, 3, 3), jitter=0.3, seed=3, dtype="float64", shuffle=True)
    mesh = scaled(mesh.replace(points=np.asarray(mesh.points) * [1, 1, 0.02]))
    return mesh, jaxvr.Camera.orbit(mesh, 25, 15, width=16, height=16, dtype="float64")


OPAQUE = jaxvr.TransferFunction([0.0, 1.0], np.eye(3)[:2], [40.0, 60.0], dtype="float64")


def drawn(mesh, camera, compositor=None, **how):
    """The largest error of each pixel that a k-buffer draws, and which pixels say so."""
    origins, directions = camera.rays()
    exact = jaxvr.render_rays(mesh, origins, directions, OPAQUE)
    image, status = jaxvr.render_rays(
        *(mesh, origins, directions, OPAQUE),
        tracer=jaxvr.KBuffer(**how),
        compositor=compositor,
        status=True,
    )
    error = np.abs(np.asarray(image) - np.asarray(exact)).max(-1)
    return error, (np.asarray(status) & bits.K_TOO_SMALL) != 0


@pytest.mark.parametrize("direction", ["front to back", "back to front"])
@pytest.mark.parametrize("pairs", ["cells", "closest"])
def test_a_small_k_tells_which_pixels_are_wrong(pairs, direction):
    mesh, camera = squeezed()
    over, k = jaxvr.Over(direction=direction), 3
    error, told = drawn(mesh, camera, k=k, pairs=pairs, compositor=over)
    assert 0 < (error > 1e-12).sum() < error.size and not ((error > 1e-12) & ~told).any()
    # The map of needed entries says the same, pixel by pixel.
    needed = jaxvr.measure_k(mesh, camera, direction=direction)
    assert np.array_equal(told, needed.entries > k)


@pytest.mark.parametrize("direction", ["front to back", "back to front"])
def test_the_measured_k_is_enough(direction):
    mesh, camera = squeezed()
    k = jaxvr.measure_k(mesh, camera, direction=direction).k
    error, told = drawn(mesh, camera, k=k, compositor=jaxvr.Over(direction=direction))
    assert not told.any() and error.max() < 1e-13


def test_an_error_says_what_to_do_about_a_small_k():
    mesh, camera = squeezed()
    with pytest.raises(jaxvr.RenderError, match="needed a k-buffer with more entries.*measure_k"):
        jaxvr.render_rays(mesh, *camera.rays(), OPAQUE, tracer=jaxvr.KBuffer(k=3))


def test_a_ray_that_ends_early_tells_what_it_missed_until_then():
    """Of 256 rays; seven were untold when only rays that came to their end said so."""
    mesh, camera = squeezed()
    error, told = drawn(mesh, camera, k=4, compositor=jaxvr.Over(termination=0.1))
    assert told.any() and not ((error > 0.1 + 1e-9) & ~told).any()


@functools.cache
def gap():
    """Two boxes, and an eye in the gap between them that looks at one: half of what its rays meet
    is behind it."""
    one = datasets.box((3, 3, 3), jitter=0.2, seed=1, dtype="float64")
    points, cells = np.asarray(one.points), np.asarray(one.cells)
    mesh = jaxvr.TetMesh.from_cells(
        np.concatenate([points, points + [0, 0, 2]]),
        {"tetra": np.concatenate([cells, cells + len(points)])},
        np.tile(points[:, 0], 2),
        dtype="float64",
    )
    size = {"width": 16, "height": 16, "dtype": "float64"}
    return mesh, jaxvr.Camera.look_at((0.5, 0.5, 1.5), (0.5, 0.45, 2.5), fov=8.0, **size)


@pytest.mark.filterwarnings("ignore:.*inverted")  # rows are sorted, not oriented
@pytest.mark.parametrize("pairs, k", [("cells", 1), ("closest", 2), ("closest", ENOUGH)])
def test_what_is_behind_the_eye(pairs, k):
    error, told = drawn(*gap(), pairs=pairs, k=k)
    assert not ((error > 1e-12) & ~told).any()
    needed = jaxvr.measure_k(*gap())
    if pairs == "cells":  # the map may ask for one entry too many, since the eye is in no cell
        assert not told[needed.entries <= k].any() and needed.k <= k + 1
    assert told.any() == (k < ENOUGH)


@pytest.mark.filterwarnings("ignore:.*inverted")
def test_rays_that_are_none_do_not_hide_others():
    mesh, camera = gap()
    origins, directions = (np.array(x).reshape(-1, 3) for x in camera.rays())
    exact = jaxvr.render_rays(mesh, origins, directions, transfer())
    directions[5] = np.nan
    for tracer in (jaxvr.RayCast(), jaxvr.KBuffer(k=ENOUGH)):
        draw = functools.partial(jaxvr.render_rays, tracer=tracer, status=True)
        image, status = jax.jit(lambda o, d, draw=draw: draw(mesh, o, d, transfer()))(
            origins, directions
        )
        others = np.arange(len(origins)) != 5
        assert np.allclose(np.asarray(image)[others], np.asarray(exact)[others], atol=1e-13)
        assert np.array_equal(np.asarray(status), np.where(others, 0, bits.LOST))


def test_points_that_are_nowhere_are_not_blamed_on_k():
    mesh, camera = squeezed()
    tracer = jaxvr.KBuffer(k=ENOUGH)
    points = np.array(mesh.points)
    points[20] = np.nan
    status = jax.jit(
        lambda p: jaxvr.render_rays(
            mesh.replace(points=p), *camera.rays(), OPAQUE, tracer=tracer, status=True
        )[1]
    )(points)
    with pytest.raises(jaxvr.RenderError, match="NaN or infinite"):
        jaxvr.check(status)


def test_exact_order_needs_one_entry():
    mesh = scaled(fins())
    camera = jaxvr.Camera.orbit(mesh, 20, 30, zoom=1.5, width=16, height=16, dtype="float64")
    order = jaxvr.order.exact_order(mesh, camera)
    assert jaxvr.measure_k(mesh, camera, order=order).k == 1
    found = jaxvr.render(mesh, camera, transfer(), tracer=jaxvr.KBuffer(k=1, order=order))
    assert np.allclose(found, jaxvr.render(mesh, camera, transfer()), atol=1e-13)


def test_faces_are_selected_in_bounded_lists(monkeypatch):
    """Many windows over the sorted faces, and chunks of them, instead of one."""
    mesh = datasets.box((5, 5, 5), jitter=0.2, dtype="float32", shuffle=True)
    camera = jaxvr.Camera.orbit(mesh, 20, 30, width=8, height=8)
    tf = jaxvr.TransferFunction([0.0, 1.0], np.eye(3)[:2], [1.0, 2.0], dtype="float32")
    exact = jaxvr.render(mesh, camera, tf)
    monkeypatch.setattr(select, "LIST", 2 * select.LOOK * select.BLOCK)
    monkeypatch.setattr(cover, "BITS", 1)
    tracer = jaxvr.KBuffer(k=ENOUGH + 1)  # one that no other test has compiled
    state = jax.eval_shape(lambda: _start(tracer, mesh, camera))
    assert state.stream.selection.faces.shape == (2048, 2)
    assert state.stream.cover.masks.shape[0] == 1
    assert mesh.n_tets * 2 > 1024  # a list holds less than all faces
    assert np.allclose(jaxvr.render(mesh, camera, tf, tracer=tracer), exact, atol=1e-6)


def _start(tracer, mesh, camera):
    scene = tracer.prepare(mesh)
    rays = tracer.prepare_rays(scene, flat(Rays(*camera.rays())))
    return tracer.start(scene, rays)


def test_boundaries_that_touch():
    """Two boxes side by side whose triangulations do not match: a ray leaves one and enters the
    other at the same depth, in an order that rounding decides."""
    one = datasets.box((2, 2, 2), jitter=0.1, seed=1, dtype="float64")
    two = datasets.box((3, 3, 3), jitter=0.1, seed=2, dtype="float64")
    points = [np.asarray(m.points) + [i, 0, 0] for i, m in enumerate((one, two))]
    cells = [np.asarray(one.cells), np.asarray(two.cells) + len(points[0])]
    values = np.concatenate([one.values, 1 - np.asarray(two.values)])
    with pytest.warns(UserWarning, match="inverted"):  # rows are sorted, not oriented
        mesh = jaxvr.TetMesh.from_cells(
            np.concatenate(points), {"tetra": np.concatenate(cells)}, values, dtype="float64"
        )
    camera = jaxvr.Camera.look_at((4, 1.1, 0.8), (1, 0.5, 0.5), fov=30, width=8, height=8)
    camera = jax.tree.map(lambda x: x.astype("float64"), camera)
    found = jaxvr.render(mesh, camera, transfer(), tracer=jaxvr.KBuffer(k=ENOUGH))
    assert np.allclose(found, jaxvr.render(mesh, camera, transfer()), atol=1e-13)


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"k": 0}, "k must be a positive integer, but is 0"),
        ({"k": 2.5}, "k must be a positive integer"),
        ({"k": True}, "k must be a positive integer"),
        ({"order": "centroid"}, r"such as jaxvr.order.Centroid\(\), but is 'centroid'"),
        ({"pairs": "nearest"}, 'must be "cells" or "closest"'),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        jaxvr.KBuffer(**arguments)


def test_k_as_numpy_has_it():
    assert jaxvr.KBuffer(k=np.int64(5)) == jaxvr.KBuffer(k=5)  # type: ignore[arg-type]
