"""`Orbit`: a camera as a hand moves it, round a target, by angles, distance and shifts."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from jaxvr._core.units import norm
from jaxvr.view.camera import Camera, orbit_axes

# A hand stops before straight up or down, where a turn of the azimuth turns the picture.
STEEPEST = 89.0
ZOOMS = (0.05, 100.0)
AXES = {
    f"{sign}{n}": np.eye(3)[k] * float(f"{sign}1")
    for sign in ("", "-")
    for k, n in enumerate("xyz")
}


@dataclasses.dataclass(frozen=True)
class Orbit:
    """Where from: angles in degrees about `axes`, as in `Camera.orbit`.

    target (3,): a point in the middle of the picture. axes (3, 3): the directions that azimuth 90,
    elevation 90 and neither look from; the second is up. zoom: at 1 a ball of that radius fits the
    picture. fov: full vertical angle in degrees of a pinhole; None for parallel rays, which start
    at `distance` from the target.
    """

    target: np.ndarray
    axes: np.ndarray
    azimuth: float
    elevation: float
    zoom: float
    radius: float
    fov: float | None
    distance: float

    @staticmethod
    def of(camera: Camera, radius: float) -> Orbit:
        """The orbit that a camera is on, for a volume in a ball of that radius."""
        (eye, target), up = camera.absolute(), np.asarray(camera.up, np.float64)
        axes = orbit_axes(up)
        out = eye - target
        distance = norm(out)
        x, y, z = axes @ (out / distance)
        if camera.fov is not None:
            fov = float(camera.fov)
            zoom = radius / math.sin(math.radians(fov) / 2) / distance
        else:
            fov, zoom = None, 2 * radius / float(np.asarray(camera.extent))
        return Orbit(
            target,
            axes,
            azimuth=math.degrees(math.atan2(x, z)),
            elevation=_between(math.degrees(math.asin(_between(y, -1, 1))), -STEEPEST, STEEPEST),
            zoom=zoom,
            radius=radius,
            fov=fov,
            distance=distance,
        )

    def turned(self, azimuth: float, elevation: float) -> Orbit:
        """By degrees; the elevation stays below 90, the azimuth in [-180, 180)."""
        if elevation:
            elevation = _between(self.elevation + elevation, -STEEPEST, STEEPEST)
        else:
            elevation = self.elevation  # from straight above a picture may be turned
        return self.seen_from(self.azimuth + azimuth, elevation)

    def seen_from(self, azimuth: float, elevation: float) -> Orbit:
        """From these angles in degrees, 90 for straight above."""
        azimuth, elevation = float(azimuth), float(elevation)
        if not (math.isfinite(azimuth) and math.isfinite(elevation)):
            raise ValueError(f"Angles must be degrees, but are {azimuth} and {elevation}.")
        return dataclasses.replace(
            self, azimuth=(azimuth + 180) % 360 - 180, elevation=_between(elevation, -90, 90)
        )

    def upright(self, name: str) -> Orbit:
        """With another axis up, "z" or "-y", from the same angles about that one."""
        if name not in AXES:
            raise ValueError(f"up must be one of {', '.join(AXES)}, but is {name!r}.")
        return dataclasses.replace(self, axes=orbit_axes(AXES[name]))

    @property
    def up(self) -> str:
        """The axis that is up, such as "z" or "-y", or three numbers for another direction."""
        return _axis(self.axes[1]) or "(" + ", ".join(f"{x:.3g}" for x in self.axes[1]) + ")"

    @property
    def from_axis(self) -> str:
        """The axis that the view looks from, such as "x" or "-z"; "" for another direction."""
        return _axis(self._basis()[2])

    def zoomed(self, factor: float) -> Orbit:
        """Closer by a factor above 0."""
        return dataclasses.replace(self, zoom=_between(self.zoom * factor, *ZOOMS))

    def shifted(self, right: float, up: float) -> Orbit:
        """The picture moves by parts of its height, and the target the other way."""
        side, true_up, _ = self._basis()
        if self.fov is None:
            height = 2 * self.radius / self.zoom
        else:
            height = 2 * self._away() * math.tan(math.radians(self.fov) / 2)
        return dataclasses.replace(
            self, target=self.target - height * (right * side + up * true_up)
        )

    def camera(self, width: int, height: int, dtype: Any = None) -> Camera:
        """The view with that many pixels."""
        _, true_up, out = self._basis()
        eye = self.target + self._away() * out
        # Straight above, the axis that is up shows no upper side of the picture.
        up = self.axes[1] if abs(self.elevation) <= STEEPEST else true_up
        if self.fov is not None:
            return Camera.look_at(eye, self.target, up, self.fov, width, height, dtype=dtype)
        extent = 2 * self.radius / self.zoom
        return Camera.orthographic(eye, self.target, up, extent, width, height, dtype=dtype)

    def _away(self) -> float:
        """From the target to the eye."""
        if self.fov is None:
            return self.distance
        return self.radius / math.sin(math.radians(self.fov) / 2) / self.zoom

    def _basis(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Right and up in the picture, and the direction from the target to the eye."""
        a, e = math.radians(self.azimuth), math.radians(self.elevation)
        x, y, z = self.axes
        out = math.cos(e) * (math.sin(a) * x + math.cos(a) * z) + math.sin(e) * y
        side = math.cos(a) * x - math.sin(a) * z
        return side, np.cross(out, side), out


def _axis(direction: np.ndarray) -> str:
    """The axis of the world that a unit vector is, but for rounding, or ""."""
    return next((n for n, axis in AXES.items() if np.abs(direction - axis).max() < 1e-6), "")


def _between(x: float, low: float, high: float) -> float:
    return min(max(float(x), low), high)
