"""All tracers with all integrators, adjoints and kinds of field: one image, one gradient."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import registry

import jaxvr

DIRECTION_SEED = 7


@functools.cache
def setting(location: str):
    mesh = registry.mesh_of(location, "float64")
    args = (
        mesh.values,
        mesh.points,
        registry.transfer_of("float64"),
        registry.camera_of("float64"),
    )
    leaves, structure = jax.tree.flatten(args)
    rng = np.random.default_rng(DIRECTION_SEED)
    # Both points of the jump move together, or the transfer function would not stay one.
    tangents = [jnp.asarray(rng.normal(size=x.shape)) for x in leaves]
    tangents = jax.tree.unflatten(structure, tangents)
    positions = tangents[2].positions
    positions = positions.at[3].set(positions[2])
    transfer = jax.tree.unflatten(
        jax.tree.structure(tangents[2]),
        [positions, *jax.tree.leaves(tangents[2])[1:]],
    )
    return mesh, args, (*tangents[:2], transfer, tangents[3])


@functools.cache
def derivative(tracer: str, integrator: str, adjoint: str, location: str):
    """The image, and its derivative along one direction in all parameters at once, projected on
    fixed weights: the number on which forward and reverse mode must agree."""
    by_name = {e.name: e for e in registry.TRACERS + registry.INTEGRATORS + registry.ADJOINTS}
    mesh, args, tangents = setting(location)
    nouns = {
        "tracer": by_name[tracer].make(),
        "integrator": by_name[integrator].make(),
        "adjoint": by_name[adjoint].make(),
    }

    def image(args):
        values, points, transfer, camera = args
        return jaxvr.render(mesh.replace(values=values, points=points), camera, transfer, **nouns)

    weights = jnp.asarray(np.random.default_rng(1).normal(size=(5, 6, 4)))
    if by_name[adjoint].reverse:
        value, pull = jax.vjp(image, args)
        (bars,) = pull(weights)
        pairs = zip(jax.tree.leaves(bars), jax.tree.leaves(tangents), strict=True)
        return np.asarray(value), float(sum(jnp.sum(b * t) for b, t in pairs))
    value, tangent = jax.jvp(image, (args,), (tangents,))
    return np.asarray(value), float(jnp.sum(weights * tangent))


@pytest.mark.parametrize(
    "tracer, integrator, adjoint, location",
    list(registry.combinations()),
    ids=lambda x: x if isinstance(x, str) else x.name,
)
def test_same_image_and_gradient(tracer, integrator, adjoint, location):
    image, slope = derivative(tracer.name, integrator.name, adjoint.name, location)
    want_image, want_slope = derivative("RayCast", "Analytic", "Direct", location)
    assert np.isfinite(image).all() and image[..., 3].max() > 0.3
    assert np.allclose(image, want_image, atol=1e-11)
    assert slope == pytest.approx(want_slope, rel=1e-9)


@pytest.mark.parametrize("location", registry.MESHES)
def test_float32_follows_float64(location):
    mesh = registry.mesh_of(location, "float32")
    image = jaxvr.render(mesh, registry.camera_of("float32"), registry.transfer_of("float32"))
    assert image.dtype == jnp.float32
    want, _ = derivative("RayCast", "Analytic", "Direct", location)
    # Camera, points and field are rounded too: this is not the error of the renderer.
    assert np.max(np.abs(np.asarray(image) - want)) < 2e-5
