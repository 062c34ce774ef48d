"""Volumes, tracers and cameras of another maker, as notebooks/contribute.md prints them: they go
wherever the package's own go, with all derivatives, and what does not fit is refused in words."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import quick
import registry
from recipes import lengths, recipes

import jaxvr
from jaxvr._core.status import check
from jaxvr.interact.viewer import Viewer
from jaxvr.trace import AbstractTracer, Store
from jaxvr.volume import AbstractVolume

pytestmark = pytest.mark.usefixtures("quick_code")

SIZE = {"width": 6, "height": 5}


def name_of(entry: registry.Entry) -> str:
    return entry.name


def field(x, y, z):
    return np.exp(-2 * ((x - 0.1) ** 2 + 0.8 * y**2 + 1.2 * (z + 0.05) ** 2))


def grid_of(dtype: str, of: Any = field, nodes: tuple[int, int, int] = (6, 5, 7)) -> Any:
    """Over [-1, 1]^3, with spacings that differ."""
    axes = [np.linspace(-1, 1, n) for n in nodes]
    values = of(*np.meshgrid(*axes, indexing="ij"))
    spacing = [2 / (n - 1) for n in nodes]
    arrays = (jnp.asarray(x, dtype) for x in (values, spacing, [-1.0] * 3))
    return recipes().Samples(*arrays)


def transfer_of(dtype: str) -> jaxvr.TransferFunction:
    colors = np.eye(4)[:, :3] * 0.7 + 0.2
    return jaxvr.TransferFunction([0.05, 0.3, 0.6, 0.95], colors, [0.5, 3, 1, 4], dtype=dtype)


def camera_of(volume: Any) -> jaxvr.Camera:
    return jaxvr.Camera.orbit(volume, 25.0, 15.0, zoom=1.3, **SIZE)


def linear(x, y, z):
    return 0.4 + 0.2 * x - 0.13 * y + 0.07 * z


def test_recipes_are_short():
    found = lengths()
    assert found["March"] <= 130  # with its volume
    assert found["AllCells"] <= 110 and found["Panorama"] <= 60 and found["Mean"] <= 60


# The grid, as far as something independent knows it: a linear field is linear on each ray.


@pytest.mark.parametrize("compositor", ["Over", "MaximumIntensity", "XRay", "depths"])
def test_a_grid_is_the_picture_of_a_mesh_with_the_same_linear_field(dtype, compositor):
    grid = grid_of(dtype, linear)
    box = jaxvr.datasets.box((1, 1, 1), dtype=dtype)
    points = 2 * np.asarray(box.points, np.float64) - 1
    mesh = box.replace(points=points).replace(values=linear(*points.T), location="point")
    camera, transfer = camera_of(grid), transfer_of(dtype)
    made = {e.name: e.make for e in registry.COMPOSITORS}[compositor]()
    images = [
        np.asarray(jaxvr.render(volume, camera, transfer, compositor=made))
        for volume in (grid, mesh)
    ]
    assert images[0].dtype == dtype and images[1][..., 3].max() > 0.5
    bound = 1e-12 if dtype == "float64" else 5e-6
    assert np.allclose(*images, rtol=0, atol=bound * max(1, images[1].max()))


def test_the_integral_of_a_grid_is_that_of_its_chords():
    grid = grid_of("float64", linear)
    camera = camera_of(grid)
    image = np.asarray(jaxvr.render(grid, camera, None, compositor=jaxvr.XRay()))
    origins, along = (np.asarray(x) for x in camera.rays())
    one, other = (-1 - origins) / along, (1 - origins) / along
    enter, leave = np.minimum(one, other).max(-1), np.maximum(one, other).min(-1)
    length = np.maximum(leave - enter, 0)
    middle = origins + ((enter + leave) / 2)[..., None] * along
    want = np.where(length > 0, length * linear(*np.moveaxis(middle, -1, 0)), 0)
    assert np.allclose(image[..., 0], want, rtol=0, atol=1e-13)
    assert ((image[..., 3] == 1) == (length > 0)).all()


# Derivatives.


@functools.cache
def slopes(compositor: str, adjoint: str) -> tuple[Any, float, float, list[float]]:
    """An image, the derivative along one direction of everything, that by differences, and those
    along values, spacing, corner, eye and transfer function by themselves."""
    grid = grid_of("float64")
    camera, transfer = camera_of(grid), transfer_of("float64")
    parts = (grid.values, grid.spacing, grid.corner, camera.eye, transfer)
    entries = {e.name: e.make for e in (*registry.COMPOSITORS, *registry.ADJOINTS)}
    nouns = {"compositor": entries[compositor](), "adjoint": entries[adjoint]()}
    rng = np.random.default_rng(3)
    weights = jnp.asarray(rng.normal(size=(5, 6, 4)))
    moves = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), parts)

    def image(parts):
        values, spacing, corner, eye, transfer = parts
        volume = grid.replace(values=values, spacing=spacing, corner=corner)
        return jaxvr.render(volume, camera.replace(eye=eye), transfer, **nouns)

    def at(step):
        return jax.tree.map(lambda x, u: x + step * u, parts, moves)

    def along(step):
        return jnp.sum(weights * image(at(step)))

    plain = quick.jit(along)
    e = 1e-6
    difference = float(plain(e) - plain(-e)) / (2 * e)
    if not {e.name: e for e in registry.ADJOINTS}[adjoint].reverse:
        forward = quick.jit(lambda step: jax.jvp(along, (step,), (1.0,))[1])
        return np.asarray(image(parts)), float(forward(0.0)), difference, []
    picture, pull = quick.jit(lambda p: (lambda y, f: (y, f(weights)[0]))(*jax.vjp(image, p)))(
        parts
    )
    shares = [
        float(sum(jnp.vdot(a, b) for a, b in zip(*map(jax.tree.leaves, pair), strict=True)))
        for pair in zip(pull, moves, strict=True)
    ]
    return np.asarray(picture), sum(shares), difference, shares


@pytest.mark.parametrize("adjoint", [a for a in registry.ADJOINTS if not a.only], ids=name_of)
@pytest.mark.parametrize(
    "compositor", [c for c in registry.COMPOSITORS if not c.make().backwards], ids=name_of
)
def test_derivatives_of_a_grid(compositor, adjoint):
    """By values, spacing and corner, eye and transfer function: those of differences, and the same
    by all adjoints."""
    image, slope, difference, shares = slopes(compositor.name, adjoint.name)
    same = slopes(compositor.name, "Direct")
    assert np.allclose(image, same[0], rtol=0, atol=1e-13) and image[..., 3].max() > 0.3
    # Where rays end early, the truncated picture steps as they end elsewhere; not within this step.
    assert slope == pytest.approx(difference, rel=1e-7)
    assert shares == pytest.approx(same[3], rel=1e-10) if shares else True
    if adjoint.reverse:
        assert all(shares[:4]) and bool(shares[4]) == compositor.make().reads_transfer


def test_derivatives_in_float32_follow():
    def slope(dtype):
        grid = grid_of(dtype)
        camera, transfer = camera_of(grid), transfer_of(dtype)

        def total(values):
            return jaxvr.render(grid.replace(values=values), camera, transfer).sum()

        return np.asarray(quick.jit(jax.grad(total))(grid.values))

    single, double = slope("float32"), slope("float64")
    assert single.dtype == np.float32
    assert np.allclose(single, double, rtol=0, atol=2e-5 * np.abs(double).max())


def test_all_cells_is_ray_casting(dtype):
    """Another tracer of meshes: the same picture and the same derivatives, by points too."""
    mesh = jaxvr.datasets.box((2, 2, 2), jitter=0.2, seed=1, dtype=dtype)
    camera, transfer = registry.camera_of(dtype), registry.transfer_of(dtype)

    def total(points, values, camera, tracer):
        volume = mesh.replace(points=points, values=values)
        return jaxvr.render(volume, camera, transfer, tracer=tracer)[..., :3].sum()

    slopes = quick.jit(jax.value_and_grad(total, (0, 1, 2)), static_argnums=3)
    both = [
        slopes(mesh.points, mesh.values, camera, tracer)
        for tracer in (recipes().AllCells(), jaxvr.RayCast())
    ]
    bound = 1e-9 if dtype == "float64" else 2e-3
    assert float(both[0][0]) == pytest.approx(float(both[1][0]), rel=bound)
    for a, b in zip(*(jax.tree.leaves(x[1]) for x in both), strict=True):
        assert a.dtype == dtype
        assert np.allclose(a, b, rtol=0, atol=bound * np.abs(b).max())


# Verbs.


def test_verbs_take_a_grid(tmp_path):
    grid = grid_of("float32")
    camera, transfer = camera_of(grid), transfer_of("float32")
    image = np.asarray(jaxvr.render(grid, camera, transfer))
    segments = jaxvr.trace(grid, camera)
    assert np.allclose(jaxvr.shade(segments, transfer), image, atol=1e-6)
    back = jaxvr.Over(direction="back to front")
    assert np.allclose(jaxvr.shade(segments, transfer, compositor=back), image, atol=1e-6)
    origins, directions = camera.rays()
    longer = jaxvr.render_rays(grid, origins, 3 * directions, transfer)
    assert np.allclose(longer, image, atol=1e-5)
    found = jaxvr.probe(grid, camera, transfer)
    assert np.allclose(found.rgba.reshape(image.shape), image, atol=1e-6)
    low, high = (np.asarray(x) for x in grid.bounds())
    at = found.positions.reshape(-1, 3)
    assert (at > low - 1e-5).all() and (at < high + 1e-5).all() and len(at) > 100
    assert found.cells.max() < grid.values.size
    start = jaxvr.default_transfer(grid)
    assert start.dtype == np.float32
    assert start.absolute_positions()[-1] <= grid.value_range()[1]
    movie = jaxvr.turntable(grid, start, frames=1, width=4, height=3, progress=False)
    assert movie.shape == (1, 3, 4, 3)
    table = jaxvr.PreIntegration((8, 8, 4))  # which asks for the longest segment
    assert np.isfinite(jaxvr.render(grid, camera, transfer, integrator=table)).all()


def test_a_viewer_of_a_grid():
    viewer = Viewer(grid_of("float32"), size=8)
    assert viewer.chosen_up == "y" and viewer.setup()["field"] == "values"
    assert sum(viewer.setup()["counts"]) == 6 * 5 * 7
    assert viewer.image.shape == (8, 8, 4) and viewer.image[..., 3].max() > 0.1


@pytest.mark.parametrize("cache", [True, False])
def test_a_fit_to_pictures_of_a_grid(cache, quick_jit):
    grid = grid_of("float32")
    panorama = recipes().Panorama(jnp.zeros(3), width=8, height=4)
    cameras = [camera_of(grid), panorama]
    truth = transfer_of("float32")
    targets = [np.asarray(jaxvr.render(grid, c, truth)) for c in cameras[:1]]
    with pytest.warns(jaxvr.ViewWarning, match="starts inside the volume's box"):
        targets.append(np.asarray(jaxvr.render(grid, panorama, truth)))
    start = jaxvr.TransferFunction(truth.positions, np.full((4, 3), 0.4), np.full(4, 2.0))
    result = jaxvr.fit(
        *(start, grid, cameras, targets), iterations=60, cache=cache, progress=False, loss="l2"
    )
    assert result.loss_history[-1] < 0.1 * result.loss_history[0]
    assert [x.shape for x in result.images] == [(5, 6, 4), (4, 8, 4)]


# Cameras.


class Given:
    """A camera that is no pytree, and gives what it is given."""

    def __init__(self, origins, directions, height=5, width=6):
        self.given, self.height, self.width = (origins, directions), height, width

    def rays(self):
        return self.given


def test_any_camera_gives_what_its_rays_give(dtype):
    mesh, transfer = registry.mesh_of("point", dtype), registry.transfer_of(dtype)
    camera = registry.camera_of(dtype)
    image = jaxvr.render(mesh, camera, transfer)
    same = jaxvr.render(mesh, Given(*camera.rays()), transfer)
    # Quick code rounds rays in another way within a compiled function than without.
    assert np.allclose(image, same, rtol=0, atol=1e-14 if dtype == "float64" else 5e-6)
    segments = [jaxvr.trace(mesh, c) for c in (camera, Given(*camera.rays()))]
    assert segments[0].shape == segments[1].shape == (5, 6)
    assert segments[0].count == segments[1].count
    probes = [jaxvr.probe(mesh, c, transfer, (2, 3)) for c in (camera, Given(*camera.rays()))]
    assert np.allclose(probes[0].scalars, probes[1].scalars, atol=1e-5)


def test_derivatives_by_a_fisheye():
    mesh, transfer = registry.mesh_of("point", "float64"), registry.transfer_of("float64")
    eye, move = jnp.asarray([0.45, 0.55, 1.9]), jnp.asarray([0.3, -0.5, 0.7])

    def total(step, turn):
        camera = recipes().Fisheye(eye + step * move, 120.0 + turn, 6, 5)
        return jaxvr.render(mesh, camera, transfer)[..., :3].sum()

    found = [float(x) for x in quick.jit(jax.grad(total, (0, 1)))(0.0, 0.0)]
    plain = quick.jit(total)
    for k, e in ((0, 1e-6), (1, 1e-5)):
        step = [e * (k == 0), e * (k == 1)]
        difference = (plain(*step) - plain(*(-x for x in step))) / (2 * e)
        assert found[k] == pytest.approx(float(difference), rel=1e-6) and found[k] != 0


def test_rays_of_recipes_are_unit_and_look_ahead():
    for camera in (
        recipes().Fisheye(jnp.zeros(3), 180.0, 7, 7),
        recipes().Panorama(jnp.zeros(3), 7, 7),
    ):
        origins, directions = (np.asarray(x) for x in camera.rays())
        assert origins.shape == directions.shape == (7, 7, 3)
        assert np.allclose(np.linalg.norm(directions, axis=-1), 1)
        assert np.allclose(directions[3, 3], [0, 0, -1])
        assert directions[0, 3, 1] > 0.9 and directions[3, -1, 0] > 0.4


def test_a_camera_of_another_maker_far_from_zero():
    """Its rays are the world's: in float64 they keep their digits, in float32 they are told of."""
    near, place = registry.mesh_of("point", "float32"), [4.1e6, -2.3e6, 0.7e6]
    far = near.replace(points=np.asarray(registry.mesh_of("point", "float64").points) + place)
    transfer = registry.transfer_of("float32")
    origins, directions = (np.asarray(x, np.float64) for x in registry.camera_of("float64").rays())
    assert any(far.origin)
    moved = origins + place
    want = np.asarray(jaxvr.render(near, Given(origins, directions), transfer))
    found = np.asarray(jaxvr.render(far, Given(moved, directions), transfer))
    assert want[..., 3].max() > 0.3 and np.allclose(found, want, rtol=0, atol=1e-4)
    with pytest.warns(UserWarning, match="origins are float32, with steps of 0.25 beside a volume"):
        jaxvr.render(far, Given(moved.astype("float32"), directions), transfer, status=True)


