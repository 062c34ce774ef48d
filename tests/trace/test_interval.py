"""Rays that are seen from `near` to `far`: what was cut there merges to the whole ray, and both
places are differentiated."""

from __future__ import annotations

import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import registry

import jaxvr
from jaxvr import testing
from jaxvr.numerics import compensated
from jaxvr.testing import BruteForce

pytestmark = pytest.mark.usefixtures("quick_code")

EPS = {"float32": 2.0**-23, "float64": 2.0**-52}
HOW: dict[str, dict[str, Any]] = {
    "compiled": {"engine": jaxvr.engine.C()},
    "jax": {"engine": jaxvr.engine.XLA()},
}
BEHIND = jaxvr.Over(direction="back to front")
OTHERS: dict[str, dict[str, Any]] = {
    "k-buffer": {"tracer": jaxvr.KBuffer(k=24)},
    "k-buffer from behind": {"tracer": jaxvr.KBuffer(k=24), "compositor": BEHIND},
    "from behind": {"compositor": BEHIND},
    "forward": {"adjoint": jaxvr.Forward()},
}
NAMES = ["lattice", "folded", "seams", "hollow", "zoo"]


def over(front, back):
    """What the over operator makes of two pictures (..., 4)."""
    return front + (1 - front[..., 3:]) * back


