"""The compiled library: found in a cache, or made on this machine when it is first wanted.

C code is compiled for the processor that it will run on, against the headers of the JAX that it
will run in, which no wheel could be. It takes some seconds once; the result is kept under a name
that holds everything it depends on.

    JAXVR_NATIVE=0    use JAX's own loops only
    JAXVR_CC          the C compiler, with options; else cc, gcc or clang, else that of `ziglang`
                      (the extra `native`: pip install 'jaxvr[native]')
    JAXVR_CACHE       the folder for compiled libraries; else jaxvr in the user's cache folder
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import importlib.util
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
import warnings
from importlib.metadata import version
from pathlib import Path

import jax

SOURCE = Path(__file__).parent / "src"
# No contraction and no reordering: exact predicates count on every rounding.
FLAGS = (
    *("-std=gnu11", "-O3", "-fPIC", "-shared", "-fvisibility=hidden"),
    *("-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math"),
)
TARGETS = ("render", "render_pull", "shade", "shade_pull", "count", "fill")


class NativeError(RuntimeError):
    """There is no compiled library, and why."""


def compiler() -> list[str] | None:
    """The command of a C compiler, or None. On Windows there is none: the threads' waiting and the
    aligned memory are POSIX."""
    if sys.platform == "win32":
        return None
    chosen = os.environ.get("JAXVR_CC")
    if chosen:
        return shlex.split(chosen)
    for name in ("cc", "gcc", "clang"):
        if path := shutil.which(name):
            return [path]
    if importlib.util.find_spec("ziglang"):
        return [sys.executable, "-m", "ziglang", "cc"]
    return None


def machine_flags() -> tuple[str, ...]:
    """Options for this machine's processor: all its instructions, and its widest vectors."""
    if platform.machine().lower() in ("arm64", "aarch64"):
        return ("-mcpu=native",)
    return ("-march=native", "-mprefer-vector-width=512")


def _processor() -> str:
    """What tells processors apart that share a cache folder, as in a cluster."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() + platform.machine()
    return "".join(sorted({x for x in lines if x.startswith(("flags", "Features", "model name"))}))


def cache_folder() -> Path:
    chosen = os.environ.get("JAXVR_CACHE")
    if chosen:
        return Path(chosen)
    home = os.environ.get("LOCALAPPDATA") or os.environ.get("XDG_CACHE_HOME")
    return (Path(home) if home else Path.home() / ".cache") / "jaxvr"


def build(dtype: str) -> Path:
    """The library for "float32" or "float64", compiled if it is not there.

    Raises:
      NativeError: without a compiler, or where it fails.
    """
    command = compiler()
    if command is None:
        raise NativeError(
            "There is no C compiler: install one, or `pip install 'jaxvr[native]'` for ziglang's."
        )
    sources = sorted(SOURCE.iterdir())
    flags = [*FLAGS, *machine_flags(), *(["-DJAXVR_DOUBLE"] if dtype == "float64" else [])]
    parts = [*command, *flags, version("jaxlib"), _processor(), platform.platform()]
    digest = hashlib.sha256("\0".join(parts).encode())
    for file in sources:
        digest.update(file.read_bytes())
    folder = cache_folder()
    target = folder / f"jaxvr-{dtype}-{digest.hexdigest()[:20]}.so"
    if target.exists():
        return target
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as scratch:
            made = Path(scratch) / target.name
            run = [*command, *flags, f"-I{jax.ffi.include_dir()}", str(SOURCE / "kernels.c")]
            done = subprocess.run([*run, "-o", str(made), "-lm"], capture_output=True, text=True)
            if done.returncode:
                raise NativeError(f"{shlex.join(run)} failed:\n{done.stderr[-2000:]}")
            os.replace(made, target)  # at once, so that processes may build side by side
    except OSError as error:
        raise NativeError(f"The library could not be made in {folder}: {error}") from error
    return target


@functools.cache
def load(dtype: str) -> str | None:
    """Registers the library's functions with XLA. Returns None, or why there is no library."""
    if os.environ.get("JAXVR_NATIVE", "1") == "0":
        return "The environment has JAXVR_NATIVE=0."
    try:
        library = ctypes.CDLL(str(build(dtype)))
    except (NativeError, OSError) as error:
        if compiler() is not None:
            warnings.warn(
                f"jaxvr uses JAX's own loops, which are slower: {error} Set JAXVR_NATIVE=0 to "
                "silence this.",
                RuntimeWarning,
                stacklevel=2,
            )
        return str(error)
    for name in TARGETS:
        capsule = jax.ffi.pycapsule(getattr(library, f"jaxvr_{name}"))
        jax.ffi.register_ffi_target(target_name(name, dtype), capsule, platform="cpu")
    return None


def target_name(name: str, dtype: str) -> str:
    return f"jaxvr_{name}_{dtype}"
