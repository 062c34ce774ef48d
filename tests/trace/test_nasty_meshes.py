"""The meshes, rays and transfer functions on which renderers fail, by all tracers, against brute
force. All meshes stand in one, side by side, so that few functions are compiled."""

from __future__ import annotations

import functools
import warnings

import numpy as np
import pytest

import jaxvr
from jaxvr import testing
from jaxvr.volume import TetMesh

pytestmark = pytest.mark.usefixtures("quick_code")

# A ray along cells 1e-12 high asks for all digits that there are near 0: that mesh stays there.
ALONE = "lattice 1e-12"
NAMES = [name for name in testing.MESHES if name not in (*testing.FOLDED, ALONE)]
# In no row or diagonal of a cube's, and at powers of two, which round no coordinate away.
PLACES = 8.0 * np.array([(k % 4, (k // 4 + 2 * k) % 5, (3 * k) % 7) for k in range(len(NAMES))])
# The thinnest of them is 1e-4 high, and stands where coordinates are 32 and more: differences of
# two of them are rounded by 2^-48 (in float32 it is not told from a plane, but rays agree there).
ATOL = {"float32": None, "float64": 4 * 2.0**-48 / 1e-4}
BOTH = ("two points", "many points")
# A k-buffer's segments do not depend on the transfer function, and forty entries take time.
TRACERS = {
    "RayCast": (None, None, BOTH),
    "RayCast, loops of JAX": (None, jaxvr.engine.XLA(), BOTH),
    "KBuffer": (jaxvr.KBuffer(k=40), None, BOTH[1:]),
}


@functools.cache
def everything(dtype: str) -> TetMesh:
    points, cells, values, count = [], [], [], 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of cells that are flat, or were turned round
        for mesh, place in zip(testing.nasty_meshes(dtype, NAMES).values(), PLACES, strict=True):
            points.append(np.asarray(mesh.points, "float64") + place)
            cells.append(np.asarray(mesh.cells) + count)
            values.append(np.asarray(mesh.values, "float64"))
            count += mesh.n_points
        return TetMesh.from_cells(
            np.concatenate(points),
            {"tetra": np.concatenate(cells)},
            np.concatenate(values),
            location="point",
            dtype=dtype,
        )


@functools.cache
def rays(dtype: str):
    origins, directions = [], []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for mesh, place in zip(testing.nasty_meshes(dtype, NAMES).values(), PLACES, strict=True):
            for o, d in testing.nasty_rays(mesh, count=2).values():
                origins.append((o + place).astype(dtype))
                directions.append(d.astype(dtype))
    return np.concatenate(origins), np.concatenate(directions)


@pytest.mark.parametrize("tracer", TRACERS)
def test_against_brute_force(tracer, dtype):
    how, engine, names = TRACERS[tracer]
    transfers = testing.nasty_transfers(dtype=dtype)
    for name in names:
        worst = testing.assert_render_close(
            *(everything(dtype), rays(dtype), transfers[name]),
            tracer=how,
            engine=engine,
            atol=ATOL[dtype],
        )
        assert worst > 0


def test_where_it_is(dtype):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of cells that are flat
        mesh = testing.nasty_meshes(dtype, [ALONE])[ALONE]
    rays = [
        np.concatenate(x) for x in zip(*testing.nasty_rays(mesh, count=2).values(), strict=True)
    ]
    for name in ("two points", "many points"):
        transfer = testing.nasty_transfers(dtype=dtype)[name]
        assert testing.assert_render_close(mesh, tuple(rays), transfer) > 0
