"""Files that are whole or not there: written beside their place, synced, and moved there.

A process that is killed meanwhile, or a disk that is full, leaves the previous file as it was. The
file beside has a name of its own, so that two writers do not meet in it, and is removed on failure;
what a killed process left is removed by `require_place`, later.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import platform
import secrets
import shutil
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

_MARK = ".jaxvr-"


def shown(path: Any, most: int = 200) -> str:
    """A path in quotes for messages; the middle of one that is longer than `most` is left out."""
    text = str(path)
    return repr(text if len(text) <= most else f"{text[: most // 2]} ... {text[-most // 2 :]}")


def place_of(path: Any) -> Path:
    """Where the file is in the end: `~` expanded and links followed, so that a link stays one."""
    path = Path(os.fsdecode(path))
    with contextlib.suppress(RuntimeError):  # no home: a folder named ~
        path = path.expanduser()
    return Path(os.path.realpath(path))


@contextlib.contextmanager
def beside(path: Any) -> Iterator[Path]:
    """The path of a new, empty file beside `path`, which takes its place when the block ends well.

    It has the same suffix, for writers that look at it. Raises OSError where it cannot be written.
    """
    place = place_of(path)
    if place.exists() and not stat.S_ISREG(place.stat().st_mode) and not place.is_dir():
        yield place  # a device or a pipe: nothing can take its place
        return
    _require_writable(place)
    name = f"{_mark(place)}{os.getpid()}-{secrets.token_hex(6)}{place.suffix[:16]}"
    part = place.with_name(name)
    os.close(os.open(part, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
    try:
        yield part
        move(part, place)
    except BaseException:
        with contextlib.suppress(OSError):
            part.unlink()
        raise


def move(made: Path, place: Path) -> None:
    """A finished file to its place in the same file system, at once, and both on the disk.

    A file that is there is replaced and its mode is kept. Raises OSError, also where that file may
    not be written.
    """
    _require_writable(place)
    sync(made)
    if place.is_file():
        with contextlib.suppress(OSError):
            shutil.copymode(place, made)
    os.replace(made, place)
    with contextlib.suppress(OSError):  # folders cannot be synced everywhere
        sync(place.parent)


def sync(path: Path) -> None:
    """The content of a file, or the names in a folder, to the disk."""
    handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _require_writable(place: Path) -> None:
    """PermissionError for a file that may not be written, which a new name would get round."""
    if place.is_file() and not os.access(place, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(place))


@contextlib.contextmanager
def whole_file(path: Any) -> Iterator[BinaryIO]:
    """A binary file to write to, whose content becomes that of `path` when the block ends well."""
    with beside(path) as part, open(part, "wb") as file:
        yield file


def write_whole(path: Any, text: str) -> None:
    """Writes a text, UTF-8, as `whole_file`."""
    with whole_file(path) as file:
        file.write(text.encode())


def require_place(path: Any, what: str) -> None:
    """OSError, with `what` it is, the path and the reason, unless a file can be written there.

    Tries it with a file beside, and removes what killed writers of the same file left on this
    machine.
    """
    try:
        place = place_of(path)
        if place.is_dir():
            raise IsADirectoryError(f"{what} cannot be written to {shown(path)}: it is a folder.")
        if place.exists() and not place.is_file():
            return
        _require_writable(place)
        _sweep(place)
        part = place.with_name(f"{_mark(place)}{os.getpid()}-{secrets.token_hex(6)}")
        try:
            with open(part, "xb") as file:
                file.write(b"jaxvr")
                file.flush()
                os.fsync(file.fileno())
        finally:
            with contextlib.suppress(OSError):
                part.unlink()
    except OSError as e:
        if e.errno is None:
            raise
        reason = f"{what} cannot be written to {shown(path)}: {e.strerror}. Choose another place."
        raise type(e)(reason) from e


def _mark(place: Path) -> str:
    """What names of files beside begin with: one mark for each file and machine."""
    about = f"{platform.node()}/{place.name}".encode(errors="surrogateescape")
    return f"{_MARK}{hashlib.sha256(about).hexdigest()[:12]}-"


def _sweep(place: Path) -> None:
    """Removes files beside whose writers are no more."""
    if os.name != "posix":  # elsewhere asking for a process may end it
        return
    mark = _mark(place)
    with contextlib.suppress(OSError):
        for part in place.parent.iterdir():
            if not part.name.startswith(mark):
                continue
            pid = part.name[len(mark) :].partition("-")[0]
            if pid.isdigit() and not _runs(int(pid)):
                with contextlib.suppress(OSError):
                    part.unlink()


def _runs(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        pass
    return True
