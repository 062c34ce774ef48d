"""Does any ray get lost? A million rays through a mesh, by the length of what they cross.

    python experiments/lost_rays.py [--rays N] [--meshes bluntfin oxygen_post] [--json FILE]

With a constant extinction e, length = -log1p(-alpha) / e is what a ray crossed of the mesh; e is
1 / diagonal, so that neither alpha nor its complement loses digits. It is compared with the sum of
the ray's chords in all cells, by the brute force of `jaxvr.testing` on several processes: a
box hierarchy gives candidate cells (some 200 a ray), which are clipped in float64; rays that then
differ by more than the tolerance are clipped again in extended precision, and only what differs
there counts. A lost ray, or one caught in a loop, would be off by a cell at least.

Nine tenths of the rays go from a sphere of 1.5 diagonals round the mesh to points in its box, and a
tenth to vertices, midpoints of edges and centres of faces (as close as the dtype lets them).

Conditioning: a ray that grazes the boundary under an angle f changes its chord by offset / f when
it is moved by that offset, however it is computed. So rays that differ are reported as `vague` if
moving them by one rounding of a coordinate at the eye's distance changes the exact chord by more
than the tolerance, and rays with a chord above a thousandth of the diagonal are counted apart.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
import time
import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from experiments.data import meshes_of
from jaxvr.testing.brute import AROUND, BruteForce

FIELDS = {"bluntfin": "density", "oxygen_post": "speed", "football_zoo": None}
TOLERANCE = {"float32": 1e-4, "float64": 1e-9}
NUDGE = {"float32": 1e-7, "float64": 2e-16}

_reference: Any = None


def _start(arrays: tuple[np.ndarray, np.ndarray]) -> None:
    global _reference
    points, cells = arrays
    mesh = SimpleNamespace(points=points, cells=cells, values=np.zeros(len(points)))
    mesh.location = "point"
    _reference = BruteForce(mesh, np.float64)


def _lengths(rays: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    return _reference.lengths(*rays)


def exact_lengths(
    mesh: Any, origins: np.ndarray, directions: np.ndarray, processes: int
) -> np.ndarray:
    """Sums of chords (R,) in float64."""
    arrays = np.asarray(mesh.points), np.asarray(mesh.cells)
    parts = [slice(i, i + 2048) for i in range(0, len(origins), 2048)]
    jobs = [(origins[p], directions[p]) for p in parts]
    if processes == 1:
        _start(arrays)
        return np.concatenate([_lengths(job) for job in jobs])
    context = multiprocessing.get_context("spawn")
    with context.Pool(processes, _start, (arrays,)) as pool:
        return np.concatenate(pool.map(_lengths, jobs, chunksize=4))


def aim(corners: np.ndarray, count: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Eyes and targets (count, 3), and which of them (count,) are aimed at mesh features."""
    rng = np.random.default_rng(seed)
    low, high = corners.min((0, 1)), corners.max((0, 1))
    diagonal = np.linalg.norm(high - low)
    eye = rng.normal(size=(count, 3))
    eye = 0.5 * (low + high) + 1.5 * diagonal * eye / np.linalg.norm(eye, axis=1, keepdims=True)
    target = low + (high - low) * rng.random((count, 3))
    aimed = np.arange(count) % 10 == 0
    cell = corners[rng.integers(0, len(corners), aimed.sum())]
    used = rng.integers(1, 4, aimed.sum())  # one corner, an edge's two or a face's three
    weight = (np.arange(4)[None] < used[:, None]) / used[:, None]
    target[aimed] = (cell * weight[..., None]).sum(1)
    return eye, target, aimed


