"""The meshes of the VTK project and of NASA: counts, repairs, seams, folds and cracks."""

import numpy as np
import pytest

from jaxvr.volume import TetMesh, packing, read_mesh
from jaxvr.volume.connectivity import FACES
from jaxvr.volume.describe import count_components
from jaxvr.volume.quality import quality

# tets, degenerate dropped, inverted turned, boundary faces, duplicate points, seam faces. Against
# the six-tets-a-hexahedron counts: two hexahedra of disk_out_ref get five. Boundaries are those of
# welded points: bluntfin 13,516 before, oxygen_post 27,676 before.
COUNTS = {
    "bluntfin": (224_874 - 115, 115, 0, 13_438, 39, 77),
    "bluntfin_merged": (224_759, 1, 0, 13_438, 0, 0),
    "oxygen_post": (616_050, 0, 0, 27_676 - 4 * 37 * 37, 1444, 2 * 37 * 37),
    "disk_out_ref": (44_832 - 2, 0, 0, 3_976, 0, 0),
    "can": (28_800, 0, 77, 7_360, 0, 0),
    "post_tets": (8_750, 0, 0, 1_980, 88, 0),
    "cylinder_tets": (1_522, 0, 0, 726, 0, 0),
    "cylinder_tetra10": (1_522, 0, 0, 726, 0, 0),
    "football_zoo": (2_028, 0, 0, 156, 0, 0),
    "hexa_lattice": (63_888, 0, 0, 5_808, 0, 0),
}
WARNS = {"bluntfin": "115 degenerate", "bluntfin_merged": "1 degenerate", "can": "77 inverted"}


NAMED = [pytest.param(name, marks=pytest.mark.outside(f"{name}.vtu")) for name in COUNTS]


@pytest.fixture(scope="module")
def load(data_path):
    cache: dict[str, TetMesh] = {}

    def get(name):
        if name not in cache:
            path = data_path(f"{name}.vtu")
            if name in WARNS:
                with pytest.warns(UserWarning, match=WARNS[name]) as caught:
                    cache[name] = read_mesh(path)
                assert len(caught) == 1 and caught[0].filename == __file__
            else:
                cache[name] = read_mesh(path)
        return cache[name]

    return get


@pytest.mark.parametrize("name", NAMED)
def test_counts(load, name):
    mesh = load(name)
    r = mesh.report
    assert COUNTS[name] == (
        mesh.n_tets,
        r.degenerate,
        r.inverted,
        mesh.n_boundary,
        r.duplicate_points,
        r.seams,
    )
    assert count_components(mesh.neighbors)[0] == 1
    assert r.folded == (77 if name == "can" else 0) and r.one_sided == 0
    assert r.tets == mesh.n_tets


@pytest.mark.parametrize("name", NAMED)
def test_invariants(load, name):
    """What a walk relies on, vectorised."""
    mesh = load(name)
    cells, words = np.asarray(mesh.cells), np.asarray(mesh.neighbors)
    points = np.asarray(mesh.points, np.float64)
    welded = np.arange(mesh.n_points)
    welded[np.asarray(mesh.duplicates)[:, 0]] = np.asarray(mesh.duplicates)[:, 1]
    rows = welded[cells]
    assert (np.diff(rows, axis=1) > 0).all()
    c, k = np.nonzero(words >= 0)
    w = words[c, k]
    n, f = packing.cell_of(w), packing.corner_of(w)
    back = words[n, f]
    assert np.array_equal(packing.cell_of(back), c) and np.array_equal(packing.corner_of(back), k)
    assert np.array_equal(packing.flag_of(back), packing.flag_of(w))
    assert np.array_equal(rows[c[:, None], FACES[k]], rows[n[:, None], FACES[f]])
    own = cells[c[:, None], FACES[k]] != cells[n[:, None], FACES[f]]
    assert np.array_equal(packing.flag_of(w).astype(bool), own.any(1))
    sign = np.sign(np.linalg.det(points[cells[:, 1:]] - points[cells[:, :1]]))
    if name not in ("bluntfin", "bluntfin_merged"):  # slivers need the exact determinant
        assert (sign != 0).all()
    opposite = sign[c] * sign[n] * np.where((k + f) % 2 == 0, 1, -1) < 0
    same_bits = packing.turned_of(w) == packing.turned_of(back)
    assert np.array_equal(opposite, same_bits)
    b = np.asarray(mesh.boundary)
    cb, fb = packing.cell_of(b), packing.corner_of(b)
    assert (
        len(np.unique(4 * cb + fb)) == len(b) == (words < 0).sum() and (words[cb, fb] == -1).all()
    )
    tau = sign[cb] * np.where(packing.turned_of(b) == 1, -1, 1)
    entry = np.where(fb % 2 == 1, tau, -tau) > 0
    assert np.array_equal(packing.flag_of(b).astype(bool), entry)


@pytest.mark.outside("bluntfin.vtu", "bluntfin_merged.vtu")
def test_blunt_fin_with_and_without_its_duplicates_is_the_same_volume(load):
    one, two = load("bluntfin"), load("bluntfin_merged")
    a, b = quality(one.points, one.cells), quality(two.points, two.cells)
    assert a.volume == pytest.approx(b.volume, rel=1e-12)
    assert a.min_dihedral == pytest.approx(0.017, abs=5e-4)
    assert a.edge_ratio == pytest.approx(2648, abs=1)


@pytest.mark.outside("oxygen_post.vtu")
def test_seam_of_the_oxygen_post_is_closed_and_keeps_both_sides(load):
    mesh = load("oxygen_post")
    seam = (np.asarray(mesh.neighbors) >= 0) & (packing.flag_of(np.asarray(mesh.neighbors)) == 1)
    assert seam.sum() == 2 * mesh.report.seams
    used = np.zeros(mesh.n_points, bool)
    used[np.asarray(mesh.cells)] = True
    assert used.all()


@pytest.mark.outside("post_tets.vtu")
def test_crack_of_the_post_stays_open(load):
    """Points coincide along the crack, but no face has the same three on both sides."""
    mesh = load("post_tets")
    assert mesh.report.duplicate_points == 88 and mesh.report.seams == 0


@pytest.mark.outside("can.vtu")
def test_folds_of_the_can(load):
    mesh = load("can")
    words = np.asarray(mesh.neighbors)
    turned = np.unique(packing.cell_of(words[(words >= 0) & (packing.turned_of(words) == 1)]))
    b = np.asarray(mesh.boundary)
    turned = np.union1d(turned, packing.cell_of(b[packing.turned_of(b) == 1]))
    assert len(turned) == 77


@pytest.mark.outside("football_zoo.vtu", "can.vtu")
def test_cell_data_of_a_zoo(data_path):
    mesh = read_mesh(data_path("football_zoo.vtu"), "scalar1")
    assert mesh.location == "cell" and mesh.values.shape == (2028,)
    can = data_path("can.vtu")
    with pytest.warns(UserWarning, match="77"):
        assert read_mesh(can, "EQPS").location == "cell"


@pytest.mark.outside("cylinder_tets.vtu", "cylinder_tetra10.vtu")
def test_quadratic_cells_are_their_linear_ones(load):
    linear, quadratic = load("cylinder_tets"), load("cylinder_tetra10")
    assert quadratic.report.reduced == (("tetra10", 1522),)
    a, b = (quality(m.points, m.cells) for m in (linear, quadratic))
    assert a.volume == pytest.approx(b.volume, rel=1e-12)
