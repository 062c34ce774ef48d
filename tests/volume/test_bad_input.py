"""`from_cells` on arrays that went wrong at random: an error or a sound mesh, never a crash."""

import warnings

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxvr.volume import TetMesh, datasets

SOURCE = datasets.box((2, 2, 2), 0.2, cell="hexahedron", shuffle=True)
POINTS, CELLS = np.asarray(SOURCE.points), np.asarray(SOURCE.cells)
STRANGE = st.sampled_from(
    [np.nan, np.inf, -np.inf, -1, 10**12, -(2**40), "four", None, 2.5, True, 1 + 2j, [], [[1]], {}]
)


def attempt(points, cells, values, **kwargs):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # repairs
        try:
            mesh = TetMesh.from_cells(points, cells, values, **kwargs)
        except ValueError as e:
            assert len(str(e)) > 20
            return None
    rows = np.asarray(mesh.cells)
    assert rows.min() >= 0 and rows.max() < mesh.n_points
    assert np.isfinite(mesh.points).all() and np.isfinite(mesh.values).all()
    words = np.asarray(mesh.neighbors)
    c, k = np.nonzero(words >= 0)
    assert (words[words[c, k] >> 4, words[c, k] & 3] >> 4 == c).all()
    return mesh


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.data())
def test_one_strange_entry(data):
    which = data.draw(st.sampled_from(["points", "cells", "values"]))
    arrays = {"points": POINTS, "cells": CELLS, "values": np.asarray(SOURCE.values)}
    lists = arrays[which].tolist()
    row = data.draw(st.integers(0, len(lists) - 1))
    x = data.draw(STRANGE)
    if isinstance(lists[row], list) and data.draw(st.booleans()):
        lists[row][data.draw(st.integers(0, len(lists[row]) - 1))] = x
    else:
        lists[row] = x
    given_arrays = {**arrays, which: lists}
    attempt(given_arrays["points"], {"tetra": given_arrays["cells"]}, given_arrays["values"])


@settings(max_examples=40, deadline=None, derandomize=True)
@given(STRANGE, st.sampled_from(["points", "cells", "tetra", "values", "location", "dtype"]))
def test_one_strange_argument(x, where):
    args = {"points": POINTS, "cells": {"tetra": CELLS}, "values": SOURCE.values}
    if where == "tetra":
        args["cells"] = {"tetra": x}
    elif where in args:
        args[where] = x
    elif x is not None:
        attempt(**args, **{where: x})
    if where in ("points", "cells", "tetra", "values"):
        assert attempt(**args) is None


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.floats(0, 0.3))
def test_random_indices(seed, part):
    rng = np.random.default_rng(seed)
    cells = CELLS.copy()
    hit = rng.random(cells.shape) < part
    cells[hit] = rng.integers(-1 if part > 0.2 else 0, len(POINTS), int(hit.sum()))
    attempt(POINTS, {"tetra": cells}, SOURCE.values)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1))
def test_random_points_on_a_lattice_fold_weld_and_flatten(seed):
    rng = np.random.default_rng(seed)
    points = rng.integers(0, 4, POINTS.shape).astype(np.float32)
    attempt(points, {"tetra": CELLS}, SOURCE.values)
    hexes = rng.integers(0, len(POINTS), (3, 8))
    attempt(points, {"hexahedron": hexes}, SOURCE.values)
