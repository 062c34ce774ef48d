"""What runs in the process that reads and writes files: one request after the other.

It is started by its path, so that the package `jaxvr`, and with it JAX, is not loaded: two empty
modules stand for `jaxvr` and `jaxvr.volume`. Standard output and error of this process are a file
in memory, in which C and C++ libraries write too, and which goes with an answer. What libraries
change here, the caller does not see.

A request and an answer are messages (`message`). Before it works on a request it says so in a byte:
a process that is gone before that may be replaced without a word, and one that is gone later was
ended by the file. Memory and time are limited where the system can (POSIX).
"""

from __future__ import annotations

import os
import pickle
import struct
import sys
from collections.abc import Callable
from typing import IO, Any

TAKEN = b"!"
IDLE_S = 120  # then the process ends by itself
SAID = 20_000  # bytes of what readers print that are kept, of the beginning and of the end


def send(stream: IO[bytes], what: Any) -> None:
    """A pickle whose arrays follow it as they are."""
    buffers: list[pickle.PickleBuffer] = []
    head = pickle.dumps(what, protocol=5, buffer_callback=buffers.append)
    views = [b.raw() for b in buffers]
    stream.write(struct.pack("<QQ", len(head), len(views)))
    stream.write(struct.pack(f"<{len(views)}Q", *(v.nbytes for v in views)))
    stream.write(head)
    for view in views:
        stream.write(view)
    stream.flush()


def receive(stream: IO[bytes]) -> Any:
    """What `send` wrote; EOFError where the stream ends before."""
    size, n = struct.unpack("<QQ", _exactly(stream, 16))
    sizes = struct.unpack(f"<{n}Q", _exactly(stream, 8 * n))
    head = _exactly(stream, size)
    return pickle.loads(head, buffers=[_exactly(stream, k) for k in sizes])


def _exactly(stream: IO[bytes], n: int) -> bytearray:
    out = bytearray(n)
    view, at = memoryview(out), 0
    while at < n:
        got = stream.readinto(view[at : at + (1 << 30)])  # type: ignore[attr-defined]
        if not got:
            raise EOFError
        at += got
    return out


def _packages() -> None:
    import types

    here = os.path.dirname(os.path.abspath(__file__))
    for name, path in (("jaxvr.volume", os.path.dirname(here)), ("jaxvr", None)):
        module = types.ModuleType(name)
        module.__path__ = [path or os.path.dirname(os.path.dirname(here))]
        sys.modules[name] = module


class _Quiet:
    """Standard output and error in a file; `take` gives what is there, and empties it."""

    def __init__(self) -> None:
        import tempfile

        if hasattr(os, "memfd_create"):
            self.fd = os.memfd_create("said")
        else:
            self.file = tempfile.TemporaryFile()
            self.fd = self.file.fileno()
        for fd in (1, 2):
            os.dup2(self.fd, fd)

    def take(self) -> str:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        size = os.lseek(self.fd, 0, os.SEEK_END)
        os.lseek(self.fd, 0, os.SEEK_SET)
        raw = os.read(self.fd, SAID)
        if size > len(raw):  # what is wrong is often said last
            os.lseek(self.fd, max(len(raw), size - SAID), os.SEEK_SET)
            raw += b"\n[...]\n" + os.read(self.fd, SAID)
        said = raw.decode("utf-8", "replace")
        os.lseek(self.fd, 0, os.SEEK_SET)
        os.ftruncate(self.fd, 0)
        return said


class _Limits:
    """Memory and time of one request, above what the process has used so far."""

    def __init__(self, memory: int | None, seconds: float | None) -> None:
        self.old: list[tuple[int, tuple[int, int]]] = []
        try:
            import resource
        except ImportError:  # Windows
            return
        self.resource = resource
        if memory is not None and (used := _address_space()) is not None:
            self._set(resource.RLIMIT_AS, used + memory)
            self._set(resource.RLIMIT_FSIZE, 64 << 20)  # what readers print is in a file in memory
        if seconds is not None:
            usage = resource.getrusage(resource.RUSAGE_SELF)
            self._set(resource.RLIMIT_CPU, int(usage.ru_utime + usage.ru_stime + seconds) + 1)

    def _set(self, what: int, value: int) -> None:
        soft, hard = self.resource.getrlimit(what)
        if soft != self.resource.RLIM_INFINITY:
            value = min(value, soft)
        self.old.append((what, (soft, hard)))
        self.resource.setrlimit(what, (value, hard))

    def lift(self) -> None:
        for what, old in self.old:
            self.resource.setrlimit(what, old)


def _address_space() -> int | None:
    try:
        with open("/proc/self/statm") as f:
            return int(f.read().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError):
        return None  # macOS does not keep to such a limit anyway


def main() -> None:
    import signal
    import threading
    import time

    stdin, stdout = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    said = _Quiet()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the caller's Ctrl-C ends the caller's wait
    _packages()
    state = {"busy": False, "since": time.monotonic()}

    def watch() -> None:
        while True:
            time.sleep(IDLE_S / 4)
            if not state["busy"] and time.monotonic() - state["since"] > IDLE_S:
                os._exit(0)

    threading.Thread(target=watch, daemon=True).start()
    while True:
        failed = ""
        try:
            name, arguments, settings = receive(stdin)
        except EOFError:
            os._exit(0)
        except Exception as e:  # of classes that are not known here
            name, arguments, settings = "", {}, {"path": sys.path}
            failed = f"an argument cannot be passed on to where files are read: {e!r}"
        state["busy"] = True
        stdout.write(TAKEN)
        stdout.flush()
        sys.path[:] = settings["path"]
        if failed:
            answer = "trouble", "asked", failed
        else:
            answer = _answer(name, arguments, settings, said)
        try:
            send(stdout, answer)
        except (BrokenPipeError, OSError):
            os._exit(0)
        state.update(busy=False, since=time.monotonic())


def _answer(name: str, arguments: dict[str, Any], settings: dict[str, Any], said: _Quiet) -> Any:
    """As `work`, within the limits that the settings say."""
    limits = None
    try:
        said.take()
        limits = _Limits(settings["memory"], settings["seconds"])
        return work(name, arguments, said.take)
    except MemoryError:
        return "trouble", "large", ""
    finally:
        if limits is not None:
            limits.lift()


def work(name: str, arguments: dict[str, Any], said: Callable[[], str]) -> Any:
    """("done", result) or ("trouble", kind, message) of a function of `jobs`."""
    try:
        from jaxvr.volume.io import jobs

        return "done", getattr(jobs, name)(said=said, **arguments)
    except KeyboardInterrupt:
        raise
    except MemoryError:
        return "trouble", "large", ""
    except ImportError as e:
        name = (e.name or str(e)).partition(".")[0]
        return "trouble", "package", f"it takes the package {name}: pip install {name}"
    except OSError as e:
        return "trouble", "system", f"{e.errno or 0}:{e.strerror or e}"
    except BaseException as e:  # readers raise anything, SystemExit included
        if hasattr(e, "kind") and type(e).__name__ == "Trouble":
            return "trouble", e.kind, e.message  # type: ignore[attr-defined]
        return "trouble", "damaged", f"{type(e).__name__}: {' '.join(str(e).split())[:300]}"


if __name__ == "__main__":
    main()
