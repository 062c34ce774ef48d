"""Where a frame's time goes: select and sort faces, cover, fragments, k-buffer, integrate.

    python -m experiments.kbuffer_stages bluntfin.vtu:density ... [--k 6] [--json F]

Stages are differences of timings of the same loops with more and more of them: faces of all tiles
selected and sorted; bits of which rays may meet them; fragments taken; the whole render. Sorting
alone is timed on lists of the same lengths, and integrating on cached segments, by JAX's loops too;
feeding the k-buffers is what is left of the render. And the entry
points of `RayCast`, found by its hierarchy and by the rasteriser over the boundary.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

import jaxvr
from experiments.common import median_of, table, transfer_of
from experiments.havs import options, report, viewpoints, volumes
from jaxvr.trace import stream as streams
from jaxvr.trace.entry import search
from jaxvr.trace.rasterize import triangle_source
from jaxvr.trace.select import Sort, next_selection, sort_first, start_selection
from jaxvr.view.rays import Rays
from jaxvr.view.tiles import batch_size, batches, tile
from jaxvr.volume import packing
from jaxvr.volume.connectivity import FACES

SIZE = batch_size("float32")


def _tiles(camera: jaxvr.Camera) -> Any:
    return batches(SIZE, tuple(tile(x) for x in camera.rays()))[0]


def _selected(scene: Any, rays: Any, sort: Any) -> Any:
    scene, rays = lax.stop_gradient((scene, rays))
    return next_selection(start_selection(scene), scene, streams.beam(rays), sort)


def _select(scene: Any, rays: Any, sort: Any) -> Any:
    return _selected(scene, rays, sort).count


def _sort_only(scene: Any, count: Any) -> Any:
    """Sorts lists as long as those of the tiles, in no order before."""
    size = start_selection(scene).faces.shape[0]
    number = jnp.arange(size, dtype=jnp.int32)
    faces = jnp.stack([(number * jnp.int32(40503)) % 65521, number], 1)
    return sort_first(faces, count)[0, 0]


def _cover(scene: Any, rays: Any, sort: Any) -> Any:
    stream = streams.start_stream(scene, SIZE)
    stream = stream._replace(selection=_selected(scene, rays, sort))

    def going(stream):
        return ~streams.over(stream)

    def body(stream):
        return streams.refill(stream, jnp.ones((), bool), scene, rays, sort)

    return lax.while_loop(going, body, stream).groups


def _fragments(scene: Any, rays: Any, sort: Any) -> Any:
    def add(sums, new):
        total, depth = sums
        return total + new.hit, depth + jnp.where(new.hit, new.at.z + new.at.value, 0)

    zero = jnp.zeros(SIZE, jnp.int32), jnp.zeros(SIZE, rays.origins.dtype)
    return streams.draw(scene, rays, sort, zero, add)


def _entries(caster: jaxvr.RayCast, scene: Any, rays: Any) -> Any:
    last = (jnp.full(SIZE, -jnp.inf), jnp.full(SIZE, -1, jnp.int32))
    return search(scene.mesh, rays, scene.boxes, jnp.ones(SIZE, bool), last).depth


def run(volume: jaxvr.TetMesh, name: str, size: int, k: int, repeat: int) -> list[dict[str, Any]]:
    camera, transfer = viewpoints(volume, size)[-1], transfer_of(volume)
    tracer, sort = jaxvr.KBuffer(k=k), Sort(jaxvr.order.Centroid())
    scene, rays = jax.jit(tracer.prepare)(volume), _tiles(camera)
    rays = jax.jit(jax.vmap(partial(tracer.prepare_rays, scene)))(Rays(*rays))

    def of_tiles(stage, *static):
        return jax.jit(lambda scene, rays: lax.map(lambda r: stage(scene, r, *static), rays))

    counts = of_tiles(_select, sort)(scene, rays)
    caster = jaxvr.RayCast()
    cast = jax.jit(caster.prepare)(volume)
    cast_rays = jax.jit(jax.vmap(partial(caster.prepare_rays, cast)))(Rays(*_tiles(camera)))
    search_all = jax.jit(lambda s, rays: lax.map(lambda r: _entries(caster, s, r), rays))
    sort_all = jax.jit(lambda s, c: lax.map(lambda n: _sort_only(s, n), c))
    words = np.asarray(volume.boundary)
    others = FACES[packing.corner_of(words)]
    boundary = np.asarray(volume.cells)[packing.cell_of(words)[:, None], others]
    values = jnp.zeros(volume.n_points, volume.dtype)
    surface = triangle_source(volume.points, values, jnp.asarray(boundary))
    draw_all = of_tiles(_fragments, sort)
    segments = jaxvr.trace(volume, camera)
    tasks = {
        "select": lambda f=of_tiles(_select, sort): f(scene, rays),
        "sort": lambda: sort_all(scene, counts),
        "cover": lambda f=of_tiles(_cover, sort): f(scene, rays),
        "fragments": lambda: draw_all(scene, rays),
        "shade": lambda: jaxvr.shade(segments, transfer, engine=jaxvr.engine.XLA()),
        "render": lambda: jaxvr.render(volume, camera, transfer, tracer=tracer, status=True),
        "prepare": lambda f=jax.jit(tracer.prepare): f(volume),
        "entries by hierarchy": lambda: search_all(cast, cast_rays),
        "entries by rasteriser": lambda: draw_all(surface, rays),
    }
    t = median_of(tasks, repeat, quiet=True)
    hits = int(jnp.sum(draw_all(scene, rays)[0]))
    stages = {
        "prepare": t["prepare"],
        "select faces of tiles": t["select"] - t["sort"],
        "sort them": t["sort"],
        "cover": t["cover"] - t["select"],
        "take fragments": t["fragments"] - t["cover"],
        "k-buffer": t["render"] - t["prepare"] - t["fragments"] - t["shade"],
        "integrate and composite": t["shade"],
    }
    rows = [
        {"mesh": name, "stage": stage, "seconds": seconds, "share": seconds / t["render"]}
        for stage, seconds in stages.items()
    ]
    for key in ("render", "entries by hierarchy", "entries by rasteriser"):
        rows.append({"mesh": name, "stage": key, "seconds": t[key], "share": None})
    rows.append({"mesh": name, "stage": "fragments", "number": hits})
    print(f"{name}: {hits} fragments")
    print(table(rows[:-1]), flush=True)
    return rows


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    found = options(__doc__, arguments, repeat=3, k=6)
    if found.tiny:
        found.repeat = 1
    rows = []
    for name, volume in volumes(found).items():
        rows += run(volume, name, found.size, found.k, found.repeat)
    return report(found, rows, "k")


if __name__ == "__main__":
    main()
