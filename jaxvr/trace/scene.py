"""What a walk gathers from: a tetrahedral mesh laid out for single loads.

Coordinates lie one axis after the other, so that a ray's permuted axes cost an addition; ids and
neighbours lie flat. Points that coincide (see `TetMesh.duplicates`) are one point, at their
common mean: under a gradient step they move together, and the walk cannot fall between them.

Everything is scaled by a power of two that brings coordinates near 1. That is exact, and keeps
products of projected coordinates clear of underflow whatever the user's unit of length is.
"""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp

from jaxvr._core.gather import load, take
from jaxvr._core.pytree import pytree, static
from jaxvr._core.stage import stage
from jaxvr._core.units import near_one
from jaxvr.trace.shear import ShearedRays, shear_points
from jaxvr.volume.mesh import TetMesh

Array = jax.Array


@pytree
class Scene:
    """A mesh of P points, T cells and F boundary faces.

    coordinates (3 P,): all x, all y, all z, times `scale` ().
    vertices (4 P,): x, y, z of each point and its scalar, 0 if values do not live at points; the
    same numbers as in `coordinates` and `values`, so that a vertex is in one cache line.
    values (V,): as in the mesh, flat. cells (4 T,), neighbors (4 T,): flat, see `TetMesh`.
    faces (L,): `TetMesh.boundary` padded by -1 to a power of two.
    location: where the values live. seams: whether some points coincide.
    """

    coordinates: Array
    vertices: Array
    values: Array
    cells: Array
    neighbors: Array
    faces: Array
    scale: Array
    location: str = static(default="point")
    seams: bool = static(default=False)

    @property
    def continuous(self) -> bool:
        """Whether the scalar is the same on both sides of every face (seams apart)."""
        return self.location == "point"


def make_scene(mesh: TetMesh) -> Scene:
    points = merged_points(mesh)
    scale = scale_of(points)
    count = mesh.boundary.shape[0]
    leaves = 1 << max(count - 1, 1).bit_length()
    faces = jnp.concatenate([mesh.boundary, jnp.full(leaves - count, -1, jnp.int32)])
    points = points * scale
    at_points = mesh.location == "point"
    values = mesh.values if at_points else jnp.zeros_like(points[:, 0])
    return Scene(
        coordinates=points.T.reshape(-1),
        vertices=jnp.concatenate([points, values[:, None]], 1).reshape(-1),
        values=mesh.values.reshape(-1),
        cells=mesh.cells.reshape(-1),
        neighbors=mesh.neighbors.reshape(-1),
        faces=faces,
        scale=scale,
        location=mesh.location,
        seams=mesh.duplicates.shape[0] > 0,
    )


def scale_of(points: Array) -> Array:
    """The power of two () that brings the largest coordinate of points (P, 3) to [1/2, 1)."""
    return near_one(points)


def merged_points(mesh: TetMesh) -> Array:
    """points (P, 3) with coinciding ones moved to the mean of each group."""
    copies = mesh.duplicates
    if copies.shape[0] == 0:
        return mesh.points
    copy, first = copies[:, 0], copies[:, 1]
    # The mean is the first point plus the mean of differences: exact when all are equal.
    away = mesh.points[copy] - mesh.points[first]
    group = jnp.ones(mesh.points.shape[0], away.dtype).at[first].add(1.0)
    mean = mesh.points.at[first].add(away / group[first][:, None])
    return mean.at[copy].set(mean[first])


def longest_edge(scene: Scene) -> Array:
    """Length () of the longest edge, in world units: no chord of a cell is longer."""
    count = scene.coordinates.shape[0] // 3
    corners = [scene.cells[k::4] for k in range(4)]
    squares = []
    for first, second in itertools.combinations(corners, 2):
        change = [
            scene.coordinates[axis * count + first] - scene.coordinates[axis * count + second]
            for axis in range(3)
        ]
        squares.append(jnp.max(sum(x * x for x in change)))
    return jnp.sqrt(jnp.max(jnp.stack(squares))) / scene.scale


def local_ids(scene: Scene, cell: Array, corner: Array) -> Array:
    """Point id at a local corner (R,) of a cell (R,)."""
    return take(scene.cells, 4 * cell + corner)


def value_slots(scene: Scene, cell: Array, corner: Array, point: Array) -> Array:
    """Index into `values` of the scalar at a corner of a cell."""
    if scene.location == "point":
        return point
    return cell + 0 * corner if scene.location == "cell" else 4 * cell + corner


def points_at(scene: Scene, cell: Array, corners: Array, wanted: Array) -> Array:
    """Point ids at local corners (C, R) of cells (R,)."""

    def find(cells, cell, corners):
        return take(cells, 4 * cell[None] + corners)

    return load(wanted, find, scene.cells, cell, corners)


def values_at(scene: Scene, cell: Array, corners: Array, wanted: Array) -> Array:
    """Scalars that cells (R,) have at local corners (C, R)."""
    at_points = scene.location == "point"
    point = points_at(scene, cell, corners, wanted) if at_points else corners

    def find(values, cell, corners, point):
        return take(values, value_slots(scene, cell[None], corners, point))

    return load(wanted, find, scene.values, cell, corners, point)


def coordinates_of(vertices: Array, ids: Array) -> Array:
    """(3, ...) of points (...), as the scene has them; vertices (4 P,): see `Scene`."""
    return jnp.stack([take(vertices, 4 * ids + axis) for axis in range(3)])


def fetch(
    scene: Scene, rays: ShearedRays, cell: Array, corners: Array, wanted: Array
) -> tuple[Array, ...]:
    """The vertices (4, R) at local corners (C, R) of a cell (R,), as each ray sees them.

    wanted (): whether any ray needs them.
    """

    def find(vertices, rays, point):
        rows = jnp.stack([rays.axis_x, rays.axis_y, rays.axis_z, jnp.full_like(rays.axis_x, 3)])
        return take(vertices, rows[:, None] + 4 * point[None])

    point = points_at(scene, cell, corners, wanted)
    *at, values = load(wanted, find, scene.vertices, rays, point)
    if scene.location != "point":
        values = values_at(scene, cell, corners, wanted)
    return tuple(
        project(rays, (*(x[k] for x in at), values[k]), wanted) for k in range(corners.shape[0])
    )


def project(rays: ShearedRays, at: tuple[Array, ...], wanted: Array) -> Array:
    """A vertex (4, R) from its coordinates in each ray's permuted axes and its scalar."""
    x, y, z, value = at
    # Rows are put together outside: a kernel that chooses by row what to compute is not vectorised.
    flat = stage(wanted, lambda rays, *at: shear_points(rays, *at)[:2], rays, x, y, z)
    return jnp.stack([*flat, rays.sign * z, value])


def entry_corners(corner: Array) -> Array:
    """Local indices (3, R), ascending, of the vertices of the face opposite `corner` (R,)."""
    k = jnp.arange(3, dtype=jnp.int32)[:, None]
    return k + (corner[None] <= k).astype(jnp.int32)
