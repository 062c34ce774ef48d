"""`jaxvr.testing`: it lets through what is right, and catches what is wrong."""

from __future__ import annotations

import subprocess
import sys
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvr
from jaxvr import testing
from jaxvr.testing.gradients import difference
from jaxvr.testing.render import camera_rays

pytestmark = pytest.mark.usefixtures("quick_code")


@pytest.fixture(scope="module")
def meshes():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return testing.nasty_meshes("float64")


def camera_of(mesh, **more):
    return jaxvr.Camera.orbit(mesh, azimuth=37, elevation=23, width=6, height=5, **more)


def test_nasty_meshes_are_what_they_say(meshes, dtype):
    assert set(meshes) == set(testing.MESHES) and testing.FOLDED < set(testing.MESHES)
    for name, mesh in meshes.items():
        assert 1 <= mesh.n_tets <= 700, name
        assert 0 <= float(mesh.values.min()) and float(mesh.values.max()) <= 1, name
    assert len(meshes["seams"].duplicates) == 9
    one = testing.nasty_meshes(dtype, only=["one"])
    assert list(one) == ["one"] and one["one"].dtype == dtype
    with pytest.raises(ValueError, match="There is no mesh 'ring'"):
        testing.nasty_meshes(only=["ring"])


def test_nasty_rays_meet_and_miss(meshes):
    mesh = meshes["hollow"]
    brute = testing.BruteForce(mesh)
    for name, (origins, directions) in testing.nasty_rays(mesh, count=16).items():
        assert origins.shape == directions.shape == (16, 3)
        assert (directions != 0).any(1).all()
        length = brute.lengths(origins, directions)
        if name in ("missing", "mesh behind"):
            assert not length.any(), name
        else:
            assert (length > 0).any(), name


def test_rays_of_the_camera(meshes):
    mesh = meshes["one"]
    views = [camera_of(mesh), jaxvr.Camera.orthographic((2, 1, 3), (0, 0, 0.2), width=4, height=3)]
    for view in views:
        for ours, theirs in zip(camera_rays(view), view.rays(), strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-7 if view.extent else 1e-14)


@pytest.mark.parametrize("name", ["one", "prisms", "hollow", "zoo"])
def test_pictures_of_nasty_meshes(meshes, name):
    mesh = meshes[name]
    transfers = testing.nasty_transfers()
    for kind in ("jump", "transparent stretches", "opaque", "below"):
        testing.assert_render_close(mesh, camera_of(mesh), transfers[kind], background=(0.2, 0, 1))
    rays = testing.nasty_rays(mesh, count=8)
    at = tuple(np.concatenate(x) for x in zip(*rays.values(), strict=True))
    testing.assert_render_close(mesh, at, transfers["two points"])


@pytest.mark.parametrize("location", ["cell", "corner"])
def test_data_of_cells_and_corners(meshes, location):
    mesh = meshes["cracks"]
    corners = np.asarray(mesh.values)[np.asarray(mesh.cells)]
    values = corners.mean(1) if location == "cell" else corners**2
    mesh = mesh.replace(values=values, location=location)
    eye = np.asarray(mesh.points)[np.asarray(mesh.cells)][5].mean(0)
    inside = jaxvr.Camera.look_at(eye, (0.5, 0.5, 0.4), fov=70, width=6, height=5, dtype="float64")
    for camera in (camera_of(mesh), inside):
        testing.assert_render_close(mesh, camera, testing.nasty_transfers()["jump"])


def test_a_wrong_picture_is_told(meshes):
    mesh, transfer = meshes["zoo"], testing.nasty_transfers()["two points"]
    camera = camera_of(mesh)
    image = np.array(jaxvr.render(mesh, camera, transfer))
    testing.assert_render_close(mesh, camera, transfer, image=image)
    image[2, 3, 1] += 1e-6
    with pytest.raises(AssertionError, match=r"1 of 30 pixels .* \(2, 3\): its green .* 1e-06"):
        testing.assert_render_close(mesh, camera, transfer, image=image)
    image[2, 3, 1] = np.nan
    with pytest.raises(AssertionError, match=r"\(2, 3\): its green is nan"):
        testing.assert_render_close(mesh, camera, transfer, image=image)
    with pytest.raises(AssertionError, match="has shape"):
        testing.assert_render_close(mesh, camera, transfer, image=image[:2])


def test_a_ray_without_a_value_of_its_own_gets_a_second_look():
    mesh = jaxvr.datasets.box((1, 1, 1), dtype="float64")
    transfer = testing.nasty_transfers()["one point"]
    along = np.array([[0.0, 0.5, -1.0]]), np.array([[0.0, 0, 1]])  # in a face of the boundary
    seen = testing.brute_force(mesh, along, transfer)
    other = np.zeros_like(seen) if seen.any() else 1 - np.exp(-np.ones((1, 4)))
    testing.assert_render_close(mesh, along, transfer, image=other)
    with pytest.raises(AssertionError, match="off"):
        testing.assert_render_close(mesh, along, transfer, image=other, slack=0)
    with pytest.raises(AssertionError, match="off"):
        testing.assert_render_close(mesh, along, transfer, image=1.1 * (seen + other))


@pytest.mark.parametrize("name", list(testing.nasty_transfers()))
def test_units_change_no_bit_of_brute_force(name, meshes):
    mesh, transfer = meshes["one"], testing.nasty_transfers()[name]
    camera = camera_of(mesh)
    image = testing.brute_force(mesh, camera, transfer)
    moved, other = testing.scaled(mesh, transfer, scalar=-70)
    np.testing.assert_array_equal(testing.brute_force(moved, camera, other), image)


# --- gradients ----------------------------------------------------------------------------------


