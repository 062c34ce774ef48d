"""The compiled library: found in a cache, or made on this machine when it is first wanted.

C code is compiled for the processor that it will run on, against the headers of the JAX that it
will run in, which no wheel could be. It takes some seconds once; the result is kept under a name
that holds everything it depends on, and a digest of itself (see `cache`).

    JAXVR_NATIVE=0    use JAX's own loops only; asked at every call
    JAXVR_CC          the C compiler, with options; else cc, gcc or clang, else that of `ziglang`
                      (pip install ziglang; the extra `native`)
    JAXVR_CACHE       the folder for compiled libraries; else (also where it is blank) jaxvr in the
                      user's cache folder

Nothing that goes wrong here is an exception of `render`: there is a reason, one warning for it, and
JAX's loops. A library that was loaded stays for the life of the process. A reason does not: it
holds while the compiler, these variables and the folder are as they were, and for what may pass by
itself (a full disk, a compiler that hung or was killed) a minute at most.
"""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import hashlib
import importlib.util
import os
import platform
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
import warnings
from pathlib import Path
from typing import Any

import jax
import jaxlib.version

from jaxvr._core.interpreter import python
from jaxvr.native import cache

SOURCE = Path(__file__).parent / "src"
# No contraction and no reordering: exact predicates count on every rounding.
FLAGS = (
    *("-std=gnu11", "-O3", "-fPIC", "-shared", "-fvisibility=hidden"),
    *("-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math"),
)
TARGETS = ("render", "render_pull", "shade", "shade_pull", "count", "fill")
EXPORTS = tuple(f"jaxvr_{name}" for name in (*TARGETS, "listen"))
TIMEOUT = 300.0  # seconds for the compiler; it takes 7 on an idle core
AGAIN = 60.0  # seconds after which what may have passed is tried again
# What a failure depends on, beside the compiler and the folder.
ENVIRONMENT = (
    *("JAXVR_CC", "JAXVR_CACHE", "LOCALAPPDATA", "XDG_CACHE_HOME", "HOME", "PATH", "TMPDIR"),
)


class NativeError(RuntimeError):
    """There is no compiled library, and why. passing: whether it may be otherwise in a while."""

    def __init__(self, reason: str, *, passing: bool = False):
        super().__init__(reason)
        self.passing = passing


@dataclasses.dataclass(frozen=True)
class _Failure:
    reason: str
    depends: Any
    until: float


_lock = threading.RLock()  # one thread builds, the others wait for what it has built
_loaded: dict[str, Any] = {}
_failed: dict[str, _Failure] = {}
_said: set[str] = set()


def compiler() -> list[str] | None:
    """The command of a C compiler, or None. On Windows there is none: the threads' waiting and the
    aligned memory are POSIX.

    Raises:
      NativeError: if JAXVR_CC cannot be read.
    """
    if sys.platform == "win32":
        return None
    chosen = os.environ.get("JAXVR_CC", "").strip()
    if chosen:
        try:
            return shlex.split(chosen)
        except ValueError as error:
            raise NativeError(f"JAXVR_CC={chosen!r} is no command: {error}.") from error
    for name in ("cc", "gcc", "clang"):
        if path := shutil.which(name):
            return [path]
    if importlib.util.find_spec("ziglang") and (program := python()):
        return [program, "-m", "ziglang", "cc"]
    return None


def machine_flags() -> tuple[str, ...]:
    """Options for this machine's processor: all its instructions, and its widest vectors."""
    if platform.machine().lower() in ("arm64", "aarch64"):
        return ("-mcpu=native",)
    return ("-march=native", "-mprefer-vector-width=512")


def _processor() -> str:
    """What tells processors apart that share a cache folder, as in a cluster."""
    try:
        lines = Path("/proc/cpuinfo").read_text(errors="replace").splitlines()
    except OSError:
        return platform.processor() + platform.machine()
    return "".join(sorted({x for x in lines if x.startswith(("flags", "Features", "model name"))}))


