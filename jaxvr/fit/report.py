"""What a fit returns, and its numbers as a dict that JSON can hold."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from jaxvr._core import svg
from jaxvr._core.writing import whole_file, write_whole
from jaxvr.fit.loop import LoopResult
from jaxvr.optics.transfer import TransferFunction
from jaxvr.view.images import psnr_of, ssim_of


@dataclasses.dataclass(frozen=True, eq=False)
class FitResult:
    """What `fit` returns.

    transfer: the fitted transfer function. loss_history (n,): loss[i] before step i.
    images: the fitted pictures of the views (height, width, 4), and held_out_images of the views
    held out. stopped: "iterations", "callback" or "patience".
    """

    transfer: TransferFunction
    loss_history: np.ndarray
    images: list[np.ndarray]
    held_out_images: list[np.ndarray]
    stopped: str
    numbers: dict[str, Any]

    def __repr__(self) -> str:
        return f"FitResult({', '.join(f'{name} {text}' for name, text in self._facts())})"

    def _repr_html_(self) -> str:
        head = '<div style="font-weight:600">FitResult</div>'
        drawn = self.transfer._repr_html_() or ""
        return f'<div class="jaxvr-fit">{head}{svg.table(self._facts())}{drawn}</div>'

    def _facts(self) -> list[tuple[str, str]]:
        """The result in a few words: labels and what stands behind them."""
        losses, views = self.loss_history, len(self.images)
        ends = f"{losses[0]:.3g} to {losses[-1]:.3g}" if len(losses) else "none"
        facts = [
            ("transfer", f"of {len(self.transfer.positions)} control points"),
            ("iterations", f"{len(losses):,} (stopped by {self.stopped})"),
            ("loss", ends),
            ("views", f"{views:,}{_mean_psnr(self.numbers.get('fitted_views'))}"),
        ]
        if self.held_out_images:
            scores = _mean_psnr(self.numbers.get("held_out"))
            facts.append(("held out", f"{len(self.held_out_images):,}{scores}"))
        return facts

    def report(self) -> dict[str, Any]:
        """Settings, losses, seconds, and PSNR (dB) and SSIM of each view; JSON can hold it.

        "ssim" is None for pictures of less than 11 x 11 pixels, "psnr" for equal ones.
        """
        return json.loads(json.dumps(self.numbers))

    def save(self, folder: Any) -> Path:
        """Writes transfer.json, report.json and images.npz (view0, ..., held_out0, ...) to a
        `folder`, which is made if need be; each is whole or not there. Returns its path."""
        path = Path(folder)
        path.mkdir(parents=True, exist_ok=True)
        self.transfer.to_json(path / "transfer.json")
        write_whole(path / "report.json", json.dumps(self.numbers, indent=2) + "\n")
        pictures = {f"view{k}": x for k, x in enumerate(self.images)}
        pictures |= {f"held_out{k}": x for k, x in enumerate(self.held_out_images)}
        with whole_file(path / "images.npz") as file:
            np.savez_compressed(file, **pictures)  # type: ignore[arg-type]
        return path


def _mean_psnr(views: Any) -> str:
    """Of what `likeness` gave, as text behind a number of views; nothing where all are equal to
    their targets."""
    scores = [v["psnr"] for v in views or [] if v["psnr"] is not None]
    return f" at {np.mean(scores):.1f} dB" if scores else ""


def likeness(images: list[np.ndarray], targets: list[np.ndarray]) -> list[dict[str, Any]]:
    """PSNR and SSIM of each picture, over the channels that its target has."""
    out = []
    for image, target in zip(images, targets, strict=True):
        image = image[..., : target.shape[-1]]
        structure = None if min(target.shape[:2]) < 11 else number(ssim_of(image, target))
        out.append({"psnr": number(psnr_of(image, target)), "ssim": structure})
    return out


def timing(result: LoopResult) -> dict[str, Any]:
    """Seconds of a loop: first iteration, median of the others, all."""
    first = float(result.seconds[0]) if len(result.seconds) else math.nan
    return {
        "first_iteration": number(first),
        "per_iteration": number(result.seconds_per_iteration),
        "all_iterations": number(result.seconds.sum()),
    }


def number(x: Any) -> float | None:
    """A float, or None for what JSON cannot hold."""
    return float(x) if np.isfinite(x) else None
