"""A folder with a library in it, and a process that loads it: for `experiments.library_faults`."""

from __future__ import annotations

import ctypes
import json
import os
import select
import shutil
import signal
import time
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import jaxvr
from jaxvr.native import build

GOOD = ("kept", "rebuilt", "JAX's loops")
NOBODY = 65534
PATIENCE = 400.0  # seconds for one state; JAX's loops may have to be compiled on a busy machine
HOME = ("HOME", "XDG_CACHE_HOME", "LOCALAPPDATA", "JAXVR_CACHE")


class Untried(Exception):
    """This machine does not allow to make the state."""


class State(NamedTuple):
    """prepare(place): makes the state. inside(place): what the process does to itself first."""

    kind: str
    name: str
    prepare: Callable[[Place], Any] = lambda place: None
    inside: Callable[[Place], Any] = lambda place: None
    processes: int = 1
    other_user: bool = False


class Place:
    """A folder for one state: a sound library in its cache, and a compiler that makes another."""

    def __init__(self, base: Path, root: Path, name: str):
        self.base, self.root, self.folder = base, root, root / "jaxvr"
        self.folder.mkdir(mode=0o700, parents=True)
        self.file = self.folder / name
        shutil.copyfile(base / "sound.so", self.file)
        self.file.chmod(0o700)
        self.environment: dict[str, str | None] = {
            "JAXVR_CACHE": str(self.folder),
            "JAXVR_CC": str(base / "cc"),
            "JAXVR_NATIVE": None,
        }

    def empty(self) -> None:
        self.file.unlink()

    def set(self, **variables: str | None) -> None:
        self.environment |= variables

    def homeless(self, **variables: str | None) -> None:
        self.set(**dict.fromkeys(HOME), TMPDIR=str(self.root))
        self.set(**variables)

    def compiler(self, line: str) -> None:
        """Another one, of a single line of shell; the output is $out."""
        self.empty()
        script = self.root / "cc"
        script.write_text(
            '#!/bin/sh\nfor x in "$@"; do [ "$last" = -o ] && out="$x"; last="$x"; done\n'
            f"sound={self.base}/sound.so\n{line}\n"
        )
        script.chmod(0o755)
        self.set(JAXVR_CC=str(script))


class Process:
    """A fork that loads the library of a place, and may render with it."""

    def __init__(self, place: Place, state: State, render: bool = False):
        self.end, other = os.pipe()
        self.process = os.fork()
        if self.process == 0:
            os.close(self.end)
            try:
                found = load(place, state, render)
            except BaseException:
                found = {"outcome": "exception", "words": traceback.format_exc(limit=-3)}
            os.write(other, json.dumps(found).encode())
            os._exit(0)
        os.close(other)

    def wait(self, seconds: float = PATIENCE) -> dict[str, Any]:
        """What it found; or how it ended, by a signal if it does not in time."""
        said, last = b"", time.monotonic() + seconds
        try:
            while select.select([self.end], [], [], max(last - time.monotonic(), 0))[0]:
                part = os.read(self.end, 1 << 16)
                said += part
                if not part:
                    break
            else:
                os.kill(self.process, signal.SIGKILL)
            code = os.waitstatus_to_exitcode(os.waitpid(self.process, 0)[1])
        finally:
            os.close(self.end)
        if said and code == 0:
            return json.loads(said)
        late = time.monotonic() >= last
        return {"outcome": "hangs" if late else f"signal {-code}" if code < 0 else f"exit {code}"}


def load(place: Place, state: State, render: bool) -> dict[str, Any]:
    """What becomes of a state, in this process."""
    for name, value in place.environment.items():
        os.environ.pop(name, None) if value is None else os.environ.update({name: value})
    if state.other_user and os.getuid() == 0:
        os.setgroups([])
        os.setgid(NOBODY)
        os.setuid(NOBODY)
    sound = (place.base / "sound.so").read_bytes()
    mapped, real = [], ctypes.CDLL

    def watched(file: str) -> Any:
        mapped.append(Path(file).read_bytes() == sound)
        return real(file)

    made, compiled = build._compile, []

    def counted(*a: Any, **k: Any) -> None:
        compiled.append(a)
        made(*a, **k)

    build._compile = counted
    state.inside(place)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        build.ctypes.CDLL = watched  # pyright: ignore[reportAttributeAccessIssue]
        reason = build.load("float32")
        again = build.load("float32")
        build.ctypes.CDLL = real  # pyright: ignore[reportAttributeAccessIssue]
        picture = np.asarray(image()).tolist() if render else None
    news = [str(t.message) for t in told if issubclass(t.category, RuntimeWarning)]
    found = {"picture": picture, "words": reason or "", "told": news}
    if again != reason:
        return found | {"outcome": "another answer", "words": f"{reason} {again}"}
    if reason:
        one = len(news) == 1
        return found | {"outcome": "JAX's loops" if one else f"{len(news)} warnings"}
    # One that was forged with a digest of its own is looked into, and then made again. What a
    # compiler makes is what is to be loaded, if a trial in another process loads it.
    fine = mapped[-1] if state.kind == "forged" else all(mapped) or state.kind == "compiler"
    if not fine:
        return found | {"outcome": "unsound file mapped"}
    if len(news) > 1:
        return found | {"outcome": f"{len(news)} warnings"}
    return found | {"outcome": "rebuilt" if compiled else "kept"}


def image() -> Any:
    mesh = jaxvr.datasets.box((1, 1, 1), field=lambda p: p[:, 0], dtype="float32")
    camera = jaxvr.Camera.orbit(mesh, width=6, height=5)
    return jaxvr.render(mesh, camera, jaxvr.default_transfer(mesh))