def nasty(name: str, dtype: str):
    """A mesh, rays aimed at its features, and places to cut them at: random ones, and where they
    meet what they were aimed at, or as near as floats come to it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of cells that are flat, or were turned round
        mesh = testing.nasty_meshes(dtype, [name])[name]
    pairs = testing.nasty_rays(mesh, count=3).values()
    origins, directions = (np.concatenate(x).astype(dtype) for x in zip(*pairs, strict=True))
    rng = np.random.default_rng(4)
    reach = np.linalg.norm(directions.astype("float64"), axis=1)  # rays are aimed at 1
    places = np.where(
        rng.random(len(origins)) < 0.5, reach, reach * rng.uniform(0.6, 1.4, len(origins))
    )
    return mesh, origins, directions, places


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("how", HOW)
def test_parts_merge_to_the_whole(name, how, dtype):
    mesh, origins, directions, places = nasty(name, dtype)
    transfer = testing.nasty_transfers(dtype=dtype)["many points"]

    def seen(near, far):
        return np.asarray(
            jaxvr.render_rays(mesh, origins, directions, transfer, near=near, far=far, **HOW[how]),
            "float64",
        )

    first, second = places, places + 0.3
    parts = over(over(seen(0, first), seen(first, second)), seen(second, np.inf))
    whole = seen(0, np.inf)
    assert whole[:, 3].max() > 0.1
    # Where cells are folded a path leads back, so that its order is not that of depths: only what
    # adds up has parts there.
    channels = slice(3, 4) if name == "folded" else slice(4)
    assert np.max(np.abs(parts - whole)[:, channels]) < 200 * EPS[dtype]
    assert np.max(np.abs(seen(0, first) - whole)) > 0.05  # there is something to merge


@pytest.mark.parametrize("how", ["compiled", "jax"])
def test_states_merge(how, dtype):
    """Of each compositor: sums, and the place of the largest scalar."""
    mesh, origins, directions, places = nasty("zoo", dtype)
    transfer = testing.nasty_transfers(dtype=dtype)["two points"]
    compositors: list[Any] = [jaxvr.Over(), jaxvr.XRay(), jaxvr.MaximumIntensity()]
    for compositor in compositors:

        def state(near, far, compositor=compositor):
            return registry.states(
                mesh,
                (origins, directions),
                transfer,
                compositor,
                HOW[how]["engine"],
                near=near,
                far=far,
            )

        whole = state(0, np.inf)
        joined = compositor.merge(state(0, places), state(places, np.inf))
        if compositor == jaxvr.MaximumIntensity():
            # A cut makes two segments of one, and so the number of the segment may be another.
            assert np.max(np.abs(joined.largest - whole.largest)) < 4 * EPS[dtype]
            assert np.array_equal(joined.where >= 0, whole.where >= 0)
            continue
        for x, y in zip(joined, whole, strict=True):
            x, y = compensated.value(x), compensated.value(y)
            assert np.max(np.abs(x - y)) <= 40 * EPS[dtype] * np.max(np.abs(y))


def test_lengths_are_those_of_brute_force(dtype):
    mesh = nasty("zoo", dtype)[0]
    # Rays along faces and edges are in the mesh or beside it, by rounding: not here.
    kinds = testing.nasty_rays(mesh, count=12)
    pairs = [kinds[k] for k in ("through a centroid", "through a face", "from within")]
    origins, directions = (np.concatenate(x).astype(dtype) for x in zip(*pairs, strict=True))
    places = np.linalg.norm(directions.astype("float64"), axis=1)
    near, far = places * 0.98, places * 1.1
    pieces = BruteForce(mesh).pieces(origins, directions)
    front, back = (
        np.clip(x, near[pieces.ray], far[pieces.ray]) for x in (pieces.enter, pieces.leave)
    )
    want = np.zeros(len(origins))
    np.add.at(want, pieces.ray, back - front)
    ones = mesh.replace(values=np.ones(mesh.n_points))
    for how in HOW.values():
        got = jaxvr.render_rays(
            ones, origins, directions, None, near=near, far=far, compositor=jaxvr.XRay(), **how
        )
        assert want.max() > 0.1
        assert np.max(np.abs(got[:, 0] - want)) < 40 * EPS[dtype] * np.max(places)


@pytest.mark.parametrize(
    "how, location",
    [*((how, "point") for how in HOW | OTHERS), *((how, "corner") for how in HOW)],
)
def test_derivatives(how, location):
    """By near, far, values, points, origins and directions: cuts within cells, on random rays."""
    mesh, transfer = registry.mesh_of(location, "float64"), registry.transfer_of("float64")
    rng = np.random.default_rng(8)
    origins = rng.normal(size=(24, 3))
    origins = 0.5 + origins / np.linalg.norm(origins, axis=1, keepdims=True) * 1.2
    origins[:6] = rng.uniform(0.2, 0.8, (6, 3))  # eyes in the mesh
    directions = rng.uniform(0.2, 0.8, (24, 3)) - origins
    near = rng.uniform(0.0, 1.0, 24)
    operands = {
        "near": near,
        "far": near + rng.uniform(0.1, 0.6, 24),
        "values": mesh.values,
        "points": mesh.points,
        "origins": origins,
        "directions": directions,
    }
    operands = {k: jnp.asarray(x) for k, x in operands.items()}
    weights = rng.normal(size=(24, 4))
    options = HOW.get(how) or OTHERS[how]

    @jax.jit
    def total(near, far, values, points, origins, directions):
        moved = mesh.replace(values=values, points=points)
        rgba = jaxvr.render_rays(
            moved, origins, directions, transfer, near=near, far=far, **options
        )
        return (rgba * weights).sum()

    tangents = {k: jnp.asarray(rng.normal(size=x.shape)) for k, x in operands.items()}
    if how == "forward":
        names = ["near", "far", "points"]
        slopes = {}
        for name in names:
            along = {k: t if k == name else 0 * t for k, t in tangents.items()}
            slopes[name] = jax.jvp(
                lambda *x: total(*x), tuple(operands.values()), tuple(along.values())
            )[1]
    else:
        bars = jax.jit(jax.grad(total, tuple(range(6))))(*operands.values())
        slopes = {k: jnp.sum(b * tangents[k]) for k, b in zip(operands, bars, strict=True)}
    for name, slope in slopes.items():

        def at(h, name=name):
            return total(**(operands | {name: operands[name] + h * tangents[name]}))

        # Steps small enough that no ray comes to another cell's cut at that size of error.
        small, large = ((at(h) - at(-h)) / (2 * h) for h in (1e-6, 2e-6))
        want = (4 * small - large) / 3
        assert abs(want) > 1e-3
        assert abs(slope - want) < 2e-7 * max(abs(want), 1)


@pytest.mark.parametrize("how", HOW)
def test_no_ends_are_those_of_a_ray(how):
    """Zero and infinity are what is meant by leaving them out."""
    dtype = "float32"
    mesh, origins, directions, _ = nasty("seams", dtype)
    transfer = testing.nasty_transfers(dtype=dtype)["two points"]

    def seen(**ends):
        return np.asarray(
            jaxvr.render_rays(mesh, origins, directions, transfer, **ends, **HOW[how])
        )

    want = seen()
    got = seen(near=0.0, far=np.inf)
    assert np.max(np.abs(got - want)) <= EPS[dtype]
    assert np.array_equal(seen(near=-1.0, far=np.inf), got)
    assert not seen(near=2.0, far=1.0).any()
    assert not seen(near=np.inf, far=np.inf).any()
    assert not seen(near=0.0, far=0.0).any()


def test_paths_that_overlap_are_all_cut():
    """A cell within another that it has no point in common with: its path begins and ends while
    the other's goes on. From behind, the eye is the end."""
    size, place = np.array([[4.0], [0.5]]), np.array([[0, 0, 0], [0, 0, -0.3]])
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / 2
    points = (size[:, :, None] * corners + place[:, None]).reshape(-1, 3)
    mesh = jaxvr.TetMesh.from_cells(
        points,
        {"tetra": np.arange(8).reshape(2, 4)[:, [0, 2, 1, 3]]},
        np.repeat([1.0, 3.0], 4),
        dtype="float64",
    )
    transfer = jaxvr.TransferFunction([0.0, 4.0], np.eye(2, 3), [0.1, 2.0], dtype="float64")
    rays = np.array([0.05, 0.03, -5.0]), np.array([0.0, 0.0, 1.0])
    pieces = BruteForce(mesh).pieces(rays[0][None], rays[1][None])
    assert len(pieces.ray) == 2
    inner = np.argmin(pieces.leave - pieces.enter)
    begin, end = float(pieces.enter[inner]), float(pieces.leave[inner])
    for far in (begin - 0.01, (begin + end) / 2, end + 0.01):
        want = np.minimum(pieces.leave, far) - np.minimum(pieces.enter, far)
        want = float((want * [1.0 if k != inner else 3.0 for k in (0, 1)]).sum())
        for how in HOW.values():
            got = jaxvr.render_rays(mesh, *rays, None, far=far, compositor=jaxvr.XRay(), **how)
            assert abs(got[0] - want) < 1e-12
    eye = rays[0] + (begin + end) / 2 * rays[1]
    want, got = (
        jaxvr.render_rays(mesh, eye, rays[1], transfer, compositor=c)
        for c in (jaxvr.Over(), BEHIND)
    )
    assert abs(got[3] - want[3]) < 1e-14 and 0.1 < got[3] < 0.9


