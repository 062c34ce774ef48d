"""Meshes and transfer functions whose leaves were computed with: told, never followed into a crash,
an endless loop or a wrong picture."""

from __future__ import annotations

import dataclasses
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvr
from jaxvr._core.status import BROKEN, LOST, UNSORTED
from jaxvr.volume import MeshReport, packing
from jaxvr.volume.integrity import components_of, hold, require_mesh

MESH = jaxvr.datasets.box((2, 2, 1), field=lambda p: p[:, 0] + 0.2 * p[:, 1], dtype="float32")
CAMERA = jaxvr.Camera.orbit(MESH, azimuth=31, elevation=17, width=4, height=3)
TRANSFER = jaxvr.TransferFunction([0.0, 0.4, 1.3], np.eye(3), [0.5, 2.0, 4.0], dtype="float32")
INTEGERS = ("cells", "neighbors", "boundary")
ENGINES = {"compiled": None, "jax": jaxvr.engine.XLA()}

pytestmark = pytest.mark.usefixtures("quick_code")


def changed(**leaves):
    return dataclasses.replace(MESH, **leaves)


def mutants(count, seed):
    """Meshes with one integer changed: bits flipped, out of range, or that of another entry."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        name = INTEGERS[rng.integers(3)]
        x = np.array(getattr(MESH, name))
        at = tuple(rng.integers(n) for n in x.shape)
        other = tuple(rng.integers(n) for n in x.shape)
        numbers: Any = [x[at] ^ (1 << int(rng.integers(31))), -7, 2**31 - 1, -(2**31), x[other]]
        x[at] = rng.choice(numbers)
        yield name, changed(**{name: jnp.asarray(x)})


VERBS = {
    "render": lambda m: jaxvr.render(m, CAMERA, TRANSFER),
    "rays": lambda m: jaxvr.render_rays(m, *CAMERA.rays(), TRANSFER),
    "trace": lambda m: jaxvr.trace(m, CAMERA),
    "probe": lambda m: jaxvr.probe(m, CAMERA, TRANSFER),
    "measure_k": lambda m: jaxvr.measure_k(m, CAMERA),
    "exact_order": lambda m: jaxvr.order.exact_order(m, CAMERA),
    "refine": lambda m: jaxvr.refine(m),
}


@pytest.mark.parametrize("verb", VERBS)
@pytest.mark.parametrize("name", INTEGERS)
def test_an_average_over_all_leaves_names_the_integers(verb, name):
    halves = changed(**{name: getattr(MESH, name) / 2})
    with pytest.raises(ValueError, match=rf"mesh\.{name} must hold integers.*mesh\.replace"):
        VERBS[verb](halves)


@pytest.mark.parametrize("verb", VERBS)
def test_integers_of_no_mesh_are_an_error(verb):
    scaled = changed(neighbors=MESH.neighbors * 3)
    with pytest.raises(ValueError, match=r"mesh\.neighbors is not that of a mesh"):
        VERBS[verb](scaled)


def test_numbers_that_are_not_finite_are_an_error():
    for name in ("points", "values"):
        broken = changed(**{name: getattr(MESH, name).at[3].set(jnp.nan)})
        with pytest.raises(ValueError, match=rf"mesh\.{name}"):
            jaxvr.render(broken, CAMERA, TRANSFER)


def test_traced_points_that_are_not_finite_are_told_to_all_rays():
    """A ray that passes a face which is nowhere meets nothing that could tell."""
    fits = jax.jit(lambda m: hold(m, jnp.zeros(2, jnp.int32)))
    for number in (jnp.nan, jnp.inf):
        assert (fits(changed(points=MESH.points.at[3, 1].set(number))) == LOST).all()
    assert not fits(MESH).any()


@pytest.mark.parametrize("name", [*INTEGERS, "duplicates"])
@pytest.mark.parametrize("kind", ["int16", "int64"])
def test_integers_of_another_width_are_an_error(name, kind):
    """Compiled loops would read them as what they are not."""
    wide = changed(**{name: np.asarray(getattr(MESH, name)).astype(kind)})
    for draw in (jaxvr.render, jax.jit(lambda *x: jaxvr.render(*x, status=True))):
        if draw is not jaxvr.render and kind == "int64" and jnp.zeros(()).dtype != "float64":
            continue  # a jit without 64 bits makes 32 of them
        with pytest.raises(ValueError, match=rf"mesh\.{name} must hold integers \(int32\).*{kind}"):
            draw(wide, CAMERA, TRANSFER)


def test_points_and_values_of_two_dtypes_are_an_error():
    for name in ("points", "values"):
        for kind in ("float16", "int32"):
            mixed = changed(**{name: getattr(MESH, name).astype(kind)})
            with pytest.raises(ValueError, match=r"mesh\.\w+ has dtype"):
                jaxvr.render(mixed, CAMERA, TRANSFER)


SEGMENTS = {
    "halved": lambda s: {"start": s.start / 2},
    "scaled": lambda s: {"start": s.start * 1000},
    "reversed": lambda s: {"start": s.start[::-1]},
    "wide": lambda s: {"start": np.asarray(s.start).astype("int64")},
    "places": lambda s: {"order": s.order * 3},
    "cut": lambda s: {"order": s.order[:-1]},
    "mixed": lambda s: {"length": s.length.astype("float16")},
    "shifted": lambda s: {"start": s.start + 1},
    "no number": lambda s: {"scalar": s.scalar * jnp.nan},
}


@pytest.mark.parametrize("name", SEGMENTS)
def test_segments_that_were_computed_with_are_told(name):
    """In an error, or under jit, where integers of the right kind are traced, a picture of NaN."""
    segments = jaxvr.trace(MESH, CAMERA)
    change = SEGMENTS[name](segments)
    broken = dataclasses.replace(segments, **change)
    with pytest.raises(ValueError, match=rf"segments\.{next(iter(change))}"):
        jaxvr.shade(broken, TRANSFER)
    if name in ("scaled", "places"):
        shade = jax.jit(lambda s: jaxvr.shade(s, TRANSFER, engine=ENGINES["jax"]))
        assert np.isnan(shade(broken)).all()
        assert np.isfinite(shade(segments)).all()


def test_integers_of_another_mesh():
    other = jaxvr.datasets.box((2, 1, 1), field=lambda p: p[:, 0], dtype="float32")
    with pytest.raises(ValueError, match="must have shape"):
        jaxvr.render(changed(points=other.points), CAMERA, TRANSFER)
    with pytest.raises(ValueError, match="not that of a mesh"):
        jaxvr.render(changed(boundary=MESH.boundary[:-1]), CAMERA, TRANSFER)


def test_changed_integers_are_found():
    """All but those that change nothing."""
    found = 0
    for name, mutant in mutants(200, seed=1):
        if np.array_equal(getattr(MESH, name), getattr(mutant, name)):
            continue
        with pytest.raises(ValueError, match=r"mesh\.\w+ is not that of a mesh"):
            jaxvr.render(mutant, CAMERA, TRANSFER)
        found += 1
    assert found > 120


def seamed():
    """Two boxes that touch in points of their own."""
    points, cells = np.asarray(MESH.points), np.asarray(MESH.cells)
    both = np.concatenate([points, points * np.array([-1, 1, 1], np.float32)])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # rows of a mesh are sorted, not oriented
        return jaxvr.TetMesh.from_cells(
            both, {"tetra": np.concatenate([cells, cells + len(points)])}, both[:, 1]
        )


BITS = {
    "turned": ("neighbors", 4),
    "seam": ("neighbors", 8),
    "turned at the boundary": ("boundary", 4),
}
BITS |= {"entry": ("boundary", 8)}


@pytest.mark.parametrize("bit", BITS)
@pytest.mark.parametrize("make", [lambda: MESH, seamed], ids=["box", "seamed"])
def test_each_bit_is_confirmed_by_others(make, bit):
    """Of every word, under jit as well."""
    mesh, (name, mask) = make(), BITS[bit]
    require_mesh(mesh)
    fits = jax.jit(lambda m: hold(m, jnp.zeros((), jnp.int32)))
    assert int(fits(mesh)) == 0
    words = np.array(getattr(mesh, name))
    for place in np.argwhere(words >= 0):
        other = words.copy()
        other[tuple(place)] ^= mask
        mutant = dataclasses.replace(mesh, **{name: jnp.asarray(other)})
        with pytest.raises(ValueError, match=r"mesh\.(neighbors|boundary) is not that of a mesh"):
            require_mesh(mutant)
        assert int(fits(mutant)) == BROKEN


def test_meshes_with_folds_and_more_are_sound():
    """What is built is confirmed, whatever lies the wrong way round in it."""
    rng = np.random.default_rng(0)
    for scale in (0.2, 0.5, 2.0):
        points = np.asarray(MESH.points) + scale * rng.normal(size=MESH.points.shape)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            folded = jaxvr.TetMesh.from_cells(
                points, {"tetra": np.asarray(MESH.cells)}, np.asarray(MESH.values)
            )
            moved = folded.replace(points=rng.permutation(points))
        for mesh in (folded, moved):
            copies = jax.tree.map(lambda x: jnp.array(x), mesh)  # of which nothing is known
            require_mesh(copies)
            assert int(jax.jit(lambda m: hold(m, jnp.zeros((), jnp.int32)))(copies)) == 0


def test_points_that_mirror_by_hand_are_an_error():
    inverted = jax.tree.map(lambda x: -x if x.dtype.kind == "f" else x, MESH)
    with pytest.raises(ValueError, match="inside out.*mesh.replace"):
        jaxvr.render(inverted, CAMERA, TRANSFER)
    whole = MESH.replace(points=-MESH.points)
    assert float(jaxvr.render(whole, CAMERA, TRANSFER).max()) > 0


@pytest.mark.parametrize("unit", [1e-30, 1.0, 1e30])
def test_points_that_mirror_while_traced_are_told(unit):
    """In a status or, where none is asked for, a picture of NaN, and not in a blank one."""

    def draw(points, status):
        mesh = MESH.replace(points=points)
        return jaxvr.render(mesh, CAMERA, TRANSFER, engine=ENGINES["jax"], status=status)

    fits = jax.jit(lambda p: hold(MESH.replace(points=p), jnp.zeros((), jnp.int32)))
    assert int(fits(unit * MESH.points)) == 0
    for mirror in ([1, -1, 1], [-1, -1, -1]):
        assert int(fits(unit * MESH.points * jnp.asarray([mirror], jnp.float32))) == BROKEN
    assert int(fits(unit * MESH.points[:, ::-1])) == BROKEN
    assert int(fits(unit * MESH.points[:, jnp.asarray([1, 2, 0])])) == 0
    assert int(fits(MESH.points * jnp.asarray([[1, 0, 1]], jnp.float32))) == 0  # flat, not mirrored
    if unit == 1.0:
        image, bits = jax.jit(draw, static_argnums=1)(-MESH.points, True)
        assert (np.asarray(bits) & BROKEN).all()
        assert np.isnan(jax.jit(draw, static_argnums=1)(-MESH.points, False)).all()
        assert np.isfinite(jax.jit(draw, static_argnums=1)(MESH.points, False)).all()


def apart(sizes, places):
    """Boxes of these sizes about these places, (N,) and (N, 3), and the box (P,) of each point."""
    points, cells = np.asarray(MESH.points, np.float64), np.asarray(MESH.cells)
    middle, count = points.mean(0), len(points)
    both = np.concatenate([(points - middle) * s + p for s, p in zip(sizes, places, strict=True)])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # rows of a mesh are sorted, not oriented
        mesh = jaxvr.TetMesh.from_cells(
            both.astype(np.float32),
            {"tetra": np.concatenate([cells + k * count for k in range(len(sizes))])},
            both[:, 0],
        )
    return mesh, np.repeat(np.arange(len(sizes)), count)


@pytest.mark.parametrize("traced", ["all leaves", "points"])
def test_a_component_that_is_mirrored_while_traced_is_told(traced):
    """Whichever of several it is, and however small it is beside the others."""
    places = np.array([[0, 0, 0], [3, 0, 0], [0, 5, 0], [7, 7, 7.0]])
    mesh, of = apart([1, 1, 2, 1e-3], places)
    assert mesh.report.components == 4
    for mesh in (mesh, dataclasses.replace(mesh, report=MeshReport())):  # not counted
        if traced == "points":
            fits = jax.jit(lambda p, m=mesh: hold(m.replace(points=p), jnp.zeros((), jnp.int32)))
        else:
            held = jax.jit(lambda m: hold(m, jnp.zeros((), jnp.int32)))
            fits = lambda p, m=mesh: held(dataclasses.replace(m, points=p))  # noqa: E731
        assert int(fits(mesh.points)) == 0
        for chosen in ([0], [1], [3], [0, 3], [0, 1, 2, 3]):
            mirrored = np.array(mesh.points)
            for k in chosen:
                mirrored[of == k, 2] = 2 * np.float32(places[k, 2]) - mirrored[of == k, 2]
            assert int(fits(jnp.asarray(mirrored))) == BROKEN, chosen
        flat = mesh.points.at[:, 2].set(jnp.where(of == 1, 0.0, mesh.points[:, 2]))
        assert int(fits(flat)) == 0


def test_components_are_those_of_a_search():
    rng = np.random.default_rng(3)
    for count, links in ((1, 0), (40, 12), (300, 220), (300, 290)):
        words = np.full((count, 4), -1, np.int32)
        order = rng.permutation(count)  # a long path in no order, cut in places
        for a, b in zip(order[:links], order[1:], strict=False):
            words[a, 1], words[b, 2] = packing.pack(b, 2, 0), packing.pack(a, 1, 0)
        want, pairs = np.arange(count), np.argwhere(words >= 0)
        for _ in range(count):
            for a, k in pairs:
                want[a] = min(want[a], want[packing.cell_of(words[a, k])])
        assert np.array_equal(components_of(jnp.asarray(words)), want)


def test_one_sided_meshes_have_no_rule_for_entries():
    """Four cells round an edge, ends glued the wrong way: what was built is drawn."""
    rng = np.random.default_rng(3)
    cells = [[i, i + 1, i + 2, i + 3] for i in range(5)]
    cells += [[5, 6, 7, 1], [6, 7, 1, 0], [7, 1, 0, 2]]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ring = jaxvr.TetMesh.from_cells(
            rng.normal(size=(8, 3)),
            {"tetra": cells},
            rng.normal(size=8),
            location="point",
            dtype="float32",
        )
    assert ring.report.one_sided == 1
    copies = jax.tree.map(lambda x: jnp.array(x), ring)
    require_mesh(copies)
    assert int(jax.jit(lambda m: hold(m, jnp.zeros((), jnp.int32)))(copies)) & BROKEN == 0


def test_replace_looks_at_the_integers_first():
    with pytest.raises(ValueError, match="is not that of a mesh"):
        changed(boundary=MESH.boundary * 1000).replace(points=-MESH.points)


@pytest.mark.parametrize("engine", ENGINES)
def test_traced_integers_end_in_a_status(engine):
    """Under a user's jit nothing can be raised: whatever the integers are, rays end, and all say
    so, in range or not."""
    draw = jax.jit(lambda m: jaxvr.render(m, CAMERA, TRANSFER, engine=ENGINES[engine], status=True))
    assert not np.asarray(draw(MESH)[1]).any()
    order = np.random.default_rng(0).permutation(MESH.n_tets)
    permuted = [(n, changed(**{n: getattr(MESH, n)[order]})) for n in ("cells", "neighbors")]
    for name, mutant in (*mutants(100, seed=2), *permuted):
        x, old = np.asarray(getattr(mutant, name)), np.asarray(getattr(MESH, name))
        bits = np.asarray(draw(mutant)[1])
        if (x != old).any():
            assert (bits & BROKEN).all(), (name, x[x != old], old[x != old])


def test_a_picture_of_broken_integers_is_nan_where_no_status_is_asked_for():
    """Of compiled loops the gradient is an error as well."""

    def loss(values, mesh):
        mesh = dataclasses.replace(mesh, values=values)
        image = jaxvr.render(mesh, CAMERA, TRANSFER, engine=ENGINES["jax"])
        return image.sum(), image

    draw = jax.jit(jax.grad(loss, has_aux=True))
    gradient, image = draw(MESH.values, MESH)
    assert np.isfinite(gradient).all() and np.isfinite(image).all() and gradient.any()
    gradient, image = draw(MESH.values, changed(neighbors=MESH.neighbors.at[0].add(1 << 20)))
    assert np.isnan(gradient).any() and np.isnan(image).all()


@pytest.mark.parametrize("engine", ENGINES)
def test_rings_end(engine):
    """Each cell's neighbour across any face is the cell itself: a walk that never leaves."""
    cell = np.arange(MESH.n_tets)[:, None] << 4 | np.arange(4)[None]
    ring = changed(neighbors=jnp.asarray(cell.astype(np.int32)))
    draw = jax.jit(lambda m: jaxvr.render(m, CAMERA, TRANSFER, engine=ENGINES[engine], status=True))
    bits = np.asarray(draw(ring)[1])
    assert (bits & BROKEN).any()


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("positions", [[0.4, 0.0, 1.3], [0.0, np.nan, 1.3], [1.3, 0.4, -np.inf]])
def test_positions_out_of_order(engine, positions):
    leaves = (jnp.asarray(positions, jnp.float32), TRANSFER.colors, TRANSFER.extinctions)
    moved = jax.tree.unflatten(jax.tree.structure(TRANSFER), leaves)
    with pytest.raises(ValueError, match="positions"):
        jaxvr.render(MESH, CAMERA, moved)
    segments = jaxvr.trace(MESH, CAMERA)
    with pytest.raises(ValueError, match="positions"):
        jaxvr.shade(segments, moved)
    draw = jax.jit(lambda t: jaxvr.render(MESH, CAMERA, t, engine=ENGINES[engine], status=True))
    image, bits = draw(moved)
    assert np.isfinite(image).all() and (np.asarray(bits) & UNSORTED).all()
    with pytest.raises(jaxvr.RenderError, match="ascending order"):
        jaxvr.check(bits)
    assert not np.asarray(draw(TRANSFER)[1]).any()
