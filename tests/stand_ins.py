"""Files that stand in for the outside data, made here: the same tests run on both.

`@pytest.mark.parametrize("name", named("can.vtu", "folds.vtu"))` runs a test on each, and leaves
out those that are not at hand (see `outside`); the fixture `file_of` gives their paths.

| made here | stands in for | what it has |
|---|---|---|
| lattice | hexa_lattice | hexahedra with faces in planes |
| beam | disk_out_ref | PyVista's example: hexahedra that someone else numbered, real fields |
| cells | football_zoo | hexahedra, wedges, pyramids, tetrahedra in one mesh; cell data |
| pipe | oxygen_post | a grid bent to a ring, joined to itself by a seam of coincident points |
| tube, tube_merged | bluntfin, bluntfin_merged | a grid with a seam and an axis, where cells have \
points twice; and the same with each point once |
| crack | post_tets | two halves whose points coincide, but whose faces do not |
| folds | can | cells pulled through their neighbours |
| linear, quadratic | cylinder_tets, cylinder_tetra10 | one mesh, without and with midpoints |
| tube.xyz, tube.q | plot3d | the tube as NASA's files, in the flow `flow` |
| slabs.npz | vectors | slabs by a rule of many nodes in extended precision |
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import meshio
import numpy as np
import pytest

from experiments.data import locate

TURNS, RINGS, LAYERS = 7, 3, 2  # blocks of the pipe and the tube, around, outwards and up


class Grid(NamedTuple):
    """points (P, 3) float32 of a block, i fastest, and its hexahedra (N, 8) in VTK's order."""

    dims: tuple[int, int, int]
    points: np.ndarray
    hexahedra: np.ndarray


def ring(inner: float, outer: float = 1.0, height: float = 0.5) -> Grid:
    """Round the z axis, from one radius to another: i outwards, j around, k up. The last j lies
    where the first does, bit by bit; from radius 0 all j of a height lie on the axis."""
    radius = np.linspace(inner, outer, RINGS + 1)
    turn = 2 * np.pi * (np.arange(TURNS + 1) % TURNS) / TURNS
    z, a, r = np.meshgrid(height * np.arange(LAYERS + 1), turn, radius, indexing="ij")
    points = np.stack([r * np.cos(a), r * np.sin(a), z], -1).reshape(-1, 3).astype(np.float32)

    def at(i: int, j: int, k: int) -> int:
        return i + (RINGS + 1) * (j + (TURNS + 1) * k)

    square = ((0, 0), (1, 0), (1, 1), (0, 1))
    hexahedra = [
        [at(i + di, j + dj, k + dk) for dk in (0, 1) for di, dj in square]
        for k in range(LAYERS)
        for j in range(TURNS)
        for i in range(RINGS)
    ]
    return Grid((RINGS + 1, TURNS + 1, LAYERS + 1), points, np.array(hexahedra))


def ring_volume(inner: float, outer: float = 1.0, height: float = 0.5) -> float:
    """Of a ring with that many corners."""
    area = 0.5 * TURNS * math.sin(2 * math.pi / TURNS)
    return area * (outer**2 - inner**2) * height * LAYERS


def flow(points: np.ndarray) -> np.ndarray:
    """Density, momentum (3) and energy (5, P) float32 of a gas at points (P, 3): it turns round
    the axis and rises."""
    x, y, z = np.asarray(points, np.float64).T
    density = 1 + 0.5 * x * x + 0.25 * z
    return np.stack([density, -y * density, x * density, 0.3 + z, 4 + x * y]).astype(np.float32)


def flow_fields(points: np.ndarray) -> dict[str, np.ndarray]:
    """What a VTK file holds of it: p = (gamma - 1) (E - rho |v|^2 / 2) with gamma = 1.4."""
    q = flow(points)
    density, momentum, energy = q[0].astype(float), q[1:4].T.astype(float), q[4].astype(float)
    square = (momentum**2).sum(1)
    return {
        "density": q[0],
        "energy": q[4],
        "momentum": q[1:4].T,
        "pressure": (0.4 * (energy - 0.5 * square / density)).astype(np.float32),
        "speed": (np.sqrt(square) / density).astype(np.float32),
    }