# Hints, as far as a volume and a camera can answer.


def test_hints_for_cameras_that_only_have_rays():
    grid, transfer = grid_of("float32"), transfer_of("float32")
    away = recipes().Fisheye(jnp.asarray([0.0, 0.0, -3.0]), 60.0, 6, 5)
    with pytest.warns(jaxvr.ViewWarning, match="blank. None of the camera's rays meets the volume"):
        jaxvr.render(grid, away, transfer)
    towards = dataclasses.replace(away, eye=jnp.asarray([0.0, 0.0, 3.0]))
    assert np.asarray(jaxvr.render(grid, towards, transfer))[..., 3].max() > 0.3  # without a word
    mesh = registry.mesh_of("point", "float32")
    with pytest.warns(jaxvr.ViewWarning, match=r"None .* whose box reaches from \(0, 0, 0\)"):
        jaxvr.render(mesh, away, registry.transfer_of("float32"))


def test_hints_for_a_grid():
    grid = grid_of("float32")
    camera, transfer = camera_of(grid), transfer_of("float32")
    behind = jaxvr.Camera.look_at((0, 0, 4), (0, 0, 8), **SIZE)
    with pytest.warns(jaxvr.ViewWarning, match="The volume lies behind the camera"):
        jaxvr.render(grid, behind, transfer)
    inside = jaxvr.Camera.look_at((0, 0, 0.5), (0, 0, 0), **SIZE)
    with pytest.warns(jaxvr.ViewWarning, match="The camera's eye lies inside the volume's box"):
        jaxvr.render(grid, inside, transfer)
    other = jaxvr.TransferFunction([100, 200], np.eye(3)[:2], [1, 2])
    with pytest.warns(jaxvr.ViewWarning, match="The field lies from 0.* the control points .* 100"):
        jaxvr.render(grid, camera, other)
    opaque = jaxvr.TransferFunction([0, 1], np.eye(3)[:2], [0.1, 0.9])
    large = grid.replace(spacing=grid.spacing * 1000, corner=grid.corner * 1000)
    with pytest.warns(jaxvr.ViewWarning, match="One cell hides what is behind it"):
        jaxvr.render(large, camera_of(large), opaque)
    with pytest.warns(jaxvr.ViewWarning, match="1 of 2 cameras do not see the volume"):
        targets = [np.zeros((5, 6, 4), "float32")] * 2
        jaxvr.fit(transfer, grid, [camera, behind], targets, iterations=1, progress=False)


