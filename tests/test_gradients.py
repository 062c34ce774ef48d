"""Gradients of every parameter class against differences, and adjoint against adjoint.

The problem, its hard cases and the differences are those of `experiments/gradients.py`; compiled
functions are shared by all tests of a location.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from experiments import gradients

LOSSES = gradients.losses
KNOWN: dict[tuple[Any, ...], Any] = {}


def losses(location: str, dtype: str) -> dict[str, Callable]:
    """`Direct` and `Forward` walk by JAX's loops whatever `Replay` does: what they give is computed
    once, for either loops of the module."""
    found = LOSSES(location, dtype)

    def once(name: str) -> Callable:
        def call(*trees):
            arrays = ((k, np.asarray(x).tobytes()) for tree in trees for k, x in tree.items())
            key = (location, dtype, name, *arrays)
            if key not in KNOWN:
                KNOWN[key] = found[name](*trees)
            return KNOWN[key]

        return call

    return {**found, **{name: once(name) for name in ("direct", "forward")}}


@pytest.fixture(autouse=True)
def compute_once(monkeypatch):
    monkeypatch.setattr(gradients, "losses", losses)


pytestmark = pytest.mark.usefixtures("loops", "quick_jit")

HARD = ("plain", "eye inside", "jump", "extinction 0", "constant field", "depth 1e4")


def _hold(found: dict[str, dict[str, float]], differences: float = 1e-7) -> None:
    for name, r in found.items():
        assert r["finite"], name
        assert r["difference"] <= differences, (name, r)
        if "direct" in r:
            assert r["direct"] <= 1e-12, (name, r)
            assert r["forward"] <= 1e-12, (name, r)


@pytest.mark.parametrize("case", [*HARD, "point at vertex value"])
def test_point_data(case):
    p, keywords = gradients.cases("point")[case]
    _hold(gradients.check("point", p, repeats=1, **keywords))


@pytest.mark.parametrize("case", ["plain", "depth 1e4"])
def test_cell_data(case):
    p, keywords = gradients.cases("cell")[case]
    _hold(gradients.check("cell", p, repeats=1, adjoints=False, **keywords))


@pytest.mark.parametrize("loops", ["compiled"], indirect=True, scope="module")
def test_corner_data(loops):
    """JAX's loops have the same gradients by points, values, transfer function and camera of such
    data, to 1e-9: test_registry."""
    p, keywords = gradients.cases("corner")["plain"]
    _hold(gradients.check("corner", p, repeats=1, adjoints=False, **keywords))


def test_opaque_cell_hides_what_is_behind():
    """A cell of depth 1e4: nothing behind it has a gradient, and all is finite."""
    p, _ = gradients.cases("cell")["depth 1e4"]
    p = {**p, "values": np.full_like(p["values"], 2.0)}
    gradient = gradients.losses("cell", "float64")["replay"](p)
    assert all(np.isfinite(g).all() for g in gradient.values())
    # only the first cells on the rays are seen
    assert np.count_nonzero(np.abs(gradient["values"]) > 1e-30) <= 40
    np.testing.assert_array_equal(gradient["colors"][:9], 0)


def test_jump_drawn_apart_has_the_one_sided_derivative():
    p, _ = gradients.cases("point")["jump"]
    f = gradients.losses("point", "float64")
    v = np.zeros(11)
    v[7], v[8] = -1.0, 1.0
    found, _ = gradients.difference(f["value"], p, {"positions": v}, 1e-4, True)
    along = float(f["replay"](p)["positions"] @ v)
    assert abs(along - found) <= 1e-5 * abs(along)


def test_float32_against_float64_at_depth_11():
    mesh = gradients.make_mesh("point", "float64")
    errors = gradients.single_precision("point", gradients.make_parameters(mesh, depth=11.0))
    assert max(errors.values()) <= 1e-4, errors
