"""What the machine can do, and how much of it a render uses.

    python -m experiments.limits bluntfin.vtu oxygen_post.vtu [--json F]

Measures on all cores: bytes a second from memory in order (a sum of two arrays into a third), cache
lines a second from random places of an array far larger than the caches, and float32 operations a
second (a product of matrices). Then, for each mesh at 512 x 512: cells on a ray, nanoseconds for a
cell and core, and from what a step has to fetch and to compute (`BYTES`, `LINES`, `OPERATIONS`) the
shares of the three that the render runs at. A share of lines above 1 says that most of what a step
fetches is in the caches still, from the rays beside it.
"""

from __future__ import annotations

import argparse
import os
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxvr
from experiments.common import camera_of, median_of, read_volume, table, transfer_of, write_json

# Of one step in float32: a word of `neighbors`, one of `cells` and a vertex with its scalar, each
# from a place of its own. Additions and multiplications, counted in jaxvr/native/src: vertex into
# the ray's frame 56, three edges 27, exit and crossing 44; cut 40, five nodes 135, compositing 70.
BYTES, LINES, OPERATIONS = 24, 3, 372


def _on_all_cores(work: Any, parts: list[Any]) -> float:
    """Median seconds of `work` on all parts at once."""
    seconds = []
    with ThreadPoolExecutor(len(parts)) as pool:
        for _ in range(5):
            start = time.perf_counter()
            list(pool.map(work, parts))
            seconds.append(time.perf_counter() - start)
    return float(np.median(seconds))


def machine_rates(size: int = 1 << 24) -> dict[str, float]:
    """GB/s in order, million random lines/s, and GFLOP/s in float32, with arrays of `size`."""
    cores = os.cpu_count() or 1
    arrays = [tuple(np.ones(size, np.float32) for _ in range(3)) for _ in range(cores)]
    streamed = _on_all_cores(lambda x: np.add(x[0], x[1], out=x[2]), arrays)
    rng = np.random.default_rng(0)
    lines = np.ones(4 * size, np.float32)
    picks = [16 * rng.integers(0, size // 4, size // 16) for _ in range(cores)]
    random = _on_all_cores(lambda rows: np.take(lines, rows, mode="clip"), picks)
    side = min(2048, int(size**0.5))
    matrix = jnp.ones((side, side), jnp.float32)
    product = jax.jit(lambda x: x @ x)
    multiplied = median_of({"product": lambda: product(matrix)}, 5, quiet=True)["product"]
    return {
        "gigabytes": cores * 3 * 4 * size / streamed / 1e9,
        "megalines": cores * (size // 16) / random / 1e6,
        "gigaflops": 2 * side**3 / multiplied / 1e9,
    }


def run(volume: jaxvr.TetMesh, name: str, size: int, rates: dict[str, float], repeat: int = 5):
    camera, transfer = camera_of(volume, size), transfer_of(volume)
    segments = jaxvr.trace(volume, camera)
    nodes = np.diff(np.asarray(segments.start))
    hit = nodes[nodes > 0]
    tasks = {"render": lambda: jaxvr.render(volume, camera, transfer)}
    seconds = median_of(tasks, repeat, quiet=True)["render"]
    rate = segments.count / seconds
    return {
        "mesh": name,
        "tets": volume.n_tets,
        "rays that hit": f"{len(hit) / nodes.size:.0%}",
        "cells a ray": float(hit.mean()) if len(hit) else 0.0,
        "most": int(nodes.max()),
        "seconds": seconds,
        "ns a cell and core": 1e9 * (os.cpu_count() or 1) / rate,
        "of bandwidth": rate * BYTES / (1e9 * rates["gigabytes"]),
        "of lines": rate * LINES / (1e6 * rates["megalines"]),
        "of flops": rate * OPERATIONS / (1e9 * rates["gigaflops"]),
    }


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("meshes", nargs="*", type=Path, help="none: a small box")
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--tiny", action="store_true")
    options = parser.parse_args(arguments)
    size, repeat = (16, 1) if options.tiny else (options.size, 5)
    rates = machine_rates(1 << 14 if options.tiny else 1 << 24)
    print(table([rates]), flush=True)
    rows = []
    for path in options.meshes or [None]:
        name = path.stem if path else "box"
        rows.append(run(read_volume(path), name, size, rates, repeat))
    print(table(rows), flush=True)
    report = {"machine": rates, "meshes": rows}
    if options.json:
        write_json(options.json, report)
    return report


if __name__ == "__main__":
    main()
