"""Images and animations as files: `save_image`, `save_animation`, and `turntable`, which makes one.

Images are premultiplied linear RGBA (H, W, 4), as `render` returns them, or opaque RGB (H, W, 3).
Colour maps are made for display, and `TransferFunction.from_colormap` takes their numbers as they
are; so PNG files, GIFs and videos hold a picture's numbers as they are by default, and a colour map
looks as its makers meant it. With `srgb=True` linear light is coded as sRGB first, which is right
for colours that were decoded from sRGB. NPY and EXR files hold floats, and nothing is coded.

To add a format: a writer here, and its suffix in `_IMAGES` or `_ANIMATIONS`.
"""

from __future__ import annotations

import importlib
import operator
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from jaxvr._core.checks import as_floats, as_light, require_finite
from jaxvr._core.writing import beside, require_place, whole_file
from jaxvr.render import render
from jaxvr.view import images as _images
from jaxvr.view.camera import Camera

_BLACK = (0.0, 0.0, 0.0)


def save_image(
    path: str | os.PathLike[str], image: Any, background: Any = None, srgb: bool = False
) -> None:
    """Writes an image (H, W, 4) or (H, W, 3) in the format that the path's suffix names; whole, or
    not at all. `jaxvr.load_image` reads it back.

    .png: eight bits a channel, of what lies between 0 and 1. A transparent image gets straight
        alpha, as the format wants it. Bytes (uint8), as `turntable` returns them, are written as
        they are.
    .npy: the array as it is, for `numpy.load`.
    .exr: float32, premultiplied and linear, as OpenEXR wants it. Needs `pip install OpenEXR`.

    Args:
      background: linear RGB (3,) to put behind the image, which is opaque then.
      srgb: code linear light as sRGB, for .png; see the module.

    Raises ValueError for another suffix, for what is no image, for NaN, for `srgb` with a format of
    floats and where OpenEXR is missing; FileNotFoundError where there is no such folder; OSError
    where it cannot be written.
    """
    image_writer(path)(Path(path), image, background, srgb)


def image_writer(path: str | os.PathLike[str]) -> Callable[..., None]:
    """What writes an image to this path; raises what `save_image` would because of the path.

    For looking before a long computation whether its result can be written.
    """
    write = _writer_for(path, _IMAGES, "An image")
    if write is _write_exr:
        _openexr()
    return write


def save_animation(path: str | os.PathLike[str], frames: Any, fps: float = 24) -> list[Path]:
    """Writes frames in the format that the path's suffix names; returns the files written.

    .gif: loops. One palette of 256 colours for all frames; of more colours each becomes a mixture
        of two of them, in a pattern that stays where it is, so that nothing flickers. At most 50
        frames a second; equal neighbours may become one frame that is shown for longer.
    .mp4: H.264, which browsers and slides play. Needs the program ffmpeg on the PATH, or
        `pip install imageio-ffmpeg`. An odd width or height gets its last column or row twice.
    .png: a file for each frame: name.png becomes name_000.png, name_001.png, ...

    Args:
      frames: (n, H, W, 3) uint8, as `turntable` returns them; or images as for `save_image`, of one
        size, transparent ones seen over black.
      fps: frames a second.

    Raises ValueError for another suffix, for frames of different sizes, for a speed that cannot be
    and where there is no ffmpeg; FileNotFoundError where there is no such folder; RuntimeError with
    the last line of what ffmpeg says if it fails.
    """
    write = _animation_writer(path, fps)
    movie = [pixels(x, _opaque_behind(x)) for x in frames]
    if not movie:
        raise ValueError("An animation needs at least one frame, but there is none.")
    for k, frame in enumerate(movie):
        if frame.shape != movie[0].shape:
            raise ValueError(
                f"The frames must have one size, but frame 0 is {movie[0].shape} and frame {k} is "
                f"{frame.shape}."
            )
    if movie[0].shape[-1] != 3:
        raise ValueError("Frames of bytes must have 3 channels, since a video has no alpha.")
    return write(Path(path), np.stack(movie), fps)


