"""Whether a k-buffer gives what ray casting gives: pictures and gradients, and with a smaller k.

    python -m experiments.kbuffer_exact bluntfin.vtu:density ... [--size 64] [--json F]

For each mesh, in float32 and in float64, from the fourteenth viewpoint: the k that it needs as
measured, the largest difference of `KBuffer`'s picture from `RayCast`'s, and of its gradients by
values, points, transfer function and camera, each relative to the largest entry. Then for half of
that k, for 6 and for 2: pixels that are off by more than 1e-5, the largest error, and how many
pixels say so by their status. The paper's way to pair fragments is there for comparison.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxvr
from experiments.common import in_float64, table, transfer_of
from experiments.havs import options, report, viewpoints, volumes


def gradients(volume: Any, camera: Any, transfer: Any, tracer: Any, weights: Any) -> Any:
    """By values, points, transfer function and camera, of the picture under fixed weights."""

    def loss(values, points, transfer, camera):
        changed = volume.replace(values=values, points=points)
        engine = jaxvr.engine.XLA()
        image, _ = jaxvr.render(
            changed, camera, transfer, tracer=tracer, engine=engine, status=True
        )
        return jnp.sum(weights * image)

    operands = (volume.values, volume.points, transfer, camera)
    return jax.jit(jax.grad(loss, argnums=(0, 1, 2, 3)))(*operands)


def compare(volume: Any, name: str, camera: Any, smaller: bool) -> list[dict[str, Any]]:
    transfer = transfer_of(volume)
    exact = np.asarray(jaxvr.render(volume, camera, transfer, engine=jaxvr.engine.XLA()))
    weights = jnp.asarray(np.random.default_rng(0).normal(size=exact.shape), exact.dtype)
    reference = gradients(volume, camera, transfer, jaxvr.RayCast(), weights)
    k = jaxvr.measure_k(volume, camera).k
    tried: list[tuple[int, Any]] = [(k, "cells")]
    if smaller:
        tried += [(max(k // 2, 1), "cells"), (k, "closest"), (6, "cells"), (2, "cells")]
    rows = []
    for entries, pairs in tried:
        tracer = jaxvr.KBuffer(k=entries, pairs=pairs)
        image, status = jaxvr.render(
            *(volume, camera, transfer), tracer=tracer, status=True, adjoint=jaxvr.Replay()
        )
        error = np.abs(np.asarray(image) - exact).max(-1)
        off, told = error > 1e-5, np.asarray(status) != 0
        row: dict[str, Any] = {"mesh": name, "dtype": str(volume.dtype), "needed": k}
        row |= {"k": entries, "pairs": pairs, "error": float(error.max())}
        row |= {"off": int(off.sum()), "told": int(told.sum()), "untold": int((off & ~told).sum())}
        row["gradient"] = None
        if (entries, pairs) == (k, "cells"):
            found = gradients(volume, camera, transfer, tracer, weights)
            gaps = [
                float(jnp.max(jnp.abs(a - b)) / jnp.max(jnp.abs(b)))
                for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(reference), strict=True)
                if float(jnp.max(jnp.abs(b))) > 0
            ]
            row["gradient"] = max(gaps)
        rows.append(row)
        print(table([row]), flush=True)
    return rows


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    found = options(__doc__, arguments)
    jax.config.update("jax_enable_x64", True)
    rows = []
    for name, volume in volumes(found).items():
        camera = viewpoints(volume, found.size)[-1]
        if not found.tiny:
            rows += compare(volume, name, camera, smaller=True)
        rows += compare(in_float64(volume), name, in_float64(camera), smaller=False)
        # Compiled code takes memory maps, of which Linux allows a process 65,530.
        jax.clear_caches()
    print(table(rows))
    return report(found, rows)


if __name__ == "__main__":
    main()
