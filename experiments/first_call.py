"""Seconds and memory of a process that reads a mesh and makes its first picture.

    python -m experiments.first_call bluntfin.vtu --size 512 [--task gradient] [--cache FOLDER]

prints one line of JSON. `experiments.speed` starts it, since a first call happens once a process:
with an empty folder for the compile cache it is cold, and with the same folder again it is warm.
Seconds run from when jaxvr is imported and the mesh is read until the picture is there, with the
camera and the transfer function in them. Tasks: `render`; `gradient`, value and gradient with
respect to the transfer function; `vtk`, the first picture of VTK's ray caster (extra `peers`; its
grid is made before).

Memory is what the system counts as resident: at the start, when the mesh is read, and the highest
until then and after. Linux only, and from /proc/self/status: `ru_maxrss` of a child starts with the
size of the process that started it.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

import jaxvr
from experiments.common import POINTS, camera_of, read_volume, transfer_of
from experiments.peers import Vtk

ROOT = Path(__file__).resolve().parent.parent


def use_cache(folder: Any) -> None:
    """All compiled functions go to and come from a folder, however small they are."""
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def resident() -> dict[str, int]:
    """Bytes that the process has in memory, `now` and at its `peak`; empty where unknown."""
    status = Path("/proc/self/status")
    if not status.exists():
        return {}
    numbers = dict(line.split(":", 1) for line in status.read_text().splitlines() if ":" in line)
    return {
        name: 1024 * int(numbers[key].split()[0])
        for name, key in (("now", "VmRSS"), ("peak", "VmHWM"))
        if key in numbers
    }


def forget_peak() -> None:
    """Starts a new peak, where the system allows that."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        pass


def first(path: Any, size: int, points: int, task: str, threads: int) -> dict[str, Any]:
    """Measures in this process, which should have done nothing before."""
    at_start = resident()
    begin = time.perf_counter()
    mesh = read_volume(path)
    jax.block_until_ready(mesh)
    read, after_reading = time.perf_counter() - begin, resident()
    vtk = None
    if task == "vtk":
        vtk = Vtk(mesh, threads)
        vtk.show(camera_of(mesh, size), transfer_of(mesh, points))
    before = resident()
    forget_peak()
    begin = time.perf_counter()
    if vtk is not None:
        vtk.draw()
    else:
        camera, transfer = camera_of(mesh, size), transfer_of(mesh, points)
        if task == "render":
            out = jaxvr.render(mesh, camera, transfer)
        else:
            loss = jax.value_and_grad(lambda t, m, c: jnp.sum(jaxvr.render(m, c, t) ** 2))
            out = jax.jit(loss)(transfer, mesh, camera)
        jax.block_until_ready(out)
    seconds, after = time.perf_counter() - begin, resident()
    result: dict[str, Any] = {"task": task, "tets": mesh.n_tets, "size": size, "points": points}
    result |= {"read_seconds": read, "seconds": seconds}
    if after:
        result |= {
            "rss_start": at_start["now"],
            "rss_read": after_reading["now"],
            "peak_read": after_reading["peak"],
            "rss_before": before["now"],
            "peak_after": after["peak"],
            "peak": max(before["peak"], after["peak"]),
        }
    return result


def in_process(
    path: Any, size: int, task: str, *, points: int = POINTS, cache: Any = None, threads: int = 2
) -> dict[str, Any]:
    """`first` in a fresh process. cache: a folder for what XLA and the C compiler make; None
    compiles all, as on a machine that has never seen jaxvr."""
    command = [sys.executable, "-m", "experiments.first_call", "--task", task]
    command += ["--size", str(size), "--points", str(points), "--threads", str(threads)]
    command += [str(Path(path).resolve())] if path is not None else []
    command += ["--cache", str(cache)] if cache is not None else []
    with tempfile.TemporaryDirectory() as empty:
        environment = os.environ | {"JAXVR_CACHE": str(empty if cache is None else cache)}
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=environment)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command[1:])} failed:\n{done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("mesh", type=Path, nargs="?", help="as for speed; none: a small box")
    parser.add_argument("--task", choices=("render", "gradient", "vtk"), default="render")
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--points", type=int, default=POINTS)
    parser.add_argument("--threads", type=int, default=2, help="of VTK")
    parser.add_argument("--cache", type=Path, help="folder of compiled functions")
    options = parser.parse_args(arguments)
    if options.cache is not None:
        use_cache(options.cache)
    result = first(options.mesh, options.size, options.points, options.task, options.threads)
    print(json.dumps(result))
    return result


if __name__ == "__main__":
    main()