def turntable(
    volume: Any,
    transfer: Any,
    path: str | os.PathLike[str] | None = None,
    *,
    frames: int = 36,
    elevation: float = 20.0,
    fov: float = 30.0,
    zoom: float = 1.0,
    width: int = 512,
    height: int = 512,
    fps: float = 24,
    background: Any = _BLACK,
    srgb: bool = False,
    progress: bool | None = True,
    **options: Any,
) -> np.ndarray:
    """Renders a volume from all round, and writes an animation of it.

    Args:
      volume, transfer: as for `render`.
      path: .gif, .mp4 or .png, as for `save_animation`; None writes nothing.
      frames: how many, at evenly spaced azimuths from 0 degrees on, once round.
      elevation, fov, zoom, width, height: of each view, as for `Camera.orbit`.
      fps: frames a second, in the file.
      background: linear RGB (3,) behind the volume; None is black, since videos have no alpha.
      srgb: code linear light as sRGB; see the module.
      progress: a bar on stderr; None shows it where stderr is a terminal.
      options: of `render`: tracer, integrator, compositor, budget, ...

    Returns:
      the frames (frames, height, width, 3) uint8. All are rendered by one compiled function.

    Raises what `render`, `Camera.orbit` and `save_animation` do; of the path before rendering.
    """
    if path is not None:
        _animation_writer(path, fps)
    if "status" in options:
        raise ValueError("turntable has no option status: it raises what the status bits say.")
    count = _positive("frames", frames)
    view = {"elevation": elevation, "fov": fov, "zoom": zoom, "width": width, "height": height}
    background = _BLACK if background is None else background
    out = []
    with tqdm(
        total=count,
        disable=None if progress is None else not progress,
        desc="turntable",
        unit="frame",
    ) as bar:
        for k in range(count):
            camera = Camera.orbit(volume, azimuth=360.0 * k / count, **view)
            image = render(volume, camera, transfer, background=background, **options)
            out.append(_images.to_uint8(image[..., :3], srgb=srgb))
            bar.update()
    movie = np.stack(out)
    if path is not None:
        save_animation(path, movie, fps)
    return movie


def pixels(image: Any, background: Any = None, srgb: bool = False) -> np.ndarray:
    """An image as bytes for display: (H, W, 4) with straight alpha, or (H, W, 3) without.

    image: floats (H, W, 4), premultiplied, or (H, W, 3); bytes (uint8) stay as they are.
    background, srgb: as for `save_image`. Raises ValueError for what is no image and for NaN.
    """
    if getattr(image, "dtype", None) == np.uint8:
        image = np.asarray(image)
        _require_image(image)
        if srgb:
            raise ValueError("The image is bytes, which are coded already: leave out srgb.")
        if background is not None and image.shape[-1] == 4:
            raise ValueError("The image is bytes with straight alpha: pass floats to put it over.")
        return image
    image = _floats(image, background)
    if image.shape[-1] == 4:
        image = np.asarray(_images.unpremultiply(image))
    return _images.to_uint8(image, srgb=srgb)


def _floats(image: Any, background: Any) -> np.ndarray:
    """A checked image of floats, (H, W, 3) if it was put over a background."""
    image = np.asarray(as_floats("image", image))
    _require_image(image)
    require_finite("image", image)
    if image.shape[-1] == 4 and background is not None:
        as_light("background", background)
        image = np.asarray(_images.composite_over(image, background))[..., :3]
    return image


def _require_image(image: Any) -> None:
    if image.ndim != 3 or image.shape[-1] not in (3, 4) or 0 in image.shape:
        raise ValueError(f"An image is (H, W, 4) or (H, W, 3), but this one is {image.shape}.")


def _opaque_behind(image: Any) -> Any:
    return None if getattr(image, "dtype", None) == np.uint8 else _BLACK


def _writer_for(path: Any, writers: dict[str, Callable[..., Any]], what: str) -> Any:
    """The writer for a path's suffix, if there is its folder."""
    path = Path(path)
    write = writers.get(path.suffix.lower())
    if write is None:
        *some, last = writers
        raise ValueError(
            f"{what} is written as {', '.join(some)} or {last}, but the path is {str(path)!r}."
        )
    if not path.parent.is_dir():
        raise FileNotFoundError(
            f"There is no folder {str(path.parent)!r} to write {path.name!r} in. Make it first."
        )
    require_place(path, what)
    return write


def _write_png(path: Path, image: Any, background: Any, srgb: bool) -> None:
    from PIL import Image

    made = Image.fromarray(pixels(image, background, srgb))
    with whole_file(path) as file:
        made.save(file, format="PNG")