def kuhn(n: int) -> tuple[np.ndarray, np.ndarray]:
    """The cube [0, n]^3 in tetrahedra: points (P, 3) of integers, cells (T, 4), all with positive
    volume. Each block is cut into six round its diagonal, one for each order of the axes."""
    axis = np.arange(n + 1)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    cells = []
    for corner in itertools.product(range(n), repeat=3):
        for order in itertools.permutations(range(3)):
            steps = np.cumsum([np.zeros(3, int), *np.eye(3, dtype=int)[list(order)]], 0)
            rows = (np.array(corner) + steps) @ [(n + 1) ** 2, n + 1, 1]
            even = np.linalg.det(np.eye(3)[list(order)]) > 0
            cells.append(rows if even else rows[[1, 0, 2, 3]])
    return points.astype(float), np.array(cells)


def wave(points: Any) -> np.ndarray:
    """A smooth field without symmetry at points (P, 3)."""
    x, y, z = np.asarray(points, np.float64).T
    return np.sin(1.3 * x + 0.4) * np.cos(0.7 * y - 0.9 * z)


def write_vtu(path: Path, points: Any, cells: Any, fields: Any = None, **more: Any) -> None:
    fields = {"wave": wave(points)} if fields is None else fields
    meshio.Mesh(np.asarray(points), cells, point_data=fields, **more).write(path)


def lattice(path: Path) -> None:
    n = 3
    points = np.stack(np.meshgrid(*[np.arange(n + 1.0)] * 3, indexing="ij"), -1).reshape(-1, 3)
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    corners = np.concatenate([corners, corners + [0, 0, 1]])
    blocks = np.array(list(itertools.product(range(n), repeat=3)))
    hexahedra = (blocks[:, None] + corners) @ [(n + 1) ** 2, n + 1, 1]
    write_vtu(path, points.astype(np.float32), {"hexahedron": hexahedra})


def beam(path: Path) -> None:
    import pyvista
    from pyvista import examples

    pyvista.read(examples.hexbeamfile).cast_to_unstructured_grid().save(path)


def cells(path: Path) -> None:
    """Three cubes in a row: a hexahedron, six pyramids, two wedges; on the wedges a roof each."""
    points = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1, 2, 3)], float)
    points = np.concatenate([points, [[1.5, 0.5, 0.5], [2.3, 0.3, 1.5], [2.7, 0.7, 1.5]]])
    quads = [[1, 5, 6, 2], [9, 10, 14, 13], [1, 2, 10, 9], [5, 13, 14, 6], [1, 9, 13, 5]]
    quads += [[2, 6, 14, 10]]  # facing outwards, so the other way round as bases
    made = {
        "hexahedron": [[0, 1, 5, 4, 8, 9, 13, 12]],
        "pyramid": [[*quad[::-1], 16] for quad in quads],
        "wedge": [[2, 3, 6, 10, 11, 14], [3, 7, 6, 11, 15, 14]],
        "tetra": [[10, 11, 14, 17], [11, 15, 14, 18]],
    }
    data = {"kind": [np.full(len(rows), k, float) for k, rows in enumerate(made.values())]}
    write_vtu(path, points, {k: np.array(rows) for k, rows in made.items()}, cell_data=data)


def pipe(path: Path) -> None:
    """On one side of the seam points are numbered inwards, on the other outwards."""
    grid = ring(0.5)
    number = np.arange(len(grid.points)).reshape(grid.dims[::-1])
    number[:, -1] = number[:, -1, ::-1]
    number = number.ravel()
    points = grid.points[number]  # pairs are exchanged: that is its own inverse
    write_vtu(path, points, {"hexahedron": number[grid.hexahedra]}, flow_fields(points))


def tube(path: Path) -> None:
    grid = ring(0.0)
    write_vtu(path, grid.points, {"hexahedron": grid.hexahedra}, flow_fields(grid.points))


def tube_merged(path: Path) -> None:
    """Each place once, numbered as they first come."""
    grid = ring(0.0)
    places: dict[tuple[float, ...], int] = {}
    number = np.array([places.setdefault(tuple(p), len(places)) for p in grid.points.tolist()])
    points = np.array(list(places), np.float32)
    write_vtu(path, points, {"hexahedron": number[grid.hexahedra]}, flow_fields(points))


