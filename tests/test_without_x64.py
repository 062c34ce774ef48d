"""What users get who never turn x64 on: no warnings, float32, and the README's example."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

SCRIPT = """
import numpy as np, jax, jaxvr
mesh = jaxvr.datasets.box((2, 2, 2))
camera = jaxvr.Camera.look_at(np.array([2.0, 1.5, 3.0]), np.zeros(3), width=6, height=4)
transfer = jaxvr.TransferFunction(np.linspace(0, 1, 4), np.ones((4, 3)), np.arange(4.0))
image = jaxvr.render(mesh, camera, transfer)
assert image.dtype == np.float32 and float(image[..., 3].max()) > 0.1
double = mesh.replace(values=np.asarray(mesh.values, np.float64) / 2)
assert jaxvr.render(double, camera, transfer).dtype == np.float32
rays = jaxvr.render_rays(mesh, np.array([2.0, 1.5, 3.0]), np.array([-2.0, -1.5, -3.0]), transfer)
assert rays.shape == (4,)
far = mesh.replace(values=101325 + 0.01 * np.asarray(mesh.values, np.float64))
ramp = transfer.replace(positions=101325 + 0.01 * np.linspace(0, 1, 4), offset=None)
assert far.offset and ramp.offset
assert abs(jaxvr.render(far, camera, ramp) - image).max() < 1e-5
"""


def run(script: str, cwd) -> None:
    environment = {k: v for k, v in os.environ.items() if not k.startswith("JAX_ENABLE_X64")}
    environment["PYTHONPATH"] = str(ROOT)
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", script],
        cwd=cwd, env=environment, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


def test_float64_input_without_x64_gives_no_warning(tmp_path):
    run(SCRIPT, tmp_path)


def test_the_readme_s_first_example_runs(tmp_path):
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S)
    small = blocks[0].replace("elevation=25)", "elevation=25, width=48, height=48)")
    assert small != blocks[0]
    run(small, tmp_path)
    assert (tmp_path / "heat_sink.png").stat().st_size > 500
