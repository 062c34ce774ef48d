"""Triangles and a camera to fragments: which pixel centre sees which triangle, and where.

The stream of `trace.stream` over a plain list of triangles. A fragment is a triangle and a pixel,
found by exact signs: of the triangles round a shared edge or vertex, each crossing of the surface
is drawn once, whatever the rounding (a rule for ties as that of the top left edge, but one for all
directions). Its depth and scalar are interpolated linearly in space, hence correct in perspective,
and can be had again, as differentiable functions of points, values and camera: `Fragments.locate`.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxvr._core.checks import (
    as_floats,
    common_float,
    is_concrete,
    require_finite,
    require_kind,
    require_shape,
)
from jaxvr._core.gather import take
from jaxvr._core.offsets import (
    NOWHERE,
    digits_of,
    is_single,
    origin_of,
    relative,
    require_said,
)
from jaxvr._core.pytree import pytree, static
from jaxvr._core.units import require_lengths
from jaxvr.order import AbstractOrder, Centroid
from jaxvr.trace.face import crossing, opposite_edges, sizes_of
from jaxvr.trace.scene import coordinates_of, scale_of
from jaxvr.trace.select import BLOCK, Sort
from jaxvr.trace.shear import shear_rays
from jaxvr.trace.stream import Hits, beam_rays, draw, face_at
from jaxvr.view.camera import Camera
from jaxvr.view.rays import Rays
from jaxvr.view.tiles import batch_size, batches, tile_order

Array = jax.Array


@pytree
class Triangles:
    """A `FaceSource`. vertices (4 P,): as in `Scene`. ids (3 F,): of the points of each triangle,
    ascending. boxes: low and high corners (3, blocks). scale (): what coordinates are times."""

    vertices: Array
    ids: Array
    boxes: tuple[Array, Array]
    scale: Array

    def look(self, blocks: Array) -> tuple[Array, tuple[Array, Array, Array], Array]:
        count = self.ids.shape[0] // 3
        slot = (blocks[:, None] * BLOCK + jnp.arange(BLOCK, dtype=jnp.int32)[None]).reshape(-1)
        there, slot = slot < count, jnp.minimum(slot, count - 1)
        ids = self.corners(slot)
        a, b, c = jnp.moveaxis(coordinates_of(self.vertices, ids), 1, 0)
        return slot, (a, b, c), there

    def corners(self, slot: Array) -> Array:
        return take(self.ids, 3 * slot[None] + jnp.arange(3, dtype=jnp.int32)[:, None])

    def keep(self, origin: Array, slot: Array) -> Array:
        return jnp.zeros(slot.shape, bool)


@pytree
class Fragments:
    """N fragments of an image, pixel after pixel, each pixel's in the order in which they were
    drawn (nearly sorted by depth).

    face (N,) int32: number of the triangle. pixel (N,) int32: row * width + column. depth (N,):
    distance from where the ray starts, in world units, along its unit direction. scalar (N,).
    triangles (F, 3) int32, width, height: as they were given.
    """

    face: Array
    pixel: Array
    depth: Array
    scalar: Array
    triangles: Array
    width: int = static(default=0)
    height: int = static(default=0)

    def locate(
        self, points: Any, values: Any, camera: Camera, *, origin: Any = None
    ) -> tuple[Array, Array]:
        """depth (N,) and scalar (N,) anew, with fragments held fixed: differentiable in points
        (P, 3), values (P,) and the camera, in both modes. Rays that lie in a triangle's plane have
        no derivative across it. origin: as for `rasterize`.

        Raises:
          ValueError: if the camera's image has another size.
        """
        size = (camera.height, camera.width)
        if size != (self.height, self.width):
            raise ValueError(
                f"The fragments are of an image of {self.height} x {self.width} pixels, but the "
                f"camera's has {size[0]} x {size[1]}."
            )
        points, camera = beside(points, camera, origin)
        return _locate(self, jnp.asarray(points), jnp.asarray(values), camera)


def rasterize(
    points: Any,
    triangles: Any,
    camera: Camera,
    values: Any = None,
    *,
    order: AbstractOrder | None = None,
    origin: Any = None,
) -> Fragments:
    """All fragments of triangles in an image.

    Args:
      points (P, 3): in world units. triangles (F, 3): point ids, of either winding. values (P,):
        scalars, 0 if None. camera: its pixel centres are sampled. order: in which triangles are
        drawn; `jaxvr.order.Centroid()` if None. origin (3,): what points are relative to, which is
        `mesh.origin` for those of a mesh; None for the world. To be said of JAX's arrays and of
        float32 where the camera has an origin.

    Returns:
      `Fragments`, in front of the camera only, in the widest float type of points and values.
      Memory while drawing is bounded by tiles of the image, about 8 MB, beside the fragments:
      three or four times their own 16 bytes each (24 in float64) until they are sorted.

    Raises:
      ValueError: for wrong shapes, indices out of range, a triangle with a point twice, NaN or
        infinite numbers, lengths out of the range that `jaxvr.units` states, 2^31 fragments or
        more. Not for use inside `jit`: how many there are
        decides the result's shape.

    Triangles share an edge if they share its two point ids. Where they only have points at the same
    place, a ray through the edge may meet both or neither: merge such points before.
    """
    if not is_concrete(*jax.tree.leaves((points, triangles, values, camera))):
        raise ValueError(
            "rasterize cannot run inside jit or grad, since the number of fragments decides the "
            "shape of its result. Call it outside, and Fragments.locate inside."
        )
    require_kind("camera", camera, Camera)
    points, camera = beside(points, camera, origin)
    dtype = common_float(None, *(np.asarray(x) for x in (points, values) if x is not None))
    points = as_floats("points", points, ndim=2, dtype=dtype)
    require_shape("points", points, (None, 3))
    require_finite("points", points)
    require_lengths("points", points)
    values = np.zeros(len(points)) if values is None else values
    values = as_floats("values", values, ndim=1, dtype=dtype)
    require_shape("values", values, (len(points),))
    require_finite("values", values)
    triangles = _checked(triangles, len(points))
    camera = jax.tree.map(lambda x: jnp.asarray(x).astype(dtype), camera)
    source = triangle_source(jnp.asarray(points), jnp.asarray(values), jnp.asarray(triangles))
    sort = Sort(order or Centroid())
    # Rays and not the camera: one compiled function for all kinds of them.
    order_of = tile_order(camera.height, camera.width)
    rays = tuple(x.reshape(-1, 3)[order_of] for x in camera.local_rays())
    counts = np.asarray(_count(sort, source, rays))
    start = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
    total = int(start[-1])
    if total >= 1 << 31:
        raise ValueError(
            f"There are {total} fragments, but at most 2^31 - 1 can be numbered. Draw the image in "
            "parts, or with fewer pixels."
        )
    room = max(1 << max(total - 1, 0).bit_length(), 1024)
    faces, depths, scalars = _fill(sort, source, rays, start[:-1].astype(np.int32), room)
    ray = np.repeat(order_of, counts)
    by_pixel = np.argsort(ray, kind="stable")
    faces, depths, scalars = (
        jnp.asarray(np.asarray(x)[:total][by_pixel]) for x in (faces, depths, scalars)
    )
    return Fragments(
        *(faces, jnp.asarray(ray[by_pixel], jnp.int32), depths, scalars),
        jnp.asarray(triangles),
        camera.width,
        camera.height,
    )


def _checked(triangles: Any, points: int) -> np.ndarray:
    triangles = np.asarray(triangles)
    if triangles.ndim != 2 or triangles.shape[1] != 3 or triangles.dtype.kind not in "iu":
        raise ValueError(
            f"triangles must be integers with shape (F, 3), but have {triangles.dtype} and "
            f"{triangles.shape}."
        )
    if len(triangles) == 0:
        raise ValueError("There are no triangles.")
    if triangles.min() < 0 or triangles.max() >= points:
        raise ValueError(
            f"triangles refer to points {triangles.min()} to {triangles.max()}, but there are "
            f"{points} points."
        )
    a, b, c = triangles.T
    twice = (a == b) | (b == c) | (a == c)
    if twice.any():
        raise ValueError(
            f"{int(twice.sum())} triangle(s) have a point twice, the first is {np.argmax(twice)}."
        )
    return triangles.astype(np.int32)


@jax.jit
def triangle_source(points: Array, values: Array, triangles: Array) -> Triangles:
    """Triangles (F, 3) over points (P, 3) with scalars (P,)."""
    scale = scale_of(points)
    points = points * scale
    ids = jnp.sort(triangles, axis=1)
    blocks = -(-ids.shape[0] // BLOCK)
    number = jnp.minimum(jnp.arange(blocks * BLOCK), ids.shape[0] - 1)
    corners = points[ids[number]].reshape(blocks, -1, 3)
    return Triangles(
        jnp.concatenate([points, values[:, None]], 1).reshape(-1),
        ids.reshape(-1),
        (corners.min(1).T, corners.max(1).T),
        scale,
    )


def _ahead(new: Hits) -> Array:
    """Fragments (R,) in front of the camera."""
    return new.hit & (new.at.z >= 0)


@partial(jax.jit, static_argnums=0)
def _count(sort: Sort, source: Triangles, rays: Any) -> Array:
    """Fragments of each ray."""
    rays, count = batches(batch_size(source.vertices.dtype), rays)

    def one(inputs):
        batch = beam_rays(Rays(*inputs), source.scale)
        zero = jnp.zeros(batch.origins.shape[1], jnp.int32)
        return draw(source, batch, sort, zero, lambda n, new: n + _ahead(new).astype(jnp.int32))

    return lax.map(one, rays).reshape(-1)[:count]


@partial(jax.jit, static_argnums=(0, 4))
def _fill(sort: Sort, source: Triangles, rays: Any, start: Array, room: int) -> Any:
    """Slots, depths and scalars (room,), ray after ray from `start` (R,) on."""
    (origins, directions, start), _ = batches(batch_size(source.vertices.dtype), (*rays, start))

    def one(arrays, inputs):
        origins, directions, first = inputs
        rays = beam_rays(Rays(origins, directions), source.scale)

        def add(carry, new):
            place, (faces, depths, scalars) = carry
            seen = _ahead(new)
            at = jnp.where(seen, place, room)
            arrays = (
                faces.at[at].set(new.slot, mode="drop"),
                depths.at[at].set(new.at.z * rays.sheared.stretch, mode="drop"),
                scalars.at[at].set(new.at.value, mode="drop"),
            )
            return place + seen.astype(jnp.int32), arrays

        return draw(source, rays, sort, (first, arrays), add)[1], None

    zero = jnp.zeros(room, source.vertices.dtype)
    nothing = (jnp.zeros(room, jnp.int32), zero, zero)
    return lax.scan(one, nothing, (origins, directions, start))[0]


def beside(points: Any, camera: Camera, origin: Any) -> tuple[Any, Camera]:
    """Points and camera relative to one origin: the camera's, if it has one, for known points of
    float64, and that of the points for others."""
    place = NOWHERE if origin is None else origin_of(origin)
    points = digits_of(points)
    if not any(camera.origin) or place == camera.origin:
        return points, camera.relative_to(place)
    if isinstance(points, jax.Array) or is_single(points):
        if origin is None:
            require_said("points", "origin", camera.origin)
        return points, camera.relative_to(place)
    by = np.asarray(camera.origin) - np.asarray(place)
    return relative(as_floats("points", points, dtype=np.float64), by, np.float64), camera


@jax.jit
def _locate(fragments: Fragments, points: Array, values: Array, camera: Camera) -> Any:
    source = triangle_source(points, values, fragments.triangles)
    origins, directions = (x.reshape(-1, 3)[fragments.pixel] for x in camera.local_rays())
    rays = shear_rays(Rays(origins, directions), source.scale)
    wanted = jnp.ones((), bool)
    face = face_at(source, rays, fragments.face, wanted)
    edges = opposite_edges(*face)
    at = crossing(face, sizes_of(edges), rays.eye)
    return at.z * rays.stretch, at.value
