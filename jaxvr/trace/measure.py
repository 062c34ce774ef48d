"""How many entries a k-buffer needs, pixel by pixel (Callahan et al. 2005, section 5, Table 1).

The fragments of a pixel arrive in the order of their faces' keys. How far one has to move is the
number of those before it that are farther (`jaxvr.order.moved`); what a buffer needs follows from
it (`jaxvr.order.entries_needed`). Only the farthest few fragments so far have to be remembered to
count: a count that reaches their number is counted again with more of them.

What is behind the eye leaves a buffer before anything in front of it, and is not looked at: neither
its order nor its number matters. Only the last of it does, which is the other end of the segment
that starts at the eye. So it stands in for the closest fragment, if there is one. Back to front it
is different: what is behind the eye arrives among the rest and takes their places, and counts.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxvr._core.checks import is_concrete
from jaxvr._core.compiling import compiled
from jaxvr._core.offsets import bare
from jaxvr._core.units import require_lengths
from jaxvr.order import AbstractOrder, Centroid
from jaxvr.trace.faces import CellFaces, cell_faces
from jaxvr.trace.scene import make_scene
from jaxvr.trace.select import Sort
from jaxvr.trace.stream import beam_rays, draw, tolerance
from jaxvr.view.camera import Camera
from jaxvr.view.rays import Rays
from jaxvr.view.tiles import batch_size, batches, tile, untile
from jaxvr.volume.integrity import require_mesh
from jaxvr.volume.mesh import TetMesh

Array = jax.Array

LEAST = 8  # positions that are counted at first
FEW = 16  # one batch of so many is measured before the others


@dataclasses.dataclass(frozen=True, eq=False)
class KMap:
    """What the pixels of a view ask of a k-buffer. All arrays are (height, width) int32 of NumPy.

    entries: k that a pixel needs, at least 1. moved: the farthest that a fragment has to move
    forward. fragments: how many there are, in front of the camera or, back to front, on both sides.
    """

    entries: np.ndarray
    moved: np.ndarray
    fragments: np.ndarray

    @property
    def k(self) -> int:
        """A k that is enough for all pixels; the smallest one, unless the eye is in the mesh."""
        return int(self.entries.max())

    def count_above(self, k: int) -> int:
        """Number of pixels that need more than k entries."""
        return int((self.entries > k).sum())


def measure_k(
    volume: TetMesh,
    camera: Camera,
    *,
    order: AbstractOrder | None = None,
    direction: Literal["front to back", "back to front"] = "front to back",
) -> KMap:
    """The k that `KBuffer` needs for a view, and where.

    Args:
      volume: a `TetMesh`. camera: the view. order: as for `KBuffer`; `Centroid()` if None.
      direction: as for `Over`. The same faces in the opposite order need another k: what comes too
        late in one comes early in the other, and waits.

    Returns:
      a `KMap`. An image with `KBuffer(k=map.k, order=order)` is right everywhere.

    Where a mesh is folded or overlaps itself, a fragment may have to stay for a second segment, and
    an entry more may be needed; where moved points have turned cells over, fragments wait until
    their path comes to them, and several more may be: the status of the image has the last word. So
    it has with `pairs="closest"` and an eye among cells: that way needs what is behind the eye in
    order, too.

    Fragments at the same depth to rounding (a ray through an edge) count as out of order, whichever
    comes first. Not for use inside `jit`: how much there is to remember is only known afterwards.
    """
    if not isinstance(volume, TetMesh) or not isinstance(camera, Camera):
        raise ValueError(
            "measure_k takes a TetMesh and a Camera, but was given a "
            f"{type(volume).__name__} and a {type(camera).__name__}."
        )
    if not is_concrete(*jax.tree.leaves((volume, camera))):
        raise ValueError("measure_k cannot run inside jit or grad. Call it outside.")
    if direction not in ("front to back", "back to front"):
        raise ValueError(
            f'direction must be "front to back" or "back to front", but is {direction!r}.'
        )
    require_mesh(volume)
    require_lengths("volume.points", volume.points)
    camera = camera.relative_to(volume.origin, volume.dtype)
    rays, count = batches(batch_size(volume.dtype), tuple(tile(x) for x in camera.local_rays()))
    source = _prepare(bare(volume))
    sort = Sort(order or Centroid(), reverse=direction == "back to front")
    number, size, _ = rays[0].shape
    out, all_batches = np.zeros((3, number, size), np.int32), np.arange(number)

    def measure(again: np.ndarray, most: int) -> None:
        """Counts up to `most`, and to four times as many for the batches where that is too few."""
        while len(again):
            # A power of two of batches, so that few functions are compiled.
            some = np.resize(again, 1 << (len(again) - 1).bit_length())
            found = np.stack(_measure(sort, most, source, *(x[some] for x in rays)))
            out[:, again] = found[:, : len(again)]
            again = again[out[0, again].max(axis=1) >= most]
            most *= 4

    # Some batches tell how far to count for most of the others, which then are drawn only once.
    some, rest = all_batches[::FEW], np.delete(all_batches, np.s_[::FEW])
    measure(some, LEAST)
    usual = np.quantile(out[0, some].max(axis=1), 0.75)
    measure(rest, LEAST * 4 ** max(0, math.ceil(math.log((usual + 1) / LEAST, 4))))
    flat = out.reshape(3, -1, 1)[:, :count]
    return KMap(*(np.asarray(untile(x, camera.height, camera.width))[..., 0] for x in flat))


class _Counts(NamedTuple):
    """farthest (M, R): depths of the M farthest fragments so far, in order. first (R,): depth of
    the closest, and how far it moved. rest (R,): the same of all others. behind (R,): the same of
    the last fragment behind the eye, -infinity if none is. fragments (R,)."""

    farthest: Array
    first: tuple[Array, Array]
    rest: Array
    behind: tuple[Array, Array]
    fragments: Array


@jax.jit
def _prepare(volume: TetMesh) -> CellFaces:
    return cell_faces(make_scene(volume))


@compiled(0, 1)
def _measure(sort: Sort, most: int, source: CellFaces, origins: Array, directions: Array) -> Any:
    """entries, moved and fragments of batches of rays (batches, R), counted up to `most`."""
    size, dtype = origins.shape[1], origins.dtype

    def one(inputs):
        rays = beam_rays(Rays(*inputs), source.scene.scale)
        zero, far = jnp.zeros(size, jnp.int32), jnp.full(size, jnp.inf, dtype)
        nothing = _Counts(
            -jnp.broadcast_to(far, (most, size)), (far, zero), zero, (-far, zero), zero
        )

        def add(counts, new):
            # Depths are compared without what rounding may do to them.
            slack, depth = tolerance(new.at.z, rays.sheared), new.at.z
            seen = new.hit & (sort.reverse | (depth >= 0))
            return _count(counts, new.hit, seen, -depth if sort.reverse else depth, slack)

        counts = draw(source, rays, sort, nothing, add)
        (_, first), (behind, of_behind), rest = counts.first, counts.behind, counts.rest
        moved = jnp.maximum(rest, first)
        # Of all fragments that count, the closest needs one entry less.
        alone = jnp.maximum(rest + 1, first)
        after = jnp.maximum(moved + 1, of_behind)
        entries = jnp.where(jnp.isfinite(behind) & (counts.fragments > 0), after, alone)
        return jnp.maximum(entries, 1), moved, counts.fragments

    return lax.map(one, (origins, directions))


def _count(counts: _Counts, hit: Array, seen: Array, depth: Array, slack: Array) -> _Counts:
    """counts with one more fragment of rays that `hit` one (R,), which is `seen` (R,) or not."""
    farthest, (first, of_first), rest, (behind, of_behind), fragments = counts
    moved = jnp.sum(farthest > (depth - slack)[None], axis=0, dtype=jnp.int32)
    # Insertion into a sorted list without a search: what is nearer moves down by one.
    below = jnp.concatenate([jnp.full_like(farthest[:1], jnp.inf), farthest[:-1]])
    new = jnp.where(hit, depth, -jnp.inf)
    farthest = jnp.maximum(farthest, jnp.minimum(below, new[None]))
    closer = depth < first
    others = jnp.where(closer, of_first, moved)
    last = hit & ~seen & (depth > behind)
    return _Counts(
        farthest,
        (jnp.where(seen & closer, depth, first), jnp.where(seen & closer, moved, of_first)),
        jnp.where(seen & (jnp.isfinite(first) | ~closer), jnp.maximum(rest, others), rest),
        (jnp.where(last, depth, behind), jnp.where(last, moved, of_behind)),
        fragments + seen.astype(jnp.int32),
    )