def test_differences_know_their_error():
    for f, want in [(np.exp, 1.0), (lambda t: np.sin(40 * t), 40.0), (np.cos, 0.0)]:
        value, error = difference(lambda t, f=f: float(f(t)), 1e-2, noise=1e-16)
        assert abs(value - want) <= 10 * error <= 1e-9
    _, error = difference(lambda t: abs(t - 1e-4), 1e-2, levels=6)
    assert error > 1e-3  # a kink within the steps


def smooth(a, b):
    return jnp.sin(a) * jnp.sum(b["x"] ** 2) + b["y"]


OPERANDS = {"a": np.array([0.3, 1.2]), "b": {"x": np.array([1.0, 2, 3]), "y": np.array(0.5)}}


def test_right_gradients_pass():
    for operands in (OPERANDS, tuple(OPERANDS.values())):
        found = testing.assert_gradients(smooth, operands)
        assert len(found) == 4 and all(c.forward is not None for c in found)
    testing.assert_gradients(lambda p: smooth(**p), OPERANDS, orders=0)
    testing.assert_gradients(jnp.sin, np.array([0.2, 0.4]), orders=0)
    constant = testing.assert_gradients(
        lambda a, b: b * 2, {"a": np.ones(2), "b": np.ones(2)}, orders=0
    )
    assert constant[0].reverse == 0


def broken(gradient):
    """a^2 with another derivative."""

    @jax.custom_vjp
    def f(a):
        return a**2

    f.defvjp(lambda a: (f(a), a), lambda a, bar: (gradient(a, bar),))
    return f


@pytest.mark.parametrize(
    "gradient, words",
    [
        (lambda a, bar: 2 * a * bar * (1 + 1e-5), "'a' is wrong: reverse mode gives"),
        (lambda a, bar: 0 * a, "'a' is 0, but should not be"),
        (lambda a, bar: jnp.full_like(a, jnp.nan), "'a' is not finite"),
    ],
)
def test_wrong_gradients_are_told(gradient, words):
    with pytest.raises(AssertionError, match=words):
        testing.assert_gradients(lambda a: broken(gradient)(a), {"a": np.array([0.3, 1.2])})
    testing.assert_gradients(
        lambda a: broken(lambda a, bar: 2 * a * bar)(a), {"a": np.array([0.3, 1.2])}
    )


def test_forward_mode_is_compared():
    a = {"a": np.array([0.3, 1.2])}
    right = broken(lambda a, bar: 2 * a * bar)
    assert testing.assert_gradients(right, a)[0].forward is None
    assert testing.assert_gradients(right, a, forward=lambda a: a**2)[0].forward is not None
    with pytest.raises(TypeError, match="custom_vjp"):
        testing.assert_gradients(right, a, forward=True)
    with pytest.raises(AssertionError, match="in reverse mode and"):
        testing.assert_gradients(right, a, forward=lambda a: 1.001 * a**2)


@jax.custom_vjp
def _forgetful(a, b):
    return a**2 * b


@jax.tree_util.register_static
class _Asked(tuple):
    pass


def _keep(a, b):
    return a.value**2 * b.value, (a.value, b.value, _Asked((a.perturbed, b.perturbed)))


def _give(residuals, bar):
    a, b, asked = residuals
    return (2 * a * b * bar if asked[0] else 0 * a), (a**2 * bar if asked[1] else 0 * b)


_forgetful.defvjp(_keep, _give, symbolic_zeros=True)


def test_gradients_that_depend_on_history_are_told():
    """Flags in the structure of residuals: each gradient is right alone."""
    operands = {"a": np.array([0.3, 1.2]), "b": np.array([2.0, 0.7])}
    fn = jax.jit(_forgetful)
    testing.assert_gradients(fn, operands, orders=0)
    with pytest.raises(AssertionError, match="is 0 in this order, though it is right alone"):
        testing.assert_gradients(fn, operands, orders=4)


def test_differences_that_decide_nothing_are_told():
    a = {"a": np.array([1.0])}  # with a kink nearer than the last step
    with pytest.raises(AssertionError, match="decide nothing"):
        testing.assert_gradients(lambda a: jnp.abs(a - 1 - 5e-6), a, orders=0)


def test_gradients_need_double():
    with pytest.raises(ValueError, match="leaf of float32"):
        testing.assert_gradients(jnp.sin, {"x": np.float32(1)})
    with pytest.raises(ValueError, match="no floats"):
        testing.assert_gradients(lambda i: i, {"i": np.arange(3)})
    with pytest.raises(ValueError, match="no operands"):
        testing.assert_gradients(lambda: 1.0, {})
    jax.config.update("jax_enable_x64", False)
    try:
        with pytest.raises(ValueError, match="jax_enable_x64"):
            testing.assert_gradients(jnp.sin, {"x": np.array(1.0)})
    finally:
        jax.config.update("jax_enable_x64", True)


def test_gradients_of_a_render(meshes):
    mesh, transfer = meshes["one"], testing.nasty_transfers()["two points"]
    camera = camera_of(mesh)

    def image(adjoint):
        return lambda values, colors: jaxvr.render(
            mesh.replace(values=values), camera, transfer.replace(colors=colors), adjoint=adjoint
        )

    operands = {"values": mesh.values, "colors": transfer.colors}
    found = testing.assert_gradients(
        image(None), operands, forward=image(jaxvr.Forward()), directions=1, orders=1
    )
    assert all(abs(c.reverse) > 1e-3 for c in found)


def test_needs_no_package_of_the_tests():
    code = (
        "import sys; sys.modules.update({k: None for k in ('pytest', 'hypothesis', '_pytest')});"
        "from jaxvr import testing; [getattr(testing, k) for k in testing.__all__]"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
