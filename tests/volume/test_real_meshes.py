"""The meshes of the VTK project and of NASA, and those that stand in for them anywhere: counts,
repairs, seams, folds and cracks."""

import warnings
from collections import defaultdict

import numpy as np
import pytest

from jaxvr.volume import TetMesh, packing, read_mesh
from jaxvr.volume.connectivity import FACES
from jaxvr.volume.describe import count_components
from jaxvr.volume.quality import quality
from tests.stand_ins import LAYERS, RINGS, TURNS, named, pulled, ring_volume

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
BLOCKS = TURNS * LAYERS  # of one ring
AXIS = 3 * BLOCKS  # a hexahedron with an edge twice is a wedge: three of its six are left
ENDS = 2 * TURNS * (2 * RINGS - 1)  # of the tube, triangles round the axis
# By counting, not by what came out. A cell at the axis has two sets of coincident points there and
# uses one, its neighbour another, so that faces there join different points too.
COUNTS |= {
    "lattice": (6 * 27, 0, 0, 2 * 6 * 9, 0, 0),
    "beam": (6 * 40, 0, 0, 2 * (2 * 4 + 80), 0, 0),
    "cells": (6 + 6 * 2 + 2 * 3 + 2, 0, 0, 2 * 14 + 2 * 2, 0, 0),
    "pipe": (
        *(6 * BLOCKS * RINGS, 0, 0, 2 * 2 * BLOCKS + 2 * 2 * TURNS * RINGS),
        *((RINGS + 1) * (LAYERS + 1), 2 * RINGS * LAYERS),
    ),
    "tube": (
        *(6 * BLOCKS * RINGS - AXIS, AXIS, 0, 2 * BLOCKS + ENDS),
        *((RINGS + TURNS) * (LAYERS + 1), 2 * LAYERS * (RINGS + TURNS - 1)),
    ),
    "tube_merged": (6 * BLOCKS * RINGS - AXIS, AXIS, 0, 2 * BLOCKS + ENDS, 0, 0),
    "crack": (2 * 6 * 8, 0, 0, 2 * 2 * 6 * 4, 9, 0),
    "folds": (6 * 27, 0, 4, 2 * 6 * 9, 0, 0),
    "linear": (6 * 8, 0, 0, 2 * 6 * 4, 0, 0),
    "quadratic": (6 * 8, 0, 0, 2 * 6 * 4, 0, 0),
}
WARNS = {"bluntfin": "115 degenerate", "bluntfin_merged": "1 degenerate", "can": "77 inverted"}
WARNS |= {"tube": f"{AXIS} degenerate", "tube_merged": f"{AXIS} degenerate", "folds": "4 inverted"}
FOLDED = {"can": 77, "folds": 4}
PIECES = {"crack": 2}

FILES = named(*(f"{name}.vtu" for name in COUNTS))


@pytest.fixture(scope="module")
def load(file_of):
    cache: dict[str, TetMesh] = {}

    def get(file):
        name = file.removesuffix(".vtu")
        if name not in cache:
            path = file_of(file)
            if name in WARNS:
                with pytest.warns(UserWarning, match=WARNS[name]) as caught:
                    cache[name] = read_mesh(path)
                assert len(caught) == 1 and caught[0].filename == __file__
            else:
                cache[name] = read_mesh(path)
        return cache[name]

    return get


@pytest.mark.parametrize("file", FILES)
def test_counts(load, file):
    mesh, name = load(file), file.removesuffix(".vtu")
    r = mesh.report
    assert COUNTS[name] == (
        mesh.n_tets,
        r.degenerate,
        r.inverted,
        mesh.n_boundary,
        r.duplicate_points,
        r.seams,
    )
    assert count_components(mesh.neighbors)[0] == PIECES.get(name, 1)
    assert r.folded == FOLDED.get(name, 0) and r.one_sided == 0
    assert r.tets == mesh.n_tets


@pytest.mark.parametrize("file", [x for x in FILES if not x.marks])
def test_faces_by_their_coordinates(load, file):
    """Boundary and seams of small meshes, by the places of corners and nothing else."""
    mesh = load(file)
    points = np.asarray(mesh.points).tolist()
    faces = defaultdict(list)
    for row in np.asarray(mesh.cells).tolist():
        for k in range(4):
            corners = frozenset(row[:k] + row[k + 1 :])
            faces[frozenset(tuple(points[p]) for p in corners)].append(corners)
    assert {len(place) for place in faces} == {3}
    sides = [len(cells) for cells in faces.values()]
    assert set(sides) == {1, 2} and sides.count(1) == mesh.n_boundary
    apart = sum(len(cells) == 2 and cells[0] != cells[1] for cells in faces.values())
    assert apart == mesh.report.seams
    assert len(points) - len(set(map(tuple, points))) == mesh.report.duplicate_points


@pytest.mark.parametrize("file", FILES)
def test_invariants(load, file):
    """What a walk relies on, vectorised."""
    mesh = load(file)
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
    if file not in ("bluntfin.vtu", "bluntfin_merged.vtu"):  # slivers need the exact determinant
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


