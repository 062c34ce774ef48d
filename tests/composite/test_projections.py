"""`XRay` and `MaximumIntensity`: against brute force, in both engines, with gradients; and what all
compositors promise: that what was cut can be merged. All adjoints are in test_registry."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import quick
import registry

import jaxvr
from jaxvr import MaximumIntensity, Over, XRay, native
from jaxvr.adjoint import Pipeline, replay
from jaxvr.adjoint.base import Operands
from jaxvr.composite import AbstractSum, Piece
from jaxvr.numerics import compensated
from jaxvr.optics import Segment
from jaxvr.testing import BruteForce, assert_gradients
from jaxvr.trace import RayCast
from jaxvr.view.rays import Rays, flat
from jaxvr.volume import datasets

EPS = {"float32": 1.2e-7, "float64": 2.3e-16}
ENGINES = [False, True]


def brute(mesh, origins, directions):
    """Integral, length and largest scalar of rays (R, 3), chord by chord; NaN of rays that miss."""
    pieces = BruteForce(mesh).pieces(origins, directions)
    length = (pieces.leave - pieces.enter).astype(np.float64)
    mean = (pieces.front + pieces.back).astype(np.float64) / 2
    count = len(origins)
    integral = np.bincount(pieces.ray, length * mean, count)
    chord = np.bincount(pieces.ray, length, count)
    largest = np.full(count, -np.inf)
    np.maximum.at(largest, pieces.ray, np.maximum(pieces.front, pieces.back).astype(np.float64))
    return integral, chord, largest


def ramp(low, high, dtype="float64"):
    """Of which red is the scalar itself, from 0 to 1."""
    colors = np.array([[0.0, 1.0, 0.2], [1.0, 0.0, 0.2]])
    return jaxvr.TransferFunction([low, high], colors, [0.0, 0.0], dtype=dtype)


@pytest.mark.parametrize("compiled", ENGINES)
@pytest.mark.parametrize("location", registry.MESHES)
def test_against_brute_force(location, compiled, dtype):
    mesh, camera = registry.mesh_of(location, dtype), registry.camera_of(dtype)
    origins, directions = (np.asarray(x).reshape(-1, 3) for x in camera.rays())
    integral, chord, largest = brute(mesh, origins, directions)
    hit = chord > 0
    assert 8 <= hit.sum() < 30
    engine = registry.engine_of(compiled)
    low, high = float(mesh.values.min()), float(mesh.values.max())

    def seen(compositor, transfer):
        image = jaxvr.render(mesh, camera, transfer, compositor=compositor, engine=engine)
        assert image.dtype == mesh.dtype
        return np.asarray(image, np.float64).reshape(-1, 4)

    small = 40 * EPS[dtype]
    got = seen(XRay(), None)
    assert np.max(np.abs(got[:, :3] - integral[:, None])) < small
    assert np.array_equal(got[:, 3], hit)
    # An extinction that is the scalar itself.
    itself = jaxvr.TransferFunction([0.0, 1.0], np.ones((2, 3)), [0.0, 1.0], dtype=dtype)
    assert 0 <= low < high <= 1
    depth = seen(XRay("optical depth"), itself)
    assert np.max(np.abs(depth[:, 0] - integral)) < small
    assert np.array_equal(depth[:, 3], hit)
    got = seen(MaximumIntensity(), ramp(low, high, dtype))
    want = np.where(hit, (largest - low) / (high - low), 0)
    assert np.max(np.abs(got[:, 0] - want)) < small
    assert np.array_equal(got[:, 3], hit)
    assert np.all(got[hit, 2] == np.float64(np.asarray(0.2, dtype)))


@pytest.mark.parametrize("compositor", [XRay(), XRay("optical depth"), MaximumIntensity()])
def test_gradients_by_differences(compositor):
    """Of compiled loops; that JAX's give the same is asked below and in test_registry."""
    mesh, camera = registry.mesh_of("corner", "float64"), registry.camera_of("float64")
    engine = jaxvr.engine.C()

    def image(values, points, camera, transfer):
        moved = mesh.replace(values=values, points=points)
        return jaxvr.render(moved, camera, transfer, compositor=compositor, engine=engine)

    operands = {"values": mesh.values, "points": mesh.points, "camera": camera}
    smooth = jaxvr.TransferFunction(
        [-0.5, 1.5], np.array([[0.1, 0.9, 0.4], [0.7, 0.2, 0.6]]), [0.3, 2.0], dtype="float64"
    )
    operands["transfer"] = smooth
    if compositor == XRay():
        operands.pop("transfer")

        def blind(values, points, camera):
            return image(values, points, camera, None)

        assert_gradients(blind, operands, rtol=1e-7, step=1e-4, orders=1, forward=False)
        return
    assert_gradients(image, operands, rtol=1e-7, step=1e-4, orders=1, forward=False)


