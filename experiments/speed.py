"""Seconds for a render and its gradients, beside VTK's ray caster, in one run.

    python -m experiments.speed bluntfin.vtu oxygen_post.vtu --size 512 [--repeat 5] [--json FILE]

VTK (extra `peers`) runs its unstructured ray caster with its accurate ("linear") integrator on the
same tetrahedra, float64 scalars, the same 11 control points in colour and opacity, one ray a pixel
and two threads; jaxvr runs in float32 with `Analytic`. The two take turns; medians and ratios are
printed. Before anything is timed, images are compared with jaxvr's `Quadrature`, which is the
truth here. VTK pierces a pixel at its lower left corner and draws row 0 at the bottom, and does not
correct scalars for perspective, so both cameras are orthographic and VTK's is half a pixel off.
"""

from __future__ import annotations

import argparse
import importlib
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxvr
from experiments.common import diagonal, write_json

POINTS = 11


def transfer_of(mesh: jaxvr.TetMesh) -> jaxvr.TransferFunction:
    """11 control points over the field's range, optical depth of some 5 across the mesh."""
    values = np.asarray(mesh.values)
    rng = np.random.default_rng(0)
    return jaxvr.TransferFunction(
        np.linspace(values.min(), values.max(), POINTS),
        rng.uniform(0, 1, (POINTS, 3)),
        rng.uniform(0.5, 8, POINTS) / diagonal(mesh),
        dtype=mesh.dtype,
    )


def camera_of(mesh: jaxvr.TetMesh, size: int) -> jaxvr.Camera:
    """Orthographic, along `Camera.orbit`'s direction, with the mesh filling the picture."""
    orbit = jaxvr.Camera.orbit(mesh)
    return jaxvr.Camera.orthographic(
        orbit.eye, orbit.target, extent=0.8 * diagonal(mesh), width=size, height=size
    )


def _vtk() -> tuple[Any, Any]:
    """VTK and its NumPy bridge, which only this experiment needs (extra `peers`)."""
    return importlib.import_module("vtk"), importlib.import_module("vtk.util.numpy_support")


class Vtk:
    """VTK's ray caster on the same scene; `render` returns uint8 RGBA, row 0 on top."""

    def __init__(self, mesh, camera, transfer, threads: int):
        vtk, numpy_support = _vtk()
        points, tets = np.asarray(mesh.points, float), _positive(mesh)
        grid, coordinates, cells = vtk.vtkUnstructuredGrid(), vtk.vtkPoints(), vtk.vtkCellArray()
        coordinates.SetData(numpy_support.numpy_to_vtk(points, deep=1))
        cells.SetData(4, numpy_support.numpy_to_vtkIdTypeArray(tets.ravel(), deep=1))
        scalars = numpy_support.numpy_to_vtk(np.asarray(mesh.values, float), deep=1)
        scalars.SetName("s")
        grid.SetPoints(coordinates)
        grid.SetCells(vtk.VTK_TETRA, cells)
        grid.GetPointData().SetScalars(scalars)

        color, opacity = vtk.vtkColorTransferFunction(), vtk.vtkPiecewiseFunction()
        nodes = (transfer.positions, transfer.colors, transfer.extinctions)
        for x, rgb, tau in zip(*(np.asarray(a, float) for a in nodes), strict=True):
            color.AddRGBPoint(x, *rgb)
            opacity.AddPoint(x, tau)
        look = vtk.vtkVolumeProperty()
        look.SetColor(color)
        look.SetScalarOpacity(opacity)
        look.SetScalarOpacityUnitDistance(1.0)
        look.ShadeOff()
        look.SetInterpolationTypeToLinear()

        mapper = vtk.vtkUnstructuredGridVolumeRayCastMapper()
        mapper.SetInputData(grid)
        self.integrator = vtk.vtkUnstructuredGridLinearRayIntegrator()
        mapper.SetRayIntegrator(self.integrator)
        mapper.SetAutoAdjustSampleDistances(0)
        mapper.SetImageSampleDistance(1.0)
        mapper.SetIntermixIntersectingGeometry(0)
        mapper.SetNumberOfThreads(threads)
        volume, renderer = vtk.vtkVolume(), vtk.vtkRenderer()
        volume.SetMapper(mapper)
        volume.SetProperty(look)
        renderer.AddVolume(volume)
        renderer.SetBackground(0, 0, 0)
        renderer.SetBackgroundAlpha(0)
        window = self.window = vtk.vtkRenderWindow()
        window.SetOffScreenRendering(1)
        window.SetMultiSamples(0)
        window.SetAlphaBitPlanes(1)
        window.SetSize(camera.width, camera.height)
        window.AddRenderer(renderer)
        view = renderer.GetActiveCamera()
        view.SetParallelProjection(1)
        # Half a pixel, so that VTK's lower left corners are jaxvr's centres.
        right, true_up, _ = (np.asarray(v, float) for v in camera.basis())
        shift = 0.5 * float(camera.extent) / camera.height * (right + true_up)
        view.SetPosition(*(np.asarray(camera.eye, float) + shift))
        view.SetFocalPoint(*(np.asarray(camera.target, float) + shift))
        view.SetViewUp(*np.asarray(camera.up, float))
        view.SetParallelScale(float(camera.extent) / 2)
        renderer.ResetCameraClippingRange()
        self.size, self.keep = (camera.height, camera.width), (grid, mapper, renderer)

    def draw(self) -> None:
        self.window.Render()

    def image(self) -> np.ndarray:
        vtk, numpy_support = _vtk()
        grab = vtk.vtkWindowToImageFilter()
        grab.SetInput(self.window)
        grab.SetInputBufferTypeToRGBA()
        grab.ReadFrontBufferOff()
        grab.SetShouldRerender(0)
        grab.Update()
        pixels = numpy_support.vtk_to_numpy(grab.GetOutput().GetPointData().GetScalars())
        return pixels.reshape(*self.size, 4)[::-1]


