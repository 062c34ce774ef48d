"""The rays of all views, as minibatches of one shape.

A batch is a set of rays with their target colours. With cached segments it is a `Segments` of its
own: the runs of its rays, copied together in the order of their lengths (rays are shaded many at a
time, in lock step, so that neighbours in the list had better end together; along stored segments
it does not matter where in the image they are). Without, it is their origins and directions, in
the order of image tiles. All batches of a fit have one number of rays and one size of buffers, so
one compiled function serves them all; the last is filled up with rays of the first.

Rays are dealt to the batches once, at random from the seed, and batches keep their rays: a copy of
the segments, and no gathering while the fit runs.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxvr._core.offsets import NOWHERE, said
from jaxvr._core.pytree import pytree, static
from jaxvr.arguments import camera_of, is_camera
from jaxvr.fit.targets import images_of
from jaxvr.render import trace
from jaxvr.trace import Segments
from jaxvr.view.camera import HasRays

Array = jax.Array

_ROUND = 1 << 16  # buffers are as long as the next multiple of this many nodes
_CHUNK = 1 << 16  # rays copied at once
_TOGETHER = 1 << 22  # rays traced at once


@pytree
class Batch:
    """rays: `Segments` of R rays, or their (origins, directions) (R, 3); target (R, C)."""

    rays: Any
    target: Array


@pytree
class Views:
    """All views of a fit, on the host. P: pixels of all of them, view after view.

    shapes: (height, width) of each view. targets (P, C). dtype: of scalars and colours.
    offset: what scalars are relative to.
    nodes: (scalar, length) of all segments, with first, end (P,): the run of each pixel; or
    rays: (origins, directions) (P, 3), with first = tile order, end None.
    """

    shapes: list[tuple[int, int]]
    targets: Any
    nodes: Any
    first: Any
    end: Any
    offset: float = static(default=0.0)

    @property
    def cached(self) -> bool:
        return self.end is not None

    @property
    def pixels(self) -> int:
        return len(self.targets)

    def parted(self, number: int) -> tuple[Views, Views]:
        """The first views, and the others."""
        n = sum(h * w for h, w in self.shapes[:number])

        def part(which: slice, pixels: slice) -> Views:
            end = None if self.end is None else self.end[pixels]
            nodes = self.nodes if self.cached else tuple(x[pixels] for x in self.nodes)
            shapes, targets = self.shapes[which], self.targets[pixels]
            return Views(shapes, targets, nodes, self.first[pixels], end, self.offset)

        return part(slice(number), slice(n)), part(slice(number, None), slice(n, None))

    def split(self, flat: Any) -> list[Any]:
        """Images (height, width, C), one a view, of colours (P, C)."""
        ends = np.cumsum([h * w for h, w in self.shapes])[:-1]
        parts = np.split(flat, ends)
        return [x.reshape(*s, -1) for x, s in zip(parts, self.shapes, strict=True)]


def gather_views(
    volume: Any,
    cameras: list[Any],
    targets: list[Any],
    *,
    cache: bool,
    tracer: Any,
    background: Any,
    engine: Any = None,
) -> Views:
    """Checked views: cameras with targets, traced if `cache`. Raises ValueError."""
    shapes = [_shape(c) for c in cameras]
    images = images_of(targets, shapes, background)
    flat = np.concatenate([x.reshape(-1, x.shape[-1]) for x in images])
    offset = _offset_of(volume, cameras)
    traced = [isinstance(c, Segments) for c in cameras]
    if any(traced) and not cache:
        raise ValueError("cache=False renders anew, but some of the cameras are Segments.")
    if all(traced):
        parts = [(c, np.asarray(c.order)) for c in cameras]
        dtype = np.asarray(cameras[0].scalar).dtype
    elif volume is None:
        raise ValueError("volume is None, but not all of the cameras are Segments.")
    else:
        dtype = volume.dtype
        if not cache:
            nodes = _rays(cameras, volume)
            return Views(shapes, flat.astype(dtype), nodes, _tile_rank(shapes), None)
        parts = list(_trace(volume, cameras, tracer, engine, dtype))
    first, end, before = [], [], 0
    for part, order in parts:
        start = np.asarray(part.start).astype(np.int64)
        place = np.argsort(order)  # the ray of each pixel
        first.append(before + start[:-1][place])
        end.append(before + start[1:][place])
        before += int(start[-1])
    nodes = tuple(
        np.concatenate([np.asarray(getattr(p, name))[: int(p.start[-1])] for p, _ in parts])
        for name in ("scalar", "length")
    )
    first, end = np.concatenate(first), np.concatenate(end)
    return Views(shapes, flat.astype(dtype), nodes, first, end, offset)


def _trace(volume: Any, cameras: list[Any], tracer: Any, engine: Any, dtype: Any) -> Iterator[Any]:
    """(Segments, pixel of each ray) of successive views.

    Cameras go together, so that one function is compiled for all, as many as 32-bit indices allow
    with a few hundred segments a ray.
    """
    group: list[HasRays] = []
    for k, c in enumerate(cameras):
        if isinstance(c, Segments):
            yield c, np.asarray(c.order)
            continue
        group.append(c)
        after = cameras[k + 1] if k + 1 < len(cameras) else None
        pixels = sum(g.width * g.height for g in [*group, after] if is_camera(g))
        if is_camera(after) and pixels <= _TOGETHER:
            continue
        tiles = np.argsort(_tile_rank([_shape(g) for g in group]))
        origins, directions = _rays(group, volume)
        rays = origins[tiles], directions[tiles]
        part = trace(here(volume), rays, tracer=tracer, engine=engine)
        yield part, tiles[np.asarray(part.order)]
        group = []


def here(volume: Any) -> Any:
    """The volume as if its origin were that of the world: for rays that are relative to it."""
    return dataclasses.replace(volume, origin=NOWHERE) if any(volume.origin) else volume


def _offset_of(volume: Any, cameras: list[Any]) -> float:
    """What the scalars of all views are relative to, or a ValueError."""
    found = {c.offset for c in cameras if isinstance(c, Segments)}
    if volume is not None:
        found.add(volume.offset)
    if len(found) > 1:
        raise ValueError(
            f"Scalars are relative to offsets that differ, {' and '.join(map(said, found))}: trace "
            "all views of one volume."
        )
    return found.pop() if found else 0.0


def _rays(cameras: list[Any], volume: Any) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions (P, 3), as `render` makes them: relative to the volume's origin."""
    rays = [camera_of(c, volume).local_rays() for c in cameras]
    origins, directions = (
        np.concatenate([np.asarray(x).reshape(-1, 3) for x in part])
        for part in zip(*rays, strict=True)
    )
    return origins, directions