@pytest.mark.parametrize("compositor", [XRay(), XRay("optical depth"), MaximumIntensity(), Over()])
def test_replay_by_the_other_engine(compositor):
    """The forward pass by one engine and the replay by the other, which rounds in its own way."""
    assert native.missing("float32") is None
    mesh, camera = registry.mesh_of("corner", "float32"), registry.camera_of("float32")
    transfer = registry.transfer_of("float32")
    integrator = compositor.default_integrator()
    pipeline = Pipeline(RayCast(), integrator, compositor)
    scene = pipeline.tracer.prepare(mesh)
    rays = pipeline.tracer.prepare_rays(scene, flat(Rays(*camera.rays())))
    rays = jax.tree.map(lambda x: x[None], rays)
    table = integrator.prepare(transfer, jnp.float32, pipeline.tracer.longest(scene))
    operands = Operands(scene, rays, table)
    rng = np.random.default_rng(0)

    def gradient(forward, backward, cotangent=None):
        forward, backward = (registry.engine_of(x) for x in (forward, backward))
        state, status = replay._run(forward, pipeline, operands)
        leaves, structure = jax.tree.flatten((pipeline, operands))
        assert not np.asarray(status).any()
        if cotangent is None:
            cotangent = jax.tree.map(
                lambda x: (
                    jnp.asarray(rng.normal(size=x.shape), x.dtype)
                    if jnp.issubdtype(x.dtype, jnp.floating)
                    else np.zeros(x.shape, jax.dtypes.float0)
                ),
                state,
            )
            if compositor == XRay("optical depth"):  # `finish` holds the length
                cotangent = cotangent._replace(length=(jnp.zeros_like(cotangent.length[0]),) * 2)
        asked = replay._flags([jnp.issubdtype(x.dtype, jnp.floating) for x in leaves])
        found = replay._backward(backward, structure, (leaves, state, asked), (cotangent, None))
        mesh_bar = structure.unflatten(found[0])[1].scene.mesh
        return (mesh_bar.values, mesh_bar.coordinates), cotangent

    want, cotangent = gradient(False, False)
    for forward, backward in ((True, False), (False, True), (True, True)):
        got, _ = gradient(forward, backward, cotangent)
        for g, w in zip(got, want, strict=True):
            assert np.max(np.abs(w)) > 0
            assert np.max(np.abs(g - w)) < 2e-5 * np.max(np.abs(w))


