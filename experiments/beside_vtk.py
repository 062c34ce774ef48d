"""One scene drawn by jaxvr and by VTK: pictures side by side, differences from the truth, times.

    python -m experiments.beside_vtk [--size 512] [--out notebooks] [--json FILE] [--tiny]

The mesh is `jaxvr.datasets.heat_sink`, the camera orthographic, the transfer function given as VTK
has it: five colours and, on nodes of its own, an opacity with three narrow peaks. jaxvr reads it by
`TransferFunction.from_vtk`. VTK (see `peers`) draws it three times: as it comes; with the merged
control points of `to_vtk` in both functions, since its integrators drop opacity nodes that are no
colour nodes; and with those and its most accurate integrator. Truth is `Quadrature` in float64.

VTK's window is compared with the truth stretched as its window is (see `peers.Vtk.displayed`), and
its floats, before the display, at random pixels. Differences are in steps of 8 bits, 1/255.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import matplotlib
import matplotlib.cm
import matplotlib.colors
import matplotlib.figure
import numpy as np

import jaxvr
from experiments.common import diagonal, in_float64, machine, median_of, table, write_json
from experiments.peers import Vtk, _vtk

COLORS = "turbo"
COLOR_NODES = 5
# Centre and highest opacity of each peak, as a part of the range.
PEAKS = ((0.18, 0.15), (0.44, 0.3), (0.7, 1.0))
HALF_WIDTH = 0.03
FLOOR = 0.015
UNIT = 1 / 60  # of the diagonal
SHOWN = 24  # steps of 8 bits that are black in the pictures of differences


def functions(mesh: jaxvr.TetMesh) -> tuple[Any, Any]:
    """The scene's vtkColorTransferFunction and vtkPiecewiseFunction."""
    vtk, _ = _vtk()
    low, high = float(mesh.values.min()), float(mesh.values.max())
    color, opacity = vtk.vtkColorTransferFunction(), vtk.vtkPiecewiseFunction()
    for t in np.linspace(0, 1, COLOR_NODES):
        color.AddRGBPoint(low + t * (high - low), *matplotlib.colormaps[COLORS](t)[:3])
    for t, o in (
        (0.0, FLOOR),
        *((c + d * HALF_WIDTH, o if d == 0 else FLOOR) for c, o in PEAKS for d in (-1, 0, 1)),
        (1.0, FLOOR),
    ):
        opacity.AddPoint(low + t * (high - low), o)
    return color, opacity


class Drawer:
    """VTK's ray caster with two functions as they are."""

    def __init__(
        self, mesh: Any, camera: Any, look: tuple[Any, Any], unit: float, integrator: Any, threads
    ):
        self.vtk = Vtk(mesh, threads)
        self.vtk.integrator = integrator
        self.vtk.mapper.SetRayIntegrator(integrator)
        some = jaxvr.TransferFunction([0.0], [[0.0, 0.0, 0.0]], [0.0])
        self.vtk.show(camera, some)
        property = self.vtk.volume.GetProperty()
        property.SetColor(look[0])
        property.SetScalarOpacity(look[1])
        property.SetScalarOpacityUnitDistance(unit)
        self.draw: Callable[[], None] = self.vtk.draw

    def against(self, truth: np.ndarray, samples: int) -> tuple[np.ndarray, dict[str, float]]:
        """The window's picture, and how it and VTK's floats differ from the truth, in steps."""
        self.draw()
        image = self.vtk.image()
        pixels = np.random.default_rng(0).integers(0, truth.shape[:2], (samples, 2))
        floats = np.abs(self.vtk.raw(pixels) - truth[pixels[:, 0], pixels[:, 1]])
        return image, steps(image, self.vtk.displayed(truth)) | {
            "floats, max": 255 * float(floats.max()),
            "floats, mean": 255 * float(floats.mean()),
        }


def steps(image: Any, truth: np.ndarray) -> dict[str, float]:
    gap = 255 * np.abs(np.asarray(image, float) - truth)
    return {"max": float(gap.max()), "mean": float(gap.mean())}


