"""gmsh's .msh files of versions 2.2, 4.0 and 4.1, text and binary, after its reference manual.

Ids are names: they are looked up in a sorted list, so that a large one costs nothing. Counts are
compared with what is left of the file before arrays of that size are made. Nodes, elements,
$NodeData, $ElementData (also on some of the elements), $ElementNodeData (per corner) with all of
their steps, and physical groups, which are the blocks of a file, are read.
"""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import numpy as np

from .content import Ask, Content, Part, Trouble, is_solid, pick_step, require_blocks
from .gmsh_stream import TYPES, Stream


@dataclasses.dataclass
class _Data:
    """One section of data: rows by id."""

    name: str
    time: float
    ids: np.ndarray
    values: Any  # (n, components), or a list of (corners, components)


@dataclasses.dataclass
class _File:
    version: str
    binary: bool
    order: str
    size: int
    node_ids: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, np.int64))
    points: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    # (type, physical tag or 0, ids (N,), nodes (N, n) as ids)
    elements: list[tuple[int, int, np.ndarray, np.ndarray]] = dataclasses.field(
        default_factory=list
    )
    names: dict[tuple[int, int], str] = dataclasses.field(default_factory=dict)
    physical: dict[tuple[int, int], list[int]] = dataclasses.field(default_factory=dict)
    # physical groups beside the first, by place in `elements`
    others: dict[int, list[int]] = dataclasses.field(default_factory=dict)
    regrouped: bool = False  # elements stand in another order than in the file
    data: dict[str, list[_Data]] = dataclasses.field(
        default_factory=lambda: {"NodeData": [], "ElementData": [], "ElementNodeData": []}
    )


def read(path: Path, ask: Ask, said: Any = None, suffix: str = "") -> Content:
    raw = path.read_bytes()
    file = _header(raw)
    skipped = set()
    known = {
        "Nodes": _nodes, "Elements": _elements, "Entities": _entities,
        "PhysicalNames": _physical_names, **dict.fromkeys(file.data, _data),
    }  # fmt: skip
    order = {"Entities": 0, "PhysicalNames": 1, "Nodes": 2, "Elements": 3}
    sections = sorted(_sections(raw, file), key=lambda s: order.get(s[0], 4))
    for name, body in sections:
        if name in known:
            known[name](file, name, body)
        elif name == "PartitionedEntities":
            skipped.add(name)
    content = _content(file, ask)
    if "PartitionedEntities" in skipped:
        content.notes.append("$PartitionedEntities are not read: cells have no physical groups.")
    content.reader = f"jaxvr (gmsh {file.version})"
    return require_blocks(content, ask.block)


def _header(raw: bytes) -> _File:
    found = re.match(rb"\s*\$MeshFormat\s+([0-9.]+)\s+([01])\s+(\d+)\s*?\n", raw)
    if not found:
        raise Trouble("damaged", "it does not begin with $MeshFormat and a version")
    version = found[1].decode()
    if version not in ("2", "2.0", "2.1", "2.2", "4", "4.0", "4.1"):
        raise Trouble("unsupported", f"gmsh files of version {version} are not read; 2.2 and 4 are")
    binary = found[2] == b"1"
    order = "<"
    if binary:
        one = raw[found.end() : found.end() + 4]
        if one not in (b"\1\0\0\0", b"\0\0\0\1"):
            raise Trouble("damaged", "its byte order cannot be told")
        order = "<" if one[0] else ">"
    size = int(found[3])
    if size not in (4, 8):
        raise Trouble("damaged", f"its data size is {size}")
    return _File(version, binary, order, size)


def _sections(raw: bytes, file: _File) -> list[tuple[str, bytes]]:
    """Names and bodies; raises Trouble for one without an end."""
    found, at = [], 0
    start = re.compile(rb"^[ \t]*\$([A-Za-z]+)[ \t\r]*\n", re.M)
    while m := start.search(raw, at):
        name = m[1]
        end = raw.find(b"$End" + name, m.end())
        if end < 0:
            raise Trouble("damaged", f"${name.decode()} has no end: the file is cut short")
        found.append((name.decode(), raw[m.end() : end]))
        at = end + 4 + len(name)
    if not any(name == "Nodes" for name, _ in found):
        raise Trouble("damaged", "it has no $Nodes")
    return found


def _line(body: bytes) -> tuple[bytes, bytes]:
    head, _, rest = body.partition(b"\n")
    return head, rest


def _stream(file: _File, name: str, body: bytes) -> Stream:
    return Stream(body, name, file.binary, file.order, file.size)