@pytest.mark.parametrize(
    "compositor", [Over(), Over(direction="back to front"), XRay(), MaximumIntensity()]
)
def test_what_was_cut_can_be_merged(compositor, dtype):
    """In two parts and in three, associated either way; of pieces that end segments or do not."""
    rng = np.random.default_rng(3)
    count, rays = 40, 64
    depth = rng.uniform(0, 0.2, (count, rays))
    rgb = rng.uniform(0, 1, (count, 3, rays)) * depth[:, None]
    length = np.where(rng.uniform(size=(count, rays)) < 0.2, 0, rng.uniform(size=(count, rays)))
    ends = rng.uniform(0.1, 1, size=(2, count, rays))
    last = rng.uniform(size=(count, rays)) < 0.7

    def fold(first, end):
        state = compositor.init(rays, dtype)
        order = range(first, end)
        for i in reversed(order) if compositor.backwards else order:
            numbers = (rgb[i], depth[i], ends[0, i], ends[1, i], length[i])
            r, d, f, g, h = (jnp.asarray(x, dtype) for x in numbers)
            state = compositor.add(state, Piece(r, d, Segment(f, g, h), jnp.asarray(last[i])))
        return state

    whole = fold(0, count)
    a, b = sorted(rng.integers(0, count + 1, 2))
    parts = fold(0, a), fold(a, b), fold(b, count)
    merge = compositor.merge
    for joined in (merge(merge(*parts[:2]), parts[2]), merge(parts[0], merge(*parts[1:]))):
        if compositor == MaximumIntensity():
            assert all(np.array_equal(x, y) for x, y in zip(joined, whole, strict=True))
            continue
        for x, y in zip(joined, whole, strict=True):
            x, y = compensated.value(x), compensated.value(y)
            assert np.max(np.abs(x - y)) <= 2 * EPS[dtype] * np.max(np.abs(y))


def test_offsets_and_units_come_back():
    """A field far from 0 in float32, and everything times powers of two."""
    camera = registry.camera_of("float32")
    near = registry.mesh_of("point", "float64")
    values = 101325 + 0.01 * np.asarray(near.values)
    far = registry.mesh_of("point", "float32").replace(values=values)
    assert far.offset
    exact = near.replace(values=values)
    want = jaxvr.render(exact, registry.camera_of("float64"), None, compositor=XRay())
    for compiled in ENGINES:
        engine = registry.engine_of(compiled)
        got = jaxvr.render(far, camera, None, compositor=XRay(), engine=engine)
        assert np.max(np.abs(got - want)) < 1e-6 * np.max(want)
        transfer = ramp(101325.0, 101325.01)
        red = jaxvr.render(far, camera, transfer, compositor=MaximumIntensity(), engine=engine)
        same = jaxvr.render(
            near.replace(values=values), camera, transfer, compositor=MaximumIntensity()
        )
        assert np.max(np.abs(red - same)) < 2e-5
    mesh = registry.mesh_of("point", "float32")
    plain = jaxvr.render(mesh, camera, None, compositor=XRay())
    larger = mesh.replace(values=mesh.values * 2.0**70)
    scaled = jaxvr.render(larger, camera, None, compositor=XRay())
    assert np.array_equal(scaled[..., 0], plain[..., 0] * 2.0**70)


@pytest.mark.parametrize("scalar, length", [(1e38, 1.0), (2e-30, 2.0**-27), (3.0, 2.0**-27)])
def test_integrals_near_the_ends_of_floats(scalar, length):
    """Right as long as they are floats; derivatives are right or NaN, and never lost."""
    mesh = datasets.box((2, 2, 2), dtype="float32")
    mesh = mesh.replace(points=mesh.points * np.float32(length))
    origins = np.array([[0.31, 0.47, -1.0]], np.float32) * np.float32(length)
    directions = np.array([[0.0, 0.0, 1.0]], np.float32)

    def integral(values):
        moved = mesh.replace(values=values)
        return jaxvr.render_rays(moved, origins, directions, None, compositor=XRay())[0, 0]

    values = jnp.full(mesh.values.shape, scalar, "float32")
    found, slope = jax.value_and_grad(integral)(values)
    assert np.allclose(found, np.float64(values[0]) * length, rtol=1e-6, atol=0)
    if scalar == 3:
        assert np.allclose(slope.sum(), length, rtol=1e-6, atol=0)
    else:
        assert np.isnan(slope).any()


def _render(mesh, camera, transfer, compositor):
    return jaxvr.render(mesh, camera, transfer, compositor=compositor)


