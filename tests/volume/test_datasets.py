"""The generators: real fields on real kinds of mesh; and the finite elements behind the first."""

import itertools
from typing import Any

import numpy as np
import pytest

from jaxvr.volume import datasets, fem, packing
from jaxvr.volume.connectivity import FACES
from jaxvr.volume.describe import count_components
from jaxvr.volume.flow import potential_flow
from jaxvr.volume.quality import quality
from jaxvr.volume.weld import weld


def boundary_faces(mesh):
    words = np.asarray(mesh.boundary)
    c, f = packing.cell_of(words), packing.corner_of(words)
    return np.asarray(mesh.cells)[c[:, None], FACES[f]]


def euler(mesh):
    """V - E + F of the boundary surface: 2 for each sphere, 0 for each torus."""
    faces = weld(np.asarray(mesh.points))[0][boundary_faces(mesh)]
    edges = {tuple(sorted(e)) for f in faces.tolist() for e in itertools.combinations(f, 2)}
    return len(np.unique(faces)) - len(edges) + len(faces)


@pytest.mark.parametrize("cell", ["tetra", "hexahedron", "wedge", "pyramid"])
@pytest.mark.parametrize("shuffle", [False, True])
def test_box(cell, shuffle, dtype):
    mesh = datasets.box((2, 3, 4), 0.25, 1, cell, dtype=dtype, shuffle=shuffle)
    assert mesh.dtype == np.dtype(dtype) and mesh.report.input_cells[0][0] == cell
    assert mesh.report.warning() is None
    assert mesh.n_boundary == 4 * (2 * 3 + 3 * 4 + 2 * 4) and euler(mesh) == 2
    assert quality(mesh.points, mesh.cells).volume == pytest.approx(1.0, abs=1e-6)
    lo, hi = mesh.bounds()
    assert lo.tolist() == [0, 0, 0] and hi.tolist() == [1, 1, 1]


def test_box_fields_and_errors():
    assert np.array_equal(datasets.box(field=lambda p: p[:, 2]).values, datasets.box().points[:, 2])
    values = np.arange(48.0)
    assert datasets.box(field=values).location == "cell"
    assert datasets.box(field=np.ones((48, 4))).location == "corner"
    bads: tuple[dict[str, Any], ...] = (
        {"n": (0, 1, 1)},
        {"n": (1, 1)},
        {"jitter": 0.7},
        {"cell": "cube"},
    )
    for bad in bads:
        with pytest.raises(ValueError):
            datasets.box(**bad)


def test_heat_sink_has_all_cells_in_one_conforming_piece():
    mesh = datasets.heat_sink()
    assert {n for n, _ in mesh.report.input_cells} == {"tetra", "hexahedron", "wedge", "pyramid"}
    assert mesh.report.warning() is None and mesh.report.duplicate_points == 0
    assert 20_000 < mesh.n_tets < 60_000
    assert count_components(mesh.neighbors) == (1, mesh.n_tets) and euler(mesh) == 2
    # base, five fins and their gables
    volume = 4.4 * 0.8 * 4 + 5 * (0.4 * 2.4 * 4 + 0.4 * 0.2 / 2 * 4)
    assert quality(mesh.points, mesh.cells).volume == pytest.approx(volume, rel=1e-6)


def test_heat_flows_out_as_much_as_in(dtype):
    mesh = datasets.heat_sink(3, power=60.0, convection=0.04, dtype=dtype)
    p, u = np.asarray(mesh.points, float), np.asarray(mesh.values, float)
    faces = boundary_faces(mesh)
    cooled = faces[p[faces][..., 1].min(1) > 0.8 - 1e-5]
    out = (fem.measure(p, cooled) * 0.04 * (u[cooled].mean(1) - 293.15)).sum()
    assert out == pytest.approx(60.0, rel=1e-3 if dtype == "float32" else 1e-8)
    hottest = p[u.argmax()]
    assert hottest[1] == 0 and np.abs(hottest[[0, 2]] - p.max(0)[[0, 2]] / 2).max() < 0.5
    assert u.min() > 293.15 and p[u.argmin()][1] > 2.5


