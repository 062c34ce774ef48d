"""Signed volumes of tetrahedra in float64, with a bound on their rounding, and which of them are
flat: volumes that the rounding of their corners may have made (NumPy, not traced)."""

from __future__ import annotations

import numpy as np

# Shewchuk, "Adaptive precision floating-point arithmetic and fast robust geometric predicates"
# (1997, doi:10.1007/PL00009321), orient3d: |error| <= (7 + 56 u) u * permanent, with u = 2**-53.
_BOUND = (7.0 + 56.0 * 2.0**-53) * 2.0**-53
_CHUNK = 1 << 19
# Roundings that a coordinate is taken to have gone through, each of half a unit in the last place:
# the one by which it is stored, and those of the few sums and products that made it.
_ROUNDINGS = 4


def signed_volumes(points: np.ndarray, tets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Six times the signed volumes, det(q1 - q0, q2 - q0, q3 - q0), and their signs.

    points (P, 3), tets (T, 4). Returns det (T,) float64 and sign (T,) int8, which is 0 where the
    determinant is zero to within its own rounding.
    """
    p, exponent = _scaled(points)
    det = np.empty(len(tets))
    sign = np.empty(len(tets), np.int8)
    for i in range(0, len(tets), _CHUNK):
        q = p[tets[i : i + _CHUNK]]
        (ax, ay, az), (bx, by, bz), (cx, cy, cz) = np.moveaxis(q[:, 1:] - q[:, :1], 0, -1)
        d = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
        permanent = (
            abs(ax) * (abs(by * cz) + abs(bz * cy))
            + abs(ay) * (abs(bz * cx) + abs(bx * cz))
            + abs(az) * (abs(bx * cy) + abs(by * cx))
        )
        s = np.sign(d).astype(np.int8)
        s[np.abs(d) <= _BOUND * permanent] = 0
        det[i : i + _CHUNK], sign[i : i + _CHUNK] = d, s
    with np.errstate(over="ignore", under="ignore"):
        return np.ldexp(det, 3 * exponent), sign


def flat_cells(points: np.ndarray, tets: np.ndarray) -> np.ndarray:
    """Which tetrahedra (T,) bool have no volume beyond the rounding of their points (P, 3).

    With d_v a bound on how far rounding may have moved any coordinate of the corner q_v, N_v twice
    the area vector of the face opposite q_v and e_vw the edges, six volumes may have changed by

        sum_v d_v |N_v|_1 + 2 sum_{v<w} d_v d_w |e_xy|_1 + 6 sum_{u<v<w} d_u d_v d_w

    and no more, xy being the corners other than v and w: the determinant of rows (q_v, 1) is linear
    in each row, and these are its terms with one, two and three rows moved (with all four it is
    zero). d_v is four roundings of the largest coordinate of q_v, in any axis: points that were
    turned or sheared carry roundings of the others. So a cell is flat if it is lower than a few
    units in the last place of where it is, and which way round such a cell lies, its corners do not
    say. Numbers that float32 can hold are taken to come from there, whatever the dtype is.
    """
    unit = float(np.finfo(points.dtype).eps) / 2
    with np.errstate(over="ignore"):
        if np.array_equal(points, points.astype(np.float32)):
            unit = float(np.finfo(np.float32).eps) / 2
    p, _ = _scaled(points)
    out = np.empty(len(tets), bool)
    for i in range(0, len(tets), _CHUNK):
        q = p[tets[i : i + _CHUNK]]
        d = (_ROUNDINGS * unit * np.abs(q).max(2)).T
        a, b, c = np.moveaxis(q[:, 1:] - q[:, :1], 1, 0)
        ab, bc, ca = b - a, c - b, a - c
        normals = (np.cross(ab, bc), np.cross(b, c), np.cross(c, a), np.cross(a, b))
        across = (bc, ca, ab, c, b, a)  # of the pairs of corners below
        pairs = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
        bound = sum(x * np.abs(n).sum(1) for x, n in zip(d, normals, strict=True))
        for (v, w), e in zip(pairs, across, strict=True):
            bound += 2 * d[v] * d[w] * np.abs(e).sum(1)
        for u, v, w in ((0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3)):
            bound += 6 * d[u] * d[v] * d[w]
        out[i : i + _CHUNK] = np.abs((a * normals[1]).sum(1)) <= bound
    return out


def _scaled(points: np.ndarray) -> tuple[np.ndarray, int]:
    """Points in float64 times 2**-exponent, exactly, and the exponent: products of coordinates of
    any size stay in range."""
    scale = float(np.abs(points).max(initial=0.0))
    exponent = int(np.frexp(scale)[1]) if scale > 0 else 0
    return np.ldexp(np.asarray(points, np.float64), -exponent), exponent
