"""`Explorer`: the widget of `jaxvr.explore`. The one file that imports anywidget.

The script asks for a frame with what happened since the last one, and does not ask again before the
answer is there: however slow the kernel is, no requests pile up. The answer has the state in it, so
that all views of a widget show the same.
"""

from __future__ import annotations

import contextlib
import threading
from pathlib import Path
from typing import Any

import anywidget
import numpy as np
import traitlets

from jaxvr._core.status import RenderError
from jaxvr.interact.viewer import Viewer
from jaxvr.optics import TransferFunction
from jaxvr.view.camera import Camera

HERE = Path(__file__).parent


class Explorer(anywidget.AnyWidget):
    """A volume to be turned by hand. Make one with `jaxvr.explore`.

    camera: the view at full size. transfer: as edited; set it to show another one. image: the exact
    picture (H, W, 4) of both, as `jaxvr.render` gives it.
    """

    _esm = HERE / "explorer.js"
    _css = HERE / "explorer.css"
    setup = traitlets.Dict().tag(sync=True)

    def __init__(self, viewer: Viewer):
        super().__init__(setup=viewer.setup())
        self._viewer = viewer
        self._settling: threading.Thread | None = None
        self.on_msg(self._receive)

    @property
    def camera(self) -> Camera:
        """The view as it was turned last, at full size: a start for `jaxvr.render`."""
        return self._viewer.camera

    @property
    def transfer(self) -> TransferFunction:
        """The transfer function as it was edited last. Set it to show another one."""
        return self._viewer.transfer

    @transfer.setter
    def transfer(self, transfer: TransferFunction) -> None:
        self._viewer.transfer = transfer
        self.send({"kind": "changed", "state": self._viewer.state()})

    @property
    def image(self) -> np.ndarray:
        """The exact picture (H, W, 4) of both, read-only, as `jaxvr.render` gives it; rendered now
        if there is none yet."""
        return self._viewer.image

    def __repr__(self) -> str:
        viewer = self._viewer
        return f"Explorer({viewer.volume!r}, {viewer.width} x {viewer.height} pixels)"

    def _receive(self, _: Any, message: dict[str, Any], buffers: Any) -> None:
        """Answers {"kind": "frame", "view", "exact", ...what `Viewer.apply` takes}."""
        if message.get("kind") != "frame":
            return
        answer: dict[str, Any] = {"kind": "frame", "view": message.get("view")}
        try:
            self._viewer.apply(message)
            if self._settling is None:
                self._prepare()  # coarse pictures compile beside the first exact one
            frame = self._viewer.frame(bool(message.get("exact")))
        except (RenderError, ValueError) as error:
            self.send(answer | {"error": str(error), "state": self._viewer.state()})
            return
        except BaseException as error:
            # Whatever it is, whoever waits for an answer gets one.
            self.send(answer | {"error": f"{type(error).__name__}: {error}"})
            raise
        about = {
            "exact": frame.exact,
            "width": frame.width,
            "height": frame.height,
            "milliseconds": 1000 * frame.seconds,
            "compiled": frame.compiled,
            "state": self._viewer.state(),
        }
        self.send(answer | about, buffers=[frame.png])
        if frame.exact:
            self._prepare()

    def _prepare(self) -> None:
        """In the background, unless that is under way."""
        if self._settling is None or not self._settling.is_alive():
            self._settling = threading.Thread(target=self._settle)
            self._settling.start()

    def _settle(self) -> None:
        # What fails here fails again, and is told, in the frame that needs it.
        with contextlib.suppress(Exception):
            self._viewer.settle()
