"""Small files of many kinds, each with what is in it: for `file_kinds`, `file_faults` and tests.

`KINDS` has a function for each, which writes into a folder and returns the file's path and the
truth: a VTK grid, or a function that gives one. Fields are linear (t, v) or different in each cell
(c). What other packages are needed is imported where it is used.
"""

from __future__ import annotations

import dataclasses
import importlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np


@dataclasses.dataclass
class Made:
    path: Path
    truth: Any
    field: str | None = "t"
    how: dict[str, Any] = dataclasses.field(default_factory=dict)
    tolerance: float = 1e-6  # of the volume
    note: str = ""


@dataclasses.dataclass
class Kind:
    name: str
    writer: str
    make: Callable[[Path], Made]


KINDS: list[Kind] = []


def kind(name: str, writer: str) -> Callable[[Any], Any]:
    def add(make: Callable[[Path], Made]) -> Callable[[Path], Made]:
        KINDS.append(Kind(name, writer, make))
        return make

    return add


def linear(points: Any) -> np.ndarray:
    return 100.0 + np.asarray(points, np.float64) @ (1.0, 2.0, 4.0)


def with_fields(grid: Any) -> Any:
    """t and v on points, c on cells."""
    points = np.array(grid.points, np.float64)
    grid.point_data["t"] = linear(points)
    grid.point_data["v"] = points @ np.array([[1.0, 2, 0], [0, 1, 3], [1, 0, 1]])
    grid.cell_data["c"] = np.arange(grid.n_cells) + 1.0
    return grid


def lattice(n: int = 2, sheared: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """points and hexahedra of a cube, sheared a little, which keeps faces plane."""
    axis = np.arange(n + 1.0)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), z.ravel()], 1)
    if sheared:
        points = points @ np.array([[1, 0.1, 0], [0, 1, 0.2], [0.1, 0, 1]])
    k, j, i = np.meshgrid(np.arange(n), np.arange(n), np.arange(n), indexing="ij")
    m = n + 1
    first = (i + m * (j + m * k)).ravel()
    up = m * m
    return points, first[:, None] + np.array([0, 1, 1 + m, m, up, 1 + up, 1 + m + up, m + up])


def unstructured(cells: list[tuple[int, Any]], points: Any) -> Any:
    """cells: (VTK's number, rows)."""
    import pyvista

    flat, kinds = [], []
    for number, rows in cells:
        for row in rows:
            flat += [len(row), *map(int, row)]
            kinds.append(number)
    return with_fields(pyvista.UnstructuredGrid(flat, kinds, np.asarray(points, np.float64)))


def zoo() -> Any:
    """Hexahedra, wedges, pyramids and tetrahedra."""
    points, h = lattice(2)
    centre = points[h[1]].mean(0)
    at = len(points)
    points = np.vstack([points, centre])
    faces = [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]]
    pyramids = [[*h[1][f][::-1], at] for f in faces]
    a = h[2]
    wedges = [[a[0], a[2], a[1], a[4], a[6], a[5]], [a[0], a[3], a[2], a[4], a[7], a[6]]]
    b = h[7]  # its faces to others are cut by diagonals of their own: nothing lies beside it
    ring = [1, 2, 3, 7, 4, 5]
    tets = [[b[0], b[p], b[q], b[6]] for p, q in zip(ring, ring[1:] + ring[:1], strict=True)]
    return unstructured([(12, [h[0], h[4]]), (13, wedges), (14, pyramids), (10, tets)], points)


def hexahedra(n: int = 2) -> Any:
    points, h = lattice(n)
    return unstructured([(12, h)], points)


def tetrahedra(n: int = 2) -> Any:
    import jaxvr

    mesh = jaxvr.datasets.box((n, n, n), jitter=0.1)
    return unstructured([(10, np.asarray(mesh.to_pyvista().cell_connectivity).reshape(-1, 4))],
                        np.asarray(mesh.points))  # fmt: skip


def by_vtk(path: Path) -> Any:
    import pyvista

    return pyvista.read(str(path))


def xml(grid: Any, path: Path, **how: Any) -> None:
    """By VTK's XML writer; how: calls by name."""
    import vtk

    name = {".vtu": "UnstructuredGrid", ".vti": "ImageData", ".vtr": "RectilinearGrid",
            ".vts": "StructuredGrid", ".vtm": "MultiBlockData", ".pvtu": "PUnstructuredGrid",
            ".vtpc": "PartitionedDataSetCollection", ".pvts": "PStructuredGrid",
            ".pvti": "PImageData"}[path.suffix]  # fmt: skip
    writer = getattr(vtk, f"vtkXML{name}Writer")()
    writer.SetFileName(str(path))
    writer.SetInputData(grid)
    for call, value in how.items():
        getattr(writer, call)(*value) if isinstance(value, tuple) else getattr(writer, call)(value)
    if not writer.Write():
        raise RuntimeError(f"{path.name} was not written")


