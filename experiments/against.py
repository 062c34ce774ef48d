"""One checkout against another: CPU time of the same tasks, taking turns.

    python -m experiments.against FOLDER [--pairs 21] [--size 512] [--engine C] [--first] [MESH ...]

FOLDER is another checkout of this repository; each of the two has a process of its own, and these
are asked for one task at a time, in an order that alternates. Told is, for each task, the median
over pairs of the ratio of CPU times, this checkout's to the other's, with quartiles, and the median
time itself. CPU time counts all threads, and is less moved by other work than wall time is.

Tasks: `render`; value and gradient by transfer function, values, points and camera; `trace`;
`shade`, and its value and gradient by the transfer function, which is an iteration of a fit.
--first tells of each task's first call instead, once: what compiling takes.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common import table
from experiments.data import meshes_of

HERE = Path(__file__).resolve().parents[1]

WORKER = """
import json, sys, time, warnings
import jax, jax.numpy as jnp, numpy as np
import jaxvr

warnings.simplefilter("ignore")
path, size, engine = sys.argv[1], int(sys.argv[2]), sys.argv[3]
mesh = jaxvr.read_mesh(path)
camera = jaxvr.Camera.orbit(mesh, width=size, height=size)
transfer = jaxvr.default_transfer(mesh)
if hasattr(jaxvr, "engine"):
    how = trace_how = {"engine": getattr(jaxvr.engine, engine)()}
else:
    how = {"adjoint": jaxvr.Replay(native=engine == "C")}
    trace_how = {"native": engine == "C"}

def loss(transfer, values, points, camera):
    volume = mesh.replace(values=values, points=points)
    return (jaxvr.render(volume, camera, transfer, **how) ** 2).mean()

arguments = transfer, mesh.values, mesh.points, camera
grads = [jax.jit(jax.value_and_grad(loss, argnums=k, allow_int=True)) for k in range(4)]

def loss_of_shade(transfer, segments):
    return (jaxvr.shade(segments, transfer, **how) ** 2).mean()

shaded = jax.jit(jax.value_and_grad(loss_of_shade))
kept = []

def segments():
    if not kept:
        kept.append(jaxvr.trace(mesh, camera, **trace_how))
    return kept[0]

tasks = {
    "render": lambda: jaxvr.render(mesh, camera, transfer, **how),
    "by transfer": lambda: grads[0](*arguments),
    "by values": lambda: grads[1](*arguments),
    "by points": lambda: grads[2](*arguments),
    "by camera": lambda: grads[3](*arguments),
    "trace": lambda: jaxvr.trace(mesh, camera, **trace_how).scalar,
    "shade": lambda: jaxvr.shade(segments(), transfer, **how),
    "shade, by transfer": lambda: shaded(transfer, segments()),
}
print(json.dumps(list(tasks)), flush=True)
for line in sys.stdin:
    name = line.strip()
    if name.startswith("shade"):
        segments()
    start = time.process_time()
    jax.block_until_ready(tasks[name]())
    print(time.process_time() - start, flush=True)
"""


class Checkout:
    """A process that imports the package of a folder."""

    def __init__(self, folder: Path, mesh: Path, size: int, engine: str):
        environment = os.environ | {"PYTHONPATH": str(folder), "TF_CPP_MIN_LOG_LEVEL": "3"}
        self.process: Any = subprocess.Popen(
            [sys.executable, "-P", "-c", WORKER, str(mesh), str(size), engine],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=folder,
            env=environment,
        )
        self.tasks = json.loads(self.process.stdout.readline())

    def seconds(self, task: str) -> float:
        self.process.stdin.write(task + "\n")
        self.process.stdin.flush()
        return float(self.process.stdout.readline())

    def close(self) -> None:
        with self.process:
            self.process.stdin.close()


def compare(
    here: Path,
    there: Path,
    mesh: Path,
    size: int,
    engine: str,
    pairs: int,
    first: bool = False,
    tasks: list[str] | None = None,
) -> list[dict[str, Any]]:
    """Rows of the table, one a task."""
    both = [Checkout(folder, mesh, size, engine) for folder in (here, there)]
    rows = []
    for task in tasks or both[0].tasks:
        cold = [one.seconds(task) for one in both]
        if first:
            rows.append({"task": task, "ratio": cold[0] / cold[1], "seconds": cold[0]})
            continue
        times = []
        for pair in range(pairs):
            order = (0, 1) if pair % 2 else (1, 0)
            found = {k: both[k].seconds(task) for k in order}
            times.append((found[0], found[1]))
        new, old = np.array(times).T
        low, middle, high = np.percentile(new / old, [25, 50, 75])
        rows.append(
            {
                "task": task,
                "ratio": float(middle),
                "quartiles": f"{low:.3f} {high:.3f}",
                "seconds": float(np.median(new)),
            }
        )
    for one in both:
        one.close()
    return rows


def main(argv: list[str] | None = None) -> list[dict[str, Any]]:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("meshes", nargs="*", default=["bluntfin", "oxygen_post"])
    parser.add_argument("--pairs", type=int, default=21)
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--engine", choices=["C", "XLA"], default="C")
    parser.add_argument("--first", action="store_true")
    parser.add_argument("--tasks", nargs="*", help="some of them, by name")
    arguments = parser.parse_args(argv)
    here = HERE
    rows: list[dict[str, Any]] = []
    for name, path in meshes_of(arguments.meshes, parser).items():
        options = arguments.size, arguments.engine, arguments.pairs, arguments.first
        for row in compare(here, arguments.folder.resolve(), path, *options, arguments.tasks):
            rows.append({"mesh": name, **row})
    print(table(rows))
    return rows


if __name__ == "__main__":
    main()
