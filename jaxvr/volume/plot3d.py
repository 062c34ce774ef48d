"""NASA's PLOT3D files: curvilinear grids (xyz) and conserved flow quantities (q), binary, in 3-D.

Format: P. P. Walatka, P. G. Buning, L. Pierce and P. A. Elson, PLOT3D User's Manual, NASA TM 101067
(1990). A grid file is its dimensions, then x, y, z of each block, and perhaps an integer `iblank`
a point (0: it is not part of the flow). A solution file is the dimensions, then for each block the
Mach number, angle of attack, Reynolds number and time, and density, momentum (3) and energy.

The files say nothing of how they were written. Byte order, 4- or 8-byte floats, one block or a
block count, Fortran record markers and iblank are told from the dimensions, the record lengths and
the file's size: of all readings whose data fit, with only zeros behind them, the closest is taken.
"""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path
from typing import Any

import numpy as np

from .mesh import TetMesh, _from_cells
from .readers import AXES, _path
from .structured import grid_cells, right_handed

GAMMA = 1.4
MAX_BLOCKS = 10_000
Dims = tuple[tuple[int, int, int], ...]


@dataclasses.dataclass(frozen=True)
class _Layout:
    """One reading of a file: order is "<" or ">", width the bytes of a float."""

    order: str
    markers: bool
    counted: bool
    width: int
    iblank: bool
    dims: Dims
    start: int
    end: int


def _header(raw: bytes, order: str, markers: bool, counted: bool) -> tuple[Dims, int] | None:
    """Dimensions and the offset behind them, or `None` where they make no sense."""

    def ints(offset: int, n: int) -> list[int] | None:
        if offset + 4 * n > len(raw):
            return None
        return np.frombuffer(raw, order + "i4", n, offset).tolist()

    at, n = 0, 1
    if counted:
        head = ints(0, 3 if markers else 1)
        if head is None:
            return None
        n = head[1] if markers else head[0]
        if not 0 < n <= MAX_BLOCKS or (markers and (head[0] != 4 or head[2] != 4)):
            return None
        at = 12 if markers else 4
    body = ints(at, 3 * n + 2 * markers)
    if body is None:
        return None
    if markers:
        if body[0] != 12 * n or body[-1] != 12 * n:
            return None
        body = body[1:-1]
    dims = tuple((body[i], body[i + 1], body[i + 2]) for i in range(0, 3 * n, 3))
    if any(d < 1 for block in dims for d in block):
        return None
    return dims, at + 4 * (3 * n + 2 * markers)


def _records(n: int, width: int, iblank: bool, solution: bool) -> list[int]:
    """Bytes of each record of a block with n points."""
    return [4 * width, 5 * n * width] if solution else [3 * n * width + (4 * n if iblank else 0)]


def _fits(raw: bytes, layout: _Layout, solution: bool) -> int | None:
    """The offset behind the data if this reading is possible, else `None`."""
    at = layout.start
    for ni, nj, nk in layout.dims:
        for size in _records(ni * nj * nk, layout.width, layout.iblank, solution):
            if layout.markers:
                if at + 8 + size > len(raw):
                    return None
                for mark in (at, at + 4 + size):
                    if np.frombuffer(raw, layout.order + "u4", 1, mark)[0] != size:
                        return None
                at += 8
            at += size
    return at if at <= len(raw) and not raw[at:].strip(b"\0") else None


def _detect(path: Path, raw: bytes, solution: bool) -> _Layout:
    found: list[_Layout] = []
    for order, markers, counted in itertools.product("<>", (True, False), (False, True)):
        head = _header(raw, order, markers, counted)
        if head is None:
            continue
        for width, iblank in itertools.product((4, 8), (False,) if solution else (False, True)):
            layout = _Layout(order, markers, counted, width, iblank, *head, end=0)
            end = _fits(raw, layout, solution)
            if end is not None:
                found.append(dataclasses.replace(layout, end=end))
    if not found:
        kind = "solution (q)" if solution else "grid (xyz)"
        raise ValueError(
            f"{str(path)!r} ({len(raw)} bytes) is no binary 3-D PLOT3D {kind} file: in no byte "
            "order, with or without record markers, do its dimensions fit its size. It may be cut "
            "short, text, two-dimensional, or the other of the two files."
        )
    return max(found, key=lambda x: x.end)