@pytest.mark.parametrize(
    "bad", [{"fins": 0}, {"fins": "3"}, {"resolution": 1}, {"conductivity": 0}, {"power": np.nan}]
)
def test_heat_sink_errors(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        datasets.heat_sink(**bad)


def test_other_heat_sinks():
    for kw in ({"fins": 1, "resolution": 3}, {"fins": 2, "resolution": 2}):
        mesh = datasets.heat_sink(**kw)
        assert mesh.report.warning() is None and euler(mesh) == 2


@pytest.mark.parametrize("cell", ["hexahedron", "pyramid"])
def test_finite_elements_converge_with_second_order(cell):
    """-div(2 grad u) = f with u known; convection on all sides, its ambient from u."""
    k, h = 2.0, 3.0

    def exact(p):
        return np.sin(2 * p[:, 0]) * np.cos(p[:, 1]) + p[:, 2] ** 2

    def gradient(p):
        x, y, z = p.T
        return np.stack([2 * np.cos(2 * x) * np.cos(y), -np.sin(2 * x) * np.sin(y), 2 * z], 1)

    errors = []
    for n in (4, 8):
        mesh = datasets.box((n, n, n), 0.2, 0, cell)
        p, tets = np.asarray(mesh.points), np.asarray(mesh.cells)
        faces = boundary_faces(mesh)
        centre = p[faces].mean(1)
        normal = np.where(np.isclose(centre, 0), -1.0, np.where(np.isclose(centre, 1), 1.0, 0.0))
        assert np.allclose(np.abs(normal).sum(1), 1)
        g = k * (gradient(centre) * normal).sum(1) + h * exact(centre)
        f = 5 * k * np.sin(2 * p[:, 0]) * np.cos(p[:, 1]) - 2 * k
        matrix = k * fem.stiffness(p, tets) + fem.mass(p, faces, h)
        right = fem.mass(p, tets, 1.0) @ f + fem.load(p, faces, g)
        error = fem.solve(matrix, right) - exact(p)
        errors.append(np.sqrt(error @ (fem.mass(p, tets, 1.0) @ error)))
    assert errors[0] / errors[1] > 3.2 and errors[1] < 5e-3


def test_finite_elements_are_exact_for_linear_fields():
    mesh = datasets.box((2, 3, 2), 0.2, 3, "hexahedron", shuffle=True)
    p, tets = np.asarray(mesh.points), np.asarray(mesh.cells)
    slope = np.array([1.0, -2.0, 0.5])
    u = p @ slope
    assert u @ (fem.stiffness(p, tets) @ u) == pytest.approx(slope @ slope)
    assert fem.mass(p, tets, 2.0).sum() == pytest.approx(2.0)
    assert fem.load(p, boundary_faces(mesh), 1.0).sum() == pytest.approx(6.0)


def test_cylinder_flow_is_a_closed_ring(dtype):
    for closed in (True, False):
        mesh = datasets.cylinder_flow((4, 12, 3), closed=closed, dtype=dtype)
        assert mesh.n_tets == 6 * 4 * 12 * 3 and mesh.report.warning() is None
        assert mesh.report.duplicate_points == (0 if closed else 5 * 4)
        assert mesh.report.seams == (0 if closed else 2 * 4 * 3)
        assert mesh.n_boundary == 2 * (2 * 4 * 12 + 2 * 12 * 3) and euler(mesh) == 0
        assert count_components(mesh.neighbors)[0] == 1


def test_cylinder_flow_solves_the_equations():
    """Closed form: no flow through the wall, twice the speed beside it, curl and divergence 0."""
    mesh = datasets.cylinder_flow((6, 24, 2))
    p, speed = np.asarray(mesh.points), np.asarray(mesh.values)
    wall = np.isclose(np.hypot(p[:, 0], p[:, 1]), 1)
    assert speed[wall] == pytest.approx(2 * np.abs(p[wall, 1]), abs=1e-14)
    pressure = datasets.cylinder_flow((6, 24, 2), field="pressure").values
    assert np.asarray(pressure) == pytest.approx(1 - speed**2, abs=1e-14)
    v = potential_flow(p, 1.0, circulation=1.7)
    assert (v[wall] * p[wall, :2]).sum(1) == pytest.approx(0, abs=1e-14)
    q = p[~wall] * 1.1
    d = 1e-5
    dx, dy = (
        (potential_flow(q + e, 1.0, 1.7) - potential_flow(q - e, 1.0, 1.7)) / (2 * d)
        for e in (np.array([[d, 0, 0]]), np.array([[0, d, 0]]))
    )
    assert dx[:, 0] + dy[:, 1] == pytest.approx(0, abs=1e-8)
    assert dx[:, 1] - dy[:, 0] == pytest.approx(0, abs=1e-8)
    angle = 2 * np.pi * np.arange(200) / 200
    ring = 3 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    tangent = np.stack([-np.sin(angle), np.cos(angle)], 1)
    around = (potential_flow(ring, 1.0, 1.7) * tangent).sum(1).mean() * 2 * np.pi * 3
    assert around == pytest.approx(-1.7)


def test_cylinder_flow_errors():
    bads: tuple[dict[str, Any], ...] = (
        {"n": (1, 2, 1)},
        {"radius": 5.0},
        {"length": 0.0},
        {"field": "vorticity"},
    )
    for bad in bads:
        with pytest.raises(ValueError):
            datasets.cylinder_flow(**bad)