def _vtu(name: str, **how: Any) -> None:
    def make(place: Path) -> Made:
        grid = zoo()
        xml(grid, place / "a.vtu", **how)
        return Made(place / "a.vtu", grid)

    kind(name, "VTK")(make)


_vtu("VTU, ascii", SetDataMode=0)
_vtu("VTU, inline binary", SetDataMode=1, SetCompressorType=0)
_vtu("VTU, appended raw", SetDataMode=2, SetCompressorType=0, SetEncodeAppendedData=0)
_vtu("VTU, appended base64", SetDataMode=2, SetCompressorType=0, SetEncodeAppendedData=1)
_vtu("VTU, zlib", SetCompressorType=2)
_vtu("VTU, LZ4", SetCompressorType=1)
_vtu("VTU, LZMA", SetCompressorType=3)
_vtu("VTU, big endian", SetByteOrder=0, SetCompressorType=0)
_vtu("VTU, 64-bit headers", SetHeaderType=64)
_vtu("VTU, 32-bit ids", SetIdType=32)


def thirds() -> tuple[Any, list[Any]]:
    """A grid, and three pieces of it with points of their own."""
    import pyvista

    whole = hexahedra(3)
    pieces = []
    for k in range(3):
        piece = whole.extract_cells(np.arange(9 * k, 9 * k + 9))
        for data, kept in ((piece.point_data, ("t", "v")), (piece.cell_data, ("c",))):
            for key in [key for key in data if key not in kept]:
                del data[key]
        pieces.append(pyvista.UnstructuredGrid(piece))
    return whole, pieces


@kind("VTU, several pieces", "VTK, by hand")
def _pieces(place: Path) -> Made:
    grid, pieces = thirds()
    parts = []
    for piece in pieces:
        xml(piece, place / "piece.vtu", SetDataMode=0)
        text = (place / "piece.vtu").read_text()
        parts.append(text[text.index("<Piece") : text.index("</Piece>") + 8])
    text = text[: text.index("<Piece")] + "\n".join(parts) + text[text.index("</Piece>") + 8 :]
    (place / "a.vtu").write_text(text)
    return Made(place / "a.vtu", grid)


@kind("PVTU, three pieces", "VTK, by hand")
def _pvtu(place: Path) -> Made:
    grid, pieces = thirds()
    for k, piece in enumerate(pieces):
        xml(piece, place / f"a{k}.vtu")
    sources = "".join(f'<Piece Source="a{k}.vtu"/>' for k in range(3))
    double = '<PDataArray type="Float64" Name="{}" NumberOfComponents="{}"/>'
    (place / "a.pvtu").write_text(
        '<VTKFile type="PUnstructuredGrid" version="1.0" byte_order="LittleEndian">'
        f'<PUnstructuredGrid GhostLevel="0"><PPointData>{double.format("t", 1)}'
        f"{double.format('v', 3)}</PPointData><PCellData>{double.format('c', 1)}</PCellData>"
        f"<PPoints>{double.format('Points', 3)}</PPoints>{sources}</PUnstructuredGrid></VTKFile>"
    )
    return Made(place / "a.pvtu", grid)


@kind("VTU, voxels among hexahedra, pixels, strips, polygons", "VTK")
def _voxels(place: Path) -> Made:
    points, h = lattice(2, sheared=False)
    swap = [0, 1, 3, 2, 4, 5, 7, 6]
    grid = unstructured(
        [(11, h[:3, swap]), (12, h[3:]), (8, [h[0][[0, 1, 3, 2]]]), (6, [h[0][[0, 1, 3, 2]]]),
         (7, [h[0][[4, 5, 6, 7]]]), (1, [[0]]), (4, [[0, 1, 2]])], points,
    )  # fmt: skip
    xml(grid, place / "a.vtu")
    return Made(place / "a.vtu", grid, "c")


@kind("VTU, ghost cells", "VTK")
def _ghosts(place: Path) -> Made:
    grid = hexahedra(3)
    ghosts = np.zeros(grid.n_cells, np.uint8)
    ghosts[::4] = 1
    grid.cell_data["vtkGhostType"] = ghosts
    xml(grid, place / "a.vtu")
    return Made(place / "a.vtu", grid, "c")


