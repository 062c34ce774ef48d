"""The command `jaxvr`: info, render, fit; a thin shell over the package.

Errors and warnings are one line each on stderr; the exit code of an error is 2.
"""

from __future__ import annotations

import argparse
import os
import sys
import warnings
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from jaxvr._core.status import RenderError
from jaxvr.defaults import DEPTH, default_transfer, diagonal
from jaxvr.files import image_writer, save_image
from jaxvr.fit import FitError, fit, noise
from jaxvr.optics import TransferFunction
from jaxvr.render import render
from jaxvr.view import Camera
from jaxvr.volume import TetMesh, list_fields, read_mesh, read_plot3d

_PLOT3D = {".xyz", ".x", ".g", ".grd", ".p3d", ".bin", ".q"}


def main(argv: list[str] | None = None) -> int:
    """Runs the command with arguments `argv` (those of the process if None); its exit code."""
    parser = _parser()
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        warnings.showwarning = _tell_once()
        try:
            arguments = parser.parse_args(argv)
            return arguments.run(arguments) or 0
        except SystemExit as e:  # of argparse: --help, or an error that it has told
            return e.code if isinstance(e.code, int) else 2
        except (ValueError, OSError, RenderError, FitError) as e:
            if isinstance(e, BrokenPipeError):  # `jaxvr info FILE | head`
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
                return 1
            _say("error", e)
            return 2
        except KeyboardInterrupt:
            _say("error", "interrupted")
            return 130


def info(arguments: Any) -> None:
    """What a file holds, and the mesh made of it."""
    if not _is_plot3d(arguments):
        fields = list_fields(arguments.file)
        print("fields")
        for f in fields:
            size = "" if f.components == 1 else f", {f.components} components"
            print(f"  {f.name} ({f.location}{size})")
    print(_mesh(arguments).describe())


def picture(arguments: Any) -> None:
    """One picture of a file."""
    out = Path(arguments.output)
    image_writer(out)  # raises now what would be wrong with the path after all the work
    mesh = _mesh(arguments)
    transfer = _transfer(arguments.tf, mesh, arguments)
    camera = Camera.orbit(
        mesh,
        azimuth=arguments.azimuth,
        elevation=arguments.elevation,
        fov=arguments.fov,
        zoom=arguments.zoom,
        width=arguments.width,
        height=arguments.height,
    )
    image = np.asarray(render(mesh, camera, transfer, background=arguments.background))
    save_image(out, image)
    print(f"{out}  {image.shape[1]} x {image.shape[0]}, mean alpha {image[..., 3].mean():.3f}")


def recover(arguments: Any) -> None:
    """Renders views with a reference transfer function, fits one to them from noise."""
    mesh = _mesh(arguments)
    reference = _transfer(arguments.reference_tf, mesh, arguments)
    if arguments.points < 2:
        raise ValueError(f"--points must be at least 2, but is {arguments.points}.")
    size = {"width": arguments.size, "height": arguments.size}
    cameras = Camera.sphere(mesh, arguments.views, **size)
    held_out = Camera.orbit(mesh, **size)
    look = {"background": arguments.background}
    targets = [np.asarray(render(mesh, c, reference, **look)) for c in cameras]
    unseen = np.asarray(render(mesh, held_out, reference, **look))
    first, last = (float(reference.positions[k]) for k in (0, -1))
    positions = np.linspace(first, last, arguments.points).astype(mesh.dtype)
    start = noise(positions, _typical(reference, mesh), arguments.seed)
    result = fit(
        start,
        mesh,
        cameras,
        targets,
        iterations=arguments.iterations,
        seed=arguments.seed,
        held_out=(held_out, unseen),
        progress=None if not arguments.quiet else False,
        checkpoint=arguments.checkpoint,
        resume=arguments.checkpoint is not None,
        **fast_schedule(arguments.iterations),
        **look,
    )
    from jaxvr.pictures import save_fit

    out = result.save(arguments.output)
    first = render(mesh, held_out, start, **look)
    save_fit(out, unseen, first, result.held_out_images[0], result.transfer, reference)
    scores = result.report()["held_out"][0]
    psnr = "equal" if scores["psnr"] is None else f"{scores['psnr']:.2f} dB"
    print(f"held-out view: PSNR {psnr}; pictures and report.json in {out}")


def fast_schedule(iterations: int) -> dict[str, Any]:
    """An optimiser for `fit` that gets from noise to high precision in a few hundred steps."""
    import optax

    rate = optax.cosine_decay_schedule(0.4, iterations)
    return {"optimizer": optax.adam(rate, b1=0.8, b2=0.95)}


def _mesh(arguments: Any) -> TetMesh:
    if _is_plot3d(arguments):
        return read_plot3d(arguments.file, arguments.q, field=arguments.field)
    return read_mesh(arguments.file, field=arguments.field)


def _is_plot3d(arguments: Any) -> bool:
    return arguments.q is not None or Path(arguments.file).suffix.lower() in _PLOT3D


