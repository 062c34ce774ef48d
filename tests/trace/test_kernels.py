"""What the walk is compiled to: that is where its speed comes from, and where it could get lost."""

from __future__ import annotations

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvr._core.gather import load, take
from jaxvr._core.once import once
from jaxvr.trace import RayCast
from jaxvr.view.rays import Rays
from jaxvr.volume import datasets

pytestmark = pytest.mark.optimised


@pytest.mark.parametrize("location", ["point", "corner"])
def test_no_kernel_of_a_step_is_handed_to_several_threads(location):
    """A mesh that is large enough for XLA to want to: its ids alone are 1.3 MB."""
    mesh = datasets.box((24, 24, 24), dtype="float32")
    if location == "corner":
        mesh = dataclasses.replace(mesh, values=mesh.values[mesh.cells], location=location)
    tracer = RayCast()

    def walk(mesh, origins, directions):
        scene = tracer.prepare(mesh)
        rays = tracer.prepare_rays(scene, Rays(origins, directions))

        def body(carry):
            state, total = carry
            state = tracer.step(scene, rays, state, state.active)
            return state, total + state.segment.length

        start = tracer.start(scene, rays), jnp.zeros_like(origins[:, 0])
        return jax.lax.while_loop(lambda c: jnp.any(c[0].active | c[0].waiting), body, start)[1]

    rays = jax.ShapeDtypeStruct((512, 3), mesh.dtype)
    text = jax.jit(walk).lower(mesh, rays, rays).compile().as_text()
    assert text is not None
    in_step = [line for line in text.splitlines() if "raycast_step" in line]
    assert len(in_step) > 100
    # What is done once for an entry is not looked at.
    split = [
        line
        for line in in_step
        if re.search(r'outer_dimension_partitions":\["\d', line)
        and not re.search(r"raycast_step/while/body/cond", line)
    ]
    assert not split, split[0]


def test_once_is_a_conditional_in_values_and_derivatives():
    def change(carry, factor):
        number, count = carry
        return jnp.sin(number) * factor, count + 1

    def run(wanted, x, factor):
        return once(wanted, change, (x, jnp.int32(3)), factor)

    x, factor = jnp.array([0.3, 0.7]), jnp.array(2.0)
    for wanted in (jnp.array(True), jnp.array(False)):
        value, count = run(wanted, x, factor)
        want = jnp.sin(x) * factor if wanted else x
        assert np.allclose(value, want) and count == 3 + int(wanted)
        slope = jnp.cos(x) * factor if wanted else jnp.ones(2)
        by = jax.grad(lambda x, w=wanted: jnp.sum(run(w, x, factor)[0]))(x)
        along = jax.jvp(lambda x, w=wanted: run(w, x, factor)[0], (x,), (jnp.ones(2),))[1]
        assert np.allclose(by, slope) and np.allclose(along, slope)
    both = jax.vmap(lambda w: run(w, x, factor)[0])(jnp.array([True, False]))
    assert np.allclose(both, [jnp.sin(x) * factor, x])


def test_load_gathers_and_is_differentiable():
    table, index = jnp.arange(10.0), jnp.array([[3, 1, 3], [0, 9, 2]])

    def run(table, wanted=True):
        return load(jnp.array(wanted), take, table, index)

    assert np.array_equal(run(table), table[index])
    assert run(table, False).shape == index.shape
    by = jax.grad(lambda t: jnp.sum(run(t) * jnp.array([[1.0, 2, 3], [4, 5, 6]])))(table)
    assert np.array_equal(by, [4, 2, 6, 4, 0, 0, 0, 0, 0, 5])
    both = jax.vmap(run)(jnp.stack([table, -table]))
    assert np.array_equal(both, [table[index], -table[index]])
