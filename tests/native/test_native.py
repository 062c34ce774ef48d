"""Compiled loops beside JAX's own: the same images, segments and gradients, and what happens where
they cannot be used. That they agree for all kinds of field and derivatives is in test_registry."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import registry

import jaxvr
from jaxvr import native
from jaxvr.numerics.rules import rule_for, thin_rule

pytestmark = pytest.mark.usefixtures("quick_jit")

ENGINES = [jaxvr.engine.C(), jaxvr.engine.XLA()]
EPS = {"float32": 5e-7, "float64": 1e-14}


def both(function):
    """`function(engine)` with compiled loops and without."""
    return [function(engine) for engine in ENGINES]


def test_the_default_is_compiled(dtype):
    """Where nothing is asked for, and not only where it is."""
    assert native.missing(dtype) is None
    mesh, camera = registry.mesh_of("point", dtype), registry.camera_of(dtype)

    def loss(transfer):
        return jaxvr.render(mesh, camera, transfer).sum()

    code = jax.jit(jax.grad(loss)).lower(registry.transfer_of(dtype)).as_text()
    for name in ("render", "render_pull"):
        assert f"@jaxvr_{name}_{dtype}" in code
    assert "stablehlo.while" not in code


@pytest.fixture(scope="module")
def layers():
    """Twelve plates with gaps between them: a ray enters more often than one search keeps."""
    corners = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
    plate = np.array([(x, y, z + up) for up in (0, 1) for x, y, z in corners], float)
    points = np.concatenate([plate + [0, 0, 1.5 * k] for k in range(12)])
    cells = {"hexahedron": np.arange(96).reshape(12, 8)}
    values = points.sum(1) / points.sum(1).max()
    return jaxvr.TetMesh.from_cells(points, cells, values, location="point", dtype="float64")


def test_a_ray_with_more_entries_than_a_search_keeps(layers):
    transfer = registry.transfer_of("float64").scaled(0.1)
    rng = np.random.default_rng(0)
    origins = np.concatenate([rng.uniform(0.2, 0.8, (50, 2)), np.full((50, 1), -1.0)], 1)
    directions = np.concatenate([rng.normal(0, 0.01, (50, 2)), np.ones((50, 1))], 1)
    segments = [jaxvr.trace(layers, (origins, directions), engine=n) for n in ENGINES]
    assert np.array_equal(segments[0].start, segments[1].start)
    assert segments[0].count > 50 * 12 * 2
    np.testing.assert_allclose(segments[0].scalar, segments[1].scalar, atol=1e-14)
    np.testing.assert_allclose(segments[0].length, segments[1].length, atol=1e-14)
    images = both(lambda n: jaxvr.render_rays(layers, origins, directions, transfer, engine=n))
    np.testing.assert_allclose(images[0], images[1], atol=1e-14)


def test_rays_of_all_directions_in_one_packet(dtype):
    """Packets are cut by the rays' largest component, and blocks that are not full are filled."""
    mesh, transfer = registry.mesh_of("point", dtype), registry.transfer_of(dtype)
    directions = np.random.default_rng(1).normal(size=(333, 3)).astype(dtype)
    origins = np.array([0.4, 0.55, 0.6], dtype) - directions * np.array(
        [[0.0], [3.0], [-2.0]] * 111
    )
    images = both(
        lambda n: jaxvr.render_rays(mesh, origins.astype(dtype), directions, transfer, engine=n)
    )
    np.testing.assert_allclose(images[0], images[1], atol=EPS[dtype])
    assert np.asarray(images[0])[::3, 3].min() > 0  # from inside


@pytest.mark.parametrize("extinction", [1e-6, 1.0, 30.0, 1e4])
@pytest.mark.filterwarnings("ignore::jaxvr.hints.ViewWarning")
def test_thin_and_opaque_cells(extinction, dtype):
    """On both sides of where the rule of few nodes ends."""
    mesh, camera = registry.mesh_of("point", dtype), registry.camera_of(dtype)
    transfer = registry.transfer_of(dtype).scaled(extinction)
    found = both(lambda n: jaxvr.render(mesh, camera, transfer, engine=n))
    # Relative where all is thin, else to the rounding of what the cells in front let through.
    scale = float(np.max(found[1]))
    np.testing.assert_allclose(
        *found, rtol=1e-6 if dtype == "float32" else 1e-12, atol=EPS[dtype] * scale
    )


def test_the_rule_for_thin_slabs(dtype):
    """Its moments against those of the full rule in float64, at the corners and inside."""
    rng = np.random.default_rng(0)
    rule, truth = thin_rule(dtype), rule_for(np.dtype("float64"))
    corners = np.array([(x, y) for x in (0, 1) for y in (0, 1)], float)
    a, b = rule.depth * np.concatenate([corners, rng.uniform(0, 1, (1000, 2))]).T

    def moments(rule):
        u, weights = np.array(rule.nodes), np.array(rule.weights)
        t = np.exp(-(a[:, None] * (u - u * u / 2) + b[:, None] * (u * u / 2)))
        return np.stack([(t * weights) @ f for f in ((1 - u) ** 2, 2 * u * (1 - u), u * u)])

    error = np.abs(moments(rule) / moments(truth) - 1).max()
    assert error < (6e-8 if dtype == "float32" else 2e-15)


