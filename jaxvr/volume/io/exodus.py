"""Exodus files without VTK: netCDF, by the package netCDF4, or by SciPy for its classic format.

After the manual of Exodus II (Schoof and Yarberry, SAND92-2137): blocks of elements with a type
each, coordinates, and variables by step on nodes and on the elements of some of the blocks.
"""

from __future__ import annotations

import importlib
import re
from pathlib import Path
from typing import Any

import numpy as np

from .content import Ask, Content, Part, Trouble, is_solid, pick_step, require_blocks

_SHAPES = {
    "TET": "tetra", "HEX": "hexahedron", "WED": "wedge", "PYR": "pyramid", "SHE": "quad",
    "QUA": "quad", "TRI": "triangle", "TRU": "line", "BEA": "line", "BAR": "line", "EDG": "line",
    "LIN": "line", "SPH": "vertex", "CIR": "vertex", "POI": "vertex", "NOD": "vertex",
    "STR": "quad",
}  # fmt: skip


def read(path: Path, ask: Ask, said: Any = None, suffix: str = "") -> Content:
    with open(path, "rb") as f:
        classic = f.read(3) == b"CDF"
    try:
        netCDF4: Any = importlib.import_module("netCDF4")
        data = netCDF4.Dataset(str(path))
        data.set_auto_mask(False)
    except ImportError:
        if not classic:
            raise
        from scipy.io import netcdf_file

        data = netcdf_file(str(path), mmap=False)
    try:
        return require_blocks(_content(data, ask), ask.block)
    finally:
        data.close()


def _array(data: Any, name: str) -> np.ndarray:
    return np.array(data.variables[name][:])


def _names(data: Any, name: str, n: int) -> list[str]:
    if name not in data.variables:
        return [""] * n
    rows = _array(data, name).astype("S1")
    return [b"".join(r).partition(b"\0")[0].decode("utf-8", "replace").strip() for r in rows]


def _content(data: Any, ask: Ask) -> Content:
    v = data.variables
    if "coord" in v:
        points = _array(data, "coord").T
    elif "coordx" in v:
        points = np.stack([_array(data, f"coord{a}") for a in "xyz" if f"coord{a}" in v], 1)
    else:
        raise Trouble("damaged", "it has no coordinates")
    if points.shape[1] != 3:
        raise Trouble("unsupported", f"it has {points.shape[1]} dimensions, not 3")
    numbers = sorted(int(m[1]) for name in v if (m := re.fullmatch(r"connect(\d+)", name)))
    ids = _array(data, "eb_prop1").tolist() if "eb_prop1" in v else numbers
    names = _names(data, "eb_names", len(ids))
    times = tuple(_array(data, "time_whole").astype(float).tolist()) if "time_whole" in v else ()
    content = Content(points=points, parts=[], reader="jaxvr (Exodus)")
    step = pick_step(times, ask.step) if times else None
    labels = []
    for k in numbers:
        nodes = _array(data, f"connect{k}").astype(np.int64) - 1
        kind = v[f"connect{k}"].elem_type
        kind = kind.decode() if isinstance(kind, bytes) else str(kind)
        shape = _SHAPES.get(kind[:3].upper())
        if shape is None:
            raise Trouble("unsupported", f"elements of type {kind!r} are not supported")
        label = (names[k - 1] if k <= len(names) else "") or str(ids[k - 1])
        labels.append(label)
        word = {"tetra": 4, "hexahedron": 8, "wedge": 6, "pyramid": 5}.get(shape, 0)
        name = shape if nodes.shape[1] == word or not word else f"{shape}{nodes.shape[1]}"
        solid = is_solid(name)
        content.parts.append(Part(name, nodes if solid else len(nodes), label))
    content.blocks = tuple(labels)
    content.steps, content.step = times if len(times) > 1 else (), step
    if step is None:
        return content
    for i, name in enumerate(_names(data, "name_nod_var", 0)):
        key = f"vals_nod_var{i + 1}"
        content.point[name] = np.array(v[key][step] if key in v else v["vals_nod_var"][step, i])
    for i, name in enumerate(_names(data, "name_elem_var", 0)):
        arrays: list[np.ndarray | None] = []
        for k, part in zip(numbers, content.parts, strict=True):
            key = f"vals_elem_var{i + 1}eb{k}"
            arrays.append(np.array(v[key][step]) if key in v and part.solid else None)
        content.cell[name] = arrays
    _vectors(content)
    return content


def _vectors(content: Content) -> None:
    """Scalars u_x, u_y, u_z (or ux, uy, uz) as one vector u, as VTK's reader has them."""
    for group in (content.point, content.cell):
        for name in [n for n in group if n.lower().endswith("x")]:
            stem = name[:-1]
            rest = [stem + a for a in ("yz" if name[-1] == "x" else "YZ")]
            if (
                stem.rstrip("_ ")
                and stem.rstrip("_ ") not in group
                and all(r in group for r in rest)
            ):
                parts: list[Any] = [group.pop(n) for n in (name, *rest)]
                if group is content.point:
                    content.point[stem.rstrip("_ ")] = np.stack(parts, -1)
                else:
                    content.cell[stem.rstrip("_ ")] = [
                        None if any(a is None for a in column) else np.stack(column, -1)
                        for column in zip(*parts, strict=True)
                    ]