@kind("VTU, polyhedra (convex)", "VTK")
def _polyhedra(place: Path) -> Made:
    import pyvista
    import vtk

    points, h = lattice(2)
    grid = vtk.vtkUnstructuredGrid()
    grid.SetPoints(pyvista.vtk_points(points))
    faces = [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]]
    for k, row in enumerate(h):
        if k % 2:
            grid.InsertNextCell(12, 8, row.tolist())
        else:
            stream = [6]
            for f in faces:
                stream += [4, *row[f].tolist()]
            ids = vtk.vtkIdList()
            for i in stream:
                ids.InsertNextId(i)
            grid.InsertNextCell(42, ids)
    grid = with_fields(pyvista.wrap(grid))
    xml(grid, place / "a.vtu", SetDataMode=0)
    return Made(place / "a.vtu", grid)


@kind("VTU, a polyhedron that is not convex", "VTK")
def _concave(place: Path) -> Made:
    made = _polyhedra(place)
    grid = made.truth
    grid.points[13] = grid.points[0] + 0.9 * (grid.points[13] - grid.points[0])
    grid.points[13] = grid.points[0] * 0.7 + grid.points[13] * 0.3
    xml(grid, made.path, SetDataMode=0)
    return made


@kind("VTU, pentagonal and hexagonal prisms", "VTK")
def _prisms(place: Path) -> Made:
    points, cells = [], []
    for number, n in ((15, 5), (16, 6)):
        turn = 2 * np.pi * np.arange(n) / n
        ring = np.stack([np.cos(turn) + 3 * (n - 5), np.sin(turn), 0 * turn], 1)
        start = len(points)
        points += [*ring, *(ring + [0, 0, 1])]
        cells.append((number, [np.arange(start, start + 2 * n)]))
    grid = unstructured(cells, np.array(points))
    xml(grid, place / "a.vtu")
    return Made(place / "a.vtu", grid, "c")


def _quadratic(number: int, name: str) -> None:
    def make(place: Path) -> Made:
        import pyvista
        import vtk

        source = vtk.vtkCellTypeSource()
        source.SetCellType(number)
        source.SetBlocksDimensions(2, 2, 2)
        source.Update()
        grid = with_fields(pyvista.wrap(source.GetOutput()))
        for key in [k for k in grid.point_data if k not in ("t", "v")]:
            del grid.point_data[key]
        for key in [k for k in grid.cell_data if k != "c"]:
            del grid.cell_data[key]
        xml(grid, place / "a.vtu")
        return Made(place / "a.vtu", grid)

    kind(f"VTU, {name}", "VTK")(make)


for _number, _name in (
    (24, "quadratic tetrahedra"), (25, "quadratic hexahedra (20)"), (26, "quadratic wedges (15)"),
    (27, "quadratic pyramids (13)"), (29, "triquadratic hexahedra (27)"),
    (71, "Lagrange tetrahedra"), (72, "Lagrange hexahedra"),
    (79, "Bezier hexahedra"),
):  # fmt: skip
    _quadratic(_number, _name)


@kind("VTU, integer and boolean fields", "PyVista")
def _integers(place: Path) -> Made:
    grid = hexahedra()
    for dtype in ("i1", "u1", "i2", "i4", "u4", "i8", "bool"):
        grid.cell_data[f"x{dtype}"] = (np.arange(grid.n_cells) % 2).astype(dtype)
    grid.save(str(place / "a.vtu"))
    return Made(place / "a.vtu", grid, "xi8")


@kind("VTU, strings among the fields, a name with spaces", "PyVista")
def _strings(place: Path) -> Made:
    grid = zoo()
    grid.point_data["words"] = ["x"] * grid.n_points
    grid.cell_data["c d"] = grid.cell_data["c"]
    (place / "a folder").mkdir()
    grid.save(str(place / "a folder" / "a file.vtu"))
    return Made(place / "a folder" / "a file.vtu", grid, "c d")


@kind("VTU named .vtk", "PyVista")
def _misnamed(place: Path) -> Made:
    grid = zoo()
    grid.save(str(place / "a.vtu"))
    (place / "a.vtu").rename(place / "b.vtk")
    return Made(place / "b.vtk", grid)