# What does not fit.


def test_refusals_in_words():
    grid, mesh = grid_of("float32"), registry.mesh_of("point", "float32")
    camera, transfer = camera_of(grid), transfer_of("float32")
    word: Any = "front"
    none: Any = None

    def refused(match, volume=grid, view: Any = camera, **nouns):
        for verb in (
            lambda: jaxvr.render(volume, view, transfer, **nouns),
            lambda: jaxvr.trace(volume, view, **nouns),
            lambda: jaxvr.probe(volume, view, transfer, **nouns),
        ):
            with pytest.raises(ValueError, match=match):
                verb()

    for tracer in (jaxvr.RayCast(), jaxvr.KBuffer(4), recipes().AllCells()):
        name = type(tracer).__name__
        refused(rf"{name} traces a TetMesh, and volume is a Samples.*March\(", tracer=tracer)
    refused("tracer is a Half, which has no start, step, longest: derive", tracer=Half())
    refused(r"March traces a Samples, and volume is a TetMesh.*RayCast\(\)", mesh, tracer=march())
    with pytest.raises(ValueError, match="measure_k takes a TetMesh .* given a Samples"):
        jaxvr.measure_k(grid, camera)
    with pytest.raises(ValueError, match="exact_order orders the faces of a TetMesh, not of a Sam"):
        jaxvr.order.exact_order(grid, camera)
    with pytest.raises(ValueError, match="March gives the nearest segments first"):
        back = jaxvr.Over(direction="back to front")
        jaxvr.render(grid, camera, transfer, compositor=back)

    refused("camera must be a jaxvr.Camera, but is a str.*rays", view=word)
    refused("camera must be .* but is <class.*Given", view=Given)
    rays = camera.rays()
    refused(r"Given.height and Given.width must be .* 5 and None", view=Given(*rays, width=none))
    refused(r"rays of shape \(5, 6\), but Given is 4 x 6", view=Given(*rays, height=4))
    refused(r"origins must have shape \(\.\.\., 3\)", view=Given(rays[0][..., :2], rays[1]))
    refused("directions has 90 NaN", view=Given(rays[0], rays[1] * np.nan))
    three = Given(*rays)
    three.given = (*rays, None)  # type: ignore[assignment]
    refused(r"Given.rays\(\) must give two arrays", view=three)
    with pytest.raises(ValueError, match=r"cameras\[1\] must be a jaxvr.Camera or jaxvr.Segments"):
        jaxvr.fit(transfer, grid, [camera, word], [], progress=False)


