"""Gradients do not depend on what was differentiated before, nor on which pullbacks are alive.

Each gradient alone against itself in company: see `orders`. What is compiled follows from what is
traced, so most programs are only traced here; `python -m experiments.state_machine --orders 200
--run` runs more of them, on both engines and in both precisions, and compares bits.
"""

from __future__ import annotations

import importlib
import pkgutil
from typing import Any

import jax
import numpy as np
import orders
import pytest
import registry

import jaxvr
from jaxvr.adjoint import replay


@pytest.fixture(scope="module")
def compiled():
    """The scene with compiled loops, and what its pullbacks compute alone."""
    scene = orders.Scene("float64", None)
    return scene, orders.alone(scene.trace)


def test_patterns_can_be_told_apart(compiled):
    assert len(set(compiled[1].values())) == len(orders.NAMES)


@pytest.mark.parametrize("first", orders.NAMES)
def test_all_ordered_pairs_alive_at_once(compiled, first):
    """Both made, then called: the second must not leave its flags to the first."""
    scene, alone = compiled
    for program in (p for p in orders.pairs() if p[0] == first):
        assert not orders.wrong(program, scene.trace(program), alone), program


@pytest.mark.parametrize("program", list(orders.sequences(2)), ids=str)
def test_random_sequences_of_six(compiled, program):
    scene, alone = compiled
    assert not orders.wrong(program, scene.trace(program), alone)


def test_loops_of_jax():
    scene = orders.Scene("float32", False)
    program = ["extinctions", "values", 0]
    alone = orders.alone(scene.trace, ("extinctions",))
    assert not orders.wrong(program, scene.trace(program), alone)


def test_to_the_bit():
    scene = orders.Scene("float32", None)
    program = ["extinctions", "values", 0]
    found = scene.run(program)
    alone = orders.alone(scene.run, ("extinctions",))
    assert not orders.wrong(program, found, alone)
    assert any(np.frombuffer(x, "float32").any() for x in found[0])


# --- the rule behind it -------------------------------------------------------------------------


def rules() -> dict[str, Any]:
    """Every function of the package with a `custom_vjp`, by its dotted name."""
    found = {}
    for module in pkgutil.walk_packages(jaxvr.__path__, "jaxvr."):
        if module.name.endswith("__main__"):
            continue
        for name, thing in vars(importlib.import_module(module.name)).items():
            if isinstance(thing, jax.custom_vjp) and thing.__module__ == module.name:
                found[f"{module.name}.{name}"] = thing
    return found


def arguments_of_replay(native: bool) -> tuple[tuple[Any, ...], Any]:
    """What `render` hands to `_replay`: its static arguments, and the operands."""
    handed: list[Any] = []

    def catch(engine, structure, leaves):
        handed.append((engine, structure, jax.tree.map(jax.typeof, leaves)))
        return rule(engine, structure, leaves)

    rule = replay._replay
    mesh = registry.mesh_of("point", "float64")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(replay, "_replay", catch)
        jax.clear_caches()
        transfer, camera = registry.transfer_of("float64"), registry.camera_of("float64")
        how = registry.engine_of(native)
        jax.eval_shape(lambda m: jaxvr.render(m, camera, transfer, engine=how), mesh)
        jax.clear_caches()
    ((*static, operands),) = handed
    return tuple(static), operands


# How each rule is called; a new one is one line here.
CALLS = {"jaxvr.adjoint.replay._replay": arguments_of_replay}


def test_every_rule_is_held():
    assert set(rules()) == set(CALLS)


@pytest.mark.parametrize("native", [True, False])
@pytest.mark.parametrize("name", list(CALLS))
def test_residuals_depend_on_the_structure_of_arguments_alone(name, native):
    """Their structure, their number, and which of them are arguments: whatever is perturbed. JAX
    keeps one trace for each pattern of perturbed leaves, but of these three only the latest."""
    static, operands = CALLS[name](native)
    rule = rules()[name]
    leaves, structure = jax.tree.flatten(operands)
    floats = [i for i, x in enumerate(leaves) if np.issubdtype(x.dtype, np.floating)]
    assert len(floats) > 3
    patterns = [{i} for i in floats] + [set(floats), set()]

    def look(perturbed: set[int]):
        seen: list[Any] = []

        def forward(*arrays):
            primals = [
                jax.custom_derivatives.CustomVJPPrimal(x, i in perturbed)
                for i, x in enumerate(arrays)
            ]
            _, residuals = rule.fwd(*static, structure.unflatten(primals))
            seen.append(jax.tree.structure(residuals))
            return jax.tree.leaves(residuals)

        jaxpr = jax.make_jaxpr(forward)(*leaves).jaxpr
        number = {id(v): i for i, v in enumerate(jaxpr.invars)}
        return seen[0], [number.get(id(v)) for v in jaxpr.outvars]

    first = look(patterns[0])
    assert any(i is not None for i in first[1])
    for perturbed in patterns[1:] if native else patterns[-2:]:
        assert look(perturbed) == first, f"{name} with the leaves {perturbed} perturbed"