def test_other_tracers_and_transforms():
    mesh, camera = registry.mesh_of("point", "float32"), registry.camera_of("float32")
    transfer = ramp(0.0, 1.0, "float32")
    for compositor in (XRay(), MaximumIntensity()):
        image = jaxvr.render(mesh, camera, transfer, compositor=compositor)
        same = [
            jaxvr.render(mesh, camera, transfer, compositor=compositor, tracer=jaxvr.KBuffer(8)),
            jaxvr.shade(jaxvr.trace(mesh, camera), transfer, compositor=compositor),
            jaxvr.render_rays(mesh, *camera.rays(), transfer, compositor=compositor),
            quick.jit(_render, static_argnums=3)(mesh, camera, transfer, compositor),
            # Cut at control points, the segments are the same.
            jaxvr.render(
                mesh, camera, transfer, compositor=compositor, integrator=jaxvr.AverageColor()
            ),
        ]
        for other in same:
            assert np.max(np.abs(other - image)) < 40 * EPS["float32"]


def test_the_eye_inside_sees_what_is_ahead():
    mesh = datasets.box((2, 2, 2), dtype="float64")
    values = np.asarray(mesh.points)[:, 0]
    mesh = mesh.replace(values=values)
    origins, directions = np.full((1, 3), 0.53), np.array([[1.0, 0.0, 0.0]])
    for sign, want in ((1.0, (1 - 0.53**2) / 2), (-1.0, 0.53**2 / 2)):
        got = jaxvr.render_rays(mesh, origins, sign * directions, None, compositor=XRay())
        assert np.allclose(got[0, 0], want, rtol=1e-14)
        red = jaxvr.render_rays(
            mesh, origins, sign * directions, ramp(0, 1), compositor=MaximumIntensity()
        )
        assert np.allclose(red[0, 0], 1.0 if sign > 0 else 0.53, rtol=1e-14)


@pytest.mark.parametrize("compiled", ENGINES)
def test_rays_through_vertices(compiled):
    """Of a constant field the integral is the chord, which no point inside has a part in. Cells
    that such rays only touch have segments of no length, whose derivatives count."""
    mesh = datasets.box((2, 2, 2), dtype="float64")
    mesh = mesh.replace(values=np.ones(len(mesh.points)))
    middle = np.abs(np.asarray(mesh.points) - 0.5).max(1) < 0.25
    assert middle.sum() == 1
    origins = np.array([[0.5, 0.5, -1.0], [-0.5, -0.5, -0.5], [0.5, 0.25, -1.0]])
    directions = np.array([[0.0, 0.0, 1.0], [1.0, 1.0, 1.0], [0.0, 0.0, 1.0]])

    def chords(points):
        moved = mesh.replace(points=points)
        engine = registry.engine_of(compiled)
        return jaxvr.render_rays(
            moved, origins, directions, None, compositor=XRay(), engine=engine
        )[:, 0]

    got, pull_back = jax.vjp(chords, mesh.points)
    assert np.allclose(got, [1, np.sqrt(3), 1], rtol=1e-14)
    for ray in range(3):
        (slope,) = pull_back(jnp.zeros(3).at[ray].set(1.0))
        assert np.max(np.abs(slope)) > 0.1
        assert np.max(np.abs(np.asarray(slope)[middle])) < 1e-12


def test_of_colours_alone():
    """A compositor that sees no optical depth has no cotangent of it."""

    @dataclasses.dataclass(frozen=True)
    class Light(AbstractSum):
        needs = frozenset({"rgb"})  # pyright: ignore[reportAssignmentType]

        def default_integrator(self):
            return jaxvr.Analytic()

        def init(self, rays, dtype):
            return jnp.zeros((3, rays), dtype)

        def add(self, state, piece):
            return state + piece.rgb

        def finish(self, state, transfer, scale):
            return jnp.concatenate([state, jnp.ones_like(state[:1])])

        def merge(self, front, back):
            return front + back

    mesh = registry.mesh_of("point", "float64")
    segments = jaxvr.trace(mesh, registry.camera_of("float64"))
    transfer = registry.transfer_of("float64")

    def total(colors, adjoint):
        moved = transfer.replace(colors=colors)
        return jaxvr.shade(segments, moved, compositor=Light(), adjoint=adjoint)[..., :3].sum()

    by = [jax.grad(total)(transfer.colors, a) for a in (jaxvr.Replay(), jaxvr.Direct(64))]
    assert np.max(np.abs(by[1])) > 0.1
    assert np.allclose(*by, rtol=1e-12)


