"""The exact order against rays and faces intersected by brute force, and what cycles do to it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvr.order import ExactOrder, Faces, exact_order
from jaxvr.order import exact as module
from jaxvr.view import Camera
from jaxvr.volume import TetMesh, datasets, packing
from jaxvr.volume.connectivity import FACES


def tets(points, cells):
    points, cells = np.asarray(points, float), np.array(cells)
    inverted = np.linalg.det(points[cells[:, 1:]] - points[cells[:, :1]]) < 0
    cells[inverted] = cells[inverted][:, [1, 0, 2, 3]]
    return TetMesh.from_cells(points, {"tetra": cells}, points[:, 0])


def without(mesh, away):
    """The mesh less the cells whose centroids (T, 3) are `away`."""
    points, cells = np.asarray(mesh.points), np.asarray(mesh.cells)
    return tets(points, cells[~away(points[cells].mean(1))])


def hollow():
    """A box with a hole through it."""
    box = datasets.box((4, 4, 3), 0.2, 5, "tetra", shuffle=True)
    return without(box, lambda c: (abs(c[:, :2] - 0.5) < 0.25).all(1))


def boxes(gap=0.3):
    """Three boxes in a row along z, the middle one turned; those behind come first."""
    box = datasets.box((2, 2, 2), 0.2, 2)
    points, cells = np.asarray(box.points), np.asarray(box.cells)
    middle = points[:, [1, 0, 2]] * [1, -1, 1] + [0, 1, 1 + gap]
    both = np.concatenate([points, middle, points + [0, 0, 2 + 2 * gap]])
    return tets(both, np.concatenate([cells + i * len(points) for i in range(3)]))


MESHES = {
    "convex": lambda: datasets.box((3, 2, 3), 0.25, 1, "tetra", shuffle=True),
    "hollow": hollow,
    "boxes": boxes,
    "touching boxes": lambda: boxes(0.0),  # coincident faces with other diagonals
    "seam": lambda: datasets.cylinder_flow((2, 7, 2), closed=False),
    "heat sink": lambda: datasets.heat_sink(2),
}


@pytest.fixture(scope="module")
def meshes():
    return {name: make() for name, make in MESHES.items()}


def cameras(mesh):
    low, high = (np.asarray(x, float) for x in mesh.bounds())
    middle, size = (low + high) / 2, float(np.linalg.norm(high - low))
    direction = np.array([0.31, 0.42, 0.85])
    inside = low + (high - low) * [0.13, 0.17, 0.21]
    return {
        "outside": Camera.orbit(mesh, azimuth=33.0, elevation=21.0, width=20, height=17),
        "other side": Camera.orbit(mesh, azimuth=200.0, elevation=-50.0, width=15, height=17),
        "near": Camera.orbit(mesh, 75.0, 10.0, zoom=3.0, fov=70.0, width=17, height=15),
        "parallel": Camera.orthographic(
            middle - size * direction, middle, extent=size, width=17, height=20
        ),
        "inside": Camera.look_at(inside, middle, fov=100.0, width=20, height=17),
        "parallel inside": Camera.orthographic(inside, middle, extent=size, width=16, height=15),
    }


def faces_of(mesh):
    """Slots (F,) and vertices (F, 3, 3) of every face, once."""
    cells, words = np.asarray(mesh.cells), np.asarray(mesh.neighbors)
    mine = (words < 0) | (packing.cell_of(words) > np.arange(len(cells))[:, None])
    c, k = np.nonzero(mine)
    return 4 * c + k, np.asarray(mesh.points, float)[cells[c[:, None], FACES[k]]]


def fragments(mesh, camera):
    """Every hit of a ray and a face ahead of the ray's start, strictly inside of the face (Möller
    and Trumbore 1997): pixels, slots and depths (N,)."""
    slots, q = faces_of(mesh)
    out = []
    rays = (np.asarray(x, float).reshape(-1, 3) for x in camera.rays())
    u, v = q[:, 1] - q[:, 0], q[:, 2] - q[:, 0]
    for pixel, (o, d) in enumerate(zip(*rays, strict=True)):
        across = np.cross(d, v)
        det = (u * across).sum(1)
        det = np.where(det == 0, np.inf, det)
        from_first = o - q[:, 0]
        b = (from_first * across).sum(1) / det
        other = np.cross(from_first, u)
        c, depth = other @ d / det, (v * other).sum(1) / det
        hit = np.nonzero((np.minimum(b, c) > 1e-10) & (b + c < 1 - 1e-10) & (depth > 0))[0]
        out.append(np.stack([np.full(len(hit), pixel), slots[hit], depth[hit]], 1))
    pixel, slot, depth = np.concatenate(out).T
    return pixel.astype(int), slot.astype(int), depth


def unsorted_pixels(order, mesh, camera, bound=1e-12):
    """Pixels whose fragments do not come sorted, and how many fragments there are."""
    pixel, slot, depth = fragments(mesh, camera)
    sequence = np.lexsort((slot, order.table[slot], pixel))
    pixel, depth = pixel[sequence], depth[sequence]
    wrong = (pixel[1:] == pixel[:-1]) & (depth[1:] < depth[:-1] - bound)
    return np.unique(pixel[1:][wrong]), len(depth)


@pytest.mark.parametrize("view", ["outside", "other side", "near", "parallel", "inside",
                                  "parallel inside"])  # fmt: skip
@pytest.mark.parametrize("name", list(MESHES))
def test_fragments_come_sorted(meshes, name, view):
    mesh = meshes[name]
    camera = cameras(mesh)[view]
    if mesh.n_tets > 1000:  # brute force takes its time
        camera = camera.replace(width=9, height=8)
    order = exact_order(mesh, camera)
    wrong, count = unsorted_pixels(order, mesh, camera)
    assert count > 200
    assert len(wrong) == 0
    assert order.cycles == 0
    assert 2 < order.levels < mesh.n_tets


def test_only_the_gaps_tell_which_box_is_first(meshes, monkeypatch):
    mesh = meshes["boxes"]
    camera = cameras(mesh)["outside"]
    monkeypatch.setattr(module, "across_gaps", lambda *_: (np.zeros(0, int),) * 2)
    assert len(unsorted_pixels(exact_order(mesh, camera), mesh, camera)[0]) > 10


def test_single_precision():
    mesh = datasets.heat_sink(2, dtype="float32")
    low, high = (np.asarray(x) for x in mesh.bounds())
    camera = Camera.look_at(
        low + np.array([-4, 6, 9], np.float32), (low + high) / 2, width=15, height=14
    )
    assert camera.dtype == mesh.dtype == np.float32
    assert len(unsorted_pixels(exact_order(mesh, camera), mesh, camera)[0]) == 0


def test_keys_of_slots(meshes):
    mesh = meshes["hollow"]
    order = exact_order(mesh, cameras(mesh)["outside"])
    table = order.table.reshape(-1, 4)
    words = np.asarray(mesh.neighbors)
    c, k = np.nonzero(words >= 0)
    n, f = packing.cell_of(words[c, k]), packing.corner_of(words[c, k])
    assert (table[c, k] == table[n, f]).all() and (table[c, k] % 2 == 0).all()
    # a cell's faces come with it and with those behind it, and one at least with it
    own = table.min(1) // 2
    assert (np.sort(own) == np.arange(mesh.n_tets)).all()
    assert set((table - 2 * own[:, None])[words < 0].tolist()) == {0, 1}


def test_an_order_for_tracers(meshes):
    mesh = meshes["convex"]
    order = exact_order(mesh, cameras(mesh)["outside"])
    slot = jnp.array([5, 0, 17], "int32")
    corner = jnp.zeros((3, 3), "float32")
    faces = Faces(slot, (corner, corner, corner), corner[0], jnp.array(True))
    keys = jax.jit(lambda how, faces: how.keys(faces), static_argnums=0)(order, faces)
    assert keys.dtype == np.int32 and np.array_equal(keys, order.table[slot])
    assert order != exact_order(mesh, cameras(mesh)["outside"]) and hash(order) is not None


def test_keys_above_2_to_24_stay_apart():
    table = np.arange(2**24, 2**24 + 4, dtype=np.int32)
    corner = jnp.zeros((3, 4), "float32")
    faces = Faces(jnp.arange(4), (corner, corner, corner), corner[:, 0], jnp.array(True))
    assert np.array_equal(ExactOrder(table, 0, 1).keys(faces), table)


def bars():
    """Three bars, each in front of the next at one end and behind the last at the other; a cell
    before all and one behind all."""
    angles = np.deg2rad([90, 210, 330])
    corners = np.stack([np.cos(angles), np.sin(angles)], 1)
    points = []
    for i in range(3):
        start, end = corners[i], corners[(i + 1) % 3]
        along = (end - start) / np.linalg.norm(end - start)
        across = 0.15 * np.array([-along[1], along[0]])
        start, end = start - 0.4 * along, end + 0.4 * along
        points += [[*(start - across), -0.6], [*(start + across), -0.4]]
        points += [[*(end - across), 0.6], [*(end + across), 0.4]]
    for z in (-2.0, 2.0):
        points += [[-3, -2, z], [3, -2, z], [0, 3, z], [0, 0, 1.2 * z]]
    return tets(points, np.arange(20).reshape(5, 4))


def test_cycle():
    mesh = bars()
    camera = Camera.orthographic((0, 0, 5.0), (0, 0, 0), extent=4.0, width=40, height=40)
    order = exact_order(mesh, camera)
    assert order.cycles == 1
    # where no ray sees more than one crossing there is no cycle to break
    wrong, _ = unsorted_pixels(order, mesh, camera)
    assert 0 < len(wrong)
    x, y = (wrong % 40 + 0.5) / 10 - 2, 2 - (wrong // 40 + 0.5) / 10
    corners = np.deg2rad([90, 210, 330])
    near = [bool((np.hypot(x - np.cos(a), y - np.sin(a)) < 0.5).all()) for a in corners]
    assert sum(near) == 1  # at one of the three crossings only
    # cells that are not in the cycle keep their places
    cell = np.asarray(mesh.cells) // 4
    rank = order.table.reshape(-1, 4).min(1) // 2
    assert cell[np.argmin(rank)][0] == 4 and cell[np.argmax(rank)][0] == 3


@pytest.mark.parametrize("passes", [1, 2, 64])
def test_cycles_are_all_broken(monkeypatch, passes):
    monkeypatch.setattr(module, "_PASSES", passes)
    rng = np.random.default_rng(3)
    before, after = rng.integers(0, 60, (2, 150))
    before, after = before[before != after], after[before != after]
    distance = rng.integers(0, 20, 60).astype(float)
    keep = module._without_cycles(distance, before, after)
    rank = np.full(60, -1)
    module._levels(rank, before[keep], after[keep])
    assert np.array_equal(np.sort(rank), np.arange(60))
    assert (rank[before[keep]] < rank[after[keep]]).all()
    # what is not in a cycle is not given up
    reach = np.zeros((60, 60), bool)
    reach[before, after] = True
    for i in range(60):
        reach |= reach[:, i : i + 1] & reach[i : i + 1]
    assert 0 < (~keep).sum() < 60
    assert reach[after[~keep], before[~keep]].all()


def test_one_cell():
    mesh = tets(np.vstack([np.zeros(3), np.eye(3)]), [[0, 1, 2, 3]])
    order = exact_order(mesh, Camera.look_at((3, 4, 5), (0, 0, 0), width=8, height=8))
    # the slope is towards the eye, the three others are behind
    assert order.table.tolist() == [0, 1, 1, 1] and (order.cycles, order.levels) == (0, 1)
    away = Camera.look_at((3, 4, 5), (6, 8, 10), width=8, height=8)
    assert exact_order(mesh, away).table.tolist() == [0, 1, 1, 1]


def test_bad_input(meshes):
    mesh = meshes["convex"]
    camera = cameras(mesh)["outside"]
    with pytest.raises(
        ValueError, match="exact_order orders the faces of a TetMesh, not of a list"
    ):
        exact_order([], camera)  # pyright: ignore[reportArgumentType]
    several = Camera.sphere(mesh, 2)
    with pytest.raises(ValueError, match="exact_order needs one Camera, not a list"):
        exact_order(mesh, several)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="exact_order needs to know .* outside of jit"):
        jax.eval_shape(lambda p: exact_order(mesh.replace(points=p), camera).levels, mesh.points)
    assert isinstance(exact_order(mesh, camera), ExactOrder)