class Half:
    def prepare(self, volume):
        return volume

    def prepare_rays(self, scene, rays):
        return rays


def march() -> Any:
    return recipes().March()


def test_volumes_that_lack_something():
    grid = grid_of("float32")
    camera, transfer = camera_of(grid), transfer_of("float32")

    def refused(volume, match):
        with pytest.raises(ValueError, match=match):
            jaxvr.render(volume, camera, transfer)

    refused(Loose(grid.values), "jaxvr.TetMesh, but is a Loose.*derives from .*AbstractVolume")
    with pytest.raises(TypeError, match="abstract.*Boundless.*bounds"):
        Boundless(grid.values)  # type: ignore[abstract]
    refused(Unnamed(grid.values), "Unnamed.lengths must name the fields")
    named = Misnamed(grid.values)
    for names, match in (
        ("values", r"Misnamed.lengths must be a tuple of names, \('values',\), but is a string"),
        (("spacing",), "Misnamed.lengths names 'spacing', which Misnamed has not"),
        (("values",), "must name a field once, but name 'values' 2 times"),
    ):
        Misnamed.lengths = names  # type: ignore[assignment]
        refused(named, match)
    refused(grid.replace(spacing=0.25), "Samples.spacing is float, but .* must be arrays")
    refused(grid.replace(spacing=grid.spacing.astype("float64")), "Samples.spacing is float64")
    refused(grid.replace(values=grid.values.astype("int32")), "must be arrays of one dtype")
    refused(grid.replace(corner=grid.corner * np.inf), "Samples.corner has 3 NaN or infinite")
    refused(grid.replace(values=grid.values.at[0, 1, 2].set(np.nan)), r"values has 1 .*\(0, 1, 2\)")
    refused(Placed(grid.values, grid.spacing, grid.corner, grid.corner), "origin must be three pla")

    @jax.jit
    def draw(spacing):
        return jaxvr.render(grid.replace(spacing=spacing), camera, transfer)

    assert np.isfinite(draw(grid.spacing)).all()
    assert np.isnan(draw(grid.spacing * np.nan)).all()  # and not blank
    bits = jax.jit(
        lambda s: jaxvr.render(grid.replace(spacing=s), camera, transfer, status=True)[1]
    )(grid.spacing * np.nan)
    with pytest.raises(jaxvr.RenderError):
        check(bits)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Loose:
    values: Any


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Boundless(AbstractVolume):
    values: Any

    def default_tracer(self):
        return march()


