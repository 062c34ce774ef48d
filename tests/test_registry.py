"""All tracers with all integrators, adjoints and kinds of field: one image, one gradient."""

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


KINDS = (registry.TRACERS, registry.INTEGRATORS, registry.COMPOSITORS, registry.ADJOINTS)
ENTRIES = {e.name: e for kind in KINDS for e in kind}
WEIGHTS = jnp.asarray(np.random.default_rng(1).normal(size=(5, 6, 4)))


def directional(image, args, tangents, adjoint: str):
    """The image, and the derivative of its sum under fixed weights along each of `tangents`: the
    numbers on which forward and reverse mode must agree."""

    def forward(args, tangent):
        return jax.jvp(image, (args,), (tangent,))

    def reverse(args):
        value, pull = jax.vjp(image, args)
        return value, pull(WEIGHTS)[0]

    if not ENTRIES[adjoint].reverse:
        compiled = quick.jit(forward)
        results = [compiled(args, t) for t in tangents]
        return np.asarray(results[0][0]), [
            float(jnp.sum(WEIGHTS * change)) for _, change in results
        ]
    value, bars = quick.jit(reverse)(args)

    def along(tangent):
        pairs = zip(jax.tree.leaves(bars), jax.tree.leaves(tangent), strict=True)
        return float(sum(jnp.sum(b * t) for b, t in pairs))

    return np.asarray(value), [along(t) for t in tangents]


def only_optical(tangents):
    """Along colours and extinctions only: what an approximation by a table must get right."""
    zero = jax.tree.map(jnp.zeros_like, tangents)
    is_transfer = [isinstance(t, jaxvr.TransferFunction) for t in tangents]
    which = is_transfer.index(True)
    positions, colors, extinctions = jax.tree.leaves(tangents[which])
    kept = jax.tree.unflatten(
        jax.tree.structure(tangents[which]), [jnp.zeros_like(positions), colors, extinctions]
    )
    return (*zero[:which], kept, *zero[which + 1 :])


@functools.cache
def derivative(
    tracer: str,
    integrator: str,
    adjoint: str,
    location: str,
    everything: bool,
    compositor: str = "Over",
):
    """Along all parameters at once, and along colours and extinctions. `everything`: points and
    camera too, not only values and transfer function."""
    mesh, args, tangents = setting(location)
    values, points, transfer, camera = args
    nouns = {
        "tracer": ENTRIES[tracer].make(),
        "integrator": ENTRIES[integrator].make(),
        "compositor": ENTRIES[compositor].make(),
        "adjoint": ENTRIES[adjoint].make(),
        "engine": ENTRIES[adjoint].engine,
    }

    def image(args):
        values, transfer, *geometry = args
        at, seen_by = geometry or (points, camera)
        return jaxvr.render(mesh.replace(values=values, points=at), seen_by, transfer, **nouns)

    order = (0, 2, 1, 3) if everything else (0, 2)
    args, tangents = tuple(args[i] for i in order), tuple(tangents[i] for i in order)
    return directional(image, args, (tangents, only_optical(tangents)), adjoint)


def compare(found, same_integrator, exact, entry):
    """All adjoints agree with one another, and integrators with `Analytic`, as far as they say."""
    image, slopes = found
    assert np.isfinite(image).all() and image[..., 3].max() > 0.3
    assert np.allclose(image, same_integrator[0], atol=1e-12)
    assert slopes == pytest.approx(same_integrator[1], rel=1e-9)
    if entry.error is None:
        assert np.allclose(image, exact[0], atol=1e-11)
        assert slopes == pytest.approx(exact[1], rel=1e-9)
    else:
        assert np.allclose(image, exact[0], atol=entry.error)
        assert slopes[1] == pytest.approx(exact[1][1], rel=entry.slope)


@pytest.mark.parametrize(
    "tracer, integrator, adjoint, location",
    list(registry.combinations()),
    ids=lambda x: x if isinstance(x, str) else x.name,
)
def test_same_image_and_gradient(tracer, integrator, adjoint, location):
    everything = integrator.name == "Analytic"  # integrators do not see geometry
    found = derivative(tracer.name, integrator.name, adjoint.name, location, everything)
    reference = tracer.follows or tracer.name
    # By one mode against another: what records for reverse mode is the slowest to compile.
    other = "Direct" if everything else "Forward"
    same = derivative(reference, integrator.name, other, location, everything)
    exact = derivative("RayCast", "Analytic", "Direct", location, everything)
    compare(found, same, exact, integrator)


