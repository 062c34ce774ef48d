"""`load_image`: pictures from files, as `render` gives them: premultiplied linear RGBA floats.

What a file's numbers mean is not in the numbers: full scale (255, 65535 or 1), whether light is
coded for display (sRGB), whether colours are multiplied by alpha. The format decides the first and
the last, the caller the second, and what the file says of itself is told where it was not asked.
"""

from __future__ import annotations

import contextlib
import importlib
import os
from pathlib import Path
from typing import Any

import numpy as np

from jaxvr._core.checks import as_light, require_finite, require_light
from jaxvr._core.warn import warn
from jaxvr._core.writing import place_of, shown
from jaxvr.view.images import composite_over

_MARGIN = 1 / 510  # half a step of 8 bits
_FULL = {np.dtype("u1"): 255, np.dtype("u2"): 65535}
# PNG's ways to store 16 bits, and those that read the same bytes so that the lower ones come out.
_LOWER = {"RGB;16B": "RGB;16L", "RGBA;16B": "RGBA;16L"}
_ORIENTATION = 0x0112  # a tag of EXIF


class PictureWarning(UserWarning):
    """A file whose numbers may mean something else than they were taken for."""


def load_image(
    path: str | os.PathLike[str],
    *,
    srgb: bool | None = None,
    alpha: str | None = None,
    background: Any = None,
    dtype: Any = None,
) -> np.ndarray:
    """A picture from a file, (H, W, 4) premultiplied linear RGBA, row 0 on top, as `render` has it.

    What `jaxvr.save_image` wrote comes back: to half a step of 8 bits from .png (of straight
    colours), as it was from .npy and .exr.

    Args:
      path: .npy, .exr (needs `pip install OpenEXR`, 3.3 or newer), or any picture that Pillow
        reads: .png with 8 or 16 bits, .jpg, .tif, .webp, ... Grey becomes three equal channels, no
        alpha an alpha of 1; a palette is looked up, and turned photographs are turned upright.
        Integers are divided by 255 or 65535.
      srgb: True decodes colours from sRGB to linear light; False takes the numbers as they stand,
        as colour maps mean them. None does so too, and warns where the file says of itself that its
        colours are coded (a PNG with an sRGB chunk or a gamma, a colour profile, any JPEG). Pass
        what `save_image` was called with. Not for .exr and floats, which are linear.
      alpha: "straight" or "premultiplied": whether colours are multiplied by alpha in the file;
        None: .exr and floats in .npy are premultiplied, all others straight, as the formats
        have it.
      background: linear RGB (3,) to put behind the picture, which is opaque then. It does not take
        away what a picture was made on: for that pass `background` to `jaxvr.fit`.
      dtype: of the result; None is float64 for files of float64, else float32.

    Raises:
      FileNotFoundError, or ValueError with the path: for what cannot be read, is damaged, has more
      than one frame, 32-bit integers, a colour space other than RGB or grey, floats that are bytes
      (above 10) or not finite. Warns with a `jaxvr.view.PictureWarning` of `srgb` as above, of a
      colour profile that is not sRGB, and of numbers outside of 0 to 1.
    """
    if alpha not in (None, "straight", "premultiplied"):
        raise ValueError(f'alpha must be "straight" or "premultiplied", but is {alpha!r}.')
    if srgb not in (None, True, False):
        raise ValueError(f"srgb must be True, False or None, but is {srgb!r}.")
    place = place_of(path)
    name = shown(path)
    if not place.exists():
        raise FileNotFoundError(f"There is no file {name}.")
    if not place.is_file():
        raise ValueError(f"{name} is no file.")
    suffix = (os.path.splitext(os.fspath(path))[1] or place.suffix).lower()  # links may have none
    read = {".npy": _npy, ".exr": _exr}.get(suffix, _pillow)
    try:
        pixels, coded, straight = read(place)
    except _Told as e:
        raise ValueError(f"{name} {e}") from e
    except PermissionError as e:
        raise PermissionError(f"{name} cannot be read: {e.strerror}.") from e
    except Exception as e:
        raise ValueError(
            f"{name} cannot be read as a picture ({str(e)[:200] or type(e).__name__}). It "
            "may be damaged, or not what its suffix says."
        ) from e
    if pixels.ndim != 3 or pixels.shape[-1] not in (1, 2, 3, 4) or 0 in pixels.shape:
        raise ValueError(f"{name} holds {pixels.shape}, and no picture (H, W), (H, W, 3 or 4).")
    linear = pixels.dtype.kind == "f"
    image = _scaled(name, pixels)
    if srgb and linear:
        raise ValueError(f"{name} holds linear floats: leave out srgb.")
    if srgb is None and coded is not None:
        warn(
            f"{name} says that its colours are coded for display ({coded}), but they are taken as "
            "they stand. Pass srgb=True for linear light, or srgb=False if this is meant.",
            PictureWarning,
        )
    if srgb and coded is not None and coded.startswith("profile") and "srgb" not in coded.lower():
        warn(f"{name} has the {coded}, but is decoded as sRGB.", PictureWarning)
    image = _rgba(image)
    if srgb:
        image[..., :3] = _decoded(image[..., :3])
    if alpha == "straight" or (alpha is None and straight):
        image[..., :3] *= image[..., 3:]
    if background is not None:
        as_light("background", background)
        image = np.array(composite_over(image, background))
    if dtype is None:
        dtype = np.float64 if pixels.dtype == np.float64 else np.float32
    return image.astype(dtype)


