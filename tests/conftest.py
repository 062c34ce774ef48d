"""A strict session: warnings are errors, no silent rank promotion, both precisions."""

from __future__ import annotations

import atexit
import gc
import os
import shutil
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")
# One thread compiles a function: with a worker on each core, dividing the work only costs.
os.environ["XLA_FLAGS"] = " ".join(
    ("--xla_cpu_parallel_codegen_split_count=1", os.environ.get("XLA_FLAGS", ""))
)
# Without LLVM's optimiser (see the Makefile), XLA's emitters by way of MLIR take half of the time.
# There are older ones until jaxlib 0.10. (A flag that XLA does not know ends the process.)
if "--xla_backend_optimization_level=0" in os.environ["XLA_FLAGS"]:
    if version("jaxlib").startswith(("0.7.", "0.8.", "0.9.", "0.10.")):
        os.environ["XLA_FLAGS"] += " --xla_cpu_use_fusion_emitters=false"
# What one process of a run has compiled, the others need not: the workers of pytest-xdist, the
# processes that tests start, and tests that clear JAX's own caches. The folder lives as long as the
# run, and its files' talk of processors, which nobody asked for, is switched off.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    os.environ["JAX_COMPILATION_CACHE_DIR"] = folder = tempfile.mkdtemp(prefix="jaxvr-tests-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")
# Where Python is told to leave no byte code beside sources, each process of a run compiles those of
# JAX anew when it imports them: 1.2 s of 1.9. It lies in a folder of the run's then.
if sys.dont_write_bytecode:
    sys.dont_write_bytecode = False
    sys.pycache_prefix = tempfile.mkdtemp(prefix="jaxvr-tests-code-")
    atexit.register(shutil.rmtree, sys.pycache_prefix, ignore_errors=True)
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    os.environ["PYTHONPYCACHEPREFIX"] = sys.pycache_prefix
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import jax
import outside
import pytest
import schedule
from rooms import *  # noqa: F403 (hooks of pytest)
from stand_ins import file_of  # noqa: F401 (a fixture)

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")

MANY_MAPS = 40_000

# Tracing makes millions of small objects, few of them garbage: by default a quarter of the time of
# all tests goes into looking through them.
gc.set_threshold(200_000, 20, 50)


def pytest_configure(config):
    for other in (outside, schedule):  # their hooks have the names of those of `rooms`
        config.pluginmanager.register(other)


@pytest.fixture(autouse=True)
def free_compiled_code():
    """Compiled functions hold memory maps, of which Linux allows a process 65,530: the compiler
    crashes when there are no more. Frees them between tests once there are many."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > MANY_MAPS:
        jax.clear_caches()
        gc.collect()


@pytest.fixture(params=["float32", "float64"])
def dtype(request):
    return request.param


@pytest.fixture(scope="module")
def quick_code():
    """`render`, `render_rays`, `trace`, `shade`, `probe` and `measure_k` outside of `jit` compile
    in a third of the time: see `quick`. For modules that do not test rounding."""
    import quick

    from jaxvr._core import compiling

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiling, "OPTIONS", quick.EMITTERS | quick.UNOPTIMISED)
        yield


@pytest.fixture
def quick_jit(quick_code, monkeypatch):
    """So do functions that code of users, or `fit`, passes to `jax.jit` meanwhile."""
    import quick

    monkeypatch.setattr(jax, "jit", quick.outermost_jit)


@pytest.fixture(scope="module", params=["compiled", "jax"])
def loops(request):
    """Runs a module with compiled loops, and again with JAX's own: `native=None` is either."""
    import jaxvr.native

    missing = jaxvr.native.missing
    if request.param == "jax":
        jaxvr.native.missing = lambda dtype="float32": "switched off by this test"
    else:
        assert missing("float32") is None, missing("float32")
    jax.clear_caches()
    yield request.param
    jaxvr.native.missing = missing
    jax.clear_caches()
