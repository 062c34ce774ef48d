"""Numbers far from 0 and close together, in float32: pictures, gradients and everything given back.

The same scene is built in three ways: near 0 in float64, and at its place in float32 and float64.
The first two must agree, in pictures to 1e-5 and in what is given back to the rounding of what is
left after the offset.
"""

from __future__ import annotations

import json
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvr
from jaxvr import Camera, TetMesh, TransferFunction, datasets
from jaxvr._core.offsets import bulk
from jaxvr.interact.orbit import Orbit
from jaxvr.interact.viewer import Viewer
from jaxvr.order import exact_order
from jaxvr.testing import assert_render_close
from jaxvr.testing.rays import scaled
from jaxvr.trace import KBuffer
from jaxvr.trace.rasterize import beside

pytestmark = pytest.mark.usefixtures("quick_code")

BOX = datasets.box((3, 3, 2), 0.2, dtype="float64")
POINTS = np.asarray(BOX.points)
CELLS = {"tetra": np.asarray(BOX.cells)}
FIELD = np.sin(3 * POINTS[:, 0]) + POINTS[:, 1] * POINTS[:, 2]
COLORS = np.random.default_rng(5).uniform(size=(5, 3))
EXTINCTIONS = np.array([0.5, 4.0, 0.2, 6.0, 2.0])
CENTER = POINTS.mean(axis=0)
EYE = CENTER + [1.4, 0.9, 2.1]
FIELDS = {"pascal": (101325, 0.01), "kelvin": (-300, 1e-5), "million": (1e6, 1.0), "id": (2e9, 7)}
PLACES = {
    "utm": ([4.5e5, 5.2e6, 0.0], 10.0),
    "cube": ([-1e5, 1e5, 1e5], 1.0),
    "axis": ([0, 0, 77], 1),
}
NEAR_FIELD, NEAR_PLACE = (0.0, 1.0), ([0.0, 0.0, 0.0], 1.0)


class Scene:
    """A mesh, a transfer function and a camera, with their numbers moved and scaled."""

    def __init__(self, field=NEAR_FIELD, place=NEAR_PLACE, dtype="float32", location="point"):
        (away, scale), (corner, size) = field, place
        corner = np.asarray(corner)
        values = FIELD
        if location != "point":
            values = FIELD[np.asarray(BOX.cells)]
            values = values.mean(axis=1) if location == "cell" else values + 0.1 * values[:, :1]
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*inverted tetrahedra turned round")
            self.mesh = TetMesh.from_cells(
                size * POINTS + corner, CELLS, scale * values + away, location=location, dtype=dtype
            )
        positions = scale * np.linspace(FIELD.min(), FIELD.max(), 5) + away
        self.transfer = TransferFunction(positions, COLORS, EXTINCTIONS / size, dtype=dtype)
        eye, target = size * EYE + corner, size * CENTER + corner
        self.camera = Camera.look_at(eye, target, width=20, height=16, dtype=dtype)
        self.field, self.size, self.corner = field, size, corner

    def image(self, **how):
        return np.asarray(jaxvr.render(self.mesh, self.camera, self.transfer, **how))


FAR = [Scene(field=f) for f in FIELDS.values()] + [Scene(place=p) for p in PLACES.values()]
IDS = [*FIELDS, *PLACES]


@pytest.fixture(scope="module", name="near")
def _near():
    return Scene(dtype="float64")


@pytest.fixture(scope="module", name="here")
def _here():
    """Near 0 in float32: what is compiled for it serves far from 0, too."""
    return Scene()


@pytest.fixture(scope="module", name="both")
def _both():
    return Scene(FIELDS["pascal"], PLACES["utm"])


@pytest.mark.parametrize("scene", FAR, ids=IDS)
def test_pictures(scene, near):
    expected = near.image()
    assert expected[..., 3].max() > 0.5
    assert np.abs(scene.image() - expected).max() < 1e-5
    segments = jaxvr.trace(scene.mesh, scene.camera)
    assert np.abs(jaxvr.shade(segments, scene.transfer) - scene.image()).max() < 1e-6
    orbit = [
        jaxvr.render(s.mesh, Camera.orbit(s.mesh, 70, -30, width=9, height=9), s.transfer)
        for s in (scene, near)
    ]
    assert np.abs(orbit[0] - np.asarray(orbit[1])).max() < 1e-5


def test_against_brute_force(both):
    """In float64, in the world, whose code takes no offset off."""
    assert_render_close(both.mesh, both.camera, both.transfer, atol=1e-5)


def test_sorted_faces(both, near):
    exact = KBuffer(k=2, order=exact_order(both.mesh, both.camera))
    assert np.abs(both.image(tracer=exact) - near.image()).max() < 1e-5


