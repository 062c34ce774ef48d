"""Which field of a file is meant, and its numbers."""

from __future__ import annotations

import difflib
from typing import Any

import numpy as np

from .content import Content, Field, Part, Trouble, components

AXES = {"x": 0, "y": 1, "z": 2}


def list_of(content: Content) -> list[Field]:
    """The fields of numbers, point data first."""
    found = []
    several = len(content.blocks) > 1
    solid = [i for i, part in enumerate(content.parts) if part.solid]
    with_cells = {name for i in solid for name in content.parts[i].blocks}

    def add(name: str, where: str, data: Any, blocks: tuple[str, ...]) -> None:
        n = components(data)
        if where == "corner":
            n //= np.shape(data)[1]
        steps = content.field_steps.get((name, where), content.steps)
        if n:
            times = steps if len(steps) > 1 else ()
            found.append(Field(name, where, n, blocks if several else (), times))

    for name, data in content.point.items():
        blocks = content.point_blocks.get(name, content.blocks)
        add(name, "point", data, tuple(b for b in blocks if b in with_cells))
    for where, group in (("cell", content.cell), ("corner", content.corner)):
        for name, arrays in group.items():
            has = [i for i in solid if arrays[i] is not None]
            blocks = dict.fromkeys(name for i in has for name in content.parts[i].blocks)
            if has:
                add(name, where, arrays[has[0]], tuple(blocks))
    return found


def listing(fields: list[Field]) -> str:
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


def choose(
    file: str,
    fields: list[Field],
    name: str | None,
    location: str | None,
    active: list[tuple[str, str]] | None = None,
) -> tuple[Field, int | str | None]:
    """The field and which component of it: an index, "magnitude", or `None` for a scalar.

    active: (name, location) of what is taken first where no name is given.
    """
    wanted = [f for f in fields if location in (None, f.location)]
    where = "" if location is None else f" {location}"
    if name is None:
        scalars = [f for f in wanted if f.components == 1]
        if not scalars:
            asked = (
                'For a vector, pass field="name.x" or field="name.magnitude".'
                if wanted
                else "If its values come from elsewhere, pass values=: an array, one number a "
                "point or a cell, or a function of the points (P, 3)."
            )
            raise Trouble(
                "asked", f"{file} has no scalar{where} field to take. {listing(fields)}. {asked}"
            )
        first = [f for a in active or () for f in scalars if (f.name, f.location) == a]
        return (first or scalars)[0], None
    if not isinstance(name, str):
        raise Trouble("asked", f"field must be a name, but is {type(name).__name__}.")
    exact = next((f for f in wanted if f.name == name), None)
    if exact is not None:
        if exact.components != 1:
            raise Trouble(
                "asked",
                f"Field {name!r} of {file} has {exact.components} components. Pass "
                f'field="{name}.x" (or .y, .z, .0 to .{exact.components - 1}) or '
                f'field="{name}.magnitude".',
            )
        return exact, None
    base, _, part = name.rpartition(".")
    vector = next((f for f in wanted if f.name == base), None)
    if vector is None:
        near = _near(name, wanted)
        raise Trouble("asked", f"{file} has no{where} field {name!r}. {near}{listing(fields)}.")
    index = AXES.get(part, int(part) if part.isdecimal() else -1)
    if part != "magnitude" and not 0 <= index < vector.components:
        raise Trouble(
            "asked",
            f"Field {base!r} of {file} has {vector.components} component(s), but {part!r} was "
            'asked for. Pass "x", "y", "z", a number from 0, or "magnitude" after the dot.',
        )
    return vector, part if part == "magnitude" else index


def label(field: Field, part: int | str | None) -> str:
    """The name by which the chosen scalar can be asked for again."""
    if part is None:
        return field.name
    return f"{field.name}.{part if isinstance(part, str) else 'xyz'[part] if part < 3 else part}"


def scalar(data: Any, part: int | str | None, lead: int = 1) -> np.ndarray:
    """One number for each of the first `lead` axes."""
    a = np.asarray(data)
    if a.dtype == bool:
        a = a.astype(np.uint8)
    flat = a.reshape(*a.shape[:lead], -1)
    if isinstance(part, str):
        return np.linalg.norm(flat.astype(np.float64), axis=-1)
    return flat[..., part or 0]