def _legacy(name: str, version: int, mode: int, dtype: str | None = None) -> None:
    def make(place: Path) -> Made:
        import vtk

        grid = zoo()
        if dtype:
            grid.cell_data["id"] = np.arange(grid.n_cells).astype(dtype)
        writer = vtk.vtkUnstructuredGridWriter()
        writer.SetFileVersion(version)
        writer.SetFileType(mode)
        writer.SetFileName(str(place / "a.vtk"))
        writer.SetInputData(grid)
        writer.Write()
        return Made(place / "a.vtk", grid, "id" if dtype else "t")

    kind(name, "VTK")(make)


_legacy("legacy VTK 5.1, ascii", 51, 1)
_legacy("legacy VTK 5.1, binary", 51, 2)
_legacy("legacy VTK 5.1, int32 field, binary", 51, 2, "i4")
_legacy("legacy VTK 5.1, uint8 field, ascii", 51, 1, "u1")
_legacy("legacy VTK 4.2, ascii", 42, 1)
_legacy("legacy VTK 4.2, binary", 42, 2)


def image(n: int = 3) -> Any:
    import pyvista

    return with_fields(
        pyvista.ImageData(dimensions=(n + 1, n, n), spacing=(0.5, 1, 2), origin=(1, 2, 3))
    )


def _structured(name: str, suffix: str, cast: str | None) -> None:
    def make(place: Path) -> Made:
        grid = image() if cast is None else getattr(image(), cast)()
        grid.save(str(place / f"a{suffix}"))
        return Made(place / f"a{suffix}", grid)

    kind(name, "PyVista")(make)


for _label, _suffix, _cast in (
    ("legacy VTK, structured points", ".vtk", None),
    ("legacy VTK, rectilinear grid", ".vtk", "cast_to_rectilinear_grid"),
    ("legacy VTK, structured grid", ".vtk", "cast_to_structured_grid"),
    ("VTI", ".vti", None),
    ("VTR", ".vtr", "cast_to_rectilinear_grid"),
    ("VTS", ".vts", "cast_to_structured_grid"),
):
    _structured(_label, _suffix, _cast)


@kind("VTS with blanked cells", "PyVista")
def _blanked(place: Path) -> Made:
    grid = image().cast_to_structured_grid()
    grid.hide_cells([0, 5], inplace=True)
    grid.save(str(place / "a.vts"))
    return Made(place / "a.vts", grid, "c")


def _parallel(name: str, suffix: str, source: Callable[[], Any]) -> None:
    def make(place: Path) -> Made:
        grid = source()
        xml(grid, place / f"a{suffix}", SetNumberOfPieces=2, SetStartPiece=0, SetEndPiece=1)
        return Made(place / f"a{suffix}", grid)

    kind(name, "VTK")(make)


_parallel("PVTS", ".pvts", lambda: image().cast_to_structured_grid())
_parallel("PVTI", ".pvti", image)


def halves() -> tuple[Any, Any]:
    """Two blocks side by side; the second has a field of its own."""
    import pyvista

    whole = hexahedra(2)
    left = whole.extract_cells(np.arange(4))
    right = whole.extract_cells(np.arange(4, 8))
    for half in (left, right):
        for key in [k for k in half.point_data if k not in ("t", "v")]:
            del half.point_data[key]
        for key in [k for k in half.cell_data if k != "c"]:
            del half.cell_data[key]
    right.cell_data["dens"] = np.arange(4.0)
    return pyvista.UnstructuredGrid(left), pyvista.UnstructuredGrid(right)


def _blocks(name: str, file: str, field: str, **how: Any) -> None:
    def make(place: Path) -> Made:
        import pyvista

        left, right = halves()
        blocks = pyvista.MultiBlock({"left": left, "right": right})
        if file.endswith(".vtpc"):
            import vtk

            both = vtk.vtkPartitionedDataSetCollection()
            for k, half in enumerate((left, right)):
                both.SetPartition(k, 0, half)
                both.GetMetaData(k).Set(vtk.vtkCompositeDataSet.NAME(), ("left", "right")[k])
            xml(both, place / file)
        elif file.endswith(".vtkhdf"):
            import vtk

            writer = vtk.vtkHDFWriter()
            writer.SetFileName(str(place / file))
            writer.SetInputData(blocks)
            writer.Write()
        else:
            xml(blocks, place / file)
        truth = right if how.get("block") == "right" else blocks.combine()
        return Made(place / file, truth, field, how)

    kind(name, "VTK")(make)


_blocks("VTM, two blocks", "a.vtm", "t")
_blocks("VTM, one of two blocks, a field that it alone has", "a.vtm", "dens", block="right")
_blocks("VTM, a field on one block, both asked for", "a.vtm", "dens")
_blocks("VTPC", "a.vtpc", "c")
_blocks("VTKHDF, blocks", "a.vtkhdf", "t")