def run(
    mesh: jaxvr.TetMesh,
    out: Path | None = None,
    *,
    size: int = 512,
    repeat: int = 7,
    threads: int = 2,
    samples: int = 2000,
) -> dict[str, Any]:
    """Rows of differences and seconds; with `out`, the picture. Needs jax_enable_x64."""
    vtk, _ = _vtk()
    orbit = jaxvr.Camera.orbit(mesh, azimuth=35, elevation=25)
    camera = jaxvr.Camera.orthographic(
        orbit.eye, orbit.target, extent=0.86 * diagonal(mesh), width=size, height=size
    )
    unit = UNIT * diagonal(mesh)
    given = functions(mesh)
    transfer = jaxvr.TransferFunction.from_vtk(*given, unit, dtype="float32")
    smaller = unit * (1 - 1e-6)  # float32 may have rounded an opacity of 1 up
    merged = transfer.to_vtk(smaller)
    wide = in_float64(mesh), in_float64(camera), in_float64(transfer)
    truth = np.asarray(jaxvr.render(*wide, integrator=jaxvr.Quadrature(samples=12)))

    default = vtk.vtkUnstructuredGridPreIntegration  # the mapper's choice for such a scene
    linear = vtk.vtkUnstructuredGridLinearRayIntegrator
    drawers = {
        "VTK, merged, linear": Drawer(mesh, camera, merged, smaller, linear(), threads),
        "VTK, merged nodes": Drawer(mesh, camera, merged, smaller, default(), threads),
        "VTK as it comes": Drawer(mesh, camera, given, unit, default(), threads),
    }
    image = np.asarray(jaxvr.render(mesh, camera, transfer))
    pictures = {"jaxvr": image}
    none = {"floats, max": None, "floats, mean": None}
    rows: list[dict[str, Any]] = [{"renderer": "jaxvr"} | steps(image, truth) | none]
    gaps = {"jaxvr": np.abs(image - truth)}
    for name, drawer in drawers.items():
        pictures[name], row = drawer.against(truth, samples)
        gaps[name] = np.abs(pictures[name] - drawer.vtk.displayed(truth))
        rows.append({"renderer": name} | row)
        if name == "VTK, merged, linear":
            between = steps(pictures[name], drawer.vtk.displayed(image))
            plain = steps(pictures[name], image)
    tasks: dict[str, Callable[[], Any]] = {
        "jaxvr": lambda: jaxvr.render(mesh, camera, transfer),
        **{name: drawer.draw for name, drawer in drawers.items()},
    }
    for row, seconds in zip(rows, median_of(tasks, repeat, quiet=True).values(), strict=True):
        row["seconds"] = seconds
    print(table(rows), flush=True)
    report = {
        "machine": machine() | {"vtk": vtk.vtkVersion().GetVTKVersion(), "vtk_threads": threads},
        "tets": mesh.n_tets,
        "size": size,
        "control_points": len(transfer.positions),
        "jaxvr against VTK, linear": between,
        "the same without the stretch": plain,
        "rows": rows,
    }
    print({k: v for k, v in report.items() if k != "rows"}, flush=True)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        save(out / "beside_vtk.png", pictures, gaps)
    return report


def save(path: Path, pictures: dict[str, np.ndarray], gaps: dict[str, np.ndarray]) -> None:
    """The pictures over white, and under each its difference from the truth."""
    figure = matplotlib.figure.Figure(figsize=(11, 6), layout="constrained")
    axes = figure.subplots(2, len(pictures))
    colors = matplotlib.cm.ScalarMappable(matplotlib.colors.Normalize(0, SHOWN), "gray_r")
    for column, (name, picture) in zip(axes.T, pictures.items(), strict=True):
        rgb = picture[..., :3] + (1 - picture[..., 3:])
        column[0].imshow(np.clip(rgb, 0, 1))
        column[0].set_title(name, fontsize=11)
        gap = 255 * gaps[name].max(-1)
        column[1].imshow(gap, cmap=colors.cmap, norm=colors.norm)
        most = f"{gap.max():.0f}" if gap.max() >= 10 else f"{gap.max():.2g}"
        column[1].set_title(f"off the truth by up to {most} of 255", fontsize=9)
        for ax in column:
            ax.set_xticks([])
            ax.set_yticks([])
        column[0].spines[:].set_visible(False)
        column[1].spines[:].set_color("0.8")
    figure.colorbar(colors, ax=axes[1], shrink=0.8, extend="max", label="8-bit steps")
    figure.savefig(path, dpi=100)


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--size", type=int, default=512, help="pixels along each side")
    parser.add_argument("--repeat", type=int, default=7, help="turns of the timing")
    parser.add_argument("--threads", type=int, default=2, help="of VTK")
    parser.add_argument("--out", type=Path, help="folder for the picture")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--tiny", action="store_true", help="two fins, 24 x 24 pixels")
    options = parser.parse_args(arguments)
    jax.config.update("jax_enable_x64", True)
    mesh = jaxvr.datasets.heat_sink(fins=2 if options.tiny else 5, dtype="float32")
    small = {"size": 24, "repeat": 1, "samples": 50}
    large = {"size": options.size, "repeat": options.repeat}
    report = run(mesh, options.out, threads=options.threads, **(small if options.tiny else large))
    if options.json:
        write_json(options.json, report)
    return report


if __name__ == "__main__":
    main()
