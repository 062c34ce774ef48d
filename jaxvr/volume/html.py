"""How a notebook shows a `TetMesh`: facts that are cheap for millions of cells, and a histogram."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from .._core import svg
from .._core.brief import is_known, spanned
from .describe import _size, _triple, offsets
from .statistics import used_points, used_values

if TYPE_CHECKING:
    from .mesh import TetMesh

WIDTH, HEIGHT = 300.0, 84.0


def mesh_html(mesh: TetMesh) -> str | None:
    """HTML of a concrete mesh; None where leaves are tracers, placeholders or not a mesh's arrays.

    Quality is left to `TetMesh.describe`, which looks at every dihedral angle.
    """
    points, cells, values = (mesh.points, mesh.cells, mesh.values)
    arrays = [getattr(mesh, f.name) for f in dataclasses.fields(mesh) if not f.metadata]
    if not is_known(*arrays) or (points.ndim, cells.ndim) != (2, 2):
        return None
    if cells.dtype.kind == "f" or 0 in (values.size, cells.size):
        return None
    corners = np.asarray(points)
    corners, numbers = corners[used_points(mesh)], used_values(mesh)
    low, high = float(numbers.min()), float(numbers.max())
    name = mesh.report.field or "values"
    rows = [
        ("tetrahedra", f"{mesh.n_tets:,}"),
        ("points", f"{mesh.n_points:,}"),
        ("field", f"{name}, {mesh.location} data, {spanned(low, high)}"),
        ("box", f"{_triple(corners.min(0), mesh)} to {_triple(corners.max(0), mesh)}"),
        *offsets(mesh),
        ("dtype", str(mesh.dtype)),
        *mesh.report.lines(),
        ("memory", _size(mesh.nbytes)),
    ]
    # "points" of the report are those that coincide.
    seen = [label for label, _ in rows]
    rows = [
        ("coincident" if label == "points" and label in seen[:k] else label, text)
        for k, (label, text) in enumerate(rows)
    ]
    head = '<div style="font-weight:600">TetMesh</div>'
    drawn = _histogram(numbers, low, high, name) if np.isfinite([low, high]).all() else ""
    return f'<div class="jaxvr-mesh">{head}{svg.table(rows)}{drawn}</div>'


def _histogram(values: np.ndarray, low: float, high: float, name: str) -> str:
    counts, every = svg.histogram(values, low, high)
    of = "values" if every == 1 else f"every {every}th value"
    floor = HEIGHT - 18
    parts = (
        f'<g transform="translate(0,2)"><path d="{svg.bars(counts, WIDTH, floor - 2)}" '
        'fill="currentColor" fill-opacity="0.45"/></g>',
        f'<line x1="0" x2="{WIDTH:g}" y1="{floor:g}" y2="{floor:g}" stroke="currentColor"/>',
        svg.caption(0, HEIGHT - 4, f"{low:.4g}"),
        svg.caption(WIDTH / 2, HEIGHT - 4, f"{name}, count of {of}", "middle"),
        svg.caption(WIDTH, HEIGHT - 4, f"{high:.4g}", "end"),
    )
    return svg.picture(WIDTH, HEIGHT, parts, f"Histogram of {name}, {low:.4g} to {high:.4g}")