@pytest.mark.parametrize("location", ["cell", "corner"])
def test_other_locations(location):
    both = Scene(FIELDS["pascal"], PLACES["utm"], location=location)
    near = Scene(dtype="float64", location=location)
    assert np.abs(both.image() - near.image()).max() < 1e-5


def test_ordinary_data_have_no_offsets(dtype):
    for field in ((0.0, 1.0), (30.0, 1.0), (0.0, 1e-30)):
        for place in (([0.0, 0.0, 0.0], 1.0), ([9.0, -20.0, 30.0], 1.0), ([0, 0, 0], 1e20)):
            scene = Scene(field, place, dtype)
            found = scene.mesh.origin, scene.mesh.offset, scene.transfer.offset, scene.camera.origin
            assert found == ((0, 0, 0), 0, 0, (0, 0, 0))
            moved = place[1] * POINTS + np.asarray(place[0])
            assert np.array_equal(scene.mesh.points, moved.astype(dtype))
    assert Scene(FIELDS["id"], PLACES["utm"], "float64").mesh.offset == 0
    box = datasets.box((3, 3, 2), 0.2, dtype=dtype)
    assert box.replace(values=np.full(box.n_points, 101325.0)).offset == 0  # a constant


@pytest.mark.parametrize("exponent", [-40, 3, 40])
def test_units_that_are_powers_of_two(both, exponent):
    """As everywhere, bits do not depend on them."""
    unit = 2.0**exponent
    away, scale = FIELDS["pascal"]
    corner, size = PLACES["utm"]
    moved = Scene((unit * away, unit * scale), (unit * np.asarray(corner), unit * size))
    assert moved.mesh.offset == unit * both.mesh.offset
    assert moved.mesh.origin == tuple(unit * x for x in both.mesh.origin)
    assert np.array_equal(moved.image(), both.image())


def test_numbers_that_no_cell_uses_do_not_count():
    points = np.concatenate([POINTS + 1e6, [[0, 0, 0]]])
    values = np.concatenate([FIELD + 1e6, [0]])
    with pytest.warns(UserWarning, match="inverted"):
        mesh = TetMesh.from_cells(points, CELLS, values, dtype="float32")
    assert mesh.offset and all(mesh.origin)
    assert mesh.replace(values=values, offset=0).offset == mesh.offset
    assert BOX.replace(values=FIELD + 1e6).offset == 0  # float64
    again = jaxvr.datasets.box((3, 3, 2), 0.2, dtype="float32").replace(values=FIELD + 1e6)
    assert np.abs(again.absolute_values() - FIELD - 1e6).max() < 1e-6


def test_gradients(both, near):
    """By the same relative numbers; those by lengths and scalars are one over their units."""
    scale, size = FIELDS["pascal"][1], PLACES["utm"][1]

    def grads(s):
        def loss(points, values, transfer, eye):
            mesh = s.mesh.replace(
                points=points, values=values, origin=s.mesh.origin, offset=s.mesh.offset
            )
            camera = s.camera.replace(eye=eye, origin=s.camera.origin)
            return (jaxvr.render(mesh, camera, transfer) ** 2).sum()

        leaves = s.mesh.points, s.mesh.values, s.transfer, s.camera.eye
        return jax.jit(jax.grad(loss, (0, 1, 2, 3)))(*leaves)

    found, right = grads(both), grads(near)
    assert found[2].offset == both.transfer.offset
    units = [size, scale, scale, 1, 1 / size, size]
    for unit, a, b in zip(units, jax.tree.leaves(found), jax.tree.leaves(right), strict=True):
        assert np.abs(unit * np.asarray(a) - b).max() < 2e-4 * np.abs(b).max()


def test_rays_probe_and_rasterize_take_and_give_the_world(both, here):
    rays = both.camera.rays()
    assert rays[0].dtype == np.float64
    along = [np.asarray(x, np.float64) for x in here.camera.rays()]
    world = PLACES["utm"][1] * along[0] + both.corner, along[1]
    expected = here.image()
    for origins, directions in (rays, world):
        image = jaxvr.render_rays(both.mesh, origins, directions, both.transfer)
        assert np.abs(image - expected).max() < 1e-5
    found = jaxvr.probe(both.mesh, world, both.transfer)
    right = jaxvr.probe(here.mesh, here.camera, here.transfer)
    assert np.array_equal(found.cells, right.cells)
    away, scale = FIELDS["pascal"]
    assert np.abs((found.scalars - away) / scale - right.scalars).max() < 1e-5
    assert np.abs((found.positions - both.corner) / 10 - right.positions).max() < 1e-5
    faces = np.asarray(BOX.cells)[:, :3]
    drawn = [
        jaxvr.rasterize(s.mesh.points, faces, s.camera, origin=s.mesh.origin) for s in (both, here)
    ]
    assert np.array_equal(drawn[0].pixel, drawn[1].pixel)
    assert np.abs(drawn[0].depth / 10 - drawn[1].depth).max() < 1e-5
    points, camera = beside(both.mesh.absolute_points(), both.camera, None)
    assert np.abs(points + camera.origin - both.mesh.absolute_points()).max() < 1e-8
    assert np.abs(points).max() < 20
    depth, _ = drawn[0].locate(
        both.mesh.points, both.mesh.values, both.camera, origin=both.mesh.origin
    )
    assert np.abs(depth / 10 - drawn[1].depth).max() < 1e-5
    with pytest.raises(ValueError, match="Say what these are relative to"):
        jaxvr.rasterize(both.mesh.points, faces, both.camera)
    k = [int(jaxvr.measure_k(s.mesh, s.camera).k) for s in (both, here)]
    assert k[0] == k[1]


