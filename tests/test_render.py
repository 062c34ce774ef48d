"""The four verbs: what they accept, what they return, what they refuse, when they compile."""

from __future__ import annotations

import dataclasses
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import quick
import registry

import jaxvr

pytestmark = pytest.mark.usefixtures("quick_code")

SIZE = {"width": 6, "height": 5}
EPS = np.finfo(np.float32).eps


@pytest.fixture(scope="module")
def scene():
    mesh = registry.mesh_of("point", "float32")
    return mesh, registry.camera_of("float32"), registry.transfer_of("float32")


def test_image_is_premultiplied_and_in_the_dtype_of_the_volume(scene):
    mesh, camera, transfer = scene
    image = jaxvr.render(mesh, camera, transfer)
    assert image.shape == (5, 6, 4) and image.dtype == jnp.float32
    color, alpha = np.asarray(image[..., :3]), np.asarray(image[..., 3:])
    assert (alpha >= 0).all() and (alpha < 1).all() and alpha.max() > 0.3
    assert (color <= alpha * float(transfer.colors.max()) + 1e-6).all()
    assert (color[alpha[..., 0] == 0] == 0).all()


def test_background_is_opaque(scene):
    mesh, camera, transfer = scene
    image = jaxvr.render(mesh, camera, transfer)
    behind = jaxvr.render(mesh, camera, transfer, background=(0.2, 0.4, 0.6))
    want = image[..., :3] + (1 - image[..., 3:]) * jnp.array([[[0.2, 0.4, 0.6]]])
    assert np.allclose(behind[..., :3], want, atol=1e-6)
    assert np.allclose(behind[..., 3], 1)


def moved(scene, apart):
    """How far an image (H, W, 4) moves when its rays' directions do by `apart`, which broadcasts to
    (H, W, 3): to first order, by the steeper of two one-sided differences, and what the rounding of
    light in [0, 1] adds. Where a ray grazes a face, light moves by seventy times its direction."""
    mesh, camera, transfer = scene
    origins, directions = (np.asarray(x) for x in camera.rays())

    def light(directions: Any) -> np.ndarray:
        return np.asarray(jaxvr.render_rays(mesh, origins, directions, transfer))

    step, here = 2.0**-12, light(directions)
    bound = np.full_like(here, 8 * EPS)
    for axis, by in zip(np.eye(3, dtype=np.float32), np.moveaxis(apart, -1, 0), strict=True):
        ahead, behind = (np.abs(light(directions + s * axis) - here) for s in (step, -step))
        bound = bound + np.maximum(ahead, behind) / step * by[..., None]
    return bound


def test_rays_are_the_camera_s(scene):
    """Those of code that is compiled in another way are rounded in another way."""
    mesh, camera, transfer = scene
    image = np.asarray(jaxvr.render(mesh, camera, transfer))
    within = quick.jit(lambda camera: camera.rays())(camera)
    assert np.allclose(
        jaxvr.render_rays(mesh, within[0], within[1], transfer), image, rtol=0, atol=8 * EPS
    )
    origins, directions = camera.rays()
    apart = np.abs(directions - within[1])
    assert np.array_equal(origins, within[0]) and apart.max() <= 2 * EPS
    bound = moved(scene, apart)
    found = jaxvr.render_rays(mesh, origins, directions, transfer)
    assert np.all(np.abs(found - image) <= bound)
    one = jaxvr.render_rays(mesh, origins[2, 3], directions[2, 3], transfer)
    assert one.shape == (4,) and np.all(np.abs(one - image[2, 3]) <= bound[2, 3])


def test_directions_may_have_any_length(scene):
    mesh, camera, transfer = scene
    origins, directions = camera.rays()
    image, bits = jaxvr.render_rays(mesh, origins, 37.5 * directions, transfer, status=True)
    want = jaxvr.render_rays(mesh, origins, directions, transfer)
    assert np.allclose(image, want, atol=1e-5)
    assert bits.shape == (5, 6) and not bits.any()
    jaxvr.check(bits)


def test_images_larger_than_a_tile_are_put_together_rightly():
    mesh = registry.mesh_of("point", "float64")
    transfer = registry.transfer_of("float64")
    camera = registry.camera_of("float64").replace(width=37, height=21)
    image = jaxvr.render(mesh, camera, transfer)
    origins, directions = camera.rays()
    assert np.allclose(jaxvr.render_rays(mesh, origins, directions, transfer), image, atol=1e-13)
    segments = jaxvr.trace(mesh, camera)
    assert np.allclose(jaxvr.shade(segments, transfer), image, atol=1e-13)


@pytest.mark.parametrize("location", registry.MESHES)
def test_shade_of_trace_is_render(location):
    mesh = registry.mesh_of(location, "float64")
    camera, transfer = registry.camera_of("float64"), registry.transfer_of("float64")
    segments = jaxvr.trace(mesh, camera)
    image = jaxvr.shade(segments, transfer)
    assert np.allclose(image, jaxvr.render(mesh, camera, transfer), atol=1e-14)
    # The same segments under another transfer function with more control points.
    other = transfer.with_points(12)
    want = jaxvr.render(mesh, camera, other)
    assert np.allclose(jaxvr.shade(segments, other), want, atol=1e-14)


def test_gradient_of_shade_is_that_of_render(scene):
    mesh, camera, transfer = (registry.mesh_of("point", "float64"), *scene[1:])
    segments = jaxvr.trace(mesh, camera)

    def loss(transfer, of):
        return jnp.sum(of(transfer) ** 2)

    got = jax.grad(loss)(transfer, lambda t: jaxvr.shade(segments, t))
    want = jax.grad(loss)(transfer, lambda t: jaxvr.render(mesh, camera, t))
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        assert np.allclose(a, b, rtol=1e-5, atol=1e-7)


