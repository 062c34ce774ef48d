"""What threads and signals have no say in: last bits of gradients, and how soon Ctrl-C ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

GRADIENTS = """
import os, sys
os.sched_setaffinity(0, {int(c) for c in sys.argv[1].split(",")})
import hashlib, jax, numpy as np, jaxvr
jax.config.update("jax_enable_x64", True)
for dtype in ("float32", "float64"):
    mesh = jaxvr.datasets.box((4, 4, 4), field=lambda p: p[:, 0] + p[:, 1] * p[:, 2], dtype=dtype)
    camera = jaxvr.Camera.orbit(mesh, azimuth=31, elevation=17, width=64, height=48)
    transfer = jaxvr.TransferFunction([0, 0.4, 1.3], np.eye(3), [0.5, 2, 4], dtype=dtype)
    def loss(values, points, transfer, camera):
        image = jaxvr.render(mesh.replace(values=values, points=points), camera, transfer,
                             engine=jaxvr.engine.C())
        return (image**2).sum()
    gradient = jax.jit(jax.grad(loss, argnums=(0, 1, 2, 3)))
    found = jax.tree.leaves(gradient(mesh.values, mesh.points, transfer, camera))
    print(hashlib.sha256(b"".join(np.asarray(x).tobytes() for x in found)).hexdigest())
"""


def _some_cpus() -> list[int]:
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []


@pytest.mark.skipif(len(_some_cpus()) < 2, reason="needs two processors to compare with one")
def test_gradients_do_not_depend_on_the_number_of_threads():
    one, two = (",".join(map(str, _some_cpus()[:n])) for n in (1, 2))
    digests = [
        subprocess.run(
            [sys.executable, "-c", GRADIENTS, cpus], cwd=ROOT, capture_output=True, text=True
        )
        for cpus in (one, two)
    ]
    assert digests[0].stdout.split() == digests[1].stdout.split(), digests[0].stderr
    assert len(digests[0].stdout.split()) == 2, digests[0].stderr


LONG = """
import signal, time, jax, numpy as np, jaxvr
# A shell has jobs in the background ignore it.
signal.signal(signal.SIGINT, signal.default_int_handler)
mesh = jaxvr.datasets.box((16, 16, 16), field=lambda p: p[:, 0])
transfer = jaxvr.default_transfer(mesh).with_points(64)
camera = jaxvr.Camera.orbit(mesh, width=64, height=64)
rays = [np.resize(np.asarray(x).reshape(-1, 3), (2_000_000, 3)) for x in camera.rays()]

def draw():
    engine = jaxvr.engine.C()
    return jax.block_until_ready(jaxvr.render_rays(mesh, *rays, transfer, engine=engine))

draw()
start = time.monotonic()
draw()
print(time.monotonic() - start, flush=True)
try:
    for _ in range(20):
        draw()
except KeyboardInterrupt:
    print("interrupted", flush=True)
    print(bool(np.isfinite(jaxvr.render(mesh, camera, transfer)).all()), flush=True)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
def test_ctrl_c_ends_the_compiled_loops_and_leaves_them_usable():
    """After a quarter of a picture, it takes much less than the three quarters that are left: rays
    are prepared by XLA's own kernels first, which nothing ends."""
    process = subprocess.Popen(
        [sys.executable, "-c", LONG],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    whole = float(process.stdout.readline())
    time.sleep(whole / 4)
    process.send_signal(signal.SIGINT)
    sent = time.monotonic()
    said = process.stdout.readline()
    took = time.monotonic() - sent
    rest, errors = process.communicate(timeout=120)
    assert said == "interrupted\n" and rest == "True\n", said + rest + errors
    assert took < whole / 2, (took, whole)
