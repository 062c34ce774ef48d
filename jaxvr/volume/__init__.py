"""Volumes: a mesh or grid with a scalar on it, and what it takes to walk through it.

What one is. A volume is a pytree of arrays: floats, which may be differentiated (`points`,
`values`), and integers, which are found once when it is built and never again (`cells`,
`neighbors`, `boundary`). `AbstractVolume` has what the doors ask of any; `TetMesh` is the
unstructured one, whose docstring has all shapes.

What holds for every `TetMesh`, whatever it was made from:
- the four welded ids of a cell are distinct, and each row of `cells` ascends by them, so that both
  sides of a face see its vertices in the same order and can agree to the bit;
- `neighbors` is symmetric: if n lies across face k of c, then c lies across the face of n that
  the word names; a face has at most two cells;
- every face without a neighbour stands in `boundary` once;
- points and values are finite, in one dtype; a cell keeps its own points, also at a seam.

How a mesh comes about (`build`): cell types by name and subdivision (`cells`), welding (`weld`),
signs (`geometry`), adjacency and fold bits (`connectivity`), values (`values`). Files come in by
`readers` and `plot3d`; generators are in `datasets`, on `structured` and `fem`.

To add a reader or a generator: make points, a dict of cells and values, and call
`TetMesh.from_cells`, which checks and repairs. To add a cell type: a `CellKind` in `cells`, with
its reference corners and its faces. To add another kind of volume: a pytree in a file of its own
that derives from `AbstractVolume`, and a tracer that walks through it (notebooks/contribute.md has
both).
"""

from . import datasets
from .base import AbstractVolume
from .mesh import TetMesh
from .plot3d import read_plot3d
from .quality import Quality, quality
from .readers import Field, list_fields, read_mesh, write_mesh
from .refine import delaunay_deviation, refine
from .report import MeshReport

__all__ = [
    "AbstractVolume",
    "Field",
    "MeshReport",
    "Quality",
    "TetMesh",
    "datasets",
    "delaunay_deviation",
    "list_fields",
    "quality",
    "read_mesh",
    "read_plot3d",
    "refine",
    "write_mesh",
]