def cache_folder() -> tuple[Path, str | None]:
    """Where libraries are kept, and what to say where that is no place for long."""
    chosen = os.environ.get("JAXVR_CACHE", "")
    return (Path(chosen).expanduser(), None) if chosen.strip() else cache.default_folder()


def build(dtype: str) -> Path:
    """The library for "float32" or "float64", compiled if it is not there.

    Raises:
      NativeError: without a compiler, or where it fails, whatever the failure is.
    """
    try:
        return _build(dtype)
    except NativeError:
        raise
    except OSError as error:
        raise NativeError(f"The library could not be made: {error}", passing=True) from error
    except Exception as error:  # of whatever the environment has in store
        reason = f"The library could not be made: {type(error).__name__}: {error}"
        raise NativeError(reason, passing=isinstance(error, MemoryError)) from error


def _build(dtype: str) -> Path:
    command = compiler()
    if command is None:
        raise NativeError(
            "There is no C compiler: install one, or `pip install ziglang`, which brings one."
        )
    flags = [*FLAGS, *machine_flags(), *(["-DJAXVR_DOUBLE"] if dtype == "float64" else [])]
    headers = Path(jax.ffi.include_dir())
    parts = [*command, *flags, jaxlib.version.__version__, _processor(), platform.platform()]
    key = hashlib.sha256("\0".join(parts).encode(errors="replace"))
    for file in (headers / "xla/ffi/api/c_api.h", *sorted(SOURCE.glob("*.[ch]"))):
        key.update(file.read_bytes())
    name = f"jaxvr-{dtype}-{key.hexdigest()[: cache.DIGITS]}"
    folder, remark = cache_folder()
    try:
        folder = cache.prepare(folder)
        if found := cache.find(folder, name):
            return found
        with cache.scratch(folder) as scratch:
            made = scratch / f"{name}.so"
            run = [*command, *flags, f"-I{headers}", str(SOURCE / "kernels.c")]
            _compile([*run, "-o", str(made), "-lm"], scratch, shown=shlex.join(run))
            _try(made)
            target = cache.publish(made, folder, name)
        if target.stem != f"{name}-{cache.digest_of(target)}":
            remark = f"A folder stands where a library belongs, which is now {target}: remove it."
        if remark:
            _say(remark)
        return target
    except OSError as error:
        reason = f"The library could not be made in {folder}: {error}"
        raise NativeError(reason, passing=True) from error


def _compile(run: list[str], scratch: Path, shown: str) -> None:
    """Runs the compiler, in a group of processes that is ended as a whole if it takes too long."""
    words = scratch / "words"
    with words.open("wb") as out:
        process = subprocess.Popen(
            run, stdin=subprocess.DEVNULL, stdout=out, stderr=out, start_new_session=True
        )
        try:
            code = process.wait(TIMEOUT)
        except subprocess.TimeoutExpired as error:
            reason = f"{shown} did not end in {TIMEOUT:.0f} seconds."
            raise NativeError(reason, passing=True) from error
        finally:
            if process.poll() is None:
                with contextlib.suppress(OSError):
                    os.killpg(process.pid, signal.SIGKILL)
                process.wait()
    if code:
        with words.open("rb") as file:
            file.seek(max(0, words.stat().st_size - 2000))
            said = file.read().decode(errors="replace")
        how = f"was ended by signal {-code}" if code < 0 else "failed"
        raise NativeError(f"{shown} {how}:\n{said}", passing=code < 0)


# A library that is none, or that ends whoever loads it, does so in a process of its own.
_TRIAL = "import ctypes, sys; [getattr(ctypes.CDLL(sys.argv[1]), n) for n in sys.argv[2:]]"


