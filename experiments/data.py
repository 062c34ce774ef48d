"""Where the data are that are not in the repository: for experiments and tests alike.

The folders are `JAXVR_DATA` and `JAXVR_VECTORS`, or else `shared/data` and `shared/vectors` beside
the checkout. `JAXVR_DATA=none` says that there are none, and speaks for both folders where
`JAXVR_VECTORS` is not set; `JAXVR_VECTORS=none` for its own.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterable, Mapping
from pathlib import Path

BESIDE = Path(__file__).resolve().parents[2] / "shared"
VARIABLES = {"data": "JAXVR_DATA", "vectors": "JAXVR_VECTORS"}


def folder(kind: str, environment: Mapping[str, str] = os.environ) -> Path | None:
    """The folder of "data" or "vectors", whether it is there or not; None where none is wanted."""
    named = environment.get(VARIABLES[kind], "")
    if "none" in (named, named or environment.get("JAXVR_DATA", "")):
        return None
    return Path(named) if named else BESIDE / kind


def locate(name: str) -> tuple[str, str]:
    """Kind of folder, and path inside of it: of "can.vtu" or "vectors/NAME"."""
    kind, _, rest = name.partition("/")
    return ("vectors", rest) if kind == "vectors" else ("data", name)


def path_of(name: str, environment: Mapping[str, str] = os.environ) -> Path:
    """A file by its name as for `locate`; raises FileNotFoundError where it is not there."""
    kind, rest = locate(name)
    place, variable = folder(kind, environment), VARIABLES[kind]
    if place is None:
        raise FileNotFoundError(f"{name} is not at hand: {variable} is none. Set it to a folder.")
    if not (place / rest).exists():
        raise FileNotFoundError(f"{name} is missing in {place}. Set {variable} to its folder.")
    return place / rest


def meshes_of(names: Iterable[str], parser: argparse.ArgumentParser) -> dict[str, Path]:
    """The files of meshes by name; where one is not at hand, the script ends and says so."""
    try:
        return {name: path_of(f"{name}.vtu") for name in names}
    except FileNotFoundError as error:
        parser.error(str(error))
