"""Skipping what is transparent: how much the forward pass saves, and that no gradient is lost."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import quick
import registry

import jaxvr
from jaxvr.optics import AbstractSlabIntegrator
from tests.adjoint.schedule import iterations

pytestmark = pytest.mark.usefixtures("quick_code")

# Eight control points of no extinction among twelve; the box has values from 0 to 1.
TAU = np.array([0, 0, 0, 0, 0, 0, 2.0, 1.0, 0, 0, 3.0, 3.0])
WEIGHTS = jnp.asarray(np.random.default_rng(1).normal(size=(5, 6, 4)))
DIRECT = jaxvr.Direct(max_steps=96)


def transfer_of(extinctions, dtype="float64"):
    colors = np.random.default_rng(0).uniform(0, 1, (12, 3))
    return jaxvr.TransferFunction(np.linspace(0.02, 0.9, 12), colors, extinctions, dtype=dtype)


@functools.cache
def scene(dtype: str = "float64"):
    return registry.mesh_of("point", dtype), registry.camera_of(dtype)


@functools.cache
def segments_of(dtype: str = "float64"):
    return jaxvr.trace(*scene(dtype))


def test_image_is_that_of_the_whole_walk(dtype):
    """`Forward` walks through every slab."""
    transfer, segments = transfer_of(TAU, dtype), segments_of(dtype)
    got, want = (
        np.asarray(jaxvr.shade(segments, transfer, adjoint=a))
        for a in (jaxvr.Replay(), jaxvr.Forward())
    )
    assert got[..., 3].max() > 0.3
    assert np.max(np.abs(got - want)) <= 2 * np.finfo(dtype).eps


@pytest.mark.parametrize("how", ["render", "shade"])
def test_a_batch_takes_fewer_iterations(how):
    mesh, camera = scene("float32")
    rays = tuple(x.reshape(-1, 3) for x in camera.rays())
    volume = mesh if how == "render" else segments_of("float32")
    integrator, over = jaxvr.Analytic(), jaxvr.Over()

    def count(extinctions, shorten):
        transfer = transfer_of(extinctions, "float32")
        return int(iterations(integrator, over, shorten, volume, rays, transfer))

    empty, peak, opaque = np.zeros(12), np.eye(12)[10], np.ones(12)
    assert count(opaque, True) == count(opaque, False)
    assert count(peak, True) <= 0.85 * count(peak, False)
    # As many as cells, if control points do not matter.
    one_slab = jaxvr.TransferFunction([0.0], np.ones((1, 3)), np.ones(1), dtype="float32")
    cells = int(iterations(integrator, over, False, volume, rays, one_slab))
    assert count(empty, True) == cells < 0.7 * count(empty, False)


CALLS = []


@dataclasses.dataclass(frozen=True)
class Counting(AbstractSlabIntegrator):
    """`Analytic`, counting how often a batch of slab integrals is computed."""

    def weights(self, a, b):
        jax.debug.callback(lambda: CALLS.append(1))
        return jaxvr.Analytic().weights(a, b)


@jax.jit
def counting_image(transfer):
    return jaxvr.shade(segments_of(), transfer, integrator=Counting())


def test_no_slab_integral_is_computed_where_nothing_is_seen():
    segments_of()  # outside of jit

    def integrals(extinctions):
        CALLS.clear()
        jax.block_until_ready(counting_image(transfer_of(extinctions)))
        jax.effects_barrier()
        return len(CALLS)

    assert integrals(np.zeros(12)) == 0
    assert 0 < integrals(TAU) < integrals(np.ones(12))


def derivatives(adjoint, extinctions):
    """Of a shaded loss with respect to the transfer function and the segments."""
    segments = segments_of()

    def loss(transfer, scalar, length):
        volume = dataclasses.replace(segments, scalar=scalar, length=length)
        return jnp.sum(WEIGHTS * jaxvr.shade(volume, transfer, adjoint=adjoint))

    return loss, (transfer_of(extinctions), segments.scalar, segments.length)


@pytest.mark.parametrize("extinctions", [TAU, np.zeros(12)], ids=["runs", "all"])
def test_gradients_at_extinction_zero_are_those_of_the_whole_walk(extinctions):
    loss, args = derivatives(jaxvr.Replay(), extinctions)
    direct, _ = derivatives(DIRECT, extinctions)
    everything = quick.jit(jax.grad(loss, argnums=(0, 1, 2)))(*args)
    want = quick.jit(jax.grad(direct, argnums=(0, 1, 2)))(*args)
    for got, expected in zip(jax.tree.leaves(everything), jax.tree.leaves(want), strict=True):
        scale = np.max(np.abs(expected)) + 1e-30
        assert np.max(np.abs(got - expected)) <= 1e-12 * scale
    # Every control point in the range of the values has a gradient; the first is below it.
    assert np.all(np.abs(np.asarray(everything[0].extinctions[1:])) > 1e-6)
    # Without one for the transfer function the backward pass takes runs at once.
    alone = quick.jit(jax.grad(loss, argnums=(1, 2)))(*args)
    for got, expected in zip(alone, want[1:], strict=True):
        scale = np.max(np.abs(expected)) + 1e-30
        assert np.max(np.abs(got - expected)) <= 1e-12 * scale


def test_gradient_at_extinction_zero_against_one_sided_differences():
    loss, args = derivatives(jaxvr.Replay(), TAU)
    rng = np.random.default_rng(4)
    way = np.where(TAU == 0, rng.uniform(0.5, 1.5, 12), 0)
    value = quick.jit(loss)

    def at(h):
        return float(value(transfer_of(TAU + h * way), *args[1:]))

    def one_sided(h):
        return (4 * at(h) - at(2 * h) - 3 * at(0.0)) / (2 * h)

    slope = float(jnp.sum(quick.jit(jax.grad(loss))(*args).extinctions * way))
    coarse, fine = one_sided(2e-4), one_sided(1e-4)
    assert slope == pytest.approx((4 * fine - coarse) / 3, rel=1e-8)
    forward, args = derivatives(jaxvr.Forward(), TAU)
    zero = jax.tree.map(jnp.zeros_like, args)
    leaves, structure = jax.tree.flatten(zero[0])
    move = structure.unflatten([*leaves[:2], jnp.asarray(way)])
    along = quick.jit(lambda args, way: jax.jvp(forward, args, way)[1])(args, (move, *zero[1:]))
    assert float(along) == pytest.approx(slope, rel=1e-12)


def test_gradients_of_the_mesh_alone_are_those_of_the_whole_walk():
    mesh, camera = scene()
    transfer = transfer_of(TAU)

    def gradient(adjoint):
        def loss(values, points):
            volume = mesh.replace(values=values, points=points)
            return jnp.sum(WEIGHTS * jaxvr.render(volume, camera, transfer, adjoint=adjoint))

        return quick.jit(jax.grad(loss, argnums=(0, 1)))(mesh.values, mesh.points)

    for got, want in zip(gradient(jaxvr.Replay()), gradient(DIRECT), strict=True):
        assert np.max(np.abs(got - want)) <= 1e-12 * np.max(np.abs(want))
