"""VTK's data sets as `Content`: grids of all kinds, and blocks of them.

Whatever is no vtkUnstructuredGrid (image data, rectilinear, structured and explicit structured
grids) becomes one by vtkAppendFilter, which is PyVista's `cast_to_unstructured_grid`: image data
and rectilinear grids turn into voxels, whose nodes `cells` puts in the order of a hexahedron.
Cells that VTK does not draw (blanked ones, and ghosts of another process) are left out.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from .. import cells as zoo
from . import polyhedra
from .content import NOT_DRAWN, Content, Part, Trouble, is_solid, join, pick_blocks

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
    73: "lagrange wedge", 74: "lagrange pyramid", 75: "bezier curve", 76: "bezier triangle",
    77: "bezier quadrilateral", 78: "bezier tetrahedron", 79: "bezier hexahedron",
    80: "bezier wedge", 81: "bezier pyramid",
}  # fmt: skip
GHOSTS = "vtkGhostType"
_CUT = (15, 16, 42)  # what `polyhedra` cuts
VOXEL_BYTES = 700  # what a cell of a structured grid comes to when it is cut into tetrahedra


def content_of(
    data: Any, blocks: Any = None, limit: int | None = None, what: str = "It"
) -> Content:
    """A data set, or a composite of them, of which `blocks` are taken. what: its name in errors.

    limit: bytes that cells of grids which say only their extent may come to.
    """
    if data is not None and data.IsA("vtkDataSet"):
        return _single(data, limit, what)
    if data is None or not data.IsA("vtkCompositeDataSet"):
        kind = "nothing" if data is None else data.GetClassName()
        raise Trouble(
            "unsupported", f"{what} holds {kind}, which is no grid and no blocks of them."
        )
    leaves = [(name, leaf) for name, leaf in leaves_of(data) if leaf.IsA("vtkDataSet")]
    if not leaves:
        raise Trouble("damaged", f"{what} holds no blocks with data.")
    names = unique(_short([name for name, _ in leaves]))
    chosen = pick_blocks(tuple(names), blocks)
    contents = [_single(leaves[k][1], limit, what) for k in chosen]
    out = join(contents, [names[k] for k in chosen])
    out.blocks = tuple(names)
    return out


def _short(names: list[str]) -> list[str]:
    """Without the levels that all have, and as the file has them (VTK's words for Exodus ids)."""
    split = [name.split("/") for name in names]
    while all(len(s) > 1 and s[0] == split[0][0] for s in split):
        split = [s[1:] for s in split]
    return [re.sub(r"Unnamed block ID: (\d+)( Type: \w+)?", r"\1", "/".join(s)) for s in split]


def unique(names: list[str]) -> list[str]:
    """The same names; those that stand twice with their place in the list."""
    return [n if names.count(n) == 1 else f"{n} ({k})" for k, n in enumerate(names)]


def leaves_of(data: Any, prefix: str = "") -> list[tuple[str, Any]]:
    """Data sets in blocks of blocks, with the names of the blocks that lead to them."""
    if not data.IsA("vtkCompositeDataSet"):
        return [(prefix or "block", data)]
    found = []
    if data.IsA("vtkDataObjectTree"):
        sub = getattr(data, "GetNumberOfBlocks", None) or getattr(
            data, "GetNumberOfPartitionedDataSets", None
        )
        count = sub() if sub else data.GetNumberOfPartitions()
        get = getattr(data, "GetBlock", None) or getattr(data, "GetPartitionedDataSet", None)
        for k in range(count):
            block = get(k) if get else data.GetPartitionAsDataObject(k)
            if block is None:
                continue
            meta = data.GetMetaData(k) if data.HasMetaData(k) else None
            name = meta.Get(data.NAME()) if meta is not None and meta.Has(data.NAME()) else None
            piece = data.IsA("vtkPartitionedDataSet") or data.IsA("vtkMultiPieceDataSet")
            name = name or (f"piece {k}" if piece else f"block {k}")
            if piece and count == 1 and prefix:
                name = ""
            found += leaves_of(block, "/".join(p for p in (prefix, name) if p))
        return found
    it = data.NewIterator()  # overlapping levels (AMR)
    it.InitTraversal()
    while not it.IsDoneWithTraversal():
        found.append((f"block {it.GetCurrentFlatIndex()}", it.GetCurrentDataObject()))
        it.GoToNextItem()
    return found


def numpy_of(data: Any) -> np.ndarray:
    from vtkmodules.util.numpy_support import vtk_to_numpy

    return vtk_to_numpy(data)


def _unstructured(grid: Any, limit: int | None, what: str) -> Any:
    if grid.IsA("vtkUnstructuredGrid"):
        return grid
    n = max(grid.GetNumberOfCells(), grid.GetNumberOfPoints())
    if limit is not None and n * VOXEL_BYTES > limit:
        raise Trouble("large", f"{what} has {n} points or cells, as its extent says")
    from vtkmodules.vtkFiltersCore import vtkAppendFilter

    append = vtkAppendFilter()
    append.AddInputData(grid)
    if not grid.IsA("vtkPointSet"):  # points that are made, not copied
        append.SetOutputPointsPrecision(append.DOUBLE_PRECISION)
    append.Update()
    return append.GetOutput()


def _arrays(data: Any, n: int, what: str, notes: list[str]) -> dict[str, np.ndarray]:
    """The arrays of numbers by name, (n,) or (n, components)."""
    found = {}
    for i in range(data.GetNumberOfArrays()):
        array = data.GetArray(i)  # None for strings
        if array is None:
            continue
        name = array.GetName() or f"Unnamed_{i}"
        if array.GetNumberOfTuples() == n:
            found[name] = numpy_of(array)
        elif n:
            notes.append(
                f"Field {name!r} has {array.GetNumberOfTuples()} values for {n} {what}s and is "
                "left out."
            )
    return found


def _single(given: Any, limit: int | None, what: str) -> Content:
    names = [
        (scalars.GetName(), where)
        for where, data in (("point", given.GetPointData()), ("cell", given.GetCellData()))
        if (scalars := data.GetScalars()) is not None
        and scalars.GetName()
        and scalars.GetNumberOfComponents() == 1
    ]
    grid = _unstructured(given, limit, what)
    notes: list[str] = []
    point = _arrays(grid.GetPointData(), grid.GetNumberOfPoints(), "point", notes)
    cell = _arrays(grid.GetCellData(), grid.GetNumberOfCells(), "cell", notes)
    points = grid.GetPoints()
    points = np.zeros((0, 3)) if points is None else numpy_of(points.GetData())
    content = Content(points=points, parts=[], point=point, active=names, notes=notes)
    rows = _parts(content, grid, point.pop(GHOSTS, None), cell.pop(GHOSTS, None))
    content.cell = {name: [None if r is None else a[r] for r in rows] for name, a in cell.items()}
    return content


def _drawn(
    kinds: np.ndarray, sizes: np.ndarray, nodes: np.ndarray, point: Any, cell: Any
) -> np.ndarray:
    drawn = np.ones(len(kinds), bool)
    if cell is not None:
        drawn &= cell & NOT_DRAWN["cell"] == 0
    if point is not None:
        hidden = np.flatnonzero(point & NOT_DRAWN["point"])
        drawn[np.repeat(np.arange(len(kinds)), sizes)[np.isin(nodes, hidden)]] = False
    return drawn


def _parts(content: Content, grid: Any, point_ghosts: Any, cell_ghosts: Any) -> list[Any]:
    """Fills in the parts; which cells of the grid each of them is, None for those that are only
    counted."""
    rows: list[Any] = []
    if grid.GetNumberOfCells() == 0:
        return rows
    try:
        kinds = numpy_of(grid.GetCellTypes())
    except TypeError:  # before VTK 9.6 that is another function
        kinds = numpy_of(grid.GetCellTypesArray())
    nodes = numpy_of(grid.GetCells().GetConnectivityArray())
    offsets = numpy_of(grid.GetCells().GetOffsetsArray()).astype(np.int64)
    sizes = np.diff(offsets)
    if len(sizes) != len(kinds) or (sizes < 0).any() or offsets[-1:].sum() > len(nodes):
        raise Trouble("malformed", "The offsets of its cells do not fit their number.")
    drawn = _drawn(kinds, sizes, nodes, point_ghosts, cell_ghosts)
    if not drawn.all():
        content.reordered = "ghost cells are left out"
    elif np.isin(kinds, _CUT).any():
        content.reordered = "polyhedra are cut"
    elif _interleave(kinds):
        content.reordered = "types of cells take turns in it"
    numbers, first = np.unique(kinds, return_index=True)
    for number in numbers[np.argsort(first)].tolist():
        these = np.flatnonzero((kinds == number) & drawn)
        if len(these) == 0:
            continue
        name = NAMES.get(number, f"VTK {number}")
        if number in _CUT:
            tets, parent = polyhedra.cut(
                content, [_faces(grid, number, int(c), nodes, offsets) for c in these], these
            )
            content.parts.append(Part("polyhedron parts", tets))
            rows.append(these[parent])
        elif not is_solid(name):
            content.parts.append(Part(name, len(these)))
            rows.append(None)
        else:
            _require_size(name, sizes[these], these)
            width = sizes[these].min()  # cells of several orders: their corners come first
            columns = offsets[these, None] + np.arange(width)
            content.parts.append(Part(name, nodes[columns].astype(np.int64)))
            rows.append(these)
    return rows


def _interleave(kinds: np.ndarray) -> bool:
    """Whether solids of one type stand in several places, with others between them."""
    solid = [k for k in np.unique(kinds) if is_solid(NAMES.get(int(k), f"VTK {k}"))]
    only = kinds[np.isin(kinds, solid)]
    return int((only[1:] != only[:-1]).sum()) + 1 > max(len(solid), 1)


def _require_size(name: str, sizes: np.ndarray, these: np.ndarray) -> None:
    kind, width, _ = zoo.canonical(name)
    assert kind is not None
    bad = sizes < kind.n_corners if width is None else sizes != width
    if bad.any():
        k = int(np.argmax(bad))
        raise Trouble(
            "malformed",
            f"{int(bad.sum())} of {len(sizes)} {name} cells have another number of nodes than "
            f"{width or kind.n_corners}: the first is cell {these[k]} with {sizes[k]}. Their types "
            "or their offsets are wrong.",
        )


def _faces(grid: Any, number: int, cell: int, nodes: np.ndarray, offsets: np.ndarray) -> list[Any]:
    """The faces of one polyhedron or prism, as lists of points."""
    if number != 42:
        ids = nodes[offsets[cell] : offsets[cell + 1]]
        n = {15: 5, 16: 6}[number]
        if len(ids) != 2 * n:
            raise Trouble("damaged", f"Cell {cell}, a {NAMES[number]}, has {len(ids)} nodes.")
        sides = [[k, (k + 1) % n, n + (k + 1) % n, n + k] for k in range(n)]
        return [ids[f].tolist() for f in ([*range(n)], [*range(n, 2 * n)], *sides)]
    from vtkmodules.vtkCommonCore import vtkIdList

    stream = vtkIdList()
    grid.GetFaceStream(int(cell), stream)
    flat = [stream.GetId(k) for k in range(stream.GetNumberOfIds())]
    faces, at = [], 1
    for _ in range(flat[0] if flat else 0):
        faces.append(flat[at + 1 : at + 1 + flat[at]])
        at += 1 + flat[at]
    return faces
