"""Files of unstructured meshes, through meshio: VTU, VTK, Exodus, gmsh, XDMF, Abaqus and others.

meshio's readers end in many ways when a file is not what it seems (their own exceptions, those of
zlib, struct and the XML parser, `sys.exit` and a message on the console, or not at all: see
`endguard`); all of them become one ValueError here. `read_mesh` never guesses: a vector field has
to be asked for by component.
"""

from __future__ import annotations

import contextlib
import difflib
import io
import mmap
import os
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import meshio
import numpy as np

from . import cells as zoo
from .endguard import ending
from .geometry import signed_volumes
from .mesh import TetMesh, _from_cells

_WHOLE = (".vtu", ".vtk")  # formats that hold all there is
AXES = {"x": 0, "y": 1, "z": 2}


class Field(NamedTuple):
    """A field in a file: its name, where it lives ("point" or "cell"), numbers per place."""

    name: str
    location: str
    components: int


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """No console output and no warnings from meshio, whose messages end up in our errors."""
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        with contextlib.redirect_stderr(io.StringIO()):
            yield


def _path(path: Any) -> Path:
    try:
        return Path(os.fspath(path))
    except TypeError as e:
        raise ValueError(f"path must be a string or a Path, but is {type(path).__name__}.") from e


def _load(path: Path) -> meshio.Mesh:
    if not path.exists():
        raise FileNotFoundError(f"There is no file {str(path)!r}.")
    if path.is_dir():
        raise ValueError(f"{str(path)!r} is a folder. Pass a mesh file.")
    if path.stat().st_size == 0:
        raise ValueError(f"{str(path)!r} is empty.")
    said = io.StringIO()
    try:
        with ending(), _quiet(), contextlib.redirect_stderr(said):
            mesh = meshio.read(path)
        points = np.asarray(mesh.points)
        blocks = [np.asarray(b.data) for b in mesh.cells]
    except KeyboardInterrupt:
        raise
    except BaseException as e:  # meshio raises anything, SystemExit included
        parts = [" ".join(said.getvalue().split()), " ".join(str(e).split())]
        text = " ".join(p for p in parts if p and p != "1") or "no reason given"
        raise ValueError(
            f"{str(path)!r} cannot be read as a mesh ({type(e).__name__}: {text[:300]}). It may be "
            "damaged, cut short, or not the format that its name says."
        ) from e
    if points.ndim != 2 or not blocks:
        raise ValueError(
            f"{str(path)!r} holds no mesh: {points.shape} points, {len(blocks)} cells."
        )
    return mesh


def _components(data: Any) -> int:
    """Numbers per place; 0 for something that is not a field of numbers."""
    a = np.asarray(data)
    return int(np.prod(a.shape[1:])) if a.ndim and a.dtype.kind in "fiub" else 0


def _fields(mesh: meshio.Mesh) -> list[Field]:
    found = [Field(n, "point", _components(d)) for n, d in mesh.point_data.items()]
    for name, parts in mesh.cell_data.items():
        solid = [d for b, d in zip(mesh.cells, parts, strict=False) if _is_solid(b.type)]
        if solid:
            found.append(Field(name, "cell", _components(solid[0])))
    return [f for f in found if f.components > 0]


def _is_solid(cell_type: str) -> bool:
    return zoo.canonical(cell_type)[0] is not None


def _listing(fields: list[Field]) -> str:
    if not fields:
        return "It has no fields"
    words = [
        f"{f.name!r} ({f.location}{'' if f.components == 1 else f', {f.components} components'})"
        for f in fields
    ]
    return "It has " + ", ".join(words)


def _near(name: str, fields: list[Field]) -> str:
    """A question that names the field most like this one, if there is any like it."""
    names = {f.name.lower(): f.name for f in fields}
    base, dot, part = name.rpartition(".")
    for word, rest in ((name, ""), (base, dot + part)):
        if near := difflib.get_close_matches(word.lower(), names, n=1):
            return f'Did you mean "{names[near[0]]}{rest}"? '
    return ""