def test_gradients_are_the_same_each_time():
    """The order of sums does not depend on which thread comes first."""
    mesh, camera = registry.mesh_of("point", "float32"), registry.camera_of("float32")
    camera = jaxvr.Camera.look_at(camera.eye, camera.target, fov=32.0, width=64, height=64)
    loss = jax.jit(
        jax.grad(lambda t, v: (jaxvr.render(mesh.replace(values=v), camera, t)).sum(), (0, 1))
    )
    runs = [jax.tree.leaves(loss(registry.transfer_of("float32"), mesh.values)) for _ in range(3)]
    for run in runs[1:]:
        for x, y in zip(run, runs[0], strict=True):
            assert np.array_equal(x, y)


def test_under_vmap_and_jit():
    mesh, camera = registry.mesh_of("point", "float64"), registry.camera_of("float64")
    transfer = registry.transfer_of("float64")
    scales = jnp.array([0.5, 2.0])

    def image(scale):
        return jaxvr.render(mesh, camera, transfer.scaled(scale), engine=jaxvr.engine.C())

    at_once = jax.jit(jax.vmap(image))(scales)
    np.testing.assert_allclose(at_once, jnp.stack([image(s) for s in scales]), atol=1e-15)


def test_what_they_do_not_cover_is_left_to_jax_or_said():
    mesh, camera = registry.mesh_of("point", "float64"), registry.camera_of("float64")
    transfer = registry.transfer_of("float64")
    with pytest.raises(ValueError, match="Quadrature"):
        jaxvr.render(
            *(mesh, camera, transfer),
            integrator=jaxvr.Quadrature(),
            engine=jaxvr.engine.C(),
        )
    assert native.missing("float16") is not None


BROKEN = """
import warnings
import jax
import jaxvr
from jaxvr import native
with warnings.catch_warnings(record=True) as said:
    warnings.simplefilter("always")
    reason = native.missing()
assert {reason!r} in reason, reason
assert [w.category.__name__ for w in said] == {categories}, said
mesh = jaxvr.datasets.box((1, 1, 1), dtype="float32")
camera = jaxvr.Camera.orbit(mesh, width=4, height=4)
transfer = jaxvr.default_transfer(mesh)
code = jax.jit(lambda m: jaxvr.render(m, camera, transfer)).lower(mesh).as_text()
assert "stablehlo.while" in code and "@jaxvr_" not in code
try:
    jaxvr.trace(mesh, camera, engine=jaxvr.engine.C())
except ValueError as error:
    assert {reason!r} in str(error)
else:
    raise AssertionError
"""


@pytest.mark.parametrize(
    "environment, reason, categories",
    [
        ({"JAXVR_NATIVE": "0"}, "JAXVR_NATIVE=0", "[]"),
        ({"JAXVR_CC": "false"}, "failed", "['RuntimeWarning']"),
        ({"JAXVR_CC": "no-such-compiler"}, "could not be made", "['RuntimeWarning']"),
    ],
)
def test_without_a_library(environment, reason, categories, tmp_path, monkeypatch):
    """In a process of its own: switched off, and with compilers that fail, JAX's loops serve."""
    monkeypatch.setenv("JAXVR_CACHE", str(tmp_path))
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    script = BROKEN.format(reason=reason, categories=categories)
    subprocess.run([sys.executable, "-c", script], check=True)


def test_library_is_built_once(tmp_path, monkeypatch):
    monkeypatch.setenv("JAXVR_CACHE", str(tmp_path))
    first = native.build.build("float32")
    made = first.stat().st_mtime_ns
    assert native.build.build("float32") == first
    assert first.stat().st_mtime_ns == made
    assert [p.name for p in tmp_path.iterdir()] == [first.name]


def test_a_budget_does_not_change_the_image(dtype):
    mesh, camera = registry.mesh_of("point", dtype), registry.camera_of(dtype)
    transfer = registry.transfer_of(dtype)
    engine = jaxvr.engine.XLA()
    whole = jaxvr.render(mesh, camera, transfer, engine=engine)
    parts = jaxvr.render(mesh, camera, transfer, engine=engine, budget=7 * 212 * 8)
    np.testing.assert_allclose(whole, parts, atol=EPS[dtype])
    bad: list[Any] = [0, -5, "1 GB", float("inf"), float("nan")]
    for budget in bad:
        with pytest.raises(ValueError, match="budget must be a number of bytes"):
            jaxvr.render(mesh, camera, transfer, budget=budget)
