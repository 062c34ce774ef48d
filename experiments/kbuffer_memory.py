"""Memory of a k-buffer render: what grows with the mesh and with the image, and what tiles bound.

    python -m experiments.kbuffer_memory post_x2.npz ... [--size 512] [--k 6] [--json F]

For each mesh: bytes that the mesh has, and that XLA reserves beside it (as its report on the
compiled render says: the scene, arrays as large as the image, and all that a tile needs), for the
default budget, for one eight times smaller and for one 64 times larger; the same for a small mesh,
and for that with a quarter of the rows and columns. From these, bytes a tetrahedron and a pixel.
Then what the process holds (Linux): before a render, and at most during it.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import jax

import jaxvr
from experiments.common import read_volume, table, transfer_of
from experiments.havs import options, report, viewpoints, volumes

LITTLE, MUCH = 1 << 16, 1 << 25  # bytes; the default is 0.4 MB


def reserved(volume: jaxvr.TetMesh, size: int, tracer: Any, budget: int | None) -> int:
    """Bytes that the compiled render needs beside its operands and its result."""
    camera, transfer = viewpoints(volume, size)[-1], transfer_of(volume)
    draw = partial(jaxvr.render, tracer=tracer, budget=budget, status=True)
    compiled = jax.jit(draw).lower(volume, camera, transfer).compile()
    analysis = compiled.memory_analysis()
    assert analysis is not None
    return int(analysis.temp_size_in_bytes)


def held(what: str) -> int | None:
    """Bytes in memory: "VmRSS", now, or "VmHWM", at most since `forget_peak`. None if not known."""
    status = Path("/proc/self/status")
    if not status.exists():
        return None
    (line,) = (x for x in status.read_text().splitlines() if x.startswith(what))
    return int(line.split()[1]) * 1024


def forget_peak() -> None:
    """See proc(5), clear_refs: 5 sets the peak to what is held now."""
    file = Path("/proc/self/clear_refs")
    if file.exists():
        file.write_text("5")


def run(volume: jaxvr.TetMesh, name: str, size: int, k: int) -> dict[str, Any]:
    tracer, small = jaxvr.KBuffer(k=k), read_volume()
    row: dict[str, Any] = {"mesh": name, "tets": volume.n_tets, "of the mesh": volume.nbytes}
    row["reserved"] = reserved(volume, size, tracer, None)
    row["with 64 KiB for rays"] = reserved(volume, size, tracer, LITTLE)
    row["with 32 MiB for rays"] = reserved(volume, size, tracer, MUCH)
    row["small mesh"] = reserved(small, size, tracer, None)
    row["small mesh, small image"] = reserved(small, size // 4, tracer, None)
    row["bytes a tet"] = (row["reserved"] - row["small mesh"]) / volume.n_tets
    pixels = size**2 - (size // 4) ** 2
    row["bytes a pixel"] = (row["small mesh"] - row["small mesh, small image"]) / pixels
    camera, transfer = viewpoints(volume, size)[-1], transfer_of(volume)
    draw = partial(jaxvr.render, tracer=tracer, status=True)
    compiled = jax.jit(draw).lower(volume, camera, transfer).compile()
    forget_peak()
    row["held before"] = held("VmRSS")
    jax.block_until_ready(compiled(volume, camera, transfer))
    row["peak while drawing"] = held("VmHWM")
    print(table([{"what": key, "": value} for key, value in row.items()]), flush=True)
    return row


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    found = options(__doc__, arguments, k=6)
    rows = [run(volume, name, found.size, found.k) for name, volume in volumes(found).items()]
    return report(found, rows, "k")


if __name__ == "__main__":
    main()
