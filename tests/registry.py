"""Every tracer, integrator, compositor, adjoint and kind of mesh, named once, for tests to cross.

A new implementation is one line here, with what it can do. `combinations` leaves out what a flag
rules out, and nothing else.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np
import quick
from recipes import recipes

import jaxvr
from jaxvr.adjoint import Pipeline
from jaxvr.adjoint.base import Operands
from jaxvr.arguments import rays_of
from jaxvr.volume import datasets


@dataclasses.dataclass(frozen=True)
class Entry:
    """name, what makes it, and what it can do.

    error: largest difference of an integrator's image from `Analytic`'s in the setting of
    test_registry, whose transfer function has a jump. slope: difference of its derivative with
    respect to colours and extinctions, relative. None for both: equal to rounding, in all
    derivatives. variant: the same class as another entry, or almost; crossed with all adjoints in
    `shade` only. only: names of the integrators that an adjoint can do, or None for all. follows: a
    tracer of the same segments, which is crossed with everything; here all adjoints will do, and
    other data with one of them. locations: of the data that a tracer takes. engine: what runs an
    adjoint.
    """

    name: str
    make: Callable[[], Any]
    error: float | None = None
    slope: float | None = None
    variant: bool = False
    forward: bool = True
    reverse: bool = True
    only: tuple[str, ...] | None = None
    follows: str | None = None
    locations: tuple[str, ...] = ("point", "cell", "corner")
    engine: Any = None

    def can(self, integrator: Entry) -> bool:
        return self.only is None or integrator.name in self.only


TRACERS = [
    Entry("RayCast", jaxvr.RayCast),
    Entry("KBuffer", lambda: jaxvr.KBuffer(k=8), follows="RayCast"),
    # Of another maker, as notebooks/contribute.md prints it; its volumes are in test_recipes.
    Entry("AllCells", lambda: recipes().AllCells(), follows="RayCast", locations=("point",)),
]

_SMALL = (24, 24, 8)
INTEGRATORS = [
    Entry("Analytic", jaxvr.Analytic),
    Entry("fast", lambda: jaxvr.Analytic("fast"), 1e-6, 1e-6, variant=True),
    Entry("draft", lambda: jaxvr.Analytic("draft"), 1e-5, 1e-5, variant=True),
    Entry("PartialPreIntegration", jaxvr.PartialPreIntegration, 1e-8, 1e-7),
    Entry(
        "texture",
        lambda: jaxvr.PartialPreIntegration(crossings="texture"),
        *(1e-8, 1e-7),
        variant=True,
    ),
    Entry("gamma", lambda: jaxvr.PartialPreIntegration(512, "bilinear"), 1e-6, 1e-3, variant=True),
    Entry("PreIntegration", lambda: jaxvr.PreIntegration(_SMALL), 0.1, 0.4),
    Entry("logarithmic", lambda: jaxvr.PreIntegration(_SMALL, "log"), 0.1, 0.4, variant=True),
    Entry("Quadrature", lambda: jaxvr.Quadrature(samples=16)),
    Entry("trapezoid", lambda: jaxvr.Quadrature("trapezoid", 8), 1e-3, 3e-3, variant=True),
    Entry("riemann", lambda: jaxvr.Quadrature("riemann", 8), 1e-3, 3e-3, variant=True),
    Entry("AverageColor", jaxvr.AverageColor, 0.3, 0.8),
    Entry("ConstantExtinction", jaxvr.ConstantExtinction, 0.3, 0.8, variant=True),
]

ADJOINTS = [
    Entry("Replay", jaxvr.Replay, forward=False, engine=jaxvr.engine.XLA()),
    Entry(
        "compiled",
        jaxvr.Replay,
        forward=False,
        engine=jaxvr.engine.C(),
        only=("Analytic", "fast", "draft"),
    ),
    Entry("Direct", lambda: jaxvr.Direct(max_steps=64)),
    Entry("Forward", jaxvr.Forward, reverse=False),
]

COMPOSITORS = [
    Entry("Over", jaxvr.Over),
    Entry("ending", lambda: jaxvr.Over(termination=0.5), 0.5, variant=True),
    Entry("backwards", lambda: jaxvr.Over(direction="back to front"), variant=True),
    Entry("MaximumIntensity", jaxvr.MaximumIntensity),
    Entry("XRay", jaxvr.XRay),
    Entry("depths", lambda: jaxvr.XRay("optical depth"), variant=True),
]


def _box(location: str, dtype: str):
    mesh = datasets.box((2, 2, 2), jitter=0.2, seed=1, dtype=dtype, shuffle=True)
    rng = np.random.default_rng(5)
    if location == "cell":
        return mesh.replace(values=rng.uniform(0, 1, mesh.n_tets), location="cell")
    if location == "corner":
        return mesh.replace(values=rng.uniform(0, 1, (mesh.n_tets, 4)), location="corner")
    return mesh


def engine_of(compiled: bool | None) -> Any:
    """C, XLA, or what is taken by default."""
    return None if compiled is None else jaxvr.engine.C() if compiled else jaxvr.engine.XLA()


MESHES = ["point", "cell", "corner"]


def mesh_of(location: str, dtype: str):
    return _box(location, dtype)


def transfer_of(dtype: str) -> jaxvr.TransferFunction:
    """Six control points with a jump, over values from 0 to 1."""
    rng = np.random.default_rng(2)
    positions = np.array([0.05, 0.3, 0.45, 0.45, 0.7, 0.9])
    return jaxvr.TransferFunction(
        positions, rng.uniform(0, 1, (6, 3)), rng.uniform(0.2, 3, 6), dtype=dtype
    )


def camera_of(dtype: str) -> jaxvr.Camera:
    return jaxvr.Camera.look_at(
        (1.9, 1.4, 2.3), (0.52, 0.47, 0.5), fov=32.0, width=6, height=5, dtype=dtype
    )


def combinations() -> Iterator[tuple[Entry, Entry, Entry, str]]:
    """All tracers and adjoints with the analytic integrator, all integrators with the adjoint by
    default and in forward mode; on the other kinds of field, which integrators do not see, the
    former once more. All integrators with all adjoints are crossed in `shade`, where that takes a
    quarter of the time. (`Recorded`, the tracer of `shade`, has its own test.)"""
    for tracer in TRACERS:
        if tracer.follows:
            for adjoint in ADJOINTS:
                if not adjoint.only:  # compiled loops cast rays
                    yield tracer, INTEGRATORS[0], adjoint, "point"
            for mesh in MESHES[1:]:
                if mesh in tracer.locations:
                    yield tracer, INTEGRATORS[0], ADJOINTS[0], mesh
            continue
        for adjoint in ADJOINTS:
            for mesh in MESHES:
                yield tracer, INTEGRATORS[0], adjoint, mesh
        for integrator in INTEGRATORS[1:]:
            for adjoint in (ADJOINTS[0], ADJOINTS[-1]):
                if not integrator.variant and adjoint.can(integrator):
                    yield tracer, integrator, adjoint, "point"


def states(mesh, rays, transfer, compositor, engine, near, far):
    """The compositor's state at the end of rays (origins, directions) (R, 3): leaves (..., R)."""
    pipeline = Pipeline(jaxvr.RayCast(), compositor.default_integrator(), compositor)
    assert engine.refuses(pipeline, mesh.dtype) is None
    origins, directions = rays
    given = rays_of(origins, directions, mesh, near, far)
    state, status = _states(engine, compositor, mesh, given, transfer)
    assert not np.asarray(status).any()
    return jax.tree.map(lambda x: x[0], state)


@functools.partial(quick.jit, static_argnums=0)
def _states(engine, compositor, mesh, rays, transfer):
    tracer, integrator = jaxvr.RayCast(), compositor.default_integrator()
    scene = tracer.prepare(mesh)
    batch = jax.tree.map(lambda x: x[None], tracer.prepare_rays(scene, rays))
    table = integrator.prepare(transfer, mesh.dtype, tracer.longest(scene))
    return engine.march(Pipeline(tracer, integrator, compositor), Operands(scene, batch, table))
