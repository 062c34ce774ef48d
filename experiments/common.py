"""What experiments share: volumes, the scene that timings use, transfer functions with features,
errors of pictures, timing by turns, tables of numbers and folders for results."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import platform
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxvr
from jaxvr._core.units import norm

# Centre, width and height of shells of density, as parts of the range and of the highest.
PEAKS = (
    (0.10, 0.05, 0.10),
    (0.30, 0.04, 0.25),
    (0.52, 0.05, 0.45),
    (0.72, 0.04, 0.7),
    (0.92, 0.06, 1.0),
)


# Control points of the transfer function that is timed unless another number is asked for.
POINTS = 11


def diagonal(volume: Any) -> float:
    """Length of the diagonal of a volume's box, of an older checkout's too."""
    low, high = (np.asarray(x, np.float64) for x in volume.bounds())
    return norm(high - low)


def read_volume(path: Any = None, field: str | None = None) -> jaxvr.TetMesh:
    """A mesh in float32: any mesh file, or an .npz with points (P, 3), tets (T, 4) and fields (P,).

    path: None makes a small box. field: of an .npz, the first one if None.
    """
    if path is None:
        return jaxvr.datasets.box((3, 3, 3), jitter=0.2, dtype="float32")
    if Path(path).suffix != ".npz":
        return jaxvr.read_mesh(path, field=field, dtype="float32")
    with np.load(path) as arrays:
        fields = [name for name in arrays.files if name not in ("points", "tets")]
        values = arrays[field or fields[0]]
        cells = {"tetra": arrays["tets"]}
        return jaxvr.TetMesh.from_cells(arrays["points"], cells, values, dtype="float32")


def transfer_of(mesh: jaxvr.TetMesh, points: int = POINTS) -> jaxvr.TransferFunction:
    """Control points over the field's range, optical depth of some 5 across the mesh."""
    values = np.asarray(mesh.values)
    rng = np.random.default_rng(0)
    return jaxvr.TransferFunction(
        np.linspace(values.min(), values.max(), points),
        rng.uniform(0, 1, (points, 3)),
        rng.uniform(0.5, 8, points) / diagonal(mesh),
        dtype=mesh.dtype,
    )


def camera_of(mesh: jaxvr.TetMesh, size: int) -> jaxvr.Camera:
    """Orthographic, along `Camera.orbit`'s direction, with the mesh filling the picture."""
    orbit = jaxvr.Camera.orbit(mesh)
    return jaxvr.Camera.orthographic(
        orbit.eye, orbit.target, extent=0.8 * diagonal(mesh), width=size, height=size
    )


def seconds_of(
    tasks: dict[str, Callable[[], Any]], repeat: int, *, quiet: bool = False
) -> dict[str, list[float]]:
    """Seconds of each task, taking turns, after one call of each that is not counted.

    quiet: do not print how long those first calls took.
    """
    seconds: dict[str, list[float]] = {name: [] for name in tasks}
    for name, task in tasks.items():
        start = time.perf_counter()
        jax.block_until_ready(task())
        if not quiet:
            print(f"  first {name:38s} {time.perf_counter() - start:8.2f} s", flush=True)
    for _ in range(repeat):
        for name, task in tasks.items():
            start = time.perf_counter()
            jax.block_until_ready(task())
            seconds[name].append(time.perf_counter() - start)
    return seconds


def median_of(
    tasks: dict[str, Callable[[], Any]], repeat: int, *, quiet: bool = False
) -> dict[str, float]:
    """The medians of `seconds_of`."""
    every = seconds_of(tasks, repeat, quiet=quiet)
    return {name: float(np.median(seconds)) for name, seconds in every.items()}


def machine() -> dict[str, Any]:
    """What the numbers of a run depend on: cores, processor, versions. No names of hosts."""
    model, info = platform.processor() or platform.machine(), Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    for line in lines:
        if line.startswith("model name"):
            model = line.split(":", 1)[1].strip()
            break
    if any(line.startswith("flags") and "avx512f" in line for line in lines):
        model += " (AVX-512)"
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    versions = {"python": platform.python_version(), "jax": jax.__version__}
    return {"cores": cores, "processor": model, "device": jax.devices()[0].platform} | versions


def shells(
    volume: Any,
    points: int,
    colormap: Any = "turbo",
    depth: float = 40.0,
    floor: float = 0.01,
    peaks: Any = PEAKS,
) -> jaxvr.TransferFunction:
    """A transfer function of five translucent shells over the range of a volume's values.

    points: control points, evenly spaced. depth: optical depth along the diagonal of the box at the
    highest peak. floor: extinction between the peaks, as part of the highest. peaks: centre, width
    and height of each, as parts of the range and of the highest.
    """
    values = np.asarray(volume.values, np.float64)
    t = np.linspace(0, 1, points)
    density = floor + sum(h * np.exp(-(((t - c) / w) ** 2)) for c, w, h in peaks)
    positions = values.min() + (values.max() - values.min()) * t
    dtype = volume.points.dtype
    extinctions = np.asarray(depth / diagonal(volume) * density, dtype)
    return jaxvr.TransferFunction.from_colormap(colormap, positions, extinctions, dtype=dtype)


