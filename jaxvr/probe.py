"""`probe`: the data behind a pixel. What lies along a ray, segment by segment, as arrays.

A picture shows one colour a pixel. `probe` walks the same rays as `render`, with JAX's loops, and
keeps what passes by: which cell, from which distance to which, the scalars there, and what the
segment adds to the colour at the eye. The contributions of a ray add up to its pixel.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxvr._core.checks import is_concrete
from jaxvr._core.compiling import compiled
from jaxvr._core.offsets import absolute, bare
from jaxvr._core.status import check
from jaxvr.adjoint.base import Operands, Pipeline, advance, begin, busy, shade_piece
from jaxvr.arguments import (
    at_the_door,
    camera_of,
    integrator_of,
    is_rays,
    rays_of,
    tracer_of,
    transfer_of,
    volume_of,
)
from jaxvr.composite import Over
from jaxvr.optics import AbstractIntegrator, TransferFunction
from jaxvr.trace import AbstractTracer
from jaxvr.trace.recorded import record
from jaxvr.units import Units, transfer_in, units_in, volume_in
from jaxvr.view.camera import HasRays
from jaxvr.view.rays import Rays
from jaxvr.view.tiles import batch_size
from jaxvr.volume import AbstractVolume

Array = jax.Array


@dataclasses.dataclass(frozen=True, eq=False)
class Probe:
    """What lies along R rays: S segments in all, each ray's from the eye on. NumPy arrays.

    start (R + 1,): the segments of ray r are number start[r] to start[r + 1] - 1.
    cells (S,) int32: rows of `mesh.cells`, the tetrahedra that the segments lie in; of another
        volume what its tracer numbers.
    distances (S, 2): from the ray's origin to the front and the back, in world units; they descend
        where a folded cell leads the ray back.
    scalars (S, 2): the field at front and back; float64 where the mesh has an offset.
    contributions (S, 4): premultiplied RGBA that each adds at the eye, dimmed by what is in front.
    positions (S, 2, 3): the front and the back, in the world; float64 where the mesh has an origin.
    """

    start: np.ndarray
    cells: np.ndarray
    distances: np.ndarray
    scalars: np.ndarray
    contributions: np.ndarray
    positions: np.ndarray

    def __len__(self) -> int:
        """Number of rays."""
        return len(self.start) - 1

    def __getitem__(self, ray: int) -> Probe:
        """What lies along one ray."""
        if not -len(self) <= ray < len(self):
            raise IndexError(f"There are {len(self)} rays, so none has the number {ray}.")
        first, end = self.start[ray % len(self)], self.start[ray % len(self) + 1]
        names = [f.name for f in dataclasses.fields(self) if f.name != "start"]
        return Probe(np.array([0, end - first]), *(getattr(self, n)[first:end] for n in names))

    @property
    def lengths(self) -> np.ndarray:
        """World lengths (S,) of the segments."""
        return np.abs(self.distances[:, 1] - self.distances[:, 0])

    @property
    def rgba(self) -> np.ndarray:
        """The colours (R, 4) of the rays, over nothing: sums of their contributions."""
        sums = np.concatenate([np.zeros((1, 4)), np.cumsum(self.contributions, 0, np.float64)])
        return (sums[self.start[1:]] - sums[self.start[:-1]]).astype(self.contributions.dtype)

    def __repr__(self) -> str:
        return f"Probe({len(self)} rays, {len(self.cells)} segments)"


def probe(
    volume: AbstractVolume,
    camera: HasRays | tuple[Any, Any],
    transfer: TransferFunction,
    pixels: Any = None,
    *,
    tracer: AbstractTracer | None = None,
    integrator: AbstractIntegrator | None = None,
) -> Probe:
    """What lies under pixels, or along rays.

    Args:
      volume: as for `render`.
      camera: a camera, or rays (origins, directions) with shapes (..., 3).
      transfer: what the contributions are those of.
      pixels: of a camera, row and column (2,) of one pixel or (R, 2) of several, row 0 on top; None
        for all of them, row by row. Some 60 bytes a segment.
      tracer, integrator: as for `render`.

    Returns:
      a `Probe`; its rays are the pixels in the order given, or the rays in C order.

    Raises:
      ValueError: for pixels that are not in the picture, for a tracer that does not know where its
        segments lie, and for what `render` refuses.
      RenderError: if a ray could not be followed.

    Not for use inside `jit` or `grad`.
    """
    if not is_concrete(*jax.tree.leaves((volume, camera, transfer))):
        raise ValueError("probe cannot run inside jit or grad. Call it outside.")
    volume, transfer = volume_of(volume), transfer_of(transfer, volume)
    if is_rays(camera):
        if pixels is not None:
            raise ValueError(
                "pixels belong to a camera, but rays were given. Pass only those wanted."
            )
        given = rays_of(*camera, volume)
        origins, directions = np.asarray(given.origins), np.asarray(given.directions)
    else:
        origins, directions = (np.asarray(x) for x in camera_of(camera, volume).local_rays())
        if pixels is not None:
            row, column = _pixels_of(pixels, origins.shape[:2])
            origins, directions = origins[row, column], directions[row, column]
    origins, directions = origins.reshape(-1, 3), directions.reshape(-1, 3)
    # By a power of two first, so that squares neither under- nor overflow.
    largest = np.abs(directions).max(axis=1, keepdims=True, initial=0)
    directions = np.ldexp(directions, -np.frexp(largest)[1])
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    pipeline = Pipeline(tracer_of(tracer, volume), integrator_of(integrator, Over()), Over())
    pipeline = at_the_door(pipeline, volume.dtype)
    size = min(batch_size(volume.dtype), 1 << max(len(origins) - 1, 0).bit_length())
    parts, counts, status = [], [], []
    scene, table, units = _prepare(pipeline, bare(volume), bare(transfer))
    start_at = origins * np.asarray(units.length)
    for first in range(0, len(origins), size):
        here = np.minimum(np.arange(first, first + size), len(origins) - 1)
        rays = start_at[here], directions[here]
        nodes, bits = _count(pipeline.tracer, scene, *rays)
        # A power of two, so that few functions are compiled.
        most = 1 << int(np.max(np.asarray(nodes))).bit_length()
        count, *found = (np.asarray(x) for x in _walk(pipeline, most, scene, table, *rays))
        used = min(size, len(origins) - first)
        kept = (np.arange(most)[None] < count[:used, None]).ravel()
        parts.append([x[:used].reshape(used * most, *x.shape[2:])[kept] for x in found])
        counts.append(count[:used])
        status.append(np.asarray(bits)[:used])
    check(np.concatenate(status) | np.asarray(units.status))
    start = np.concatenate([[0], np.cumsum(np.concatenate(counts), dtype=np.int64)])
    cells, distances, scalars, contributions = (np.concatenate(x) for x in zip(*parts))
    distances = np.maximum(distances, 0) / np.asarray(units.length)
    scalars = scalars / np.asarray(units.scalar)
    ray = np.repeat(np.arange(len(origins)), np.diff(start))
    positions = origins[ray][:, None] + distances[..., None] * directions[ray][:, None]
    if any(volume.origin):
        positions = absolute(positions, volume.origin)
    if volume.offset:
        scalars = absolute(scalars, volume.offset)
    return Probe(start, cells, distances, scalars, contributions, positions)


def _pixels_of(pixels: Any, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    given = np.asarray(pixels)
    if given.dtype.kind not in "iu" or given.shape[-1:] != (2,) or given.ndim > 2:
        raise ValueError(
            "pixels must be whole numbers (row, column) with shape (2,) or (R, 2), but have dtype "
            f"{given.dtype} and shape {given.shape}."
        )
    row, column = given.reshape(-1, 2).T
    bad = (row < 0) | (row >= shape[0]) | (column < 0) | (column >= shape[1])
    if len(row) == 0 or bad.any():
        first = given.reshape(-1, 2)[bad][0].tolist() if bad.any() else "none"
        raise ValueError(
            f"The picture has {shape[0]} rows and {shape[1]} columns; {int(bad.sum())} of "
            f"{len(row)} pixels are not in it, the first is {first}."
        )
    return row, column


@compiled()
def _prepare(pipeline: Pipeline, volume: Any, transfer: Any) -> tuple[Any, Any, Units]:
    units = units_in(volume, transfer.positions)
    volume, transfer = volume_in(units, volume), transfer_in(units, transfer)
    scene = pipeline.tracer.prepare(volume)
    longest = pipeline.tracer.longest(scene)
    return scene, pipeline.integrator.prepare(transfer, volume.dtype, longest), units


@compiled()
def _count(tracer: AbstractTracer, scene: Any, origins: Array, directions: Array) -> Any:
    """Nodes, as many as segments or more, and status of R rays."""
    rays = tracer.prepare_rays(scene, Rays(origins, directions))
    found = record(tracer, scene, jax.tree.map(lambda x: x[None], rays))
    return tuple(x[0] for x in found)


@compiled(1)
def _walk(pipeline: Pipeline, most: int, scene: Any, table: Any, origins: Any, directions: Any):
    """Number of segments (R,), then of each, (R, most, ...): cell, distances, scalars and
    contribution."""
    tracer, compositor = pipeline.tracer, pipeline.compositor
    rays = tracer.prepare_rays(scene, Rays(origins, directions))
    operands = Operands(scene, rays, table)
    size, dtype = origins.shape[0], origins.dtype
    lane = jnp.arange(size)

    def body(carry):
        march, place, seen, out = carry
        segment = march.trace.segment
        cell, *distances = tracer.locate(scene, rays, march.trace)
        pixel, cursor, finished, *_ = shade_piece(pipeline, operands, march)
        live = march.trace.active & finished & (segment.length > 0)
        rgba = compositor.finish(pixel, None, None).T
        ends = ((segment.front, segment.back), distances)
        scalars, distances = (jnp.stack(pair, axis=1) for pair in ends)
        new = (cell, distances, scalars, rgba - seen)
        to = jnp.where(live, place, most)
        out = tuple(x.at[lane, to].set(y, mode="drop") for x, y in zip(out, new, strict=True))
        march = advance(pipeline, operands, march._replace(pixel=pixel, cursor=cursor), finished)
        return march, place + live, jnp.where(live[:, None], rgba, seen), out

    pairs = jnp.zeros((size, most, 2), dtype)
    cells = jnp.zeros((size, most), jnp.int32)
    out = (cells, pairs, pairs, jnp.zeros((size, most, 4), dtype))
    march = begin(pipeline, operands)
    carry = (march, jnp.zeros(size, jnp.int32), jnp.zeros((size, 4), dtype), out)
    _, place, _, out = lax.while_loop(lambda c: busy(c[0]), body, carry)
    return place, *out