@kind("VTKHDF, unstructured", "VTK")
def _vtkhdf(place: Path) -> Made:
    import vtk

    grid = zoo()
    writer = vtk.vtkHDFWriter()
    writer.SetFileName(str(place / "a.vtkhdf"))
    writer.SetInputData(grid)
    writer.Write()
    return Made(place / "a.vtkhdf", grid)


def steps_of(grid: Any, n: int = 3) -> list[Any]:
    out = []
    for k in range(n):
        one = grid.copy()
        one.point_data["t"] = grid.point_data["t"] + 10.0 * k
        out.append(one)
    return out


@kind("PVD, one of three steps", "by hand, PyVista")
def _pvd(place: Path) -> Made:
    grids = steps_of(zoo())
    entries = []
    for k, grid in enumerate(grids):
        grid.save(str(place / f"a{k}.vtu"))
        entries.append(f'<DataSet timestep="{0.5 * k}" part="0" file="a{k}.vtu"/>')
    (place / "a.pvd").write_text(
        f'<VTKFile type="Collection"><Collection>{"".join(entries)}</Collection></VTKFile>'
    )
    return Made(place / "a.pvd", grids[1], "t", {"step": 0.5})


@kind("series of VTU files, the last step", "by hand, PyVista")
def _series(place: Path) -> Made:
    grids = steps_of(zoo())
    for k, grid in enumerate(grids):
        grid.save(str(place / f"a{k}.vtu"))
    files = [{"name": f"a{k}.vtu", "time": float(k)} for k in range(3)]
    (place / "a.vtu.series").write_text(json.dumps({"file-series-version": "1.0", "files": files}))
    return Made(place / "a.vtu.series", grids[2])


@kind("EnSight Gold, ascii", "by hand")
def _ensight(place: Path) -> Made:
    grid = hexahedra()
    n = grid.n_points

    def column(numbers: Any) -> list[str]:
        return [f"{x:12.5e}" for x in numbers]

    rows = [" ".join(f"{i + 1}" for i in r) for r in grid.cell_connectivity.reshape(-1, 8)]
    head = ["a", "b", "node id off", "element id off", "part", "1", "block", "coordinates", str(n)]
    text = [*head, *column(grid.points.T.ravel()), "hexa8", str(len(rows)), *rows]
    (place / "a.geo").write_text("\n".join(text) + "\n")
    for name, location, numbers in (
        ("t", "coordinates", grid.point_data["t"]), ("c", "hexa8", grid.cell_data["c"]),
    ):  # fmt: skip
        lines = [name, "part", "1", location, *column(numbers)]
        (place / f"a.{name}").write_text("\n".join(lines) + "\n")
    (place / "a.case").write_text(
        "FORMAT\ntype: ensight gold\nGEOMETRY\nmodel: a.geo\nVARIABLE\n"
        "scalar per node: t a.t\nscalar per element: c a.c\n"
    )
    return Made(place / "a.case", grid)


@kind("Tecplot, hexahedra", "by hand")
def _tecplot(place: Path) -> Made:
    grid = hexahedra()
    rows = grid.cell_connectivity.reshape(-1, 8) + 1
    lines = ['VARIABLES = "X" "Y" "Z" "t"', f"ZONE T=\"a\", N={grid.n_points}, E={len(rows)}, "
             "F=FEPOINT, ET=BRICK"]  # fmt: skip
    for p, t in zip(grid.points, grid.point_data["t"], strict=True):
        lines.append(" ".join(f"{x:.9g}" for x in (*p, t)))
    lines += [" ".join(map(str, r)) for r in rows]
    (place / "a.dat").write_text("\n".join(lines) + "\n")
    return Made(place / "a.dat", grid)