def _try(made: Path) -> None:
    if not made.is_file():
        raise NativeError("The C compiler said nothing, and made nothing.")
    if not (program := python()):  # inside of another program
        return
    run = [program, "-I", "-S", "-c", _TRIAL, str(made)]
    done = subprocess.run(
        [*run, *EXPORTS], stdin=subprocess.DEVNULL, capture_output=True, timeout=TIMEOUT
    )
    if done.returncode:
        last = done.stderr.decode(errors="replace").strip().rpartition("\n")[2]
        last = last.replace(str(made), "the file")
        raise NativeError(f"What the C compiler made cannot be loaded: {last or done.returncode}.")


def load(dtype: str) -> str | None:
    """Registers the library's functions with XLA. Returns None, or why there is no library."""
    if os.environ.get("JAXVR_NATIVE", "1") == "0":
        return "The environment has JAXVR_NATIVE=0."
    if dtype in _loaded:
        listen()
        return None
    with _lock:
        if dtype in _loaded:
            return None
        depends = _depends()
        known = _failed.get(dtype)
        if known and known.depends == depends and time.monotonic() < known.until:
            return known.reason
        try:
            _loaded[dtype] = _register(dtype)
            _failed.pop(dtype, None)
            listen()
            return None
        except NativeError as error:
            until = time.monotonic() + AGAIN if error.passing else float("inf")
            # Looked at again: the attempt may have made the folder.
            _failed[dtype] = _Failure(str(error), _depends(), until)
            reason = str(error)
    if sys.platform != "win32":
        _say(
            f"jaxvr uses JAX's own loops, which are slower: {reason} Set JAXVR_NATIVE=0 to silence "
            "this."
        )
    return reason


def _register(dtype: str) -> Any:
    """The library, loaded and known to XLA.

    Raises:
      NativeError: whatever goes wrong.
    """
    try:
        library = _open(build(dtype))
        if library is None:
            library = _open(build(dtype))
        if library is None:
            raise NativeError("The library that was compiled cannot be loaded.")
        for name in TARGETS:
            capsule = jax.ffi.pycapsule(getattr(library, f"jaxvr_{name}"))
            jax.ffi.register_ffi_target(target_name(name, dtype), capsule, platform="cpu")
        return library
    except NativeError:
        raise
    except Exception as error:
        reason = f"The library cannot be used: {type(error).__name__}: {error}"
        raise NativeError(reason) from error


def _open(file: Path) -> Any:
    """A library with all that it must have; else None, and the file is gone."""
    try:
        library = ctypes.CDLL(str(file))
        for name in EXPORTS:
            getattr(library, name)
        return library
    except (OSError, AttributeError):
        cache.remove(file)
        return None


def _depends() -> Any:
    """What a failure depends on: as long as it is equal, another try would end the same."""
    environment = tuple(os.environ.get(name) for name in ENVIRONMENT)
    try:
        command = compiler()
        tool = shutil.which(command[0]) if command else None
        made = os.stat(tool).st_mtime_ns if tool else None
    except (NativeError, OSError, IndexError):
        tool = made = None
    try:
        folder = cache_folder()[0]
        status = folder.stat()
        place = (status.st_mode, status.st_uid, os.access(folder, os.W_OK))
    except (OSError, ValueError, RuntimeError):  # RuntimeError: a ~ of no user
        place = None
    return environment, tool, made, place


def _say(message: str) -> None:
    """A warning, once for each reason."""
    # The two precisions fail alike, and names of scratch folders are never the same.
    kind = re.sub(rf"{cache.SCRATCH}\w+", "", message.replace(" -DJAXVR_DOUBLE", ""))
    kind = re.sub(r"jaxvr-float(32|64)-\w+", "", kind)
    with _lock:
        if kind in _said:
            return
        _said.add(kind)
    warnings.warn(message, RuntimeWarning, stacklevel=3)


def listen() -> None:
    """Whether Ctrl-C ends the compiled loops: if it is a KeyboardInterrupt, and not what a
    handler of the program's own makes of it, which may want to finish."""
    yes = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    for library in list(_loaded.values()):
        library.jaxvr_listen(int(yes))


def target_name(name: str, dtype: str) -> str:
    return f"jaxvr_{name}_{dtype}"