def test_a_transfer_function_and_its_offset(both, tmp_path):
    tf, x = both.transfer, np.linspace(FIELD.min(), FIELD.max(), 5) * 0.01 + 101325
    assert tf.offset and np.abs(tf.absolute_positions() - x).max() < 1e-9
    for same in (
        TransferFunction.from_json(tf.to_json()),
        TransferFunction.from_json(tf.to_json(), dtype="float32"),
        tf.replace(colors=tf.colors),
        tf.replace(positions=tf.positions, offset=tf.offset),
        tf.scaled(1.0),
        tf.resample(tf.absolute_positions()),
        jax.tree.map(lambda leaf: leaf, tf),
        jax.jit(lambda t: t)(tf),
    ):
        assert same.offset == tf.offset
        assert all(map(np.array_equal, jax.tree.leaves(same), jax.tree.leaves(tf)))
    fine = 101325 + 0.01 * np.linspace(FIELD.min(), FIELD.max(), 33)
    near = TransferFunction((x - 101325) / 0.01, COLORS, tf.extinctions, dtype="float64")
    for a, b in zip(tf(fine), near((fine - 101325) / 0.01), strict=True):
        assert np.abs(a - np.asarray(b)).max() < 1e-5 * np.abs(b).max()
    for a, b in zip(tf.with_points(9)(fine), near.with_points(9)((fine - 101325) / 0.01)):
        assert np.abs(a - np.asarray(b)).max() < 1e-5 * np.abs(b).max()
    whole = jnp.asarray([101325.0, 101326.0], jnp.float32)  # 101325.01 itself is none of float32
    same = TransferFunction(whole, COLORS[:2], [1, 2], dtype="float32")
    assert same.offset == 0  # JAX's arrays are taken as they are
    assert np.abs(same.relative_to(101325.01).positions - np.array([-0.01, 0.99])).max() < 1e-7
    with pytest.warns(UserWarning, match="4 pairs of positions are no longer as far|are one in"):
        tf.relative_to(0)
    shifted = tf.relative_to(101320)
    assert np.abs(shifted.absolute_positions() - x).max() < 1e-6
    double = tf.astype("float64").relative_to(0)
    assert np.abs(double.positions - x).max() < 1e-9
    image = jaxvr.render(both.mesh, both.camera, double)
    assert np.abs(image - both.image()).max() < 1e-5
    mapped = TransferFunction.from_colormap("viridis", x, EXTINCTIONS, points=9, dtype="float32")
    assert mapped.offset == tf.offset and np.abs(np.diff(mapped.positions)).min() > 0
    opaque = TransferFunction.from_opacity(x, "viridis", [0, 0.1, 0.2, 0.3, 0.9], dtype="float32")
    assert opaque.offset == tf.offset
    with pytest.raises(ValueError, match="positions are held relative to offset = 101325.* Say"):
        tf.replace(positions=x)
    assert tf.replace(positions=np.linspace(0, 1, 5), offset=0).offset == 0
    with pytest.raises(ValueError, match="offset must be a finite number"):
        TransferFunction(x, COLORS, EXTINCTIONS, offset=np.nan)
    document = json.loads(tf.to_json()) | {"offset": [1, 2]}
    with pytest.raises(ValueError, match="'offset' must be one number"):
        TransferFunction.from_json(document)
    assert f"{x[0]:.9g}"[:9] in repr(tf) and "101325" in (tf._repr_html_() or "")


def test_a_transfer_function_goes_through_vtk(both):
    pytest.importorskip("vtk")
    tf = both.transfer
    back = TransferFunction.from_vtk(*tf.to_vtk(0.01), unit_distance=0.01, dtype="float32")
    assert back.offset == tf.offset
    for a, b in zip(jax.tree.leaves(back), jax.tree.leaves(tf), strict=True):
        assert np.allclose(a, b, rtol=1e-6, atol=0)