def _integer(text: bytes, name: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise Trouble("damaged", f"${name} begins with {text[:20]!r}, not a count") from None


def _nodes(file: _File, name: str, body: bytes) -> None:
    if file.version.startswith("2"):
        head, rest = _line(body)
        n = _integer(head, name)
        least = 28 if file.binary else 8
        if n < 0 or n * least > len(rest) + 8:
            raise Trouble("damaged", f"$Nodes counts {n} nodes in {len(rest)} bytes")
        if file.binary:
            kind = np.dtype([("id", file.order + "i4"), ("x", file.order + "f8", 3)])
            rows = np.frombuffer(rest, kind, n)
            file.node_ids, file.points = rows["id"].astype(np.int64), rows["x"].copy()
        else:
            numbers = Stream(rest, name, False, "", 8).floats(4 * n).reshape(n, 4)
            file.node_ids, file.points = _whole(numbers[:, 0], name), numbers[:, 1:].copy()
        return
    s = _stream(file, name, body)
    new = file.version == "4.1"
    head = s.sizes(4 if new else 2)
    ids, points = [], []
    for _ in range(_bounded(head[0], s, name)):
        dim, _, parametric = s.ints(3) if new else s.ints(3)[[1, 0, 2]]
        n = int(s.sizes(1)[0])
        extra = int(dim) if parametric else 0
        if new:
            ids.append(s.sizes(n))
            points.append(s.floats(n * (3 + extra)).reshape(n, -1)[:, :3])
        elif file.binary:
            width = np.dtype([("id", file.order + "i4"), ("x", file.order + "f8", 3 + extra)])
            raw = s.take(n * width.itemsize, "u1", 1)
            rows = np.frombuffer(raw.tobytes(), width, n)
            ids.append(rows["id"].astype(np.int64))
            points.append(rows["x"][:, :3])
        else:
            numbers = s.floats(n * (4 + extra)).reshape(n, -1)
            ids.append(_whole(numbers[:, 0], name))
            points.append(numbers[:, 1:4])
    file.node_ids = np.concatenate([np.zeros(0, np.int64), *ids])
    file.points = np.concatenate([np.zeros((0, 3)), *points])
    if len(file.points) != head[1]:
        raise Trouble("damaged", f"$Nodes counts {head[1]} nodes, and {len(file.points)} are there")


def _whole(numbers: np.ndarray, name: str) -> np.ndarray:
    ids = numbers.astype(np.int64) if np.isfinite(numbers).all() else np.zeros(0, np.int64)
    if len(ids) != len(numbers) or (ids != numbers).any():
        raise Trouble("damaged", f"${name} has ids that are no whole numbers")
    return ids


def _bounded(n: Any, s: Stream, name: str) -> int:
    if not 0 <= n <= s.left:
        raise Trouble("damaged", f"${name} counts {n} blocks in {s.left} numbers")
    return int(n)


def _type(number: Any) -> tuple[str, int]:
    if int(number) not in TYPES:
        raise Trouble("unsupported", f"elements of gmsh's type {number} are not supported")
    return TYPES[int(number)]


def _elements(file: _File, name: str, body: bytes) -> None:
    if file.version.startswith("2"):
        _elements_2(file, name, body)
        return
    s = _stream(file, name, body)
    new = file.version == "4.1"
    head = s.sizes(4 if new else 2)
    total = 0
    for _ in range(_bounded(head[0], s, name)):
        dim, tag, kind = s.ints(3) if new else s.ints(3)[[1, 0, 2]]
        n = int(s.sizes(1)[0])
        _, width = _type(kind)
        count = n * (width + 1)
        rows = (s.sizes(count) if new else s.ints(count)).reshape(n, width + 1)
        groups = file.physical.get((int(dim), int(tag)), [])
        tag = groups[0] if groups else 0
        if dim == 3 and len(groups) > 1:
            file.others[len(file.elements)] = groups[1:]
        file.elements.append((int(kind), tag, rows[:, 0], rows[:, 1:]))
        total += n
    if total != head[1]:
        raise Trouble("damaged", f"$Elements counts {head[1]} elements, and {total} are there")


def _elements_2(file: _File, name: str, body: bytes) -> None:
    head, rest = _line(body)
    n = _integer(head, name)
    s = _stream(file, name, rest)
    if n < 0 or n > s.left:
        raise Trouble("damaged", f"$Elements counts {n} elements in {len(rest)} bytes")
    groups: dict[tuple[int, int], list[np.ndarray]] = {}
    sequence: list[tuple[int, int]] = []  # (type, physical group) of each run of elements

    def add(kind: int, rows: np.ndarray, tags: int) -> None:
        physical = rows[:, 1] if tags else np.zeros(len(rows), np.int64)
        for tag in np.unique(physical).tolist():
            these = rows[physical == tag]
            part = np.column_stack([these[:, 0], these[:, 1 + tags :]])
            groups.setdefault((kind, tag), []).append(part)

    left = n
    if file.binary:
        while left:
            kind, m, tags = s.ints(3)
            if m < 1 or m > left or tags < 0:
                raise Trouble("damaged", f"$Elements has a block of {m} where {left} are left")
            rows = s.table(int(m), 1 + int(tags) + _type(kind)[1])
            for tag in rows[:, 1].tolist() if tags else [0]:
                if sequence[-1:] != [(int(kind), tag)]:
                    sequence.append((int(kind), tag))
            add(int(kind), rows, int(tags))
            left -= int(m)
    else:
        lines: dict[tuple[int, int], list[list[int]]] = {}
        for line in rest.splitlines():
            words = line.split()
            if not words:
                continue
            try:
                row = [int(w) for w in words]
                kind, tags = row[1], row[2]
                if tags < 0 or len(row) != 3 + tags + _type(kind)[1]:
                    raise IndexError
            except (ValueError, IndexError):
                raise Trouble("damaged", f"$Elements: {line[:60]!r} is no element") from None
            key = (kind, row[3] if tags else 0)
            if sequence[-1:] != [key]:
                sequence.append(key)
            lines.setdefault((kind, tags), []).append(row[:1] + row[3:])
            left -= 1
        if left:
            raise Trouble("damaged", f"$Elements counts {n} elements, and {n - left} are there")
        for (kind, tags), rows in lines.items():
            try:
                add(kind, np.array(rows, np.int64), tags)
            except OverflowError as e:
                raise Trouble("damaged", f"$Elements: {e}") from None
    solid = {k: is_solid(_type(k)[0]) for k, _ in sequence}
    found = [key for key in sequence if solid[key[0]]]
    if found != [key for key in groups if solid[key[0]]]:
        file.regrouped = True
    for (kind, tag), parts in groups.items():
        rows = np.concatenate(parts)
        file.elements.append((kind, tag, rows[:, 0], rows[:, 1:]))


def _physical_names(file: _File, name: str, body: bytes) -> None:
    for dim, tag, word in re.findall(rb'^\s*(\d+)\s+(\d+)\s+"([^"\n]*)"', body, re.M):
        file.names[int(dim), int(tag)] = word.decode("utf-8", "replace")


def _entities(file: _File, name: str, body: bytes) -> None:
    s = _stream(file, name, body)
    counts = s.sizes(4)
    new = file.version == "4.1"
    for dim, count in enumerate(counts.tolist()):
        for _ in range(_bounded(count, s, name)):
            tag = int(s.ints(1)[0])
            s.floats(3 if dim == 0 and new else 6)
            n = int(s.sizes(1)[0])
            file.physical[dim, tag] = [abs(t) for t in s.ints(n).tolist()]
            if dim:
                s.ints(int(s.sizes(1)[0]))


def _data(file: _File, name: str, body: bytes) -> None:
    """String tags, real tags (time) and integer tags (step, components, entries) as text, then
    rows."""

    def counted() -> list[bytes]:
        nonlocal body
        head, body = _line(body)
        out = []
        for _ in range(_integer(head, name)):
            if not body:
                raise Trouble("damaged", f"${name} ends in its tags")
            head, body = _line(body)
            out.append(head.strip())
        return out

    strings = counted()
    try:
        reals = [float(w) for w in counted()]
        integers = [int(w) for w in counted()]
    except ValueError as e:
        raise Trouble("damaged", f"${name}: {e}") from None
    if len(integers) < 3 or integers[1] < 1 or integers[2] < 0:
        raise Trouble("damaged", f"${name} has the integer tags {integers}")
    label = strings[0].strip(b'"').decode("utf-8", "replace") if strings else name
    step, width, n = integers[:3]
    if not file.binary and b"np." in body:  # as meshio writes with NumPy 2
        body = re.sub(rb"np\.\w+\(([^()]*)\)", rb"\1", body)
    s = _stream(file, name, body)
    time = reals[0] if reals else float(step)
    if name != "ElementNodeData":
        if file.binary:
            kind = np.dtype([("id", file.order + "i4"), ("v", file.order + "f8", width)])
            raw = s.take(n * kind.itemsize, "u1", 1)
            rows = np.frombuffer(raw.tobytes(), kind, n)
            ids, values = rows["id"].astype(np.int64), rows["v"].reshape(n, width)
        else:
            numbers = s.floats(n * (1 + width)).reshape(n, 1 + width)
            ids, values = _whole(numbers[:, 0], name), numbers[:, 1:]
    else:
        found, rows = [], []
        for _ in range(_bounded(n, s, name)):
            entry, corners = s.ints(2).tolist()
            found.append(entry)
            rows.append(s.floats(max(corners, 0) * width).reshape(-1, width))
        ids, values = np.array(found, np.int64), rows
    file.data[name].append(_Data(label, time, ids, values))


def _content(file: _File, ask: Ask) -> Content:
    order = np.argsort(file.node_ids, kind="stable")
    ids = file.node_ids[order]
    if (ids[1:] == ids[:-1]).any():
        raise Trouble("damaged", f"node {ids[1:][ids[1:] == ids[:-1]][0]} stands there twice")

    def place(given: np.ndarray, what: str) -> np.ndarray:
        at = np.searchsorted(ids, given)
        at[at == len(ids)] = 0
        if len(given) and (len(ids) == 0 or (ids[at] != given).any()):
            bad = given[ids[at] != given] if len(ids) else given
            raise Trouble("damaged", f"{what} uses node {bad.ravel()[0]}, which is not there")
        return order[at]

    content = Content(points=file.points, parts=[])
    if file.regrouped:
        content.reordered = "elements of physical groups or types take turns in it"
    element_ids, solid_blocks = [], {}
    for k, (number, tag, own, nodes) in enumerate(file.elements):
        kind, _ = TYPES[number]
        element_ids.append(own)
        if is_solid(kind):
            block = file.names.get((3, tag), str(tag)) if tag else "no group"
            solid_blocks[block] = None
            also = tuple(file.names.get((3, t), str(t)) for t in file.others.get(k, ()))
            solid_blocks.update(dict.fromkeys(also))
            content.parts.append(Part(kind, place(nodes, f"a {kind}"), block, also))
        else:
            content.parts.append(Part(kind, len(nodes)))
    content.blocks = tuple(solid_blocks)
    for name, sections in file.data.items():
        _fields(content, file, name, sections, ask, element_ids, place)
    return content


def _fields(
    content: Content, file: _File, name: str, sections: list[_Data], ask: Ask,
    element_ids: list[np.ndarray], place: Any,
) -> None:  # fmt: skip
    where = {"NodeData": "point", "ElementData": "cell", "ElementNodeData": "corner"}[name]
    for label in dict.fromkeys(d.name for d in sections):
        steps = sorted((d for d in sections if d.name == label), key=lambda d: d.time)
        times = tuple(d.time for d in steps)
        try:
            step = pick_step(times, ask.step) if len(steps) > 1 else 0
        except Trouble as e:
            raise Trouble("asked", f"Field {label!r}: {e}") from None
        data = steps[step]
        content.field_steps[label, where] = times
        if where == "point":
            values = np.full((len(file.points), data.values.shape[1]), np.nan)
            values[place(data.ids, f"${name}")] = data.values
            content.point[label] = values[:, 0] if values.shape[1] == 1 else values
            continue
        sort = np.argsort(data.ids, kind="stable")
        known = data.ids[sort]
        arrays: list[np.ndarray | None] = []
        used = 0
        for part, own in zip(content.parts, element_ids, strict=True):
            at = np.minimum(np.searchsorted(known, own), max(len(known) - 1, 0))
            hit = known[at] == own if len(known) else np.zeros(len(own), bool)
            used += int(hit.sum())
            if not hit.any() or not len(own):
                arrays.append(None)
                continue
            rows = sort[at]
            if where == "cell":
                values = np.where(hit[:, None], data.values[rows], np.nan)
            else:
                values = _corner_rows(data, rows, hit, part, label)
            arrays.append(values[..., 0] if values.shape[-1] == 1 else values)
        if used < len(data.ids):
            content.notes.append(
                f"Field {label!r} has values for {len(data.ids) - used} elements that do not exist."
            )
        getattr(content, where)[label] = arrays


def _corner_rows(
    data: _Data, rows: np.ndarray, hit: np.ndarray, part: Part, label: str
) -> np.ndarray:
    sizes = {len(data.values[r]) for r in rows[hit]}
    if len(sizes) > 1:
        raise Trouble(
            "damaged", f"field {label!r} has {sorted(sizes)} corners in {part.type} cells"
        )
    width = sizes.pop()
    nan = np.full((width, data.values[0].shape[1]), np.nan)
    return np.array([data.values[r] if h else nan for r, h in zip(rows, hit, strict=True)])
