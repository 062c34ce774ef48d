"""Playing segments back, in both directions: which segments, in which order, and what is new."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvr.trace import Recorded
from jaxvr.trace.recorded import Nodes, Runs

# Three rays: two segments, a jump, one more; none; and one that leaves the mesh and comes back.
SCALAR = jnp.asarray([0.1, 0.2, 0.3, 0.7, 0.9, 0.4, 0.5, 0.6, 0.8])
LENGTH = jnp.asarray([0.0, 1.0, 2.0, 0.0, 3.0, 0.0, 4.0, 0.0, 5.0])
RUNS = Runs(jnp.asarray([0, 5, 5]), jnp.asarray([5, 5, 9]))
# front, back, length, fresh
FORWARDS = [
    [(0.1, 0.2, 1, True), (0.2, 0.3, 2, False), (0.7, 0.7, 0, True), (0.7, 0.9, 3, False)],
    [],
    [(0.4, 0.5, 4, True), (0.6, 0.6, 0, True), (0.6, 0.8, 5, False)],
]
BACKWARDS = [
    [(0.9, 0.7, 3, True), (0.7, 0.7, 0, False), (0.3, 0.2, 2, True), (0.2, 0.1, 1, False)],
    [],
    [(0.8, 0.6, 5, True), (0.6, 0.6, 0, False), (0.5, 0.4, 4, True)],
]


@pytest.mark.parametrize("tracer, want", [(Recorded(), FORWARDS), (Recorded(True), BACKWARDS)])
def test_segments_in_order(tracer, want):
    scene = Nodes(SCALAR, LENGTH)
    step = jax.jit(lambda state, move: tracer.step(scene, RUNS, state, move))
    state, found, turn = tracer.start(scene, RUNS), [[], [], []], 0
    move = state.active
    while np.any(state.active | state.waiting):
        state = step(state, move)
        for ray in np.flatnonzero(move | (turn == 0)):
            if state.active[ray]:
                values = (*state.segment, state.fresh)
                found[ray].append(tuple(np.asarray(x)[ray].item() for x in values))
        # Rays go at their own pace: each waits at every third turn.
        turn += 1
        move = state.active & ((np.arange(3) + turn) % 3 != 0)
        assert not np.any(np.where(state.active, 0, state.segment.length))
    assert found == want


def test_reversed_twice_is_the_same():
    assert Recorded().reversed() == Recorded(reverse=True)
    assert Recorded().reversed().reversed() == Recorded()
