"""Meshes from VTK's and PyVista's grids, without a file between, and back: see `io.vtk_data`."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from .geometry import signed_volumes
from .io.content import Trouble
from .io.fields import arrays_of, choose, list_of
from .io.vtk_data import content_of
from .mesh import TetMesh, _from_cells


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
    try:
        content = content_of(grid)
        content.active = _active(grid, location, content.active)
        if field is None:
            found, _ = choose(name, list_of(content), None, location, content.active)
            field, location = found.name, found.location
        got = arrays_of(content, name, field, location)
    except Trouble as e:
        raise ValueError(e.message) from None
    for note in content.notes:
        warnings.warn(note, UserWarning, stacklevel=3)
    cells = {t: range(c) if isinstance(c, int) else c for t, c in got["cells"].items()}
    return _from_cells(
        cls, got["points"], cells, got["values"], got["location"], dtype, got["label"],
        stacklevel=4, strict=True,
    )  # fmt: skip


def write_grid(mesh: TetMesh) -> Any:
    """See `TetMesh.to_pyvista`."""
    try:
        import pyvista
    except ImportError as e:
        raise ImportError("to_pyvista needs PyVista: pip install pyvista") from e
    points, cells, values = (np.array(x) for x in (mesh.points, mesh.cells, mesh.values))
    points = mesh.absolute_points() if any(mesh.origin) else points
    values = mesh.absolute_values() if mesh.offset else values
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


def _active(grid: Any, location: str | None, vtk: list[tuple[str, str]]) -> list[tuple[str, str]]:
    """PyVista's choice of active scalars; VTK's, points before cells, where it has none."""
    info = getattr(grid, "active_scalars_info", None)
    if info is not None and info.name and location is None:
        return [(info.name, "cell" if info.association.name == "CELL" else "point")]
    return vtk