def run_mesh(
    path: Path, dtype: str, count: int, processes: int, known: dict, field: str | None = None
) -> dict[str, Any]:
    """Counts for one mesh; `known` keeps the lengths of the rays that both dtypes share."""
    import jax

    import jaxvr
    from jaxvr.volume import read_mesh

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        mesh = read_mesh(path, field, np.dtype(dtype))
    points = np.asarray(mesh.points, np.float64)
    corners = points[np.asarray(mesh.cells)]
    diagonal = float(np.linalg.norm(np.ptp(corners.reshape(-1, 3), axis=0)))
    eye, target, aimed = aim(corners, count, seed=0)
    origins = eye.astype(np.float32).astype(dtype)
    directions = target - origins
    # rays without an aim are the same numbers in both dtypes, so that one reference serves both
    directions[~aimed] = directions[~aimed].astype(np.float32)
    directions = directions.astype(dtype)
    tf = jaxvr.TransferFunction(
        np.asarray([0.0], dtype), np.ones((1, 3), dtype), np.asarray([1 / diagonal], dtype)
    )
    start = time.perf_counter()
    alpha, status = [], []
    step = 1 << 17
    for i in range(0, count, step):
        part = np.minimum(np.arange(i, i + min(step, count)), count - 1)  # one shape, one compile
        rgba, bits = jaxvr.render_rays(mesh, origins[part], directions[part], tf, status=True)
        alpha.append(np.asarray(rgba[: min(step, count - i), 3], np.float64))
        status.append(np.asarray(bits[: min(step, count - i)]))
    length = -np.log1p(-np.concatenate(alpha)) / float(tf.extinctions[0])
    render_seconds = time.perf_counter() - start
    start = time.perf_counter()
    exact = np.zeros(count)
    key = hash(points.tobytes())
    for part, shared in ((aimed, False), (~aimed, True)):
        if shared and key in known:
            exact[part] = known[key]
            continue
        exact[part] = exact_lengths(mesh, origins[part], directions[part], processes)
        if shared:
            known[key] = exact[part]
    seconds = time.perf_counter() - start

    def relative(a, b):
        return np.abs(a - b) / np.maximum(np.maximum(a, b), 1e-300)

    off = np.flatnonzero(relative(length, exact) > TOLERANCE[dtype])
    vague = np.zeros(count, bool)
    if len(off):
        fine = BruteForce(mesh)
        rays = origins[off], directions[off]
        exact[off] = fine.lengths(*rays)
        moved = [fine.lengths(*rays, shift=NUDGE[dtype] * u) for u in AROUND]
        change = np.max([relative(m, exact[off]) for m in moved], axis=0)
        vague[off] = change > TOLERANCE[dtype]
    error = relative(length, exact)
    differ = error > TOLERANCE[dtype]
    long = exact > 1e-3 * diagonal
    hit = exact > 0
    del jax
    return {
        "mesh": path.stem,
        "dtype": dtype,
        "rays": count,
        "aimed": int(aimed.sum()),
        "hit": int(hit.sum()),
        "status": int(np.count_nonzero(np.concatenate(status))),
        "differ": int(differ.sum()),
        "differ_vague": int((differ & vague).sum()),
        "differ_aimed": int((differ & aimed).sum()),
        "differ_long": int((differ & long).sum()),
        "differ_clear": int((differ & ~vague).sum()),
        "worst_absolute": float(np.abs(length - exact).max() / diagonal),
        "worst_long": float(error[long].max(initial=0)),
        "worst_clear": float(error[~vague].max(initial=0)),
        "longest_differing": float((exact[differ] / diagonal).max(initial=0)),
        "median": float(np.median(error[hit])),
        "render_seconds": render_seconds,
        "reference_seconds": seconds,
    }


def main(arguments: Any = None) -> list[dict[str, Any]]:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rays", type=int, default=1_000_000)
    parser.add_argument("--meshes", nargs="+", default=["bluntfin", "oxygen_post"])
    parser.add_argument("--dtypes", nargs="+", default=["float32", "float64"])
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    import jax

    files = meshes_of(options.meshes, parser)
    jax.config.update("jax_enable_x64", True)
    results, known = [], {}
    print("rays whose length is off by more than 1e-4 (float32) or 1e-9 (float64), relative")
    print(
        f"{'mesh':13}{'dtype':9}{'rays':>9}{'hit':>9}{'median':>9}{'lost':>6}{'differ':>8}"
        f"{'vague':>7}{'aimed':>7}{'long':>6}{'clear':>7}{'worst long':>12}{'worst/size':>12}"
    )
    for name, path in files.items():
        for dtype in options.dtypes:
            field = FIELDS.get(name)
            r = run_mesh(path, dtype, options.rays, options.processes, known, field)
            results.append(r)
            print(
                f"{name:13}{dtype:9}{r['rays']:9}{r['hit']:9}{r['median']:9.1e}{r['status']:6}"
                f"{r['differ']:8}{r['differ_vague']:7}{r['differ_aimed']:7}{r['differ_long']:6}"
                f"{r['differ_clear']:7}{r['worst_long']:12.1e}{r['worst_absolute']:12.1e}"
                f"   (render {r['render_seconds']:.0f} s,"
                f" brute force {r['reference_seconds']:.0f} s)",
                flush=True,
            )
    print(
        "lost: status bits; vague: ill-conditioned at the boundary; long: chord > diagonal / 1000;"
    )
    print("clear: neither vague; worst/size: largest absolute difference, of the diagonal")
    if options.json:
        options.json.write_text(json.dumps(results, indent=1) + "\n")
    return results


if __name__ == "__main__":
    main()