def spikes(
    volume: Any,
    centres: Any,
    half_width: float,
    colormap: Any = "turbo",
    depth: float = 1000.0,
    floor: float = 1e-4,
) -> jaxvr.TransferFunction:
    """A transfer function of sharp peaks, like isosurfaces: four control points at its ends and
    three a peak.

    centres: of the peaks, as parts of the range, ascending. half_width: from the tip of a peak to
    its foot, as part of the range. depth, floor: as for `shells`, of tips and between them.
    """
    values = np.asarray(volume.values, np.float64)
    tips = np.asarray(centres, np.float64)
    t = np.concatenate([[0], (tips[:, None] + half_width * np.array([-1, 0, 1])).ravel(), [1]])
    density = np.full(len(t), floor)
    density[2:-1:3] = 1
    positions = values.min() + (values.max() - values.min()) * t
    dtype = volume.points.dtype
    extinctions = np.asarray(depth / diagonal(volume) * density, dtype)
    return jaxvr.TransferFunction.from_colormap(colormap, positions, extinctions, dtype=dtype)


def errors(image: Any, reference: Any) -> dict[str, float]:
    """How an image (H, W, 4) differs from another one.

    max, mean, rms and psnr (dB) over all pixels and channels. bias: mean of image - reference over
    r, g and b, as seen over black. brightness: the ratio of their sums, less 1.
    """
    a, b = (np.asarray(x, np.float64) for x in (image, reference))
    gap = a - b
    light = b[..., :3].sum()
    return {
        "max": float(np.abs(gap).max()),
        "mean": float(np.abs(gap).mean()),
        "rms": float(np.sqrt((gap**2).mean())),
        "psnr": float(jaxvr.psnr(a, b)),
        "bias": float(gap[..., :3].mean()),
        "brightness": float(gap[..., :3].sum() / light) if light else 0.0,
    }


def table(rows: list[dict[str, Any]]) -> str:
    """Rows with equal keys as aligned text; None is a dash."""

    def text(x):
        return "-" if x is None else f"{x:.3g}" if isinstance(x, float) else str(x)

    cells = [list(rows[0]), *([text(x) for x in row.values()] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = [[f"{x:>{w}}" for x, w in zip(line, widths, strict=True)] for line in cells]
    return "\n".join("  ".join(line).rstrip() for line in lines)


@contextlib.contextmanager
def with_x64() -> Iterator[None]:
    """Float64 within, as by `jax.enable_x64`, which jax 0.7 does not have."""
    before = jax.config.read("jax_enable_x64")
    jax.config.update("jax_enable_x64", True)
    try:
        yield
    finally:
        jax.config.update("jax_enable_x64", before)


def in_float64(tree: Any) -> Any:
    """A mesh, camera or transfer function with its floats widened; needs jax_enable_x64."""
    return jax.tree.map(
        lambda x: x.astype(np.float64) if np.issubdtype(x.dtype, np.floating) else x, tree
    )


def picture_options(description: str | None, arguments: Any) -> argparse.Namespace:
    """Options of an experiment that makes pictures of a mesh; `volume` is the mesh, in float32."""
    parser = argparse.ArgumentParser(description=(description or "").splitlines()[0])
    parser.add_argument("mesh", type=Path, nargs="?", help="any mesh file; none: a small box")
    parser.add_argument("--field")
    parser.add_argument("--size", type=int, default=512, help="pixels along each side")
    parser.add_argument("--out", type=Path, help="folder for pictures")
    parser.add_argument("--json", type=Path, help="write the numbers there")
    parser.add_argument("--tiny", action="store_true", help="a few pixels and small tables")
    options = parser.parse_args(arguments)
    if options.mesh is None:
        options.volume = jaxvr.datasets.box((4, 4, 4), jitter=0.2, dtype="float32")
    else:
        options.volume = jaxvr.read_mesh(options.mesh, field=options.field, dtype="float32")
    return options


def run_on_pictures(
    run: Callable[..., dict[str, Any]], description: str | None, arguments: Any, tiny: Any
) -> dict[str, Any]:
    """`run(volume, out, size=...)` with `picture_options`, or with the keywords `tiny` instead."""
    options = picture_options(description, arguments)
    report = run(options.volume, options.out, **(tiny if options.tiny else {"size": options.size}))
    if options.json:
        write_json(options.json, report)
    return report


def write_json(path: Any, data: Any) -> Path:
    file = Path(path)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(data, indent=2) + "\n")
    return file