def _write_npy(path: Path, image: Any, background: Any, srgb: bool) -> None:
    _refuse_srgb(path, srgb)
    if getattr(image, "dtype", None) == np.uint8:
        image = pixels(image, background)
    else:
        checked = _floats(image, background)
        # As it is: `_floats` may have rounded float64, where JAX has it switched off.
        image = checked if background is not None else np.asarray(image)
    with whole_file(path) as file:
        np.save(file, image)


def _write_exr(path: Path, image: Any, background: Any, srgb: bool) -> None:
    _refuse_srgb(path, srgb)
    if getattr(image, "dtype", None) == np.uint8:
        raise ValueError("An .exr file holds linear floats, but the image is bytes.")
    image = np.ascontiguousarray(_floats(image, background), np.float32)
    module = _openexr()
    header = {"compression": module.ZIP_COMPRESSION, "type": module.scanlineimage}
    channels = {"RGBA" if image.shape[-1] == 4 else "RGB": image}
    with beside(path) as part, module.File(header, channels) as file:
        file.write(str(part))


def _refuse_srgb(path: Path, srgb: bool) -> None:
    if srgb:
        raise ValueError(f"{path.suffix} files hold linear floats: leave out srgb.")


def _openexr() -> Any:
    try:
        module = importlib.import_module("OpenEXR")
    except ImportError:
        module = None
    if not hasattr(module, "File"):  # before version 3.3
        raise ValueError(
            ".exr files need the package OpenEXR, 3.3 or newer: pip install 'OpenEXR>=3.3'. "
            ".npy files hold the same floats without it."
        )
    return module


_IMAGES = {".png": _write_png, ".npy": _write_npy, ".exr": _write_exr}


def _animation_writer(path: Any, fps: Any) -> Callable[..., list[Path]]:
    """What writes an animation to this path; raises what is wrong with either."""
    write = _writer_for(path, _ANIMATIONS, "An animation")
    if not isinstance(fps, int | float | np.number) or not 0 < fps < np.inf:
        raise ValueError(f"fps must be a number above 0, but is {fps!r}.")
    if write is _write_gif and fps > 50:
        raise ValueError(f"A .gif file shows at most 50 frames a second, but fps is {fps:g}.")
    if write is _write_mp4:
        _ffmpeg()
    return write


def _write_frames(path: Path, movie: np.ndarray, fps: float) -> list[Path]:
    digits = max(3, len(str(len(movie) - 1)))
    out = []
    for k, frame in enumerate(movie):
        out.append(path.with_name(f"{path.stem}_{k:0{digits}d}{path.suffix}"))
        _write_png(out[-1], frame, None, False)
    return out


def _write_gif(path: Path, movie: np.ndarray, fps: float) -> list[Path]:
    from PIL import Image

    palette, indices = _indexed(movie)
    flat = palette.ravel().tolist()
    images = []
    for index in indices:
        images.append(Image.fromarray(index))
        images[-1].putpalette(flat)
    # GIF counts hundredths of a second: what one frame loses by rounding, another gets.
    ends = np.rint(100 * np.arange(len(movie) + 1) / fps).astype(int)
    durations = (10 * np.maximum(np.diff(ends), 2)).tolist()
    with whole_file(path) as file:
        images[0].save(
            file,
            format="GIF",
            save_all=True,
            append_images=images[1:],
            duration=durations,
            loop=0,
            optimize=False,
        )
    return [path]