@kind("OpenFOAM, polyMesh and a field", "by hand")
def _foam(place: Path) -> Made:
    """Two cubes, side by side."""
    points, h = lattice(1)
    points = np.vstack([points, points + points[1]])
    order = {tuple(np.round(p, 9)): k for k, p in reversed([*enumerate(points)])}
    number = np.array([order[tuple(np.round(p, 9))] for p in points])
    kept = np.unique(number)
    points, number = points[kept], np.searchsorted(kept, number)
    cells = [number[h[0]], number[h[0] + 8]]
    faces = [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]]
    rings = [[tuple(c[f].tolist()) for f in faces] for c in cells]
    shared = [f for f in rings[0] if {*f} in [{*g} for g in rings[1]]]
    outer = [(f, k) for k in (0, 1) for f in rings[k] if {*f} != {*shared[0]}]

    def file(name: str, what: str, body: str) -> None:
        target = place / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(
            f"FoamFile {{ version 2.0; format ascii; class {what}; object {target.name}; }}\n{body}"
        )

    def listed(items: list[str]) -> str:
        return f"{len(items)}\n(\n" + "\n".join(items) + "\n)\n"

    mesh = "constant/polyMesh/"
    file(mesh + "points", "vectorField", listed([f"({p[0]} {p[1]} {p[2]})" for p in points]))
    rows = [*shared, *(f for f, _ in outer)]
    file(mesh + "faces", "faceList", listed([f"4({' '.join(map(str, f))})" for f in rows]))
    file(mesh + "owner", "labelList", listed(["0", *(str(k) for _, k in outer)]))
    file(mesh + "neighbour", "labelList", listed(["1"]))
    file(mesh + "boundary", "polyBoundaryMesh",
         "1\n(\nwall { type wall; nFaces 10; startFace 1; }\n)\n")  # fmt: skip
    file("system/controlDict", "dictionary",
         "startFrom startTime; startTime 0; stopAt endTime; endTime 1; deltaT 1; "
         "writeControl timeStep; writeInterval 1;\n")  # fmt: skip
    file("1/c", "volScalarField",
         "dimensions [0 0 0 0 0 0 0];\ninternalField nonuniform List<scalar> 2(1 2);\n"
         "boundaryField { wall { type zeroGradient; } }\n")  # fmt: skip
    (place / "a.foam").touch()
    (place / "a.foam").write_text(" ")
    grid = unstructured([(12, cells)], points)
    return Made(place / "a.foam", grid, "c")


def meshio_of(grid: Any, cells: bool = True) -> Any:
    """The same as a meshio.Mesh."""
    import meshio

    names = {10: "tetra", 12: "hexahedron", 13: "wedge", 14: "pyramid"}
    blocks, data, at = [], [], 0
    flat, offsets = grid.cell_connectivity, grid.cell_offsets
    kinds = np.asarray(grid.celltypes)
    while at < len(kinds):
        end = at
        while end < len(kinds) and kinds[end] == kinds[at]:
            end += 1
        rows = flat[offsets[at] : offsets[end]].reshape(end - at, -1)
        blocks.append((names[int(kinds[at])], np.asarray(rows)))
        data.append(np.asarray(grid.cell_data["c"][at:end]))
        at = end
    points = np.asarray(grid.points)
    return meshio.Mesh(points, blocks, point_data={"t": np.asarray(grid.point_data["t"])},
                       cell_data={"c": data} if cells else {})  # fmt: skip


def _meshio(
    name: str, file: str, source: Callable[[], Any], field: str | None = "t",
    form: str | None = None, cells: bool = True, **how: Any,
) -> None:  # fmt: skip
    """field: None for formats without fields, whose values are given."""

    def make(place: Path) -> Made:
        import contextlib
        import io

        grid = source()
        mesh = meshio_of(grid, cells)
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            mesh.write(place / file, file_format=form, **how)
        if field is None:
            return Made(place / file, grid, None, {"values": linear})
        return Made(place / file, grid, field)

    kind(name, "meshio")(make)


_meshio("VTU by meshio", "a.vtu", zoo)
_meshio("legacy VTK 4.2 by meshio", "a.vtk", zoo, form="vtk42")
_meshio("legacy VTK 5.1 by meshio", "a.vtk", zoo, form="vtk51")
_meshio("gmsh 2.2 by meshio", "a.msh", zoo, form="gmsh22", binary=False)
_meshio("gmsh 4.1 by meshio, binary", "a.msh", zoo, form="gmsh", cells=False)
_meshio("XDMF, numbers in the XML", "a.xdmf", tetrahedra, data_format="XML")
_meshio("XDMF, numbers in HDF5", "a.xdmf", tetrahedra)
_meshio("XDMF, mixed cells", "a.xdmf", zoo, data_format="XML")
_meshio("Exodus by meshio", "a.e", tetrahedra, cells=False)
_meshio("MED", "a.med", tetrahedra)
_meshio("Abaqus", "a.inp", hexahedra, None, "abaqus", False)
_meshio("Nastran", "a.bdf", tetrahedra, None, cells=False)
_meshio("Medit", "a.mesh", tetrahedra, None, cells=False)
_meshio("SU2", "a.su2", zoo, None, cells=False)
_meshio("UGRID", "a.ugrid", tetrahedra, None, cells=False)
_meshio("UGRID, little endian", "a.lb8.ugrid", tetrahedra, None, cells=False)
_meshio("AVS-UCD", "a.avs", tetrahedra)
_meshio("Tecplot by meshio", "a.tec", tetrahedra, cells=False)
_meshio("Kratos", "a.mdpa", tetrahedra, None, cells=False)
_meshio("FLAC3D", "a.f3grid", tetrahedra, None, cells=False)
_meshio("PERMAS", "a.post", tetrahedra, None, cells=False)
_meshio("MOAB", "a.h5m", tetrahedra, cells=False)
_meshio("DOLFIN XML", "a.xml", tetrahedra, None, cells=False)
_meshio("TetGen", "a.node", tetrahedra, None, cells=False)
_meshio("Netgen", "a.vol", tetrahedra, None, cells=False)
_meshio("HMF", "a.hmf", tetrahedra)


