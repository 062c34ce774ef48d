"""What readers give: cells, fields and steps of a file as arrays; and what may be wrong with it."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from .. import cells as zoo

# Bits of vtkGhostType: duplicate, refined and hidden cells; hidden points.
NOT_DRAWN = {"cell": 1 | 8 | 32, "point": 2}


class Trouble(Exception):
    """Why a file is not read. kind: "damaged"; "malformed", which no
    other reader would read right; "unsupported", a kind that nobody here reads;
    "package", one that a missing package reads; "suffix", an unknown one; "large"; "asked", where
    the file is right and what was asked for is not in it; "system", an error of the disk."""

    def __init__(self, kind: str, message: str):
        super().__init__(kind, message)
        self.kind, self.message = kind, message

    def __str__(self) -> str:
        return self.message


class Field(NamedTuple):
    """A field in a file.

    name; location: "point", "cell" or "corner"; components: numbers per place; blocks: the names of
    the blocks that have it, where the file has several; steps: the times of its steps, where it has
    several.
    """

    name: str
    location: str
    components: int
    blocks: tuple[str, ...] = ()
    steps: tuple[float, ...] = ()


@dataclasses.dataclass(frozen=True)
class Ask:
    """step: which time step (an index, or a time as a float); block: names or places of blocks;
    limit: bytes of memory, or None; vtk: whether VTK's readers may be taken; alone: whether the
    process does nothing but read files, so that it may be ended and what VTK prints is known."""

    step: int | float | None = None
    block: Any = None
    limit: int | None = None
    vtk: bool = True
    alone: bool = True


@dataclasses.dataclass
class Part:
    """Cells of one type in one block: nodes (N, n) in VTK's order, or their number alone where
    they are no solids."""

    type: str
    nodes: np.ndarray | int
    block: str = ""
    also: tuple[str, ...] = ()  # other blocks that they are in

    def __len__(self) -> int:
        return self.nodes if isinstance(self.nodes, int) else len(self.nodes)

    @property
    def blocks(self) -> tuple[str, ...]:
        """All blocks that they are in."""
        return (self.block, *self.also)

    @property
    def solid(self) -> bool:
        return not isinstance(self.nodes, int)


@dataclasses.dataclass
class Content:
    """points (P, 3). cell, corner: from a name to one array for each of `parts`, (N, ...) or
    (N, corners, ...), None where a part lacks it. point_blocks: the blocks that have a point field,
    where not all do. active: the scalars that the file names. blocks: the names of all blocks.
    steps: times of all steps where there are several, `step` the index of the one that was read;
    field_steps: (name,
    location) to times, where fields have steps of their own. notes: what the caller is warned of.
    reordered: why the rows of parts are not those of the file, "" where they are.
    raw: points and cells that the reader found, before any are left out or cut.
    """

    points: np.ndarray
    parts: list[Part]
    point: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    cell: dict[str, list[np.ndarray | None]] = dataclasses.field(default_factory=dict)
    corner: dict[str, list[np.ndarray | None]] = dataclasses.field(default_factory=dict)
    point_blocks: dict[str, tuple[str, ...]] = dataclasses.field(default_factory=dict)
    active: list[tuple[str, str]] = dataclasses.field(default_factory=list)
    blocks: tuple[str, ...] = ()
    steps: tuple[float, ...] = ()
    step: int | None = None
    field_steps: dict[tuple[str, str], tuple[float, ...]] = dataclasses.field(default_factory=dict)
    notes: list[str] = dataclasses.field(default_factory=list)
    reader: str = ""
    reordered: str = ""
    raw: tuple[int, int] | None = None

    @property
    def n_cells(self) -> int:
        return sum(map(len, self.parts))


def is_solid(cell_type: str) -> bool:
    """Whether cells of this type have a volume; Trouble for one that nobody knows."""
    try:
        return zoo.canonical(cell_type)[0] is not None
    except ValueError as e:
        raise Trouble("unsupported", str(e)) from None


def components(data: Any) -> int:
    """Numbers per place; 0 for what is no field of numbers."""
    a = np.asarray(data)
    return int(np.prod(a.shape[1:])) if a.ndim and a.dtype.kind in "fiub" else 0


def pick_step(steps: tuple[float, ...], asked: int | float | None, default: int = -1) -> int:
    """The index of the step asked for: by index, from the end where negative, or by a float that is
    a time. None: the last one."""
    if asked is None:
        return range(len(steps))[default]
    listed = ", ".join(f"{t:g}" for t in steps[:20]) + (", ..." if len(steps) > 20 else "")
    if isinstance(asked, int):
        if not -len(steps) <= asked < len(steps):
            raise Trouble(
                "asked", f"There is no step {asked}: it has {len(steps)}, at times {listed}."
            )
        return asked % len(steps)
    near = [k for k, t in enumerate(steps) if np.isclose(t, asked, rtol=1e-9, atol=0)]
    if not near:
        raise Trouble(
            "asked",
            f"There is no step at time {asked:g}: its {len(steps)} are at {listed}. An integer "
            "counts steps from 0, a float is a time.",
        )
    return near[0]


def pick_blocks(names: tuple[str, ...], asked: Any) -> list[int]:
    """Places of the blocks asked for, by name or place; all where None."""
    if asked is None:
        return list(range(len(names)))
    wanted = [asked] if isinstance(asked, str | int) else list(asked)
    found = []
    for want in wanted:
        if isinstance(want, str) and want in names:
            found += [k for k, name in enumerate(names) if name == want]
        elif isinstance(want, int) and 0 <= want < len(names):
            found.append(want)
        else:
            has = ", ".join(map(repr, names)) if names else "no blocks"
            raise Trouble("asked", f"There is no block {want!r}. It has {has}.")
    return sorted(set(found))


def require_blocks(content: Content, asked: Any) -> Content:
    """The content with the blocks asked for only."""
    if asked is None:
        return content
    kept = {content.blocks[k] for k in pick_blocks(content.blocks, asked)}
    places = [i for i, part in enumerate(content.parts) if kept & set(part.blocks)]

    def chosen(data: dict[str, list[Any]]) -> dict[str, list[Any]]:
        return {name: [a[i] for i in places] for name, a in data.items()}

    return dataclasses.replace(
        content,
        parts=[content.parts[i] for i in places],
        cell=chosen(content.cell),
        corner=chosen(content.corner),
        point={
            name: a
            for name, a in content.point.items()
            if kept & set(content.point_blocks.get(name, tuple(kept)))
        },
    )


def join(contents: list[Content], names: list[str]) -> Content:
    """Blocks that come as contents of their own, as one. A point field that some blocks lack is NaN
    there, and named in `point_blocks`. Blocks of a content's own come as "name/block"."""
    inner = [
        {b: f"{name}/{b}" if len(c.blocks) > 1 else name for p in c.parts for b in p.blocks}
        or {"": name}
        for c, name in zip(contents, names, strict=True)
    ]
    if len(contents) == 1 and len(contents[0].blocks) < 2:
        out = contents[0]
        for part in out.parts:
            part.block = names[0]
        return dataclasses.replace(out, blocks=tuple(names))
    points, parts, start = [], [], 0
    point: dict[str, list[np.ndarray]] = {}
    where: dict[str, list[str]] = {}
    shapes: dict[str, tuple[Any, ...]] = {}
    for content, known in zip(contents, inner, strict=True):
        for key, a in content.point.items():
            shapes.setdefault(key, a.shape[1:])
            if a.shape[1:] == shapes[key] and len(content.points):
                has = content.point_blocks.get(key, tuple(known))
                where.setdefault(key, []).extend(n for b, n in known.items() if b in has)
    filled = [n for c, known in zip(contents, inner, strict=True) if len(c.points) for n in known]
    for content, known in zip(contents, inner, strict=True):
        n = len(content.points)
        for part in content.parts:
            nodes = part.nodes if isinstance(part.nodes, int) else part.nodes + start
            also = tuple(known[b] for b in part.also)
            parts.append(Part(part.type, nodes, known[part.block], also))
        for key, shape in shapes.items():
            a = content.point.get(key)
            if a is None or a.shape[1:] != shape:
                a = np.full((n, *shape), np.nan)
            point.setdefault(key, []).append(a)
        points.append(content.points)
        start += n

    notes = list(dict.fromkeys(n for c in contents for n in c.notes))

    def rows(what: str) -> dict[str, list[np.ndarray | None]]:
        found: dict[str, list[np.ndarray | None]] = {}
        for key in dict.fromkeys(k for c in contents for k in getattr(c, what)):
            column = found.setdefault(key, [])
            for c in contents:
                column += getattr(c, what).get(key, [None] * len(c.parts))
            lead = 1 if what == "cell" else 2
            shapes = [None if a is None else a.shape[lead:] for a in column]
            first = next((s for s in shapes if s is not None), None)
            if any(s not in (None, first) for s in shapes):
                notes.append(
                    f"Field {key!r} has other numbers of components in some blocks than in the "
                    "first, and counts as absent there: pass block= to read them."
                )
                found[key] = [
                    a if s == first else None for a, s in zip(column, shapes, strict=True)
                ]
        return found

    return Content(
        points=np.concatenate(points),
        parts=parts,
        point={key: np.concatenate(a) for key, a in point.items()},
        cell=rows("cell"),
        corner=rows("corner"),
        point_blocks={k: tuple(w) for k, w in where.items() if len(w) < len(filled)},
        active=contents[0].active,
        blocks=tuple(dict.fromkeys(n for known in inner for n in known.values())),
        notes=notes,
        reader=contents[0].reader,
        reordered=next((c.reordered for c in contents if c.reordered), ""),
    )
