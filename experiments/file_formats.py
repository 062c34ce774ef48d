"""More kinds for `file_makers.KINDS`, written by hand after their manuals, with SciPy alone.

Exodus in netCDF's classic format (SAND92-2137), XDMF with its numbers in the XML
(https://www.xdmf.org), UGRID in text and in binary
(https://www.simcenter.msstate.edu/software/documentation/ug_io/3d_grid_file_type_ugrid.html).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from experiments.file_makers import (
    KINDS,
    Made,
    kind,
    linear,
    steps_of,
    tetrahedra,
    unstructured,
    zoo,
)

__all__ = ["KINDS"]  # those of `file_makers` and these

# VTK's numbers and names in each of the formats.
EXODUS = {10: "TETRA", 12: "HEX8", 13: "WEDGE", 14: "PYRAMID"}
XDMF = {10: ("Tetrahedron", 6), 12: ("Hexahedron", 9), 13: ("Wedge", 8), 14: ("Pyramid", 7)}
NODES = {10: 4, 12: 8, 13: 6, 14: 5}


def blocks_of(grid: Any) -> list[tuple[int, np.ndarray, np.ndarray]]:
    """(VTK's number, rows, places of the cells) by type; types follow each other in the grid."""
    flat = np.asarray(grid.cell_connectivity)
    sizes = [NODES[number] for number in np.asarray(grid.celltypes).tolist()]
    starts = np.cumsum([0, *sizes])
    found = []
    for number in dict.fromkeys(np.asarray(grid.celltypes).tolist()):
        these = np.flatnonzero(np.asarray(grid.celltypes) == number)
        rows = flat[starts[these][:, None] + np.arange(NODES[number])]
        found.append((number, rows, these))
    return found


def exodus(path: Path, grid: Any, blocks: Any, fields: Any, coord: bool, version: int) -> None:
    """blocks: (element type, rows from 0). fields: ("nod" or "elem", name, steps of numbers, for
    "elem" by block, with None for blocks without). coord: coordinates as one array."""
    from scipy.io import netcdf_file

    nodal, elemental = ([f for f in fields if f[0] == what] for what in ("nod", "elem"))
    n_steps = len(fields[0][2])
    with netcdf_file(str(path), "w", version=version) as d:
        d.api_version, d.version = np.float32(5), np.float32(5)
        d.floating_point_word_size, d.file_size, d.title = np.int32(8), np.int32(1), "a"
        sizes = {
            "time_step": None, "len_string": 33, "len_line": 81, "four": 4, "num_dim": 3,
            "num_nodes": grid.n_points, "num_elem": sum(len(rows) for _, rows in blocks),
            "num_el_blk": len(blocks), "num_nod_var": len(nodal), "num_elem_var": len(elemental),
        }  # fmt: skip
        for name, n in sizes.items():
            if n != 0:
                d.createDimension(name, n)

        def variable(name: str, what: Any, dims: tuple[str, ...], data: Any) -> Any:
            made = d.createVariable(name, what, dims)
            made[:] = data
            return made

        variable("time_whole", "f8", ("time_step",), np.arange(float(n_steps)))
        variable("eb_status", "i4", ("num_el_blk",), 1)
        ids = variable("eb_prop1", "i4", ("num_el_blk",), 1 + np.arange(len(blocks)))
        ids.name = "ID"
        if coord:
            variable("coord", "f8", ("num_dim", "num_nodes"), np.asarray(grid.points).T)
        else:
            for a, x in zip("xyz", np.asarray(grid.points).T, strict=True):
                variable(f"coord{a}", "f8", ("num_nodes",), x)
        for k, (element, rows) in enumerate(blocks, 1):
            dims = f"num_el_in_blk{k}", f"num_nod_per_el{k}"
            for name, n in zip(dims, rows.shape, strict=True):
                d.createDimension(name, n)
            variable(f"connect{k}", "i4", dims, rows + 1).elem_type = element
        for what, group in (("nod", nodal), ("elem", elemental)):
            if group:
                names = np.zeros((len(group), 33), "S1")
                for row, (_, name, _) in zip(names, group, strict=True):
                    row[: len(name)] = [*name]
                variable(f"name_{what}_var", "c", (f"num_{what}_var", "len_string"), names)
        for v, (_, _, steps) in enumerate(nodal, 1):
            made = d.createVariable(f"vals_nod_var{v}", "f8", ("time_step", "num_nodes"))
            for k, numbers in enumerate(steps):
                made[k] = numbers
        if elemental:
            table = [[step is not None for step in each] for _, _, (each, *_) in elemental]
            variable("elem_var_tab", "i4", ("num_el_blk", "num_elem_var"), np.array(table).T)
        for v, (_, _, steps) in enumerate(elemental, 1):
            for b in range(1, len(blocks) + 1):
                if steps[0][b - 1] is None:
                    continue
                name, dims = f"vals_elem_var{v}eb{b}", ("time_step", f"num_el_in_blk{b}")
                made = d.createVariable(name, "f8", dims)
                for k, by_block in enumerate(steps):
                    made[k] = by_block[b - 1]


@kind("Exodus, classic, a field on one of two blocks", "SciPy, by hand")
def _exodus_blocks(place: Path) -> Made:
    grid = tetrahedra(1)
    cells = grid.cell_connectivity.reshape(-1, 4)
    dens = [(None, np.arange(len(cells) - 2) + 10.0 * k) for k in range(3)]
    temp = [grid.point_data["t"] + k for k in range(3)]
    exodus(
        place / "a.e", grid, [("TETRA4", cells[:2]), ("TETRA4", cells[2:])],
        [("nod", "temp", temp), ("elem", "dens", dens)], False, 2,
    )  # fmt: skip
    right = unstructured([(10, cells[2:])], grid.points)
    right.cell_data["dens"] = dens[1][1]
    return Made(place / "a.e", right, "dens", {"block": "2", "step": 1})


def _exodus_zoo(place: Path, field: str, step: int, coord: bool, version: int) -> Made:
    grids = steps_of(zoo())
    found = blocks_of(grids[0])
    blocks = [(EXODUS[number], rows) for number, rows, _ in found]
    c = [[grid.cell_data["c"][these] for _, _, these in found] for grid in grids]
    t = [np.asarray(grid.point_data["t"]) for grid in grids]
    exodus(place / "a.exo", grids[0], blocks, [("nod", "t", t), ("elem", "c", c)], coord, version)
    return Made(place / "a.exo", grids[step], field, {"step": step})


@kind("Exodus, classic, all types, a field on nodes", "SciPy, by hand")
def _exodus_nodes(place: Path) -> Made:
    return _exodus_zoo(place, "t", 2, False, 1)


@kind("Exodus, classic, all types, a field on elements", "SciPy, by hand")
def _exodus_elements(place: Path) -> Made:
    return _exodus_zoo(place, "c", 0, True, 2)


def item(numbers: Any) -> str:
    """A DataItem of XDMF with its numbers."""
    a = np.asarray(numbers)
    what = "Int" if a.dtype.kind == "i" else "Float"
    size = " ".join(map(str, a.shape))
    text = " ".join(repr(x) for x in a.ravel().tolist())
    return (
        f'<DataItem DataType="{what}" Precision="8" Format="XML" Dimensions="{size}">{text}'
        "</DataItem>"
    )


def xdmf_grid(grid: Any, mixed: bool, time: float | None = None) -> str:
    found = blocks_of(grid)
    if mixed:
        flat = np.concatenate(
            [np.insert(rows, 0, XDMF[number][1], axis=1).ravel() for number, rows, _ in found]
        )
        topology = f'TopologyType="Mixed" NumberOfElements="{grid.n_cells}">{item(flat)}'
    else:
        ((number, rows, _),) = found
        name = XDMF[number][0]
        topology = f'TopologyType="{name}" NumberOfElements="{len(rows)}">{item(rows)}'
    order = np.concatenate([these for _, _, these in found])
    fields = "".join(
        f'<Attribute Name="{name}" AttributeType="Scalar" Center="{where}">{item(data)}</Attribute>'
        for name, where, data in (
            ("t", "Node", grid.point_data["t"]),
            ("c", "Cell", np.asarray(grid.cell_data["c"])[order]),
        )
    )
    at = "" if time is None else f'<Time Value="{time}"/>'
    return (
        f'<Grid Name="a" GridType="Uniform">{at}<Topology {topology}</Topology>'
        f'<Geometry GeometryType="XYZ">{item(np.asarray(grid.points, np.float64))}</Geometry>'
        f"{fields}</Grid>"
    )


def _xdmf(path: Path, grids: str) -> Path:
    path.write_text(f'<?xml version="1.0"?><Xdmf Version="3.0"><Domain>{grids}</Domain></Xdmf>')
    return path


@kind("XDMF, numbers in the XML, by hand", "by hand")
def _xdmf_tetrahedra(place: Path) -> Made:
    grid = tetrahedra()
    return Made(_xdmf(place / "a.xdmf", xdmf_grid(grid, False)), grid, "c")


@kind("XDMF, mixed cells in the XML, by hand", "by hand")
def _xdmf_mixed(place: Path) -> Made:
    grid = zoo()
    return Made(_xdmf(place / "a.xmf", xdmf_grid(grid, True)), grid, "t")


@kind("XDMF, steps in the XML, by hand", "by hand")
def _xdmf_steps(place: Path) -> Made:
    grids = steps_of(tetrahedra(1))
    text = "".join(xdmf_grid(grid, False, 0.5 * k) for k, grid in enumerate(grids))
    text = f'<Grid GridType="Collection" CollectionType="Temporal">{text}</Grid>'
    return Made(_xdmf(place / "a.xdmf", text), grids[1], "t", {"step": 0.5})


def ugrid(grid: Any, form: str) -> bytes:
    """form: "" for text, else b, lb, r or lr and the bytes of a float (b8, lr4), where r stands for
    records of Fortran, and an l at the end for integers of 8 bytes. Two triangles stand for the
    faces of the boundary, with tags."""
    rows = {number: block + 1 for number, block, _ in blocks_of(grid)}
    if 14 in rows:  # the base is 1 4 5 2, the apex 3
        rows[14] = rows[14][:, [0, 3, 4, 1, 2]]
    faces = np.array([[1, 2, 3], [2, 3, 4]])
    counts = [grid.n_points, len(faces), 0, *(len(rows.get(n, ())) for n in (10, 14, 13, 12))]
    points = np.asarray(grid.points, np.float64)
    cells = [rows[n] for n in (10, 14, 13, 12) if n in rows]
    if not form:
        lines = [" ".join(map(str, counts)), *(" ".join(map(repr, p)) for p in points.tolist())]
        for block in (faces, np.array([[5], [6]]), *cells):
            lines += [" ".join(map(str, row)) for row in block.tolist()]
        return ("\n".join(lines) + "\n").encode()
    order = "<" if form[0] == "l" else ">"
    integer = f"{order}i{8 if form[-1] == 'l' else 4}"
    whole = np.array(counts, integer).tobytes()
    rest = points.astype(f"{order}f{4 if '4' in form else 8}").tobytes()
    rest += b"".join(
        np.ascontiguousarray(a, integer).tobytes() for a in (faces, [[5], [6]], *cells)
    )
    if "r" not in form:
        return whole + rest
    marks = [np.array([len(part)], integer).tobytes() for part in (whole, rest)]
    return marks[0] + whole + marks[0] + marks[1] + rest + marks[1]


def _ugrid(form: str, what: str) -> None:
    def make(place: Path) -> Made:
        grid = zoo()
        path = place / f"a.{form}.ugrid" if form else place / "a.ugrid"
        path.write_bytes(ugrid(grid, form))
        return Made(path, grid, None, {"values": linear}, 1e-6)

    kind(f"UGRID, {what}", "by hand")(make)


_ugrid("", "text, by hand")
for form, what in (
    ("b8", "big endian"),
    ("b8l", "integers of 8 bytes"),
    ("lb4", "little endian, float32"),
    ("r8", "Fortran records"),
    ("lr4", "Fortran records, little endian, float32"),
):
    _ugrid(form, what)