@functools.cache
def shaded(integrator: str, adjoint: str, compositor: str = "Over", location: str = "point"):
    """Traced segments: derivatives with respect to their scalars and lengths too."""
    mesh, (_, _, transfer, camera), tangents = setting(location)
    segments = jaxvr.trace(mesh, camera)
    rng = np.random.default_rng(3)
    args = (segments.scalar, segments.length, transfer)
    moves = [jnp.asarray(rng.normal(size=x.shape)) for x in args[:2]]
    moves[1] = jnp.where(segments.length == 0, 0, moves[1])  # jumps of the scalar stay jumps
    names = {"integrator": integrator, "compositor": compositor, "adjoint": adjoint}
    nouns = {noun: ENTRIES[name].make() for noun, name in names.items()}
    nouns["engine"] = ENTRIES[adjoint].engine

    def image(args):
        scalar, length, transfer = args
        replaced = dataclasses.replace(segments, scalar=scalar, length=length)
        return jaxvr.shade(replaced, transfer, **nouns)

    tangents = (*moves, tangents[2])
    return directional(image, args, (tangents, only_optical(tangents)), adjoint)


@pytest.mark.parametrize(
    "integrator, adjoint",
    [(i, a) for i in registry.INTEGRATORS for a in registry.ADJOINTS if a.can(i)],
    ids=lambda x: x.name,
)
def test_same_shaded_image_and_gradient(integrator, adjoint):
    found = shaded(integrator.name, adjoint.name)
    compare(found, shaded(integrator.name, "Direct"), shaded("Analytic", "Direct"), integrator)


@pytest.mark.parametrize(
    "integrator, adjoint, location",
    [("Analytic", a.name, "corner") for a in registry.ADJOINTS if a.name != "compiled"]
    + [("ConstantExtinction", "Replay", "point")],
)
def test_shaded_back_to_front(integrator, adjoint, location):
    found = shaded(integrator, adjoint, "backwards", location)
    same = shaded(
        integrator, "compiled" if integrator == "Analytic" else "Direct", "Over", location
    )
    compare(found, same, same, ENTRIES["Analytic"])


@pytest.mark.parametrize("tracer", ["RayCast", "KBuffer"])
def test_back_to_front(tracer):
    found = derivative(tracer, "Analytic", "Replay", "corner", True, "backwards")
    same = derivative("RayCast", "Analytic", "compiled", "corner", True)
    compare(found, same, same, ENTRIES["Analytic"])


@pytest.mark.parametrize("adjoint", registry.ADJOINTS, ids=lambda x: x.name)
@pytest.mark.parametrize("how", ["render", "shade"])
def test_all_adjoints_end_rays_at_the_same_places(how, adjoint):
    entry = ENTRIES["ending"]

    def found(adjoint, compositor):
        if how == "shade":
            return shaded("Analytic", adjoint, compositor)
        # By points in test_termination.
        everything = compositor == "Over"  # which was computed for the others
        return derivative("RayCast", "Analytic", adjoint, "point", everything, compositor)

    (image, slopes), same = found(adjoint.name, "ending"), found("Direct", "ending")
    exact, _ = found("Direct", "Over")
    assert np.allclose(image, same[0], atol=1e-12)
    assert slopes == pytest.approx(same[1], rel=1e-9)
    assert 0.01 < np.max(np.abs(image - exact)) <= entry.error


@pytest.mark.parametrize("location", registry.MESHES)
def test_float32_follows_float64(location):
    mesh = registry.mesh_of(location, "float32")
    image = jaxvr.render(mesh, registry.camera_of("float32"), registry.transfer_of("float32"))
    assert image.dtype == jnp.float32
    want, _ = derivative("RayCast", "Analytic", "Direct", location, True)
    # Camera, points and field are rounded too: this is not the error of the renderer.
    assert np.max(np.abs(np.asarray(image) - want)) < 2e-5


@pytest.mark.parametrize("compositor", ["MaximumIntensity", "XRay", "depths"])
@pytest.mark.parametrize("adjoint", registry.ADJOINTS, ids=lambda x: x.name)
def test_all_adjoints_with_all_compositors(compositor, adjoint):
    (image, slopes), same = (shaded("Analytic", a, compositor) for a in (adjoint.name, "Direct"))
    assert np.isfinite(image).all() and np.abs(image[..., 0]).max() > 0.1
    assert np.allclose(image, same[0], atol=1e-12)
    assert slopes == pytest.approx(same[1], rel=1e-9, abs=1e-13)
