"""Signed volumes of tetrahedra in float64, with a bound on their rounding (NumPy, not traced)."""

from __future__ import annotations

import numpy as np

# Shewchuk, "Adaptive precision floating-point arithmetic and fast robust geometric predicates"
# (1997), orient3d: |error| <= (7 + 56 u) u * permanent, with u = 2**-53.
_BOUND = (7.0 + 56.0 * 2.0**-53) * 2.0**-53
_CHUNK = 1 << 19


def signed_volumes(points: np.ndarray, tets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Six times the signed volumes, det(q1 - q0, q2 - q0, q3 - q0), and their signs.

    points (P, 3), tets (T, 4). Returns det (T,) float64 and sign (T,) int8, which is 0 where the
    determinant is zero to within its own rounding.
    """
    scale = float(np.abs(points).max(initial=0.0))
    # a power of two, exactly undone: keeps products in range for coordinates of any size
    exponent = int(np.frexp(scale)[1]) if scale > 0 else 0
    p = np.ldexp(np.asarray(points, np.float64), -exponent)
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
