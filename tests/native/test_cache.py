"""Compiled libraries in their folder: what is not whole, or not this user's, is never loaded but
made again, and no failure gets out of `render`. The compiler is a script that copies a library."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from jaxvr.native import build, cache

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="POSIX modes and owners")


@pytest.fixture(scope="module")
def library():
    """A sound library."""
    return build.build("float32")


@pytest.fixture
def folder(tmp_path, monkeypatch, library):
    """An empty folder for libraries, and a compiler that is quick: it counts its calls there."""
    script = tmp_path / "cc"
    script.write_text(
        f"#!{sys.executable}\n"
        "import os, shutil, sys\n"
        f"open({str(tmp_path / 'calls')!r}, 'a').write('x')\n"
        f"shutil.copyfile({str(library)!r}, sys.argv[sys.argv.index('-o') + 1])\n"
    )
    script.chmod(0o700)
    monkeypatch.setenv("JAXVR_CC", str(script))
    monkeypatch.setenv("JAXVR_CACHE", str(tmp_path / "jaxvr"))
    return tmp_path / "jaxvr"


def calls(folder):
    file = folder.parent / "calls"
    return len(file.read_text()) if file.exists() else 0


def cut(file, part):
    file.write_bytes(file.read_bytes()[: int(part * file.stat().st_size)])


def flip(file, part):
    raw = bytearray(file.read_bytes())
    raw[int(part * (len(raw) - 1))] ^= 4
    file.write_bytes(raw)


def to_link(file):
    other = file.with_name("other.so")
    other.write_bytes(file.read_bytes())
    file.unlink()
    file.symlink_to(other)


FAULTS = {
    **{f"cut at {p}": lambda f, p=p: cut(f, p) for p in (0, 0.001, 0.3, 0.99)},
    **{f"flipped at {p}": lambda f, p=p: flip(f, p) for p in (0, 0.5, 1)},
    "longer": lambda f: f.write_bytes(f.read_bytes() + b"\0"),
    "words": lambda f: f.write_text("not a library"),
    "another program": lambda f: f.write_bytes(Path(sys.executable).read_bytes()[:100_000]),
    "written by others": lambda f: f.chmod(0o722),
    "a link": to_link,
    "an empty folder": lambda f: (f.unlink(), f.mkdir()),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_unsound_files_are_made_again(folder, fault):
    first = build.build("float32")
    assert build.build("float32") == first and calls(folder) == 1
    FAULTS[fault](first)
    again = build.build("float32")
    assert calls(folder) == 2 and cache.is_sound(again)
    assert not again.is_symlink() and stat.S_IMODE(again.stat().st_mode) & 0o022 == 0


def test_a_folder_in_the_place_of_a_library(folder, monkeypatch):
    """The library gets another name, once, and a warning says so."""
    monkeypatch.setattr(build, "_said", set())
    first = build.build("float32")
    first.unlink()
    first.mkdir()
    (first / "kept").write_text("")
    with pytest.warns(RuntimeWarning, match="A folder stands where a library belongs.*remove it"):
        again = build.build("float32")
    assert again != first and cache.is_sound(again) and (first / "kept").exists()
    assert build.build("float32") == again and calls(folder) == 2
    assert build._open(again) is not None


@pytest.mark.skipif(not hasattr(os, "getuid") or os.getuid() != 0, reason="only root gives away")
def test_a_file_of_another_user_is_not_loaded(folder):
    first = build.build("float32")
    os.chown(first, 4321, -1)
    assert cache.is_sound(build.build("float32")) and calls(folder) == 2


def test_folders_are_private_whatever_the_umask_is(folder):
    before = os.umask(0)
    try:
        build.build("float32")
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700
        folder.chmod(0o777)
        build.build("float32")
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    finally:
        os.umask(before)


def test_a_folder_with_other_uses_keeps_its_mode(folder, monkeypatch, tmp_path):
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o777)
    monkeypatch.setenv("JAXVR_CACHE", str(shared))
    made = build.build("float32")
    assert made.parent.parent == shared and stat.S_IMODE(shared.stat().st_mode) == 0o777
    assert stat.S_IMODE(made.parent.stat().st_mode) == 0o700


def test_left_overs_of_killed_builds_go(folder):
    build.build("float32").unlink()
    old, new = folder / "tmp-jaxvr-old", folder / "tmp-jaxvr-new"
    old.mkdir()
    new.mkdir()
    os.utime(old, (0, 0))
    build.build("float32")
    assert not old.exists() and new.exists()


def test_builds_side_by_side(folder):
    """Threads end with one sound library."""
    found = []
    threads = [
        threading.Thread(target=lambda: found.append(build.build("float32"))) for _ in range(6)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(set(found)) == 1 and len(found) == 6 and cache.is_sound(found[0])


PROCESSES = """
import os, sys
from jaxvr.native import build
start, go = os.pipe()
children = []
for _ in range(8):  # nothing was computed yet, so there are no threads to lose
    if not (child := os.fork()):
        os.close(go)
        os.read(start, 1)  # until the parent has made all of them
        try:
            os.write(1, f"{build.build('float32')}\\n".encode())  # a line at once, among eight
        finally:
            os._exit(0)
    children.append(child)
