"""Gradients do not depend on what was differentiated before, nor on which pullbacks are alive.

Each gradient alone, after all others, and interleaved with them: see `orders`. What is compiled
follows from what is traced, so most orders are only traced; `experiments/state_machine.py --orders`
runs them all to the bits, with random sequences of six.
"""

from __future__ import annotations

import gc
from typing import Any

import jax
import numpy as np
import orders
import pytest

import jaxvr


@pytest.fixture(scope="module", params=["compiled", "jax"])
def native(request) -> bool | None:
    return None if request.param == "compiled" else False


@pytest.fixture(scope="module")
def scene(native):
    return orders.Scene("float64" if native is None else "float32", native)


@pytest.fixture(scope="module")
def alone(scene):
    return scene.traced_alone()


def test_all_ordered_pairs_of_pullbacks_alive_at_once():
    """Made in one order and called in it: the second must not leave its flags to the first."""
    scene = orders.Scene("float64", None)
    alone = scene.traced_alone()
    assert len(set(alone.values())) == len(orders.NAMES)  # they can be told apart
    for pair in orders.pairs():
        assert not orders.wrong(pair, scene.traced(pair, (0, 1)), alone), pair