@kind("XDMF, time series", "meshio")
def _xdmf_series(place: Path) -> Made:
    import meshio

    grids = steps_of(tetrahedra())
    with meshio.xdmf.TimeSeriesWriter(str(place / "a.xdmf"), data_format="XML") as writer:
        mesh = meshio_of(grids[0])
        writer.write_points_cells(mesh.points, mesh.cells)
        for k, grid in enumerate(grids):
            writer.write_data(0.5 * k, point_data={"t": np.asarray(grid.point_data["t"])})
    return Made(place / "a.xdmf", grids[1], "t", {"step": 1})


@kind("Abaqus, two *NODE sections", "meshio, by hand")
def _two_nodes(place: Path) -> Made:
    grid = hexahedra()
    meshio_of(grid, False).write(place / "b.inp", file_format="abaqus")
    lines = (place / "b.inp").read_text().splitlines(keepends=True)
    at = next(k for k, line in enumerate(lines) if line.upper().startswith("*NODE"))
    lines.insert(at + 10, "*NODE, NSET=more\n")
    (place / "a.inp").write_text("".join(lines))
    return Made(place / "a.inp", grid, None, {"values": linear})


@kind("a compressed VTU (.vtu.gz)", "by hand")
def _gzip(place: Path) -> Made:
    import gzip

    grid = zoo()
    xml(grid, place / "a.vtu")
    (place / "b.vtu.gz").write_bytes(gzip.compress((place / "a.vtu").read_bytes()))
    return Made(place / "b.vtu.gz", grid)


def gmsh_box(order: int = 1, groups: bool = False) -> Any:
    """A model of two boxes, meshed; the caller ends gmsh."""
    gmsh: Any = importlib.import_module("gmsh")
    gmsh.initialize(interruptible=False)
    gmsh.option.setNumber("General.Terminal", 0)
    gmsh.option.setNumber("Mesh.MeshSizeMax", 0.7)
    gmsh.option.setNumber("Mesh.ElementOrder", order)
    gmsh.model.add("a")
    gmsh.model.occ.addBox(0, 0, 0, 1, 1, 1)
    gmsh.model.occ.addBox(1, 0, 0, 1, 1, 1)
    gmsh.model.occ.fragment([(3, 1)], [(3, 2)])
    gmsh.model.occ.synchronize()
    if groups:
        gmsh.model.addPhysicalGroup(3, [1], 7, "left")
        gmsh.model.addPhysicalGroup(3, [2], 8, "right")
    gmsh.model.mesh.generate(3)
    return gmsh


def gmsh_truth(gmsh: Any, volumes: tuple[int, ...] = (1, 2), shift: float = 0.0) -> Any:
    """Linear tetrahedra of the model."""
    ids, points, _ = gmsh.model.mesh.getNodes()
    place = {int(i): k for k, i in enumerate(ids)}
    rows, tags = [], []
    for v in volumes:
        kinds, elements, nodes = gmsh.model.mesh.getElements(3, v)
        for number, own, flat in zip(kinds, elements, nodes, strict=True):
            width = gmsh.model.mesh.getElementProperties(number)[3]
            for e, r in zip(own, flat.reshape(-1, width)[:, :4], strict=True):
                rows.append([place[int(i)] for i in r])
                tags.append(int(e))
    grid = unstructured([(10, rows)], points.reshape(-1, 3))
    grid.point_data["t"] += shift
    grid.cell_data["c"] = np.array(tags, float)
    return grid


