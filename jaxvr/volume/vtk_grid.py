"""Meshes from VTK's and PyVista's grids, without a file between, and back.

Whatever is no vtkUnstructuredGrid (image data, rectilinear, structured and explicit structured
grids) becomes one by vtkAppendFilter, which is PyVista's `cast_to_unstructured_grid`: image data
and rectilinear grids turn into voxels, whose nodes `cells` puts in the order of a hexahedron.
Cells that VTK does not draw (blanked ones, and ghosts of another process) are left out.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from . import cells as zoo
from .geometry import signed_volumes
from .mesh import TetMesh, _from_cells
from .readers import Field, _choose, _scalar, _suffix

# VTK's numbers, in the names of meshio, which `cells` knows.
NAMES = {
    0: "empty", 1: "vertex", 2: "polyvertex", 3: "line", 4: "polyline", 5: "triangle",
    6: "trianglestrip", 7: "polygon", 8: "pixel", 9: "quad", 10: "tetra", 11: "voxel",
    12: "hexahedron", 13: "wedge", 14: "pyramid", 15: "pentagonal prism", 16: "hexagonal prism",
    21: "line3", 22: "triangle6", 23: "quad8", 24: "tetra10", 25: "hexahedron20", 26: "wedge15",
    27: "pyramid13", 28: "quad9", 29: "hexahedron27", 30: "quad6", 31: "wedge12", 32: "wedge18",
    33: "hexahedron24", 34: "triangle7", 35: "line4", 36: "polygon", 37: "pyramid19",
    41: "convex point set", 42: "polyhedron", 68: "lagrange curve", 69: "lagrange triangle",
    70: "lagrange quadrilateral", 71: "lagrange tetrahedron", 72: "lagrange hexahedron",
    73: "lagrange wedge", 74: "lagrange pyramid",
}  # fmt: skip
GHOSTS = "vtkGhostType"
_NOT_DRAWN = {"cell": 1 | 8 | 32, "point": 2}  # duplicate, refined and hidden cells; hidden points


def read_grid(
    cls: type[TetMesh], grid: Any, field: str | None, location: str | None, dtype: Any
) -> TetMesh:
    """See `TetMesh.from_pyvista`."""
    if location not in (None, "point", "cell"):
        raise ValueError(f'location must be "point", "cell" or None, but is {location!r}.')
    if not (hasattr(grid, "IsA") and grid.IsA("vtkDataSet")):
        raise ValueError(
            "A grid of VTK or PyVista is needed, such as a pyvista.UnstructuredGrid, but this is "
            f"{type(grid).__name__}. Of several blocks pass one, or blocks.combine(); of a reader "
            "or a filter pass GetOutput()."
        )
    name = type(grid).__name__
    active = _active(grid, location)
    grid = _unstructured(grid)
    arrays = {
        "point": _arrays(grid.GetPointData(), grid.GetNumberOfPoints()),
        "cell": _arrays(grid.GetCellData(), grid.GetNumberOfCells()),
    }
    fields = [
        Field(key, where, int(np.prod(a.shape[1:])))
        for where, group in arrays.items()
        for key, a in group.items()
        if key != GHOSTS
    ]
    if field is None:
        chosen = [a for a in active if Field(*a, 1) in fields]
        field, location = chosen[0] if chosen else (None, location)
    found, part = _choose(Path(name), fields, field, location)
    label = found.name if part is None else f"{found.name}.{_suffix(part)}"
    data = _scalar(arrays[found.location][found.name], part)
    cells, rows = _blocks(grid, arrays)
    values: Any = data if found.location == "point" else {t: data[r] for t, r in rows.items()}
    points = grid.GetPoints()
    points = np.zeros((0, 3)) if points is None else _numpy(points.GetData())
    return _from_cells(cls, points, cells, values, found.location, dtype, label, stacklevel=4)


def write_grid(mesh: TetMesh) -> Any:
    """See `TetMesh.to_pyvista`."""
    try:
        import pyvista
    except ImportError as e:
        raise ImportError("to_pyvista needs PyVista: pip install pyvista") from e
    points, cells, values = (np.array(x) for x in (mesh.points, mesh.cells, mesh.values))
    _, sign = signed_volumes(points, cells)
    order = np.tile(np.arange(4), (len(cells), 1))
    order[sign < 0] = (0, 1, 3, 2)
    tets = np.take_along_axis(cells, order, 1)
    if mesh.location == "corner":
        values = np.take_along_axis(values, order, 1).reshape(-1)
        points = points[tets.reshape(-1)]
        tets = np.arange(tets.size).reshape(tets.shape)
    rows = np.column_stack([np.full(len(tets), 4), tets]).astype(np.int64)
    kinds = np.full(len(tets), pyvista.CellType.TETRA, np.uint8)
    grid = pyvista.UnstructuredGrid(rows.ravel(), kinds, points)
    where = "cell" if mesh.location == "cell" else "point"
    name = mesh.report.field or "values"
    (grid.cell_data if where == "cell" else grid.point_data)[name] = values
    grid.set_active_scalars(name, preference=where)
    return grid


def _numpy(data: Any) -> np.ndarray:
    from vtkmodules.util.numpy_support import vtk_to_numpy

    return vtk_to_numpy(data)


def _unstructured(grid: Any) -> Any:
    if grid.IsA("vtkUnstructuredGrid"):
        return grid
    from vtkmodules.vtkFiltersCore import vtkAppendFilter

    append = vtkAppendFilter()
    append.AddInputData(grid)
    if not grid.IsA("vtkPointSet"):  # points that are made, not copied
        append.SetOutputPointsPrecision(append.DOUBLE_PRECISION)
    append.Update()
    return append.GetOutput()


def _arrays(data: Any, n: int) -> dict[str, np.ndarray]:
    """The arrays of numbers by name, (n,) or (n, components)."""
    found = {}
    for i in range(data.GetNumberOfArrays()):
        array = data.GetArray(i)  # None for strings
        if array is not None and array.GetNumberOfTuples() == n:
            found[array.GetName() or f"Unnamed_{i}"] = _numpy(array)
    return found


def _active(grid: Any, location: str | None) -> list[tuple[str, str]]:
    """Names and locations of the active scalars: PyVista's choice, else points before cells."""
    info = getattr(grid, "active_scalars_info", None)
    if info is not None and info.name and location is None:
        return [(info.name, "cell" if info.association.name == "CELL" else "point")]
    found = []
    for where, data in (("point", grid.GetPointData()), ("cell", grid.GetCellData())):
        scalars = data.GetScalars()
        if scalars is not None and scalars.GetName() and location in (None, where):
            found.append((scalars.GetName(), where))
    return found


