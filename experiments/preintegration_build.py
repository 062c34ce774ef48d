"""How long a pre-integrated table takes to build, and what building it incrementally costs.

    python -m experiments.preintegration_build [--repeat 7] [--json FILE] [--out FOLDER] [--tiny]

Callahan et al. 2005, Table 3: milliseconds of the base slice, of the slices composed from it, and
in total, for three sizes. Here beside the direct build, with the errors of the composed tables
against it (float32), for both schedules and for the logarithmic table; then for 2, 11 and 64
control points. Last the seconds that somebody waits who moves a control point: the whole `prepare`
of the default integrator for a new transfer function, which compiles nothing, and its gradient.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxvr
from experiments.common import table, write_json
from jaxvr.optics.partition import nodes_of
from jaxvr.optics.preintegration import SCHEDULES
from jaxvr.optics.preintegration_table import direct, doubling
from jaxvr.plot import Figure

SIZES = ((64, 64, 128), (128, 128, 128), (128, 128, 256))
POINTS = (2, 11, 64)
# Scale and schedule; a logarithmic table is doubled, whatever the schedule.
WAYS = (("linear", "one by one"), ("linear", "halves"), ("log", "halves"))


def transfer_of(points: int, seed: int = 0) -> jaxvr.TransferFunction:
    """Control points over [0, 1] with random colours, and extinctions from 0.5 to 8: the longest
    segment has length 1."""
    rng = np.random.default_rng(seed)
    return jaxvr.TransferFunction(
        np.linspace(0, 1, points),
        rng.uniform(0, 1, (points, 3)),
        rng.uniform(0.5, 8, points),
        dtype="float32",
    )


def milliseconds(task: Callable[[], Any], repeat: int) -> float:
    """Median of `repeat` calls, after one that compiles."""
    jax.block_until_ready(task())
    taken = []
    for _ in range(repeat):
        start = time.perf_counter()
        jax.block_until_ready(task())
        taken.append(time.perf_counter() - start)
    return 1e3 * float(np.median(taken))


def build(
    size: tuple[int, int, int], points: int, repeat: int
) -> tuple[list[dict[str, Any]], dict[str, dict[str, list[float]]]]:
    """One row a way to build: milliseconds, and errors against the direct build; and for each way
    the errors of every slice."""
    n_f, n_b, n_l = size
    longest = jnp.float32(1)
    transfer = transfer_of(points)
    nodes = nodes_of(transfer, np.float32)
    scalars = tuple(jnp.linspace(0, 1, n, dtype=np.float32) for n in (n_f, n_b))
    slices = jax.jit(direct)
    rows, exact, by_length = [], {}, {}
    for scale in ("linear", "log"):
        whole = jaxvr.PreIntegration(size, scale, incremental=False)
        make = jax.jit(whole._build)
        exact[scale] = np.asarray(make(nodes, longest), np.float64)
        total = milliseconds(lambda: make(nodes, longest), max(1, repeat // 3))
        rows.append(_row(size, points, f"{scale}, direct", total=total, direct=total))
    for scale, schedule in WAYS:
        integrator = jaxvr.PreIntegration(size, scale, schedule=schedule)
        lengths = integrator._length(jnp.arange(1, n_l), longest)
        first = lengths[: 1 if scale == "linear" else min(integrator._per_octave, n_l - 1)]
        base = slices(nodes, scalars, first)
        if scale == "linear":
            steps = jax.jit(lambda b, way=SCHEDULES[schedule]: way(b[0], n_l - 1))
        else:
            steps = jax.jit(lambda b: doubling(b, n_l - 1))
        make = jax.jit(integrator._build)
        gap = np.abs(np.asarray(make(nodes, longest), np.float64) - exact[scale])
        by_length[_name(scale, schedule)] = {
            "length": np.asarray(lengths).tolist(),
            "largest": gap[1:].max((1, 2, 3)).tolist(),
            "mean": gap[1:].mean((1, 2, 3)).tolist(),
        }
        rows.append(
            _row(
                size,
                points,
                _name(scale, schedule),
                base=milliseconds(lambda: slices(nodes, scalars, first), repeat),
                steps=milliseconds(lambda: steps(base), repeat),
                total=milliseconds(lambda: make(nodes, longest), repeat),
                direct=rows[scale == "log"]["total ms"],
                largest=float(gap.max()),
                mean=float(gap.mean()),
            )
        )
    return rows, by_length


def _name(scale: str, schedule: str) -> str:
    return f"{scale}, {schedule if scale == 'linear' else 'doubling'}"


def _row(size, points, how, *, base=None, steps=None, total, direct, largest=None, mean=None):
    return {
        "size": "x".join(map(str, size)),
        "points": points,
        "build": how,
        "base ms": base,
        "incremental ms": steps,
        "total ms": total,
        "direct / total": direct / total,
        "largest error": largest,
        "mean error": mean,
    }


def wait(size: tuple[int, int, int], points: int, repeat: int) -> dict[str, Any]:
    """Seconds for `prepare` and for its gradient, each with a new transfer function."""
    integrator = jaxvr.PreIntegration(size)
    traced = []

    def rows(transfer):
        traced.append(transfer)  # Python runs this only to compile
        return integrator.prepare(transfer, np.float32, jnp.float32(1)).rows

    prepare = jax.jit(rows)
    slope = jax.jit(jax.grad(lambda transfer: jnp.sum(rows(transfer) ** 2)))
    others = iter([transfer_of(points, seed) for seed in range(2 * repeat + 2)])
    seconds = [milliseconds(lambda f=f: f(next(others)), repeat) / 1e3 for f in (prepare, slope)]
    return {
        "size": "x".join(map(str, size)),
        "points": points,
        "prepare s": seconds[0],
        "gradient s": seconds[1],
        "compilations": len(traced),
    }


def plot_by_length(by_length: dict[str, dict[str, list[float]]], title: str) -> Figure:
    """Largest and mean error of each slice of the composed tables against the direct one."""
    figure = Figure(figsize=(10, 3.8), layout="constrained")
    for ax, what in zip(figure.subplots(1, 2), ("largest", "mean"), strict=True):
        for name, errors in by_length.items():
            made = np.array(errors[what]) > 0
            lengths = np.array(errors["length"])[made]
            ax.loglog(lengths, np.array(errors[what])[made], ".-", label=name)
        ax.set_xlabel("length of the slice, as part of the longest")
        ax.set_ylabel(f"{what} error of its entries")
        ax.grid(alpha=0.3)
        ax.legend()
    figure.suptitle(title)
    return figure


def run(
    out: Path | None = None,
    *,
    sizes: tuple[tuple[int, int, int], ...] = SIZES,
    points: tuple[int, ...] = POINTS,
    repeat: int = 7,
) -> dict[str, Any]:
    """Every size with 11 control points, and the second size with all of `points`."""
    report: dict[str, Any] = {
        "cores": os.cpu_count(),
        "device": jax.devices()[0].device_kind,
        "build": [],
        "wait": [],
    }
    middle = sizes[min(1, len(sizes) - 1)]
    cases = [(size, 11) for size in sizes] + [(middle, k) for k in points if k != 11]
    for size, k in cases:
        rows, by_length = build(size, k, repeat)
        report["build"] += rows
        if (size, k) == (middle, 11):
            report["by_length"] = by_length
        print(f"{table(rows)}\n", flush=True)
    report["wait"] = [wait(middle, k, repeat) for k in points]
    print(f"default integrator, a new transfer function each time\n{table(report['wait'])}")
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        title = f"{' x '.join(map(str, middle))} composed, against direct; 11 control points"
        figure = plot_by_length(report["by_length"], title)
        figure.savefig(out / "preintegration_build.png", dpi=150)
    return report


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--repeat", type=int, default=7)
    parser.add_argument("--out", type=Path, help="folder for a picture of errors by length")
    parser.add_argument("--json", type=Path, help="write the numbers there")
    parser.add_argument("--tiny", action="store_true", help="one small table, timed once")
    options = parser.parse_args(arguments)
    tiny: dict[str, Any] = {"sizes": ((16, 16, 16),), "points": (11,), "repeat": 1}
    report = run(options.out, **(tiny if options.tiny else {"repeat": options.repeat}))
    if options.json:
        write_json(options.json, report)
    return report


if __name__ == "__main__":
    main()
