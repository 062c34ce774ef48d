"""Rays and transfer functions on which renderers fail."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from jaxvr.optics import TransferFunction

LATTICE = np.array([s for s in np.ndindex(3, 3, 3) if s != (1, 1, 1)]) - 1.0


def nasty_rays(
    mesh: Any, count: int = 32, seed: int = 0
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Rays aimed at the features of a mesh, by kind: origins and directions (count, 3), float64.

    mesh: a `TetMesh`. count: rays of each kind. seed: which features.

    Through vertices, edges, faces and centroids, from outside; along lattice directions through
    each of them; in the planes of faces; grazing the bounding box; from eyes on vertices, on edges,
    in faces and within cells; from within outwards to vertices; with the mesh behind; missing it.
    Numbers are those of the mesh's dtype, so that rays meet features as exactly as it can say.
    """
    dtype = np.dtype(mesh.points.dtype)
    rng = np.random.default_rng(seed)
    corners = np.asarray(mesh.points, np.float64)[np.asarray(mesh.cells)]
    low, high = corners.min((0, 1)), corners.max((0, 1))
    size = float(np.linalg.norm(high - low))

    def some() -> np.ndarray:
        return corners[rng.integers(len(corners), size=count)][:, rng.permutation(4)]

    def away() -> np.ndarray:
        u = rng.normal(size=(count, 3))
        return u / np.linalg.norm(u, axis=1, keepdims=True)

    def towards(target: np.ndarray, u: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        origin = target + size * rng.uniform(1.2, 4, (count, 1)) * (away() if u is None else u)
        return origin, target - origin

    means = {
        k: some()[:, :n].mean(1) for n, k in enumerate(("", "a vertex", "an edge", "a face")) if n
    }
    means["a centroid"] = some().mean(1)
    rays = {f"through {k}": towards(x) for k, x in means.items()}
    lattice = LATTICE[np.arange(count) % len(LATTICE)]
    for k, x in means.items():
        # steps of a power of two, so that the origin is exact where the mesh is
        start = x - 2.0 ** np.ceil(np.log2(2 * size)) * lattice
        rays[f"lattice direction through {k}"] = (start, lattice)
    a, b, c = some()[:, :3].transpose(1, 0, 2)
    along = (b - a) * rng.normal(size=(count, 1)) + (c - a) * rng.normal(size=(count, 1))
    rays["in the plane of a face"] = (a + (b - a) / 4 + (c - a) / 4 - 3 * along, along)
    a, b = some()[:, :2].transpose(1, 0, 2)
    rays["along an edge"] = (a - 2 * (b - a), b - a)
    side = np.where(rng.random((count, 3)) < 0.5, low, high)
    axis = np.eye(3)[rng.integers(3, size=count)]
    step = axis * rng.choice([-1, 1], (count, 1))
    rays["grazing"] = (side - 2 * size * step, step)
    rays["from a vertex"] = (some()[:, 0], away())
    rays["from an edge"] = (some()[:, :2].mean(1), away())
    rays["from a face"] = (some()[:, :3].mean(1), away())
    rays["from within"] = (some().mean(1), away())
    inside = some().mean(1)
    target = some()[:, 0]
    rays["from within to a vertex"] = (inside, target - inside)
    target = some().mean(1)
    u = away()
    rays["mesh behind"] = (target + 2 * size * u, u)
    u = away()
    aside = np.cross(u, away())
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    rays["missing"] = ((low + high) / 2 + 2 * size * (aside - u), u)
    rounded = {k: [x.astype(dtype).astype(np.float64) for x in pair] for k, pair in rays.items()}
    for _, directions in rounded.values():
        directions[(directions == 0).all(1)] = 1.0  # two features in one place
    return {k: (origins, directions) for k, (origins, directions) in rounded.items()}


def nasty_transfers(
    low: float = 0.0, high: float = 1.0, length: float = 1.0, dtype: Any = "float64"
) -> dict[str, TransferFunction]:
    """Transfer functions by kind, for values from `low` to `high` and chords of about `length`.

    dtype: of the arrays. One and two points, jumps inside and at the ends, many points, points at
    values that vertices have, transparent stretches, no extinction at all, an opaque peak (optical
    depth 1e4), extinctions from 1e-6 to 1e6, black and bright light, a range far below and far
    above the values.
    """
    rng = np.random.default_rng(11)
    span = high - low

    def make(at: Any, extinctions: Any, colors: Any = None) -> TransferFunction:
        at = low + span * np.asarray(at, np.float64)
        colors = rng.uniform(0, 1, (len(at), 3)) if colors is None else np.asarray(colors)
        return TransferFunction(
            at, colors, np.asarray(extinctions, np.float64) / length, dtype=dtype
        )

    many = np.sort(rng.uniform(0, 1, 64))
    return {
        "one point": make([0.5], [1.0]),
        "two points": make([0, 1], [0.3, 3.0]),
        "jump": make([0, 0.4, 0.4, 1], [0.2, 3.0, 0.1, 2.0]),
        "jumps": make([0, 0, 0.3, 0.3, 0.6, 0.6, 1, 1], [0.1, 2, 1, 0, 4, 0.5, 3, 0.2]),
        "step to nothing": make([0.5, 0.5], [2.0, 0.0]),
        "many points": make(many, rng.uniform(0, 4, 64)),
        "transparent stretches": make([0, 0.2, 0.3, 0.6, 0.7, 1], [1, 0, 0, 0, 5, 0]),
        "no extinction": make([0, 1], [0.0, 0.0]),
        "opaque peak": make([0, 0.45, 0.5, 0.55, 1], [0, 0, 1e4, 0, 0]),
        "opaque": make([0, 1], [1e4, 1e4]),
        "tiny and huge": make([0, 0.3, 0.6, 1], [1e-6, 1e6, 1e-3, 1.0]),
        "black": make([0, 1], [1.0, 2.0], np.zeros((2, 3))),
        "bright": make([0, 1], [1.0, 2.0], np.array([[40.0, 0, 3], [0, 9, 0]])),
        "below": make([-3, -2], [1.0, 0.5]),
        "above": make([3, 4], [0.7, 2.0]),
    }


def scaled(
    mesh: Any,
    transfer: TransferFunction,
    scalar: int = 0,
    length: int = 0,
    extinction: int | None = None,
) -> tuple[Any, TransferFunction]:
    """The same picture in other units: a mesh and a transfer function, scaled by powers of two.

    mesh: a `TetMesh`. scalar, length, extinction: exponents of two for values and positions, for
    points, and for extinctions; None for the exponent that keeps optical depths, -length.

    No bit of a mantissa changes, so a renderer without thresholds in a unit gives the same bits
    (rays and cameras have to be scaled, too: `origins * 2.0**length`).
    """
    extinction = -length if extinction is None else extinction
    one = np.asarray(mesh.points).dtype.type
    scale = [np.ldexp(one(1), k) for k in (scalar, length, extinction)]
    moved = mesh.replace(
        values=np.asarray(mesh.values) * scale[0],
        points=np.asarray(mesh.points) * scale[1],
        origin=[math.ldexp(x, length) for x in mesh.origin],
        offset=math.ldexp(mesh.offset, scalar),
    )
    return moved, TransferFunction(
        np.asarray(transfer.positions) * scale[0],
        np.asarray(transfer.colors),
        np.asarray(transfer.extinctions) * scale[2],
        offset=math.ldexp(transfer.offset, scalar),
    )
