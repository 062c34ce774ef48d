"""Memory of a k-buffer render: what grows with the mesh, and what tiles of the image bound.

    python -m experiments.kbuffer_memory post_x2.npz ... [--size 512] [--k 6] [--json F]

For each mesh: bytes that the mesh has, bytes that XLA reserves beside it (as its report on the
compiled render says: the scene, the image and all that a tile needs), for the default budget and
for one eight times smaller, and the same for a small mesh: what is left for the tiles. Then the
peak of the process in a render, before and after, as the system counts it.
"""

from __future__ import annotations

import resource
from functools import partial
from typing import Any

import jax

import jaxvr
from experiments.common import read_volume, table, transfer_of
from experiments.havs import options, report, viewpoints, volumes

BUDGET = 1 << 16


def reserved(volume: jaxvr.TetMesh, size: int, tracer: Any, budget: int | None) -> int:
    """Bytes that the compiled render needs beside its operands and its result."""
    camera, transfer = viewpoints(volume, size)[-1], transfer_of(volume)
    draw = partial(jaxvr.render, tracer=tracer, budget=budget, status=True)
    compiled = jax.jit(draw).lower(volume, camera, transfer).compile()
    analysis = compiled.memory_analysis()
    assert analysis is not None
    return int(analysis.temp_size_in_bytes)


def peak() -> int:
    """Bytes that this process has had at most."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def run(volume: jaxvr.TetMesh, name: str, size: int, k: int) -> dict[str, Any]:
    tracer, small = jaxvr.KBuffer(k=k), read_volume()
    row: dict[str, Any] = {"mesh": name, "tets": volume.n_tets, "of the mesh": volume.nbytes}
    row["reserved"] = reserved(volume, size, tracer, None)
    row["with 64 KiB for rays"] = reserved(volume, size, tracer, BUDGET)
    row["small mesh"] = reserved(small, size, tracer, None)
    row["peak before"] = peak()
    camera, transfer = viewpoints(volume, size)[-1], transfer_of(volume)
    jax.block_until_ready(jaxvr.render(volume, camera, transfer, tracer=tracer, status=True))
    row["peak after"] = peak()
    row["reserved bytes a tet"] = (row["reserved"] - row["small mesh"]) / volume.n_tets
    print(table([{"what": key, "": value} for key, value in row.items()]), flush=True)
    return row


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    found = options(__doc__, arguments, k=6)
    rows = [run(volume, name, found.size, found.k) for name, volume in volumes(found).items()]
    return report(found, rows, "k")


if __name__ == "__main__":
    main()