def test_positions_that_float32_makes_one():
    with pytest.warns(UserWarning, match=r"1 pairs of positions are one in float32.*\[1\]"):
        TransferFunction(
            [0, 101325, 101325.001, 4e5], np.zeros((4, 3)), np.ones(4), dtype="float32"
        )


def test_a_camera_and_its_origin(both):
    camera, mesh = both.camera, both.mesh
    assert camera.origin == (450000, 5200000, 0)  # near its target
    eye, target = camera.absolute()
    assert np.abs(eye - (10 * EYE + both.corner)).max() < 1e-5
    for same in (
        camera.replace(fov=camera.fov),
        camera.replace(eye=camera.eye, origin=camera.origin),
        Camera.look_at(eye, target, width=20, height=16, dtype="float32"),
        camera.relative_to(mesh.origin),
    ):
        assert np.array_equal(jaxvr.render(mesh, same, both.transfer), both.image())
    moved = camera.relative_to((450001.0, 5200002.0, 3.0))
    assert np.abs(jaxvr.render(mesh, moved, both.transfer) - both.image()).max() < 1e-5
    with pytest.raises(ValueError, match="eye are held relative to origin"):
        camera.replace(eye=eye)
    with pytest.raises(ValueError, match="cannot be made in float32 inside jit"):
        jax.jit(lambda c: c.rays())(camera)
    orbit = Orbit.of(camera, 8.0).camera(20, 16, "float32")
    assert np.abs(jaxvr.render(mesh, orbit, both.transfer) - both.image()).max() < 1e-4
    flat = Camera.orthographic(eye, target, extent=12.0, width=5, height=5, dtype="float32")
    assert jaxvr.render(mesh, flat, both.transfer)[2, 2, 3] > 0.5
    assert "relative to (450000, 5200000, 0)" in repr(camera)


def test_a_camera_in_float32_of_a_mesh_in_float64(both):
    """The mesh has no origin, the camera has: it is widened before that is put back."""
    double = Scene(FIELDS["pascal"], PLACES["utm"], "float64")
    assert double.mesh.origin == (0, 0, 0) != both.camera.origin
    image = jaxvr.render(double.mesh, both.camera, both.transfer)
    assert np.abs(image - double.image()).max() < 1e-5
    exact, right = (exact_order(double.mesh, c) for c in (both.camera, double.camera))
    assert np.array_equal(exact.table, right.table)
    k = [int(jaxvr.measure_k(double.mesh, c).k) for c in (both.camera, double.camera)]
    assert k[0] == k[1]


def test_a_camera_goes_through_vtk(both):
    pytest.importorskip("vtk")
    again = Camera.from_vtk(both.camera.to_vtk(), 20, 16, dtype="float32")
    assert np.abs(jaxvr.render(both.mesh, again, both.transfer) - both.image()).max() < 1e-5


def test_cameras_and_rays_that_lost_their_digits_are_told(both):
    eye, target = both.camera.absolute()
    with pytest.warns(UserWarning, match="with steps of 0.5 beside a volume at"):
        lost = Camera.look_at(jnp.asarray(eye, jnp.float32), jnp.asarray(target, jnp.float32))
        jaxvr.render(both.mesh, lost.replace(width=4, height=4), both.transfer)
    with pytest.warns(UserWarning, match="origins are float32, with steps of 0.5"):
        jaxvr.render_rays(
            both.mesh, jnp.asarray(eye, jnp.float32), jnp.ones(3, jnp.float32), both.transfer
        )


