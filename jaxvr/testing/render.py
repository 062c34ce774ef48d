"""`assert_render_close`: a picture against brute force."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxvr._core.status import check
from jaxvr.render import render, render_rays
from jaxvr.testing.brute import AROUND, BruteForce
from jaxvr.view import Camera

CHANNELS = ("red", "green", "blue", "alpha")
# In each dtype: the difference that is rounding, and how far a ray may lie from where it is meant
# to lie, in diagonals of the mesh.
ATOL = {"float32": 5e-5, "float64": 1e-11}
SLACK = {"float32": 4e-7, "float64": 1e-14}


def camera_rays(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Origins and unit directions (height, width, 3) of a camera's rays, in float64 NumPy.

    The formulas of `Camera`, written once more: forward = normalize(target - eye), right =
    normalize(forward x up), true_up = right x forward; the ray of pixel (i, j) goes through x =
    ((2j + 1)/width - 1) * half * width/height and y = (1 - (2i + 1)/height) * half, where half is
    tan(fov/2) of a pinhole's full vertical angle, or half of the extent of an orthographic camera.
    """
    (eye, target), up = camera.absolute(), np.asarray(camera.up, np.float64)
    width, height = camera.width, camera.height

    def unit(v):
        return v / np.linalg.norm(v, axis=-1, keepdims=True)

    forward = unit(target - eye)
    right = unit(np.cross(forward, up))
    true_up = np.cross(right, forward)
    if camera.extent is None:
        half = np.tan(np.deg2rad(np.float64(np.asarray(camera.fov))) / 2)
    else:
        half = np.float64(np.asarray(camera.extent)) / 2
    x = ((2 * np.arange(width) + 1) / width - 1) * half * width / height
    y = (1 - (2 * np.arange(height) + 1) / height) * half
    aside = x[None, :, None] * right + y[:, None, None] * true_up
    if camera.extent is None:
        return np.broadcast_to(eye, aside.shape).copy(), unit(forward + aside)
    return eye + aside, np.broadcast_to(forward, aside.shape).copy()


def brute_force(
    volume: Any, camera: Any, transfer: Any, background: Any = None, exact: Any = None
) -> np.ndarray:
    """The picture (height, width, 4), or what rays (..., 3) see (..., 4), in float64 NumPy.

    volume: a `TetMesh`. camera: a `Camera`, or rays (origins, directions) with shapes (..., 3).
    transfer: a `TransferFunction`. background: opaque RGB (3,), or None.
    exact: the dtype of the geometry; None for `np.longdouble`, float64 is three times as fast.

    Shares no code with `render`: see `BruteForce`. About 10,000 rays a second on 1,000 cells.
    """
    reference = BruteForce(volume, np.longdouble if exact is None else exact)
    origins, directions = _rays(camera)
    shape = origins.shape[:-1]
    rgba, _ = reference.render(origins.reshape(-1, 3), directions.reshape(-1, 3), transfer)
    return _over(rgba, background).reshape(*shape, 4)


def assert_render_close(
    volume: Any,
    camera: Any,
    transfer: Any,
    *,
    atol: float | None = None,
    slack: float | None = None,
    background: Any = None,
    image: Any = None,
    **how: Any,
) -> float:
    """Renders, and asks for the picture that brute force sees.

    Args:
      volume, camera, transfer, background: as for `brute_force`.
      atol: the largest difference of a channel; None for 1e-11 in float64 and 5e-5 in float32.
        Approximate integrators and early termination need more.
      slack: where a ray lies in the boundary, or between cells with different values, or passes
        through a jump of the field, it has no value of its own. A pixel that is off is therefore
        seen again along twelve rays, each moved sideways by this share of the mesh's diagonal; it
        is right if it lies within `atol` of the range of what those see. None for 1e-14 in float64
        and 4e-7 in float32; 0 for no second look.
      image: what to judge, from a renderer of your own; None renders with `jaxvr.render`, or with
        `render_rays` where `camera` is rays.
      how: what else `render` takes: tracer, integrator, compositor, adjoint, budget.

    Returns:
      The largest difference, pixels without a value of their own left out.

    Raises:
      AssertionError: says how many pixels are off, which is the worst, by how much, its ray, and
        how many cells that crosses. RenderError: if a ray could not be followed.
    """
    dtype = np.dtype(volume.points.dtype).name
    atol = ATOL[dtype] if atol is None else atol
    slack = SLACK[dtype] if slack is None else slack
    if image is None:
        if isinstance(camera, Camera):
            found = render(volume, camera, transfer, background=background, status=True, **how)
        else:
            origins, directions = camera
            found = render_rays(
                *(volume, origins, directions, transfer),
                background=background,
                status=True,
                **how,
            )
        image, status = found  # asked for, so that odd views, which are meant, give no warning
        check(status)
    origins, directions = _rays(camera)
    shape = origins.shape[:-1]
    found = np.asarray(image, np.float64)
    if found.shape != (*shape, 4):
        raise AssertionError(f"The image has shape {found.shape}, but should have {(*shape, 4)}.")
    found, origins, directions = (x.reshape(-1, x.shape[-1]) for x in (found, origins, directions))
    reference = BruteForce(volume)
    want = _over(reference.render(origins, directions, transfer)[0], background)
    off = np.abs(found - want)
    off[~np.isfinite(found)] = np.inf
    for_itself = np.ones(len(off), bool)
    doubt = np.flatnonzero((off > atol).any(1))
    if len(doubt) and slack:
        seen = np.stack(
            [
                _over(
                    reference.render(origins[doubt], directions[doubt], transfer, shift=slack * u)[
                        0
                    ],
                    background,
                )
                for u in AROUND
            ]
        )
        low, high = np.minimum(seen.min(0), want[doubt]), np.maximum(seen.max(0), want[doubt])
        beside = np.maximum(low - found[doubt], found[doubt] - high)
        beside[~np.isfinite(found[doubt])] = np.inf
        fine = (beside <= atol).all(1)
        for_itself[doubt[fine]] = False
        doubt = doubt[~fine]
    if len(doubt):
        worst = doubt[off[doubt].max(1).argmax()]
        channel = int(off[worst].argmax())
        pixel = tuple(int(i) for i in np.unravel_index(worst, shape)) if shape else ()
        cells = len(reference.pieces(origins[worst][None], directions[worst][None]).cell)
        raise AssertionError(
            f"{len(doubt)} of {len(off)} pixels are off by more than {atol:.3g}. The worst is "
            f"{pixel}: its {CHANNELS[channel]} is {found[worst, channel]:.9g}, brute force sees "
            f"{want[worst, channel]:.9g}, a difference of {off[worst, channel]:.3g}. Its ray "
            f"starts at {origins[worst].tolist()}, goes along {directions[worst].tolist()}, and "
            f"crosses {cells} cells."
        )
    return float(off[for_itself].max(initial=0.0))


def _rays(camera: Any) -> tuple[np.ndarray, np.ndarray]:
    if isinstance(camera, Camera):
        return camera_rays(camera)
    origins, directions = (np.asarray(x, np.float64) for x in camera)
    return np.broadcast_arrays(origins, directions)  # pyright: ignore[reportReturnType]


def _over(rgba: np.ndarray, background: Any) -> np.ndarray:
    if background is None:
        return rgba
    behind = np.concatenate([np.asarray(background, np.float64), [1.0]])
    return rgba + (1 - rgba[:, 3:]) * behind
