"""Rendering against brute force on small meshes, the slab against its vectors, and brute force
against what can be said in closed form.

The rays and the comparison are those of `experiments/exactness.py`, which runs them on all of the
real data.
"""

from __future__ import annotations

import itertools
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import jaxvr
from experiments import exactness, lost_rays
from jaxvr.testing.brute import BruteForce
from jaxvr.volume import datasets
from tests.stand_ins import named

pytestmark = [pytest.mark.optimised, pytest.mark.usefixtures("loops")]

WORST = {"float64": 1e-10, "float32": 2e-5}


def _one_tet(values, location="point"):
    points = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], float)
    return SimpleNamespace(
        points=points, cells=np.array([[0, 1, 2, 3]]), values=np.asarray(values), location=location
    )


def test_reference_knows_the_chord_and_the_integral_of_one_cell():
    """s = x along a ray in x: extinction e x, colour x, from 0 to L; rgb = 1 - ... by parts."""
    reference = BruteForce(_one_tet([0.0, 1.0, 0.0, 0.0]))
    tf = SimpleNamespace(
        positions=np.array([0.0, 1.0]),
        extinctions=np.array([0.0, 2.0]),
        colors=np.array([[0.5] * 3, [0.5] * 3]),
    )
    y, z = 0.25, 0.125
    rgba, length = reference.render(np.array([[-1.0, y, z]]), np.array([[3.0, 0, 0]]), tf)
    chord = 1 - y - z
    alpha = -np.expm1(-(chord**2))
    np.testing.assert_allclose(length, chord, rtol=1e-14)
    np.testing.assert_allclose(rgba[0], [alpha / 2] * 3 + [alpha], rtol=1e-13)
    # from inside, only what lies ahead
    rgba, length = reference.render(np.array([[0.25, y, z]]), np.array([[1.0, 0, 0]]), tf)
    np.testing.assert_allclose(length, chord - 0.25, rtol=1e-14)
    np.testing.assert_allclose(rgba[0, 3], -np.expm1(-(chord**2 - 0.25**2)), rtol=1e-13)


def test_reference_splits_at_jumps_and_thick_slabs():
    reference = BruteForce(_one_tet([0.0, 1.0, 0.0, 0.0]))
    tf = SimpleNamespace(
        positions=np.array([0.25, 0.25]),
        extinctions=np.array([0.0, 400.0]),
        colors=np.array([[0.0] * 3, [0.75] * 3]),
    )
    rgba, _ = reference.render(np.array([[-1.0, 0.25, 0.25]]), np.array([[1.0, 0, 0]]), tf)
    alpha = -np.expm1(-400 * 0.25)
    np.testing.assert_allclose(rgba[0], [0.75 * alpha] * 3 + [alpha], rtol=1e-13)


def test_reference_counts_a_ray_in_shared_faces_once():
    mesh = datasets.box((2, 2, 2))
    g = np.arange(1, 8) / 8
    u, v = (x.ravel() for x in np.meshgrid(g, g))
    origins = np.stack([u, v, np.full(u.size, -1.0)], 1)
    found = BruteForce(mesh).lengths(origins, np.tile([0.0, 0, 1], (u.size, 1)))
    np.testing.assert_allclose(found, 1.0, rtol=1e-14)


def crossed(file, cases):
    """Parameters: a file with cases of others, of which the first says which loops run."""
    (entry,) = named(file)
    return [pytest.param(file, *case, marks=entry.marks) for case in cases]


FIELDS = {"beam.vtu": "sample_point_scalars"}
DTYPES, LOCATIONS = ("float32", "float64"), (None, "cell", "corner")
ALL = list(itertools.product(("compiled", "jax"), DTYPES, LOCATIONS))
# JAX's loops compile for ten seconds each time.
SOME = [("compiled", "float32", None), ("compiled", "float32", "cell")]
SOME += [("compiled", "float64", None), ("compiled", "float64", "corner")]
SOME += [("jax", "float32", "corner"), ("jax", "float64", None)]


@pytest.mark.parametrize(
    "file, loops, dtype, location",
    crossed("football_zoo.vtu", ALL) + crossed("beam.vtu", SOME),
    indirect=["loops"],
)
def test_zoo_cells(file_of, file, loops, dtype, location):
    rays = 800 if file == "football_zoo.vtu" else 400
    found = exactness.run_mesh(file_of(file), dtype, rays, location, FIELDS.get(file))
    assert found["status"] == 0
    assert found["worst"] <= WORST[dtype], found
    # only rays in the boundary or, for discontinuous data, in faces are left out
    assert found["ambiguous"] <= (80 if location else 8), found


def test_lattice_seen_exactly_along_its_axes(dtype):
    mesh = datasets.box((3, 3, 3), dtype=dtype)
    reference = BruteForce(mesh)
    rng = np.random.default_rng(4)
    found = exactness.compare(
        mesh,
        {
            "random": exactness.make_rays(mesh, reference, "random", 200, rng),
            "lattice": exactness.lattice_rays(mesh, reference),
            "on_vertex": exactness.make_rays(mesh, reference, "on_vertex", 200, rng),
        },
    )
    assert found["status"] == 0
    assert found["worst"] <= WORST[dtype], found


@pytest.mark.parametrize(
    "file, loops",
    crossed("football_zoo.vtu", [("compiled",), ("jax",)]) + crossed("beam.vtu", [("compiled",)]),
    indirect=["loops"],
)
def test_quadrature_is_an_independent_witness(file_of, file, loops):
    mesh = exactness.read_mesh(file_of(file), FIELDS.get(file), np.float64)
    reference = BruteForce(mesh)
    rays = exactness.make_rays(mesh, reference, "random", 100, np.random.default_rng(0))
    found = exactness.compare(mesh, {"random": rays}, integrator=jaxvr.Quadrature(samples=12))
    assert found["worst"] <= 1e-10, found


@pytest.mark.parametrize(
    "file, loops, dtype",
    crossed("football_zoo.vtu", itertools.product(("compiled", "jax"), DTYPES))
    + crossed("beam.vtu", [("compiled", "float64"), ("jax", "float32")]),
    indirect=["loops"],
)
def test_lost_rays_on_a_small_mesh(file_of, file, loops, dtype):
    found = lost_rays.run_mesh(file_of(file), dtype, 1000, 1, {}, FIELDS.get(file))
    assert found["status"] == 0
    assert found["differ_clear"] == 0, found


@pytest.mark.parametrize("file", named("vectors/segment_vectors_public.npz", "vectors/slabs.npz"))
@pytest.mark.parametrize(
    "dtype, value, slope", [("float64", 1e-15, 5e-15), ("float32", 5e-7, 7e-7)]
)
def test_slab_against_vectors(file_of, file, dtype, value, slope):
    found = exactness.check_slab(file_of(file), dtype)
    assert found["rgb"] <= value and found["alpha"] <= value, found
    assert found["jacfwd"] <= slope and found["jacrev"] <= slope, found
