"""Rays that meet the boundary in its edges and vertices."""

import numpy as np
import pytest

from jaxvr.order import exact_order, gaps
from jaxvr.view import Camera
from jaxvr.volume import datasets, packing
from jaxvr.volume.connectivity import FACES


@pytest.mark.parametrize("forward", [(0, 0, 1), (0, 0, -1), (1, 0, 0), (1, 1, 0)])
def test_rays_along_edges_and_faces(forward):
    """Rays through the vertices and edges of a lattice cross the boundary in and out by turns."""
    mesh = datasets.box((2, 2, 2))
    middle = np.full(3, 0.5)
    up = (0, 1, 0) if forward[1] == 0 else (0, 0, 1)
    at = middle - 3 * np.array(forward)
    for camera in (
        Camera.orthographic(at, middle, up, extent=2.5, width=5, height=5, dtype="float64"),
        Camera.look_at(at, middle, up, fov=50.0, width=5, height=5, dtype="float64"),
    ):
        view = gaps.look(mesh, camera)
        words = np.asarray(mesh.boundary)
        cell, corner = packing.cell_of(words), packing.corner_of(words)
        faces = np.asarray(mesh.cells)[cell[:, None], FACES[corner]]
        pixel, face, depth, positive = gaps.draw(view, faces, np.asarray(mesh.duplicates))
        entry = positive != (packing.flag_of(words[face]) == 1)
        entries = np.bincount(pixel[entry], minlength=25)
        assert np.array_equal(entries, np.bincount(pixel[~entry], minlength=25))
        assert set(entries) == {0, 1} and entries[12] == 1
        assert (depth[entry].max() < depth[~entry].min()) and exact_order(mesh, camera).cycles == 0
