"""Derivatives that an adjoint cannot give: refused in words that name the one that can, and never
computed by rules that hold for others."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvr
from jaxvr._core.modes import constant, forward_only, reverse_only

MESH = jaxvr.datasets.box((2, 1, 1), field=lambda p: p[:, 0] + 0.2 * p[:, 1], dtype="float64")
CAMERA = jaxvr.Camera.orbit(MESH, azimuth=31, elevation=17, width=3, height=2)
TRANSFER = jaxvr.TransferFunction([0.0, 0.4, 1.3], np.eye(3), [0.5, 2.0, 4.0])
OPERANDS = {
    "extinctions": lambda x, **how: jaxvr.render(
        MESH, CAMERA, TRANSFER.replace(extinctions=x), **how
    ),
    "values": lambda x, **how: jaxvr.render(MESH.replace(values=x), CAMERA, TRANSFER, **how),
}
START = {"extinctions": TRANSFER.extinctions, "values": MESH.values}
ENGINES = [jaxvr.engine.C(), jaxvr.engine.XLA()]

pytestmark = pytest.mark.usefixtures("quick_code")


def loss(name, **how):
    return lambda x: (OPERANDS[name](x, **how) ** 2).sum()


def jvp(f):
    return lambda x: jax.jvp(f, (x,), (jnp.ones_like(x),))[1]


@pytest.mark.parametrize("engine", ENGINES, ids=["compiled", "jax"])
@pytest.mark.parametrize("under", [lambda f: f, jax.jit], ids=["plain", "jit"])
@pytest.mark.parametrize("mode", [jvp, jax.jacfwd], ids=["jvp", "jacfwd"])
def test_forward_mode_of_replay_names_forward(engine, under, mode):
    f = loss("extinctions", engine=engine)
    with pytest.raises(TypeError, match=r"adjoint=Forward\(\)"):
        under(mode(f))(START["extinctions"])


@pytest.mark.parametrize("under", [lambda f: f, jax.jit], ids=["plain", "jit"])
def test_reverse_mode_of_forward_names_replay(under):
    f = loss("values", adjoint=jaxvr.Forward())
    with pytest.raises(TypeError, match=r"adjoint=Replay\(\)"):
        under(jax.grad(f))(START["values"])


@pytest.mark.parametrize("engine", ENGINES, ids=["compiled", "jax"])
@pytest.mark.parametrize("name", OPERANDS)
@pytest.mark.parametrize("second", [jvp, lambda g: jax.grad(lambda x: g(x).sum())])
def test_second_derivatives_of_replay_are_refused(engine, name, second):
    """Forward over reverse through JAX's loops gave numbers, wrong ones."""
    gradient = jax.grad(loss(name, engine=engine))
    with pytest.raises(TypeError, match=r"first derivatives only.*Direct"):
        second(gradient)(START[name])


def both(extinctions, values):
    """By Direct, which differentiates whatever it is made of."""
    image = jaxvr.render(
        MESH.replace(values=values),
        CAMERA,
        TRANSFER.replace(extinctions=extinctions),
        adjoint=jaxvr.Direct(12),
    )
    return (image**2).sum()


def test_second_derivatives_with_colours_and_extinctions_are_direct_s_and_right():
    """By extinctions twice, and by extinctions and values."""
    gradient = jax.jit(jax.grad(both))  # by extinctions
    x, v = START["extinctions"], START["values"]
    along, across = jnp.array([1.0, -0.5, 0.7]), jnp.cos(jnp.arange(v.size))
    got = jax.jvp(gradient, (x, v), (along, across))[1]
    step = 1e-4
    ahead = gradient(x + step * along, v + step * across)
    behind = gradient(x - step * along, v - step * across)
    np.testing.assert_allclose(got, (ahead - behind) / (2 * step), rtol=1e-6, atol=1e-8)


def test_second_derivatives_by_the_scalar_are_refused():
    """They were 0, since places of cuts are held: right is 8.8 on a mesh like this one."""
    gradient = jax.grad(both, argnums=1)
    with pytest.raises(TypeError, match="places of cuts are held"):
        jvp(lambda v: gradient(START["extinctions"], v))(START["values"])


def test_modes_pass_arrays_on():
    tree = {"a": jnp.arange(3.0), "n": jnp.arange(2)}
    for guard in (constant, forward_only, reverse_only):
        out = guard(tree, "no")
        assert all(np.array_equal(out[k], tree[k]) for k in tree)
    # The mode that is allowed, plain and through the transformations that users put round it.
    square = lambda guard: lambda x: (guard({"x": x}, "refused")["x"] ** 2).sum()  # noqa: E731
    x = jnp.arange(3.0)
    for f in (square(reverse_only), jax.jit(square(reverse_only))):
        for g in (jax.grad(f), jax.grad(jax.checkpoint(f)), jax.jit(jax.grad(f))):
            np.testing.assert_array_equal(g(x), 2 * x)
        np.testing.assert_array_equal(jax.vmap(jax.grad(f))(x[None]), 2 * x[None])
        np.testing.assert_array_equal(jax.grad(lambda y: jax.vmap(f)(y).sum())(x[None])[0], 2 * x)
    for f in (square(forward_only), jax.jit(square(forward_only))):
        np.testing.assert_array_equal(jax.jacfwd(f)(x), 2 * x)
        np.testing.assert_array_equal(jax.jacfwd(jax.jacfwd(f))(x), 2 * np.eye(3))
    for refused in (
        lambda: jax.grad(square(forward_only))(x),
        lambda: jax.jit(jax.grad(square(forward_only)))(x),
        lambda: jvp(square(reverse_only))(x),
        lambda: jax.jit(jvp(square(reverse_only)))(x),
        lambda: jax.grad(square(constant))(x),
        lambda: jvp(square(constant))(x),
    ):
        with pytest.raises(TypeError, match="refused"):
            refused()