def _typical(transfer: TransferFunction, mesh: TetMesh) -> float:
    mean = float(np.asarray(transfer.extinctions, np.float64).mean())
    return mean if mean > 0 else DEPTH / diagonal(mesh)


def _transfer(source: str, mesh: TetMesh, arguments: Any) -> TransferFunction:
    """From a JSON file, or a colour map over the range of the mesh's values."""
    if source.lower().endswith(".json") or os.path.sep in source:
        if not Path(source).is_file():
            raise FileNotFoundError(f"There is no file {source!r}.")
        transfer = TransferFunction.from_json(
            Path(source), unit_distance=arguments.unit_distance, dtype=mesh.dtype
        )
    else:
        transfer = default_transfer(mesh, source)
    return transfer.scaled(arguments.opacity)


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="jaxvr", description="Differentiable volume rendering of unstructured meshes."
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="of jaxvr, JAX and Python")
    shown = " (%(default)s)"
    commands = parser.add_subparsers(required=True, metavar="COMMAND", parser_class=_Parser)

    def command(name: str, run: Any, about: str) -> argparse.ArgumentParser:
        made = commands.add_parser(name, help=about, description=about)
        made.set_defaults(run=run)
        made.add_argument("file", metavar="FILE", help="a mesh file that meshio reads, or PLOT3D")
        made.add_argument("--field", help="its field (name, name.x, name.magnitude)")
        made.add_argument("--q", metavar="FILE", help="the PLOT3D solution of a PLOT3D grid")
        return made

    def optics(made: argparse.ArgumentParser) -> None:
        made.add_argument(
            *("--opacity", "--extinction"),
            type=float,
            default=1.0,
            metavar="X",
            help="factor on all extinctions (%(default)s)",
        )
        made.add_argument(
            "--unit-distance",
            type=float,
            default=1.0,
            metavar="L",
            help="length that opacities of a ParaView colour map are for (%(default)s)",
        )
        made.add_argument(
            "--background", type=float, nargs=3, metavar=("R", "G", "B"), help="else transparent"
        )

    command("info", info, "What a file holds, and the mesh made of it.")

    made = command("render", picture, "Render a picture of a volume.")
    made.add_argument(
        "--tf",
        default="viridis",
        help="transfer function: a .json file (of jaxvr or ParaView), or the name of a colour map, "
        "with extinction rising from 0" + shown,
    )
    optics(made)
    for name, default, about in (
        ("azimuth", 30.0, "degrees round the vertical axis"),
        ("elevation", 20.0, "degrees above the horizon"),
        ("zoom", 1.0, "magnification; at 1 the bounding ball fits"),
        ("fov", 30.0, "vertical field of view in degrees"),
    ):
        made.add_argument(f"--{name}", type=float, default=default, metavar="X", help=about + shown)
    for name in ("width", "height"):
        made.add_argument(f"--{name}", type=int, default=512, metavar="N", help="pixels" + shown)
    made.add_argument(
        *("-o", "--output"),
        required=True,
        metavar="FILE",
        help=".png, or .npy or .exr with the float image (premultiplied linear RGBA)",
    )

    made = command("fit", recover, "Recover a transfer function from pictures, from noise.")
    made.add_argument(
        "--reference-tf",
        required=True,
        metavar="TF",
        help="what the pictures are made with: a .json file or the name of a colour map",
    )
    optics(made)
    for name, default, about in (
        ("points", 64, "control points to fit"),
        ("views", 8, "pictures, from all round"),
        ("iterations", 200, "steps of the optimiser"),
        ("size", 128, "pixels along a side of the pictures"),
        ("seed", 0, "of the noise to start from"),
    ):
        made.add_argument(f"--{name}", type=int, default=default, metavar="N", help=about + shown)
    made.add_argument("--checkpoint", metavar="FILE", help="written, and resumed from if it exists")
    made.add_argument("--quiet", action="store_true", help="no progress bar")
    made.add_argument("-o", "--output", required=True, metavar="FOLDER", help="pictures, report")
    return parser


class _Version(argparse.Action):
    """Tells what somebody who reports a fault is asked for."""

    def __call__(self, parser: Any, *_: Any, **__: Any) -> None:
        import platform

        import jax

        from jaxvr import __version__

        print(f"jaxvr {__version__} (jax {jax.__version__}, Python {platform.python_version()})")
        parser.exit()


class _Parser(argparse.ArgumentParser):
    """Tells errors in one line."""

    def error(self, message: str) -> NoReturn:
        _say("error", f"{message} (see {self.prog} --help)")
        raise SystemExit(2)


def _tell_once() -> Any:
    """Tells a warning once, wherever it comes from: a fit renders in several places."""
    told: set[str] = set()

    def tell(message: Any, category: Any, *_: Any, **__: Any) -> None:
        if str(message) not in told:
            told.add(str(message))
            _say("warning", message)

    return tell


def _say(what: str, message: Any) -> None:
    print(f"jaxvr: {what}: {' '.join(str(message).split())}", file=sys.stderr)
