"""Tetrahedra and a field to a file, by meshio: whole, or not at all.

A file is made in a folder of its own beside its place, synced to the disk, read back where its
format may leave something out, and then moved: whoever is killed or finds the disk full leaves the
file that was there before. What formats put beside it (.h5) goes with it.
"""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from jaxvr._core.writing import move

from .content import Trouble

_WHOLE = (".vtu", ".vtk")  # formats that hold all there is


def write(
    said: Callable[[], str],
    path: str,
    points: np.ndarray,
    tets: np.ndarray,
    name: str,
    values: np.ndarray,
    location: str,
    workshop: str,
    suffix: str,
) -> None:
    """location: "point" or "cell". workshop: a folder to make, beside the file. suffix: of the
    format; the file, that a link may lead to, may have another one. Raises Trouble."""
    import meshio

    file = Path(path)
    data: dict[str, Any] = (
        {"point_data": {name: values}} if location == "point" else {"cell_data": {name: [values]}}
    )
    mesh = meshio.Mesh(points, [("tetra", tets)], **data)
    folder = Path(workshop)
    try:
        folder.mkdir(mode=0o700)
        made = folder / (file.name if file.suffix == suffix else file.name + suffix)
        mesh.write(made)
        if suffix.lower() not in _WHOLE:
            _require_whole(made, len(tets), name, location, said)
        _move(made, file)
    except OSError as e:
        if e.errno is None and "requested and" in str(e):  # of NumPy, where a write fell short
            raise Trouble("system", f"{errno.ENOSPC}:{os.strerror(errno.ENOSPC)}") from e
        raise Trouble("system", f"{e.errno or errno.EIO}:{e.strerror or e}") from e
    except (ImportError, MemoryError, Trouble):
        raise
    except BaseException as e:  # meshio raises anything, SystemExit included
        text = " ".join([*said().split(), *str(e).split()]) or "no reason given"
        raise Trouble("unsupported", f"{type(e).__name__}: {text[:300]}") from e
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _require_whole(made: Path, n: int, name: str, location: str, said: Callable[[], str]) -> None:
    """Some formats leave out, in silence, what they cannot hold."""
    from . import fields, registry
    from .content import Ask

    try:
        back = registry.read(made, Ask(), said)
    except Trouble as e:
        raise Trouble("unsupported", f"what was written cannot be read: {e}") from None
    kept = sum(len(p) for p in back.parts if p.type == "tetra")
    has = [f.name for f in fields.list_of(back) if f.location == location]
    if kept != n or name not in has:
        raise Trouble(
            "unsupported",
            f"the format of {made.name} holds {kept} of {n} tetrahedra and the {location} fields "
            f"{has}, not {name!r}",
        )


def _move(made: Path, file: Path) -> None:
    """The files beside `made` to the place of `file`, and then `made` as `file`."""
    for other in sorted(p for p in made.parent.iterdir() if p != made):
        move(other, file.parent / other.name)
    move(made, file)