class Unnamed(Boundless):
    def bounds(self):
        return np.zeros(3), np.ones(3)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Misnamed(Unnamed):
    scalars = ("values",)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Placed(AbstractVolume):
    lengths, scalars = ("spacing", "corner"), ("values",)

    values: Any
    spacing: Any
    corner: Any
    origin: Any

    def bounds(self):
        return self.corner, self.corner

    def default_tracer(self):
        return march()


@dataclasses.dataclass(frozen=True)
class OneWay(AbstractTracer):
    """A tracer whose steps can be differentiated, and nothing else."""

    def prepare(self, volume):
        return march().prepare(volume)

    def prepare_rays(self, scene, rays):
        return march().prepare_rays(scene, rays)

    def start(self, scene, rays):
        return march().start(scene, rays)

    def step(self, scene, rays, state, move):
        return march().step(scene, rays, state, move)


def test_a_tracer_without_a_way_back():
    """Reverse mode by the volume is an error, and no 0; what needs no way back, works."""
    grid = grid_of("float64")
    camera, transfer = camera_of(grid), transfer_of("float64")

    def total(values, transfer, camera, **nouns):
        volume = grid.replace(values=values)
        return jaxvr.render(volume, camera, transfer, tracer=OneWay(), **nouns).sum()

    args = grid.values, transfer, camera
    match = "OneWay has no address and no segment, so that reverse mode knows no way"
    for number in (0, 2):
        with pytest.raises(ValueError, match=match):
            jax.grad(total, number)(*args)
    by_transfer = quick.jit(jax.grad(total, 1))(*args).extinctions
    recorded = functools.partial(total, adjoint=jaxvr.Direct(64))
    direct = quick.jit(jax.grad(recorded, (0, 1)))(*args)
    assert np.allclose(by_transfer, direct[1].extinctions, rtol=1e-10)
    own = jax.grad(lambda v: jaxvr.render(grid.replace(values=v), camera, transfer).sum())
    want = quick.jit(own)(args[0])
    assert np.allclose(direct[0], want, rtol=0, atol=1e-12 * np.abs(want).max())
    assert np.abs(want).max() > 0
    with pytest.raises(ValueError, match=r"OneWay has no locate\(scene, rays, state\)"):
        jaxvr.probe(grid, camera, transfer, (2, 3), tracer=OneWay())
    with pytest.raises(ValueError, match=r"PreIntegration has a table .* write its longest"):
        jaxvr.render(*(grid, camera, transfer), tracer=OneWay(), integrator=jaxvr.PreIntegration())


