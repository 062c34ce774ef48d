"""Table 2 of Callahan et al. 2005: cells a second with k = 2 and k = 6, and sorting by itself.

    python -m experiments.kbuffer_speed bluntfin.vtu:density ... [--repeat 3] [--views 14]

Means over fixed viewpoints at 512 x 512, with `RayCast` in the same run: its compiled loops, and
JAX's own, which are what `KBuffer` runs in. As in the paper, sorting all faces for a view stands by
itself: by centroid all faces are sorted, by first vertex the points are, and faces follow. (The
renderer does not sort that way: it sorts the faces of each tile, which is part of its time.)
Pictures are right or not as k allows; this is about time.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxvr
from experiments.common import seconds_of, table, transfer_of
from experiments.havs import options, report, viewpoints, volumes
from jaxvr.volume import packing
from jaxvr.volume.connectivity import FACES


@jax.jit
def sort_by_centroid(points: Any, faces: Any, eye: Any) -> Any:
    """The order (F,) of faces (F, 3)."""
    away = points[faces].mean(1) - eye[None]
    return jnp.argsort(jnp.sum(away * away, axis=1))


@jax.jit
def sort_by_first_vertex(points: Any, first: Any, starts: Any, eye: Any) -> Any:
    """The same, for faces that are grouped by their first vertex: `first` (F,) its id and `starts`
    (P + 1,) where each vertex's faces begin."""
    away = points - eye[None]
    order = jnp.argsort(jnp.sum(away * away, axis=1))
    count = (starts[1:] - starts[:-1])[order]
    ends = jnp.cumsum(count)
    # Face i of the sorted list belongs to the vertex in whose run i lies.
    vertex = jnp.repeat(jnp.arange(len(order)), count, total_repeat_length=first.shape[0])
    within = jnp.arange(first.shape[0]) - (ends - count)[vertex]
    return starts[:-1][order][vertex] + within


def faces_of(volume: jaxvr.TetMesh) -> np.ndarray:
    """All faces (F, 3), each once."""
    cells, words = np.asarray(volume.cells), np.asarray(volume.neighbors)
    cell, corner = np.nonzero(
        (words < 0) | (packing.cell_of(words) > np.arange(len(cells))[:, None])
    )
    others = FACES[corner]
    return cells[cell[:, None], others]


def run(volume: jaxvr.TetMesh, name: str, size: int, views: int, repeat: int) -> dict[str, Any]:
    transfer = transfer_of(volume)
    faces = faces_of(volume)
    grouped = faces[np.argsort(faces[:, 0], kind="stable")]
    starts = np.searchsorted(grouped[:, 0], np.arange(volume.n_points + 1)).astype(np.int32)
    faces, first, starts = (jnp.asarray(x) for x in (faces, grouped[:, 0], starts))
    sums: dict[str, list[float]] = {}
    for camera in viewpoints(volume, size)[-views:]:
        draw = partial(jaxvr.render, volume, camera, transfer, status=True)
        jax_loops = jaxvr.engine.XLA()
        tasks = {
            "k = 2": lambda: draw(tracer=jaxvr.KBuffer(k=2)),
            "k = 6": lambda: draw(tracer=jaxvr.KBuffer(k=6)),
            "k = 6, first vertex": lambda: draw(
                tracer=jaxvr.KBuffer(k=6, order=jaxvr.order.FirstVertex())
            ),
            "RayCast, JAX": lambda: draw(engine=jax_loops),
            "RayCast, compiled": lambda: draw(),
            "sort by centroid": lambda: sort_by_centroid(volume.points, faces, camera.eye),
            "sort by first vertex": lambda: sort_by_first_vertex(
                volume.points, first, starts, camera.eye
            ),
        }
        for task, seconds in seconds_of(tasks, repeat, quiet=True).items():
            sums.setdefault(task, []).append(float(np.median(seconds)))
    row: dict[str, Any] = {"mesh": name, "cells": volume.n_tets, "faces": int(faces.shape[0])}
    means = {task: float(np.mean(seconds)) for task, seconds in sums.items()}
    row |= means
    row["kcells/s, k = 2"] = volume.n_tets / means["k = 2"] / 1e3
    row["kcells/s, k = 6"] = volume.n_tets / means["k = 6"] / 1e3
    row["kcells/s, RayCast, JAX"] = volume.n_tets / means["RayCast, JAX"] / 1e3
    row["kcells/s, RayCast, compiled"] = volume.n_tets / means["RayCast, compiled"] / 1e3
    print(table([{"what": key, name: value} for key, value in row.items()]), flush=True)
    return row


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    found = options(__doc__, arguments, repeat=3, views=14)
    if found.tiny:
        found.repeat = found.views = 1
    rows = [
        run(volume, name, found.size, found.views, found.repeat)
        for name, volume in volumes(found).items()
    ]
    return report(found, rows, "views")


if __name__ == "__main__":
    main()
