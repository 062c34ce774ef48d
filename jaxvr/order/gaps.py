"""Where rays leave a mesh and enter it again: the A-buffer of its boundary faces.

The cell of an exit comes before that of the next entry. SXMPVO (Cook, Max, Silva and Williams,
"Image-space visibility ordering for cell projection volume rendering of unstructured data", 2004)
finds these relations by drawing the boundary faces into an A-buffer: they hold for the pixels,
which is all that an image needs.

Here exits and entries of a pixel are paired by counting them from the last ones, not by looking for
an exit that an entry follows in a list sorted by depth. Rays end outside, so between entry i and
entry i + 1 from the end there is exit i + 1 from the end, also if an eye inside has no first entry,
and also where surfaces touch and rounding decides which is closer. On the host, in float64.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxvr._core.units import norm, scaled_to_one
from jaxvr.view import Camera
from jaxvr.volume import TetMesh, packing
from jaxvr.volume.connectivity import FACES

_PIXELS = 1 << 20  # at once, where faces are drawn


class View(NamedTuple):
    """points (P, 3): float64, over 2**exponent, which brings them and the eye below 1. eye (3,).
    towards (3,): where parallel rays come from; None for a pinhole. axes (3, 3): right, up,
    forward. place (2, width * height): where pixel centres are, as slopes (pinhole) or lengths, on
    the first two axes. half (2,): half the size of the image there."""

    points: np.ndarray
    eye: np.ndarray
    towards: np.ndarray | None
    axes: np.ndarray
    place: np.ndarray
    half: np.ndarray
    width: int
    height: int


def look(mesh: TetMesh, camera: Camera) -> View:
    """Rays are the camera's own, with the roundings that they have."""
    camera = camera.relative_to(mesh.origin, np.promote_types(camera.dtype, mesh.dtype))
    origins, directions = (np.asarray(x, np.float64).reshape(-1, 3) for x in camera.local_rays())
    points, eye = np.asarray(mesh.points, np.float64), np.asarray(camera.eye, np.float64)
    size = max(float(np.abs(points).max()), float(np.abs(eye).max()))
    exponent = int(np.frexp(size)[1])
    points, eye, origins = (np.ldexp(x, -exponent) for x in (points, eye, origins))
    pinhole = camera.fov is not None
    if camera.fov is not None:
        forward = np.ldexp(np.asarray(camera.target, np.float64), -exponent) - eye
        high = np.tan(np.deg2rad(float(camera.fov)) / 2)
    else:
        assert camera.extent is not None
        forward, high = directions[0], np.ldexp(float(camera.extent), -exponent) / 2
    forward = forward / norm(forward)
    right = np.cross(forward, scaled_to_one(np.asarray(camera.up))[0])
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(right, forward), forward])
    x, y, z = _along(axes, directions if pinhole else origins - eye)
    place = np.stack([x / z, y / z] if pinhole else [x, y])
    half = high * np.array([camera.width / camera.height, 1.0])
    towards = None if pinhole else -forward
    return View(points, eye, towards, axes, place, half, camera.width, camera.height)