def _active(path: Path) -> str | None:
    """The active point scalars that a VTU file names (meshio does not tell)."""
    if path.suffix.lower() != ".vtu":
        return None
    with open(path, "rb") as f, mmap.mmap(f.fileno(), 0, access=mmap.ACCESS_READ) as text:
        tag = re.search(rb"<PointData\b[^>]*>", text)
        name = re.search(rb"\bScalars\s*=\s*[\"']([^\"']*)[\"']", tag[0]) if tag else None
        return name[1].decode("utf-8", "replace") if name else None


def _choose(
    path: Path, fields: list[Field], name: str | None, location: str | None
) -> tuple[Field, int | str | None]:
    """The field and which component of it: an index, "magnitude", or `None` for a scalar."""
    wanted = [f for f in fields if location in (None, f.location)]
    where = "" if location is None else f" {location}"
    if name is None:
        scalars = [f for f in wanted if f.components == 1]
        if not scalars:
            raise ValueError(
                f"{path.name} has no scalar{where} field to take. {_listing(fields)}. For a "
                'vector, pass field="name.x" or field="name.magnitude".'
            )
        active = (_active(path), "point")
        return next((f for f in scalars if (f.name, f.location) == active), scalars[0]), None
    exact = next((f for f in wanted if f.name == name), None)
    if exact is not None:
        if exact.components != 1:
            raise ValueError(
                f"Field {name!r} of {path.name} has {exact.components} components. Pass "
                f'field="{name}.x" (or .y, .z, .0 to .{exact.components - 1}) or '
                f'field="{name}.magnitude".'
            )
        return exact, None
    base, _, part = str(name).rpartition(".")
    vector = next((f for f in wanted if f.name == base), None)
    if vector is None:
        near = _near(str(name), wanted)
        raise ValueError(f"{path.name} has no{where} field {name!r}. {near}{_listing(fields)}.")
    index = AXES.get(part, int(part) if part.isdecimal() else -1)
    if part != "magnitude" and not 0 <= index < vector.components:
        raise ValueError(
            f"Field {base!r} of {path.name} has {vector.components} component(s), but {part!r} was "
            'asked for. Pass "x", "y", "z", a number from 0, or "magnitude" after the dot.'
        )
    return vector, part if part == "magnitude" else index


def _scalar(data: Any, part: int | str | None) -> np.ndarray:
    a = np.asarray(data)
    flat = a.reshape(len(a), -1)
    if isinstance(part, str):
        return np.linalg.norm(flat.astype(np.float64), axis=1)
    return flat[:, part or 0]


def list_fields(path: Any) -> list[Field]:
    """The fields of the mesh file at `path`, point data first. Errors are those of `read_mesh`."""
    file = _path(path)
    mesh = _load(file)
    try:
        return _fields(mesh)
    except ValueError as e:
        raise ValueError(f"{file.name}: {e}") from e


