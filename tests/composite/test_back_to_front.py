"""The over operator from behind: the same pixels and gradients, thin, thick and opaque, and what
cannot be had from behind. All adjoints are in test_registry."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import registry

import jaxvr
from jaxvr.adjoint import Pipeline
from jaxvr.composite import Over
from jaxvr.trace import Recorded
from tests.composite.test_over import fold, pieces, pixels, require_derivative

BEHIND = Over(direction="back to front")


@pytest.mark.parametrize("size", [1e-8, 1e-3, 0.05, 0.7, 5.0])
def test_float32_keeps_its_digits_from_thin_to_opaque(size):
    rgb, depth = pieces(size, n=2000)
    before = np.cumsum(depth, 0, dtype=np.float64) - depth
    want = (np.exp(-before)[:, None] * rgb).sum(0)
    got = np.asarray(pixels(fold(rgb, depth, BEHIND), BEHIND))
    assert np.max(np.abs(got[:3] / want - 1)) < 1e-6
    assert np.max(np.abs(got[3] / -np.expm1(-depth.sum(0, dtype=np.float64)) - 1)) < 5e-7


def test_what_an_opaque_piece_hides_leaves_no_rounding():
    """A light of 1e6 behind an optical depth of 16: 0.1125, where float32 subtracts 1e6 - 1e6."""
    depth = jnp.asarray([[16.0], [1.0]], jnp.float32)
    rgb = jnp.asarray([[[0.0]] * 3, [[1e6]] * 3], jnp.float32)
    got = pixels(fold(rgb, depth, BEHIND), BEHIND)
    assert np.allclose(got[:3], 1e6 * np.exp(-16), rtol=1e-6)


@pytest.mark.parametrize("opaque", [None, 1e4])
def test_pull_back_is_the_derivative_even_behind_an_opaque_piece(opaque):
    rgb, depth = pieces(0.2, n=12, dtype=np.float64)
    depth[8] = 1.5
    if opaque:
        depth[5] = opaque
    require_derivative(rgb, depth, BEHIND)


def test_float32_and_opaque_cells_have_the_image_and_the_gradient_of_front_to_back():
    """Of data that is constant in each cell: a jump between any two segments."""
    weights = jnp.asarray(np.random.default_rng(0).normal(size=(5, 6, 4)), jnp.float32)
    camera, transfer = registry.camera_of("float32"), registry.transfer_of("float32")
    segments = jaxvr.trace(registry.mesh_of("cell", "float32"), camera)
    options = {"xla_backend_optimization_level": 0}  # as in test_registry

    def found(over):
        def loss(transfer):
            image = jaxvr.shade(segments, transfer, compositor=over)
            return jnp.sum(weights * image), image

        gradient = jax.jit(jax.grad(loss, has_aux=True), compiler_options=options)
        return [gradient(transfer.scaled(s)) for s in (1.0, 1e4)]

    for (got, image), (want, same) in zip(found(BEHIND), found(Over()), strict=True):
        assert image.dtype == jnp.float32
        assert np.max(np.abs(image - same)) < 5e-7
        for x, y in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
            assert np.max(np.abs(x - y)) <= 2e-5 * np.max(np.abs(y))


def test_what_cannot_be_had_from_behind_is_said():
    mesh, camera = registry.mesh_of("point", "float64"), registry.camera_of("float64")
    transfer = registry.transfer_of("float64")
    with pytest.raises(ValueError, match="cannot end early"):
        Over(0.1, direction="back to front")
    sideways: Any = "sideways"
    with pytest.raises(ValueError, match=r"direction must be one of .* but is 'sideways'"):
        Over(direction=sideways)
    with pytest.raises(ValueError, match=r"engine=C\(\).*front to back"):
        segments, engine = jaxvr.trace(mesh, camera), jaxvr.engine.C()
        jaxvr.shade(segments, transfer, compositor=BEHIND, engine=engine)
    for tracer, compositor in ((Recorded(), BEHIND), (Recorded(reverse=True), Over())):
        pipeline = Pipeline(tracer, jaxvr.Analytic(), compositor)
        assert jaxvr.engine.C().refuses(pipeline, "float64") == "Its loops go front to back."


@pytest.mark.parametrize(
    "integrator", [jaxvr.Analytic("draft"), jaxvr.PreIntegration((16, 16, 8)), jaxvr.AverageColor()]
)
def test_a_slab_from_behind_is_the_slab_with_its_ends_exchanged(integrator):
    rng = np.random.default_rng(0)
    extinctions, colors = rng.uniform(0, 3, (2, 9)), rng.uniform(0, 1, (2, 9, 3))
    length = np.geomspace(1e-6, 10, 9)
    got = integrator.reversed().slab(*extinctions, *colors, length)
    want = integrator.slab(*extinctions[::-1], *colors[::-1], length)
    for x, y in zip(got, want, strict=True):
        assert np.allclose(x, y, rtol=1e-13, atol=1e-16)


def test_which_end_comes_first_is_for_the_compositor_to_say():
    mesh, camera = registry.mesh_of("point", "float64"), registry.camera_of("float64")
    transfer = registry.transfer_of("float64")
    for tracer in (jaxvr.RayCast(reverse=True), jaxvr.KBuffer(reverse=True)):
        with pytest.raises(ValueError, match="reverse=True, and which end comes first"):
            jaxvr.render(mesh, camera, transfer, tracer=tracer)
        with pytest.raises(ValueError, match="reverse=True, and which end comes first"):
            jaxvr.trace(mesh, camera, tracer=tracer)
        with pytest.raises(ValueError, match="reverse=True, and which end comes first"):
            jaxvr.probe(mesh, camera, transfer, tracer=tracer)


def test_a_termination_that_no_constructor_saw():
    mesh, camera = registry.mesh_of("point", "float64"), registry.camera_of("float64")
    transfer = registry.transfer_of("float64")

    @jax.jit
    def image(t):
        return jaxvr.render(mesh, camera, transfer, compositor=Over(termination=t))

    assert np.isfinite(image(0.5)).all()
    for t in (2.0, -1.0, np.nan):
        assert np.isnan(image(t)).all()
