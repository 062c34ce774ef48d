"""`Viewer`: a volume, a view and a transfer function that change, and the picture of them.

While the camera moves pictures are rendered. Where it stands and the transfer function changes, its
segments are traced once, in the background, and from then on shaded. Only the very first picture
waits for a compiler: until a coarse one is compiled, in the background too, the exact one stands
in.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxvr._core import svg
from jaxvr._core.brief import is_known, spanned
from jaxvr._core.checks import require_kind
from jaxvr._core.status import check
from jaxvr.arguments import background_of, volume_of
from jaxvr.defaults import QUANTILES, UPS, best_up, default_transfer
from jaxvr.interact import edits as _edits
from jaxvr.interact.orbit import AXES, Orbit
from jaxvr.interact.pace import Pace
from jaxvr.interact.png import encode
from jaxvr.optics import AbstractIntegrator, Analytic, TransferFunction
from jaxvr.render import render, shade, trace
from jaxvr.trace import AbstractTracer, Segments
from jaxvr.view.camera import Camera
from jaxvr.volume import AbstractVolume

# More segments than this are not kept: views are rendered then.
SEGMENT_BYTES = 1 << 30
# Control points of a default transfer function: few enough to be moved by hand.
POINTS = 6
# Views by name: azimuth and elevation.
VIEWS = {
    "front": (0, 0),
    "right": (90, 0),
    "back": (180, 0),
    "left": (-90, 0),
    "top": (0, 90),
    "bottom": (0, -90),
}


class Frame(NamedTuple):
    """exact: at full size, else coarse. seconds: all that it took. compiled: whether some of them
    went into compiling."""

    png: bytes
    width: int
    height: int
    exact: bool
    seconds: float
    compiled: bool


class Viewer:
    """Arguments as for `jaxvr.explore`; no widget is needed, and none is known."""

    def __init__(
        self,
        volume: AbstractVolume,
        transfer: TransferFunction | None = None,
        camera: Camera | None = None,
        *,
        size: int = 512,
        coarse: int | None = None,
        tracer: AbstractTracer | None = None,
        integrator: AbstractIntegrator | None = None,
        background: Any = (1.0, 1.0, 1.0),
    ):
        volume = volume_of(volume)
        if camera is not None:
            require_kind("camera", camera, Camera)
        if coarse is not None and (not isinstance(coarse, int) or coarse < 1):
            raise ValueError(f"coarse must be pixels of a side, at least 1, but is {coarse!r}.")
        self.volume, self.tracer, self.integrator = volume, tracer, integrator
        self.background = background_of(background)
        self.range = volume.value_range()
        self._told = ""
        if transfer is None:
            transfer = default_transfer(volume, points=POINTS)
            self._told = _spans(transfer, *self.range)
        self._transfer = self._first_transfer = _transfer_of(transfer)
        # The axis that was chosen here, "" where the camera was given.
        self.chosen_up = "" if camera is not None else best_up(volume, self._transfer)
        if camera is None:
            camera = Camera.orbit(volume, up=UPS[self.chosen_up], width=size, height=size)
        self.orbit = self._first_orbit = Orbit.of(camera, volume.diagonal() / 2)
        self.width, self.height = camera.width, camera.height
        # Shading is faster than rendering, so it may have more pixels.
        self._paces = {
            "render": Pace(self.width, self.height, coarse),
            "shade": Pace(self.width, self.height, coarse),
        }
        self._image: np.ndarray | None = None
        self._segments: dict[float, Segments] = {}
        self._seen: set[Any] = set()
        self._stands = False
        self._settling = False

    @property
    def camera(self) -> Camera:
        """The view, at full size."""
        return self._camera(1.0, self.orbit)

    @property
    def transfer(self) -> TransferFunction:
        """As it was given or edited last."""
        return self._transfer

    @transfer.setter
    def transfer(self, transfer: TransferFunction) -> None:
        self._transfer, self._image, self._stands = _transfer_of(transfer), None, True

    @property
    def image(self) -> np.ndarray:
        """The exact picture (height, width, 4), read-only; rendered now if there is none yet."""
        if self._image is None:
            self._image = self._draw(1.0)
        return self._image

    def look(self, orbit: Orbit) -> None:
        """From elsewhere."""
        self.orbit, self._image, self._stands = orbit, None, False
        self._segments = {}

    def apply(self, message: Mapping[str, Any]) -> None:
        """What a hand did since the last message, each part optional.

        reset: a list of "view" and "transfer", which happens first. up: the name of the axis to
        turn up. angles: degrees [azimuth, elevation] to look from. turn: by how many more. shift:
        parts of the picture's height [right, up]. zoom: a factor. edits: a list for `edits.apply`.
        """
        for what in message.get("reset") or ():
            if what == "view":
                self.look(self._first_orbit)
            elif what == "transfer":
                self.transfer = self._first_transfer
        orbit = self.orbit
        if message.get("up") is not None:
            orbit = orbit.upright(message["up"])
        if message.get("angles") is not None:
            orbit = orbit.seen_from(*message["angles"])
        azimuth, elevation = message.get("turn") or (0, 0)
        right, up = message.get("shift") or (0, 0)
        factor = message.get("zoom") or 1
        if azimuth or elevation:
            orbit = orbit.turned(azimuth, elevation)
        if factor != 1:
            orbit = orbit.zoomed(factor)
        if right or up:
            orbit = orbit.shifted(right, up)
        if orbit is not self.orbit:
            self.look(orbit)
        self.edit(message.get("edits") or ())

    def edit(self, edits: Iterable[Mapping[str, Any]]) -> None:
        """Edits of the transfer function, see `edits.apply`."""
        for edit in edits:
            self.transfer = _edits.apply(self._transfer, edit)

    def frame(self, exact: bool) -> Frame:
        """The picture of now: at full size, or else as fine as can be drawn quickly."""
        start = time.perf_counter()
        pace = self._pace()
        divisor = 1.0 if exact or not self._ready(pace.divisor) else pace.divisor
        known = divisor == 1 and self._image is not None
        compiled = not known and not self._ready(divisor)
        image = self.image if divisor == 1 else self._draw(divisor)
        png = encode(image, level=1)
        seconds = time.perf_counter() - start
        # Compiling is not the pace, nor is sharing the processor.
        if not (known or compiled or self._settling):
            pace.observe(divisor, seconds)
        return Frame(png, image.shape[1], image.shape[0], divisor == 1, seconds, compiled)

    def settle(self) -> None:
        """Compiles and traces what the next pictures need, to be called after an exact one.

        May run in a thread beside everything else: what it traces for a view that is left meanwhile
        is dropped.
        """
        self._settling = True
        try:
            self._settle(self.orbit, self._drawn())
        finally:
            self._settling = False

    def _settle(self, orbit: Orbit, transfer: TransferFunction) -> None:
        pace, segments = self._paces["render"], self._segments
        wanted = pace.wanted()
        if _how(wanted, None, transfer) not in self._seen:
            self._picture(wanted, None, transfer, orbit)
        pace.divisor = wanted
        if not self._stands:
            return
        pace = self._paces["shade"]
        wanted = pace.wanted()
        for divisor in (wanted, 1.0):
            traced = segments.get(divisor)
            if traced is None:
                if max((s.nbytes * d**2 for d, s in segments.items()), default=0) > SEGMENT_BYTES:
                    return
                traced = trace(self.volume, self._camera(divisor, orbit), tracer=self.tracer)
            if _how(divisor, traced, transfer) not in self._seen:
                self._picture(divisor, traced, transfer, orbit)
            # Of a view that is left this is a dictionary that nobody looks at.
            segments[divisor] = traced
        pace.divisor = wanted

    def state(self) -> dict[str, Any]:
        """View and control points as a message."""
        t = self._transfer
        return {
            "azimuth": self.orbit.azimuth,
            "elevation": self.orbit.elevation,
            "zoom": self.orbit.zoom,
            "up": self.orbit.up,
            "chosen": self.orbit.up == self.chosen_up,
            "from": self.orbit.from_axis,
            "told": self._told if t is self._first_transfer else "",
            "positions": t.absolute_positions().tolist(),
            "extinctions": np.asarray(t.extinctions, np.float64).tolist(),
            "colors": [svg.hex_color(c) for c in np.asarray(t.colors)],
        }

    def setup(self) -> dict[str, Any]:
        """What does not change, as a message: size, range of the field, its histogram, names."""
        counts, _ = svg.histogram(self.volume.weighted_values()[0], *self.range)
        return {
            "width": self.width,
            "height": self.height,
            "range": list(self.range),
            "counts": counts.tolist(),
            "field": self.volume.field_name or "values",
            "ups": list(AXES),
            "views": {name: list(angles) for name, angles in VIEWS.items()},
        }

    def _pace(self) -> Pace:
        shading = self._paces["shade"]
        return shading if self._kept(shading.divisor) is not None else self._paces["render"]

    def _kept(self, divisor: float) -> Segments | None:
        """Segments to shade instead of rendering."""
        return self._segments.get(divisor) if self._stands else None

    def _ready(self, divisor: float) -> bool:
        """Whether a picture can be had without compiling."""
        return _how(divisor, self._kept(divisor), self._drawn()) in self._seen

    def _draw(self, divisor: float) -> np.ndarray:
        return self._picture(divisor, self._kept(divisor), self._drawn(), self.orbit)

    def _picture(
        self, divisor: float, segments: Segments | None, transfer: TransferFunction, orbit: Orbit
    ) -> np.ndarray:
        common = {"integrator": self.integrator, "background": self.background}
        if segments is not None:
            image = shade(segments, transfer, **common)
        else:
            camera = self._camera(divisor, orbit)
            # With the status asked for there are no hints: a hand may well go inside.
            how = {"tracer": self.tracer, "status": True, **common}
            image, status = render(self.volume, camera, transfer, **how)
            check(status)
        image = np.asarray(image)
        self._seen.add(_how(divisor, segments, transfer))
        return image

    def _camera(self, divisor: float, orbit: Orbit) -> Camera:
        size = self._paces["render"].size(divisor)
        return orbit.camera(*size, dtype=self.volume.dtype)

    def _drawn(self) -> TransferFunction:
        """The transfer function, for `Analytic` with unused points so that adding one seldom
        compiles; tables of other integrators would spread over those too."""
        if self.integrator is None or isinstance(self.integrator, Analytic):
            return _edits.padded(self._transfer)
        return self._transfer


def _how(divisor: float, segments: Segments | None, transfer: TransferFunction) -> Any:
    """What a picture is compiled for."""
    return divisor, segments and segments.scalar.shape, transfer.positions.shape


def _spans(transfer: TransferFunction, least: float, most: float) -> str:
    """What the points of a default transfer function span, in words."""
    first, last = transfer.absolute_positions()[[0, -1]].tolist()
    what = "Transfer function chosen here: "
    if first == last:
        return f"{what}the field is {first:.4g} everywhere."
    if (first, last) == (least, most):
        return f"{what}it spans the whole range, {spanned(least, most, 4)}."
    low, high = (f"{100 * q:g}" for q in QUANTILES)
    return (
        f"{what}it spans {spanned(first, last, 4)}, the {low} and {high} % quantiles of the "
        f"volume; values go from {spanned(least, most, 4)}."
    )


def _transfer_of(transfer: Any) -> TransferFunction:
    require_kind("transfer", transfer, TransferFunction)
    if not is_known(transfer.positions, transfer.colors, transfer.extinctions):
        raise ValueError("transfer must have known numbers: explore it outside jit and grad.")
    return transfer
