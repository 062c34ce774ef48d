"""No history changes a result: some steps of the machine, the same ones each time.

`python -m experiments.state_machine --minutes 60` makes other ones, over more recipes.
"""

from __future__ import annotations

import sys
from pathlib import Path

import hypothesis
import pytest
from hypothesis.stateful import run_state_machine_as_test
from machine import Recipe, Scene, Worker, compute, difference, make_machine

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from experiments import state_machine


@pytest.fixture(scope="module")
def worker():
    worker = Worker()
    yield worker
    worker.close()


@pytest.mark.filterwarnings("ignore::jaxvr.ViewWarning")
def test_verbs_in_any_order(worker):
    settings = hypothesis.settings(
        max_examples=3,  # the first that hypothesis makes is the simplest there is
        stateful_step_count=7,
        deadline=None,
        derandomize=True,
        database=None,
        phases=[hypothesis.Phase.generate],
        suppress_health_check=[*hypothesis.HealthCheck],  # pyright: ignore[reportArgumentType]
    )
    count: dict[str, int] = {}
    run_state_machine_as_test(make_machine(worker, count=count), settings=settings)
    assert sum(count.values()) >= 7


def test_the_machine_can_fail(worker):
    """A picture of other numbers than the recipe's is told."""
    recipe = Recipe()
    found = compute(recipe)
    assert difference(recipe, found, worker.alone(recipe)) is None
    other = difference(recipe, compute(recipe._replace(variant=1)), worker.alone(recipe))
    assert other and "is off by" in other
    gradient = recipe._replace(verb="gradient", operands=("extinctions",))
    zero = [0 * x for x in worker.alone(gradient)]
    assert "extinctions is off" in str(difference(gradient, zero, worker.alone(gradient)))
    assert Scene(recipe).image().shape == (4, 4, 4)


def test_the_script(monkeypatch, capsys):
    count, faults = state_machine.explore(0, 0)
    assert not count and not faults
    monkeypatch.setattr(state_machine.orders, "pairs", lambda: iter([["colors", "eye", 0, 1]]))
    assert state_machine.all_orders(0, False, [None], ["float64"]) == 0
    assert "1 of 1, 0 wrong" in capsys.readouterr().out
