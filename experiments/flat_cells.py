"""Rays through cells without volume: chords, pictures and gradients by points.

    python -m experiments.flat_cells [--rays 1000000] [--before FOLDER] [--json FILE]
    python -m experiments.flat_cells --time

Eight Delaunay meshes of convex sets of points, as Qhull returns them (`tests/flat_meshes.py`):
lattices whose inner points are jittered by 0, 1e-12 and 1e-7, spheres in each other, slivers, a
stack of prisms, a mesh squashed to 1e-6 of its height, and the lattice without jitter after
`replace(points=)` with its inner points moved by 0.02. Half of the rays are aimed at vertices,
edges, faces and cells, along directions of the lattice and from anywhere; the others run along
edges, in faces, from vertex to vertex and in lattice planes.

A mesh fills the convex hull of its points, so what is exact needs no cells, and no code of the
package: where a ray enters and leaves the hull, hence its chord; and with a field that is linear in
space, and extinction and colour that are linear in it, its colour, by Gauss-Legendre. In NumPy, and
again in long doubles for rays that are off. *Chord*: the error of the length recovered from alpha
in a homogeneous medium, as a part of the hull's chord through the middle in the ray's direction, so
that chords across a squashed mesh count as much as those along it. *Picture*: largest error of r,
g, b, alpha.

Of the rays that are off by more than 1e-4 those are counted apart whose error *rounding* explains:
at most four times what the exact result changes by when the ray is moved by one rounding of its
coordinates (where it grazes the hull), and both ends of the chord by one rounding of the diagonal
(where the chord is a few units of that, as across the squashed mesh in float32).

Gradients (float64): the derivative of a ray's colour by one inner point along one direction
against differences from either side, extrapolated to step 0 (Richardson). Rays are not aimed. Where
a cell has no volume the derivative has two sides: on one the cell gains volume, on the other it is
turned over and has no length. The derivative is that of the side where it gains volume; a move
that gives volume to one flat cell on the ray and turns another over has sides that mix both kinds,
and the derivative is *neither* of them. Then meshes *nearby*, all inner points of which were moved
by some 1e-9 at random so that no cell is flat, are tried for one whose derivative it is.

--before: the same of another checkout, in a process of its own. --time: seconds of a picture of
real meshes instead, where they are (`JAXVR_DATA`).
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
if str(ROOT) not in sys.path:
    sys.path.append(str(ROOT))  # last: another checkout's package comes before this one's

from experiments.data import path_of  # noqa: E402
from tests import flat_meshes as flat  # noqa: E402

LIMITS = (1e-4, 1e-3)
DTYPES = ("float32", "float64")
BATCH = 1 << 17
TRIES = 100  # of meshes nearby
LOOKED_AT = 10_000  # rays that are off, the least first, whose error rounding may explain
FIELDS = {"bluntfin": "density", "oxygen_post": "speed"}
MOVED = "lattice, moved"
DEPTH = 0.3  # of the homogeneous medium, along the shortest of the lengths that share one
DENSITY = (1.0, 4.0)  # of the linear one, times the diagonal, where the field is 0 and 1
COLORS = np.array([[0.1, 0.9, 0.4], [1.0, 0.2, 0.3]])


def shapes(tiny: bool = False) -> dict[str, tuple[flat.FlatMesh, np.ndarray]]:
    """Meshes, and the points (P, 3) that each is rendered with."""
    n = 4 if tiny else 9
    plain = {
        "lattice": flat.lattice(n),
        "lattice, jitter 1e-12": flat.lattice(n, 1e-12),
        "lattice, jitter 1e-7": flat.lattice(n, 1e-7),
        "cospherical": flat.cospherical(*(3, 5, 1) if tiny else (7, 14, 3)),
        "slivers": flat.slivers(4 if tiny else 8),
        "prisms": flat.prisms(*(5, 2, 1) if tiny else (9, 8, 3)),
        "squashed": flat.squashed(20 if tiny else 1000),
    }
    out = {name: (mesh, mesh.points) for name, mesh in plain.items()}
    return out | {MOVED: (plain["lattice"], flat.moved(plain["lattice"]))}


def build(mesh: flat.FlatMesh, points: np.ndarray, values: Any, dtype: str) -> Any:
    """A `TetMesh` of values (P,) or a function of points (P, 3); moved points come by `replace`."""
    import jaxvr

    given = np.asarray(points, dtype)
    numbers = np.asarray(values(given.astype(np.float64)) if callable(values) else values, dtype)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of flat and inverted cells
        out = jaxvr.TetMesh.from_cells(
            np.asarray(mesh.points, dtype), {"tetra": mesh.cells}, numbers, location="point"
        )
    return out if points is mesh.points else out.replace(points=given)


def diagonal(points: np.ndarray) -> float:
    return float(np.linalg.norm(np.ptp(points, axis=0)))


class Hull:
    """What rays see of a convex body, in float64 or long doubles."""

    def __init__(self, points: np.ndarray, kind: Any = np.float64):
        self.kind = kind
        self.normals, self.offsets = (x.astype(kind) for x in flat.hull_planes(points))
        self.low, self.span = points.min(0), np.ptp(points, axis=0)
        self.size = kind(diagonal(points))
        slope = np.array([0.5, 0.3, 0.2]) / self.span
        self.slope, self.base = slope.astype(kind), kind(-(self.low @ slope))

    def field(self, points: np.ndarray) -> np.ndarray:
        """Linear, from 0 to 1 over the bounding box."""
        return points @ self.slope + self.base

    def interval(self, origins: Any, directions: Any) -> tuple[Any, ...]:
        """Unit directions (R, 3), where rays enter and leave (R,); equal where they miss."""
        o, d = (np.asarray(x, self.kind) for x in (origins, directions))
        d = d / np.sqrt((d**2).sum(1, keepdims=True))
        enter, leave = np.zeros(len(o), self.kind), np.full(len(o), self.kind(np.inf))
        for n, offset in zip(self.normals, self.offsets, strict=True):
            rise, room = d @ n, offset - o @ n
            with np.errstate(divide="ignore", invalid="ignore"):
                at = room / rise
            enter = np.where(rise < 0, np.maximum(enter, at), enter)
            leave = np.where(rise > 0, np.minimum(leave, at), leave)
            leave = np.where((rise == 0) & (room < 0), -np.inf, leave)
        return d, enter, np.maximum(leave, enter)

    def chords(self, origins: Any, directions: Any) -> np.ndarray:
        _, enter, leave = self.interval(origins, directions)
        return leave - enter

    def through_middle(self, directions: np.ndarray) -> np.ndarray:
        """Chords (R,) of lines in these directions through the middle of the bounding box."""
        away = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        return self.chords(self.low + self.span / 2 - 2 * self.size * away, directions)

    def picture(self, origins: Any, directions: Any) -> np.ndarray:
        """r, g, b, alpha (R, 4) of `linear`'s transfer function."""
        d, enter, leave = self.interval(origins, directions)
        o, length = np.asarray(origins, self.kind), leave - enter
        first, last = (self.field(o + t[:, None] * d) for t in (enter, leave))
        low, high = (x / self.size for x in DENSITY)
        t, weights = (x.astype(self.kind) for x in np.polynomial.legendre.leggauss(20))
        rgb = np.zeros((len(o), 3), self.kind)
        # at the part x of the chord, s = first + x (last - first), the density is linear in s and
        # the optical depth before it x length (density(first) + density(s)) / 2
        for x, w in zip((1 + t) / 2, weights / 2, strict=True):
            s = first + x * (last - first)
            density = low + s * (high - low)
            depth = x * length * (low + (first + s) / 2 * (high - low))
            color = COLORS[0] + s[:, None] * (COLORS[1] - COLORS[0])
            rgb += (w * length * density * np.exp(-depth))[:, None] * color
        depth = length * (low + (first + last) / 2 * (high - low))
        return np.concatenate([rgb, -np.expm1(-depth)[:, None]], 1)


