"""The folder that compiled libraries are kept in, and which files in it may be loaded.

A library is code that this process will run, and a file that is cut short kills the process when it
is mapped (SIGBUS), whatever the loader thinks of it. So before a file is loaded its content is
compared with a SHA-256 digest that is part of its name,

    jaxvr-<dtype>-<key: what it was made from>-<digest of the content>.so

and it must be a regular file of this user (or of root) that nobody else may write to, in a folder
of which the same holds. Files get their name by a rename, after their content has reached the disk.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import stat
import tempfile
import time
import uuid
from collections.abc import Iterator
from pathlib import Path

from jaxvr._core.writing import sync

DIGITS = 20
SCRATCH = "tmp-jaxvr-"
# A build takes minutes at most: what is older was left by one that was killed.
LEFT_OVER = 3600.0


def is_ours(status: os.stat_result, *, roots: bool = True) -> bool:
    """Whether nobody but this user, or root, can have written there."""
    if not hasattr(os, "getuid"):
        return True
    owner = status.st_uid == os.getuid() or (roots and status.st_uid == 0)
    return owner and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def default_folder() -> tuple[Path, str | None]:
    """Where libraries go unless the environment says otherwise, and None; without a home, a folder
    of this user's own among the temporary ones, and what to say about it. Never a place that
    depends on where the process happens to run: a relative XDG_CACHE_HOME is passed over, as the
    XDG Base Directory Specification asks.

    Raises:
      OSError: if there is no home, and no folder for temporary files either.
    """
    for name in ("LOCALAPPDATA", "XDG_CACHE_HOME"):
        path = Path(os.environ.get(name, ""))
        if path.is_absolute():
            return path / "jaxvr", None
    with contextlib.suppress(RuntimeError):  # no HOME, and no entry for this user
        home = Path.home()
        if home.is_absolute():
            return home / ".cache" / "jaxvr", None
    folder = _temporary() / f"jaxvr-{_user()}"
    remark = (
        f"There is no home folder, so jaxvr keeps what it has compiled in {folder}. Set "
        "JAXVR_CACHE to a folder that stays, or it will be compiled again."
    )
    return folder, remark


def _temporary() -> Path:
    """The folder for temporary files; not the working folder, which is `tempfile`'s last resort."""
    folder = Path(tempfile.gettempdir())
    named = (os.environ.get(name) for name in ("TMPDIR", "TEMP", "TMP"))
    known = [Path(x) for x in (*named, "/tmp", "/var/tmp", "/usr/tmp") if x]
    if folder == Path.cwd() and folder not in known:
        raise FileNotFoundError("there is neither a home folder nor one for temporary files")
    return folder


def _user() -> str:
    return str(os.getuid()) if hasattr(os, "getuid") else "user"


def prepare(folder: Path) -> Path:
    """A folder that only this user (or root) can write to: this one, made with mode 0700 or, if it
    is jaxvr's by its name, brought to it; else, as in /tmp, one for this user in it.

    Raises:
      OSError: if there is none.
    """
    for path in (*reversed(folder.parents), folder):
        if not path.exists():  # `parents=True` would make parents by the process's umask
            path.mkdir(mode=0o700, exist_ok=True)
    if not folder.is_dir():
        raise NotADirectoryError(f"{folder} is no folder")
    status = folder.stat()
    if is_ours(status):
        return folder
    # A folder with another name has other uses too, which are not ours to forbid.
    mine = hasattr(os, "getuid") and status.st_uid == os.getuid()
    if mine and folder.name == "jaxvr":
        folder.chmod(0o700)
        return folder
    own = folder / f"jaxvr-{_user()}"
    with contextlib.suppress(FileExistsError):
        own.mkdir(mode=0o700)
    status = own.lstat()
    if stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid():
        own.chmod(0o700)
        return own
    raise PermissionError(f"{folder} and {own} can be written to by others")


def is_sound(file: Path) -> bool:
    """Whether a library is whole, and nobody else's: see the module."""
    try:
        status = file.lstat()
        if not stat.S_ISREG(status.st_mode) or not is_ours(status):
            return False
        return digest_of(file) == file.stem.rpartition("-")[2]
    except OSError:
        return False


def digest_of(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()[:DIGITS]


def find(folder: Path, name: str) -> Path | None:
    """A library of this name, without its digest, that may be loaded. Others of it are removed."""
    found = None
    for file in sorted(folder.glob(f"{name}-*.so")):
        if found is None and is_sound(file):
            found = file
        elif not is_sound(file):
            remove(file)
    return found


def remove(file: Path) -> None:
    """A file, or an empty folder in the place of one."""
    with contextlib.suppress(OSError):
        if _is_folder(file):
            file.rmdir()
        else:
            file.unlink()


def _is_folder(file: Path) -> bool:
    return file.is_dir() and not file.is_symlink()


def publish(made: Path, folder: Path, name: str) -> Path:
    """Moves a finished library to its place, at once, so that processes may build side by side.

    Where a folder has its name, which nothing replaces, another part goes before the digest.
    """
    made.chmod(0o700)
    sync(made)
    digest = digest_of(made)
    target = folder / f"{name}-{digest}.so"
    if _is_folder(target):
        remove(target)
    if _is_folder(target):
        target = folder / f"{name}-{uuid.uuid4().hex[:8]}-{digest}.so"
    made.replace(target)  # whose mode does not count, as it does in `writing.move`
    with contextlib.suppress(OSError):  # not all file systems have it
        sync(folder)
    return target


@contextlib.contextmanager
def scratch(folder: Path) -> Iterator[Path]:
    """A folder to build in, gone afterwards, as are those that killed builds have left."""
    for old in folder.glob("tmp*"):
        with contextlib.suppress(OSError):
            if _is_left_over(old):
                shutil.rmtree(old, ignore_errors=True)
    path = Path(tempfile.mkdtemp(prefix=SCRATCH, dir=folder))
    try:
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)


def _is_left_over(path: Path) -> bool:
    """Old, and a build's: by its name, or by what is in it (once these were tmp and 8 letters)."""
    status = path.lstat()
    if not stat.S_ISDIR(status.st_mode) or time.time() - status.st_mtime < LEFT_OVER:
        return False
    contents = list(path.iterdir())
    known = all(x.name.startswith("jaxvr-") for x in contents)
    return path.name.startswith(SCRATCH) or (len(path.name) == 11 and bool(contents) and known)
