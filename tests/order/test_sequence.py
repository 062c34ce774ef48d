"""Nearly sorted sequences, and the k-buffer's entries against brute force."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvr.order import sequence as seq


def test_examples_of_the_paper():
    values = [0.6, 0.2, 0.3, 0.5, 0.4]
    assert seq.exactly_sorted(values).tolist() == [5, 1, 2, 4, 3]
    assert seq.displacement(values, (4, 2, 1, 5, 3)) == 1
    assert seq.displacement(values, (3, 1, 4, 5, 2)) == 2
    assert seq.displacement(values) == 4
    assert seq.is_k_nearly_sorted(values, 4) and not seq.is_k_nearly_sorted(values, 3)


def test_equal_values_keep_their_order():
    assert seq.exactly_sorted([2.0, 1.0, 2.0, 1.0]).tolist() == [3, 1, 4, 2]
    assert seq.displacement([1.0, 1.0, 1.0]) == 0


def test_moved_counts_insertions():
    assert seq.moved([3.0, 1.0, 2.0, 2.0, 0.0]).tolist() == [0, 1, 1, 1, 4]
    # no fragment, wherever that stands
    assert seq.moved([np.inf, 3.0, np.inf, 1.0]).tolist() == [0, 0, 0, 1]


def smallest_k(depths):
    wanted = sorted(depths)
    wanted = list(zip(wanted[:-1], wanted[1:], strict=True))
    right = [k for k in range(1, len(depths) + 2) if seq.kbuffer_sort(depths, k) == wanted]
    assert right == list(range(right[0], len(depths) + 2)), "a larger buffer is never worse"
    return right[0]


@pytest.mark.parametrize("n", range(1, 7))
def test_entries_needed_is_the_smallest_k(n):
    streams = np.array(list(itertools.permutations(range(n))), float).reshape(-1, n)
    needed = seq.entries_needed(streams)
    assert needed.tolist() == [smallest_k(s) for s in streams.tolist()]
    # max(moved) + 1 is one too many exactly where only the closest fragment is that late
    late = seq.moved(streams)
    most = late.max(-1, keepdims=True)
    others = np.where(streams == 0, 0, late).max(-1)
    assert (needed == most[:, 0] + np.where(others < most[:, 0], 0, 1)).all()
    assert (most[:, 0] <= seq.displacement(streams)).all()


def test_entries_needed_where_depths_are_equal():
    streams = np.array(list(itertools.product(range(3), repeat=6)), float)
    assert seq.entries_needed(streams).tolist() == [smallest_k(s) for s in streams.tolist()]


def test_late_is_what_counts():
    early = [9.0, *range(9)]  # the farthest comes first
    assert seq.displacement(early) == 9 and seq.entries_needed(early) == 2
    assert seq.entries_needed([2.0, 1.0]) == 1
    assert seq.entries_needed([np.inf, 3.0, np.inf, 2.0, np.inf, 1.0, np.inf]) == 2


def test_same_under_jit():
    streams = np.random.default_rng(0).permuted(np.tile(np.arange(9.0), (5, 1)), axis=1)
    for f in (seq.exactly_sorted, seq.displacement, seq.moved, seq.entries_needed):
        for depths in (streams, streams[0]):
            assert np.array_equal(jax.jit(f)(jnp.asarray(depths)), f(depths)), f


def test_a_buffer_without_entries():
    with pytest.raises(ValueError, match="at least one entry"):
        seq.kbuffer_sort([1.0], 0)
