"""The pictures that a fit is given: floats of the right shapes, and such as a render can reach.

Pictures come from elsewhere: as bytes, with colours not multiplied by alpha, on a background that
nobody named. Bytes are refused; what no transfer function could reach is told before the fit.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from jaxvr._core.checks import as_floats, refuse_bytes, require_light
from jaxvr._core.warn import warn
from jaxvr.fit.parameters import Parameters, Sigmoid
from jaxvr.hints import ViewWarning

# Half a step of 8 bits: what rounding to bytes can add.
_MARGIN = 1 / 510


def pictures_of(targets: Any) -> list[Any]:
    """Targets as a list; one alone is a list of one."""
    if getattr(targets, "ndim", None) == 3:
        return [targets]
    try:
        return list(targets)
    except TypeError:
        raise ValueError(f"targets must be images, not {type(targets).__name__}.") from None


def images_of(
    targets: list[Any], shapes: list[tuple[int, int]], background: Any
) -> list[np.ndarray]:
    """Checked targets of views of these shapes (height, width). Raises ValueError."""
    if len(targets) != len(shapes):
        raise ValueError(f"There are {len(shapes)} cameras, but {len(targets)} targets.")
    out = []
    for k, (image, want) in enumerate(zip(targets, shapes, strict=True)):
        refuse_bytes(f"targets[{k}]", image)
        image = np.asarray(as_floats(f"targets[{k}]", image))
        if image.ndim != 3 or image.shape[:2] != want or image.shape[2] not in (3, 4):
            raise ValueError(
                f"targets[{k}] must have shape {(*want, 4)} as its camera has, "
                f"or {(*want, 3)}, but has {image.shape}."
            )
        require_light(f"targets[{k}]", image)
        out.append(image)
    channels = {x.shape[2] for x in out}
    if len(channels) > 1:
        raise ValueError("Some targets are RGBA and some RGB. Pass one kind.")
    if channels == {3} and background is None:
        raise ValueError(
            "Targets without alpha need background=, the colour (3,) that they were made on."
        )
    return out


def look_at_targets(images: list[np.ndarray], parameters: Parameters, background: Any) -> None:
    """Warns of targets that no picture of these parameters can be like."""
    low, high = _colors(parameters)
    back = np.zeros(3) if background is None else np.asarray(background, np.float64)
    least, most = min(low, 0.0, float(back.min())), max(high, 0.0, float(back.max()))
    for k, image in enumerate(images):
        rgb = image[..., :3]
        if message := _outside(f"targets[{k}]", rgb, least, most):
            warn(message, ViewWarning)
            break
    if images[0].shape[2] == 3:
        return
    for message in (
        _first(images, lambda k, x: _outside(f"The alpha of targets[{k}]", x[..., 3], 0.0, 1.0)),
        _first(images, lambda k, x: _straight(k, x, high) if background is None else None),
        _opacity(images, background),
    ):
        if message:
            warn(message, ViewWarning)


def _colors(parameters: Parameters) -> tuple[float, float]:
    """The least and the greatest colour that the parameters can reach; infinite if unknown."""
    transform = parameters.transforms.get("colors")
    if transform is None:
        colors = np.asarray(parameters.transfer.colors)
        return float(colors.min()), float(colors.max())
    if isinstance(transform, Sigmoid):
        return float(np.min(transform.low)), float(np.max(transform.high))
    return -math.inf, math.inf


def _first(images: list[np.ndarray], look: Any) -> str | None:
    return next(filter(None, (look(k, x) for k, x in enumerate(images))), None)


def _outside(name: str, x: np.ndarray, least: float, most: float) -> str | None:
    found = float(x.min()), float(x.max())
    if found[0] >= least - _MARGIN and found[1] <= most + _MARGIN:
        return None
    outside = int(((x < least - _MARGIN) | (x > most + _MARGIN)).sum())
    return (
        f"{name} has {outside:,} of {x.size:,} numbers outside of {least:g} to {most:g}, from "
        f"{found[0]:.4g} to {found[1]:.4g}: no picture of this fit can reach them. Clip them, or "
        "give the colours other bounds (free=)."
    )


def _straight(k: int, image: np.ndarray, high: float) -> str | None:
    """Whether colours are brighter than premultiplied ones can be."""
    over = image[..., :3].max(-1) - max(high, 0.0) * image[..., 3]
    number = int((over > 2 * _MARGIN).sum())
    if not number or not math.isfinite(high):
        return None
    return (
        f"targets[{k}] has {number:,} pixels whose colour exceeds their alpha, by up to "
        f"{over.max():.3g}: a premultiplied picture has none. Multiply colours by alpha, or "
        "load the file with jaxvr.load_image."
    )


def _opacity(images: list[np.ndarray], background: Any) -> str | None:
    """Whether alpha and background contradict each other."""
    least = min(float(x[..., 3].min()) for x in images)
    if background is None and least >= 1 - _MARGIN:
        return (
            "All targets are opaque everywhere, as pictures on a background are, but there is "
            "none: the fit will fill the views. Pass background=, the colour they were made on."
        )
    if background is not None and least < 1 - _MARGIN:
        return (
            f"The targets are transparent (alpha down to {least:.3g}), but with background= all "
            "pictures are opaque. Leave it out, or put the targets over it with "
            "jaxvr.view.composite_over."
        )
    return None