@pytest.mark.parametrize(
    "with_them, without",
    named(("bluntfin.vtu", "bluntfin_merged.vtu"), ("tube.vtu", "tube_merged.vtu")),
)
def test_a_mesh_with_and_without_its_duplicates_is_the_same_volume(load, with_them, without):
    one, two = load(with_them), load(without)
    a, b = quality(one.points, one.cells), quality(two.points, two.cells)
    assert a.volume == pytest.approx(b.volume, rel=1e-12)
    if with_them == "bluntfin.vtu":
        assert a.min_dihedral == pytest.approx(0.017, abs=5e-4)
        assert a.edge_ratio == pytest.approx(2648, abs=1)
    else:
        assert a.volume == pytest.approx(ring_volume(0.0), rel=1e-6)


@pytest.mark.parametrize("file", named("oxygen_post.vtu", "pipe.vtu", "tube.vtu"))
def test_seams_are_closed_and_keep_both_sides(load, file):
    mesh = load(file)
    seam = (np.asarray(mesh.neighbors) >= 0) & (packing.flag_of(np.asarray(mesh.neighbors)) == 1)
    assert seam.sum() == 2 * mesh.report.seams > 0
    used = np.zeros(mesh.n_points, bool)
    used[np.asarray(mesh.cells)] = True
    if file != "tube.vtu":  # on the axis cells need one of their points only
        assert used.all()


@pytest.mark.parametrize("file", named("post_tets.vtu", "crack.vtu"))
def test_cracks_stay_open(load, file):
    """Points coincide along the crack, but no face has the same three on both sides."""
    mesh = load(file)
    assert mesh.report.duplicate_points == {"post_tets.vtu": 88, "crack.vtu": 9}[file]
    assert mesh.report.seams == 0


def turned_cells(mesh) -> np.ndarray:
    """Cells that a walk takes for turned over, from their neighbours' words and the boundary's."""
    words = np.asarray(mesh.neighbors)
    turned = packing.cell_of(words[(words >= 0) & (packing.turned_of(words) == 1)])
    b = np.asarray(mesh.boundary)
    return np.union1d(turned, packing.cell_of(b[packing.turned_of(b) == 1]))


@pytest.mark.parametrize("file", named("can.vtu", "folds.vtu"))
def test_folds(load, file):
    assert len(turned_cells(load(file))) == FOLDED[file.removesuffix(".vtu")]


def test_folds_are_the_cells_that_were_pulled_over(file_of):
    points, tets = pulled()
    over = np.linalg.det(points[tets[:, 1:]] - points[tets[:, :1]]) < 0
    with pytest.warns(UserWarning, match="4 inverted"):
        mesh = read_mesh(file_of("folds.vtu"), "number")
    assert np.array_equal(np.sort(mesh.values[turned_cells(mesh)]), np.flatnonzero(over))


CELL_DATA = {"football_zoo": "scalar1", "can": "EQPS", "cells": "kind"}
CELL_DATA |= {"beam": "sample_cell_scalars"}


@pytest.mark.parametrize("file", named(*(f"{name}.vtu" for name in CELL_DATA)))
def test_cell_data(file_of, file):
    name = file.removesuffix(".vtu")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "77 inverted")  # see `test_counts`
        mesh = read_mesh(file_of(file), CELL_DATA[name])
    assert mesh.location == "cell" and mesh.values.shape == (COUNTS[name][0],)


def test_cell_data_go_to_the_tetrahedra_of_their_cells(file_of):
    mesh = read_mesh(file_of("cells.vtu"), "kind")
    middle = np.asarray(mesh.points)[np.asarray(mesh.cells)].mean(1)
    where = np.where(middle[:, 2] > 1, 3, np.floor(middle[:, 0]))  # roofs above, cubes in a row
    assert np.array_equal(mesh.values, where)


@pytest.mark.parametrize(
    "first, second",
    named(("cylinder_tets.vtu", "cylinder_tetra10.vtu"), ("linear.vtu", "quadratic.vtu")),
)
def test_quadratic_cells_are_their_linear_ones(load, first, second):
    linear, quadratic = load(first), load(second)
    assert quadratic.report.reduced == (("tetra10", linear.n_tets),)
    a, b = (quality(m.points, m.cells) for m in (linear, quadratic))
    assert a.volume == pytest.approx(b.volume, rel=1e-12)
    for name in ("neighbors", "boundary"):
        assert np.array_equal(getattr(linear, name), getattr(quadratic, name)), name


@pytest.mark.parametrize(
    "file, volume",
    [
        *(("lattice.vtu", 27), ("beam.vtu", 5), ("cells.vtu", 3 + 2 * 0.5**2 / 3)),
        *(("pipe.vtu", ring_volume(0.5)), ("tube.vtu", ring_volume(0.0)), ("crack.vtu", 16)),
    ],
)
def test_volumes(load, file, volume):
    mesh = load(file)
    assert quality(mesh.points, mesh.cells).volume == pytest.approx(volume, rel=1e-6)
