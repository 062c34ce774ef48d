"""Damaged files, and disks that fail: python -m experiments.file_faults --out experiments

- mutants: files of `file_makers`, each with bytes changed, cut, swapped, repeated, numbers made
  large: `read_mesh` gives a sound mesh or a ValueError, in a stated time, whatever they hold.
- threads: eight read and write side by side for a minute, while another prints: every mesh is the
  one that was written, standard output and the filters of warnings are as they were.
- kills: a process that writes over a mesh is killed at random times: the old file or the new one is
  there, whole.
- disks: full ones, read-only places, folders that are not there: an error that says so, and what
  was there stays.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import json
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

import jaxvr
from experiments import file_formats
from jaxvr.volume.io import sizes

SOURCES = (
    "VTU, ascii", "VTU, appended raw", "VTU, zlib", "VTU, LZ4", "VTU, several pieces",
    "VTU, polyhedra (convex)", "legacy VTK 5.1, ascii", "legacy VTK 5.1, binary",
    "legacy VTK 4.2, binary", "legacy VTK, structured points", "VTI", "VTS", "PVTU, three pieces",
    "VTM, two blocks", "VTKHDF, unstructured", "PVD, one of three steps",
    "series of VTU files, the last step", "EnSight Gold, ascii", "gmsh 2.2 by meshio",
    "XDMF, numbers in the XML", "XDMF, time series", "Abaqus", "Nastran", "Medit", "SU2",
    "UGRID, little endian", "AVS-UCD", "Tecplot, hexahedra", "FLAC3D", "DOLFIN XML", "Netgen",
    "gmsh 2.2, ascii", "gmsh 2.2, binary", "gmsh 4.1, ascii", "gmsh 4.1, binary",
    "gmsh, data at the corners of elements", "MED", "CGNS by gmsh",
    "Exodus, classic, a field on one of two blocks", "XDMF, mixed cells in the XML, by hand",
    "UGRID, text, by hand", "UGRID, Fortran records",
)  # fmt: skip


def mutate(raw: bytes, rng: random.Random) -> bytes:
    data = bytearray(raw)
    n = len(data)
    what = rng.choice(("bytes", "cut", "swap", "repeat", "number", "zero", "insert"))
    at = rng.randrange(n)
    if what == "bytes":
        for _ in range(rng.choice((1, 3, 20))):
            data[rng.randrange(n)] = rng.randrange(256)
    elif what == "cut":
        del data[at:]
    elif what == "swap":
        size = rng.randrange(1, 40)
        a, b = rng.randrange(n), rng.randrange(n)
        data[a : a + size], data[b : b + size] = data[b : b + size], data[a : a + size]
    elif what == "repeat":
        size = rng.randrange(1, 200)
        data[at:at] = data[at : at + size]
    elif what == "number":
        digits = [k for k, c in enumerate(data) if 48 <= c <= 57]
        if digits:
            k = rng.choice(digits)
            data[k : k + 1] = rng.choice((b"-1", b"0", b"99999999999", b"2147483647", b"1e300"))
    elif what == "zero":
        data[at : at + rng.randrange(1, 40)] = bytes(min(8, n - at))
    else:
        data[at:at] = rng.randbytes(rng.randrange(1, 30))
    return bytes(data)


def outcome(path: Path, how: dict[str, Any]) -> str:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            mesh = jaxvr.read_mesh(path, **how)
        except ValueError as e:
            text = str(e)
            if path.name not in text:
                return f"an error without the file's name: {text[:80]}"
            for words, label in (
                ("crashed", "error: a reader crashed"), ("takes more memory", "error: memory"),
                ("takes longer", "error: time"), ("not supported", "error: not supported"),
                ("unknown kind", "error: unknown kind"), ("cannot be read", "error: damaged"),
            ):  # fmt: skip
                if words in text:
                    return label
            return "error: of the mesh or the field"
        except Exception as e:
            return f"{type(e).__name__}: {e}"[:90]
    cells = np.asarray(mesh.cells)
    sound = cells.min() >= 0 and cells.max() < mesh.n_points
    sound &= bool(np.isfinite(mesh.points).all() and np.isfinite(mesh.values).all())
    return "a mesh" if sound else "AN UNSOUND MESH"


def mutants(count: int, seed: int, first: int = 0) -> dict[str, Any]:
    """Files `first` to `first` + `count` of those that a seed makes: each has numbers of its own,
    so that one that is read wrongly can be made again alone. Each may compute for 5 seconds."""
    usual, sizes.SECONDS = sizes.SECONDS, 5.0  # of 15: sound files of their size take less than 1
    try:
        return _mutants(count, seed, first)
    finally:
        sizes.SECONDS = usual


def _mutants(count: int, seed: int, first: int) -> dict[str, Any]:
    if unknown := set(SOURCES) - {kind.name for kind in file_formats.KINDS}:
        raise ValueError(f"There are no kinds {sorted(unknown)}.")
    found: collections.Counter[str] = collections.Counter()
    slowest = (0.0, "")
    with tempfile.TemporaryDirectory() as root:
        sources = []
        for kind in file_formats.KINDS:
            if kind.name not in SOURCES:
                continue
            place = Path(root) / f"{len(sources)} {kind.name}".replace("/", " ")
            place.mkdir()
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    made = kind.make(place)
            except Exception as e:
                print(f"left out: {kind.name} ({type(e).__name__}: {e})")
                continue
            sources.append((kind.name, made.path, made.path.read_bytes(), made))
        for k in range(first, first + count):
            name, path, raw, made = sources[k % len(sources)]
            how = {key: v for key, v in made.how.items() if key == "values"}
            path.write_bytes(mutate(raw, random.Random(f"{seed} {k}")))
            start = time.perf_counter()
            said = outcome(path, how)
            took = time.perf_counter() - start
            slowest = max(slowest, (took, name))
            found[said] += 1
            if not said.startswith(("error:", "a mesh")):
                print(f"file {k}, {name}: {said}")
            path.write_bytes(raw)
            if (k + 1) % 1000 == 0:
                print(k + 1, dict(found), f"slowest {slowest[0]:.1f} s", flush=True)
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    return {
        "files": count, "kinds": len(sources), "outcomes": dict(found.most_common()),
        "slowest_s": round(slowest[0], 2), "slowest_kind": slowest[1],
        "largest_child_MB": round(peak),
    }  # fmt: skip


def threads(seconds: float) -> dict[str, Any]:
    before = sys.stdout, sys.stderr, list(warnings.filters), open
    wrong: list[str] = []
    counts: collections.Counter[str] = collections.Counter()
    stop = time.monotonic() + seconds
    with tempfile.TemporaryDirectory() as root, open(Path(root) / "printed", "w+") as printed:

        def work(k: int) -> None:
            rng = np.random.default_rng(k)
            while time.monotonic() < stop:
                n = int(rng.integers(1, 5))
                mesh = jaxvr.datasets.box((n, 2, 2), jitter=0.2, seed=int(rng.integers(1_000_000)))
                path = Path(root) / f"{k}.{'vtu' if rng.random() < 0.5 else 'vtk'}"
                jaxvr.write_mesh(path, mesh)
                back = jaxvr.read_mesh(path)
                counts["written and read"] += 1
                if not (
                    np.array_equal(back.points, mesh.points)
                    and np.array_equal(back.values, mesh.values)
                ):
                    wrong.append(f"{path.name} came back as another one")

        def talk() -> None:
            while time.monotonic() < stop:
                print("a line", file=printed)
                counts["lines printed"] += 1
                time.sleep(0.001)

        workers = [threading.Thread(target=work, args=(k,)) for k in range(8)]
        workers.append(threading.Thread(target=talk))
        for t in workers:
            t.start()
        for t in workers:
            t.join()
        printed.seek(0)
        lines = sum(1 for _ in printed)
    same = before == (sys.stdout, sys.stderr, list(warnings.filters), open)
    if lines != counts["lines printed"]:
        wrong.append(f"{counts['lines printed']} lines printed, {lines} arrived")
    return {**counts, "wrong": wrong, "streams and filters as before": same}


_WRITER = """
import sys, jaxvr, numpy as np
mesh = jaxvr.datasets.box((8, 8, 8), field=lambda p: p[:, 0])
k = 0
print("ready", flush=True)
while True:
    k += 1
    jaxvr.write_mesh(sys.argv[1], mesh.replace(values=np.full(mesh.n_points, float(k))))