def test_extinctions_are_fitted_through_optical_depths():
    """Whose pictures are no colours: that they are above 1, and above alpha, is not warned of."""
    mesh, camera = registry.mesh_of("point", "float32"), registry.camera_of("float32")
    target = jaxvr.TransferFunction([0.0, 1.0], np.ones((2, 3)), [3.0, 6.0], dtype="float32")
    image = jaxvr.render(mesh, camera, target, compositor=XRay("optical depth"))
    assert image.max() > 2
    result = jaxvr.fit(
        *(target.replace(extinctions=[4.0, 4.0]), mesh, camera, image),
        compositor=XRay("optical depth"),
        free="extinctions",
        loss="l2",
        iterations=40,
        learning_rate=0.1,
        progress=False,
    )
    assert result.loss_history[-1] < 0.1 * result.loss_history[0]


@pytest.mark.parametrize("compiled", ENGINES)
def test_a_scalar_that_is_none_is_seen(compiled):
    """Under jit, where nobody can refuse them: rays that meet a NaN have no colour, others theirs,
    whatever lies before and behind it."""
    mesh = datasets.box((3, 3, 3), dtype="float64")
    points = np.asarray(mesh.points)
    origins, directions = np.array([[0.31, 0.37, -1.0], [0.9, 0.9, -1.0]]), np.zeros((2, 3))
    directions[:] = 0.01, 0.007, 1.0
    engine = registry.engine_of(compiled)

    @quick.jit
    def red(values):
        moved, transfer = mesh.replace(values=values), ramp(0, 1)
        how = {"compositor": MaximumIntensity(), "engine": engine}
        return jaxvr.render_rays(moved, origins, directions, transfer, **how)[:, 0]

    fine = red(mesh.values)
    for place in ([1 / 3] * 3, [1 / 3, 1 / 3, 0], [1 / 3, 1 / 3, 1]):
        at = np.argmin(np.abs(points - place).sum(1))
        got = red(mesh.values.at[at].set(jnp.nan))
        assert np.isnan(got[0]) and got[1] == fine[1]


def test_colours_are_fitted_through_the_maximum():
    mesh, camera = registry.mesh_of("point", "float32"), registry.camera_of("float32")
    target = ramp(0.0, 1.0, "float32")
    image = jaxvr.render(mesh, camera, target, compositor=MaximumIntensity())
    start = target.replace(colors=np.full((2, 3), 0.5))
    result = jaxvr.fit(
        *(start, mesh, camera, image),
        compositor=MaximumIntensity(),
        free="colors",
        loss="l2",
        iterations=60,
        learning_rate=0.5,
        progress=False,
    )
    assert result.loss_history[-1] < 0.02 * result.loss_history[0]


def test_what_is_not_needed_is_not_given():
    """Else it would be 0, or without its derivative, where it is looked at all the same."""
    mesh, camera = registry.mesh_of("point", "float32"), registry.camera_of("float32")
    transfer = registry.transfer_of("float32")

    class Blind(MaximumIntensity):
        @property
        def needs(self):
            return frozenset({"scalar"})

    class Weighted(XRay):
        @property
        def needs(self):
            return frozenset({"optical_depth"})

        def add(self, state, piece):
            length = piece.segment.length
            weighted = piece._replace(optical_depth=piece.optical_depth * length)
            return super().add(state, weighted)

    for compositor, error in ((Blind(), TypeError), (Weighted("optical depth"), AttributeError)):
        for compiled in (None, False):
            with pytest.raises(error, match="None"):
                engine = registry.engine_of(compiled)
                jaxvr.render(mesh, camera, transfer, compositor=compositor, engine=engine)


