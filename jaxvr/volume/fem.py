"""Linear finite elements on tetrahedra for steady heat conduction (NumPy and scipy.sparse).

    -div(k grad u) = f inside,   k du/dn = g - h u on the boundary

with k constant: h > 0 and g = h * ambient is convection, h = 0 a given flux. The weak form is
(k grad u, grad v) + <h u, v> = (f, v) + <g, v>; on linear tetrahedra with gradients of the
barycentric coordinates. f is taken linear in each cell, g and h constant on each face.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:  # scipy.sparse takes a while to import
    from scipy.sparse import csr_array


def stiffness(points: np.ndarray, tets: np.ndarray) -> csr_array:
    """(grad u, grad v) for points (P, 3) and tets (T, 4) of either orientation."""
    q = points[tets]
    edges = q[:, 1:] - q[:, :1]
    inverse = np.linalg.inv(edges)  # columns: gradients of coordinates 1 to 3
    volume = np.abs(np.linalg.det(edges)) / 6.0
    grad = np.concatenate([-inverse.sum(2, keepdims=True), inverse], 2).transpose(0, 2, 1)
    return _assemble(np.einsum("t,tix,tjx->tij", volume, grad, grad), tets, len(points))


def mass(points: np.ndarray, simplices: np.ndarray, weight: np.ndarray | float) -> csr_array:
    """<weight u, v> over tets (n, 4) or triangles (n, 3); weight: one for each, or one for all."""
    m = simplices.shape[1]
    size = measure(points, simplices) * weight
    local = (np.ones((m, m)) + np.eye(m)) / (m * (m + 1))
    return _assemble(size[:, None, None] * local, simplices, len(points))


def measure(points: np.ndarray, simplices: np.ndarray) -> np.ndarray:
    """Volumes of tets (n, 4), or areas of triangles (n, 3)."""
    q = points[simplices]
    edges = q[:, 1:] - q[:, :1]
    if simplices.shape[1] == 4:
        return np.abs(np.linalg.det(edges)) / 6.0
    return np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / 2.0


def load(points: np.ndarray, faces: np.ndarray, flux: np.ndarray | float) -> np.ndarray:
    """<g, v> (P,) over triangles (n, 3) with a constant flux on each."""
    third = np.repeat(measure(points, faces) * flux / 3.0, 3)
    return np.bincount(faces.ravel(), third, minlength=len(points))


def _assemble(local: np.ndarray, simplices: np.ndarray, n: int) -> csr_array:
    from scipy.sparse import coo_array

    m = simplices.shape[1]
    rows, cols = np.repeat(simplices, m, 1).ravel(), np.tile(simplices, m).ravel()
    return coo_array((local.ravel(), (rows, cols)), shape=(n, n)).tocsr()


def solve(matrix: csr_array, right: np.ndarray, rtol: float = 1e-11) -> np.ndarray:
    """The solution of a symmetric positive definite system, by Jacobi-preconditioned CG."""
    from scipy.sparse import dia_array
    from scipy.sparse.linalg import cg

    n = len(right)
    inverse = dia_array(
        (np.reciprocal(matrix.diagonal().astype(np.float64))[None], [0]), shape=(n, n)
    )
    x, failed = cg(matrix, right, rtol=rtol, maxiter=20 * n + 100, M=inverse)
    if failed:
        raise RuntimeError(f"Conjugate gradients did not converge (code {failed}).")
    return x