def _along(axes: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Coordinates (3, ...) of x (..., 3), term by term: the same for the same x, wherever it is."""
    return np.stack([x[..., 0] * a[0] + x[..., 1] * a[1] + x[..., 2] * a[2] for a in axes])


def across_gaps(view: View, mesh: TetMesh, eps: float) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of cells (M,), (M,): rays leave the mesh from the first and enter it next in the
    second. eps: of the mesh's dtype, to which surfaces that touch may overlap."""
    words = np.asarray(mesh.boundary)
    cell, corner = packing.cell_of(words), packing.corner_of(words)
    faces = np.asarray(mesh.cells)[cell[:, None], FACES[corner]]
    pixel, face, depth, positive = draw(view, faces, np.asarray(mesh.duplicates))
    entry = positive != (packing.flag_of(words[face]) == 1)
    order = np.lexsort((depth, pixel))
    pixel, depth, entry, cell = pixel[order], depth[order], entry[order], cell[face[order]]
    # fragment i from the end of its kind and pixel, as one number; exits count from -1
    numbers = []
    for kind, first in ((~entry, -1), (entry, 0)):
        p = pixel[kind]
        from_end = np.searchsorted(p, p, side="right") - 1 - np.arange(len(p))
        numbers.append(p * (len(faces) + 2) + from_end + first)
    pairs = np.intersect1d(*numbers, assume_unique=True, return_indices=True)[1:]
    i, j = np.flatnonzero(~entry)[pairs[0]], np.flatnonzero(entry)[pairs[1]]
    good = (depth[i] <= depth[j] + 8 * eps) & (cell[i] != cell[j])
    found = np.unique(cell[i[good]].astype(np.int64) << 32 | cell[j[good]])
    return found >> 32, found & 0xFFFFFFFF


def draw(view: View, faces: np.ndarray, duplicates: np.ndarray) -> tuple[np.ndarray, ...]:
    """Fragments of faces (F, 3) ahead of the eye: pixel, face, depth and whether the eye is on the
    positive side, (N,) each.

    In view coordinates q = (X, Y, Z) from the eye, vertices are homogeneous, v = (X, Y, W) with
    W = Z (pinhole) or 1 (parallel), and the ray of pixel (x, y) is on the left of the edge from v_i
    to v_j if E_ij = (x, y, 1) . (v_i x v_j) > 0. A line meets a face where the signs of its three
    E agree (Olano and Greer, "Triangle scan conversion using 2D homogeneous coordinates", 1997);
    they are then as barycentric coordinates, the sign is that of the eye's side. An edge is taken
    in the same direction in all its faces; on it, E = 0, the sign is that for a point shifted by
    (d, d**2) for small d. So rays cross a closed surface in and out by turns.
    """
    welded = np.arange(len(view.points))
    welded[duplicates[:, 0]] = duplicates[:, 1]
    seen = _along(view.axes, view.points[welded[faces]] - view.eye)  # (3, F, corner)
    v = seen if view.towards is None else np.stack([seen[0], seen[1], np.ones_like(seen[0])])
    low, high = _boxes(view, v)
    edges = []
    for i, j in ((1, 2), (0, 2), (0, 1)):
        a, b, c = np.cross(v[:, :, i], v[:, :, j], axis=0)
        edges.append((a, b, c, (a > 0) | ((a == 0) & (b > 0))))
    found = []
    for face, pixel in _pixels(view, low, high):
        x, y = view.place[:, pixel]
        values, signs = [], []
        for a, b, c, tie in edges:
            e = a[face] * x + b[face] * y + c[face]
            values.append(e)
            signs.append((e > 0) | ((e == 0) & tie[face]))
        inside = (signs[0] != signs[1]) & (signs[0] == signs[2])
        face, pixel, positive = face[inside], pixel[inside], signs[0][inside]
        weights = [np.abs(e[inside]) for e in values]
        total = weights[0] + weights[1] + weights[2]
        z = seen[2][face]
        depth = sum(w * z[:, i] for i, w in enumerate(weights)) / np.where(total > 0, total, 1)
        ahead = (depth > 0) & (total > 0)
        found.append(tuple(x[ahead] for x in (pixel, face, depth, positive)))
    if not found:
        return tuple(np.zeros(0, kind) for kind in (np.int64, np.int64, np.float64, bool))
    return tuple(np.concatenate(x) for x in zip(*found, strict=True))


def _boxes(view: View, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First and last column and row (2, F), (2, F) of the pixels that faces (3, F, corner) may
    cover; the last may be before the first."""
    w, half = v[2], view.half[:, None, None]
    size = np.array([view.width, view.height])[:, None]
    crossing = w.min(1) <= 1e-9 * np.abs(v).max((0, 2))  # reaches behind the eye, or almost
    at = v[:2] / np.where(crossing[:, None], 1, w)
    at = at / half * np.array([1, -1])[:, None, None]  # rows go down
    # rays are rounded in the camera's dtype
    low = np.ceil(((at.min(2) + 1) * size - 1) / 2 - 0.01)
    high = np.floor(((at.max(2) + 1) * size - 1) / 2 + 0.01)
    # beyond a side of the image: linear, and so right for what is behind the eye too
    beside = ((v[:2] > half * w).all(2) | (v[:2] < -half * w).all(2)).any(0) | (w <= 0).all(1)
    low = np.where(crossing, np.where(beside, size, 0), np.clip(low, 0, size))
    high = np.where(crossing, size - 1, np.clip(high, -1, size - 1))
    return low.astype(np.int64), high.astype(np.int64)


def _pixels(view: View, low: np.ndarray, high: np.ndarray):
    """All pixels in boxes, as pairs of box and pixel, some at a time."""
    wide, tall = np.maximum(high - low + 1, 0)
    face = np.flatnonzero(wide * tall > 0)
    for faces in np.array_split(face, 1 + int(tall[face].sum()) // _PIXELS):
        # rows of boxes first, then the pixels of each
        span, row = expand(tall[faces])
        box, row = faces[span], low[1, faces[span]] + row
        for part in np.array_split(np.arange(len(box)), 1 + int(wide[box].sum()) // _PIXELS):
            span, column = expand(wide[box[part]])
            which = part[span]
            yield box[which], row[which] * view.width + low[0, box[which]] + column


def expand(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """i repeated counts[i] times, and the number of each repetition."""
    which = np.repeat(np.arange(len(counts)), counts)
    return which, np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)
