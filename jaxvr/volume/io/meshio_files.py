"""Files that meshio reads, with what its readers pass over told or read another way.

Several of them wait in a loop for a line that a file cut short does not have (`endguard`); all
print and some end the process: here that is a process of its own (`child`). Files with several
time steps are read where meshio can (XDMF). What meshio warns of goes on as a note.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from ..endguard import ending
from . import polyhedra
from .content import NOT_DRAWN, Ask, Content, Part, Trouble, is_solid, pick_step


def read(path: Path, ask: Ask, said: Callable[[], str], suffix: str) -> Content:
    import meshio

    formats = meshio.extension_to_filetypes.get(suffix, [])
    if not formats:
        raise Trouble("suffix", "")
    reasons = []
    for file_format in formats:
        try:
            with ending():
                if file_format == "xdmf" and (series := _xdmf_series(path, ask)) is not None:
                    content = series
                else:
                    content = content_of(_patched(meshio, path, file_format))
            break
        except (ImportError, MemoryError, Trouble):
            raise
        except BaseException as e:
            text = " ".join([*said().split(), *str(e).split()][:60])
            reasons.append(f"{file_format}: {type(e).__name__}: {text}")
    else:
        raise Trouble("damaged", f"meshio: {'; '.join(reasons)[:300]}")
    content.reader = f"meshio ({file_format})"
    content.active = _active(path) if suffix == ".vtu" else []
    told = " ".join(said().split())
    if told:
        content.notes.append(f"meshio says: {told[:300]}")
    return content


def _patched(meshio: Any, path: Path, file_format: str) -> Any:
    """meshio's mesh, of a file as its reader wants it: see the comments."""
    import io

    _require_flat(path, file_format)
    if file_format == "nastran":
        text = path.read_bytes()
        if b"BEGIN BULK" not in text.upper():  # optional in bulk data files, as gmsh writes them
            with io.StringIO("BEGIN BULK\n" + text.decode("utf-8", "replace")) as f:
                return (
                    meshio.nastran.read_buffer(f)
                    if hasattr(meshio.nastran, "read_buffer")
                    else meshio.nastran._nastran.read_buffer(f)
                )
    if file_format == "abaqus":
        text = path.read_text("utf-8", "replace")
        if (merged := _one_node_section(text)) is not None:
            with io.StringIO(merged) as f:
                return meshio.abaqus._abaqus.read_buffer(f)
    if file_format == "med":
        _without_groups(meshio.med._med)
    if file_format == "ugrid":
        return _ugrid(meshio, path)
    return meshio.read(path, file_format)


def _ugrid(meshio: Any, path: Path) -> Any:
    """meshio keeps the digits of float32 from files of text, and writes "np.int64(8)" for 8 where
    NumPy is 2."""
    module = meshio.ugrid._ugrid
    if module.determine_file_type(str(path))["type"] != "ascii":
        return meshio.read(path, "ugrid")
    text = re.sub(rb"np\.\w+\(([^()]*)\)", rb"\1", path.read_bytes())
    form = {"type": "ascii", "float_type": "f8", "int_type": "i8"}
    with tempfile.TemporaryFile() as f:  # its reader needs a file of the system
        f.write(text)
        f.seek(0)
        return module.read_buffer(f, form)


def _require_flat(path: Path, file_format: str) -> None:
    """Trouble for files of which meshio would read a part, or put nodes in wrong places."""

    def lines(pattern: str) -> list[str]:
        text = path.read_text("utf-8", "replace")
        return [m[0].rstrip() for m in re.finditer(pattern, text, re.M | re.I)]

    why = ""
    if file_format == "tecplot" and (n := len(lines(r"^[ \t]*ZONE\b.*"))) > 1:
        why = f"it has {n} zones, of which meshio reads one"
    elif file_format == "su2":
        zones = [w.partition("=")[2].strip() for w in lines(r"^[ \t]*NZONE[ \t]*=[ \t]*\d+")]
        if any(int(n) > 1 for n in zones):
            why = f"it has {zones[0]} zones, of which one would be read"
    elif file_format == "abaqus":
        n = len(lines(r"^\*INSTANCE\b.*"))
        moved = lines(r"^\*INSTANCE\b.*\n(?:\*\*.*\n)*[ \t]*[-+.\d].*")
        if (parts := len(lines(r"^\*PART\b.*"))) > 1 or n > 1:
            why = f"it is an assembly of {parts} parts and {n} instances; save one flat mesh"
        elif moved:
            why = "its instance of a part is moved; save one flat mesh"
    elif file_format == "nastran":
        for line in lines(r"^(?:GRID|GRDSET)\*?[ ,\t].*"):
            if "," in line:
                system = [*line.split(","), "", "", ""][2]
            else:
                system = line[24:40] if line[:8].strip().endswith("*") else line[16:24]
            if system.strip() not in ("", "0"):
                why = f"coordinates of {line[:24]!r} are in system {system.strip()}, not the basic"
                break
    if why:
        raise Trouble("unsupported", why)


def _without_groups(module: Any) -> None:
    """Families of a MED file may have no groups, as gmsh writes them: they have no names then."""
    given = module._read_families
    if given.__name__ != "_read_families":
        return

    def families(data: Any) -> Any:
        named = {k: v for k, v in data.items() if "GRO" in v}
        return given(named) | {v.attrs["NUM"]: [] for k, v in data.items() if k not in named}

    module._read_families = families


