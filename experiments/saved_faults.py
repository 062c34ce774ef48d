"""Mutated transfer functions and checkpoints, kills while writing, full disks, read-only places.

    python -m experiments.saved_faults [--tiny] [--json FILE]

A mutant may be refused with a ValueError that names the file, or give what was stored; of a JSON
text it may be another function too, where numbers were changed. Anything else is a fault. Kills
come at a random time while a process writes one state after the other; the file must then be one of
those states (of whole fits: `experiments.fit_kills`). Places are tried as another user where the
process is root.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import signal
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common import table
from jaxvr._core.writing import require_place, write_whole
from jaxvr.fit import checkpoint
from jaxvr.optics import TransferFunction
from jaxvr.view.load import load_image

NOBODY = 65534
LIKE = {"a": np.zeros((40, 3), np.float32), "n": np.zeros((), np.int32)}
ABOUT = {"seed": 3, "digests": {"targets": ["0" * 32] * 4}}


def state_of(k: int) -> dict[str, np.ndarray]:
    return {"a": np.full((40, 3), k, np.float32), "n": np.array(k, np.int32)}


def mutant(data: bytes, rng: random.Random) -> tuple[str, bytes]:
    """A kind of change, and the changed bytes."""
    kind = rng.choice(["cut", "bit", "byte", "zeros", "removed", "twice", "inserted", "number"])
    at = rng.randrange(len(data))
    n = rng.randrange(1, 64)
    junk = bytes(rng.randrange(256) for _ in range(n))
    made = {
        "cut": lambda: data[:at],
        "bit": lambda: data[:at] + bytes([data[at] ^ 1 << rng.randrange(8)]) + data[at + 1 :],
        "byte": lambda: data[:at] + junk[:1] + data[at + 1 :],
        "zeros": lambda: data[:at] + bytes(n) + data[at + n :],
        "removed": lambda: data[:at] + data[at + n :],
        "twice": lambda: data[: at + n] + data[at:],
        "inserted": lambda: data[:at] + junk + data[at:],
        "number": lambda: (
            data[:at]
            + rng.choice([b"1e999", b"NaN", b"-1", b'"x"', b"[]", b"null"])
            + data[at + 1 :]
        ),
    }
    return kind, made[kind]()


def checkpoints(number: int, folder: Path, rng: random.Random) -> Counter[str]:
    path, out = folder / "c.npz", Counter[str]()
    checkpoint.save(path, state_of(7), [1.0, 0.5], ABOUT)
    sound = path.read_bytes()
    for _ in range(number):
        _, data = mutant(sound, rng)
        path.write_bytes(data)
        try:
            state, losses = checkpoint.load(path, LIKE, ABOUT)
        except ValueError as e:
            good = "c.npz' is no checkpoint of a fit" in str(e) or "belongs to another" in str(e)
            out["error" if good else f"fault: {e}"[:80]] += 1
        except BaseException as e:
            out[f"fault: {type(e).__name__}"] += 1
        else:
            same = losses == [1.0, 0.5] and all((state[k] == state_of(7)[k]).all() for k in LIKE)
            out["what was stored" if same else "fault: other numbers"] += 1
    return out


def jsons(number: int, folder: Path, rng: random.Random) -> Counter[str]:
    points = [0.1, 0, 0.5, 0, 1, 0.5, 0.3, 0.2, 2, 1, 0.5, 0]
    map_of = {
        "Name": "m",
        "NanColor": [1, 1, 0],
        "RGBPoints": [0.1, 1, 0, 0, 1, 0, 1, 0, 2, 0, 0, 1],
    }
    sources = [TransferFunction([0.0, 0.5, 1], np.eye(3), [0.0, 1, 2]).to_json().encode()]
    for space, log in (("CIELAB", True), ("HSV", False), ("Diverging", False), ("Step", True)):
        entry = map_of | {"ColorSpace": space, "UseLogScale": log, "Points": points}
        sources.append(json.dumps([entry]).encode())
    path, out = folder / "t.json", Counter[str]()
    wanted = [TransferFunction.from_json(s.decode()).to_json() for s in sources]
    for k in range(number):
        which = k % len(sources)
        path.write_bytes(mutant(sources[which], rng)[1])
        try:
            with warnings.catch_warnings(record=True) as told:
                warnings.simplefilter("always")
                made = TransferFunction.from_json(path)
        except ValueError:
            out["error"] += 1
        except BaseException as e:
            out[f"fault: {type(e).__name__}"] += 1
        else:
            same = made.to_json() == wanted[which]
            out["told" if told else "what was stored" if same else "another function"] += 1
    return out


def killed(number: int, folder: Path, rng: random.Random, write: Any, read: Any) -> Counter[str]:
    """Processes that write state after state, killed at a random time."""
    out = Counter[str]()
    for k in range(number):
        path = folder / f"k{k % 4}.bin"
        child = os.fork()
        if child == 0:
            for n in range(10**9):
                write(path, n)
        time.sleep(rng.uniform(0.0005, 0.03))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        try:
            out["whole" if not path.exists() or read(path) else "fault: mixed"] += 1
        except BaseException as e:
            out[f"fault: {type(e).__name__}"] += 1
        require_place(path, "The file")  # removes what the killed one left
        left = [p for p in folder.iterdir() if p.name.startswith(".jaxvr")]
        out["fault: left behind"] += bool(left)
    return +out


def in_child(do: Callable[[], str]) -> str:
    """What a forked process says, which may give up its rights and limits."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            said = do()
        except BaseException as e:
            said = f"fault: {type(e).__name__}: {e}"
        os.write(writing, said.encode()[:4000])
        os._exit(0)
    os.close(writing)
    os.waitpid(child, 0)
    with os.fdopen(reading) as file:
        return file.read() or "fault: crashed"


