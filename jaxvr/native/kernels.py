"""Calls of the compiled loops: what a pipeline's arrays look like to them, and what comes back.

Rays are flat here, (N,); the loops make blocks of their own, which XLA's threads take in turns.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxvr.native.build import target_name
from jaxvr.native.nouns import COMPOSITORS, TRACERS
from jaxvr.numerics.rules import Rule, rule_for, thin_rule
from jaxvr.optics.analytic import RULES
from jaxvr.optics.partition import Nodes
from jaxvr.trace.raycast import CastScene
from jaxvr.trace.recorded import Nodes as Recording
from jaxvr.trace.recorded import Runs
from jaxvr.trace.shear import ShearedRays

Array = jax.Array
Shape = jax.ShapeDtypeStruct
LOCATIONS = {"point": 0, "cell": 1, "corner": 2}
PAIR = 10  # numbers of a row of `AbstractSlabIntegrator.gradient_start`


def composite(pipeline: Any, operands: Any) -> tuple[Any, Array]:
    """The compositor's state and status (N,) of rays (N,), cast through a `CastScene` or played
    back. pipeline, operands: as `adjoint.base` has them, of what `nouns` lists."""
    scene, rays, _ = operands
    world, count = _world(scene, rays)
    dtype = _dtype_of(scene)
    packing = COMPOSITORS[type(pipeline.compositor)]
    integers = Shape((2, count if packing.has_place else 0), jnp.int32)
    operands = (*world, *_optics(pipeline, operands, dtype))
    sums, status = Shape((8, count), dtype), Shape((count,), jnp.int32)
    name = TRACERS[type(pipeline.tracer)].forward
    if isinstance(scene, Recording):
        sums, integers = _call(name, dtype, [sums, integers])(*operands)
        status = jnp.zeros(count, jnp.int32)
    else:
        sums, status, integers = _call(name, dtype, [sums, status, integers])(*operands)
    return packing.state(sums, integers), status


def pull_back(
    pipeline: Any, operands: Any, *, final: Any, cotangent: Any, asked: tuple[Any, Any, bool]
) -> tuple[Any, Any, Any]:
    """Gradients of the scene, the rays and the table, as `gradient_start` of tracer and integrator
    has them.

    Args:
      final, cotangent: from `composite`, and that of it.
      asked: structures of (scene, rays) with True at leaves that are asked for, and whether the
        table is.
    """
    scene, rays, table = operands
    world, count = _world(scene, rays)
    dtype = _dtype_of(scene)
    operands = (*world, *_optics(pipeline, operands, dtype))
    packing = COMPOSITORS[type(pipeline.compositor)]
    operands = (*operands, *packing.finals(pipeline.compositor, final, cotangent))
    name = TRACERS[type(pipeline.tracer)].backward
    ask_scene, ask_rays, ask_table = asked
    rows = Shape((2 * table.position.shape[0] if ask_table else 0, PAIR), dtype)

    def sized(like: Array, wanted: bool) -> Shape:
        return Shape(like.shape if wanted else (0,), dtype)

    if isinstance(scene, Recording):
        shapes = [rows, *(sized(x, a) for x, a in zip(scene, ask_scene, strict=True))]
        table_bar, *found = _call(name, dtype, shapes)(*operands)
        scene_bar = Recording(*(x if a else None for x, a in zip(found, ask_scene, strict=True)))
        return scene_bar, None, table_bar if ask_table else None
    mesh, at_points = scene.mesh, scene.mesh.location == "point"
    by_values, by_points = ask_scene.mesh.values, ask_scene.mesh.coordinates
    by_rays = any(jax.tree.leaves(ask_rays))
    points = mesh.coordinates.shape[0] // 3
    shapes = [
        rows,
        Shape((points if by_values or by_points else 0, 4), dtype),
        sized(mesh.values, (by_values or by_points) and not at_points),
        Shape((8, count if by_rays else 0), dtype),
    ]
    table_bar, vertices, values, by_ray = _call(name, dtype, shapes)(*operands)
    values = vertices[:, 3] if at_points else values
    scene_bar = (
        values if by_values else None,
        vertices[:, :3].T.reshape(-1) if by_points else None,
    )
    rays_bar = tuple(x.reshape(rays.origin_x.shape) for x in by_ray) if by_rays else None
    if rays_bar is not None:
        ends = zip((rays.near, rays.far), rays_bar[6:], strict=True)
        rays_bar = (*rays_bar[:6], *(None if x is None else bar for x, bar in ends))
    return scene_bar, rays_bar, table_bar if ask_table else None


def count_nodes(scene: CastScene, rays: ShearedRays) -> tuple[Array, Array]:
    """Number of nodes and status (N,) of each ray: `trace.recorded.record`."""
    world, count = _world(scene, rays)
    shapes = [Shape((count,), jnp.int32)] * 2
    found, status = _call("count", scene.mesh.coordinates.dtype, shapes)(*world)
    return found, status


def fill_nodes(scene: CastScene, rays: ShearedRays, start: Array, total: int) -> Recording:
    """The nodes (total,) of the first R rays, from `start` (R,) on: `trace.recorded.fill`. Others
    are copies that fill a batch: they would write where the last ray does, at the same time."""
    dtype = scene.mesh.coordinates.dtype
    shapes = [Shape((total,), dtype)] * 2
    return Recording(*_call("fill", dtype, shapes)(*_world(scene, rays)[0], start))


def _call(name: str, dtype: Any, shapes: Any):
    target = target_name(name, np.dtype(dtype).name)
    return jax.ffi.ffi_call(target, shapes, vmap_method="sequential")


def _world(scene: Any, rays: Any) -> tuple[tuple[Any, ...], int]:
    """The arguments that say what is traced, and the number of rays."""
    if isinstance(rays, Runs):
        return (*scene, rays.first.reshape(-1), rays.end.reshape(-1)), rays.first.size
    mesh = scene.mesh
    axes = (rays.axis_x, rays.axis_y, rays.axis_z)
    numbers = (
        *(rays.origin_x, rays.origin_y, rays.origin_z, rays.shear_x, rays.shear_y),
        *(rays.shear_x_low, rays.shear_y_low, rays.sign, rays.stretch),
    )
    arrays = (
        *(mesh.vertices, mesh.values, mesh.cells, mesh.neighbors),
        *(scene.boxes.low, scene.boxes.high, mesh.faces),
        *(jnp.stack([x.reshape(-1) for x in rows]) for rows in (axes, numbers)),
        _bounds(rays),
        np.array([LOCATIONS[mesh.location], mesh.seams], np.int32),
    )
    return arrays, rays.origin_x.size


def _bounds(rays: ShearedRays) -> Array:
    """near, far and stop (3, N), or (3, 0) for rays that have none of them."""
    like = rays.origin_x.reshape(-1)
    if rays.near is None and rays.far is None:
        return jnp.zeros((3, 0), like.dtype)
    given = ((rays.near, 0), (rays.far, jnp.inf), (rays.stop, jnp.inf))
    return jnp.stack([jnp.full_like(like, d) if x is None else x.reshape(-1) for x, d in given])


def _dtype_of(scene: Any) -> Any:
    return (scene.scalar if isinstance(scene, Recording) else scene.mesh.coordinates).dtype


def _optics(pipeline: Any, operands: Any, dtype: Any) -> tuple[Any, ...]:
    table, compositor = operands.table, pipeline.compositor
    packing = COMPOSITORS[type(compositor)]
    kind, enough = packing.kind(compositor), packing.enough(compositor)
    if not compositor.shades:
        rules = np.zeros((5, 0), dtype)
        numbers = _numbers([0, 0, 0, enough, kind], dtype)
        return jnp.zeros(1, dtype), jnp.zeros((2, 16), dtype), rules, rules, numbers
    if not packing.is_light:  # a place for lengths
        optical = table.optical.at[1:].set(0)
        table = dataclasses.replace(table, optical=optical)
    small = RULES[pipeline.integrator.accuracy]
    rule = small or rule_for(dtype)
    thin = thin_rule(dtype)
    rows = (_rows(r).astype(dtype) for r in (rule, thin))
    numbers = _numbers([rule.depth, small is not None, thin.depth, enough, kind], dtype)
    return table.position, slabs_of(table), *rows, numbers


def _numbers(numbers: list[Any], dtype: Any) -> Any:
    """(n,), some of which may be traced."""
    if any(isinstance(x, jax.Array) for x in numbers):
        return jnp.stack([jnp.asarray(x, dtype) for x in numbers])
    return np.array(numbers, dtype)


def _rows(rule: Rule) -> np.ndarray:
    """by_front, by_back, and weights times the Bernstein basis of degree 2 (5, n)."""
    u, weights = np.array(rule.nodes), np.array(rule.weights)
    basis = [(1 - u) ** 2, 2 * u * (1 - u), u * u]
    return np.stack([u * (1 - u / 2), u * u / 2, *(weights * b for b in basis)])


def slabs_of(table: Nodes) -> Array:
    """A record for each of K + 1 slabs (K + 1, 16): see src/slab.h."""
    position = lax.stop_gradient(table.position)
    count, dtype = position.shape[0], position.dtype
    infinite = jnp.full(1, jnp.inf, dtype)
    slab = np.arange(count + 1)
    left, right = np.maximum(slab - 1, 0), np.minimum(slab, count - 1)
    low, high = position[left], position[right]
    outermost = (slab == 0) | (slab == count)
    # Border k is position k; the two of a jump are hard on all sides.
    equal = position[1:] == position[:-1]
    hard = jnp.zeros(count, dtype).at[:-1].max(equal).at[1:].max(equal)
    no = jnp.zeros(1, dtype)
    width = high - low
    inside = (width > 0) & ~outermost
    slope = jnp.where(inside, 1 / jnp.where(inside, width, 1), 0)
    first, second = table.optical[:, left], table.optical[:, right]
    floor, ceiling = jnp.concatenate([-infinite, position]), jnp.concatenate([position, infinite])
    dark = (first[0] == 0) & (second[0] == 0)
    dark_range = (jnp.where(dark, floor, jnp.inf), jnp.where(dark, ceiling, -jnp.inf))
    columns = [
        *(floor, ceiling, low, slope, *first, *(second - first)),
        *(jnp.concatenate([no, hard]), jnp.concatenate([hard, no]), *dark_range),
    ]
    return jnp.stack(columns, 1)