def test_positions_that_lost_their_digits_are_told(both):
    x = 101325 + 0.01 * np.linspace(FIELD.min(), FIELD.max(), 5)
    few = "positions come in float32, which has steps of 0.0078 there: they lie from 101325.* 2 st"
    others = COLORS, EXTINCTIONS
    for single in (jnp.asarray(x, jnp.float32), x.astype(np.float32)):
        for make in (
            lambda x: TransferFunction(x, *others),
            lambda x: TransferFunction(x, *others, dtype="float64"),
            lambda x: TransferFunction.from_colormap("viridis", x, EXTINCTIONS),
            lambda x: TransferFunction.from_opacity(x, "viridis", np.full(5, 0.1)),
            lambda x: both.transfer.resample(x),
        ):
            with pytest.warns(UserWarning, match=few) as told:
                made = make(single)
            assert len(told) == 1 and told[0].filename == __file__
    # Numbers that are meant as they are, or that came out of `jit`, where nobody knows, are told
    # beside a mesh that has an offset.
    leaves = [jnp.asarray(a, jnp.float32) for a in (x, *others)]
    lost = TransferFunction.tree_unflatten(0.0, leaves)
    meant = both.transfer.replace(positions=jnp.asarray(x, jnp.float32), offset=0)
    for verb in (jaxvr.render, jaxvr.probe):
        for transfer in (lost, meant):
            with pytest.warns(UserWarning, match=few) as told:
                verb(both.mesh, both.camera, transfer)
            assert sum("come in float32" in str(w.message) for w in told) == 1
    near = jnp.asarray([101325.0, 101325.01, 101340.0], jnp.float32)  # one gap of one step
    with pytest.warns(UserWarning, match="steps of 0.0078 there.*1920 steps"):
        made = TransferFunction(near, COLORS[:3], EXTINCTIONS[:3], dtype="float32")
    assert made.offset == 0


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_positions_that_kept_their_digits_are_not_told(both, dtype):
    """Warnings are errors."""
    fine = 101325 + np.linspace(0.0, 300.0, 5)
    others = COLORS, EXTINCTIONS
    for kept in (
        jnp.asarray([101325, 101325.5, 101326, 101327, 101328], jnp.float32),  # whole steps
        jnp.asarray(fine + 0.3, jnp.float32),  # enough of them
        jnp.asarray(np.linspace(0, 2e5, 5) + 0.3, jnp.float32),
        jnp.full(5, 101325.01, jnp.float32)[:2],
        jnp.asarray(fine - 101325 + 0.01, jnp.float32),
        101325 + 0.01 * np.linspace(0, 1, 5),
        (101325 + 0.01 * np.linspace(0, 1, 5)).tolist(),
        np.arange(101325, 101330),
    ):
        n = len(kept)
        made = TransferFunction(kept, COLORS[:n], EXTINCTIONS[:n], dtype=dtype)
        assert jax.tree.map(lambda leaf: leaf, made).offset == made.offset
    tf = both.transfer.replace(positions=both.transfer.positions, offset=both.transfer.offset)
    assert tf.scaled(2.0).astype(dtype).offset == tf.offset
    x = jnp.asarray(101325 + 0.01 * np.linspace(FIELD.min(), FIELD.max(), 5), jnp.float32)

    @jax.jit
    def picture(x):  # nobody knows the numbers
        return jaxvr.render(both.mesh, both.camera, TransferFunction(x, *others))[..., 3].sum()

    assert np.isfinite(picture(x)) and np.isfinite(jax.jit(jax.grad(picture))(x)).all()


def test_a_fit_tells_of_lost_digits_once(both):
    x = jnp.asarray(101325 + 0.01 * np.linspace(FIELD.min(), FIELD.max(), 3), jnp.float32)
    with pytest.warns(UserWarning, match="positions come in float32"):
        start = TransferFunction(x, COLORS[:3], EXTINCTIONS[:3] / both.size, dtype="float32")
    seen = []
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        jaxvr.fit(
            *(start, both.mesh, [both.camera], [both.image()]), iterations=6, progress=False,
            callback=lambda i, loss, tf: seen.append(tf.absolute_positions()),
        )  # fmt: skip
    assert len(seen) == 6
    assert sum("come in float32" in str(w.message) for w in told) == 1


def test_a_mesh_gives_back_the_world(both, near, tmp_path):
    pytest.importorskip("vtk")
    mesh = both.mesh
    world = 10 * POINTS + both.corner, 0.01 * FIELD + 101325
    grid = mesh.to_pyvista()
    assert np.abs(np.asarray(grid.points) - world[0]).max() < 1e-6
    assert np.abs(np.asarray(grid.active_scalars) - world[1]).max() < 1e-9
    jaxvr.write_mesh(tmp_path / "far.vtu", mesh)
    read = jaxvr.read_mesh(tmp_path / "far.vtu", dtype="float32")
    assert read.origin == mesh.origin and read.offset == mesh.offset
    for a, b in ((read.absolute_points(), world[0]), (read.absolute_values(), world[1])):
        assert np.abs(a - b).max() < 1e-6
    finer = jaxvr.refine(mesh, 0.3)
    assert finer.n_tets > mesh.n_tets and finer.origin == mesh.origin
    image = jaxvr.render(finer, both.camera, both.transfer)
    assert np.abs(image - both.image()).max() < 2e-5  # linear in each cell before and after
    text = mesh.describe()
    assert "(450008, 5200008, 0): points are held relative to it" in text
    assert "101325" in text and "5200010" in text
    assert "5200008" in repr(mesh) and "held relative" in (mesh._repr_html_() or "")
    for name, of in (("points", "origin"), ("values", "offset")):
        with pytest.raises(ValueError, match=f"{name} are held relative to {of} = .*Say what"):
            mesh.replace(**{name: getattr(mesh, name)})
        same = mesh.replace(**{name: getattr(mesh, name), of: getattr(mesh, of)})
        assert np.array_equal(getattr(same, name), getattr(mesh, name))
        with pytest.raises(ValueError, match=f"pass {name} too"):
            mesh.replace(**{of: 0})
    with pytest.raises(ValueError, match="origin must be three finite numbers"):
        mesh.replace(points=mesh.points, origin=(1, 2))


