"""The processes that read and write files for this one: started when needed, kept for a while.

At most `MOST` work at a time, whatever the number of threads; the others wait. A process that is
idle for two minutes ends by itself, and all end with this one. One that a file ended (a crash of
the reader, memory, time) is told as such, and the next file gets a new one.

Inside of an application that is no Python (`interpreter.python` finds none) there is nothing to
start: files are read and written here then, one at a time, without limits, and a warning says so.
"""

from __future__ import annotations

import atexit
import dataclasses
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

from jaxvr._core.interpreter import python
from jaxvr._core.warn import warn

from . import child
from .content import Trouble

MOST = 4
KEPT = 2  # idle ones
_CHILD = Path(child.__file__)


class _Pool:
    def __init__(self) -> None:
        self.pid = os.getpid()
        self.idle: list[subprocess.Popen[bytes]] = []
        self.lock = threading.Lock()
        self.places = threading.BoundedSemaphore(MOST)


_pool = _Pool()


class Unguarded(UserWarning):
    """Files are read in the caller's process, see `process`."""


_here = threading.Lock()
_warned = False


def _run_here(job: str, arguments: dict[str, Any]) -> Any:
    """An answer as of a process of its own, from this one."""
    global _warned
    if not _warned:
        _warned = True
        warn(
            f"Files are read and written inside of {sys.executable or 'this program'}, which is no "
            "Python that could be started: limits of memory and time do not hold, what readers "
            "print goes to its streams, and a file that crashes a reader ends it. "
            "multiprocessing.set_executable(path of a Python with jaxvr's packages) mends that.",
            Unguarded,
        )
    if "ask" in arguments:
        arguments["ask"] = dataclasses.replace(arguments["ask"], alone=False)
    with _here:
        return child.work(job, arguments, _nothing_said)


def _nothing_said() -> str:
    return ""


def _start(program: str) -> subprocess.Popen[bytes]:
    window = getattr(subprocess, "CREATE_NO_WINDOW", 0)  # Windows opens one otherwise
    return subprocess.Popen(
        [program, "-I", "-W", "ignore", str(_CHILD)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        creationflags=window,
    )


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()
    for stream in (process.stdin, process.stdout):
        try:
            if stream is not None:
                stream.close()
        except OSError:
            pass  # what was not written any more


@atexit.register
def _end_all() -> None:
    if _pool.pid == os.getpid():
        while _pool.idle:
            _end(_pool.idle.pop())


def _forked() -> None:
    """In a forked process: the pipes and processes are the other's. Nothing is flushed there."""
    global _pool
    idle, _pool = _pool.idle, _Pool()
    for process in idle:
        for stream in (process.stdin, process.stdout):
            if stream is not None:
                stream.close()
        process.returncode = 0  # not to be waited for here


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forked)


def run(job: str, memory: int | None, seconds: float | None, **arguments: Any) -> Any:
    """What the function `job` of `jobs` returns for these arguments. Raises Trouble.

    memory: bytes that it may take; seconds: of computing.
    """
    global _pool
    if _pool.pid != os.getpid():  # forked: the pipes are another's
        _pool = _Pool()
    pool = _pool
    program = python()
    if program is None:
        answer = _run_here(job, arguments)
        if answer[0] == "trouble":
            raise Trouble(*answer[1:])
        return answer[1]
    settings = {"path": sys.path, "memory": memory, "seconds": seconds}
    with pool.places:
        for tries_left in (1, 0):  # an idle one may have ended meanwhile
            with pool.lock:
                process = pool.idle.pop() if pool.idle and tries_left else None
            fresh = process is None
            process = _start(program) if process is None else process
            whole = taken = False
            try:
                assert process.stdin is not None and process.stdout is not None
                child.send(process.stdin, (job, arguments, settings))
                taken = process.stdout.read(1) == child.TAKEN
                if taken:
                    answer = child.receive(process.stdout)
                    whole = answer[:2] != ("trouble", "large")  # it may be short of more
                    break
                raise EOFError
            except (EOFError, OSError):
                if taken:
                    raise _gone(process) from None
                if fresh:
                    raise _not_started(process) from None
            finally:
                with pool.lock:
                    keep = whole and len(pool.idle) < KEPT
                    if keep:
                        pool.idle.append(process)
                if not keep:
                    _end(process)
    if answer[0] == "trouble":
        raise Trouble(*answer[1:])
    return answer[1]


def _not_started(process: subprocess.Popen[bytes]) -> Trouble:
    try:
        code = f" (exit code {process.wait(timeout=10)})"
    except subprocess.TimeoutExpired:
        code = ""
    return Trouble("system", f"Python could not be started to read files{code}.")


def _gone(process: subprocess.Popen[bytes]) -> Trouble:
    """Why a process that had taken a request is not there any more."""
    try:
        code = process.wait(timeout=10)
    except subprocess.TimeoutExpired:
        return Trouble("system", "The process that reads files does not answer.")
    if -code in (getattr(signal, "SIGXCPU", 0), getattr(signal, "SIGPROF", 0)) and code:
        return Trouble("slow", "")
    if code in (-signal.SIGABRT, -getattr(signal, "SIGKILL", 9)):  # C++'s std::bad_alloc aborts
        return Trouble("large", "")
    return Trouble("crashed", f"the reader crashed (exit code {code})")