def _read_blocks(path: Path, solution: bool) -> tuple[_Layout, list[list[np.ndarray]]]:
    """The layout, and for each block its records' arrays (floats, and iblank if there is any)."""
    if not path.exists():
        raise FileNotFoundError(f"There is no file {str(path)!r}.")
    if path.is_dir():
        raise ValueError(f"{str(path)!r} is a folder. Pass a PLOT3D file.")
    raw = path.read_bytes()
    layout = _detect(path, raw, solution)
    at, blocks = layout.start, []
    native = np.float32 if layout.width == 4 else np.float64
    for ni, nj, nk in layout.dims:
        n, arrays = ni * nj * nk, []
        for size in _records(n, layout.width, layout.iblank, solution):
            at += 4 * layout.markers
            tail = 4 * n if layout.iblank else 0
            count = (size - tail) // layout.width
            a = np.frombuffer(raw, f"{layout.order}f{layout.width}", count, at)
            arrays.append(a.astype(native))
            if tail:
                b = np.frombuffer(raw, layout.order + "i4", n, at + size - tail)
                arrays.append(b.astype(np.int32))
            at += size + 4 * layout.markers
        blocks.append(arrays)
    return layout, blocks


_CONSERVED = {"density": 0, "energy": 4} | {f"momentum.{a}": 1 + i for a, i in AXES.items()}
_DERIVED = ("pressure", "speed", "momentum.magnitude", *(f"velocity.{a}" for a in AXES))


def _field(q: np.ndarray, name: str) -> np.ndarray:
    """A field (P,) of the conserved quantities q (5, P): density, momentum, energy."""
    if name in _CONSERVED:
        return q[_CONSERVED[name]]
    if name not in _DERIVED:
        raise ValueError(
            f"PLOT3D files have no field {name!r}. They have {', '.join([*_CONSERVED, *_DERIVED])}."
        )
    wide = q.astype(np.float64)
    density, momentum, energy = wide[0], wide[1:4], wide[4]
    square = (momentum**2).sum(0)
    if name == "momentum.magnitude":
        return np.sqrt(square).astype(q.dtype)
    bad = ~(density > 0)
    if bad.any():
        i = int(np.argmax(bad))
        raise ValueError(
            f"{name} needs a positive density, but {int(bad.sum())} points have none, the first "
            f"at index {i}: {density[i]:g}. Take density or energy instead."
        )
    if name == "pressure":
        out = (GAMMA - 1) * (energy - 0.5 * square / density)
    elif name == "speed":
        out = np.sqrt(square) / density
    else:
        out = momentum[AXES[name[-1]]] / density
    return out.astype(q.dtype)


def read_plot3d(
    xyz_path: Any, q_path: Any = None, field: str | None = None, dtype: Any = None
) -> TetMesh:
    """The volume of a PLOT3D grid: its hexahedra, cut into tetrahedra, with a field of the q file.

    xyz_path, q_path: the files of the grid and of the solution.
    field: "density" (the default), "energy", "pressure" (ideal gas, gamma = 1.4), "speed",
        "momentum.x", .y, .z, .magnitude or "velocity.x", .y, .z, in the file's (dimensionless)
        units. Without a q file: a coordinate, "x" (the default), "y" or "z".
    dtype: as in `TetMesh.from_cells`.

    Blocks are joined where their points coincide exactly. Cells with a blanked point (iblank 0) are
    left out; so are blocks that are one point thick. Left-handed blocks are read as right-handed.
    Raises FileNotFoundError where a file is missing and ValueError where one is no binary PLOT3D
    file, the two do not belong together, no such field exists, or `TetMesh.from_cells` refuses.
    """
    file = _path(xyz_path)
    layout, blocks = _read_blocks(file, solution=False)
    points, cells, start = [], [], 0
    for (ni, nj, nk), arrays in zip(layout.dims, blocks, strict=True):
        p = arrays[0].reshape(3, -1).T
        if min(ni, nj, nk) > 1:
            hexahedra = grid_cells(ni, nj, nk)
            if layout.iblank:
                hexahedra = hexahedra[(arrays[1][hexahedra] != 0).all(1)]
            if len(hexahedra):
                cells.append(right_handed(p, hexahedra) + start)
        points.append(p)
        start += len(p)
    if not cells:
        raise ValueError(
            f"No cells left in {str(file)!r}: dimensions {layout.dims}"
            + (", and blanked points." if layout.iblank else ".")
        )
    xyz = np.concatenate(points)
    if q_path is None:
        field = "x" if field is None else field
        if field not in AXES:
            raise ValueError(f'Field {field!r} needs q_path; a grid alone has "x", "y" and "z".')
        values = xyz[:, AXES[field]]
    else:
        field = "density" if field is None else field
        q_file = _path(q_path)
        q_layout, q_blocks = _read_blocks(q_file, solution=True)
        if q_layout.dims != layout.dims:
            raise ValueError(
                f"{str(file)!r} has dimensions {layout.dims}, but {str(q_file)!r} has "
                f"{q_layout.dims}. They do not belong together."
            )
        values = _field(np.concatenate([b[1].reshape(5, -1) for b in q_blocks], 1), field)
    return _from_cells(
        TetMesh,
        xyz,
        {"hexahedron": np.concatenate(cells)},
        values,
        "point",
        dtype,
        field,
        stacklevel=3,
    )