def test_defaults_explorer_and_hints(both):
    default = jaxvr.default_transfer(both.mesh)
    assert default.offset == both.mesh.offset
    assert np.asarray(jaxvr.render(both.mesh, both.camera, default))[..., 3].max() > 0.5
    viewer = Viewer(both.mesh, both.transfer, both.camera)
    state = viewer.state()
    assert np.abs(np.array(state["positions"]) - both.transfer.absolute_positions()).max() == 0
    viewer.apply({"edits": [{"edit": "move", "index": 2, "position": 101325.005, "extinction": 1}]})
    assert abs(viewer.transfer.absolute_positions()[2] - 101325.005) < 1e-8
    viewer.apply({"edits": [{"edit": "add", "position": 101325.0052, "extinction": 1}]})
    assert viewer.transfer.offset == both.transfer.offset and len(viewer.transfer.positions) == 6
    assert np.abs(viewer.image[..., :3] - 1).max() > 0.3
    wrong = TransferFunction([0.0, 1.0], np.eye(3)[:2], [1.0, 2.0], dtype="float32")
    with pytest.warns(jaxvr.ViewWarning, match="lies from 101325.* to 101325"):
        jaxvr.render(both.mesh, both.camera, wrong)
    away = both.camera.replace(target=both.camera.eye * 2, origin=both.camera.origin)
    with pytest.warns(jaxvr.ViewWarning, match="behind the camera.*5200010"):
        jaxvr.render(both.mesh, away, both.transfer)


@pytest.mark.parametrize("cache", [True, False])
def test_a_fit(cache, both, here):
    """Far from 0 in float32 it goes as near 0, since it sees the same numbers."""
    fitted = []
    for s in (both, here):
        start = s.transfer.replace(extinctions=jnp.full(5, 2.0 / s.size, "float32"))
        fitted.append(
            jaxvr.fit(
                *(start, s.mesh, [s.camera], [s.image()]),
                iterations=5,
                free=("colors", "extinctions", "positions"),
                cache=cache,
                progress=False,
            )
        )
    far, near = fitted
    assert far.transfer.offset == both.transfer.offset
    assert far.loss_history[-1] < far.loss_history[0]
    assert np.allclose(far.loss_history, near.loss_history, rtol=1e-3, atol=1e-6)
    moved = (far.transfer.absolute_positions() - 101325) / 0.01
    assert np.abs(moved - near.transfer.absolute_positions()).max() < 1e-3
    if cache:
        segments = [jaxvr.trace(s.mesh, s.camera) for s in (both, here)]
        with pytest.raises(ValueError, match="offsets that differ"):
            jaxvr.fit(near.transfer, None, segments, [both.image()] * 2, progress=False)


def test_what_no_offset_helps_is_told():
    two = np.concatenate([POINTS, POINTS + [5e6, 0, 0]])
    cells = {"tetra": np.concatenate([CELLS["tetra"], CELLS["tetra"] + len(POINTS)])}
    with pytest.warns(UserWarning) as told:
        TetMesh.from_cells(two, cells, np.concatenate([FIELD, FIELD]), dtype="float32")
    assert any("so small beside the steps of float32" in str(w.message) for w in told)
    box = datasets.box((3, 3, 2), 0.2, dtype="float32")
    halves = np.where(np.arange(box.n_points) % 2, 101325 + 1e-3 * FIELD, 1e-3 * FIELD)
    with pytest.warns(UserWarning) as told:
        TetMesh.from_cells(np.asarray(box.points), {"tetra": box.cells}, halves, dtype="float32")
    assert any("different values: they lie in places far" in str(w.message) for w in told)
    given = np.asarray(box.points), {"tetra": box.cells}
    for scale in (1e-60, 1e-309):  # the latter below the normal numbers of float64, too
        with pytest.warns(UserWarning) as told:
            TetMesh.from_cells(*given, scale * FIELD, dtype="float32")
        assert any("different values: they are too near 0" in str(w.message) for w in told)
    single = (101325 + 0.01 * FIELD).astype(np.float32)
    with pytest.warns(UserWarning) as told:
        TetMesh.from_cells(np.asarray(box.points), {"tetra": box.cells}, single)
    assert any("in float32, which has steps of 0.0078" in str(w.message) for w in told)
    single = (POINTS + [0, 5.2e6, 0]).astype(np.float32)
    with pytest.warns(UserWarning) as caught:
        TetMesh.from_cells(single, {"tetra": box.cells}, FIELD, dtype="float32")
    assert any("so small beside the steps" in str(w.message) for w in caught)