class _Told(ValueError):
    """What is wrong with a file, in words that follow its name."""


def _scaled(name: str, pixels: np.ndarray) -> np.ndarray:
    """Floats of which 1 is full intensity, float64."""
    if full := _FULL.get(pixels.dtype.newbyteorder("=")):
        return pixels.astype(np.float64) / full
    if pixels.dtype.kind != "f":
        raise ValueError(
            f"{name} holds {pixels.dtype}, whose full intensity is not known. Divide the numbers "
            "by it and save floats."
        )
    image = pixels.astype(np.float64)
    require_finite(name, image)
    require_light(name, image)
    least, most = float(image.min()), float(image.max())
    if least < -_MARGIN or most > 1 + _MARGIN:
        found = f"from {least:.4g} to {most:.4g}"
        warn(f"{name} has numbers {found}, outside of 0 to 1.", PictureWarning)
    return image


def _rgba(image: np.ndarray) -> np.ndarray:
    channels = image.shape[-1]
    color, alpha = image[..., : 1 if channels < 3 else 3], np.ones((*image.shape[:2], 1))
    if channels in (2, 4):
        alpha = image[..., -1:]
    return np.concatenate([np.broadcast_to(color, (*image.shape[:2], 3)), alpha], axis=-1)


def _decoded(x: np.ndarray) -> np.ndarray:
    """sRGB to linear in float64, which JAX may have switched off."""
    return np.where(x <= 0.04045, x / 12.92, ((np.maximum(x, 0) + 0.055) / 1.055) ** 2.4)


def _npy(place: Path) -> tuple[np.ndarray, str | None, bool]:
    # Mapped first: a header that asks for more than the file has is an error, and no allocation.
    mapped = np.load(place, mmap_mode="r", allow_pickle=False)
    array = np.array(mapped[..., None] if mapped.ndim == 2 else mapped)
    return array, None, array.dtype.kind != "f"


def _exr(place: Path) -> tuple[np.ndarray, str | None, bool]:
    module: Any = None
    with contextlib.suppress(ImportError):
        module = importlib.import_module("OpenEXR")
    if not hasattr(module, "File"):
        raise _Told(
            "needs the package OpenEXR, 3.3 or newer: pip install OpenEXR. "
            ".npy files hold the same floats without it."
        )
    with module.File(str(place), separate_channels=True) as file:
        header = file.header()
        shown_window, data = (
            np.ravel(header[key]).tolist() for key in ("displayWindow", "dataWindow")
        )
        if len(file.parts) != 1 or shown_window != data:
            raise _Told("has several parts, or a data window that is not the whole picture.")
        channels = {key: np.array(c.pixels) for key, c in file.channels().items()}
    wanted = ["Y"] if "Y" in channels and "R" not in channels else ["R", "G", "B"]
    if missing := [c for c in wanted if c not in channels]:
        raise _Told(f"lacks the channels {missing}; it has {sorted(channels)}.")
    wanted += ["A"] if "A" in channels else []
    return np.stack([channels[c].astype(np.float32) for c in wanted], -1), None, False


