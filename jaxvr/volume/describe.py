"""The page that `TetMesh.describe` returns."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from .._core.brief import spanned
from .._core.offsets import said
from .connectivity import components
from .packing import cell_of
from .quality import quality
from .statistics import value_range

if TYPE_CHECKING:
    from .mesh import TetMesh


def count_components(neighbors: Any) -> tuple[int, int]:
    """Number of sets of cells that hang together by faces, and the cells of the largest.

    neighbors (T, 4): see `TetMesh`.
    """
    words = np.asarray(neighbors)
    c, k = np.nonzero(words >= 0)
    pairs = np.stack([c, k, cell_of(words[c, k])], 1)
    count, label = components(len(words), pairs)
    return count, int(np.bincount(label).max())


def _triple(x: Any, mesh: TetMesh) -> str:
    """A place relative to the mesh's origin, in the world."""
    parts = zip(np.asarray(x, np.float64), mesh.origin, strict=True)
    return "(" + ", ".join(f"{v + o:.10g}" if o else f"{v:.6g}" for v, o in parts) + ")"


def offsets(mesh: TetMesh) -> list[tuple[str, str]]:
    """What points and values are held relative to, where they are."""
    rows = (
        ("origin", f"{said(mesh.origin)}: points are held relative to it", any(mesh.origin)),
        ("offset", f"{said(mesh.offset)}: values are held relative to it", bool(mesh.offset)),
    )
    return [(label, text) for label, text, there in rows if there]


def _size(n: int) -> str:
    for unit in ("bytes", "kB", "MB"):
        if n < 1000:
            return f"{n:.3g} {unit}"
        n = n / 1000  # type: ignore[assignment]
    return f"{n:.3g} GB"


def describe(mesh: TetMesh) -> str:
    """Facts on a concrete mesh, one a line; see `TetMesh.describe`."""
    low, high = value_range(mesh)
    lo, hi = mesh.bounds()
    q = quality(mesh.points, mesh.cells)
    count, largest = count_components(mesh.neighbors)
    shape = "one piece" if count == 1 else f"{count:,}, the largest of {largest:,} tetrahedra"
    field = mesh.report.field or "values"
    nbytes = mesh.nbytes
    rows = [
        *mesh.report.lines(),
        ("components", shape),
        ("boundary", f"{mesh.n_boundary:,} faces"),
        ("box", f"{_triple(lo, mesh)} to {_triple(hi, mesh)}"),
        *offsets(mesh),
        ("dihedral angles", f"{q.min_dihedral:.3g} to {q.max_dihedral:.6g} degrees"),
        ("edge ratio", f"up to {q.edge_ratio:,.4g}"),
        ("volumes", f"{q.min_volume:.3g} to {q.max_volume:.3g}, {q.volume:.6g} in all"),
        ("field", f"{field}, {mesh.location} data, {spanned(low, high)}"),
        ("memory", f"{_size(nbytes)}, {nbytes / mesh.n_tets:.0f} bytes per tetrahedron"),
    ]
    width = max(len(label) for label, _ in rows)
    head = f"TetMesh of {mesh.n_tets:,} tetrahedra and {mesh.n_points:,} points in {mesh.dtype}"
    return "\n".join([head, *(f"  {label:<{width}}  {text}" for label, text in rows)])
