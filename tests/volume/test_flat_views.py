"""What goes by faces and cells of a mesh, on meshes with cells that have no volume: fragments of
its boundary, the exact order, and better cells, with nothing counted twice or lost."""

from __future__ import annotations

import flat_meshes as flat
import numpy as np
import pytest

import jaxvr
from jaxvr.order import exact_order
from jaxvr.volume import TetMesh, packing
from jaxvr.volume.connectivity import FACES
from jaxvr.volume.geometry import signed_volumes

pytestmark = pytest.mark.usefixtures("quick_code")

SIZE = {"width": 12, "height": 12}
SHAPES = {
    "lattice": lambda: flat.lattice(4),
    "lattice, jitter 1e-7": lambda: flat.lattice(4, 1e-7),
    "slivers": lambda: flat.slivers(4),
    "prisms": lambda: flat.prisms(5, 2),
}


def mesh_of(name, dtype):
    shape = SHAPES[name]()
    with pytest.warns(UserWarning, match="flat"):
        mesh = TetMesh.from_cells(
            shape.points, {"tetra": shape.cells}, shape.points @ [1.0, 0.3, 0.2], dtype=dtype
        )
    assert mesh.report.flat > 5
    return mesh, shape


@pytest.mark.parametrize("name", SHAPES)
def test_the_boundary_is_crossed_in_pairs(name, dtype):
    """Rays of a lattice's own directions run in its faces and edges; chords are the hull's."""
    mesh, shape = mesh_of(name, dtype)
    words = np.asarray(mesh.boundary)
    triangles = np.asarray(mesh.cells)[packing.cell_of(words)[:, None], FACES[words & 3]]
    low, high = np.asarray(mesh.points).min(0), np.asarray(mesh.points).max(0)
    middle, size = (low + high) / 2, float((high - low).max())
    camera = jaxvr.Camera.orthographic(
        middle + [0, 0, 2 * size], middle, extent=1.2 * size, dtype=dtype, **SIZE
    )
    found = jaxvr.rasterize(mesh.points, triangles, camera)
    pixel, depth = np.asarray(found.pixel), np.asarray(found.depth, float)
    count = np.bincount(pixel, minlength=144)
    assert (count % 2 == 0).all() and (count > 0).sum() > 30
    planes = flat.hull_planes(shape.points)
    origins, directions = (np.asarray(x, float).reshape(-1, 3) for x in camera.rays())
    chords = flat.hull_chords(planes, origins, directions)
    far, near = np.full(144, -np.inf), np.full(144, np.inf)
    np.maximum.at(far, pixel, depth)
    np.minimum.at(near, pixel, depth)
    seen = count > 0
    tolerance = 1e-6 if dtype == "float32" else 1e-12
    # Of a ray that only touches the hull, rounding decides whether it meets it.
    assert chords[~seen].max(initial=0.0) <= tolerance
    np.testing.assert_allclose((far - near)[seen], chords[seen], rtol=0, atol=tolerance * size)


@pytest.mark.parametrize("name", SHAPES)
def test_the_exact_order_leaves_two_entries(name, dtype):
    """All neighbours come out side by side, flat or not, so two entries give the picture."""
    mesh, _ = mesh_of(name, dtype)
    camera = jaxvr.Camera.orbit(mesh, azimuth=33, elevation=21, **SIZE)
    transfer = jaxvr.default_transfer(mesh)
    order = exact_order(mesh, camera)
    assert order.cycles == 0
    tracer = jaxvr.KBuffer(k=2, order=order)
    found, status = jaxvr.render(mesh, camera, transfer, tracer=tracer, status=True)
    want = jaxvr.render(mesh, camera, transfer)
    assert not np.asarray(status).any() and want[..., 3].max() > 0.3
    np.testing.assert_allclose(found, want, rtol=0, atol=1e-6 if dtype == "float32" else 1e-14)


@pytest.mark.parametrize("name", SHAPES)
def test_better_cells_fill_the_same_volume(name):
    mesh, _ = mesh_of(name, "float64")
    better = jaxvr.refine(mesh)
    before, after = (
        signed_volumes(np.asarray(m.points, float), np.asarray(m.cells))[0] for m in (mesh, better)
    )
    assert abs(after).sum() == pytest.approx(abs(before).sum(), rel=1e-12)
    assert better.report.folded == better.report.one_sided == 0
    camera = jaxvr.Camera.orbit(mesh, azimuth=33, elevation=21, **SIZE)
    transfer = jaxvr.default_transfer(mesh)
    want, found = (jaxvr.render(m, camera, transfer) for m in (mesh, better))
    np.testing.assert_allclose(found, want, rtol=0, atol=1e-12)  # the field is linear
