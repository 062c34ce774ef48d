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

from jaxvr._core.brief import spanned
from jaxvr._core.offsets import absolute
from jaxvr._core.status import RenderError
from jaxvr._core.warn import warn
from jaxvr._core.writing import place_of
from jaxvr.defaults import DEPTH, UPS, best_up, default_transfer
from jaxvr.files import image_writer, save_image
from jaxvr.fit import CheckpointWarning, FitError, fit, noise
from jaxvr.fit.resume import prepare
from jaxvr.native import compile_cache
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
            if arguments.run is not info:
                compile_cache.switch_on()
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
            steps = f", {len(f.steps)} steps" if f.steps else ""
            blocks = f", blocks {', '.join(f.blocks)}" if f.blocks else ""
            print(f"  {f.name} ({f.location}{size}{steps}{blocks})")
    print(_mesh(arguments).describe())


def picture(arguments: Any) -> None:
    """One picture of a file."""
    out = Path(arguments.output)
    image_writer(out)  # raises now what would be wrong with the path after all the work
    if arguments.scalar_bar and out.suffix.lower() != ".png":
        raise ValueError("--scalar-bar is drawn on a .png; the other formats hold pixels alone.")
    mesh = _mesh(arguments)
    transfer = _transfer(arguments.tf, mesh, arguments)
    camera, view = _camera(mesh, transfer, arguments)
    image = np.asarray(render(mesh, camera, transfer, background=arguments.background))
    field = mesh.field_name or "values"
    if arguments.scalar_bar:
        from jaxvr import plot

        plot.image(image, transfer=transfer, label=field).savefig(out)
    else:
        save_image(out, image)
    low, high = mesh.value_range()
    ends = transfer.absolute_positions()[[0, -1]]
    size = f"{image.shape[1]} x {image.shape[0]}, mean alpha {image[..., 3].mean():.3f}"
    print(f"{out}  {size}")
    print(f"field {field}, {spanned(low, high)}, colours from {spanned(*ends)}; {view}")


def recover(arguments: Any) -> None:
    """Renders views with a reference transfer function, fits one to them from noise."""
    _look_at_checkpoint(arguments)
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
    first, last = reference.absolute_positions()[[0, -1]]
    positions = np.linspace(first, last, arguments.points)
    start = noise(positions, _typical(reference, mesh), arguments.seed, dtype=mesh.dtype)
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
        resume=arguments.resume,
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


def _look_at_checkpoint(arguments: Any) -> None:
    """Before anything is read: what stands there is gone on from only when told."""
    path, resume = arguments.checkpoint, arguments.resume
    if path is None and resume:
        raise ValueError("--resume needs --checkpoint FILE, the file to go on from.")
    if path is None:
        return
    done = prepare(path, resume)
    if resume and not place_of(path).exists():
        warn(f"There is no checkpoint {path!r} yet: the fit starts anew.", CheckpointWarning)
    if done and not resume:
        warn(
            f"The checkpoint {path!r} holds {done} iterations. The fit starts anew and replaces "
            "it; pass --resume to go on from it.",
            CheckpointWarning,
        )


def fast_schedule(iterations: int) -> dict[str, Any]:
    """An optimiser for `fit` that gets from noise to high precision in a few hundred steps."""
    import optax

    rate = optax.cosine_decay_schedule(0.4, iterations)
    return {"optimizer": optax.adam(rate, b1=0.8, b2=0.95)}


def _mesh(arguments: Any) -> TetMesh:
    if _is_plot3d(arguments):
        return read_plot3d(arguments.file, arguments.q, field=arguments.field)
    step = arguments.step
    if step is not None:
        try:
            step = int(step) if step.lstrip("-").isdecimal() else float(step)
        except ValueError:
            raise ValueError(
                f"--step must be an index (3) or a time with a point (0.5), but is {step!r}."
            ) from None
    return read_mesh(arguments.file, field=arguments.field, step=step, block=arguments.block)