def test_segments_are_compact(scene):
    mesh, camera, _ = scene
    segments = jaxvr.trace(mesh, camera)
    rays = segments.start.shape[0] - 1
    assert rays == 30 and int(segments.start[-1]) == segments.count
    lengths = np.asarray(segments.length)[: segments.count]
    assert (lengths >= 0).all() and np.asarray(segments.length)[segments.count :].sum() == 0
    assert segments.scalar.dtype == jnp.float32  # 4 + 4 bytes a segment


def test_chords_of_traced_segments_are_world_lengths(scene):
    mesh, _, _ = scene
    origins = np.array([[0.3, 0.4, -2.0], [0.6, 0.2, -2.0], [5.0, 5.0, 5.0]])
    segments = jaxvr.trace(mesh, (origins, np.array([0.0, 0.0, 2.0])))
    start, length = np.asarray(segments.start), np.asarray(segments.length)
    chords = np.add.reduceat(np.append(length, 0), start[:-1]) * (np.diff(start) > 0)
    assert np.allclose(chords[np.argsort(np.asarray(segments.order))], [1, 1, 0], atol=1e-6)


def test_new_floats_do_not_compile_again(scene):
    mesh, camera, transfer = scene
    module: Any = sys.modules["jaxvr.render"]
    gradient: Any = jax.jit(jax.grad(lambda t, m, c: jnp.sum(jaxvr.render(m, c, t) ** 2)))
    jaxvr.render(mesh, camera, transfer)
    gradient(transfer, mesh, camera)
    before = module._render._cache_size(), gradient._cache_size()
    others = (
        mesh.replace(values=mesh.values * 0.5),
        camera.replace(eye=np.array([2.5, 1.0, 2.0], np.float32)),
        transfer.scaled(2.0),
    )
    jaxvr.render(others[0], camera, transfer)
    jaxvr.render(mesh, others[1], transfer)
    jaxvr.render(mesh.replace(points=mesh.points * 1.1), others[1], others[2])
    gradient(others[2], others[0], others[1])
    assert (module._render._cache_size(), gradient._cache_size()) == before


def test_camera_and_mesh_may_be_constants_of_a_user_s_jit(scene):
    mesh, camera, transfer = scene
    inside = jax.jit(lambda t: jaxvr.render(mesh, camera, t))(transfer)
    apart = np.full((5, 6, 3), 2 * EPS)  # directions are right to a rounding, here and there
    assert np.all(np.abs(inside - jaxvr.render(mesh, camera, transfer)) <= moved(scene, apart))


def test_vmap_over_transfer_functions(scene):
    mesh, camera, transfer = scene
    scales = jnp.array([0.5, 2.0], jnp.float32)

    def image(scale):
        return jaxvr.render(mesh, camera, transfer.scaled(scale))

    many = jax.vmap(image)(scales)
    assert np.allclose(many[1], image(scales[1]), atol=1e-5)


def test_points_that_are_not_finite_are_an_error_not_a_picture(scene):
    mesh, camera, transfer = scene
    broken = dataclasses.replace(mesh, points=mesh.points * jnp.nan)
    origins, directions = camera.rays()
    with pytest.raises(ValueError, match=r"mesh\.points has 81 NaN"):
        jaxvr.render_rays(broken, origins, directions, transfer)
    draw = jax.jit(lambda m: jaxvr.render_rays(m, origins, directions, transfer, status=True))
    # Nothing contains a ray: no wrong picture, and it ends.
    assert (draw(broken)[0] == 0).all()
    with pytest.raises(ValueError, match="points"):
        mesh.replace(points=mesh.points * jnp.nan)


def test_bad_arguments(scene):
    mesh, camera, transfer = scene
    word: Any = "front"
    with pytest.raises(ValueError, match=r"camera must be a jaxvr.Camera, but is a str"):
        jaxvr.render(mesh, word, transfer)
    with pytest.raises(ValueError, match=r"transfer must be a jaxvr.TransferFunction"):
        jaxvr.render(mesh, camera, word)
    with pytest.raises(ValueError, match=r"volume must be a jaxvr.TetMesh"):
        jaxvr.render(word, camera, transfer)
    with pytest.raises(ValueError, match=r"background must be RGB with shape \(3,\)"):
        jaxvr.render(mesh, camera, transfer, background=np.array([1.0]))
    with pytest.raises(ValueError, match=r"direction.s. are zero, the first at \(1,\)"):
        jaxvr.render_rays(mesh, np.zeros((2, 3)), np.eye(3)[:2] * [[1], [0]], transfer)
    with pytest.raises(ValueError, match=r"origins must have shape \(..., 3\)"):
        jaxvr.render_rays(mesh, np.zeros(2), np.ones(3), transfer)
    with pytest.raises(ValueError, match=r"origins has 1 NaN"):
        jaxvr.render_rays(mesh, np.array([0, np.nan, 0]), np.ones(3), transfer)
    with pytest.raises(ValueError, match="no rays"):
        jaxvr.render_rays(mesh, np.zeros((0, 3)), np.ones(3), transfer)
    with pytest.raises(ValueError, match="trace cannot run inside jit"):
        jax.jit(lambda m: jaxvr.trace(m, camera))(mesh)
    with pytest.raises(ValueError, match="max_steps must be a positive integer"):
        jaxvr.Direct(max_steps=0)


def test_too_few_steps_are_an_error(scene):
    mesh, camera, transfer = scene
    with pytest.raises(jaxvr.RenderError, match="maximum number of steps.*Increase"):
        jaxvr.render(mesh, camera, transfer, adjoint=jaxvr.Direct(max_steps=3))