@pytest.mark.outside("bluntfin.vtu")
@pytest.mark.optimised
@pytest.mark.filterwarnings("ignore:115 degenerate")
def test_on_a_real_mesh(data_path):
    mesh = jaxvr.read_mesh(data_path("bluntfin.vtu"), "density", dtype="float64")
    camera = jaxvr.Camera.orbit(mesh, width=20, height=15, dtype="float64")
    integral, chord, largest = brute(mesh, *(np.asarray(x).reshape(-1, 3) for x in camera.rays()))
    got = np.asarray(jaxvr.render(mesh, camera, None, compositor=XRay())).reshape(-1, 4)
    assert (chord > 0).sum() > 40
    assert np.max(np.abs(got[:, 0] - integral)) < 1e-13 * integral.max()
    low, high = float(mesh.values.min()), float(mesh.values.max())
    red = jaxvr.render(mesh, camera, ramp(low, high), compositor=MaximumIntensity())
    want = np.where(chord > 0, (largest - low) / (high - low), 0)
    assert np.max(np.abs(np.asarray(red)[..., 0].ravel() - want)) < 1e-14


def test_what_cannot_be_is_said():
    mesh, camera = registry.mesh_of("point", "float64"), registry.camera_of("float64")
    transfer = registry.transfer_of("float64")
    wrong: Any = "density"
    with pytest.raises(ValueError, match=r"of must be one of \['scalar', 'optical depth'\]"):
        XRay(wrong)
    none: Any = None
    for compositor in (Over(), MaximumIntensity(), XRay("optical depth")):
        with pytest.raises(
            ValueError, match=r"transfer must be a jaxvr.TransferFunction, but is a None"
        ):
            jaxvr.render(mesh, camera, none, compositor=compositor)
    for compositor in (Over(), XRay("optical depth")):
        blind = XRay().default_integrator()
        with pytest.raises(ValueError, match="composites light, and Unshaded"):
            jaxvr.render(mesh, camera, transfer, compositor=compositor, integrator=blind)
    with pytest.raises(ValueError, match=r"XRay\(of='scalar'\) does not look at the transfer"):
        jaxvr.fit(transfer, mesh, camera, np.zeros((5, 6, 4)), compositor=XRay())
    depths = XRay("optical depth")
    with pytest.raises(ValueError, match=r"does not look at colors, .* free=\('extinctions',\)"):
        jaxvr.fit(transfer, mesh, camera, np.zeros((5, 6, 4)), compositor=depths)
    with pytest.raises(ValueError, match="Over composites light, and Unshaded"):
        jaxvr.probe(mesh, camera, transfer, integrator=XRay().default_integrator())

    class Bare:
        def finish(self, state, transfer, scale): ...

    with pytest.raises(ValueError, match="compositor is a Bare, which has no needs, .*done"):
        jaxvr.render(mesh, camera, transfer, compositor=Bare())  # pyright: ignore
    with pytest.raises(ValueError, match=r"MaximumIntensity\(\) does not look at extinctions"):
        jaxvr.fit(transfer, mesh, camera, np.zeros((5, 6, 4)), compositor=MaximumIntensity())
    away = jaxvr.Camera.look_at((3, 3, 3), (6, 6, 6), width=4, height=4)
    with pytest.warns(jaxvr.ViewWarning, match="blank. The volume lies behind the camera"):
        jaxvr.render(mesh, away, None, compositor=XRay())
    # Optical depths hide nothing, however large they are: no warning of opacities.
    large = mesh.replace(points=1000 * mesh.points)
    view = jaxvr.Camera.orbit(large, width=4, height=4)
    thick = jaxvr.TransferFunction([0.0, 1.0], np.ones((2, 3)), [0.9, 0.9])
    with pytest.warns(jaxvr.ViewWarning, match="One cell hides what is behind it"):
        jaxvr.render(large, view, thick)
    jaxvr.render(large, view, thick, compositor=depths)
