"""Meshes with cells that have no volume, or hardly any, and the convex hulls that they fill.

All are Delaunay meshes by Qhull, whose points are cospherical, coplanar or squashed: it returns
flat cells there, and cells that rounding turned over. Without them the others do not conform.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import ConvexHull, Delaunay


class FlatMesh(NamedTuple):
    """points (P, 3) float64, cells (T, 4), inner (P,) bool: points that do not touch the hull."""

    points: np.ndarray
    cells: np.ndarray
    inner: np.ndarray


def _mesh(points: np.ndarray, inner: np.ndarray) -> FlatMesh:
    return FlatMesh(points, Delaunay(points).simplices.astype(np.int64), inner)


def lattice(n: int = 5, jitter: float = 0.0, seed: int = 0) -> FlatMesh:
    """n points a side in the unit cube, those inside moved by normal deviates times `jitter`."""
    axis = np.arange(n) / (n - 1)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    inner = np.all((points > 0) & (points < 1), axis=1)
    moves = np.random.default_rng(seed).normal(size=points.shape)
    return _mesh(points + jitter * moves * inner[:, None], inner)


def cospherical(rings: int = 4, around: int = 8, shells: int = 2) -> FlatMesh:
    """Points on concentric spheres, by latitude and longitude, and their centre."""
    latitude = np.pi * (np.arange(rings) + 1) / (rings + 1)
    longitude = 2 * np.pi * np.arange(around) / around
    t, f = (x.ravel() for x in np.meshgrid(latitude, longitude, indexing="ij"))
    sphere = np.stack([np.sin(t) * np.cos(f), np.sin(t) * np.sin(f), np.cos(t)], 1)
    sphere = np.concatenate([sphere, [[0, 0, 1.0], [0, 0, -1.0]]])
    radii = (np.arange(shells) + 1) / shells
    points = np.concatenate([*(r * sphere for r in radii), np.zeros((1, 3))])
    return _mesh(points, (points**2).sum(1) < 0.999)


def slivers(n: int = 5, height: float = 1e-9, seed: int = 0) -> FlatMesh:
    """A lattice of which every second layer is turned by 45 degrees about the axis, and all are
    moved up and down by `height` at random: cells of four nearly cocircular points."""
    axis = np.linspace(-1, 1, n)
    x, y, k = (a.ravel() for a in np.meshgrid(axis, axis, np.arange(n), indexing="ij"))
    turn = np.pi / 4 * (k % 2)
    points = np.stack([x * np.cos(turn) - y * np.sin(turn), x * np.sin(turn) + y * np.cos(turn), k])
    points = points.T / (n - 1)
    inner = (np.hypot(x, y) < 0.9) & (k > 0) & (k < n - 1)
    moves = np.random.default_rng(seed).uniform(-height, height, len(points))
    points[:, 2] += moves * inner
    return _mesh(points, inner)


def prisms(sides: int = 7, layers: int = 4, rings: int = 2) -> FlatMesh:
    """Regular polygons, one above the other, with rings inside: blocks of cospherical points."""
    angle = 2 * np.pi * np.arange(sides) / sides
    disc = [np.zeros((1, 2))]
    for r in range(1, rings + 1):
        disc.append(r / rings * np.stack([np.cos(angle), np.sin(angle)], 1))
    flat = np.concatenate(disc)
    height = np.repeat(np.arange(layers + 1) / layers, len(flat))
    points = np.column_stack([np.tile(flat, (layers + 1, 1)), height])
    outside = np.hypot(points[:, 0], points[:, 1]) > 0.999
    return _mesh(points, ~outside & (height > 0) & (height < 1))


def squashed(n: int = 150, factor: float = 1e-6, seed: int = 0) -> FlatMesh:
    """The Delaunay mesh of random points in a cube, flattened along z afterwards."""
    rng = np.random.default_rng(seed)
    corners = np.stack(np.meshgrid(*[[0.0, 1.0]] * 3, indexing="ij"), -1).reshape(-1, 3)
    points = np.concatenate([corners, rng.uniform(0.02, 0.98, (n, 3))])
    cells = Delaunay(points).simplices.astype(np.int64)
    inner = np.arange(len(points)) >= 8
    return FlatMesh(points * [1, 1, factor], cells, inner)


def moved(mesh: FlatMesh, by: float = 0.02, seed: int = 1) -> np.ndarray:
    """Its points (P, 3) with the inner ones moved by normal deviates times `by`."""
    moves = np.random.default_rng(seed).normal(size=mesh.points.shape)
    return mesh.points + by * moves * mesh.inner[:, None]


def one_sided(f: Callable[[float], Any], h: float) -> float:
    """Derivative of f at 0 from the side of h, extrapolated to step 0 from three steps."""

    start = float(f(0.0))

    def slope(h: float) -> float:
        return (float(f(h)) - start) / h

    return (8 * slope(h / 4) - 6 * slope(h / 2) + slope(h)) / 3


MESHES: dict[str, Callable[[], FlatMesh]] = {
    "lattice": lattice,
    "lattice, jitter 1e-12": lambda: lattice(jitter=1e-12),
    "lattice, jitter 1e-7": lambda: lattice(jitter=1e-7),
    "cospherical": cospherical,
    "slivers": slivers,
    "prisms": prisms,
    "squashed": squashed,
}


def hull_planes(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Outward normals (n, 3) and offsets (n,) of the hull: it is where normal . x <= offset."""
    equations = np.unique(ConvexHull(points).equations.round(13), axis=0)
    return equations[:, :3], -equations[:, 3]