def read_mesh(
    path: Any, field: str | None = None, dtype: Any = None, *, location: str | None = None
) -> TetMesh:
    """The mesh in a file, with one of its fields. Reads whatever meshio reads.

    path: a file whose name ends as its format wants it.
    field: the name of a point or cell field; "name.x", "name.y", "name.z", "name.0" or
        "name.magnitude" for one that has components. `None` takes the active scalar point field if
        the file names one, else the first scalar, point fields before cell fields.
    dtype: as in `TetMesh.from_cells`. location: "point" or "cell" where both have that name.

    Zoo cells are subdivided so that they conform; quadratic cells are reduced to their corners;
    points, lines and faces among the cells are ignored (`mesh.report` counts all of these).
    Raises FileNotFoundError where there is no file, and ValueError for a file that is no mesh, is
    damaged or cut short, has not this field (with those it has), or fails `TetMesh.from_cells`.
    """
    if location not in (None, "point", "cell"):
        raise ValueError(f'location must be "point", "cell" or None, but is {location!r}.')
    file = _path(path)
    mesh = _load(file)
    try:
        solid = [i for i, b in enumerate(mesh.cells) if _is_solid(b.type)]
        cells: dict[str, Any] = {}
        for t in dict.fromkeys(b.type for b in mesh.cells):  # a type may have several blocks
            parts = [b.data for b in mesh.cells if b.type == t]
            flat = not _is_solid(t)  # only counted, and polygons are ragged
            cells[t] = range(sum(map(len, parts))) if flat else np.concatenate(parts)
        chosen, part = _choose(file, _fields(mesh), field, location)
        name = chosen.name if part is None else f"{chosen.name}.{_suffix(part)}"
        if chosen.location == "point":
            values: Any = _scalar(mesh.point_data[chosen.name], part)
        else:
            data = mesh.cell_data[chosen.name]
            values = {
                t: np.concatenate(
                    [_scalar(data[i], part) for i in solid if mesh.cells[i].type == t]
                )
                for t in dict.fromkeys(mesh.cells[i].type for i in solid)
            }
        return _from_cells(
            TetMesh, mesh.points, cells, values, chosen.location, dtype, name, stacklevel=3
        )
    except ValueError as e:
        message = str(e)
        if file.name not in message:
            message = f"{file.name}: {message}"
        raise ValueError(message) from e


def _suffix(part: int | str) -> str:
    return part if isinstance(part, str) else "xyz"[part] if part < 3 else str(part)


def write_mesh(path: Any, mesh: TetMesh) -> None:
    """Write the tetrahedra (positively oriented) of a mesh and its field to the file at `path`, in
    the format of its name.

    Point and cell data are written as such. Files have no data per corner: those become point data
    on points of each tetrahedron's own, which `read_mesh` welds again, so the mesh that comes back
    has the same faces and the same picture. The field has the name it was read by, or "values".
    Raises ValueError for a name whose format meshio does not know or cannot write this in.
    """
    file = _path(path)
    points = np.asarray(mesh.points)
    cells = np.asarray(mesh.cells)
    values = np.asarray(mesh.values)
    _, sign = signed_volumes(points, cells)
    flip = sign < 0
    order = np.tile(np.arange(4), (len(cells), 1))
    order[flip] = (0, 1, 3, 2)
    tets = np.take_along_axis(cells, order, 1)
    name = mesh.report.field or "values"
    point_data: dict[str, Any] = {}
    cell_data: dict[str, Any] = {}
    if mesh.location == "corner":
        point_data[name] = np.take_along_axis(values, order, 1).reshape(-1)
        points = points[tets.reshape(-1)]
        tets = np.arange(tets.size).reshape(tets.shape)
    elif mesh.location == "cell":
        cell_data[name] = [values]
    else:
        point_data[name] = values
    if not file.parent.is_dir():
        raise FileNotFoundError(f"There is no folder {str(file.parent)!r} to write in.")
    try:
        out = meshio.Mesh(
            points, [("tetra", tets.astype(np.int64))], point_data=point_data, cell_data=cell_data
        )
        with _quiet():
            out.write(file)
            back = None if file.suffix.lower() in _WHOLE else meshio.read(file)
    except KeyboardInterrupt:
        raise
    except BaseException as e:  # as in _load
        text = " ".join(str(e).split()) or "no reason given"
        raise ValueError(
            f"The mesh cannot be written to {str(file)!r} ({type(e).__name__}: {text[:300]}). "
            'A name that ends in ".vtu" always works.'
        ) from e
    if back is not None:  # some formats leave out, in silence, what they cannot hold
        kept = sum(len(b.data) for b in back.cells if b.type == "tetra")
        if kept != len(tets) or name not in {f.name for f in _fields(back)}:
            raise ValueError(
                f"The format of {file.name} holds {kept} of {len(tets)} tetrahedra and the fields "
                f"{[f.name for f in _fields(back)]}, not {name!r}. Write a .vtu file instead."
            )