def _indexed(movie: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A palette (256, 3) uint8 for all frames (n, H, W, 3) uint8, and their indices (n, H, W).

    At most 256 colours stay what they are. Of more, the most common one does, which is the
    background; 255 others are found by median cut among all colours, each counted once so that
    small bright parts get their share. The rest are mixed by ordered dithering (Bayer, "An optimum
    method for two-level rendition of continuous-tone pictures", 1973).
    """
    from PIL import Image

    red, green, blue = (movie[..., c].astype(np.int32) for c in range(3))
    codes = red << 16 | green << 8 | blue
    numbers = np.zeros(1 << 24, np.int32)
    for code in codes:
        found, count = np.unique(code, return_counts=True)
        numbers[found] += count
    used = np.flatnonzero(numbers)
    colors = np.stack([used >> 16, used >> 8 & 255, used & 255], axis=-1).astype(np.uint8)
    if len(used) <= 256:
        palette = np.pad(colors, ((0, 256 - len(used)), (0, 0)))
        table = np.zeros(1 << 24, np.uint8)
        table[used] = np.arange(len(used))
        return palette, table[codes]
    cut = Image.fromarray(colors[None]).quantize(255, method=Image.Quantize.MEDIANCUT)
    others = np.array(cut.getpalette(), np.uint8).reshape(-1, 3)[:255]
    palette = np.concatenate([colors[numbers[used].argmax()][None], others])
    palette = np.pad(palette, ((0, 256 - len(palette)), (0, 0)), mode="edge")
    tables = [np.zeros(1 << 24, np.uint8) for _ in range(3)]
    for k in range(0, len(used), 1 << 16):
        part = used[k : k + (1 << 16)]
        for table, numbers in zip(
            tables, _mixtures(colors[k : k + len(part)], palette), strict=True
        ):
            table[part] = numbers
    bayer = np.zeros((1, 1), int)
    for _ in range(3):
        bayer = np.block([[4 * bayer, 4 * bayer + 2], [4 * bayer + 3, 4 * bayer + 1]])
    height, width = movie.shape[1:3]
    threshold = np.tile(bayer, (-(-height // 8), -(-width // 8)))[:height, :width]
    first, second, part = tables
    return palette, np.stack(
        [np.where(part[code] > threshold, second[code], first[code]) for code in codes]
    )


def _mixtures(colors: np.ndarray, palette: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each colour (n, 3) the nearest in the palette, the one to mix it with, and how much of
    that, 0 to 32 of 64 parts: (n,), (n,), (n,)."""
    from scipy.spatial import KDTree

    colors, palette = colors.astype(float), palette.astype(float)
    near: Any = KDTree(palette).query(colors, k=8)[1]
    first = palette[near[:, :1]]
    across, gap = palette[near[:, 1:]] - first, colors[:, None] - first
    square = (across**2).sum(-1)
    t = np.clip((across * gap).sum(-1) / np.maximum(square, 1), 0, 0.5)
    # What the mixture is off by, and something for its grain.
    off = ((gap - t[..., None] * across) ** 2).sum(-1) + 0.02 * t * (1 - t) * square
    best = off.argmin(-1)[:, None]
    second, t = (np.take_along_axis(x, best, axis=1)[:, 0] for x in (near[:, 1:], t))
    return near[:, 0], second, np.rint(64 * t)


def _write_mp4(path: Path, movie: np.ndarray, fps: float) -> list[Path]:
    # H.264 halves the colours' resolution, and so wants even sizes.
    height, width = movie.shape[1:3]
    movie = np.pad(movie, ((0, 0), (0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    size = f"{movie.shape[2]}x{movie.shape[1]}"
    # Players take what is not tagged for BT.709, ffmpeg converts by BT.601 unless told.
    color = "-colorspace bt709 -color_primaries bt709 -color_trc bt709 -color_range tv"
    command = [
        _ffmpeg(),
        *("-y", "-loglevel", "error"),
        *("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", f"{fps:g}", "-i", "-"),
        *("-an", "-vf", "scale=out_color_matrix=bt709:out_range=tv"),
        *("-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "18", *color.split()),
        *("-movflags", "+faststart"),
    ]
    with beside(path) as part:
        command.append(str(part.absolute()))
        done = subprocess.run(command, input=movie.tobytes(), capture_output=True, check=False)
        if done.returncode:
            said = done.stderr.decode(errors="replace").strip().splitlines() or ["nothing"]
            raise RuntimeError(f"{command[0]} could not write {str(path)!r}. It said: {said[-1]}")
    return [path]


def _ffmpeg() -> str:
    """The program on the PATH, else that of the package imageio-ffmpeg."""
    if found := shutil.which("ffmpeg"):
        return found
    try:
        return importlib.import_module("imageio_ffmpeg").get_ffmpeg_exe()
    except (ImportError, RuntimeError):
        raise ValueError(
            ".mp4 files need ffmpeg: install the program, or pip install imageio-ffmpeg. "
            ".gif files need neither."
        ) from None


_ANIMATIONS = {".gif": _write_gif, ".mp4": _write_mp4, ".png": _write_frames}


def _positive(name: str, n: Any) -> int:
    try:
        n = operator.index(n)
    except TypeError:
        raise ValueError(f"{name} must be a whole number, but is {n!r}.") from None
    if n < 1:
        raise ValueError(f"{name} must be at least 1, but is {n}.")
    return n
