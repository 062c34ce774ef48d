"""Counts that a file claims against its size, before anybody makes arrays of them; and against what
came out afterwards.

A file of some bytes cannot hold a billion points: who believes its header asks for the memory first
and finds out later. What cannot be told from a header is bounded by the memory that the process may
take (`memory`).
"""

from __future__ import annotations

import math
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
_STRUCTURED = (".vti", ".vtr", ".vts")
_LISTS = (".pvtu", ".vtm", ".vtmb", ".vtpd", ".vtpc")
# Boxes that pieces cut the whole into, of which each is looked at.
_MOST_BOXES = 10**7


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
    """Points and cells that a file says it has, where that is cheap to tell: for all of VTK's XML
    kinds and its legacy files, and for UGRID. Not for those whose counts are in HDF5 (VTKHDF, CGNS)
    or spread over files that begin in several ways (EnSight). Raises Trouble where they cannot be
    in a file of its size, and where pieces are missing."""
    size = path.stat().st_size
    if suffix == ".vtu":
        return _vtu(path, size)
    if suffix == ".vtk":
        return _legacy(path, size)
    if suffix in _LISTS:
        return _listed(path, suffix)
    if suffix in _STRUCTURED or suffix in (".pvti", ".pvtr", ".pvts"):
        return _structured(path, suffix)
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
    """The sum over the files that a file lists; nothing where some of them do not tell."""
    tag, key = ("Piece", "Source") if suffix == ".pvtu" else ("DataSet", "file")
    try:
        entries = ElementTree.fromstring(path.read_bytes()).iter(tag)
        files = [path.parent / e.attrib[key] for e in entries if e.get(key)]
    except ElementTree.ParseError:
        return {}  # its reader says what is wrong
    if any(file.suffix not in (".vtu", *_STRUCTURED) for file in files):
        return {}
    found: Counts = {"points": 0, "cells": 0}
    for file in files:
        _require_there(file)
        for what, n in claims(file, file.suffix).items():
            found[what] += n
    return found


def _require_there(file: Path) -> None:
    if not file.is_file():
        raise Trouble("damaged", f"it names {file.name!r}, which is not there")


Extent = tuple[int, int, int, int, int, int]


def _extents(path: Path) -> tuple[Extent | None, list[Extent], list[str]]:
    """The whole extent of a structured grid, those of its pieces, and the files that these name."""
    with open(path, "rb") as f:
        text = f.read()

    def numbers(key: bytes, tag: bytes) -> list[Extent]:
        found = re.search(rb"\b" + key + rb"""\s*=\s*["']([-\s\d]*)["']""", tag)
        words = found[1].split() if found else []
        try:
            return [tuple(int(w) for w in words)] if len(words) == 6 else []  # type: ignore[list-item]
        except ValueError:
            return []

    whole = numbers(b"WholeExtent", text)
    pieces: list[Extent] = []
    sources = []
    for tag in re.findall(rb"<Piece\b[^>]*>", text):
        pieces += numbers(b"Extent", tag)
        if source := re.search(rb"""\bSource\s*=\s*["']([^"']*)["']""", tag):
            sources.append(source[1].decode("utf-8", "replace"))
    return (whole[0] if whole else None), pieces, sources


def _structured(path: Path, suffix: str) -> Counts:
    """By the whole extent, which pieces have to cover: VTK leaves what it finds in the memory where
    they do not."""
    whole, pieces, sources = _extents(path)
    if whole is None:
        return {}  # its reader says what is wrong
    if suffix.startswith(".p"):
        pieces = []
        for source in sources:
            _require_there(path.parent / source)
            pieces += _extents(path.parent / source)[1]
    sizes = [high - low + 1 for low, high in zip(whole[::2], whole[1::2], strict=True)]
    if min(sizes) < 1:
        return {"points": 0, "cells": 0}
    cells = math.prod(max(n - 1, 1) for n in sizes)
    covered = _covered(whole, pieces)
    if covered < cells:
        raise Trouble("damaged", f"{path.name} has {cells} cells, of which pieces hold {covered}")
    return {"points": math.prod(sizes), "cells": cells}


def _covered(whole: Extent, pieces: list[Extent]) -> int:
    """How many cells of the whole are in some piece."""
    flat = [low == high for low, high in zip(whole[::2], whole[1::2], strict=True)]

    def sides(extent: Extent) -> list[tuple[int, int]]:
        """From the first cell of the whole to behind the last one, along each axis."""
        pairs = zip(extent[::2], extent[1::2], whole[::2], whole[1::2], flat, strict=True)
        return [
            (max(low, first), min(high, last) + (1 if one and low <= high else 0))
            for low, high, first, last, one in pairs
        ]

    boxes = [box for box in map(sides, pieces) if all(low < high for low, high in box)]
    volumes = [math.prod(high - low for low, high in box) for box in boxes]
    planes = [sorted({x for box in boxes for x in box[axis]}) for axis in range(3)]
    if math.prod(map(len, planes)) > _MOST_BOXES:
        return sum(volumes)  # at least so many as there are
    import numpy as np

    hit = np.zeros([max(len(p) - 1, 0) for p in planes], bool)
    for box in boxes:
        hit[tuple(slice(p.index(low), p.index(high)) for p, (low, high) in zip(planes, box))] = True
    each = [np.diff(np.array(p, object)) for p in planes]
    return sum(
        int(each[0][i]) * int(each[1][j]) * int(each[2][k]) for i, j, k in np.argwhere(hit).tolist()
    )


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
    dims = re.search(rb"^DIMENSIONS\s+(\d+)\s+(\d+)\s+(\d+)\s", text[:2000], re.M | re.I)
    if dims and all(n := [int(x) for x in dims.groups()]):
        found = {"points": math.prod(n), "cells": math.prod(max(x - 1, 1) for x in n)}
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
