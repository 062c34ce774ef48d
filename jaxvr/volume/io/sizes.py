"""Counts that a file claims against its size, before anybody makes arrays of them; and against what
came out afterwards.

A file of some bytes cannot hold a billion points: who believes its header asks for the memory first
and finds out later. What cannot be told from a header is bounded by the memory that the process may
take (`memory`).
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from xml.etree import ElementTree

from .content import Content, Trouble

LEAST = 2 << 30  # bytes that any file may take
TIMES = 200  # what a byte of a file may take, if that is more
SECONDS = 15.0  # of computing, for any file
SPEED = 1e5  # bytes a second, above that
# What a byte can come to by each of VTK's compressors, at most: by their formats.
_RATIO = {
    "vtkZLibDataCompressor": 1032,
    "vtkLZ4DataCompressor": 255,
    "vtkLZMADataCompressor": 10**5,
}
_PARTS = {".pvd", ".series", ".pvtu", ".pvti", ".pvtr", ".pvts", ".vtm", ".vtmb", ".vtpd", ".vtpc",
          ".case", ".encas", ".xdmf", ".xmf", ".foam"}  # fmt: skip
Counts = dict[str, int]
COUNTED = (".vtu", ".vtk", ".pvtu", ".vtm")  # whose headers tell what has to come out


def volume_of(path: Path, suffix: str) -> int:
    """Bytes of a file, and of those beside it where it refers to them."""
    if suffix not in _PARTS:
        return path.stat().st_size
    total, seen = 0, 0
    for folder, _, names in os.walk(path.parent):
        for name in names:
            seen += 1
            try:
                total += os.stat(os.path.join(folder, name)).st_size
            except OSError:
                continue
        if seen > 100_000:
            break
    return total


def memory(size: int) -> int:
    """Bytes that reading a file of this size may take."""
    return max(LEAST, TIMES * size)


def seconds(size: int) -> float:
    return SECONDS + size / SPEED


def claims(path: Path, suffix: str) -> Counts:
    """Points and cells that a file says it has, where that is cheap to tell. Raises Trouble where
    they cannot be in a file of its size."""
    size = path.stat().st_size
    if suffix == ".vtu":
        return _vtu(path, size)
    if suffix == ".vtk":
        return _legacy(path, size)
    if suffix in (".pvtu", ".vtm"):
        return _listed(path, suffix)
    if suffix == ".ugrid":
        return _ugrid(path, size)
    return {}


def require(content: Content, counts: Counts, path: Path) -> None:
    """Trouble where fewer or more points or cells came out than the file says."""
    if content.raw is None:
        return
    for what, got in zip(("points", "cells"), content.raw, strict=True):
        if what in counts and counts[what] != got:
            raise Trouble(
                "unsupported",
                f"it has {counts[what]} {what}, of which {content.reader} reads {got}",
            )


def _bound(n: int, what: str, least: float, size: int) -> None:
    if n * least > size:
        raise Trouble("damaged", f"it says that it has {n} {what}, in a file of {size} bytes")


def _vtu(path: Path, size: int) -> Counts:
    with open(path, "rb") as f:
        text = f.read()
    head = re.search(rb"<VTKFile\b[^>]*>", text)
    compressor = re.search(rb'compressor\s*=\s*["\'](\w+)', head[0]) if head else None
    ratio = _RATIO.get(compressor[1].decode(), 10**5) if compressor else 1
    found: Counts = {"points": 0, "cells": 0}
    for tag in re.findall(rb"<Piece\b[^>]*>", text):
        for what, key in (("points", b"NumberOfPoints"), ("cells", b"NumberOfCells")):
            m = re.search(rb"\b" + key + rb'\s*=\s*["\']\s*(\d+)\s*["\']', tag)
            found[what] += int(m[1]) if m else 0
    _bound(found["points"], "points", 6 / ratio, size)
    _bound(found["cells"], "cells", 4 / ratio, size)
    return found


def _listed(path: Path, suffix: str) -> Counts:
    """The sum over the .vtu files that a file lists; nothing where there are others among them."""
    tag, key = ("Piece", "Source") if suffix == ".pvtu" else ("DataSet", "file")
    try:
        entries = ElementTree.fromstring(path.read_bytes()).iter(tag)
        files = [path.parent / e.attrib[key] for e in entries if e.get(key)]
    except ElementTree.ParseError:
        return {}  # its reader says what is wrong
    if any(file.suffix != ".vtu" for file in files):
        return {}
    found: Counts = {"points": 0, "cells": 0}
    for file in files:
        if not file.is_file():
            raise Trouble("damaged", f"it names {file.name!r}, which is not there")
        for what, n in _vtu(file, file.stat().st_size).items():
            found[what] += n
    return found


def _legacy(path: Path, size: int) -> Counts:
    with open(path, "rb") as f:
        text = f.read()
    found: Counts = {}
    unstructured = re.search(rb"^DATASET\s+UNSTRUCTURED_GRID", text[:2000], re.M | re.I)
    m = re.search(rb"^POINTS\s+(\d+)\s+\w+", text, re.M | re.I)
    if m:
        _bound(int(m[1]), "points", 6, size)
        if unstructured:
            found["points"] = int(m[1])
    m = re.search(rb"^CELLS\s+(\d+)\s+(\d+)", text, re.M | re.I)
    if m and unstructured:
        version = re.match(rb"# vtk DataFile Version (\d+)", text)
        new = version is not None and int(version[1]) >= 5
        _bound(int(m[2]), "numbers of cells", 2, size)
        _bound(int(m[1]), "cells", 2, size)
        found["cells"] = int(m[1]) - (1 if new else 0)  # version 5 counts offsets
    m = re.search(rb"^(?:POINT|CELL)_DATA\s+(\d+)", text, re.M | re.I)
    if m and not re.search(rb"^FIELD\s", text[m.end() :], re.M | re.I):
        _bound(int(m[1]), "values", 1, size)
    return found


def _ugrid(path: Path, size: int) -> Counts:
    import numpy as np

    kind = path.suffixes[-2].lower() if len(path.suffixes) > 1 else ""
    with open(path, "rb") as f:
        head = f.read(4096)
    try:
        if m := re.fullmatch(r"\.(l?)(b|r)(?:4|8)(l?)", kind):
            width = 8 if m[3] else 4
            at = width if m[2] == "r" else 0
            numbers = np.frombuffer(head, f"{'<' if m[1] else '>'}i{width}", 7, at).tolist()
            least = 4
        else:
            words = re.sub(rb"np\.\w+\(([^()]*)\)", rb"\1", head).split()  # by NumPy 2
            numbers, least = [int(w) for w in words[:7]], 2
    except ValueError:
        raise Trouble("damaged", "its seven counts cannot be read") from None
    for n, what in zip(numbers, ("points", "triangles", "quads", "tetra", "pyramids", "wedges", "hexahedra")):  # noqa: E501  # fmt: skip
        _bound(n, what, 3 * least if what == "points" else least, size)
    return {"points": numbers[0], "cells": sum(numbers[1:])} if len(numbers) == 7 else {}
