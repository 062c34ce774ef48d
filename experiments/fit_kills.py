"""Fits that are killed while they run, and resumed until they are done.

    python -m experiments.fit_kills [--kills N] [--seed N] [--json FILE]

A process runs `jaxvr.fit` with a checkpoint after each step and is killed (SIGKILL) at a random
moment of a random step, now and then before the first. A new process resumes it, is killed too, and
so on, a few times; the last one is left alone. Losses and transfer function must then be those of a
fit that nobody disturbed, to the bit, and nothing may lie beside the checkpoint. What a kill leaves
there on the way is counted: it shows how many of them hit a file that was being written.

Processes are forked from one that has imported jaxvr and computed nothing.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import sys
import tempfile
import time
import zipfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import jaxvr

STEPS = 100
IN_A_ROW = 4  # kills of one fit, before it may end
EARLY = 0.2  # the part of kills that come before the first step


def run(path: Path | None, out: Path, compiled: Path, ready: Callable[[], Any]) -> None:
    """A small fit; its losses and its transfer function go to `out` as bytes. compiled: where
    programs are kept for the processes after this one. ready: called after each step."""
    import jax

    config: Any = jax.config
    config.update("jax_compilation_cache_dir", str(compiled))
    config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    volume = jaxvr.datasets.box((1, 1, 1), field=lambda p: p[:, 0] + 0.2 * p[:, 1])
    eyes = np.array([[0.5, 0.4, 3.0], [2.8, 0.9, 0.1]])
    cameras = [jaxvr.Camera.look_at(eye, (0.5, 0.5, 0.5), width=6, height=6) for eye in eyes]
    start = jaxvr.TransferFunction([0, 0.6, 1.2], np.full((3, 3), 0.4), np.full(3, 2.0))
    rng = np.random.default_rng(0)
    alpha = 0.5 * rng.random((2, 6, 6, 1))
    targets = list(np.concatenate([alpha * rng.random((2, 6, 6, 3)), alpha], -1))
    keep = {} if path is None else {"checkpoint": path, "checkpoint_every": 1, "resume": True}
    found = jaxvr.fit(
        *(start, volume, cameras, targets), iterations=STEPS, rays=20, progress=False,
        callback=lambda *_: ready() is None, **keep,  # what is true would end it
    )  # fmt: skip
    assert len(found.loss_history) == STEPS
    leaves = [found.loss_history, *jax.tree.leaves(found.transfer)]
    out.write_bytes(b"".join(np.asarray(x).tobytes() for x in leaves))


class Process:
    """A fit in a process of its own, which has just begun."""

    def __init__(self, path: Path | None, out: Path, compiled: Path):
        self._reading, writing = os.pipe()
        self.id = os.fork()
        if self.id == 0:
            code, said = 1, os.dup(2)
            try:
                os.close(self._reading)
                # XLA prints dozens of lines for each program that it takes from the folder.
                os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
                run(path, out, compiled, lambda: os.write(writing, b"s"))
                code = 0
            except BaseException as e:
                os.write(said, f"{type(e).__name__}: {e}\n".encode())
            finally:
                os._exit(code)
        os.close(writing)

    def wait(self, steps: int) -> float:
        """Until it has made so many steps; the seconds that one takes, from the second on."""
        times = []
        for k in range(steps):
            if os.read(self._reading, 1) != b"s":
                raise RuntimeError(f"A fit ended after {k} steps.")
            times.append(time.perf_counter())
        return (times[-1] - times[0]) / max(steps - 1, 1)

    def end(self, kill: bool = False) -> int:
        """Its status."""
        if kill:
            os.kill(self.id, signal.SIGKILL)
        status = os.waitpid(self.id, 0)[1]
        os.close(self._reading)
        return status


def steps_in(path: Path) -> int:
    """In a checkpoint; 0 without one. Raises whatever one that is not whole makes."""
    if not path.exists():
        return 0
    with zipfile.ZipFile(path) as archive:
        if archive.testzip() is not None:
            raise ValueError("A checksum differs.")
        return json.loads(archive.read("about.json"))["iterations"]


def kills(number: int, folder: Path, rng: random.Random) -> Counter[str]:
    """What came of `number` kills."""
    found = Counter[str]()
    right, compiled = folder / "right", folder / "compiled"
    whole = Process(None, right, compiled)
    if whole.end():
        raise RuntimeError("The fit that nobody kills fails.")
    start_up, done = 1.0, 0
    while done < number:
        place = folder / f"fit {done}"
        place.mkdir()
        path, out = place / "c.npz", folder / f"out {done}"
        for _ in range(min(IN_A_ROW, number - done)):
            before = steps_in(path)
            fit = Process(path, out, compiled)
            if rng.random() < EARLY:
                time.sleep(rng.uniform(0, start_up))
            else:
                step = fit.wait(rng.randint(2, max(2, (STEPS - before) // 2)))
                time.sleep(rng.uniform(0, step))
            status = fit.end(kill=True)
            done += 1
            found["kills that left a file beside"] += any(p != path for p in place.iterdir())
            try:
                after = steps_in(path)
            except Exception as e:
                found[f"fault: {type(e).__name__}"] += 1
                break
            if after < before:
                found["fault: steps lost"] += 1
            if os.WIFSIGNALED(status):
                found["killed, with steps" if after > before else "killed, without a step"] += 1
            else:
                found["fault: an error" if status else "had ended"] += 1
        began = time.perf_counter()
        fit = Process(path, out, compiled)
        fit.wait(1)
        start_up = time.perf_counter() - began
        same = fit.end() == 0 and out.read_bytes() == right.read_bytes()
        found["resumed, equal to the bit" if same else "fault: another result"] += 1
        if list(place.iterdir()) != [path]:
            found["fault: left behind"] += 1
    return found


def main(argv: list[str] | None = None) -> Counter[str]:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", metavar="FILE", help="counts")
    arguments = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as folder:
        found = kills(arguments.kills, Path(folder), random.Random(arguments.seed))
    for what, n in found.items():
        print(f"{n:5} {what}")
    if arguments.json:
        Path(arguments.json).write_text(json.dumps(found, indent=2) + "\n")
    return found


if __name__ == "__main__":
    sys.exit(any(what.startswith("fault") for what in main()))