def rays_of(
    shape: flat.FlatMesh, points: np.ndarray, hull: Hull, count: int, dtype: str
) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions (count, 3), as exact as the dtype has them. They start two chords
    through the middle before what they are aimed at, so that a squashed mesh is not far away."""
    there = shape._replace(points=points)
    parts = [flat.rays_at_features(there, count - count // 2, seed=1)]
    parts.append(flat.rays_along_features(there, count // 2, seed=2))
    origins, directions = (np.concatenate(x) for x in zip(*parts, strict=True))
    ahead = 2 * (diagonal(points) - np.concatenate(in_parts(hull.through_middle, directions)))
    origins = origins + ahead.astype(float)[:, None] * directions
    return origins.astype(dtype), directions.astype(dtype)


def in_parts(function: Callable[..., Any], *arrays: np.ndarray) -> list[Any]:
    """function of rows of arrays, some at a time: long doubles are large."""
    return [function(*(x[i : i + BATCH] for x in arrays)) for i in range(0, len(arrays[0]), BATCH)]


def colors_of(
    mesh: Any, origins: Any, directions: Any, transfer: Any, step: int
) -> tuple[Any, Any]:
    """(R, 4) and status (R,), `step` rays at a time."""
    import jaxvr

    colors, bits, count = [], [], len(origins)
    for i in range(0, count, step):
        part = np.minimum(np.arange(i, i + step), count - 1)  # one shape, one compilation
        found = jaxvr.render_rays(mesh, origins[part], directions[part], transfer, status=True)
        for all_of, x in zip((colors, bits), found, strict=True):
            all_of.append(np.asarray(x)[: count - i])
    return np.concatenate(colors).astype(np.float64), np.concatenate(bits)


def summary(
    found: np.ndarray,
    exact: Callable[..., np.ndarray],
    unit: np.ndarray,
    ends: np.ndarray,
    rays: tuple[np.ndarray, np.ndarray],
) -> dict[str, Any]:
    """Counts of rays that are off. found (R, n); exact(kind, part, nudge): what it should be, of
    some of the rays, moved by one of eight nudges; errors are parts of unit (R,); ends (R,): the
    error that rounding of both ends makes."""

    def apart(a: np.ndarray, b: np.ndarray, part: Any = slice(None)) -> np.ndarray:
        return np.abs(a - b).max(1).astype(np.float64) / unit[part]

    error = apart(found, exact(np.float64))
    off = np.flatnonzero(~(error <= LIMITS[0]))
    off = off[np.argsort(error[off])[:LOOKED_AT]]
    explained = np.zeros(len(off), bool)
    if len(off):
        want = exact(np.longdouble, off)
        error[off] = apart(found[off], want, off)
        moved = [apart(exact(np.longdouble, off, k), want, off) for k in range(8)]
        explained = error[off] <= 4 * (np.max(moved, axis=0) + ends[off])
    clear = error.copy()
    clear[off[explained]] = -1
    worst = int(np.argmax(clear))
    return {
        "off 1e-4": int((~(clear <= LIMITS[0])).sum()),
        "off 1e-3": int((~(clear <= LIMITS[1])).sum()),
        "worst": float(error[worst]),
        "rounding": int(explained.sum()),
        "ray": [x[worst].tolist() for x in rays],
    }


def check(name: str, shape: flat.FlatMesh, points: np.ndarray, count: int, dtype: str) -> Any:
    """Chords and pictures of one mesh in one precision."""
    import jaxvr

    given = np.asarray(points, dtype).astype(np.float64)
    hulls = {kind: Hull(given, kind) for kind in (np.float64, np.longdouble)}
    hull = hulls[np.float64]
    size = float(hull.size)
    origins, directions = rays = rays_of(shape, points, hull, count, dtype)
    # one rounding of a coordinate, along each axis
    rounding = float(np.finfo(dtype).eps) * (np.abs(origins).astype(np.float64) + hull.span)
    signs = np.array([[k & 1, k & 2, k & 4] for k in range(8)]) > 0

    def transfer(positions: Any, colors: Any, extinctions: Any) -> Any:
        arrays = (np.asarray(x, dtype) for x in (positions, colors, extinctions))
        return jaxvr.TransferFunction(*arrays)

    def exact(what: str) -> Callable[..., np.ndarray]:
        def of(kind: Any, part: Any = slice(None), nudge: int | None = None) -> np.ndarray:
            start = origins[part].astype(kind)
            if nudge is not None:
                start = start + np.where(signs[nudge], 1, -1) * rounding[part]
            out = np.concatenate(in_parts(getattr(hulls[kind], what), start, directions[part]))
            return out.reshape(len(out), -1)

        return of

    mesh = build(shape, points, hull.field, dtype)
    report = mesh.report
    row = {
        "mesh": name,
        "dtype": dtype,
        "rays": count,
        "cells": mesh.n_tets,
        "flat": getattr(report, "flat", 0),
        "dropped": report.degenerate + getattr(report, "crowded", 0),
        "folded": report.folded,
        "boundary": mesh.n_boundary,
    }
    step = min(BATCH, count)
    scale = np.concatenate(in_parts(hull.through_middle, directions))
    found, status = np.zeros(count), np.zeros(count, int)
    decade = np.floor(np.log10(scale / size)).astype(int)
    for k in np.unique(decade):  # alpha tells no length that is tiny beside the others
        extinction = DEPTH / (size * 10.0**k)
        medium, part = transfer([0.0], np.ones((1, 3)), [extinction]), decade == k
        rgba, status[part] = colors_of(mesh, origins[part], directions[part], medium, step)
        with np.errstate(divide="ignore"):
            found[part] = -np.log1p(-rgba[:, 3]) / extinction
    row["status"] = int(np.count_nonzero(status))
    ends = 2 * float(np.finfo(dtype).eps) * size / scale
    row["chord"] = summary(found[:, None], exact("chords"), scale, ends, rays)
    linear = transfer([0.0, 1.0], COLORS, np.array(DENSITY) / size)
    rgba, _ = colors_of(mesh, origins, directions, linear, step)
    one = np.ones(count)
    row["picture"] = summary(rgba, exact("picture"), one, 0 * one, rays)
    return row


def wave(points: np.ndarray) -> np.ndarray:
    """A field that is not linear: it is bent in each flat cell."""
    x, y, z = points.T
    return 0.5 + 0.5 * np.sin(3.0 * x + 1.0) * np.cos(2.0 * y - 1.5 * z)


def gradients(name: str, shape: flat.FlatMesh, points: np.ndarray, rays: int, moves: int) -> Any:
    """Derivatives of rays' colours by single points against differences from both sides."""
    import jax
    import jax.numpy as jnp

    import jaxvr

    rng = np.random.default_rng(5)
    span, size = np.ptp(points, axis=0), diagonal(points)
    unit = (points - points.min(0)) / span
    mesh = build(shape, points, wave(unit), "float64")
    weight = rng.dirichlet(np.ones(4), rays)
    target = (points[shape.cells[rng.integers(0, len(shape.cells), rays)]] * weight[..., None]).sum(
        1
    )
    direction = rng.normal(size=(rays, 3)) * span
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    origins = target - 2 * size * direction
    # opaque enough at any slant through a mesh that is squashed
    length = float(np.median(Hull(points).chords(origins, direction)))
    transfer = jaxvr.TransferFunction(
        np.array([0.0, 0.4, 1.0]), np.eye(3), np.array([0.5, 3.0, 1.0]) / length
    )
    channel = rng.normal(size=(rays, 4))

    @jax.jit
    def values(at: Any) -> Any:
        rgba = jaxvr.render_rays(mesh.replace(points=at), origins, direction, transfer)
        return (rgba * channel).sum(1)

    one = jax.jit(jax.grad(lambda at, pick: (values(at) * pick).sum()))
    slopes = np.stack([np.asarray(one(mesh.points, jnp.asarray(e))) for e in np.eye(rays)])
    inner = rng.permutation(np.flatnonzero(shape.inner))[:moves]
    step = 2e-8 if "1e-7" in name else 1e-6
    start, along, sides = np.asarray(values(mesh.points)), [], []
    for v in inner:
        u = rng.normal(size=3) * span

        def slope(h: float, v: int = v, u: np.ndarray = u) -> np.ndarray:
            moved = np.array(points)
            moved[v] += h * u
            return (np.asarray(values(moved)) - start) / h

        # D(h) = D(0) + a h + ..., so 2 D(h / 2) - D(h) is D(0) to second order
        sides.append([2 * slope(h / 2) - slope(h) for h in (step, -step)])
        along.append(u)
    g = np.stack([slopes[:, v] @ u for v, u in zip(inner, along, strict=True)])
    d = np.array(sides)  # (moves, 2, rays) and g (moves, rays)
    scale = np.abs(d).max((0, 1))
    scale = np.where(scale > 0, scale, 1)
    off = np.abs(g[:, None] - d) / scale
    touched = (np.abs(d) > 1e-6 * scale).any(1) | (np.abs(g) > 1e-6 * scale)
    apart = touched & (np.abs(d[:, 0] - d[:, 1]) > 2e-6 * scale)
    near = off.min(1) <= 1e-6
    both = touched & ~apart
    neither = np.argwhere(apart & ~near)
    nearby = np.zeros(len(neither), bool)
    for _ in range(TRIES):
        there = points + 1e-9 * rng.normal(size=points.shape) * span * shape.inner[:, None]
        for ray in np.unique(neither[~nearby, 1]):
            slope_there = np.asarray(one(jnp.asarray(there), jnp.asarray(np.eye(rays)[ray])))
            for i in np.flatnonzero((neither[:, 1] == ray) & ~nearby):
                k = neither[i, 0]
                gap = abs(slope_there[inner[k]] @ along[k] - g[k, ray])
                nearby[i] = gap <= 1e-6 * scale[ray]
    return {
        "mesh": name,
        "pairs": int(touched.sum()),
        "sides agree": int(both.sum()),
        "equal": int((both & near).sum()),
        "worst": float(off.min(1)[both].max(initial=0)),
        "sides differ": int(apart.sum()),
        "one of them": int((apart & near).sum()),
        "neither": len(neither),
        "of a mesh nearby": int(nearby.sum()),
    }


