"""What the tests on outside data cover, in small: the hexahedral beam that PyVista's wheel brings,
and slabs whose reference is computed here. They run in any clone."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import pyvista
from pyvista import examples

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import jaxvr
from experiments import exactness, lost_rays
from jaxvr.volume.describe import count_components
from jaxvr.volume.quality import quality
from tests.reference import Reference
from tests.test_exactness import WORST

FIELD = "sample_point_scalars"


@pytest.fixture(scope="module")
def beam(tmp_path_factory):
    """The beam as a VTU file; the experiments read it from their folder of data."""
    path = tmp_path_factory.mktemp("data") / "beam.vtu"
    pyvista.read(examples.hexbeamfile).cast_to_unstructured_grid().save(path)
    with pytest.MonkeyPatch.context() as patch:
        for module in (exactness, lost_rays):
            patch.setattr(module, "DATA", path.parent)
            patch.setitem(module.FIELDS, "beam", FIELD)
        yield path


def test_counts(beam):
    """40 hexahedra of 5 or 6 tetrahedra; the hull has 2 x 2 squares at the ends and 4 x 2 x 10
    along the sides, two triangles each."""
    mesh = jaxvr.read_mesh(beam, FIELD)
    r = mesh.report
    assert 5 * 40 <= mesh.n_tets <= 6 * 40 and mesh.n_boundary == 2 * (2 * 4 + 80)
    assert (r.degenerate, r.inverted, r.seams, r.duplicate_points, r.folded) == (0, 0, 0, 0, 0)
    assert count_components(mesh.neighbors)[0] == 1
    assert quality(mesh.points, mesh.cells).volume == pytest.approx(5.0, rel=1e-6)
    cell = jaxvr.read_mesh(beam, "sample_cell_scalars")
    assert cell.location == "cell" and cell.values.shape == (mesh.n_tets,)


@pytest.mark.parametrize("location", [None, "cell", "corner"])
def test_against_brute_force(beam, dtype, location):
    found = exactness.run_mesh("beam", dtype, 400, location)
    assert found["status"] == 0
    assert found["worst"] <= WORST[dtype], found


def test_quadrature_is_an_independent_witness(beam):
    mesh = exactness.read_mesh(beam, FIELD, np.float64)
    reference = Reference(mesh)
    rays = exactness.make_rays(mesh, reference, "random", 100, np.random.default_rng(0))
    found = exactness.compare(mesh, {"random": rays}, integrator=jaxvr.Quadrature(samples=12))
    assert found["worst"] <= 1e-10, found


def test_no_ray_is_lost(beam, dtype):
    found = lost_rays.run_mesh("beam", dtype, 500, 1, {})
    assert found["status"] == 0
    assert found["differ_clear"] == 0, found


def test_cut_file_is_refused(beam, tmp_path):
    raw, path = beam.read_bytes(), tmp_path / "cut.vtu"
    for n in range(0, len(raw) - 40, len(raw) // 10):
        path.write_bytes(raw[:n])
        with pytest.raises((ValueError, OSError)):
            jaxvr.read_mesh(path)


def _slab(x, t, weights):
    """rgb and alpha of slabs x (n, 9) = (tau_f, tau_b, C_f, C_b, l), by a rule for t in [0, 1]:
    rgb = int C(t) tau(t) l exp(-l (tau_f t + (tau_b - tau_f) t^2 / 2)) dt. Complex numbers pass."""
    tau_f, tau_b, length = x[:, :1], x[:, 1:2], x[:, 8:9]
    through = np.exp(-length * (tau_f * t + (tau_b - tau_f) * t * t / 2))
    light = (tau_f + (tau_b - tau_f) * t) * length * through * weights
    color = x[:, 2:5, None] + (x[:, 5:8] - x[:, 2:5])[..., None] * t
    alpha = -np.expm1(-length * (tau_f + tau_b) / 2)
    return np.concatenate([(color * light[:, None]).sum(2), alpha], 1), through


@pytest.mark.parametrize(
    "dtype, value, slope", [("float64", 2e-15, 2e-14), ("float32", 5e-7, 7e-7)]
)
def test_slab_against_a_rule_of_many_nodes(tmp_path, dtype, value, slope):
    """Derivatives are imaginary parts at a step of 1e-30: no difference, so no cancellation."""
    rng = np.random.default_rng(5)
    x = rng.uniform(0, 1, (300, 9))
    x[:, :2] *= 3
    x[::10, 0] = x[::10, 1]
    x[5::10, 1] = 0
    x = x.astype(np.float32).astype(float)
    nodes, weights = np.polynomial.legendre.leggauss(48)
    t, weights = (nodes + 1) / 2, weights / 2
    result, through = _slab(x, t, weights)
    steps = [_slab(x + 1e-30j * np.eye(9)[k], t, weights)[0].imag / 1e-30 for k in range(9)]
    basis = np.stack([(1 - t) ** 2, 2 * t * (1 - t), t * t])
    jac = np.stack(steps, -1)
    path = tmp_path / "slabs.npz"
    np.savez(
        path,
        **{"tau_f": x[:, 0], "tau_b": x[:, 1], "C_f": x[:, 2:5], "C_b": x[:, 5:8], "l": x[:, 8]},
        **{"rgb": result[:, :3], "alpha": result[:, 3], "jac": jac},
        **{"w_f": jac[:, 0, 2], "w_b": jac[:, 0, 5]},
        B=(basis * (through * weights)[:, None]).sum(2),
        f32_exact_inputs=np.ones(len(x), bool),
    )
    found = exactness.check_slab(path, dtype)
    assert found["rows"] == 300
    assert found["rgb"] <= value and found["alpha"] <= value, found
    assert found["jacfwd"] <= slope and found["jacrev"] <= slope, found
