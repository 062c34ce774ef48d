"""Every experiment runs at a tiny size, and one number of each is pinned.

To add one: a function from a folder to a number, and the bounds that it must lie in.
"""

from __future__ import annotations

from pathlib import Path

import pytest

import jaxvr
from experiments import demo, fit_transfer


def demo_psnr(folder: Path) -> float:
    report = demo.run(folder, tiny=True)
    assert (folder / "overview.png").stat().st_size > 0 and (folder / "report.json").exists()
    return report["held_out"][0]["psnr"]


def fit_transfer_psnr(folder: Path) -> float:
    volume = jaxvr.datasets.heat_sink(fins=2)  # the shapes of the demo: compiled already
    report = fit_transfer.run(
        volume, folder, size=16, reference_points=64, schedules=("decay",), passes=40, uncached=0
    )
    assert (folder / "decay" / "difference.png").exists()
    return report["schedules"]["decay"]["held_out"][0]["psnr"]


EXPERIMENTS = [(demo_psnr, 25, 200), (fit_transfer_psnr, 25, 200)]


@pytest.mark.parametrize(
    ("run", "low", "high"), EXPERIMENTS, ids=lambda x: getattr(x, "__name__", "")
)
def test_experiment(run, low, high, tmp_path):
    assert low < run(tmp_path / "out") < high
