"""Files of unstructured meshes: `read_mesh`, `list_fields`, `write_mesh`.

What reads them stands in the folder `io`, and runs in a process of its own: here is what users see,
and what is said when a file cannot be read: whether it is damaged, of a kind that is not supported,
in need of a package, or of an unknown kind. `read_mesh` never guesses: a vector field has to be
asked for by component, and what is taken where there is a choice is told.
"""

from __future__ import annotations

import dataclasses
import operator
import os
import shutil
import uuid
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from .geometry import signed_volumes
from .io import process, sizes
from .io.content import Ask, Field, Trouble
from .io.fields import AXES
from .mesh import TetMesh, _from_cells

__all__ = ["AXES", "Field", "list_fields", "read_mesh", "write_mesh"]

_DEFAULT = "default"  # of `max_memory`


def _path(path: Any) -> Path:
    try:
        text = os.fspath(path)
        return Path(os.fsdecode(text)).expanduser()
    except TypeError as e:
        raise ValueError(f"path must be a string or a Path, but is {type(path).__name__}.") from e
    except RuntimeError as e:  # no home
        raise ValueError(f"{path!r} has no meaning here: {e}.") from e


def _existing(path: Any) -> Path:
    """The path of a file that is there and not empty."""
    file = _path(path)
    text = str(path)
    if "://" in text:
        raise ValueError(f"{text!r} is an address. Files are read from disk: download it first.")
    try:
        if not file.exists():
            raise FileNotFoundError(f"There is no file {str(file)!r}.")
        if file.is_dir():
            raise ValueError(f"{str(file)!r} is a folder. Pass a mesh file.")
        if not file.is_file():
            raise ValueError(f"{str(file)!r} is no regular file. Pass a mesh file.")
        if file.stat().st_size == 0:
            raise ValueError(f"{str(file)!r} is empty.")
    except ValueError as e:
        if "null" in str(e):
            raise ValueError(f"path {text!r} has a null character.") from None
        raise
    return file.absolute()


def _ask(step: Any, block: Any, limit: int | None) -> Ask:
    if isinstance(step, bool | np.bool_) or not isinstance(
        step, int | float | np.integer | np.floating | None
    ):
        raise ValueError(
            f"step must be an integer (an index) or a float (a time), but is {step!r}."
        )
    if isinstance(step, np.integer | np.floating):
        step = step.item()
    if isinstance(block, str):
        block = str.__str__(block)  # of subclasses, which the reading process does not know
    elif block is not None:
        many = [block] if isinstance(block, int | np.integer | np.bool_) else block
        try:
            items: list[Any] = list(many)
            if any(isinstance(b, bool | np.bool_) for b in items):
                raise TypeError
            block = [str.__str__(b) if isinstance(b, str) else operator.index(b) for b in items]
        except (TypeError, ValueError):
            raise ValueError(
                f"block must be a name, an index or a list of them, but is {block!r}."
            ) from None
    return Ask(step, block, limit)


def _limits(file: Path, max_memory: Any) -> tuple[int | None, float | None]:
    """Bytes and seconds that reading may take."""
    if max_memory is None:
        return None, None
    size = sizes.volume_of(file, file.suffix.lower())
    if max_memory == _DEFAULT:
        return sizes.memory(size), sizes.seconds(size)
    if isinstance(max_memory, bool) or not isinstance(max_memory, int | float | np.number):
        raise ValueError(f"max_memory must be a number of bytes or None, but is {max_memory!r}.")
    if not max_memory > 0:
        raise ValueError(f"max_memory must be above 0, but is {max_memory!r}.")
    return int(max_memory), sizes.seconds(size)


def _run(job: str, file: Path, max_memory: Any, step: Any, block: Any, **arguments: Any) -> Any:
    memory, seconds = _limits(file, max_memory)
    ask = _ask(step, block, memory)
    arguments["path"] = str(file)
    try:
        try:
            return process.run(job, memory, seconds, ask=ask, **arguments)
        except Trouble as e:
            if e.kind != "crashed":
                raise
            crash = e.message
        try:
            got = process.run(
                job, memory, seconds, ask=dataclasses.replace(ask, vtk=False), **arguments
            )
        except Trouble as e:
            raise Trouble("damaged", f"{crash}; without VTK: {e.message or e.kind}") from None
        warnings.warn(f"{file.name}: {crash}, and another one read it.", UserWarning, stacklevel=3)
        return got
    except Trouble as e:
        raise _error(file, e, memory, seconds) from None