def _positive(mesh: jaxvr.TetMesh) -> np.ndarray:
    """Cells (T, 4) as positively oriented VTK tetrahedra."""
    points, tets = np.asarray(mesh.points, float), np.asarray(mesh.cells).astype(np.int64)
    corner = points[tets]
    volume = np.einsum(
        "ti,ti->t",
        np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]),
        corner[:, 3] - corner[:, 0],
    )
    tets[volume < 0] = tets[volume < 0][:, [0, 1, 3, 2]]
    return tets


def median_of(
    tasks: dict[str, Callable[[], Any]], repeat: int, *, quiet: bool = False
) -> dict[str, float]:
    """Median seconds of each task, taking turns, after one call of each that is not counted.

    quiet: do not print how long those first calls took.
    """
    seconds: dict[str, list[float]] = {name: [] for name in tasks}
    for name, task in tasks.items():
        start = time.perf_counter()
        jax.block_until_ready(task())
        if not quiet:
            print(f"  first {name:28s} {time.perf_counter() - start:8.2f} s", flush=True)
    for _ in range(repeat):
        for name, task in tasks.items():
            start = time.perf_counter()
            jax.block_until_ready(task())
            seconds[name].append(time.perf_counter() - start)
    return {name: float(np.median(all_)) for name, all_ in seconds.items()}


def run(path: Path, size: int, repeat: int, peers: bool, threads: int = 2) -> dict[str, Any]:
    mesh = jaxvr.read_mesh(path, dtype="float32")
    camera, transfer = camera_of(mesh, size), transfer_of(mesh)
    print(f"{path.stem}, {mesh.n_tets:,} tets, {size} x {size}", flush=True)

    def render(m, t):
        return jaxvr.render(m, camera, t)

    def gradient(of):
        return jax.jit(jax.value_and_grad(lambda x, m, t: jnp.sum(of(x, m, t) ** 2)))

    by_transfer = gradient(lambda x, m, t: jaxvr.render(m, camera, x))
    by_values = gradient(lambda x, m, t: jaxvr.render(m.replace(values=x), camera, t))
    by_points = gradient(lambda x, m, t: jaxvr.render(m.replace(points=x), camera, t))
    segments = jaxvr.trace(mesh, camera)
    by_shade = jax.jit(jax.value_and_grad(lambda t, s: jnp.sum(jaxvr.shade(s, t) ** 2)))
    tasks: dict[str, Callable[[], Any]] = {
        "render": lambda: render(mesh, transfer),
        "value_and_grad, transfer": lambda: by_transfer(transfer, mesh, transfer),
        "value_and_grad, values": lambda: by_values(mesh.values, mesh, transfer),
        "value_and_grad, points": lambda: by_points(mesh.points, mesh, transfer),
        "trace": lambda: jaxvr.trace(mesh, camera).scalar,
        "shade": lambda: jaxvr.shade(segments, transfer),
        "value_and_grad, shade": lambda: by_shade(transfer, segments),
    }
    image = np.asarray(render(mesh, transfer))
    truth = np.asarray(
        jaxvr.render(mesh, camera, transfer, integrator=jaxvr.Quadrature(samples=12))
    )
    result: dict[str, Any] = {
        "mesh": path.stem,
        "size": size,
        "cores": os.cpu_count(),
        "segments": segments.count,
        "bytes_per_segment": segments.nbytes / max(segments.count, 1),
        "error": float(np.abs(image - truth).max()),
    }
    if peers:
        vtk = Vtk(mesh, camera, transfer, threads)
        vtk.draw()
        result["vtk_error"] = float(np.abs(vtk.image() / 255.0 - truth).max())
        result["vtk_pixels_off"] = int((np.abs(vtk.image() / 255.0 - truth).max(-1) > 0.02).sum())

        def draw():
            vtk.integrator.Modified()
            vtk.window.Modified()
            vtk.draw()

        tasks = {"VTK, linear": draw, **tasks}
    medians = median_of(tasks, repeat)
    result["seconds"] = medians
    for name, seconds in medians.items():
        beside = f"{seconds / medians['render']:6.2f} of the render"
        if peers:
            beside += f"   {medians['VTK, linear'] / seconds:6.2f} times VTK's speed"
        print(f"  {name:28s} {seconds:8.3f} s   {beside}", flush=True)
    print({k: v for k, v in result.items() if k != "seconds"}, flush=True)
    return result


def main(arguments: list[str] | None = None) -> list[dict[str, Any]]:
    parser = argparse.ArgumentParser(description="jaxvr beside VTK's ray caster")
    parser.add_argument("meshes", nargs="+", type=Path)
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--no-peers", action="store_true")
    parser.add_argument("--json")
    options = parser.parse_args(arguments)
    rows = [run(p, options.size, options.repeat, not options.no_peers) for p in options.meshes]
    if options.json:
        write_json(options.json, rows)
    return rows


if __name__ == "__main__":
    main()