def crack(path: Path) -> None:
    """Two cubes side by side, the second one mirrored, so that the diagonals of their faces cross
    each other."""
    points, tets = kuhn(2)
    other = points * [1, -1, 1] + [2, 2, 0]
    both = np.concatenate([tets, tets[:, [1, 0, 2, 3]] + len(points)])
    write_vtu(path, np.concatenate([points, other]), {"tetra": both})


def pulled() -> tuple[np.ndarray, np.ndarray]:
    """A lattice whose point (1, 1, 1) was pulled through its neighbours."""
    points, tets = kuhn(3)
    points[np.flatnonzero((points == 1).all(1))] = [2.5, 2.25, 1.75]
    return points, tets


def folds(path: Path) -> None:
    points, tets = pulled()
    data = {"number": [np.arange(len(tets), dtype=float)]}
    write_vtu(path, points, {"tetra": tets}, cell_data=data)


def linear(path: Path) -> None:
    points, tets = kuhn(2)
    write_vtu(path, points, {"tetra": tets})


def quadratic(path: Path) -> None:
    """Midpoints come first, and are off the middle: cells are cut to their corners."""
    points, tets = kuhn(2)
    ends = tets[:, [[0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]]]  # VTK's order
    edges, number = np.unique(np.sort(ends, -1).reshape(-1, 2), axis=0, return_inverse=True)
    middle = points[edges].mean(1) + [0.05, -0.1, 0.02]
    rows = np.concatenate([tets + len(edges), number.reshape(-1, 6)], 1)
    write_vtu(path, np.concatenate([middle, points]), {"tetra10": rows})


def plot3d_grid(path: Path) -> None:
    grid = ring(0.0)
    write_plot3d(path, [(grid.dims, grid.points.T, None)])


def plot3d_solution(path: Path) -> None:
    grid = ring(0.0)
    write_plot3d(path, [(grid.dims, flow(grid.points), None)], solution=True)


def write_plot3d(
    path: Path,
    blocks: Any,
    order: str = "<",
    markers: bool = False,
    counted: bool = False,
    width: int = 4,
    solution: bool = False,
) -> None:
    """blocks: (dims, points (3, P) or a solution (5, P), iblank or None)."""

    def ints(x: Any) -> bytes:
        return np.asarray(x, order + "i4").tobytes()

    def floats(x: Any) -> bytes:
        return np.asarray(x, f"{order}f{width}").tobytes()

    records = [ints(len(blocks))] if counted else []
    records.append(ints([d for dims, _, _ in blocks for d in dims]))
    for _, numbers, iblank in blocks:
        if solution:
            records += [floats([2.95, 0, 2.1e6, 1.0]), floats(numbers)]
        else:
            records.append(floats(numbers) + (b"" if iblank is None else ints(iblank)))
    out = b""
    for record in records:
        mark = np.array(len(record), order + "u4").tobytes() if markers else b""
        out += mark + record + mark
    path.write_bytes(out)


def slabs(path: Path) -> None:
    from tests.optics.slabs import write

    write(path)


MESHES: dict[str, Callable[[Path], None]] = {
    make.__name__: make
    for make in (lattice, beam, cells, pipe, tube, tube_merged, crack, folds, linear, quadratic)
}
MADE: dict[str, Callable[[Path], None]] = {
    **{f"{name}.vtu": make for name, make in MESHES.items()},
    **{"tube.xyz": plot3d_grid, "tube.q": plot3d_solution, "vectors/slabs.npz": slabs},
}


def named(*names: str | tuple[str, ...]) -> list[Any]:
    """Parameters: names of files, or groups of them, left out where they are not at hand."""
    found = []
    for entry in names:
        group = (entry,) if isinstance(entry, str) else entry
        needs = [name for name in group if name not in MADE]
        marks = [pytest.mark.outside(*needs)] if needs else []
        found.append(pytest.param(*group, marks=marks, id=Path(group[0]).stem))
    return found


@pytest.fixture(scope="session")
def file_of(request, tmp_path_factory):
    """Path of a file of `MADE`, or of the outside data."""
    made: dict[str, Path] = {}

    def find(name: str) -> Path:
        if name not in MADE:
            return request.getfixturevalue("data_path")(name)
        if name not in made:
            made[name] = tmp_path_factory.mktemp("made") / locate(name)[1]
            MADE[name](made[name])
        return made[name]

    return find