os.close(go)
[os.waitpid(child, 0) for child in children]
"""


def test_processes_side_by_side(folder):
    """Several that start together in an empty cache: each ends with a sound library, of one name,
    and they leave nothing else."""
    root = Path(__file__).resolve().parents[2]
    run = [sys.executable, "-W", "ignore", "-c", PROCESSES]
    done = subprocess.run(run, cwd=root, capture_output=True, text=True)
    found = done.stdout.split()
    assert len(found) == 8, done.stdout + done.stderr
    (file,) = {Path(name) for name in found}
    assert cache.is_sound(file) and list(folder.iterdir()) == [file]


def compiler_that(folder, line):
    script = folder.parent / "cc"
    script.write_text(f"#!/bin/sh\n{line}\n")
    script.chmod(0o700)


COMPILERS = {
    "fails": ("echo no; exit 1", "failed"),
    "says nothing and makes nothing": ("exit 0", "made nothing"),
    "is killed": ("kill -9 $$", "ended by signal 9"),
    "hangs": ("sleep 60", "did not end"),
    "makes garbage": ('while [ "$1" != -o ]; do shift; done; echo x > "$2"', "cannot be loaded"),
    "speaks bytes": ("printf '\\377\\376'; exit 3", "failed"),
}


@pytest.mark.parametrize("kind", COMPILERS)
def test_compilers_that_do_not(folder, monkeypatch, kind):
    line, word = COMPILERS[kind]
    compiler_that(folder, line)
    monkeypatch.setattr(build, "TIMEOUT", 1.0 if kind == "hangs" else 60.0)
    with pytest.raises(build.NativeError, match=word):
        build.build("float32")
    assert not list(folder.glob("tmp*")) and not list(folder.glob("*.so"))


@pytest.mark.parametrize("chosen", ["'unbalanced", "/no/such/compiler", "/"])
def test_no_compiler(folder, monkeypatch, chosen):
    monkeypatch.setenv("JAXVR_CC", chosen)
    with pytest.raises(build.NativeError):
        build.build("float32")


def test_a_file_where_the_folder_should_be(folder):
    folder.write_text("")
    with pytest.raises(build.NativeError, match="no folder"):
        build.build("float32")


NO_HOME = """
import os, pwd, warnings
for name in ("HOME", "XDG_CACHE_HOME", "JAXVR_CACHE"):
    os.environ.pop(name, None)
def nobody(*_): raise KeyError("no entry")
pwd.getpwuid = nobody
import jaxvr
with warnings.catch_warnings(record=True) as told:
    warnings.simplefilter("always")
    mesh = jaxvr.datasets.box((1, 1, 1), field=lambda p: p[:, 0])
    view = jaxvr.Camera.orbit(mesh, width=4, height=4), jaxvr.default_transfer(mesh)
    jaxvr.render(mesh, *view), jaxvr.render(mesh, *view)
print(len([t for t in told if issubclass(t.category, RuntimeWarning)]), jaxvr.native.missing())
"""


def test_no_home_ends_in_a_picture_and_one_warning(folder, tmp_path):
    environment = os.environ | {"TMPDIR": str(tmp_path)}
    run = [sys.executable, "-c", NO_HOME]
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run(run, env=environment, cwd=root, capture_output=True, text=True)
    assert done.stdout.split() == ["1", "None"], done.stdout + done.stderr


@pytest.mark.parametrize("relative", ["cache", "./cache", "../cache", "~/cache", ""])
def test_a_relative_cache_folder_is_passed_over(monkeypatch, tmp_path, relative):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.delenv("LOCALAPPDATA", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", relative)
    assert cache.default_folder() == (tmp_path / "home/.cache/jaxvr", None)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache.default_folder() == (tmp_path / "xdg/jaxvr", None)


@pytest.mark.parametrize("blank", ["", " ", "\t \n"])
def test_a_blank_name_of_the_folder_is_none(monkeypatch, tmp_path, blank):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "caches"))
    monkeypatch.delenv("LOCALAPPDATA", raising=False)
    monkeypatch.setenv("JAXVR_CACHE", blank)
    assert build.cache_folder() == (tmp_path / "caches" / "jaxvr", None)


@pytest.mark.parametrize("home", [None, "here"])
def test_the_working_folder_is_no_place_for_libraries(monkeypatch, tmp_path, home):
    def nobody(*_):
        raise KeyError("no entry")

    for name in ("HOME", "LOCALAPPDATA", "XDG_CACHE_HOME", "JAXVR_CACHE", "TMPDIR", "TEMP", "TMP"):
        monkeypatch.delenv(name, raising=False)
    if home:
        monkeypatch.setenv("HOME", home)
    monkeypatch.setattr("pwd.getpwuid", nobody)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))  # what `tempfile` ends up with
    with pytest.raises(FileNotFoundError):
        cache.default_folder()
    with pytest.raises(build.NativeError, match="neither a home folder"):
        build.build("float32")
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setenv("TMPDIR", str(tmp_path))  # unless somebody says so
    assert cache.default_folder()[0].parent == tmp_path


def test_a_tilde_in_the_name_of_the_folder(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("JAXVR_CACHE", "~/libraries")
    assert build.cache_folder() == (tmp_path / "libraries", None)
    monkeypatch.setenv("JAXVR_CACHE", "~nobody-of-this-name/libraries")
    with pytest.raises(build.NativeError):
        build.build("float32")
    build._depends()  # nor does this let a RuntimeError out