def _error(file: Path, e: Trouble, memory: int | None, seconds: float | None) -> Exception:
    name, why = str(file), e.message.rstrip(".")
    if e.kind == "asked":
        return ValueError(why + "." if file.name in why else f"{file.name}: {why}.")
    if e.kind == "package":
        return ValueError(f"{name!r} is not read: {why}.")
    if e.kind == "unsupported":
        return ValueError(f"{name!r} is of a kind that is not supported: {why}.")
    if e.kind == "suffix":
        return ValueError(f"{name!r} is of an unknown kind: {why}.")
    if e.kind == "system":
        number, _, text = e.message.partition(":")
        if number.isdecimal():
            return OSError(int(number), text, name)
        return OSError(e.message)
    if e.kind in ("large", "slow"):
        limit = "" if memory is None else f" than the {memory / 2**20:.0f} MB that it may"
        took = f"Reading {name!r} takes more memory{limit}"
        if e.kind == "slow":
            took = f"Reading {name!r} takes longer than {seconds:.0f} seconds"
        because = f" ({why})" if why else ""
        return ValueError(
            f"{took}{because}. Files that are damaged ask for such amounts; if this one is not, "
            "pass max_memory= in bytes, or None for no limit of memory and time."
        )
    return ValueError(
        f"{name!r} cannot be read as a mesh: {why}. It is damaged, cut short, or not the format "
        "that its name says."
    )


def list_fields(path: Any, *, max_memory: Any = _DEFAULT) -> list[Field]:
    """The fields of the mesh file at `path`, point data first.

    Each is a named tuple of its name, location ("point", "cell" or "corner"), number of components,
    the names of the blocks that have it (where the file has several) and the times of the steps
    that have it (where the file has several). Of a .pvd or .series file all steps are looked at;
    where that takes reading more than 20 of them as a whole, a warning says which were not.
    `path`, `max_memory` and errors are those of `read_mesh`.
    """
    file = _existing(path)
    found, notes = _run("fields", file, max_memory, None, None)
    for note in notes:
        warnings.warn(f"{file.name}: {note}", UserWarning, stacklevel=2)
    return found


def read_mesh(
    path: Any,
    field: str | None = None,
    dtype: Any = None,
    *,
    location: str | None = None,
    step: int | float | None = None,
    block: Any = None,
    values: Any = None,
    max_memory: Any = _DEFAULT,
) -> TetMesh:
    """The mesh in a file, with one of its fields.

    Reads what VTK reads, where it is installed (`pip install vtk`): .vtu .pvtu .vtk .vtkhdf .vtm
    .pvd .cgns Exodus EnSight OpenFOAM and the structured kinds, whose cells are taken as
    hexahedra; gmsh's .msh; and the formats of meshio. `experiments/files.md` has a table.

    path: a file whose name ends as its format wants it; "~" is the home folder.
    field: the name of a field; "name.x", "name.y", "name.z", "name.0" or "name.magnitude" for one
        that has components. `None` takes the active scalar field if the file names one, else the
        first scalar, point fields before cell fields, those before fields at corners.
    dtype: as in `TetMesh.from_cells`. location: "point", "cell" or "corner" where several have that
        name, or of `values`.
    step: which time step: an index (from the end where it is negative) or, as a float, a time.
        `None` takes the last one, and warns where there are several.
    block: the name of a block, its place, or a list of them; `None` takes all.
    values: instead of a field of the file: an array as in `TetMesh.from_cells` for its points or
        cells, or a function from points (P, 3) to values (P,).
    max_memory: bytes that reading may take: by default 2 GiB, or 200 times the file's size if that
        is more, and 15 s of computing and 10 s for each MB. `None` lifts both.

    Zoo cells are subdivided so that they conform; quadratic cells are reduced to their corners;
    convex polyhedra are cut about their centroid, which becomes a point; points, lines and faces
    among the cells are ignored (`mesh.report` counts all of these); ghost cells are left out.
    Values at the corners of cells that are no tetrahedra come as point data on points of each
    cell's own, which are welded.

    Readers run in a process of their own, so that what they print, ask for or crash does not reach
    the caller's. Inside of an application whose `sys.executable` is no Python (one frozen by
    PyInstaller, or that embeds Python and has none beside) they run in the caller's, as the first
    time a warning says: there is no limit of memory and time, what readers print goes to its
    streams, VTK's messages pass by its window meanwhile, and a crash ends it.
    `multiprocessing.set_executable` says which Python to start instead.

    Raises FileNotFoundError where there is no file, OSError where the disk fails, and ValueError
    for a file that is damaged, of a kind that is not supported or known, in need of a package,
    larger than the limit, that has not this field, step or block (with those it has), whose cells
    would have to be repaired in more than a tenth of the mesh, or that fails `TetMesh.from_cells`.
    Warns of repairs, of the step that was taken, and of what its reader warns of.
    """
    if location not in (None, "point", "cell", "corner"):
        raise ValueError(
            f'location must be "point", "cell", "corner" or None, but is {location!r}.'
        )
    if field is not None:
        if not isinstance(field, str):
            raise ValueError(f"field must be a name, but is {type(field).__name__}.")
        field = str.__str__(field)
    location = None if location is None else str.__str__(location)
    if values is not None and field is not None:
        raise ValueError("Pass a field of the file or values, not both.")
    file = _existing(path)
    got = _run(
        "read", file, max_memory, step, block,
        field=field, location=location, values=values is not None,
    )  # fmt: skip
    for note in got["notes"]:
        warnings.warn(f"{file.name}: {note}", UserWarning, stacklevel=2)
    cells = {t: range(c) if isinstance(c, int) else c for t, c in got["cells"].items()}
    try:
        if values is not None:
            if isinstance(values, Callable):
                values = values(got["points"])
            else:
                _require_order(values, location, len(got["points"]), got["reordered"])
        else:
            values, location = got["values"], got["location"]
        return _from_cells(
            TetMesh, got["points"], cells, values, location, dtype, got["label"], stacklevel=3,
            strict=True,
        )  # fmt: skip
    except ValueError as e:
        message = str(e)
        if file.name not in message:
            message = f"{file.name}: {message}"
        raise ValueError(message) from e