def _pillow(place: Path) -> tuple[np.ndarray, str | None, bool]:
    from PIL import Image, ImageOps

    with Image.open(place) as picture:
        if getattr(picture, "n_frames", 1) > 1:
            raise _Told(f"holds {getattr(picture, 'n_frames')} frames. Save one of them alone.")  # noqa: B009
        coded = _coding(picture)
        transparent = picture.info.get("transparency")
        tile: Any = picture.tile[0] if picture.tile else (None, None, None, "")
        way = tile[3] if isinstance(tile[3], str) else ""
        if way.endswith(";16B") and picture.format == "PNG":
            pixels = _sixteen_bits(place, picture, way)
            if transparent is not None:
                opaque = (pixels != np.asarray(transparent)).any(-1, keepdims=True)
                pixels = np.concatenate([pixels, np.where(opaque, 65535, 0)], -1).astype(np.uint16)
            return _upright(pixels, picture.getexif().get(_ORIENTATION, 1)), coded, True
        mode = picture.mode
        if mode in ("RGBa", "La"):
            picture = picture.convert("RGBA")  # Pillow's way to divide
        elif mode == "P" or (mode in ("1", "L", "RGB") and transparent is not None):
            picture = picture.convert("RGB" if transparent is None else "RGBA")
        elif mode == "PA":
            picture = picture.convert("RGBA")
        elif mode == "1":
            picture = picture.convert("L")
        if picture.mode == "I":
            raise _Told("holds 32-bit integers, whose full intensity is not known.")
        if picture.mode not in ("L", "LA", "RGB", "RGBA", "F") and not mode.startswith("I;16"):
            raise _Told(f"has the colour space {mode}. Convert it to RGB first.")
        pixels = np.asarray(ImageOps.exif_transpose(picture))
    return pixels[..., None] if pixels.ndim == 2 else pixels, coded, True


def _upright(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Turned and mirrored as EXIF says (1 to 8), for which Pillow has pictures of 8 bits only."""
    if orientation in (5, 6, 7, 8):
        pixels = pixels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return pixels


def _sixteen_bits(place: Path, picture: Any, way: str) -> np.ndarray:
    """All bits of a PNG of 16. Pillow keeps the upper eight of colours, and decodes the others if
    it takes the bytes of each number the other way round."""
    from PIL import Image

    if way == "I;16B":
        pixels = np.asarray(picture)
        return pixels.astype(np.uint16)[..., None]
    upper = np.asarray(picture)
    with Image.open(place) as again:
        tile = again.tile[0]
        if way == "LA;16B":  # as four bytes a pixel
            again.tile = [(*tile[:3], "RGBA")]  # type: ignore[list-item]
            both = np.asarray(again).astype(np.uint16)
            pixels = both[..., 0::2] << 8 | both[..., 1::2]
        else:
            again.tile = [(*tile[:3], _LOWER[way])]  # type: ignore[list-item]
            pixels = upper.astype(np.uint16) << 8 | np.asarray(again)
    high = pixels >> 8
    if not np.array_equal(high, upper[..., -high.shape[-1] :]):
        raise _Told("has 16 bits, of which this version of Pillow reads eight.")
    return pixels


def _coding(picture: Any) -> str | None:
    """What a file says of the coding of its colours."""
    info = picture.info
    if profile := info.get("icc_profile"):
        return f"profile {_described(profile)}"
    if "srgb" in info:
        return "an sRGB chunk"
    if abs(info.get("gamma", 1.0) - 1) > 0.01:
        return f"a gamma of {info['gamma']:.4g}"
    return "JPEG" if picture.format in ("JPEG", "MPO") else None


def _described(profile: bytes) -> str:
    from io import BytesIO

    try:
        from PIL import ImageCms

        return ImageCms.getProfileDescription(ImageCms.ImageCmsProfile(BytesIO(profile))).strip()
    except Exception:
        return "that cannot be read"