def hull_chords(planes: tuple[np.ndarray, np.ndarray], origins, directions) -> np.ndarray:
    """Lengths (R,) of rays (R, 3) inside the hull, from their origins on, in world units."""
    normals, offsets = planes
    origins, directions = np.asarray(origins, np.float64), np.asarray(directions, np.float64)
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    rise, room = directions @ normals.T, offsets - origins @ normals.T
    with np.errstate(divide="ignore", invalid="ignore"):
        at = room / rise
    enter = np.where(rise < 0, at, 0.0).max(1, initial=0.0)
    leave = np.where(rise > 0, at, np.inf).min(1)
    outside = ((rise == 0) & (room < 0)).any(1)
    return np.where(outside, 0.0, np.maximum(leave - enter, 0.0))


def rays_at_features(mesh: FlatMesh, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Rays (R, 3) through vertices, midpoints of edges, centres of faces and of cells, by turns:
    a half along directions of the lattice, the others from anywhere. None of them lies in a plane
    of the hull, where it is a matter of taste what it sees: those are moved a little inwards."""
    rng = np.random.default_rng(seed)
    corners = mesh.points[mesh.cells[rng.integers(0, len(mesh.cells), count)]]
    used = 1 + np.arange(count) % 4
    weight = (np.arange(4) < used[:, None]) / used[:, None]
    target = (corners * weight[..., None]).sum(1)
    along = rng.integers(-1, 2, (count, 3)).astype(float)
    along[(along == 0).all(1)] = [1, 0, 0]
    free = rng.normal(size=(count, 3))
    direction = np.where((np.arange(count) // 4 % 2 == 0)[:, None], along, free)
    return _from_outside(mesh, target, direction)


def rays_along_features(mesh: FlatMesh, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Rays (R, 3) along edges of cells, in planes of their faces, from one vertex to another, and
    through vertices in planes of the axes, by turns; hull planes as in `rays_at_features`."""
    rng = np.random.default_rng(seed)
    a, b, c, _ = mesh.points[mesh.cells[rng.integers(0, len(mesh.cells), count)]].swapaxes(0, 1)
    other = mesh.points[mesh.cells[rng.integers(0, len(mesh.cells), count), 0]]
    u, v = rng.uniform(0.1, 0.9, (2, count, 1))
    span = np.ptp(mesh.points, axis=0)
    plane = rng.normal(size=(count, 3)) * span * (rng.integers(0, 3, (count, 1)) != np.arange(3))
    kind = np.arange(count) % 4
    target = np.select(
        [kind[:, None] == k for k in range(3)],
        [a + u * (b - a), (1 - u) * a + u * ((1 - v) * b + v * c), a],
        a,
    )
    direction = np.select(
        [kind[:, None] == k for k in range(3)],
        [b - a, (b - a) * rng.normal(size=(count, 1)) + (c - a), other - a],
        plane,
    )
    direction[(direction == 0).all(1)] = [1, 0, 0]
    return _from_outside(mesh, target, direction)


def _from_outside(
    mesh: FlatMesh, target: np.ndarray, direction: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    low, high = mesh.points.min(0), mesh.points.max(0)
    middle, size = (low + high) / 2, float(np.linalg.norm(high - low))
    direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    normals, offsets = hull_planes(mesh.points)
    grazes = np.zeros(len(target), bool)
    for i in range(0, len(target), 1 << 16):
        part = slice(i, i + (1 << 16))
        room = np.abs(offsets - target[part] @ normals.T) / size
        grazes[part] = ((np.abs(direction[part] @ normals.T) < 1e-3) & (room < 1e-3)).any(1)
    target = np.where(grazes[:, None], target + 0.01 * (middle - target), target)
    return target - 2 * size * direction, direction