def test_new_numbers_of_the_world_keep_their_digits(both):
    """replace takes them with 0, as the page says; known float64 of JAX is as good as NumPy's."""
    mesh, camera, tf = both.mesh, both.camera, both.transfer
    points = 10 * POINTS + both.corner
    values, eye = 101325 + 0.01 * FIELD, 10 * EYE + both.corner
    x = 101325 + 0.01 * np.linspace(FIELD.min(), FIELD.max(), 5)
    kinds = [np.asarray, jnp.asarray, lambda a: a.tolist()]
    for kind in kinds if jnp.zeros(()).dtype == np.float64 else (np.asarray, kinds[2]):
        moved = mesh.replace(points=kind(points), origin=0)
        moved = moved.replace(values=kind(values), offset=0)
        plain = datasets.box((3, 3, 2), 0.2, dtype="float32")
        plain = plain.replace(points=kind(points), values=kind(values))
        for same in (moved, plain):
            assert (same.origin, same.offset) == (mesh.origin, mesh.offset)
            assert np.abs(same.absolute_points() - points).max() < 1e-6
            assert np.abs(same.absolute_values() - values).max() < 1e-9
        seen = camera.replace(eye=kind(eye), origin=0)
        assert np.abs(np.array(seen.absolute()) - camera.absolute()).max() < 1e-6
        made = Camera.look_at(kind(eye), kind(camera.absolute()[1]), dtype="float32")
        assert made.origin == camera.origin
        for same in (
            tf.replace(positions=kind(x), offset=0),
            TransferFunction(kind(x), COLORS, tf.extinctions, offset=0, dtype="float32"),
            TransferFunction(kind(x), COLORS, tf.extinctions, dtype="float32"),
            TransferFunction(
                kind(x - 101000), COLORS, tf.extinctions, offset=101e3, dtype="float32"
            ),
        ):
            assert np.abs(same.absolute_positions() - x).max() < 1e-9
            assert np.abs(same.positions).max() < 1
    # What is relative already stays what it is, and so do trees of the same structure.
    for kind in (np.asarray, jnp.asarray, lambda a: np.asarray(a, np.float64)):
        same = mesh.replace(points=kind(mesh.points), origin=mesh.origin)
        same = same.replace(values=kind(mesh.values), offset=mesh.offset)
        assert jax.tree.structure(same) == jax.tree.structure(mesh)
        assert all(map(np.array_equal, jax.tree.leaves(same), jax.tree.leaves(mesh)))
        same = camera.replace(eye=kind(camera.eye), origin=camera.origin)
        assert all(map(np.array_equal, jax.tree.leaves(same), jax.tree.leaves(camera)))
        same = tf.replace(positions=kind(tf.positions), offset=tf.offset)
        assert jax.tree.structure(same) == jax.tree.structure(tf)
        assert np.array_equal(same.positions, tf.positions)


def test_a_start_in_float64_is_fitted_in_float32(both):
    double = Scene(FIELDS["pascal"], PLACES["utm"], "float64").transfer
    assert double.offset == 0 and double.astype("float32").offset == both.transfer.offset
    how = {"iterations": 1, "learning_rate": 1e-9, "progress": False}
    found = jaxvr.fit(double, both.mesh, [both.camera], [both.image()], **how)
    assert np.abs(found.images[0] - both.image()).max() < 1e-4
    assert np.abs(found.transfer.absolute_positions() - double.positions).max() < 1e-8


def test_float32_that_lost_its_digits_is_told(both):
    """At every door, of NumPy's as of JAX's."""
    eye, target = both.camera.absolute()
    x = both.transfer.absolute_positions()
    origins, directions = both.camera.rays()
    box = datasets.box((3, 3, 2), 0.2, dtype="float32")
    for kind in (np.asarray, jnp.asarray):

        def single(a, kind=kind):
            return kind(np.asarray(a, np.float32))

        for what, call in {
            "positions come in float32": lambda: TransferFunction(
                single(x[[0, -1]]), COLORS[:2], [1, 2], dtype="float32"
            ),
            "scalars come in float32": lambda: both.transfer(single(x)),
            "values come in float32": lambda: box.replace(values=single(101325 + 0.01 * FIELD)),
            "so small beside the steps": lambda: box.replace(points=single(POINTS + 5.2e6)),
            "origins are float32": lambda: jaxvr.render_rays(
                both.mesh, single(origins), directions, both.transfer
            ),
        }.items():
            with pytest.warns(UserWarning, match=what):
                call()
    with pytest.warns(UserWarning, match="eye comes in float32, which has steps of 0.5 there, 21"):
        Camera.look_at(np.float32(eye), target, dtype="float32")
    assert both.transfer(np.asarray([101325, 101326], np.float32))[1][1] > 0  # whole: none is lost
    faces = np.asarray(BOX.cells)[:, :3]
    with pytest.raises(ValueError, match="Say what these are relative to"):
        jaxvr.rasterize(np.asarray(both.mesh.points), faces, both.camera)