def run(count: int, names: Any = None, dtypes: Any = DTYPES, tiny: bool = False) -> dict[str, Any]:
    """All of the package that is imported."""
    rows, slopes = [], []
    for name, (shape, points) in shapes(tiny).items():
        if names and name not in names:
            continue
        for dtype in dtypes:
            start = time.perf_counter()
            rows.append(check(name, shape, points, count, dtype))
            chord, picture = rows[-1]["chord"], rows[-1]["picture"]
            print(
                f"{name:22} {dtype} chord {chord['off 1e-4']:7} {chord['off 1e-3']:7} "
                f"{chord['worst']:8.1e} ({chord['rounding']})  picture {picture['off 1e-4']:7} "
                f"{picture['off 1e-3']:7} {picture['worst']:8.1e} ({picture['rounding']}) "
                f"in {time.perf_counter() - start:.0f} s",
                flush=True,
            )
        slopes.append(gradients(name, shape, points, *((4, 4) if tiny else (48, 24))))
        print(slopes[-1], flush=True)
    return {"rows": rows, "gradients": slopes}


def seconds(size: int, repeat: int) -> dict[str, Any]:
    """Medians of the time of a picture of size x size, float32, of the meshes that are there."""
    import jaxvr
    from experiments.common import camera_of, seconds_of, transfer_of

    tasks: dict[str, Callable[[], Any]] = {}
    for name, field in FIELDS.items():
        try:
            path = path_of(f"{name}.vtu")
        except FileNotFoundError as error:
            print(error)
            continue
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            mesh = jaxvr.read_mesh(path, field, "float32")
        view = mesh, camera_of(mesh, size), transfer_of(mesh)
        tasks[name] = lambda view=view: jaxvr.render(*view)
    out = {}
    for name, each in seconds_of(tasks, repeat).items():
        out[name] = {"median": float(np.median(each)), "least": min(each), "repeat": repeat}
        print(f"{name:12} {size} x {size}: median {np.median(each):.4f} s, least {min(each):.4f} s")
    return out