def arrays_of(
    content: Content, file: str, name: str | None, location: str | None, want: bool = True
) -> dict[str, Any]:
    """What `TetMesh.from_cells` takes of a content: points, cells (an array by type, a number where
    they are ignored), values, location, label. want: False for the mesh without a field."""
    cells: dict[str, Any] = {}
    solid: dict[str, list[int]] = {}
    for i, part in enumerate(content.parts):
        if isinstance(part.nodes, int):
            cells[part.type] = cells.get(part.type, 0) + part.nodes
        elif len(part.nodes):
            solid.setdefault(part.type, []).append(i)
            cells.setdefault(part.type, None)
    for kind, places in solid.items():
        cells[kind] = np.concatenate([content.parts[i].nodes for i in places])
    out = {
        "points": content.points,
        "cells": cells,
        "values": None,
        "location": None,
        "label": None,
        "reordered": content.reordered or _interleaved(content),
    }
    if not want:
        return out
    fields = list_of(content)
    what = file
    if len(content.steps) > 1 and content.step is not None:
        what = f"{file}, at time {content.steps[content.step]:g},"
    chosen, component = choose(what, fields, name, location, content.active)
    out["label"] = label(chosen, component)
    out["location"] = chosen.location
    out["steps"] = chosen.steps
    used = [i for places in solid.values() for i in places]
    if chosen.location == "point":
        has = content.point_blocks.get(chosen.name)
        if has is not None:
            _require_everywhere(
                chosen, [i for i in used if content.parts[i].block not in has], content
            )
        out["values"] = scalar(content.point[chosen.name], component)
        return out
    arrays = getattr(content, chosen.location)[chosen.name]
    _require_everywhere(chosen, [i for i in used if arrays[i] is None], content)
    if chosen.location == "cell":
        out["values"] = {
            kind: np.concatenate([scalar(arrays[i], component) for i in places])
            for kind, places in solid.items()
        }
        return out
    return out | _corners(content, solid, arrays, component)


def _interleaved(content: Content) -> str:
    """Why cells by type are in another order than in the parts."""
    types = [p.type for p in content.parts if p.solid and len(p)]
    runs = [t for k, t in enumerate(types) if k == 0 or t != types[k - 1]]
    return "types of cells take turns in it" if len(runs) > len(set(runs)) else ""


def _require_everywhere(field: Field, lacking: list[int], content: Content) -> None:
    if not lacking:
        return
    parts = [content.parts[i] for i in lacking]
    n = sum(map(len, parts))
    if field.blocks:
        names = [*dict.fromkeys(p.block for p in parts)]
        advice = f"Pass block={[*field.blocks]} to read those that have it."
        if set(names) & set(field.blocks):
            names, advice = [*dict.fromkeys(p.type for p in parts)], "Take another field."
    else:
        names, advice = [*dict.fromkeys(p.type for p in parts)], "Take another field."
    raise Trouble(
        "asked",
        f"Field {field.name!r} ({field.location}) is not on all cells: {n} in "
        f"{', '.join(map(repr, names))} have no value. {advice}",
    )


def _corners(
    content: Content,
    solid: dict[str, list[int]],
    arrays: list[np.ndarray | None],
    component: int | str | None,
) -> dict[str, Any]:
    """Values at the corners of cells. Of tetrahedra alone they stay; other cells get points of
    their own, which coincide and are welded, so that the values are point data."""

    def values(i: int) -> np.ndarray:
        a = arrays[i]
        assert a is not None
        return scalar(a, component, lead=2)

    kinds = {kind: [content.parts[i] for i in places] for kind, places in solid.items()}
    if [*kinds] == ["tetra"]:
        return {"values": np.concatenate([values(i)[:, :4] for i in solid["tetra"]])}
    points, data, cells, start = [], [], {}, 0
    for kind, places in solid.items():
        nodes = np.concatenate([_nodes(content.parts[i]) for i in places])
        at = np.concatenate([values(i) for i in places])
        width = min(nodes.shape[1], at.shape[1])
        cells[kind] = start + np.arange(nodes.size).reshape(nodes.shape)
        points.append(content.points[nodes.reshape(-1)])
        full = np.zeros(nodes.shape, at.dtype)
        full[:, :width] = at[:, :width]
        data.append(full.reshape(-1))
        start += nodes.size
    flat = {p.type: len(p) for p in content.parts if not p.solid}
    return {
        "points": np.concatenate(points),
        "values": np.concatenate(data),
        "cells": {**flat, **cells},
        "location": "point",
    }


def _nodes(part: Part) -> np.ndarray:
    assert not isinstance(part.nodes, int)
    return part.nodes
