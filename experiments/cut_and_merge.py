"""Rays cut at random places: whether the parts merge to the whole ray.

    python -m experiments.cut_and_merge [--rays 1000] [--json FILE] [MESH ...]

Random rays through each mesh are rendered whole, from 0 to a random distance, and from there on,
and the compositor's states on both sides are merged. Told is the largest difference of pixels: for
the over operator in RGBA, for the integral of the scalar relative to the largest, and for the
largest scalar in units of the field's range; by compiled loops and JAX's own, in both precisions.
Where cells are folded a path leads back, and what lies in front is not what comes first: there only
sums merge, so that of the over operator alpha is told.
"""

from __future__ import annotations

import argparse
import json
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxvr
from experiments.common import table
from experiments.data import meshes_of
from jaxvr.adjoint.base import Operands, Pipeline
from jaxvr.arguments import between
from jaxvr.numerics import compensated

MESHES = ["bluntfin", "oxygen_post", "post_tets", "disk_out_ref", "can"]
ENGINES = {"C": jaxvr.engine.C(), "XLA": jaxvr.engine.XLA()}


def random_rays(mesh: jaxvr.TetMesh, count: int, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Origins and directions (count, 3) of rays towards points in random cells, and places (count,)
    to cut them at: within the volume's bounds, half of them behind the point in that very cell."""
    rng = np.random.default_rng(seed)
    points = np.asarray(mesh.points, np.float64)
    corners = points[np.asarray(mesh.cells)[rng.integers(mesh.n_tets, size=count)]]
    weights = rng.dirichlet(np.ones(4), (2, count))
    target, place = np.einsum("kic,icx->kix", weights, corners)
    away = rng.normal(size=(count, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    size = mesh.diagonal()
    origins = target + size * away
    along = np.abs(((place - target) * -away).sum(1))
    cuts = np.where(rng.random(count) < 0.5, size + along, size * rng.uniform(0.6, 1.4, count))
    return origins, -away, cuts


@jax.jit
def _prepared(mesh: Any, rays: Any):
    tracer = jaxvr.RayCast()
    scene = tracer.prepare(mesh)
    return scene, jax.tree.map(lambda x: x[None], tracer.prepare_rays(scene, rays))


@partial(jax.jit, static_argnums=0)
def _states(engine: Any, compositor: Any, scene: Any, rays: Any, transfer: Any) -> Any:
    tracer, integrator = jaxvr.RayCast(), compositor.default_integrator()
    table = integrator.prepare(transfer, transfer.positions.dtype, tracer.longest(scene))
    state, status = engine.march(
        Pipeline(tracer, integrator, compositor), Operands(scene, rays, table)
    )
    return jax.tree.map(lambda x: x[0], state), status


def numbers(compositor: Any, state: Any) -> np.ndarray:
    """What the state stands for (n, R)."""
    if isinstance(compositor, jaxvr.MaximumIntensity):
        return np.asarray(state.largest)[None]
    if isinstance(compositor, jaxvr.XRay):
        return np.asarray(compensated.value(state.integral))[None]
    return np.asarray(compositor.finish(state, None, None))


def run(mesh: jaxvr.TetMesh, count: int) -> dict[str, dict[str, float]]:
    """Largest differences, by compositor and engine."""
    origins, directions, cuts = random_rays(mesh, count)
    values = np.asarray(mesh.values, np.float64)
    low, high = float(values.min()), float(values.max())
    transfer = jaxvr.TransferFunction.from_colormap(
        "viridis", np.linspace(low, high, 6), np.array([0, 1, 5, 2, 8, 3]) / mesh.diagonal()
    )
    transfer = transfer.relative_to(mesh.offset, mesh.dtype)
    origins, directions = (np.asarray(x, mesh.dtype) for x in (origins, directions))
    compositors: dict[str, Any] = {
        "Over": jaxvr.Over(),
        "XRay": jaxvr.XRay(),
        "MaximumIntensity": jaxvr.MaximumIntensity(),
    }
    found: dict[str, dict[str, float]] = {}
    for name, compositor in compositors.items():
        for kind, engine in ENGINES.items():
            pipeline = Pipeline(jaxvr.RayCast(), compositor.default_integrator(), compositor)
            if why := engine.refuses(pipeline, mesh.dtype):
                raise SystemExit(f"{kind}: {why}")

            def of(near, far, engine=engine, compositor=compositor):
                rays = between(jnp.asarray(origins), jnp.asarray(directions), near, far)
                state, status = _states(engine, compositor, *_prepared(mesh, rays), transfer)
                assert not np.asarray(status).any()
                return state

            whole = numbers(compositor, of(0.0, np.inf))
            joined = compositor.merge(of(0.0, cuts), of(cuts, np.inf))
            apart = np.abs(numbers(compositor, joined) - whole)
            scale = {"Over": 1.0, "XRay": np.abs(whole).max(), "MaximumIntensity": high - low}[name]
            if name == "Over" and mesh.report.folded:
                apart = apart[3:]
            found.setdefault(name, {})[kind] = float(apart.max() / scale)
    return found


def main(argv: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("meshes", nargs="*", default=MESHES)
    parser.add_argument("--rays", type=int, default=1000)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args(argv)
    found, rows = {}, []
    for name, path in meshes_of(arguments.meshes, parser).items():
        for dtype in ("float32", "float64"):
            mesh = jaxvr.read_mesh(path, dtype=dtype)
            found[f"{name} {dtype}"] = here = run(mesh, arguments.rays)
            numbers = {f"{c}, {e}": f"{x:.1e}" for c in here for e, x in here[c].items()}
            rows.append({"mesh": name, "dtype": dtype, **numbers})
    print(table(rows))
    if arguments.json:
        arguments.json.write_text(json.dumps(found, indent=1))
    return found


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
