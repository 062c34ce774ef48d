"""No history changes a result: some steps of the machine, the same ones each time.

`python -m experiments.state_machine --minutes 60` makes other ones, over more recipes.
"""

from __future__ import annotations

import hypothesis
import pytest
from hypothesis.stateful import run_state_machine_as_test
from machine import Recipe, Scene, Worker, compute, difference, make_machine


@pytest.fixture(scope="module")
def worker():
    worker = Worker()
    yield worker
    worker.close()


@pytest.mark.filterwarnings("ignore::jaxvr.ViewWarning")
def test_verbs_in_any_order(worker):
    settings = hypothesis.settings(
        max_examples=4,
        stateful_step_count=8,
        deadline=None,
        derandomize=True,
        database=None,
        phases=[hypothesis.Phase.generate],
        suppress_health_check=[*hypothesis.HealthCheck],  # pyright: ignore[reportArgumentType]
    )
    count: dict[str, int] = {}
    run_state_machine_as_test(make_machine(worker, count=count), settings=settings)
    assert sum(count.values()) >= 16


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