def _gmsh(
    name: str, file: str, version: float = 4.1, binary: int = 0, order: int = 1,
    groups: bool = False, field: str | None = None, **how: Any,
) -> None:  # fmt: skip
    """field: "t" on nodes in two steps, "c" on elements, "k" at corners of elements."""

    def make(place: Path) -> Made:
        gmsh = gmsh_box(order, groups)
        try:
            gmsh.option.setNumber("Mesh.MshFileVersion", version)
            gmsh.option.setNumber("Mesh.Binary", binary)
            gmsh.option.setNumber("PostProcessing.Binary", binary)
            gmsh.option.setNumber("PostProcessing.SaveMesh", 0)
            path = place / file
            gmsh.write(str(path))
            shift = 10.0 if field == "t" and how.get("step") is None else 0.0
            truth = gmsh_truth(gmsh, (2,) if how.get("block") == "right" else (1, 2), shift)
            if field:
                _gmsh_view(gmsh, field, path)
        finally:
            gmsh.finalize()
        if field is None:
            return Made(path, truth, None, {"values": linear, **how})
        if field == "k":
            truth.point_data["k"] = truth.point_data["t"]
        return Made(path, truth, field, how)

    kind(name, "gmsh")(make)


def _gmsh_view(gmsh: Any, field: str, path: Path) -> None:
    view = gmsh.view.add(field)
    if field == "t":
        ids, points, _ = gmsh.model.mesh.getNodes()
        values = linear(points.reshape(-1, 3))
        for k in range(2):
            data = [[v + 10.0 * k] for v in values]
            gmsh.view.addModelData(view, k, "a", "NodeData", ids, data, time=float(k))
    else:
        tags = [e for own in gmsh.model.mesh.getElements(3)[1] for e in own]
        if field == "c":
            gmsh.view.addModelData(view, 0, "a", "ElementData", tags, [[float(e)] for e in tags])
        else:
            data = []
            for e in tags:
                nodes = gmsh.model.mesh.getElement(int(e))[1]
                at = np.array([gmsh.model.mesh.getNode(int(i))[0] for i in nodes])
                data.append(linear(at).tolist())
            gmsh.view.addModelData(view, 0, "a", "ElementNodeData", tags, data)
    gmsh.view.write(view, str(path), append=True)


_gmsh("gmsh 2.2, ascii", "a.msh", 2.2)
_gmsh("gmsh 2.2, binary", "a.msh", 2.2, 1)
_gmsh("gmsh 4.0, ascii", "a.msh", 4.0)
_gmsh("gmsh 4.0, binary", "a.msh", 4.0, 1)
_gmsh("gmsh 4.1, ascii", "a.msh")
_gmsh("gmsh 4.1, binary", "a.msh", 4.1, 1)
_gmsh("gmsh 4.1, quadratic", "a.msh", order=2)
_gmsh("gmsh, physical groups, one of them", "a.msh", groups=True, block="right")
_gmsh("gmsh, node data, the last of two steps", "a.msh", field="t")
_gmsh("gmsh, node data, the first of two steps, binary", "a.msh", binary=1, field="t", step=0)
_gmsh("gmsh, element data on volumes only", "a.msh", field="c")
_gmsh("gmsh, data at the corners of elements", "a.msh", field="k")
_gmsh("gmsh 2.2, data at corners, binary", "a.msh", 2.2, 1, field="k")
_gmsh("VTK by gmsh", "a.vtk")
_gmsh("Nastran by gmsh", "a.bdf")
_gmsh("Abaqus by gmsh", "a.inp")
_gmsh("SU2 by gmsh", "a.su2")
_gmsh("Medit by gmsh", "a.mesh")
_gmsh("MED by gmsh", "a.med")
_gmsh("CGNS by gmsh", "a.cgns")
_gmsh("I-DEAS by gmsh (.unv)", "a.unv")


@kind("gmsh, a node id of 2147483647", "by hand")
def _large_id(place: Path) -> Made:
    (place / "a.msh").write_text(
        "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n4\n1 0 0 0\n2 1 0 0\n3 0 1 0\n"
        "2147483647 0 0 1\n$EndNodes\n$Elements\n1\n1 4 2 0 1 1 2 3 2147483647\n$EndElements\n"
    )
    grid = unstructured([(10, [[0, 1, 2, 3]])], [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    return Made(place / "a.msh", grid, None, {"values": linear})


def _example(name: str) -> None:
    def make(place: Path) -> Made:
        from pyvista import examples

        path = Path(examples.__file__).parent / name
        return Made(path, by_vtk(path), None)

    kind(f"{name} of PyVista's examples", "public")(make)


for _file in ("hexbeam.vtk", "rectilinear.vtk", "uniform.vtk"):
    _example(_file)