def test_rasterize_takes_the_world(both):
    faces, world = np.asarray(BOX.cells)[:, :3], 10 * POINTS + both.corner
    right = jaxvr.rasterize(both.mesh.points, faces, both.camera, origin=both.mesh.origin)
    for origin in (None, 0):
        drawn = jaxvr.rasterize(world, faces, both.camera, origin=origin)
        assert np.array_equal(drawn.pixel, right.pixel)
        assert np.abs(drawn.depth - np.asarray(right.depth)).max() < 1e-4


@pytest.mark.filterwarnings("ignore::jaxvr.ViewWarning")
def test_positions_that_move_beside_each_other_are_told():
    box = datasets.box((3, 3, 2), 0.2, dtype="float32")
    camera = Camera.orbit(box, width=4, height=4)
    peak = TransferFunction(
        [101325, 101325.01, 101325.02], np.ones((3, 3)), [0, 9, 0], dtype="float32"
    )
    wide = box.replace(values=2e5 * POINTS[:, 0])
    constant = box.replace(values=np.full(box.n_points, 101325.005))
    assert wide.offset == constant.offset == 0 != peak.offset
    for mesh in (wide, constant):
        with pytest.warns(UserWarning, match="pairs of positions are no longer as far from each"):
            jaxvr.render(mesh, camera, peak)
    with pytest.warns(UserWarning, match="3 pairs of positions are no longer.*101325"):
        TransferFunction(
            [-1e9, 101325, 101325.01, 101325.02, 101325.03, 1e9],
            np.ones((6, 3)),
            np.ones(6),
            dtype="float32",
        )


def test_values_that_no_float_holds_are_told(dtype):
    box = datasets.box((3, 3, 2), 0.2, dtype=dtype)
    for ids in (2**60 + np.arange(48), -(2**60) - np.arange(48), 2**63 + np.arange(48, dtype="u8")):
        with pytest.warns(UserWarning, match="integers that float64 cannot hold"):
            box.replace(values=ids)
    few = np.where(np.arange(48) == 7, 2**63 - 1, 0)
    with pytest.warns(UserWarning, match="1 integers that float64 cannot.*9223372036854775807"):
        box.replace(values=few)
    box.replace(values=np.where(np.arange(48) == 7, -(2**63), 0))  # a power of two
    if dtype == "float32":
        with pytest.warns(UserWarning, match="0 of the 1 different values: they are too near 0"):
            box.replace(values=np.full(48, 1e-300))


def test_outlying_values_and_parts_are_told():
    box = datasets.box((8, 8, 8), 0.0, dtype="float32")
    values = 101325 + 0.01 * np.sin(np.arange(box.n_points))
    values[:4] = [0.1, 0.1001, 0.1002, 0.1003]  # fewer than one in a hundred
    with pytest.warns(UserWarning, match="1 of the 4 different outlying values.* from 0.1 to 1013"):
        moved = box.replace(values=values)
    assert moved.offset
    points = np.concatenate([POINTS, POINTS + [5, 0, 0]])
    cells = {"tetra": np.concatenate([CELLS["tetra"], CELLS["tetra"] + len(POINTS)])}
    with pytest.warns(UserWarning, match="inverted"):
        two = TetMesh.from_cells(points, cells, np.concatenate([FIELD, FIELD]), dtype="float32")
    with pytest.warns(UserWarning, match="so small beside the steps of float32"):
        two.replace(points=np.concatenate([POINTS, POINTS + [5e6, 0, 0]]))


def test_an_offset_does_not_depend_on_the_grid():
    """A sample of every so many values would see one side of a structured one only."""
    values = np.tile(np.linspace(0, 1, 64), 1 << 12)
    values[::64] = 1000.0
    assert bulk(values) != (1000.0, 1000.0) and bulk(values)[0] < 0.05


def test_json_gives_the_same_bits_back():
    far, near = [1000, 1000.5, 1001], [9, 9.1, 9.2]
    for positions, offset in ((far, None), ([0.25, 0.5, 1], 7.0), (near, 1)):
        x = jnp.asarray(positions, jnp.float32)
        tf = TransferFunction(x, COLORS[:3], [1, 2, 3], offset=offset, dtype="float32")
        back = TransferFunction.from_json(tf.to_json())
        assert jax.tree.structure(back) == jax.tree.structure(tf)
        assert np.array_equal(back.positions, tf.positions)


def test_scaled_scenes_keep_their_offsets(both):
    mesh, tf = scaled(both.mesh, both.transfer, scalar=3, length=-2)
    assert np.array_equal(mesh.absolute_points(), both.mesh.absolute_points() / 4)
    assert np.array_equal(mesh.absolute_values(), both.mesh.absolute_values() * 8)
    assert np.array_equal(tf.absolute_positions(), both.transfer.absolute_positions() * 8)