def _blocks(
    grid: Any, arrays: dict[str, dict[str, np.ndarray]]
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Cells by type, as `TetMesh.from_cells` takes them, and which cells of the grid they are."""
    if grid.GetNumberOfCells() == 0:
        return {}, {}
    try:
        kinds = _numpy(grid.GetCellTypes())
    except TypeError:  # before VTK 9.6 that is another function
        kinds = _numpy(grid.GetCellTypesArray())
    nodes = _numpy(grid.GetCells().GetConnectivityArray())
    offsets = _numpy(grid.GetCells().GetOffsetsArray()).astype(np.int64)
    sizes = np.diff(offsets)
    drawn = np.ones(len(kinds), bool)
    ghosts = arrays["cell"].get(GHOSTS)
    if ghosts is not None:
        drawn &= ghosts & _NOT_DRAWN["cell"] == 0
    ghosts = arrays["point"].get(GHOSTS)
    if ghosts is not None:
        hidden = np.flatnonzero(ghosts & _NOT_DRAWN["point"])
        drawn[np.repeat(np.arange(len(kinds)), sizes)[np.isin(nodes, hidden)]] = False
    cells: dict[str, Any] = {}
    rows: dict[str, np.ndarray] = {}
    numbers, first = np.unique(kinds, return_index=True)
    for number in numbers[np.argsort(first)].tolist():
        these = np.flatnonzero((kinds == number) & drawn)
        name = NAMES.get(number, f"VTK {number}")
        if len(these) == 0:
            continue
        if zoo.canonical(name)[0] is None:  # only counted
            cells[name] = range(len(cells.get(name, ())) + len(these))
            continue
        width = sizes[these].min()  # cells of several orders: their corners come first
        cells[name] = nodes[offsets[these, None] + np.arange(width)]
        rows[name] = these
    return cells, rows
