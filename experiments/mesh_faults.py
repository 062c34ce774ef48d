"""Meshes whose leaves were computed with, and what becomes of each.

    python -m experiments.mesh_faults [--count 240] [--json FILE] [--tiny]

Each mutant of a mesh (integers out of range, negative, overflowing; entries exchanged; neighbours
that do not answer, and rings of them; bits turned over; averages, steps and products over all
leaves; numbers that are not finite, points mirrored, leaves permuted) is rendered, traced and
shaded, and differentiated, as it is and, where it can be, as an argument of a function under `jit`,
by compiled loops and by JAX's own. It may end in an error in words (`error`), in a status bit
(`status`), in a picture that is what the mesh shows (`right`: that of the mesh before, or, where
numbers were changed and no integers, that of a mesh built from them anew), or in one with NaN
(`NaN`). It must not crash, run on, or give another picture with status 0 (`wrong`).

A crash would end the script; a case that takes more than a minute says so (`late`).
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxvr
from experiments.common import table

OUTCOMES = ("error", "status", "right", "NaN", "wrong", "crash", "late")
BAD = ("wrong", "crash", "late")
LATE = 60.0
INTEGERS = ("cells", "neighbors", "boundary", "duplicates")
TURNED, FLAG = 4, 8
Arrays = dict[str, np.ndarray]


def subjects(dtype: str) -> list[jaxvr.TetMesh]:
    """A box, and two that touch in points of their own (seams)."""
    box = jaxvr.datasets.box((2, 2, 1), jitter=0.1, field=lambda p: p[:, 0] + 0.2 * p[:, 1])
    points, cells = np.asarray(box.points, np.float64), np.asarray(box.cells)
    both = np.concatenate([points, points * [-1, 1, 1]])
    seamed = jaxvr.TetMesh.from_cells(
        both,
        {"tetra": np.concatenate([cells, cells + len(points)])},
        both[:, 1] + np.repeat([0.0, 0.3], len(points)),
        dtype=dtype,
    )
    return [
        jaxvr.TetMesh.from_cells(points, {"tetra": cells}, np.asarray(box.values), dtype=dtype),
        seamed,
    ]


def one_entry(x: np.ndarray, rng: Any, change: Callable[[int], int]) -> None:
    at = tuple(rng.integers(n) for n in x.shape)
    x[at] = np.int64(change(int(x[at]))).astype(np.int32)


def some_entries(x: np.ndarray, rng: Any) -> None:
    flat = x.reshape(-1)
    flat[rng.integers(flat.size, size=3)] = flat[rng.integers(flat.size, size=3)]


def permute(x: np.ndarray, rng: Any) -> None:
    x[:] = x[rng.permutation(len(x))]


def exchange(x: np.ndarray, rng: Any) -> None:
    first, second = rng.choice(len(x), 2, replace=False)
    x[[first, second]] = x[[second, first]]


def ring(arrays: Arrays, rng: Any) -> None:
    """Each cell, or a pair of cells, is its own neighbour across all faces."""
    count = len(arrays["neighbors"])
    cell = np.arange(count) ^ int(rng.integers(2))
    arrays["neighbors"][:] = np.minimum(cell, count - 1)[:, None] << 4 | np.arange(4)[None]


def unanswered(arrays: Arrays, rng: Any) -> None:
    x = arrays["neighbors"]
    at = np.argwhere(x >= 0)
    cell, corner = at[rng.integers(len(at))]
    x[cell, corner] = int(rng.integers(len(x))) << 4 | int(rng.integers(4))


def bits(name: str, bit: int, whole: bool) -> Callable[[Arrays, Any], None]:
    def change(arrays: Arrays, rng: Any) -> None:
        x = arrays[name]
        at = np.argwhere(x >= 0)
        for place in at if whole else at[rng.integers(len(at))][None]:
            x[tuple(place)] ^= bit

    return change


def of(name: str, change: Callable[[np.ndarray, Any], Any]) -> Callable[[Arrays, Any], None]:
    return lambda arrays, rng: change(arrays[name], rng)


def numbers(name: str, value: float) -> Callable[[Arrays, Any], None]:
    def change(arrays: Arrays, rng: Any) -> None:
        arrays[name].reshape(-1)[rng.integers(arrays[name].size)] = value

    return change


def all_leaves(step: Callable[[np.ndarray, Any], np.ndarray]) -> Callable[[Arrays, Any], None]:
    def change(arrays: Arrays, rng: Any) -> None:
        for name in arrays:
            arrays[name] = step(arrays[name], rng)

    return change


def kinds() -> dict[str, Callable[[Arrays, Any], None]]:
    out: dict[str, Callable[[Arrays, Any], None]] = {}
    for name in INTEGERS:
        changes: dict[str, Callable[[int], int]] = {
            "large": lambda v: 2**31 - 1,
            "small": lambda v: -(2**31),
            "-7": lambda v: -7,
            "times 1000": lambda v: (v + 1) * 1000,
            "one more": lambda v: v + 1,
            "one less": lambda v: v - 1,
        }
        for what, change in changes.items():
            out[f"{name}: {what}"] = of(name, lambda x, rng, c=change: one_entry(x, rng, c))
        for bit in (0, 1, 2, 3, 5, 30):
            out[f"{name}: bit {bit}"] = of(
                name, lambda x, rng, b=bit: one_entry(x, rng, lambda v: v ^ (1 << b))
            )
        out[f"{name}: others' entries"] = of(name, some_entries)
        out[f"{name}: permuted"] = of(name, permute)
        out[f"{name}: two exchanged"] = of(name, exchange)
    out |= {
        "neighbors: ring": ring,
        "neighbors: unanswered": unanswered,
        "neighbors: none": of("neighbors", lambda x, rng: x.fill(-1)),
        "turned in one word": bits("neighbors", TURNED, False),
        "turned in a word of the boundary": bits("boundary", TURNED, False),
        "turned in all words": bits("neighbors", TURNED, True),
        "seam of one face": bits("neighbors", FLAG, False),
        "seams of all": bits("neighbors", FLAG, True),
        "entry of one face": bits("boundary", FLAG, False),
        "entries of all": bits("boundary", FLAG, True),
        "all leaves: half of two": all_leaves(lambda x, rng: (x + x) / 2),
        "all leaves: half": all_leaves(lambda x, rng: (x * 0.5).astype(x.dtype)),
        "all leaves: twice": all_leaves(lambda x, rng: x * 2),
        "all leaves: a step": all_leaves(
            lambda x, rng: (x + rng.normal(scale=2, size=x.shape)).astype(x.dtype)
        ),
        "all leaves: a little step": all_leaves(
            lambda x, rng: (x - 1e-3 * rng.normal(size=x.shape)).astype(x.dtype)
        ),
        "all leaves: minus": all_leaves(lambda x, rng: -x),
        "all leaves: floats": all_leaves(lambda x, rng: x.astype(np.float32)),
        "points: mirrored": of("points", lambda x, rng: np.negative(x[:, 0], x[:, 0])),
        "points: inverted": of("points", lambda x, rng: np.negative(x, x)),
        "points: axes exchanged": of("points", lambda x, rng: exchange(x.T, rng)),
        "points: permuted": of("points", permute),
        "values: permuted": of("values", permute),
    }
    for name in ("points", "values"):
        for value in (np.nan, np.inf, 1e38, -1e-45):
            out[f"{name}: one is {value}"] = numbers(name, value)
    return out


class Judge:
    """Views of a mesh, and the outcome of a mutant in each."""

    def __init__(self, mesh: jaxvr.TetMesh, dtype: str, tiny: bool = False):
        self.mesh, self.dtype, self.tiny = mesh, dtype, tiny
        self.camera = jaxvr.Camera.orbit(mesh, azimuth=31, elevation=17, width=8, height=7)
        self.transfer = jaxvr.default_transfer(mesh)
        self.draws: dict[bool, Any] = {}
        self.slopes: dict[bool, Any] = {}
        for native in (True, False):
            engine = jaxvr.engine.C() if native else jaxvr.engine.XLA()

            def draw(m: Any, e: Any = engine) -> Any:
                return jaxvr.render(m, self.camera, self.transfer, engine=e, status=True)

            def slope(m: Any, d: Any = draw) -> Any:
                of_values = lambda v: d(dataclasses.replace(m, values=v))  # noqa: E731
                image, pull, status = jax.vjp(of_values, m.values, has_aux=True)
                return pull(jnp.ones_like(image))[0], status

            self.draws[native], self.slopes[native] = draw, slope
        self.jitted = {
            (what, native): jax.jit(f)
            for what, fs in (("render", self.draws), ("gradient", self.slopes))
            for native, f in fs.items()
        }
        self.want: dict[str, Any] = {
            "render": self.draws[True](mesh)[0],
            "gradient": self.slopes[True](mesh)[0],
        }

    def traced(self, mesh: Any, native: bool) -> tuple[Any, Any]:
        engine = jaxvr.engine.C() if native else jaxvr.engine.XLA()
        segments = jaxvr.trace(mesh, self.camera, engine=engine)
        return jaxvr.shade(segments, self.transfer, engine=engine), segments.status

    def ways(self) -> Iterator[tuple[str, str, bool, Callable[[Any], Any]]]:
        """What is done, how, by which loops, and the function."""
        for native in (True, False):
            yield "render", "as it is", native, self.draws[native]
            yield "trace, shade", "as it is", native, lambda m, n=native: self.traced(m, n)
            if native or not self.tiny:  # JAX's own gradient takes longest to compile
                yield "gradient", "as it is", native, self.slopes[native]
            for what in ("render", "gradient")[: 2 if native or not self.tiny else 1]:
                yield what, "under jit", native, self.jitted[what, native]

    def what_it_shows(self, mutant: Any) -> dict[str, Any] | None:
        """Picture and gradient of a mesh built anew from a mutant with its own integers."""
        same = all(
            np.array_equal(getattr(mutant, k), getattr(self.mesh, k))
            for k in ("cells", "neighbors", "duplicates")
        )
        if not same or not np.isfinite(mutant.points).all() or not np.isfinite(mutant.values).all():
            return None
        try:
            anew = jaxvr.TetMesh.from_cells(
                mutant.points, {"tetra": mutant.cells}, mutant.values, dtype=self.dtype
            )
            return {
                "render": self.draws[True](anew)[0],
                "gradient": self.slopes[True](anew)[0],
            }
        except (ValueError, jaxvr.RenderError):
            return None

    def outcome(self, mutant: Any, what: str, do: Callable[[Any], Any], shows: Any) -> str:
        start = time.monotonic()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                got, status = jax.block_until_ready(do(mutant))
        except (ValueError, jaxvr.RenderError):
            return "error"
        except jax.errors.JaxRuntimeError as error:  # of a compiled loop's gradient, which has no
            return "error" if "jaxvr: integers" in str(error) else "crash"  # status
        if time.monotonic() - start > LATE:
            return "late"
        if np.asarray(status).any():
            return "status"
        if not np.isfinite(got).all():
            return "NaN"
        key = "gradient" if what == "gradient" else "render"
        size = float(np.abs(self.want[key]).max())
        for want in (self.want[key], *([shows[key]] if shows else [])):
            if np.allclose(got, want, atol=2e-4 * size, rtol=0):
                return "right"
        return "wrong"


def run(
    count: int, dtypes: tuple[str, ...] = ("float32",), seed: int = 0, tiny: bool = False
) -> dict[str, Any]:
    """The first `count` mutants of all kinds, in turn over meshes and dtypes."""
    judges = [
        Judge(m, dtype, tiny) for dtype in dtypes for m in subjects(dtype)[-1 if tiny else 0 :]
    ]
    print(f"{len(judges)} meshes", flush=True)
    changes, rows, rng = kinds(), [], np.random.default_rng(seed)
    names = list(changes)
    start = time.monotonic()
    order = rng.permutation(len(names)) if count < len(names) else np.arange(len(names))
    for number in range(count):
        kind = names[order[number % len(names)]]
        judge = judges[(number + number // len(names)) % len(judges)]
        arrays = {k: np.array(getattr(judge.mesh, k)) for k in (*INTEGERS, "points", "values")}
        if kind.startswith("duplicates") and len(arrays["duplicates"]) == 0:
            judge = judges[-1]
            arrays = {k: np.array(getattr(judge.mesh, k)) for k in arrays}
        changes[kind](arrays, rng)
        mutant = dataclasses.replace(judge.mesh, **{k: jnp.asarray(x) for k, x in arrays.items()})
        shows = judge.what_it_shows(mutant)
        for what, how, native, do in judge.ways():
            rows.append(
                {
                    "kind": kind,
                    "what": what,
                    "how": how,
                    "loops": "compiled" if native else "JAX",
                    "outcome": judge.outcome(mutant, what, do, shows),
                }
            )
            if rows[-1]["outcome"] in BAD:
                print(number, judge.dtype, rows[-1], flush=True)
    out = []
    for what, how in dict.fromkeys((r["what"], r["how"]) for r in rows):
        for loops in ("compiled", "JAX"):
            own = [r for r in rows if (r["what"], r["how"], r["loops"]) == (what, how, loops)]
            number = Counter(r["outcome"] for r in own)
            out.append(
                {"what": what, "how": how, "loops": loops, "mutants": len(own)}
                | {k: number[k] for k in OUTCOMES}
            )
    print(table(out), flush=True)
    wrong = Counter(f"{r['kind']} ({r['how']})" for r in rows if r["outcome"] in BAD)
    return {
        "dtypes": dtypes,
        "mutants": count,
        "kinds": len(names),
        "seconds": round(time.monotonic() - start),
        "table": out,
        "wrong": dict(wrong),
    }


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--count", type=int, default=240)
    parser.add_argument("--dtype", choices=["float32", "float64"], action="append")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--tiny", action="store_true")
    args = parser.parse_args(arguments)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # rows of a mesh are sorted, not oriented
        dtypes = tuple(args.dtype or ("float32", "float64"))
        report = run(8, tiny=True) if args.tiny else run(args.count, dtypes)
    if args.json:
        args.json.write_text(json.dumps(report, indent=1) + "\n")
    return report


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