def _one_node_section(text: str) -> str | None:
    """An Abaqus file with the rows of all *NODE sections in the first: meshio keeps the last one
    only. None where there is one."""
    lines = text.splitlines(keepends=True)
    starts = [k for k, line in enumerate(lines) if re.match(r"\*NODE\s*(,|$)", line.strip(), re.I)]
    if len(starts) < 2:
        return None
    rows, rest = [], []
    inside = False
    first = None
    for k, line in enumerate(lines):
        if line.startswith("*") and not line.startswith("**"):
            inside = k in starts
            if inside:
                if first is None:
                    first = len(rest)
                    rest.append(line)
                continue
        (rows if inside else rest).append(line if line.endswith("\n") else line + "\n")
    assert first is not None
    return "".join([*rest[: first + 1], *rows, *rest[first + 1 :]])


def content_of(mesh: Any) -> Content:
    """What a meshio.Mesh holds."""
    points = np.asarray(mesh.points)
    if points.ndim != 2 or not mesh.cells:
        raise Trouble(
            "damaged", f"it holds no mesh: points {points.shape}, {len(mesh.cells)} cells"
        )
    content = Content(points, [], point={k: np.asarray(a) for k, a in mesh.point_data.items()})
    rows: list[Any] = []
    start = 0
    for block in mesh.cells:
        n = len(block.data)
        if block.type.startswith("polyhedron"):
            faces = [[[int(i) for i in f] for f in cell] for cell in block.data]
            tets, parent = polyhedra.cut(content, faces, np.arange(start, start + n))
            content.reordered = "polyhedra are cut"
            content.parts.append(Part("polyhedron parts", tets))
            rows.append(parent)
        elif is_solid(block.type):
            name = block.type.removeprefix("VTK_").lower().replace("_", " ")
            content.parts.append(Part(name, np.asarray(block.data)))
            rows.append(slice(None))
        else:
            content.parts.append(Part(block.type, n))
            rows.append(None)
        start += n
    for name, parts in mesh.cell_data.items():
        if len(parts) != len(mesh.cells):
            raise Trouble("damaged", f"field {name!r} has {len(parts)} of {len(mesh.cells)} blocks")
        arrays = []
        for row, block, a in zip(rows, mesh.cells, parts, strict=True):
            a = np.asarray(a)
            if len(a) != len(block.data):
                raise Trouble(
                    "damaged", f"field {name!r} has {len(a)} values for {len(block.data)}"
                )
            arrays.append(None if row is None else a[row])
        content.cell[name] = arrays
    for name, a in content.point.items():
        if len(a) != len(content.points):
            raise Trouble("damaged", f"field {name!r} has {len(a)} values for {len(points)} points")
    content.raw = (len(points), start)
    _without_ghosts(content)
    return content


def _without_ghosts(content: Content) -> None:
    """Leaves out the cells that VTK does not draw: see `vtk_data`."""
    hidden = content.point.pop("vtkGhostType", None)
    kinds, levels = (content.cell.pop(f"vtkGhost{w}", None) for w in ("Type", "Levels"))
    for k, part in enumerate(content.parts):
        if isinstance(part.nodes, int):
            continue
        drawn = np.ones(len(part), bool)
        if kinds is not None:
            drawn &= np.asarray(kinds[k]).astype(int) & NOT_DRAWN["cell"] == 0
        if levels is not None:
            drawn &= np.asarray(levels[k]) == 0
        if hidden is not None:
            drawn &= (hidden.astype(int) & NOT_DRAWN["point"] == 0)[part.nodes].all(1)
        if not drawn.all():
            content.reordered = "ghost cells are left out"
            part.nodes = part.nodes[drawn]
            for arrays in content.cell.values():
                a = arrays[k]
                arrays[k] = None if a is None else a[drawn]


def _active(path: Path) -> list[tuple[str, str]]:
    """The active point scalars that a VTU file names (meshio does not tell)."""
    with open(path, "rb") as f:
        text = f.read()
    found = []
    for where in ("Point", "Cell"):
        tag = re.search(rb"<%sData\b[^>]*>" % where.encode(), text)
        name = re.search(rb"\bScalars\s*=\s*[\"']([^\"']*)[\"']", tag[0]) if tag else None
        if name:
            found.append((name[1].decode("utf-8", "replace"), where.lower()))
    return found


def _xdmf_series(path: Path, ask: Ask) -> Content | None:
    """One step of an XDMF file with a temporal collection of grids; None for other files."""
    import meshio

    root = ElementTree.parse(path).getroot()
    temporal = [g for g in root.iter("Grid") if g.get("CollectionType", "").lower() == "temporal"]
    if not temporal:
        return None
    times = [float(t.get("Value", "nan")) for t in temporal[0].iter("Time")]
    with meshio.xdmf.TimeSeriesReader(path) as reader:
        points, cells = reader.read_points_cells()
        if len(times) != reader.num_steps:
            times = [float(k) for k in range(reader.num_steps)]
        step = pick_step(tuple(times), ask.step)
        _, point, cell, *_ = reader.read_data(step)
    make: Any = meshio.Mesh
    content = content_of(make(points, cells, point_data=point, cell_data=cell))
    content.steps, content.step = tuple(times) if len(times) > 1 else (), step
    return content
