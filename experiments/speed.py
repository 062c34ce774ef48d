"""Seconds and memory of all that jaxvr does with a mesh, beside VTK's ray caster.

    python tools/refine_hex.py oxygen_post.vtu post_x2.npz --n 2 --fields speed --tets
    python -m experiments.speed bluntfin.vtu oxygen_post.vtu post_x2.npz --json F --markdown F

The first line comes with the test data and makes the oxygen post with 4.9 million tets; an .npz has
points, tets and a field. The second takes all measures, which are

    runs       tasks that take turns, one after the other, in one process; medians. At 512 x 512 and
               11 control points: VTK (see `peers`), render, value_and_grad with respect to each
               class of parameters, trace, shade, and an iteration of a fit. At the other sizes, and
               at 512 x 512 with the other numbers of control points: VTK, render and shade. Before
               a run, its images are compared with jaxvr's `Quadrature`, which is the truth here.
    scaling    the render of all meshes, taking turns: what more tets cost.
    processes  first calls, without a compile cache and with a warm one, and the highest memory at
               the largest size: each in a process of its own (see `first_call`).
    bytes      of the mesh and of what XLA reserves to render it, for each tet (see `memory`).

jaxvr runs in float32 with `Analytic` and all cores, VTK in its own double precision on `--threads`
threads. The result is printed, with the targets and whether they are met. `--only` takes words:
tasks whose names contain one of them (render always), or `scaling`, `first`, `memory`, `bytes`.
With `--jax-loop`, the loop in plain JAX is timed beside the native kernel. `--cross` takes all
sizes with all numbers of control points.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxvr
from experiments import speed_tables
from experiments.common import (
    POINTS,
    camera_of,
    machine,
    median_of,
    read_volume,
    seconds_of,
    transfer_of,
    write_json,
)
from experiments.first_call import in_process
from experiments.memory import bytes_per_tet
from experiments.peers import Vtk
from experiments.speed_tables import FIT, RENDER, SHADE, VTK
from jaxvr.fit.batches import deal, gather_views, make_batches
from jaxvr.fit.fit import Objective
from jaxvr.fit.loop import Control, run
from jaxvr.fit.losses import l1
from jaxvr.fit.parameters import Parameters

__all__ = ["camera_of", "median_of", "transfer_of"]  # for other experiments

SIZE = 512
PARTS = ("scaling", "first", "memory", "bytes")  # words of `--only` that are no tasks of runs
Tasks = dict[str, Callable[[], Any]]


def gradients(mesh: Any, camera: Any, transfer: Any, **keywords: Any) -> Tasks:
    """Value and gradient of a sum of squares, compiled, for each class of parameters."""
    scenes = {
        "transfer": (transfer, lambda x, m, c, t: (m, c, x)),
        "values": (mesh.values, lambda x, m, c, t: (m.replace(values=x), c, t)),
        "points": (mesh.points, lambda x, m, c, t: (m.replace(points=x), c, t)),
        "camera": (camera.eye, lambda x, m, c, t: (m, dataclasses.replace(c, eye=x), t)),
    }

    def task(x, scene):
        def loss(x, *rest):
            return jnp.sum(jaxvr.render(*scene(x, *rest), **keywords) ** 2)

        compiled = jax.jit(jax.value_and_grad(loss))
        return lambda: compiled(x, mesh, camera, transfer)

    return {f"value_and_grad, {name}": task(*scene) for name, scene in scenes.items()}


def fit_iteration(segments: Any, transfer: Any, image: Any) -> Callable[[], Any]:
    """One iteration of `jaxvr.fit` on the cached segments of one view, of all its rays.

    It is the loop of `fit` itself, for one iteration from the start: loss and gradient (L1, of
    colours and extinctions behind their transforms), the step of Adam, and the checks of both.
    """
    views = gather_views(
        *(None, [segments], [0.5 * image]), cache=True, tracer=None, background=None
    )
    batches, _ = make_batches(views, deal(views, None, None, 0))
    parameters = Parameters.of(transfer)
    unit = jnp.mean(transfer.extinctions)
    inputs = parameters, unit, None, None, batches[0], np.zeros(2, transfer.dtype)
    nouns = jaxvr.Analytic(), jaxvr.Over(), jaxvr.Replay(), jaxvr.RayCast(), jaxvr.engine.C()
    gradient, raw = Objective(l1, *nouns).gradient, parameters.raw()
    once = Control(iterations=1, progress=False)
    rest = (1, None, 0.1, once, None, lambda n: {})
    return lambda: run(gradient, raw, lambda i: inputs, *rest).parameters


def few_tasks(mesh: Any, camera: Any, transfer: Any, segments: Any) -> Tasks:
    """What is timed at every size and number of control points, but for VTK."""
    return {
        RENDER: lambda: jaxvr.render(mesh, camera, transfer),
        SHADE: lambda: jaxvr.shade(segments, transfer),
    }


def all_tasks(mesh: Any, camera: Any, transfer: Any, segments: Any, image: Any) -> Tasks:
    """What is timed at the main ones, but for VTK."""
    by_shade = jax.jit(jax.value_and_grad(lambda t, s: jnp.sum(jaxvr.shade(s, t) ** 2)))
    few = few_tasks(mesh, camera, transfer, segments)
    return {
        RENDER: few[RENDER],
        **gradients(mesh, camera, transfer),
        "trace": lambda: jaxvr.trace(mesh, camera).scalar,
        SHADE: few[SHADE],
        "value_and_grad, shade": lambda: by_shade(transfer, segments),
        FIT: fit_iteration(segments, transfer, image),
    }


def jax_loop(mesh: Any, camera: Any, transfer: Any, segments: Any) -> Tasks:
    """The same without the native kernel."""
    loop = jaxvr.engine.XLA()
    tasks: Tasks = {
        RENDER: lambda: jaxvr.render(mesh, camera, transfer, engine=loop),
        **gradients(mesh, camera, transfer, engine=loop),
        "trace": lambda: jaxvr.trace(mesh, camera, engine=loop).scalar,
        SHADE: lambda: jaxvr.shade(segments, transfer, engine=loop),
    }
    return {f"{name}, JAX loop": task for name, task in tasks.items()}


def measure(name: str, mesh: Any, vtk: Any, segments: Any, camera: Any, points: int, options: Any):
    """One run: all tasks if this is the main scene, else VTK, render and shade."""
    size = camera.width
    transfer = transfer_of(mesh, points)
    main = size == options.size and points == options.main_points
    print(f"{name}, {mesh.n_tets:,} tets, {size} x {size}, {points} control points", flush=True)
    image = np.asarray(jaxvr.render(mesh, camera, transfer))
    scene = mesh, camera, transfer, segments
    tasks = all_tasks(*scene, image) if main else few_tasks(*scene)
    if main and options.jax_loop:
        tasks |= jax_loop(*scene)
    tasks = {n: task for n, task in tasks.items() if n == RENDER or wanted(n, options)}
    truth = np.asarray(
        jaxvr.render(mesh, camera, transfer, integrator=jaxvr.Quadrature(samples=12))
    )
    result: dict[str, Any] = {"mesh": name, "tets": mesh.n_tets, "size": size, "points": points}
    result |= {
        "main": main,
        "segments": segments.count,
        "bytes_per_segment": segments.nbytes / max(segments.count, 1),
        "error": float(np.abs(image - truth).max()),
    }
    if vtk is not None:
        vtk.show(camera, transfer)
        vtk.draw()
        result |= vtk.agreement(truth)
        tasks = {VTK: vtk.draw, **tasks}
    every = seconds_of(tasks, options.repeat)
    result["seconds"] = {n: float(np.median(s)) for n, s in every.items()}
    result["all_seconds"] = every
    return result


def wanted(name: str, options: Any) -> bool:
    return not options.only or any(word in name for word in options.only)


def scenes(options: Any) -> list[tuple[int, int]]:
    """(size, control points) of each run, the main one first, then the others of its size."""
    if options.cross:
        every = [(size, points) for size in options.sizes for points in options.points]
    else:
        every = [(size, options.main_points) for size in options.sizes]
        every += [(options.size, points) for points in options.points]
    first = (options.size, options.main_points)
    return sorted(set(every), key=lambda s: (s != first, s[0] != options.size, s))


def processes(name: str, path: Any, options: Any) -> list[dict[str, Any]]:
    """First calls and memory, each in fresh processes: medians of seconds."""
    rows = []
    keywords = {"points": options.main_points, "threads": options.threads}

    def take(task: str, size: int, folder: Any = None) -> None:
        made = [
            in_process(path, size, task, cache=folder, **keywords) for _ in range(options.processes)
        ]
        cache = "none" if folder is None else "warm"
        row = made[0] | {"mesh": name, "cache": cache}
        row["seconds"] = float(np.median([one["seconds"] for one in made]))
        rows.append(row)
        print(f"  process {task:10s} {cache:8s} {size:5d} {row['seconds']:8.2f} s", flush=True)

    for task in ("render",) if options.tiny else ("render", "gradient"):
        if not wanted("first", options):
            break
        take(task, options.size)
        with tempfile.TemporaryDirectory() as folder:
            in_process(path, options.size, task, cache=folder, **keywords)
            take(task, options.size, folder)
    largest = max(options.sizes)
    if wanted("memory", options) and not (rows and largest == options.size):
        take("render", largest)
    if options.peers:
        for size in dict.fromkeys([options.size, largest]):
            take("vtk", size)
    return rows


def measure_mesh(path: Any, options: Any) -> tuple[str, Any, dict[str, Any]]:
    """All of one mesh: its name, itself, and its part of the report."""
    name = path.stem if path is not None else "box"
    part: dict[str, Any] = {"runs": [], "processes": [], "bytes": []}
    if wanted("first", options) or wanted("memory", options):
        part["processes"] = processes(name, path, options)
    mesh = read_volume(path)
    runs = scenes(options) if not options.only or set(options.only) - set(PARTS) else []
    vtk = Vtk(mesh, options.threads) if options.peers and runs else None
    traced = None
    for size, points in runs:
        camera = camera_of(mesh, size)
        if traced is None or traced.shape != (size, size):
            traced = jaxvr.trace(mesh, camera)
        part["runs"].append(measure(name, mesh, vtk, traced, camera, points, options))
    if wanted("bytes", options):
        part["bytes"].append({"mesh": name} | bytes_per_tet(mesh, options.size))
    return name, mesh, part


def scaling(meshes: dict[str, Any], options: Any) -> list[dict[str, Any]]:
    """The main picture of all meshes, taking turns."""
    print(f"{', '.join(meshes)}: render in turns", flush=True)

    def task(mesh):
        camera = camera_of(mesh, options.size)
        transfer = transfer_of(mesh, options.main_points)
        return lambda: jaxvr.render(mesh, camera, transfer)

    medians = median_of({name: task(mesh) for name, mesh in meshes.items()}, options.repeat)
    return [
        {"mesh": name, "tets": meshes[name].n_tets, "size": options.size, "seconds": seconds}
        for name, seconds in medians.items()
    ]


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("meshes", nargs="*", type=Path, help="mesh files or .npz; none: a box")
    parser.add_argument("--sizes", nargs="+", type=int, default=[256, SIZE, 1024])
    parser.add_argument("--points", nargs="+", type=int, default=[2, POINTS, 64, 255])
    parser.add_argument("--repeat", type=int, default=5, help="turns of a run")
    parser.add_argument("--processes", type=int, default=1, help="fresh processes a first call")
    parser.add_argument("--threads", type=int, default=2, help="of VTK")
    parser.add_argument("--no-peers", dest="peers", action="store_false")
    parser.add_argument("--only", nargs="+", default=[], metavar="WORD")
    parser.add_argument("--cross", action="store_true")
    parser.add_argument("--jax-loop", action="store_true")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--markdown", type=Path)
    parser.add_argument("--tiny", action="store_true", help="a box, 16 x 16 pixels, no VTK")
    options = parser.parse_args(arguments)
    if options.tiny:
        options.sizes, options.points, options.repeat, options.peers = [16], [POINTS], 1, False
    # The scene of all tasks: the usual one, or else the first that was asked for.
    options.size = SIZE if SIZE in options.sizes else options.sizes[0]
    options.main_points = POINTS if POINTS in options.points else options.points[0]
    report: dict[str, Any] = {"machine": machine() | {"vtk_threads": options.threads}}
    report |= {"size": options.size, "repeat": options.repeat}
    report |= {"runs": [], "processes": [], "bytes": [], "scaling": []}
    meshes = {}
    for path in options.meshes or [None]:
        name, meshes[name], part = measure_mesh(path, options)
        for key, rows in part.items():
            report[key] += rows
        if options.json:  # as far as it is
            write_json(options.json, report)
    if len(meshes) > 1 and wanted("scaling", options):
        report["scaling"] = scaling(meshes, options)
    for number, row in enumerate(report["runs"], 1):
        row["run"] = number
    for row in report["scaling"]:
        row["run"] = len(report["runs"]) + 1
    report["targets"] = speed_tables.targets(report)
    text = speed_tables.markdown(report)
    print(text, flush=True)
    if options.json:
        write_json(options.json, report)
    if options.markdown:
        options.markdown.parent.mkdir(parents=True, exist_ok=True)
        options.markdown.write_text(text)
    return report


if __name__ == "__main__":
    main()
