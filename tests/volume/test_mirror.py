"""Points that turn a mesh inside out: its entries go with them, and of folds a warning tells."""

from __future__ import annotations

import warnings

import flat_meshes as flat
import numpy as np
import pytest

import jaxvr
from jaxvr.testing import nasty_meshes
from jaxvr.volume import TetMesh, datasets
from jaxvr.volume.geometry import signed_volumes

pytestmark = pytest.mark.usefixtures("quick_code")

CUBE = np.array([[x, y, z] for z in (0, 1.0) for y in (0, 1.0) for x in (0, 1.0)])
FIVE = [[0, 1, 2, 4], [3, 1, 2, 7], [5, 1, 4, 7], [6, 2, 4, 7], [1, 2, 4, 7]]
SIDES = [[0, 1, 2, 3], [4, 5, 6, 7], [0, 1, 4, 5], [2, 3, 6, 7], [0, 2, 4, 6], [1, 3, 5, 7]]
# Rows act on points: p -> p @ move.T
MOVES = {
    "one axis": np.diag([1.0, 1, -1]),
    "all axes": -np.eye(3),
    "two axes": np.diag([-1.0, -1, 1]),
    "swapped": np.eye(3)[[1, 0, 2]],
    "round": np.eye(3)[[1, 2, 0]],
}


def quietly(make, *args, **kwargs):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of flat and inverted cells
        return make(*args, **kwargs)


def of_cells(
    points, cells, dtype="float64", field=lambda p: np.sin(3 * p[:, 0]) + p[:, 1] * p[:, 2]
):
    return quietly(
        TetMesh.from_cells, points, {"tetra": cells}, field(points), location="point", dtype=dtype
    )


def delaunay(name, dtype):
    mesh = flat.MESHES[name]()
    return of_cells(mesh.points, mesh.cells, dtype)


MESHES = {
    "box": lambda dtype: datasets.box((2, 2, 2), 0.2, dtype=dtype),
    "zoo": lambda dtype: datasets.box((2, 2, 2), 0.2, cell="pyramid", dtype=dtype),
    "lattice": lambda dtype: delaunay("lattice", dtype),
    "squashed": lambda dtype: delaunay("squashed", dtype),
    "all flat at the boundary": lambda dtype: of_cells(CUBE, FIVE + SIDES, dtype),
    "seams": lambda dtype: quietly(nasty_meshes, dtype, ["seams"])["seams"],
    "pieces": lambda dtype: quietly(nasty_meshes, dtype, ["pieces"])["pieces"],
    "folded": lambda dtype: quietly(nasty_meshes, dtype, ["folded"])["folded"],
}


def colors(mesh, origins, directions):
    values = np.asarray(mesh.values, np.float64)
    size = float(np.linalg.norm(np.ptp(np.asarray(mesh.points, np.float64), axis=0)))
    at = np.linspace(values.min(), values.max(), 3)
    arrays = np.linspace(values.min(), values.max(), 3), np.eye(3), np.full(3, 1 / size)
    at, light, extinctions = (x.astype(mesh.dtype) for x in arrays)
    tf = jaxvr.TransferFunction(at, light, extinctions)
    origins, directions = (np.asarray(x, mesh.dtype) for x in (origins, directions))
    rgba, status = jaxvr.render_rays(mesh, origins, directions, tf, status=True)
    assert not np.asarray(status).any()
    return np.asarray(rgba)


def rays_through(points, count=64):
    """From outside to inside of the box round the points, in no special direction."""
    rng = np.random.default_rng(0)
    low, span = points.min(0), np.ptp(points, axis=0)
    target = low + span * rng.uniform(0.1, 0.9, (count, 3))
    away = span * rng.normal(size=(count, 3))
    return target - 3 * away, away


FLAT = ("lattice", "squashed", "all flat at the boundary")
CASES = [(name, "float64") for name in MESHES] + [(name, "float32") for name in FLAT]


@pytest.mark.parametrize(("name", "dtype"), CASES)
def test_a_mirrored_mesh_has_the_mirrored_picture(name, dtype):
    mesh = MESHES[name](dtype)
    points = np.asarray(mesh.points)
    origins, directions = rays_through(points.astype(np.float64))
    want = colors(mesh, origins, directions)
    assert (want[:, 3] > 0.01).mean() > 0.4  # there is something to see
    for move in MOVES.values():
        there = mesh.replace(points=points @ move.T)  # exact, and no warning
        found = colors(there, origins @ move.T, directions @ move.T)
        np.testing.assert_allclose(found, want, rtol=0, atol=1e-5 if dtype == "float32" else 1e-11)
        back = there.replace(points=points)
        assert np.array_equal(back.boundary, mesh.boundary)


def test_of_two_pieces_one_is_mirrored():
    mesh = datasets.box((2, 2, 2), 0.2)
    points, cells = np.asarray(mesh.points), np.asarray(mesh.cells)
    both = np.concatenate([points, points + [1.5, 0, 0]])
    pair = of_cells(both, np.concatenate([cells, cells + len(points)]))
    one = both.copy()
    one[len(points) :, 2] *= -1
    moved, anew = pair.replace(points=one), of_cells(one, np.asarray(pair.cells))
    anew = anew.replace(values=pair.values)
    rays = rays_through(one, 128)
    np.testing.assert_allclose(colors(moved, *rays), colors(anew, *rays), rtol=0, atol=1e-11)
    assert np.array_equal(np.sort(moved.boundary), np.sort(anew.boundary))


def test_values_and_small_moves_leave_the_entries():
    mesh = delaunay("lattice", "float64")
    shape = flat.lattice()
    moved = mesh.replace(points=flat.moved(shape), values=np.asarray(mesh.values) + 1)
    assert moved.boundary is mesh.boundary


def test_a_fold_is_told_with_its_cells():
    mesh = datasets.box((4, 2, 2))
    points = np.array(mesh.points)
    points[:, 0] = np.abs(points[:, 0] - 0.5)  # the half to the left over the one to the right
    before, after = (
        signed_volumes(p, np.asarray(mesh.cells))[1] for p in (np.asarray(mesh.points), points)
    )
    over = int((before != after).sum())
    assert over == mesh.n_tets // 2
    with pytest.warns(UserWarning, match=f"turn {over} of {mesh.n_tets} tetrahedra over") as caught:
        mesh.replace(points=points)
    assert caught[0].filename == __file__


def test_points_without_volume_turn_nothing():
    mesh = datasets.box((2, 2, 2))
    flattened = mesh.replace(points=np.asarray(mesh.points) * [1, 1, 0])
    assert np.array_equal(flattened.boundary, mesh.boundary)
    rgba = colors(flattened, *rays_through(np.asarray(mesh.points)))
    np.testing.assert_allclose(rgba, 0, atol=1e-14)