def elsewhere(folder: Path, arguments: list[str]) -> dict[str, Any]:
    """The report of the package in another folder, by this script in another process."""
    if not (folder / "jaxvr").is_dir():
        raise SystemExit(f"There is no package jaxvr in {folder}.")
    with tempfile.TemporaryDirectory() as scratch:
        file = Path(scratch, "report.json")
        command = [sys.executable, __file__, *arguments, "--json", str(file)]
        # Of that folder the package only: what else is imported is of this checkout.
        Path(scratch, "jaxvr").symlink_to(folder.resolve() / "jaxvr", target_is_directory=True)
        path = os.pathsep.join([scratch, os.environ.get("PYTHONPATH", "")])
        subprocess.run(command, check=True, env=os.environ | {"PYTHONPATH": path})
        return json.loads(file.read_text())["after"]


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rays", type=int, default=1_000_000)
    parser.add_argument("--meshes", nargs="+", help="names, of all if none")
    parser.add_argument("--dtypes", nargs="+", default=list(DTYPES), choices=DTYPES)
    parser.add_argument("--before", type=Path, help="another checkout, to be measured first")
    parser.add_argument("--time", action="store_true", help="seconds of real meshes instead")
    parser.add_argument("--size", type=int, default=512, help="of pictures that are timed")
    parser.add_argument("--repeat", type=int, default=9, help="how many times")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--tiny", action="store_true")
    given = list(sys.argv[1:] if arguments is None else arguments)
    args = parser.parse_args(given)
    report: dict[str, Any] = {}
    if args.before:
        own = {"--before": args.before, "--json": args.json}
        for flag in (flag for flag, value in own.items() if value):
            i = given.index(flag)
            del given[i : i + 2]
        report["before"] = elsewhere(args.before, given)
    import jax

    jax.config.update("jax_enable_x64", True)
    if args.time:
        report["after"] = seconds(args.size, args.repeat)
    else:
        count = 512 if args.tiny else args.rays
        report["after"] = run(count, args.meshes, args.dtypes, args.tiny)
    if args.json:
        args.json.write_text(json.dumps(report, indent=1) + "\n")
    return report


if __name__ == "__main__":
    main()
