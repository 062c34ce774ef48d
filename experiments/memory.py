"""Memory of the adjoints against cells per ray.

    python -m experiments.memory [--tiny]

Compiles (and does not run) the gradient of one image for meshes of more and more cells in depth,
and prints what XLA reserves beyond arguments and result. `Replay` keeps nothing along the ray;
`Direct` stores every step.
"""

from __future__ import annotations

import argparse
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxvr
from experiments.common import camera_of, transfer_of, write_json


def reserved(mesh: jaxvr.TetMesh, size: int, adjoint=None, engine=None) -> int:
    """Bytes of temporary buffers for the gradient of a size x size image."""
    transfer = jaxvr.TransferFunction([0.0, 0.5, 1.0], np.eye(3), [0.1, 2.0, 1.0])
    camera = jaxvr.Camera.orbit(mesh, width=size, height=size)

    def loss(transfer, mesh):
        return jnp.sum(jaxvr.render(mesh, camera, transfer, adjoint=adjoint, engine=engine) ** 2)

    compiled = jax.jit(jax.grad(loss)).lower(transfer, mesh).compile()
    analysis = compiled.memory_analysis()
    assert analysis is not None
    return int(analysis.temp_size_in_bytes)


def bytes_per_tet(mesh: jaxvr.TetMesh, size: int) -> dict[str, Any]:
    """What a mesh takes on the device, and with it what XLA reserves beyond arguments and result to
    render it in one compiled function: for an image of 16 x 16, and for one of size x size, whose
    rays and pixels do not depend on the mesh. What a native kernel allocates itself is not in it.
    """
    transfer = transfer_of(mesh)

    def needed(side: int) -> int:
        render = jax.jit(lambda m, c, t: jaxvr.render(m, c, t))
        compiled = render.lower(mesh, camera_of(mesh, side), transfer).compile()
        analysis = compiled.memory_analysis()
        assert analysis is not None
        return mesh.nbytes + int(analysis.temp_size_in_bytes)

    total = {"mesh": mesh.nbytes, "small": needed(16), "image": needed(size)}
    per_tet = {f"{name}_per_tet": value / mesh.n_tets for name, value in total.items()}
    return {"tets": mesh.n_tets, "size": size, "bytes": total} | per_tet


def run(size: int, depths: list[int], steps_per_layer: int = 6) -> list[dict]:
    """One row a mesh: a bar of 2 x 2 x n blocks, which a ray along it crosses in some 6 n cells."""
    rows = []
    for n in depths:
        mesh = jaxvr.datasets.box((2, 2, n), dtype="float32")
        steps = steps_per_layer * n
        replay = reserved(mesh, size, jaxvr.Replay())
        direct = reserved(mesh, size, jaxvr.Direct(max_steps=steps))
        rows.append(
            {"layers": n, "tets": mesh.n_tets, "steps": steps, "replay": replay, "direct": direct}
        )
        print(
            f"{n:5d} layers {mesh.n_tets:6d} tets {steps:5d} steps   Replay {replay / 1e6:9.1f} MB"
            f"   Direct {direct / 1e6:9.1f} MB",
            flush=True,
        )
    return rows


def main(arguments: list[str] | None = None) -> list[dict]:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--json")
    parser.add_argument("--tiny", action="store_true")
    options = parser.parse_args(arguments)
    size, depths = (8, [2, 8]) if options.tiny else (options.size, [4, 16, 64])
    rows = run(size, depths)
    if options.json:
        write_json(options.json, rows)
    return rows


if __name__ == "__main__":
    main()