def deal(
    views: Views, per_batch: Any, views_per_batch: Any, seed: int, fill: bool = False
) -> list[np.ndarray]:
    """The pixels of each batch: all, `per_batch` random ones, or those of some whole views.

    fill: repeat pixels where there are less than `per_batch`.
    """
    pixels = views.pixels
    if per_batch is not None and views_per_batch is not None:
        raise ValueError("Pass rays= or views=, not both.")
    rng = np.random.default_rng(seed)
    if views_per_batch is not None:
        n = _count("views", views_per_batch, len(views.shapes))
        if len(set(views.shapes)) > 1:
            raise ValueError(
                f"views= needs views of one size, but there are {sorted(set(views.shapes))}. "
                "Pass rays= instead."
            )
        size = pixels // len(views.shapes)
        order = _rounded(rng.permutation(len(views.shapes)), n)
        return [(group[:, None] * size + np.arange(size)).ravel() for group in order.reshape(-1, n)]
    if per_batch is None:
        return [np.arange(pixels)]
    n = _count("rays", per_batch, per_batch if fill else pixels)
    if n == pixels:
        return [np.arange(pixels)]
    return list(_rounded(rng.permutation(pixels), n).reshape(-1, n))


def make_batches(
    views: Views, dealt: list[np.ndarray], least: int = 0
) -> tuple[list[Batch], list[np.ndarray]]:
    """Batches on the device, and the pixel of each of their rays.

    least: nodes that buffers hold at least, so that they fit a function compiled for others.
    """
    if not views.cached:
        sets = [p[np.argsort(views.first[p], kind="stable")] for p in dealt]
        made = [
            Batch(tuple(jnp.asarray(x[p]) for x in views.nodes), jnp.asarray(views.targets[p]))
            for p in sets
        ]
        return made, sets
    size = views.end - views.first
    sets = [p[np.argsort(size[p], kind="stable")] for p in dealt]
    largest = max(int(size[p].sum()) for p in sets)
    if largest >= 2**31:
        raise ValueError(
            f"{largest} nodes in one batch do not fit 32-bit indices. Pass rays= or views= to "
            "take fewer rays at once."
        )
    total = max(-(-max(largest, 1) // _ROUND) * _ROUND, least)
    made = [Batch(_runs(views, p, total), jnp.asarray(views.targets[p])) for p in sets]
    return made, sets


def _runs(views: Views, pixels: np.ndarray, total: int) -> Segments:
    """The segments of some pixels, one after the other, in buffers of `total` nodes."""
    first, size = views.first[pixels], (views.end - views.first)[pixels]
    start = np.concatenate([[0], np.cumsum(size)])
    out = [np.zeros(total, x.dtype) for x in views.nodes]
    for lo in range(0, len(pixels), _CHUNK):
        hi = min(lo + _CHUNK, len(pixels))
        shift = np.repeat(first[lo:hi] - start[lo:hi], size[lo:hi])
        source = shift + np.arange(start[lo], start[hi])
        for x, y in zip(out, views.nodes, strict=True):
            x[start[lo] : start[hi]] = y[source]
    rays = len(pixels)
    return Segments(
        *(jnp.asarray(x) for x in out),
        start=jnp.asarray(start, jnp.int32),
        status=jnp.zeros(rays, jnp.int32),
        order=jnp.arange(rays, dtype=jnp.int32),
        shape=(rays,),
        offset=views.offset,
    )


def _rounded(order: np.ndarray, n: int) -> np.ndarray:
    """`order`, filled up from its beginning to a multiple of n."""
    return np.resize(order, -(-len(order) // n) * n)


def _tile_rank(shapes: list[tuple[int, int]], side: int = 16) -> np.ndarray:
    """The rank of each pixel when views are read tile by tile."""
    ranks, offset = [], 0
    for height, width in shapes:
        rows, columns = (x.ravel() for x in np.mgrid[0:height, 0:width])
        order = np.lexsort((columns, rows, columns // side, rows // side))
        rank = np.empty(len(order), np.int64)
        rank[order] = offset + np.arange(len(order))
        ranks.append(rank)
        offset += len(order)
    return np.concatenate(ranks)


def _count(name: str, n: Any, most: int) -> int:
    if isinstance(n, bool) or not isinstance(n, int | np.integer) or not 1 <= n:
        raise ValueError(f"{name} must be a whole number of at least 1, but is {n!r}.")
    return min(int(n), most)


def listed(cameras: Any) -> list[Any]:
    """Checked cameras or segments; one alone is a list of one."""
    cameras = [cameras] if isinstance(cameras, Segments) or is_camera(cameras) else cameras
    if not isinstance(cameras, Sequence):
        raise ValueError(f"cameras must be a list of jaxvr.Camera, not {type(cameras).__name__}.")
    for k, c in enumerate(cameras):
        if not (isinstance(c, Segments) or is_camera(c)):
            raise ValueError(
                f"cameras[{k}] must be a jaxvr.Camera or jaxvr.Segments, not {type(c).__name__}."
            )
        if isinstance(c, Segments) and len(c.shape) != 2:
            raise ValueError(f"cameras[{k}] are segments of rays {c.shape}, not of an image.")
    if not cameras:
        raise ValueError("cameras is empty: a fit needs at least one view.")
    return list(cameras)


def _shape(camera: Any) -> tuple[int, int]:
    if isinstance(camera, Segments):
        height, width = camera.shape
        return height, width
    return camera.height, camera.width
