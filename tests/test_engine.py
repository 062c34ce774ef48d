"""Engines: the one door to them, what they refuse, and one from outside. That all give the same is
in test_registry, and what C is against XLA in tests/native."""

from __future__ import annotations

import re
from typing import Any

import jax
import numpy as np
import pytest
import registry
from test_docs import ROOT, blocks

import jaxvr
from jaxvr.adjoint import Pipeline

pytestmark = pytest.mark.usefixtures("quick_jit")

C, XLA = jaxvr.engine.C(), jaxvr.engine.XLA()


def scene(dtype="float32"):
    return registry.mesh_of("point", dtype), registry.camera_of(dtype), registry.transfer_of(dtype)


def loops_of(function, *args) -> set[str]:
    """Whose loops a function runs."""
    code = jax.jit(function).lower(*args).as_text()
    return {name for name, sign in (("C", "@jaxvr_"), ("XLA", "stablehlo.while")) if sign in code}


def verbs(mesh, camera, transfer, **how: Any):
    """Functions of a transfer function that draw."""
    origins, directions = camera.rays()
    segments = jaxvr.trace(mesh, camera)
    return {
        "render": lambda t: jaxvr.render(mesh, camera, t, **how),
        "render_rays": lambda t: jaxvr.render_rays(mesh, origins, directions, t, **how),
        "shade": lambda t: jaxvr.shade(segments, t, **how),
    }


@pytest.mark.parametrize("engine, name", [(None, "C"), (C, "C"), (XLA, "XLA")])
def test_every_verb_has_the_door(engine, name):
    mesh, camera, transfer = scene()
    for draw in verbs(mesh, camera, transfer, engine=engine).values():
        assert loops_of(draw, transfer) == {name}
        assert loops_of(jax.grad(lambda t, draw=draw: draw(t).sum()), transfer) == {name}


class Told(jaxvr.engine.AbstractEngine):
    """XLA's loops; keeps the names of what was called."""

    def __init__(self):
        self.calls: list[str] = []

    def __getattribute__(self, name):
        if name in ("march", "pull_back", "count", "fill"):
            self.calls.append(name)
            return getattr(XLA, name)
        return super().__getattribute__(name)

    def refuses(self, pipeline, dtype):
        return None

    march = pull_back = count = fill = None  # pyright: ignore


@pytest.mark.parametrize("cache", [True, False])
def test_fit_takes_its_engine_everywhere(cache):
    mesh, camera, transfer = scene()
    target, engine = jaxvr.render(mesh, camera, transfer), Told()
    how: dict[str, Any] = {"iterations": 1, "progress": False, "cache": cache}
    start = transfer.replace(colors=0.5 * transfer.colors)
    found = jaxvr.fit(start, mesh, camera, target, engine=engine, **how)
    want = jaxvr.fit(start, mesh, camera, target, engine=XLA, **how)
    assert np.array_equal(found.loss_history, want.loss_history)
    assert {"march", "pull_back"} <= set(engine.calls)
    assert ({"count", "fill"} <= set(engine.calls)) == cache


def test_what_is_refused_is_said():
    mesh, camera, transfer = scene()
    cases = [
        ({"integrator": jaxvr.Quadrature()}, "none for Quadrature"),
        ({"tracer": jaxvr.KBuffer(8)}, "none for KBuffer"),
        ({"adjoint": jaxvr.Direct(64)}, "Direct has JAX differentiate the loop"),
        ({"adjoint": jaxvr.Forward()}, "Forward has JAX differentiate the loop"),
    ]
    for nouns, words in cases:
        with pytest.raises(ValueError, match=rf"engine=C\(\) cannot be used here: .*{words}"):
            jaxvr.render(mesh, camera, transfer, engine=C, **nouns)
        image = jaxvr.render(mesh, camera, transfer, **nouns)  # by XLA, without a word
        same = jaxvr.render(mesh, camera, transfer, engine=XLA, **nouns)
        assert np.array_equal(image, same)
    with pytest.raises(ValueError, match="none for KBuffer"):
        jaxvr.trace(mesh, camera, tracer=jaxvr.KBuffer(8), engine=C)
    for adjoint in (jaxvr.Direct(64), jaxvr.Forward()):  # whose loops no other engine can run
        with pytest.raises(ValueError, match="not written in JAX"):
            jaxvr.render(mesh, camera, transfer, engine=Told(), adjoint=adjoint)
    for wrong, words in ((jaxvr.engine.XLA, "forget the"), ("XLA", r"jaxvr\.engine\.XLA\(\)")):
        given: Any = wrong
        with pytest.raises(ValueError, match=words):
            jaxvr.render(mesh, camera, transfer, engine=given)


def test_reasons_are_asked_for_at_every_call(monkeypatch):
    """And not compiled in: the environment may change."""
    mesh, camera, transfer = scene()
    pipeline = Pipeline(jaxvr.RayCast(), jaxvr.Analytic(), jaxvr.Over())
    first = jaxvr.render(mesh, camera, transfer, engine=C)
    assert C.refuses(pipeline, "float32") is None
    monkeypatch.setenv("JAXVR_NATIVE", "0")
    with pytest.raises(ValueError, match="JAXVR_NATIVE=0"):
        jaxvr.render(mesh, camera, transfer, engine=C)
    second = jaxvr.render(mesh, camera, transfer)
    assert np.array_equal(second, jaxvr.render(mesh, camera, transfer, engine=XLA))
    assert np.max(np.abs(second - first)) < 1e-6


@pytest.mark.parametrize("native", [True, False])
def test_native_is_deprecated_and_goes_on_working(native):
    mesh, camera, transfer = scene()
    name = "C" if native else "XLA"
    words = re.escape(f"native={native}) is deprecated: pass engine=jaxvr.engine.{name}()")
    with pytest.warns(DeprecationWarning, match=rf"Replay\({words}") as caught:
        adjoint = jaxvr.Replay(native=native)
    assert caught[0].filename == __file__
    for draw in verbs(mesh, camera, transfer, adjoint=adjoint).values():
        assert loops_of(draw, transfer) == {name}
    with pytest.warns(DeprecationWarning, match=rf"trace\({words}"):
        segments = jaxvr.trace(mesh, camera, native=native)
    same = jaxvr.trace(mesh, camera, engine=registry.engine_of(native))
    assert np.array_equal(segments.scalar, same.scalar)
    target = jaxvr.render(mesh, camera, transfer)
    jaxvr.fit(transfer, mesh, camera, target, adjoint=adjoint, iterations=1, progress=False)
    with pytest.raises(ValueError, match="not both"):
        jaxvr.render(mesh, camera, transfer, adjoint=adjoint, engine=XLA)
    with pytest.warns(DeprecationWarning), pytest.raises(ValueError, match="not both"):
        jaxvr.trace(mesh, camera, native=native, engine=XLA)


def test_the_recipe_brings_an_engine_from_outside():
    (code,) = [c for c in blocks(ROOT / "notebooks/contribute.md", "python") if "Counting" in c]
    names: dict[str, Any] = {}
    exec(code, names)
    engine, mesh = names["engine"], names["mesh"]
    assert {"march", "pull_back", "count", "fill"} == set(engine.asked)
    image = jaxvr.render(mesh, names["camera"], names["transfer"], engine=engine)
    want = jaxvr.render(mesh, names["camera"], names["transfer"], engine=XLA)
    assert np.array_equal(image, want)
