"""Files that list files: one for each time step and part (.pvd, .series).

A part that has blocks of its own keeps them, as "part/block".
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from . import vtk_files
from .content import Ask, Content, Field, Trouble, join, pick_blocks, pick_step
from .fields import list_of

SUFFIXES = (".pvd", ".series")
# Steps whose files are read as a whole for their fields, where no header tells them.
MOST = 20
Read = Callable[[Path, Ask, Callable[[], str]], Content]


def members(path: Path, suffix: str) -> list[tuple[float, str, Path]]:
    """(time, name of the part, file) of each entry of a .pvd or .series file. Raises Trouble."""
    try:
        if suffix == ".series":
            entries = json.loads(path.read_text("utf-8"))["files"]
            found = [(float(e["time"]), "", path.parent / e["name"]) for e in entries]
        else:
            sets = ElementTree.fromstring(path.read_bytes()).iter("DataSet")
            found = [
                (
                    float(e.get("timestep") or 0),
                    e.get("name") or e.get("part") or "0",
                    path.parent / e.attrib["file"],
                )
                for e in sets
            ]
    except (ValueError, KeyError, TypeError, ElementTree.ParseError) as e:
        raise Trouble("damaged", f"it is no collection of files: {type(e).__name__}: {e}") from None
    if not found:
        raise Trouble("damaged", "it lists no files.")
    for _, _, file in found:
        if not file.is_file():
            raise Trouble("damaged", f"it names {file.name!r}, which is not there.")
    return found


def read(path: Path, ask: Ask, said: Callable[[], str], suffix: str, reader: Read) -> Content:
    """One step of such a file. reader: for the files that it lists."""
    entries = members(path, suffix)
    times = tuple(sorted({t for t, _, _ in entries}))
    step = pick_step(times, ask.step)
    here = [(name, file) for t, name, file in entries if t == times[step]]
    if len(here) == 1:
        content = reader(here[0][1], dataclasses.replace(ask, step=None), said)
    else:
        names = tuple(name for name, _ in here)
        chosen = _chosen(names, ask.block)
        contents = [
            reader(here[k][1], dataclasses.replace(ask, step=None, block=inner), said)
            for k, inner in chosen.items()
        ]
        content = join(contents, [names[k] for k in chosen])
        passed = [name for k, name in enumerate(names) if k not in chosen]
        content.blocks = (*content.blocks, *passed)
    content.raw = None
    content.step = step
    if len(times) > 1:
        content.steps = times
    return content


def _chosen(names: tuple[str, ...], asked: Any) -> dict[int, Any]:
    """Which parts are asked for, and which of their own blocks: None for all of them."""
    if asked is None:
        return dict.fromkeys(range(len(names)))
    found: dict[int, Any] = {}
    wanted: list[Any] = [asked] if isinstance(asked, str | int) else list(asked)
    for want in wanted:
        outer = [
            k
            for k, name in enumerate(names)
            if isinstance(want, str) and want not in names and want.startswith(f"{name}/")
        ]
        for k in outer:
            if found.get(k, ()) is not None:
                found[k] = [*found.get(k, ()), want[len(names[k]) + 1 :]]
        if not outer:
            found |= dict.fromkeys(pick_blocks(names, want))
    return dict(sorted(found.items()))


def fields(
    path: Path,
    ask: Ask,
    said: Callable[[], str],
    suffix: str,
    reader: Read,
    known: list[Field],
    step: int,
) -> tuple[list[Field], list[str]]:
    """The fields of all steps, each with the times that have it, and what is to be told.

    known: those of `step`. Headers tell names where the files are VTK's XML; a step is read as a
    whole where it has others than those before it, or where its header does not tell.
    """
    entries = members(path, suffix)
    times = tuple(sorted({t for t, _, _ in entries}))
    found = {(f.name, f.location): f for f in known}
    have = {key: [times[step]] for key in found}
    unread: list[float] = []
    whole = 0
    for k, time in enumerate(times):
        if k == step:
            continue
        names = _names([file for t, _, file in entries if t == time], ask)
        if names is None or not names <= set(found):
            whole += 1
            if whole > MOST:
                unread.append(time)
                continue
            listed = list_of(read(path, dataclasses.replace(ask, step=k), said, suffix, reader))
            names = {(f.name, f.location) for f in listed}
            for f in listed:
                found.setdefault((f.name, f.location), f)
        for key in names:
            have.setdefault(key, []).append(time)
    notes = []
    if unread:
        notes = [
            f"It has {len(times)} steps, of which {len(unread)} were not looked at for fields: "
            f"those from {unread[0]:g} to {unread[-1]:g}."
        ]
    return [
        f._replace(steps=tuple(sorted(have[key]))) for key, f in found.items() if key in have
    ], notes


def _names(files: list[Path], ask: Ask) -> set[tuple[str, str]] | None:
    """Fields of all these files by their headers; None where these do not tell."""
    if not ask.vtk:
        return None
    found: set[tuple[str, str]] = set()
    for file in files:
        try:
            names = vtk_files.names(file, file.suffix.lower())
        except ImportError:
            return None
        if not names:
            return None
        found |= names
    return found