def _camera(mesh: TetMesh, transfer: TransferFunction, arguments: Any) -> tuple[Camera, str]:
    """The view that is asked for, and what was chosen."""
    a = arguments
    size = {"fov": a.fov, "width": a.width, "height": a.height}
    angles = {"azimuth": a.azimuth, "elevation": a.elevation, "zoom": a.zoom}
    given = {name: x for name, x in angles.items() if x is not None}
    if a.eye is None:
        name = best_up(mesh, transfer, fov=a.fov, **given) if a.up is None else None
        up = UPS[name] if name else a.up
        camera = Camera.orbit(mesh, up=up, **given, **size)
        return camera, f"{name} up, which shows most (--up)" if name else f"up {_numbers(up)}"
    if given:
        raise ValueError(f"--eye says where from: leave out {', '.join('--' + x for x in given)}.")
    low, high = (absolute(x, mesh.origin) for x in mesh.bounds())
    up = a.up or UPS["z" if abs(_along(low, high, a.eye)[1]) > 0.99 else "y"]
    camera = Camera.look_at(a.eye, (low + high) / 2, up, **size, dtype=mesh.dtype)
    return camera, f"up {_numbers(up)}"


def _along(low: np.ndarray, high: np.ndarray, eye: Any) -> np.ndarray:
    """The direction from an eye to the middle of a box."""
    ahead = (low + high) / 2 - np.asarray(eye)
    return ahead / max(float(np.abs(ahead).max()), np.finfo(float).tiny)


def _numbers(x: Any) -> str:
    return "(" + ", ".join(f"{v:g}" for v in x) + ")"


def _up(text: str) -> tuple[float, ...]:
    """An axis such as z or -y, or three numbers with commas."""
    sign, name = (-1.0, text[1:]) if text.startswith("-") else (1.0, text)
    if name in UPS:
        return tuple(sign * x + 0.0 for x in UPS[name])
    parts = tuple(float(x) for x in text.split(","))
    if len(parts) != 3 or not any(parts):
        raise ValueError
    return parts


_up.__name__ = "axis"  # argparse names it where it fails


def _is_plot3d(arguments: Any) -> bool:
    return arguments.q is not None or Path(arguments.file).suffix.lower() in _PLOT3D


def _typical(transfer: TransferFunction, mesh: TetMesh) -> float:
    mean = float(np.asarray(transfer.extinctions, np.float64).mean())
    return mean if mean > 0 else DEPTH / mesh.diagonal()


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
        made.add_argument("file", metavar="FILE", help="a mesh file, or PLOT3D")
        made.add_argument("--field", help="its field (name, name.x, name.magnitude)")
        made.add_argument("--step", help="its time step: an index, or a time with a point (0.5)")
        made.add_argument("--block", help="one of its blocks, by name")
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
    made.add_argument(
        "--up",
        type=_up,
        metavar="AXIS",
        help="x, y, z, --up=-z or three numbers x,y,z (that of y, z, x which shows most)",
    )
    for name, about in (
        ("azimuth", "degrees round the axis that is up (30)"),
        ("elevation", "degrees above the horizon (20)"),
        ("zoom", "magnification; at 1, which is the default, the bounding ball fits"),
    ):
        made.add_argument(f"--{name}", type=float, metavar="X", help=about)
    made.add_argument(
        *("--eye",),
        type=float,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="where to look from, at the middle of the box, instead of these angles",
    )
    made.add_argument(
        "--fov", type=float, default=30.0, metavar="X", help="vertical view angle, degrees" + shown
    )
    for name in ("width", "height"):
        made.add_argument(f"--{name}", type=int, default=512, metavar="N", help="pixels" + shown)
    made.add_argument(
        "--scalar-bar", action="store_true", help="draw the transfer function beside a .png"
    )
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
    made.add_argument("--checkpoint", metavar="FILE", help="where the state is kept on the way")
    made.add_argument("--resume", action="store_true", help="go on from the checkpoint's state")
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