def test_rows_that_are_not_there_are_zero():
    from jaxvr.trace.base import gather

    rows = {"a": jnp.arange(1.0, 4.0), "b": jnp.arange(1.0, 7.0).reshape(3, 2)}
    at = jnp.asarray([[0, -1], [2, 1]])
    found = gather(rows, {"a": at, "b": at})
    assert found["a"].tolist() == [[1, 0], [3, 2]]
    assert found["b"].tolist() == [[[1, 2], [0, 0]], [[5, 6], [3, 4]]]
    assert isinstance(Store(rows).whole, tuple)


def test_units_of_another_volume():
    """Whatever the unit of lengths and of scalars is, a picture has the same bits."""
    grid = grid_of("float32")
    camera, transfer = camera_of(grid), transfer_of("float32")
    image = np.asarray(jaxvr.render(grid, camera, transfer))
    for length, scalar in ((2.0**40, 1.0), (1.0, 2.0**50), (2.0**-60, 2.0**-30)):
        far = grid.replace(
            values=grid.values * scalar, spacing=grid.spacing * length, corner=grid.corner * length
        )
        same = jaxvr.TransferFunction(
            transfer.positions * scalar, transfer.colors, transfer.extinctions / length
        )
        view = camera.replace(eye=camera.eye * length, target=camera.target * length)
        assert (np.asarray(jaxvr.render(far, view, same)) == image).all()
