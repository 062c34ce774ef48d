"""Brute force in NumPy: what a ray sees, from every cell that it meets. Shares no code with jaxvr.

Each cell is clipped by the ray (four half-spaces, an interval of depths, cut off at the origin);
the scalar is linear in the cell; pieces are sorted by entry depth, split where they cross control
points, integrated by Gauss-Legendre quadrature and composited.

Geometry is in `np.longdouble` (64 bits of mantissa where the hardware has them), so that the error
of the reference itself is far below that of what it is compared with. A ray that lies in a face
belongs to the cell on one side of it: every ray is moved sideways by 1024 epsilons (some 1e-16) of
the mesh's diagonal, in a direction that has nothing to do with the mesh, which is above the
rounding of the half-spaces and below everything else. Where the field is continuous that is no
change; a ray that lies in the *boundary*, or between cells with different values, has no value of
its own, and `BruteForce.ambiguous` finds it.

Neighbouring cells find the depth of their common face from the same numbers in the same order (rows
of `mesh.cells` are sorted alike), so that chords add up without gaps.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

Exact = np.longdouble
SIDEWAYS = np.array([0.5641895835477563, 0.7316738548391265, 0.3819660112501051])
# Along a convex edge of the boundary most directions lead outside, so doubts need more than two.
SIGNS = (np.ones(3), np.array([1, -1, 1]))
_turned = np.concatenate([np.roll(SIDEWAYS, k) * s for k in range(3) for s in SIGNS])
AROUND = np.concatenate([_turned, -_turned]).reshape(-1, 3)
NODES, WEIGHTS = np.polynomial.legendre.leggauss(20)
# 20 points are good to 1e-15 up to this optical depth; thicker slabs are cut into equal parts.
THICK = 4.0
BRANCH = 8
FACES = ((1, 2, 3), (0, 2, 3), (0, 1, 3), (0, 1, 2))


class Pieces(NamedTuple):
    """Chords of rays in cells, sorted by ray and entry depth: each array has one entry a chord."""

    ray: np.ndarray
    cell: np.ndarray
    enter: np.ndarray
    leave: np.ndarray
    front: np.ndarray
    back: np.ndarray


class BruteForce:
    """A mesh prepared for brute force.

    mesh: a `TetMesh`, or anything with points (P, 3), cells (T, 4), values and their location.
    exact: the dtype of the geometry; float64 is three times as fast, and good for lengths.

    What it sees is the mesh's own numbers: in float32 those that were rounded to it. Neighbours are
    not asked for: every cell stands alone. So cells that overlap are seen both (a mesh that is
    folded has no right picture), and cells without volume, which hold nothing, are left out.
    """

    def __init__(self, mesh: Any, exact: Any = Exact):
        self.exact = exact
        self.shift = 1024 * float(np.finfo(exact).eps)
        # In the world, as rays and transfer functions are.
        points = np.asarray(mesh.points, np.float64) + getattr(mesh, "origin", 0.0)
        self.cells = np.asarray(mesh.cells)
        self.corners = points[self.cells]
        values = np.asarray(mesh.values, np.float64) + getattr(mesh, "offset", 0.0)
        self.values = {
            "point": lambda: values[self.cells],
            "cell": lambda: np.repeat(values[:, None], 4, 1),
            "corner": lambda: values,
        }[mesh.location]()
        self.low, self.high = self.corners.min((0, 1)), self.corners.max((0, 1))
        self.diagonal = float(np.linalg.norm(self.high - self.low))
        exact = self.corners.astype(self.exact)
        self.anchor = np.stack([exact[:, f[0]] for f in FACES], 1)
        normal = np.stack(
            [np.cross(exact[:, b] - exact[:, a], exact[:, c] - exact[:, a]) for a, b, c in FACES],
            1,
        )
        height = np.einsum("tkx,tkx->tk", normal, exact - self.anchor)
        # inward normals; `height` is that of the vertex across, so that distance / height is its
        # barycentric coordinate
        self.normal = normal * np.sign(height)[..., None]
        self.height = np.abs(height)
        self.solid = (self.height > 0).all(1)
        self._tree()

    def _tree(self) -> None:
        """Boxes of cells in Morton order, eight to a node, level by level."""
        middle = self.corners.mean(1)
        grid = ((middle - self.low) / (self.high - self.low + 1e-300) * 1023).astype(np.int64)
        code = np.zeros(len(grid), np.int64)
        for bit in range(10):
            for axis in range(3):
                code |= ((grid[:, axis] >> bit) & 1) << (3 * bit + axis)
        self.order = np.argsort(code, kind="stable")
        slack = 1e-9 * self.diagonal
        low = self.corners[self.order].min(1) - slack
        high = self.corners[self.order].max(1) + slack
        self.levels = [(low, high)]
        while len(low) > BRANCH:
            pad = -len(low) % BRANCH
            low = np.concatenate([low, np.repeat(low[-1:], pad, 0)])
            high = np.concatenate([high, np.repeat(high[-1:], pad, 0)])
            low = low.reshape(-1, BRANCH, 3).min(1)
            high = high.reshape(-1, BRANCH, 3).max(1)
            self.levels.append((low, high))

    def candidates(self, origins: np.ndarray, directions: np.ndarray):
        """Pairs (ray, cell) of rays (origins and directions, (R, 3)) and cells whose boxes meet;
        all that matter and some more."""
        inverse = 1 / np.where(np.abs(directions) < 1e-200, 1e-200, directions)
        low, high = self.levels[-1]
        ray = np.repeat(np.arange(len(origins)), len(low))
        node = np.tile(np.arange(len(low)), len(origins))
        for level in range(len(self.levels) - 1, -1, -1):
            low, high = self.levels[level]
            enter, leave = np.zeros(len(ray)), np.full(len(ray), np.inf)
            for axis in range(3):
                o, i = origins[ray, axis], inverse[ray, axis]
                a, b = (low[node, axis] - o) * i, (high[node, axis] - o) * i
                enter = np.maximum(enter, np.minimum(a, b))
                leave = np.minimum(leave, np.maximum(a, b))
            meets = enter <= leave * (1 + 1e-12) + 1e-12 * self.diagonal
            ray, node = ray[meets], node[meets]
            if level:
                ray = np.repeat(ray, BRANCH)
                node = (node[:, None] * BRANCH + np.arange(BRANCH)).ravel()
                there = node < len(self.levels[level - 1][0])
                ray, node = ray[there], node[there]
        cell = self.order[node]
        return ray[self.solid[cell]], cell[self.solid[cell]]

    def pieces(self, origins: Any, directions: Any, shift: Any = None) -> Pieces:
        """Chords of rays, origins and directions (R, 3); depths are world lengths from the origin.

        shift: how far rays are moved, in diagonals: a number, or a vector (3,).
        """
        origins = np.asarray(origins, np.float64)
        directions = np.asarray(directions, np.float64)
        ray, cell = self.candidates(origins, directions)
        exact = self.exact
        move = (self.shift if shift is None else shift) * SIDEWAYS if np.ndim(shift) == 0 else shift
        o = origins.astype(exact) + exact(self.diagonal) * np.asarray(move).astype(exact)
        d = directions.astype(exact)
        d = d / np.sqrt((d * d).sum(-1, keepdims=True))
        rise = np.zeros((len(ray), 4), exact)
        start = np.zeros((len(ray), 4), exact)
        for axis in range(3):
            n = self.normal[cell, :, axis]
            rise += n * d[ray, axis][:, None]
            start += n * (o[ray, axis][:, None] - self.anchor[cell, :, axis])
        flat = rise == 0
        at = -start / np.where(flat, 1, rise)
        at = np.where(flat, np.where(start < 0, np.inf, -np.inf), at)
        enter = np.where((rise > 0) | (flat & (start < 0)), at, -np.inf)
        leave = np.where(rise < 0, at, np.inf)
        by, out = enter.argmax(1), leave.argmin(1)
        first, last = enter.max(1), leave.min(1)
        keep = np.flatnonzero(last > np.maximum(first, 0))
        ray, cell, rise, start = ray[keep], cell[keep], rise[keep], start[keep]
        first, last, by, out = first[keep], last[keep], by[keep], out[keep]
        by = np.where(first < 0, -1, by)
        first = np.maximum(first, 0)

        def scalar(depth, face):
            weight = np.maximum((start + rise * depth[:, None]) / self.height[cell], 0)
            weight[np.arange(4)[None] == face[:, None]] = 0
            total = weight.sum(1)
            none = total <= 0
            weight[none], total[none] = 1, 4
            # differences first, so that a constant stays exactly constant
            base = self.values[cell, :1]
            return base[:, 0] + ((weight * (self.values[cell] - base)).sum(1) / total)

        front, back = scalar(first, by), scalar(last, out)
        order = np.lexsort((first, ray))
        kept = (ray, cell, first, last, front, back)
        return Pieces(*(x[order] for x in kept))

    def lengths(
        self, origins: Any, directions: Any, chunk: int = 64, shift: Any = None
    ) -> np.ndarray:
        """The total chord (R,) of rays, origins and directions (R, 3). chunk: rays at once; shift:
        as for `pieces`."""
        parts = [slice(i, i + chunk) for i in range(0, len(origins), chunk)]
        traced = (self.pieces(origins[p], directions[p], shift) for p in parts)
        sums = [chords(t, len(origins[p])) for t, p in zip(traced, parts, strict=True)]
        return np.concatenate([np.zeros(0), *sums])

    def render(
        self,
        origins: Any,
        directions: Any,
        transfer: Any,
        chunk: int = 64,
        shift: Any = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """rgba (R, 4), premultiplied, and the total chord (R,) of rays, origins and directions
        (R, 3). transfer: a `TransferFunction`. chunk, shift: as for `lengths`."""
        table = tuple(
            np.asarray(getattr(transfer, k), np.float64)
            for k in ("positions", "extinctions", "colors")
        )
        table = (table[0] + getattr(transfer, "offset", 0.0), *table[1:])
        origins, directions = np.asarray(origins), np.asarray(directions)
        rgba, length = np.zeros((len(origins), 4)), np.zeros(len(origins))
        for i in range(0, len(origins), chunk):
            part = slice(i, min(i + chunk, len(origins)))
            pieces = self.pieces(origins[part], directions[part], shift)
            count = part.stop - i
            rgba[part], length[part] = composite(pieces, table, count), chords(pieces, count)
        return rgba, length

    def ambiguous(
        self, origins: Any, directions: Any, transfer: Any, by: float, tolerance: float
    ) -> np.ndarray:
        """Which rays (R,) see something else, by more than `tolerance`, when moved by `by` of the
        diagonal in any of twelve directions. origins, directions, transfer: as for `render`."""
        seen = np.stack(
            [self.render(origins, directions, transfer, shift=by * u)[0] for u in AROUND]
        )
        return np.ptp(seen, axis=0).max(1) > tolerance


def chords(pieces: Pieces, count: int) -> np.ndarray:
    """Total length of each ray (count,)."""
    return _sum_by(pieces.ray, pieces.leave - pieces.enter, count).astype(np.float64)


def _sum_by(ray: np.ndarray, x: np.ndarray, count: int) -> np.ndarray:
    """Sums of x (N, ...) over the runs of the sorted `ray`, in extended precision."""
    out = np.zeros((count, *x.shape[1:]), Exact)
    if len(ray):
        first = np.flatnonzero(np.concatenate([[True], ray[1:] != ray[:-1]]))
        out[ray[first]] = np.add.reduceat(x.astype(Exact), first, axis=0)
    return out


def composite(pieces: Pieces, table: Any, count: int) -> np.ndarray:
    """rgba (count, 4) of sorted pieces; table: positions (K,), extinctions (K,), colours (K, 3)."""
    if not len(pieces.ray):
        return np.zeros((count, 4))
    ray, length, front, back = _split(pieces, table[0])
    a, b = (_optical(table, *end) for end in (front, back))
    parts = np.maximum(np.ceil(length * np.maximum(a[:, 0], b[:, 0]) / THICK), 1).astype(int)
    if parts.max() > 1:
        number = np.repeat(parts, parts)
        i = np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
        a, b, ray, length = (np.repeat(x, parts, 0) for x in (a, b, ray, length))
        a, b = (a + (b - a) * (k / number)[:, None] for k in (i, i + 1))
        length = length / number
    depth = 0.5 * (a[:, 0] + b[:, 0]) * length
    emitted = np.zeros((len(ray), 3))
    for x, w in zip((NODES + 1) / 2, WEIGHTS / 2, strict=True):
        ext = a[:, 0] + (b[:, 0] - a[:, 0]) * x
        through = np.exp(-length * x * 0.5 * (a[:, 0] + ext))
        emitted += (w * length * ext * through)[:, None] * (a[:, 1:] + (b[:, 1:] - a[:, 1:]) * x)
    before = np.cumsum(depth.astype(Exact)) - depth
    first = np.flatnonzero(np.concatenate([[True], ray[1:] != ray[:-1]]))
    runs = np.diff(np.concatenate([first, [len(ray)]]))
    before = (before - np.repeat(before[first], runs)).astype(np.float64)
    rgb = _sum_by(ray, emitted * np.exp(-before)[:, None], count)
    alpha = -np.expm1(-_sum_by(ray, depth, count))
    return np.concatenate([rgb, alpha[:, None]], 1).astype(np.float64)


def _split(pieces: Pieces, positions: np.ndarray):
    """Pieces cut at control points: ray, length, and (slab, place in it) of both ends.

    Slab k lies between control points k - 1 and k; slabs 0 and K are unbounded and constant. A
    constant scalar at a control point belongs to the slab above it.
    """
    s0, s1 = pieces.front, pieces.back
    change = s1 - s0
    flat, up = change == 0, change > 0
    # a rising piece starts in the slab above a control point, a falling one in that below
    k0 = np.where(
        up | flat,
        np.searchsorted(positions, s0, side="right"),
        np.searchsorted(positions, s0, side="left"),
    )
    k1 = np.where(
        up, np.searchsorted(positions, s1, side="left"), np.searchsorted(positions, s1, "right")
    )
    k1 = np.where(flat, k0, k1)
    number = np.abs(k1 - k0) + 1
    of = np.repeat(np.arange(len(s0)), number)
    i = np.arange(number.sum()) - np.repeat(np.cumsum(number) - number, number)
    slab = k0[of] + i * np.where(k1 < k0, -1, 1)[of]
    bounds = np.concatenate([[-np.inf], positions, [np.inf]])
    low, high = bounds[slab], bounds[slab + 1]
    rising = up[of]
    near = np.where(rising, np.maximum(s0[of], low), np.minimum(s0[of], high))
    far = np.where(rising, np.minimum(s1[of], high), np.maximum(s1[of], low))
    share = np.where(flat[of], 1, (far - near) / np.where(flat, 1, change)[of])
    whole = (pieces.leave - pieces.enter)[of]
    length = np.maximum(share * whole, 0).astype(np.float64)
    width = high - low
    inner = np.isfinite(width) & (width > 0)

    def place(s):
        with np.errstate(invalid="ignore"):
            inside = (s - np.where(inner, low, 0)) / np.where(inner, width, 1)
        return np.where(inner, inside, 0).astype(np.float64)

    return pieces.ray[of], length, (slab, place(near)), (slab, place(far))


def _optical(table: Any, slab: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Extinction and colour (N, 4) at a place in a slab."""
    positions, extinctions, colors = table
    rows = np.concatenate([extinctions[:, None], colors], 1)
    left, right = np.maximum(slab - 1, 0), np.minimum(slab, len(positions) - 1)
    return rows[left] + place[:, None] * (rows[right] - rows[left])
