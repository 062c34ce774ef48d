"""Pictures as arrays: how alike two are, what is behind them, how they are coded for display.

An image is float (..., H, W, C), row 0 on top. Rendered ones have C = 4: premultiplied linear RGBA.
Everything here but `to_uint8` is differentiable and may be called under `jit`.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxvr._core.checks import (
    BRIGHTEST,
    as_floats,
    is_concrete,
    refuse_bytes,
    require_finite,
)

Array = jax.Array


def psnr(a: Any, b: Any, peak: float = 1.0) -> Array:
    """Peak signal-to-noise ratio () of images a and b in dB, 10 log10(peak^2 / mean squared
    difference).

    The mean is over all entries, alpha included if there is one. Equal images give +inf, with a
    derivative of zero. peak: full intensity; 255 for two images of bytes. Raises ValueError for
    different shapes, empty images, and bytes or numbers above ten times the peak where it is not
    said. (Noise may well lead a little below 0 or above the peak.)
    """
    a, b = _pair(a, b, peak)
    return psnr_of(a, b, peak)


def psnr_of(a: Any, b: Any, peak: Any = 1.0) -> Array:
    """`psnr` of floats that were looked at."""
    error = jnp.mean((a - b) ** 2)
    equal = error == 0
    return jnp.where(equal, jnp.inf, -10 * jnp.log10(jnp.where(equal, 1, error / peak**2)))


def ssim(a: Any, b: Any, peak: float = 1.0) -> Array:
    """Structural similarity (), at most 1: the mean over channels and windows.

    Wang et al., "Image quality assessment: from error visibility to structural similarity" (2004):
    an 11 x 11 Gaussian window of standard deviation 1.5 pixels, weights summing to one and so
    without Bessel's correction, K1 = 0.01, K2 = 0.03, only windows that lie inside the picture.
    `a` and `b` are (H, W) or (H, W, C), both sides at least 11, else ValueError. peak: what is full
    intensity, as for `psnr`.
    """
    a, b = _pair(a, b, peak)
    if a.ndim not in (2, 3) or min(a.shape[:2]) < 11:
        raise ValueError(f"ssim needs (H, W) or (H, W, C) with H, W >= 11, but got {a.shape}.")
    return ssim_of(a, b, peak)


@jax.jit
def ssim_of(a: Any, b: Any, peak: Any = 1.0) -> Array:
    """`ssim` of images that were looked at."""
    moments = jnp.stack([a, b, a * a, b * b, a * b])
    for axis in (1, 2):
        moments = _blur(moments, axis)
    mean_a, mean_b, aa, bb, ab = moments
    product, squares = mean_a * mean_b, mean_a**2 + mean_b**2
    c1, c2 = (0.01 * peak) ** 2, (0.03 * peak) ** 2
    luminance = (2 * product + c1) / (squares + c1)
    structure = (2 * (ab - product) + c2) / (aa + bb - squares + c2)
    return jnp.mean(luminance * structure)


def _blur(x: Array, axis: int) -> Array:
    weights = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    weights /= weights.sum()
    n = x.shape[axis] - 10
    return sum(
        (float(w) * jax.lax.slice_in_dim(x, k, k + n, axis=axis) for k, w in enumerate(weights)),
        start=jnp.zeros((), x.dtype),
    )


def composite_over(image: Any, background: Any) -> Array:
    """A premultiplied image (..., 4) over a background: image + (1 - alpha) * background.

    `background`: linear RGB (3,), opaque; premultiplied RGBA (4,); or an image of either kind that
    broadcasts against `image`. The result (..., 4) is premultiplied too.
    """
    refuse_bytes("image", image)
    image = as_floats("image", image)
    back = as_floats("background", background, dtype=image.dtype)
    if image.ndim == 0 or image.shape[-1] != 4:
        raise ValueError(f"image must be RGBA, shape (..., 4), but has {image.shape}.")
    if back.ndim == 0 or back.shape[-1] not in (3, 4):
        raise ValueError(f"background must have shape (..., 3) or (..., 4), but has {back.shape}.")
    back = jnp.asarray(back)
    if back.shape[-1] == 3:
        back = jnp.concatenate([back, jnp.ones((*back.shape[:-1], 1), back.dtype)], axis=-1)
    try:
        back = jnp.broadcast_to(back, image.shape)
    except ValueError:
        raise ValueError(f"background {back.shape} does not fit image {image.shape}.") from None
    return image + (1 - image[..., 3:]) * back


def unpremultiply(image: Any) -> Array:
    """Straight RGBA (..., 4) from premultiplied: colours divided by alpha, black where it is 0.

    The derivative at alpha = 0 is zero.
    """
    refuse_bytes("image", image)
    image = jnp.asarray(as_floats("image", image))
    if image.ndim == 0 or image.shape[-1] != 4:
        raise ValueError(f"image must be RGBA, shape (..., 4), but has {image.shape}.")
    alpha = image[..., 3:]
    some = alpha > 0
    rgb = jnp.where(some, image[..., :3] / jnp.where(some, alpha, 1), 0)
    return jnp.concatenate([rgb, alpha], axis=-1)


def linear_to_srgb(x: Any) -> Array:
    """sRGB (IEC 61966-2-1) code values from linear light, any shape; straight colours, no alpha.

    Negative numbers lie on the linear piece. Linear light 0 to 1 becomes 0 to 1.
    """
    _refuse_byte_codes(x)
    x = jnp.asarray(as_floats("x", x))
    dark = x <= 0.0031308
    power = jnp.where(dark, 1, x) ** (1 / 2.4)
    return jnp.where(dark, 12.92 * x, 1.055 * power - 0.055)


def srgb_to_linear(x: Any) -> Array:
    """The inverse of `linear_to_srgb`."""
    _refuse_byte_codes(x)
    x = jnp.asarray(as_floats("x", x))
    dark = x <= 0.04045
    power = ((jnp.where(dark, 1, x) + 0.055) / 1.055) ** 2.4
    return jnp.where(dark, x / 12.92, power)


def to_uint8(image: Any, srgb: bool = False) -> np.ndarray:
    """Bytes, same shape: 0 to 1 becomes 0 to 255, rounded to nearest, clipped outside.

    `srgb` codes linear light for display first (of four channels the first three). The colours are
    taken as they are: `unpremultiply` first where straight alpha is wanted. NaN is a ValueError,
    and so are integers, and whole numbers of which some exceed 10, which are bytes in floats.
    """
    refuse_bytes("image", image)
    image = as_floats("image", image)
    require_finite("image", image)
    if not is_concrete(image):
        raise ValueError("to_uint8 needs known numbers; call it outside jit and grad.")
    pixels = np.array(image, np.float64)
    if pixels.max(initial=0) > BRIGHTEST and (pixels == np.rint(pixels)).all():
        raise ValueError(
            f"image holds whole numbers up to {pixels.max():g}, but 1 is full intensity. Divide "
            "bytes by 255."
        )
    if srgb:
        rgb = pixels[..., :3] if pixels.ndim and pixels.shape[-1] == 4 else pixels
        rgb[...] = np.asarray(linear_to_srgb(np.clip(rgb, 0, 1)))
    return np.rint(np.clip(pixels, 0, 1) * 255).astype(np.uint8)


def _refuse_byte_codes(x: Any) -> None:
    """Plain numbers, such as 0 and 1, are no bytes; arrays of small integers are."""
    if isinstance(x, np.ndarray | jax.Array) and np.dtype(x.dtype).itemsize <= 2:
        refuse_bytes("x", x)


def _pair(a: Any, b: Any, peak: Any) -> tuple[Array, Array]:
    _require_peak(a, b, peak)
    a, b = jnp.asarray(as_floats("a", a)), jnp.asarray(as_floats("b", b))
    if a.shape != b.shape:
        raise ValueError(f"The images must have one shape, but have {a.shape} and {b.shape}.")
    if a.size == 0:
        raise ValueError(f"The images are empty: their shape is {a.shape}.")
    dtype = jnp.promote_types(a.dtype, b.dtype)
    return a.astype(dtype), b.astype(dtype)


def _require_peak(a: Any, b: Any, peak: Any) -> None:
    """ValueError for images in other units than `peak`, or than each other."""
    kinds = [getattr(np.dtype(getattr(x, "dtype", float)), "kind", "f") in "iub" for x in (a, b)]
    if not is_concrete(a, b, peak):
        return
    if kinds[0] != kinds[1] or (all(kinds) and float(peak) == 1):
        for name, x in (("a", a), ("b", b)):
            refuse_bytes(name, x, "For two images of bytes pass peak=255.")
    for name, x in (("a", a), ("b", b)):
        x = np.asarray(x)
        if x.dtype.kind not in "fiu" or x.size == 0:
            continue
        most = float(x.max())
        if most > BRIGHTEST * float(peak):
            raise ValueError(
                f"{name} holds {most:g}, but full intensity is peak={float(peak):g}. Divide bytes "
                "by 255, or pass another peak."
            )