def places(folder: Path) -> Counter[str]:
    """Limits of size, full devices, places without rights; the old file must stay."""
    out = Counter[str]()
    path = folder / "c.npz"
    checkpoint.save(path, state_of(1), [1.0], ABOUT)
    before = path.read_bytes()
    writers = {
        "checkpoint": lambda: checkpoint.save(path, state_of(2), [2.0], ABOUT),
        "text": lambda: write_whole(path, "x" * 5000),
        "trial": lambda: require_place(path, "The checkpoint"),
    }
    for name, write in writers.items():
        for size in (0, 1, 100, 1000):

            def small(write: Any = write, size: int = size) -> str:
                signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
                resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
                return attempt(write)

            said = in_child(small)
            kept = path.read_bytes() == before
            clean = [p.name for p in folder.iterdir()] == ["c.npz"]
            fine = said.startswith("OSError") or (
                name == "trial" and size > 4 and said == "written"
            )
            good = fine and kept and clean
            out["error, the old file kept" if good else f"fault: {name} {size} {said}"[:80]] += 1
    folder.chmod(0o555)

    def other_user(write: Any) -> str:
        if os.getuid() == 0:
            os.setgid(NOBODY)
            os.setuid(NOBODY)
        return attempt(write)

    for name, write in writers.items():
        said = in_child(lambda write=write: other_user(write))
        good = said.startswith("PermissionError") and path.read_bytes() == before
        out["error, the old file kept" if good else f"fault: {name} {said}"[:80]] += 1
    folder.chmod(0o755)
    return out


def attempt(write: Callable[[], Any]) -> str:
    try:
        write()
    except OSError as e:
        kind = "PermissionError" if isinstance(e, PermissionError) else "OSError"
        return f"{kind}: {e}"
    return "written"


def pictures(number: int, folder: Path, rng: random.Random) -> Counter[str]:
    from jaxvr.files import save_image

    out = Counter[str]()
    image = np.random.default_rng(0).random((9, 7, 4)) * 0.5
    for suffix in (".png", ".npy"):
        path = folder / f"a{suffix}"
        save_image(path, image)
        sound = path.read_bytes()
        for _ in range(number // 2):
            path.write_bytes(mutant(sound, rng)[1])
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    load_image(path)
                out["a picture"] += 1
            except ValueError as e:
                out["error" if path.name in str(e) else "fault: no name"] += 1
            except BaseException as e:
                out[f"fault: {type(e).__name__}"] += 1
    return out


def main(argv: list[str] | None = None) -> dict[str, Counter[str]]:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tiny", action="store_true", help="a few of each kind")
    parser.add_argument("--json", metavar="FILE", help="counts")
    arguments = parser.parse_args(argv)
    many, kills = (50, 6) if arguments.tiny else (5000, 100)
    rng = random.Random(0)
    found: dict[str, Counter[str]] = {}

    def save(path: Path, n: int) -> None:
        checkpoint.save(path, state_of(n), [float(n)], ABOUT)

    # Kills first: forks of a process that has computed nothing.
    for name, run in {
        "kills, checkpoints": lambda f: killed(kills, f, rng, save, whole_written),
        "kills, results": lambda f: killed(kills, f, rng, result_text, whole_text),
        "full disks and read-only places": places,
        "checkpoints": lambda f: checkpoints(many, f, rng),
        "transfer functions": lambda f: jsons(many, f, rng),
        "pictures": lambda f: pictures(many // 5, f, rng),
    }.items():
        with tempfile.TemporaryDirectory() as folder:
            os.chmod(folder, 0o755)
            found[name] = run(Path(folder))
    rows = [
        {
            "what": k,
            "tried": sum(c.values()),
            "outcomes": ", ".join(f"{o} {n}" for o, n in c.items()),
        }
        for k, c in found.items()
    ]
    print(table(rows))
    if arguments.json:
        Path(arguments.json).write_text(json.dumps(found, indent=2) + "\n")
    return found


def whole_written(path: Path) -> bool:
    """Without JAX, which forks must not start: each array is of one number."""
    with np.load(path) as data:
        n = int(data["losses"][0])
        return bool((data["leaf0"] == np.float32(n)).all() and int(data["leaf1"]) == n)


def result_text(path: Path, n: int) -> None:
    write_whole(path, json.dumps([n] * 2000))


def whole_text(path: Path) -> bool:
    return len(set(json.loads(path.read_text()))) == 1


if __name__ == "__main__":
    faults = [o for c in main().values() for o in c if o.startswith("fault")]
    sys.exit(1 if faults else 0)