"""


def kills(count: int) -> dict[str, Any]:
    """Half of them kill the process of the user, half the one that writes for it."""
    rng = random.Random(0)
    found: collections.Counter[str] = collections.Counter()
    left = 0
    with tempfile.TemporaryDirectory() as root:
        path = Path(root) / "a.vtu"
        jaxvr.write_mesh(path, jaxvr.datasets.box((8, 8, 8)))
        process = None
        for k in range(count):
            if process is None or process.poll() is not None:
                process = subprocess.Popen(
                    [sys.executable, "-c", _WRITER, str(path)], stdout=subprocess.PIPE,
                    stderr=subprocess.DEVNULL, start_new_session=True,
                )  # fmt: skip
                assert process.stdout is not None
                process.stdout.readline()
                time.sleep(0.7)
            time.sleep(rng.uniform(0, 0.1))
            if k % 2:
                process.kill()
                process.wait()
            else:
                for child in _children(process.pid):
                    with contextlib.suppress(ProcessLookupError):
                        os.kill(child, signal.SIGKILL)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(0.5)  # with an error, if it was writing
            time.sleep(0.05)
            try:
                mesh = jaxvr.read_mesh(path)
                whole = mesh.n_tets == 6 * 8**3
                found["a whole file" if whole else "ANOTHER MESH"] += 1
            except (ValueError, OSError) as e:
                found[f"BROKEN: {e}"] += 1
        if process is not None:
            process.kill()
            process.wait()
        time.sleep(1)
        left = len([p for p in Path(root).iterdir() if p != path])
    return {"kills": count, **found, "folders left behind": left}


def _children(pid: int) -> list[int]:
    try:
        return [int(w) for w in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except OSError:
        return []


def disks() -> dict[str, str]:
    mesh = jaxvr.datasets.box((16, 16, 16))
    out = {}

    def attempt(label: str, path: Path, old: bytes | None) -> None:
        try:
            jaxvr.write_mesh(path, mesh)
            said = "written"
        except (OSError, ValueError) as e:
            said = f"{type(e).__name__}: {str(e).replace(str(path.parent), '...')}"
        kept = old is None or path.read_bytes() == old
        left = [p.name for p in path.parent.glob(".*")] if path.parent.is_dir() else []
        out[label] = (
            said + ("" if kept else " THE OLD FILE IS GONE") + (f" LEFT {left}" * bool(left))
        )

    with tempfile.TemporaryDirectory() as root:
        small = Path(root) / "small"
        small.mkdir()
        mount = ["mount", "-t", "tmpfs", "-o", "size=64k", "none", str(small)]
        if os.geteuid() == 0 and subprocess.run(mount, capture_output=True).returncode == 0:
            try:
                for suffix in (".vtu", ".vtk", ".msh"):
                    path = small / f"a{suffix}"
                    path.write_bytes(b"old")
                    attempt(f"full disk, {suffix}", path, b"old")
                    path.unlink()
                subprocess.run([*mount[:4], "remount,ro", "none", str(small)], check=True)
                attempt("read-only disk", small / "a.vtu", None)
            finally:
                subprocess.run(["umount", str(small)], check=True)
        else:
            out["full disk"] = "not tried: no right to mount one"
        attempt("no folder", Path(root) / "none" / "a.vtu", None)
        attempt("a folder of that name", small, None)
        attempt("a name too long", Path(root) / ("a" * 300 + ".vtu"), None)
        attempt("a folder that is no folder", Path("/dev/null/a.vtu"), None)
    attempt("/proc", Path("/proc/a.vtu"), None)
    return out


def main(argv: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--mutants", type=int, default=10_000)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="place of the first mutant")
    parser.add_argument("--out", type=Path, help="folder for file_faults.json")
    arguments = parser.parse_args(argv)
    report: dict[str, Any] = {}
    for name, run in (
        ("disks", disks),
        ("threads", lambda: threads(arguments.seconds)),
        ("kills", lambda: kills(arguments.kills)),
        ("mutants", lambda: mutants(arguments.mutants, arguments.seed, arguments.first)),
    ):
        report[name] = run()
        print(name, json.dumps(report[name], indent=1), flush=True)
    if arguments.out:
        (arguments.out / "file_faults.json").write_text(json.dumps(report, indent=1) + "\n")
    return report


if __name__ == "__main__":
    main()
