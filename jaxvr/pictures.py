"""What a fit looks like: the folder of pictures that the command line and the experiments write.

target, start, fitted: one view, as it is given, before and after. difference: fitted - target,
with its scale. transfer: the true and the fitted transfer function. overview: all of it at once.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from jaxvr import plot
from jaxvr.files import save_image
from jaxvr.optics.transfer import TransferFunction


def save_fit(
    folder: Any,
    target: Any,
    start: Any,
    fitted: Any,
    transfer: TransferFunction,
    reference: TransferFunction | None = None,
    *,
    background: Any = None,
) -> list[Path]:
    """Writes the pictures and returns their paths.

    Args:
      target, start, fitted (height, width, 4): one view.
      transfer: the fitted transfer function. reference: the true one, where it is known.
      background: opaque RGB (3,) behind pictures that are transparent.
    """
    path = Path(folder)
    path.mkdir(parents=True, exist_ok=True)
    images = {"target": target, "start": start, "fitted": fitted}
    images = {name: np.asarray(x) for name, x in images.items()}
    out = []
    for name, image in images.items():
        out.append(path / f"{name}.png")
        save_image(out[-1], image, background=background)
    drawn = {
        "difference": plot.difference(images["fitted"], images["target"], title="fitted - target"),
        "transfer": plot.transfer(transfer, reference=reference),
        "overview": plot.compare(list(images.values()), list(images), background=background),
    }
    for name, axes in drawn.items():
        out.append(path / f"{name}.png")
        # Pictures as they are need their figure's own resolution.
        axes.savefig(out[-1], dpi=150 if name == "transfer" else "figure")
    return out