def _require_order(values: Any, location: str | None, n_points: int, why: str) -> None:
    """ValueError for one array of cells where the cells of the file come in another order."""
    if not why or isinstance(values, dict) or location == "point":
        return
    if location is None and len(np.shape(values)) == 1 and len(values) == n_points:
        return
    raise ValueError(
        f"values cannot be one array for the cells of this file, whose order is not kept: {why}. "
        "Pass values at its points, a function of the points, or a dict by type of cell."
    )


def write_mesh(path: Any, mesh: TetMesh) -> None:
    """Write the tetrahedra (positively oriented) of a mesh and its field to the file at `path`, in
    the format of its name.

    Point and cell data are written as such. Files have no data per corner: those become point data
    on points of each tetrahedron's own, which `read_mesh` welds again, so the mesh that comes back
    has the same faces and the same picture. The field has the name it was read by, or "values".

    The file is there as a whole or not at all: it is made beside its place, synced and then moved
    over what was there. Through a link the file that it leads to is written, in the format of the
    link's name, or of that file's where the link has no suffix.

    Raises FileNotFoundError where there is no such folder, OSError where the disk is full or may
    not be written, and ValueError for a name whose format meshio does not know or cannot write this
    in.
    """
    file = _path(path)
    points = mesh.absolute_points() if any(mesh.origin) else np.asarray(mesh.points)
    cells = np.asarray(mesh.cells)
    values = mesh.absolute_values() if mesh.offset else np.asarray(mesh.values)
    _, sign = signed_volumes(points, cells)
    flip = sign < 0
    order = np.tile(np.arange(4), (len(cells), 1))
    order[flip] = (0, 1, 3, 2)
    tets = np.take_along_axis(cells, order, 1)
    location = "cell" if mesh.location == "cell" else "point"
    if mesh.location == "corner":
        values = np.take_along_axis(values, order, 1).reshape(-1)
        points = points[tets.reshape(-1)]
        tets = np.arange(tets.size).reshape(tets.shape)
    if not file.parent.is_dir():
        raise FileNotFoundError(f"There is no folder {str(file.parent)!r} to write in.")
    if file.is_dir():
        raise ValueError(f"{str(file)!r} is a folder. Pass the name of a file.")
    place = file.resolve()
    workshop = place.parent / f".{place.name[:40]}.{uuid.uuid4().hex}"
    name = mesh.report.field or "values"
    try:
        process.run(
            "write", None, None, path=str(place), points=points, tets=tets.astype(np.int64),
            name=name, values=values, location=location, workshop=str(workshop),
            suffix=file.suffix or place.suffix,
        )  # fmt: skip
    except Trouble as e:
        shutil.rmtree(workshop, ignore_errors=True)
        number, _, text = e.message.partition(":")
        if e.kind == "system" and number.isdecimal():
            raise OSError(int(number), f"{text}. Nothing was written", str(file)) from None
        raise ValueError(
            f"The mesh cannot be written to {str(file)!r}: {e.message.rstrip('.') or e.kind}. A "
            'name that ends in ".vtu" always works.'
        ) from None
    except BaseException:  # Ctrl-C: the process that wrote was ended
        shutil.rmtree(workshop, ignore_errors=True)
        raise
