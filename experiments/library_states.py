"""States of a library's file, folder, environment, compiler and disk: for
`experiments.library_faults`."""

from __future__ import annotations

import contextlib
import hashlib
import os
import resource
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from experiments.library_place import Place, Process, State, Untried
from jaxvr.native import build, cache

# The file


def flip(place: Place, byte: int, bit: int) -> None:
    raw = bytearray(place.file.read_bytes())
    raw[byte % len(raw)] ^= 1 << bit
    place.file.write_bytes(raw)


def become(place: Place, content: bytes, own_digest: bool = False) -> None:
    place.file.write_bytes(content)
    if own_digest:
        digest = hashlib.sha256(content).hexdigest()[: cache.DIGITS]
        place.file.rename(place.file.with_name(f"{stem(place)}-{digest}.so"))


def stem(place: Place) -> str:
    return place.file.stem.rpartition("-")[0]


def instead(place: Place, make: Callable[[Path], Any]) -> None:
    place.file.unlink()
    make(place.file)


def listen_at(path: Path) -> None:
    with contextlib.chdir(path.parent), socket.socket(socket.AF_UNIX) as s:
        s.bind(path.name)


def beside(place: Place, name: str, content: bytes) -> None:
    (place.folder / name).write_bytes(content)


def files(sound: bytes, many: int) -> list[State]:
    size = len(sound)
    rng = np.random.default_rng(0)
    lengths = [0, 1, 3, 4, 15, 16, 63, 64, 100, 1000, 4095, 4096, size - 4096, size - 1]
    lengths += [int(x) for x in np.linspace(5000, size - 5000, many)]
    places = [*range(0, 64, 3), *(size - 64 * k - 1 for k in range(12))]
    places += [int(x) for x in rng.integers(64, size, 2 * many)]
    extension = next(Path(p) for p in sys.path if Path(p).name == "lib-dynload")
    elf = next(extension.glob("*.so")).read_bytes()
    program = Path(os.path.realpath(sys.executable)).read_bytes()[:200_000]
    foreign = {
        "text": b"not a library",
        "zeros": bytes(size),
        "noise": rng.bytes(size),
        "a program": program,
        "an extension of Python": elf,
        "an archive": b"!<arch>\n" + sound,
        "a script": b"#!/bin/sh\nexit 0\n",
        "for 32 bits": sound[:4] + b"\1" + sound[5:],
        "big endian": sound[:5] + b"\2" + sound[6:],
        "of another machine": sound[:18] + b"\xf3\0" + sound[20:],
        "a header alone": sound[:64],
        "header and zeros": sound[:64] + bytes(size - 64),
        "halves swapped": sound[size // 2 :] + sound[: size // 2],
        "longer": sound + b"\0",
        "twice": sound * 2,
    }
    kinds: dict[str, Callable[[Path], Any]] = {
        "nothing": lambda f: None,
        "a link that dangles": lambda f: f.symlink_to("nowhere"),
        "a link to itself": lambda f: f.symlink_to(f.name),
        "a folder": lambda f: f.mkdir(),
        "a full folder": lambda f: (f.mkdir(), (f / "x").write_text("")),
        "a pipe": lambda f: os.mkfifo(f),
        "a socket": listen_at,
        "a link to /dev/zero": lambda f: f.symlink_to("/dev/zero"),
        "a link to a folder": lambda f: f.symlink_to("/tmp"),
    }
    out = [State("cut", f"at {n}", lambda p, n=n: become(p, sound[:n])) for n in lengths]
    out += [
        State("bit", f"{bit} of byte {n % size}", lambda p, n=n, bit=bit: flip(p, n, bit))
        for n, bit in zip(places, rng.integers(0, 8, len(places)).tolist(), strict=True)
    ]
    out += [State("foreign", k, lambda p, x=x: become(p, x)) for k, x in foreign.items()]
    out += [
        State("forged", f"{k}, by its own digest", lambda p, k=k: become(p, foreign[k], True))
        for k in ("text", "an extension of Python", "for 32 bits")
    ]
    out += [State("kind", k, lambda p, m=m: instead(p, m)) for k, m in kinds.items()]
    out.append(
        State("kind", "a link to a sound one", lambda p: instead(p, lambda f: link_to_sound(p, f)))
    )
    stale = {
        "of another source": ("jaxvr-float32-00000000000000000000-{}.so", sound),
        "without a digest": ("jaxvr-float32-{}.so", sound),
        "of the other dtype": ("jaxvr-float64-00000000000000000000-{}.so", sound[:1000]),
        "text": ("{}.so", b"text"),
        "with odd bytes in its name": ("jaxvr-\udcff-{}.so", b""),
    }
    out += [
        State("stale", k, lambda p, n=n, x=x: beside(p, n.format("0" * cache.DIGITS), x))
        for k, (n, x) in stale.items()
    ]
    out += [
        State("stale", "an unsound one first", lambda p: beside(p, f"{stem(p)}-0.so", sound)),
        State("stale", "an unsound one last", lambda p: beside(p, f"{stem(p)}-z.so", b"")),
    ]
    return out


def link_to_sound(place: Place, file: Path) -> None:
    file.symlink_to(place.base / "sound.so")


# Modes, owners, umasks


def modes() -> list[State]:
    out = []
    for mode in (0, 0o200, 0o400, 0o444, 0o500, 0o600, 0o644, 0o666, 0o722, 0o755, 0o777, 0o4755):
        for user in (False, True):
            name = f"{mode:o}{' as another user' * user}"
            out += [
                State("mode of the file", name, lambda p, m=mode: p.file.chmod(m), other_user=user),
                State("mode of folder", name, lambda p, m=mode: p.folder.chmod(m), other_user=user),
            ]
    for mode in (0, 0o500, 0o777):
        prepare = lambda p, m=mode: (p.empty(), p.folder.chmod(m))  # noqa: E731
        out.append(State("mode of folder", f"{mode:o}, empty", prepare, other_user=True))
    for mask in (0, 0o022, 0o027, 0o077, 0o177, 0o377, 0o777):
        inside = lambda p, m=mask: os.umask(m)  # noqa: E731
        out.append(State("umask", f"{mask:o}", lambda p: shutil.rmtree(p.folder), inside))
    if os.getuid() == 0:
        out += [
            State("owner", "of the file", lambda p: os.chown(p.file, 4321, -1)),
            State("owner", "of the folder", lambda p: os.chown(p.folder, 4321, -1)),
            State("owner", "root, for another user", lambda p: own(p, 0), other_user=True),
            State("owner", "a third, for another user", lambda p: own(p, 4321), other_user=True),
        ]
    return out


def own(place: Place, user: int) -> None:
    os.chown(place.file, user, -1)
    os.chown(place.folder, user, -1)


# The environment


def no_entry(place: Place) -> None:
    """This user has none in the list of users."""
    import pwd

    def nobody(*_: Any) -> Any:
        raise KeyError("no entry")

    pwd.getpwuid = nobody
    tempfile.tempdir = None


def gone(place: Place) -> None:
    away = place.root / "away"
    away.mkdir()
    os.chdir(away)
    away.rmdir()


def environment() -> list[State]:
    odd = {
        "empty": "",
        "missing": "{root}/no/such/folder",
        "relative": "some/where",
        "here": ".",
        "a file": "{root}/file",
        "below a file": "{root}/file/x",
        "null": "/dev/null",
        "below null": "/dev/null/x",
        "full": "/dev/full",
        "proc": "/proc",
        "long": "{root}/" + 300 * "x",
        "longer": "{root}/" + 3000 * "x/",
        "two lines": "{root}/a\nb",
        "no text": "{root}/\udcff\udcfe",
        "a tilde": "~/cache",
        "blanks": "{root}/ a  b ",
        "a variable": "$HOME/x",
    }

    def put(place: Place, variable: str, value: str) -> None:
        (place.root / "file").write_text("")
        value = value.format(root=place.root)
        if variable == "JAXVR_CACHE":
            place.set(JAXVR_CACHE=value)
        else:
            place.homeless(**{variable: value})

    out = [
        State(variable, k, lambda p, n=variable, x=x: put(p, n, x), lambda p: os.chdir(p.root))
        for variable in ("JAXVR_CACHE", "XDG_CACHE_HOME", "HOME", "LOCALAPPDATA")
        for k, x in odd.items()
    ]
    out += [
        State("TMPDIR without a home", k, lambda p, x=x: put(p, "TMPDIR", x), no_entry)
        for k, x in odd.items()
    ]
    out += [
        State("folder", "gone from under us", lambda p: p.set(JAXVR_CACHE="cache"), gone),
        State("PATH", "empty", lambda p: (p.empty(), p.set(PATH="", JAXVR_CC=None))),
        State("PATH", "none", lambda p: (p.empty(), p.set(PATH=None, JAXVR_CC=None))),
    ]
    return out


# The compiler


def compilers(size: int) -> list[State]:
    lines = {f"exit {n}": f"exit {n}" for n in (0, 1, 2, 126, 127, 255)}
    lines |= {f"signal {n}": f"kill -{n} $$" for n in (2, 6, 9, 11, 15)}
    cuts = (0, 1, 64, 1000, size // 4, size // 2, size - 5000, size - 1)
    lines |= {f"cut at {n}": f'head -c {n} "$sound" > "$out"' for n in cuts}
    lines |= {
        "half, then killed": f'head -c {size // 2} "$sound" > "$out"; kill -9 $$',
        "whole, then fails": 'cp "$sound" "$out"; exit 1',
        "garbage": 'echo x > "$out"',
        "a program": 'cp /bin/sh "$out"',
        "a folder": 'mkdir "$out"',
        "a pipe": 'mkfifo "$out"',
        "a link": 'ln -s "$sound" "$out"',
        "a link that dangles": 'ln -s nowhere "$out"',
        "of mode 0": 'cp "$sound" "$out"; chmod 0 "$out"',
        "of mode 777": 'cp "$sound" "$out"; chmod 777 "$out"',
        "without its folder": 'rm -r "$(dirname "$out")"; exit 0',
        "without the cache": 'rm -r "$(dirname "$(dirname "$out")")"; exit 0',
        "the cache a file": 'd=$(dirname "$(dirname "$out")"); rm -r "$d"; : > "$d"; exit 0',
        "words": 'head -c 5000000 /dev/zero; cp "$sound" "$out"',
        "words and fails": "head -c 5000000 /dev/urandom >&2; exit 1",
        "asks": 'read x; cp "$sound" "$out"',
        "leaves a process": 'sleep 3 & cp "$sound" "$out"',
        "hangs": "sleep 60",
        "hangs and is deaf": "trap '' 1 2 15; sleep 60 & wait; sleep 60",
    }
    quick = lambda p: setattr(build, "TIMEOUT", 2.0)  # noqa: E731
    out = [State("compiler", k, lambda p, x=x: p.compiler(x), quick) for k, x in lines.items()]
    chosen = {
        "none": "/no/such/compiler",
        "a folder": "/",
        "no command": "'unbalanced",
        "blank": "  ",
        "no program": "/etc/passwd",
        "options alone": "-O3 -g",
        "with options": "{cc} -O3",
        "no text": "\udcff",
        "a loop": "{root}/loop",
        "no script": "{root}/no_script",
    }
    for k, x in chosen.items():
        out.append(State("JAXVR_CC", k, lambda p, x=x: choose(p, x)))
    return out


def choose(place: Place, command: str) -> None:
    place.empty()
    (place.root / "loop").symlink_to("loop")
    script = place.root / "no_script"
    script.write_bytes(b"\0\1\2")
    script.chmod(0o755)
    place.set(JAXVR_CC=command.format(root=place.root, cc=place.base / "cc"))


# The disk, ends in the middle of a build, and others at the same time


def limit(what: int, number: int) -> Callable[[Place], None]:
    return lambda place: resource.setrlimit(what, (number, resource.getrlimit(what)[1]))


def full(place: Place, size: str) -> None:
    """Another file system in the folder's place, of a size."""
    place.empty()
    run = ["mount", "-t", "tmpfs", "-o", f"size={size},mode=700", "tmpfs", str(place.folder)]
    done = subprocess.run(run, capture_output=True)
    if done.returncode:
        raise Untried(done.stderr.decode().strip())


STEPS = {
    "preparing": (cache, "prepare"),
    "searching": (cache, "find"),
    "compiling": (build, "_compile"),
    "trying": (build, "_try"),
    "publishing": (cache, "publish"),
    "digesting": (cache, "digest_of"),
    "syncing": (os, "fsync"),
    "renaming": (Path, "replace"),
    "registering": (build, "_register"),
}


def dies(place: Place, step: str, after: bool) -> None:
    """A process that is killed at a step of its build comes first."""
    place.empty()

    def end(place: Place) -> None:
        owner, name = STEPS[step]
        real = getattr(owner, name)

        def killed(*a: Any, **k: Any) -> None:
            if after:
                real(*a, **k)
            os.kill(os.getpid(), signal.SIGKILL)

        setattr(owner, name, killed)

    found = Process(place, State("", "", inside=end)).wait()
    assert found["outcome"] == "signal 9", found


def dies_at(place: Place, delay: float) -> None:
    """One with a compiler that writes slowly, killed with it after some time."""
    place.compiler('head -c 50000 "$sound" > "$out"; sleep 0.3; cp "$sound" "$out"; sleep 0.1')
    Process(place, State("", "")).wait(delay)
    time.sleep(0.6)


def disk_and_time() -> list[State]:
    out = [
        State("disk", f"files of {n} bytes", Place.empty, limit(resource.RLIMIT_FSIZE, n))
        for n in (0, 1, 1000, 100_000)
    ]
    out += [State("disk", f"full after {s}", lambda p, s=s: full(p, s)) for s in ("4k", "40k")]
    out += [
        State("disk", f"{n} files open", Place.empty, limit(resource.RLIMIT_NOFILE, n))
        for n in (0, 3, 5, 8, 16)
    ]
    for step in STEPS:
        for after in (False, True):
            name = f"{'after' if after else 'before'} {step}"
            out.append(State("killed", name, lambda p, s=step, a=after: dies(p, s, a)))
    out += [
        State("killed", f"after {t} s", lambda p, t=t: dies_at(p, t)) for t in (0.05, 0.2, 0.35)
    ]
    out += [
        State("at once", "8 in an empty cache", Place.empty, processes=8),
        State("at once", "8 without a folder", lambda p: shutil.rmtree(p.folder), processes=8),
        State("at once", "8 beside a cut file", lambda p: become(p, b"cut"), processes=8),
        State("at once", "8 whose compiler fails", lambda p: p.compiler("exit 1"), processes=8),
    ]
    return out


def states(sound: bytes, many: int) -> list[State]:
    return [
        *(State("sound", "as it should be"), State("sound", "no file yet", Place.empty)),
        *files(sound, many),
        *modes(),
        *environment(),
        *compilers(len(sound)),
        *disk_and_time(),
    ]