def test_what_is_infinitely_far_does_not_move():
    """Derivatives by rays, which scale the places of their ends."""
    mesh, transfer = registry.mesh_of("point", "float64"), registry.transfer_of("float64")
    origins, directions = (x.reshape(-1, 3) for x in registry.camera_of("float64").rays())

    def slope(**more):
        def total(directions):
            return jaxvr.render_rays(mesh, origins, directions, transfer, **more).sum()

        return jax.jit(jax.grad(total))(directions)

    want = slope()
    assert np.abs(want).max() > 0.1
    for more in (*HOW.values(), *OTHERS.values()):
        if more.get("adjoint") is not None:
            continue
        for ends in ({"near": 0.0, "far": np.inf}, {}):
            assert np.allclose(slope(**ends, **more), want, rtol=1e-9, atol=1e-11)
    assert not slope(near=np.inf, far=np.inf).any()


def test_units_change_no_bit():
    mesh, origins, directions, places = nasty("seams", "float32")
    transfer = testing.nasty_transfers(dtype="float32")["two points"]
    thicker = jaxvr.TransferFunction(
        transfer.positions, transfer.colors, transfer.extinctions / 2**20
    )
    larger = mesh.replace(points=np.asarray(mesh.points) * np.float32(2**20))
    for how in HOW.values():
        one = jaxvr.render_rays(
            mesh, origins, directions, transfer, near=places, far=places + 0.25, **how
        )
        two = jaxvr.render_rays(
            *(larger, origins * np.float32(2**20), directions * np.float32(2**-9), thicker),
            near=places * 2**20,
            far=(places + 0.25) * 2**20,
            **how,
        )
        assert np.array_equal(one, two)


@pytest.mark.parametrize("compositor", [jaxvr.Over(), BEHIND])
def test_traced_segments_are_cut(compositor):
    dtype = "float32"
    mesh, origins, directions, places = nasty("seams", dtype)
    transfer = testing.nasty_transfers(dtype=dtype)["many points"]
    want = jaxvr.render_rays(
        mesh, origins, directions, transfer, near=0.5 * places, far=places, compositor=compositor
    )
    for engine in (jaxvr.engine.C(), jaxvr.engine.XLA()):
        segments = jaxvr.trace(
            mesh, (origins, directions), near=0.5 * places, far=places, engine=engine
        )
        got = jaxvr.shade(segments, transfer, compositor=compositor)
        assert np.max(np.abs(got - want)) < 20 * EPS[dtype]


def test_a_camera_with_ends():
    mesh, camera = registry.mesh_of("point", "float64"), registry.camera_of("float64")
    transfer = registry.transfer_of("float64")
    origins, directions = camera.rays()
    want = jaxvr.render_rays(mesh, origins, directions, transfer, near=2.2, far=2.9)
    got = jaxvr.shade(jaxvr.trace(mesh, camera, near=2.2, far=2.9), transfer)
    assert np.allclose(got, want, atol=1e-14)
    assert np.max(np.abs(got - jaxvr.render(mesh, camera, transfer))) > 0.1


def test_mistakes():
    mesh, camera = registry.mesh_of("point", "float64"), registry.camera_of("float64")
    transfer = registry.transfer_of("float64")
    rays = camera.rays()
    far: Any = np.full((5, 6), 3.0)
    far[2, 3] = np.nan
    with pytest.raises(ValueError, match=r"far is NaN for 1 ray\(s\)"):
        jaxvr.render_rays(mesh, *rays, transfer, far=far)
    with pytest.raises(ValueError, match=r"near must be a number or have the shape \(5, 6\)"):
        jaxvr.render_rays(mesh, *rays, transfer, near=np.zeros(3))
    truths: Any = (True, [[True] * 6] * 5, jax.numpy.ones((5, 6), bool))
    for near in truths:
        with pytest.raises(ValueError, match="near must be None or hold distances"):
            jaxvr.render_rays(mesh, *rays, transfer, near=near)
    got = jax.jit(lambda far: jaxvr.render_rays(mesh, *rays, transfer, far=far))(far)
    assert np.isnan(got[2, 3]).all() and np.isfinite(np.delete(got.reshape(-1, 4), 15, 0)).all()
