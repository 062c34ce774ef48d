"""What `read_mesh` does with kinds of files: python -m experiments.file_kinds --out experiments

Each file is written here by another program (VTK, PyVista, meshio, gmsh, by hand after a format's
description), or comes with a package, and is read by `read_mesh` and, where it can, by VTK's own
reader; else the truth is what was written. "right": the volume agrees to 1e-6 (the sum of VTK's
cell sizes), every point of the mesh is one of the truth's and has its value, cell values agree in
their integral. What is refused is refused by a message, which stands in the table. Needs
`pip install vtk pyvista meshio h5py netCDF4 gmsh`; a kind whose writer is missing is told as such.
"""

from __future__ import annotations

import argparse
import collections
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

import jaxvr
from experiments import file_formats, file_makers
from experiments.data import folder

TOLERANCE = 1e-6


def volume_of(mesh: jaxvr.TetMesh) -> np.ndarray:
    """Of each tetrahedron (T,)."""
    p = np.asarray(mesh.points, np.float64)[np.asarray(mesh.cells)]
    return np.abs(np.linalg.det(p[:, 1:] - p[:, :1])) / 6


def truth_of(grid: Any) -> Any:
    """One unstructured grid of what VTK read, without the cells that it does not draw."""
    import vtk

    if grid.IsA("vtkCompositeDataSet"):
        append = vtk.vtkAppendFilter()
        append.SetOutputPointsPrecision(append.DOUBLE_PRECISION)
        walk = grid.NewIterator()
        walk.InitTraversal()
        while not walk.IsDoneWithTraversal():
            append.AddInputData(walk.GetCurrentDataObject())
            walk.GoToNextItem()
        append.Update()
        return truth_of(append.GetOutput())
    if not grid.IsA("vtkUnstructuredGrid"):
        append = vtk.vtkAppendFilter()
        append.AddInputData(grid)
        append.SetOutputPointsPrecision(append.DOUBLE_PRECISION)
        append.Update()
        grid = append.GetOutput()
    if grid.GetCellData().HasArray("vtkGhostType"):
        grid.RemoveGhostCells()
    return grid


def compare(mesh: jaxvr.TetMesh, truth: Any, tolerance: float = TOLERANCE) -> str | None:
    """What is wrong with a mesh, or None. tolerance: of the volume."""
    import vtk
    from vtkmodules.util.numpy_support import vtk_to_numpy

    sizes = vtk.vtkCellSizeFilter()
    sizes.SetInputData(truth)
    sizes.Update()
    volumes = np.abs(vtk_to_numpy(sizes.GetOutput().GetCellData().GetArray("Volume")))
    mine, right = volume_of(mesh), volumes.sum()
    if not abs(mine.sum() - right) <= tolerance * right:
        return f"volume {mine.sum():.6g}, not {right:.6g}"
    name, _, part = (mesh.report.field or "t").partition(".")
    cellwise = mesh.location == "cell"
    data = truth.GetCellData() if cellwise else truth.GetPointData()
    if not data.HasArray(name):
        return f"the truth has no field {name}"
    values = vtk_to_numpy(data.GetArray(name)).astype(np.float64)
    if values.ndim > 1:
        values = values[:, "xyz".index(part)]
    if cellwise:
        a, b = (mine * np.asarray(mesh.values)).sum(), (volumes * values).sum()
        return (
            None if abs(a - b) <= TOLERANCE * abs(volumes * values).sum() else f"integral {a}, {b}"
        )
    from scipy.spatial import KDTree

    used = np.unique(np.asarray(mesh.cells))
    got = np.asarray(mesh.values, np.float64)
    if mesh.location == "corner":
        used, got = np.asarray(mesh.cells).ravel(), got.ravel()
    else:
        got = got[used]
    where = np.asarray(mesh.points, np.float64)[used]
    points = vtk_to_numpy(truth.GetPoints().GetData()).astype(np.float64)
    size = np.ptp(points, axis=0).max()
    near = KDTree(points).query_ball_point(where, 1e-6 * size)
    new = sum(not n for n in near)
    cells = sum(n for k, n in mesh.report.input_cells if k.startswith("polyhedron"))
    if new > cells:  # centroids of polyhedra are new points
        return f"{new} points that the truth has not"
    span = np.ptp(values) or 1.0
    # points that coincide may have several values: one of them is meant
    off = max(min(abs(values[n] - v)) for n, v in zip(near, got, strict=True) if n)
    return None if off <= TOLERANCE * span else f"a value is off by {off:g}"


def rows(folder: Path, only: str = "") -> Iterator[dict[str, str]]:
    for kind in file_formats.KINDS:
        if only and only not in kind.name:
            continue
        place = folder / kind.name.replace("/", "_").replace(" ", "_")
        place.mkdir()
        row = {"kind": kind.name, "writer": kind.writer}
        try:
            made = kind.make(place)
        except ImportError as e:
            yield row | {"outcome": "not made", "what": f"needs the package {e.name}"}
            continue
        except Exception as e:  # of other packages' writers
            yield row | {"outcome": "not made", "what": f"{type(e).__name__}: {e}"}
            continue
        yield row | attempt(made)


def attempt(made: file_makers.Made) -> dict[str, str]:
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            mesh = jaxvr.read_mesh(made.path, made.field, **made.how)
        except (ValueError, OSError) as e:
            text = str(e).replace(str(made.path.parent) + "/", "")
            return {"outcome": "refused", "what": text}
    truth = truth_of(made.truth() if isinstance(made.truth, Callable) else made.truth)
    wrong = compare(mesh, truth, made.tolerance)
    told = "; ".join(str(w.message).replace("\n", " ") for w in said)
    what = f"{made.note}{mesh.n_tets} tetrahedra, {mesh.report.field}" + (
        f" ({told})" if told else ""
    )
    return {"outcome": "right" if wrong is None else "WRONG", "what": wrong or what}


def page(table: list[dict[str, str]]) -> str:
    counts = collections.Counter(row["outcome"] for row in table)
    lines = [
        "# Kinds of files",
        "",
        "Made by `python -m experiments.file_kinds`, whose docstring says what is compared. "
        f"{len(table)} kinds: " + ", ".join(f"{n} {k}" for k, n in counts.most_common()) + ".",
        "",
        "| kind | written by | outcome | what came of it |",
        "|---|---|---|---|",
    ]
    for row in table:
        what = row["what"].replace("|", "\\|").replace("\n", " ")[:260]
        lines.append(f"| {row['kind']} | {row['writer']} | {row['outcome']} | {what} |")
    return "\n".join(lines) + "\n"


def public(names: str) -> list[dict[str, str]]:
    """Files of the outside data, where they are at hand."""
    place = folder("data")
    found = []
    for path in sorted(place.glob(names)) if place is not None and place.is_dir() else []:
        made = file_makers.Made(path, lambda path=path: file_makers.by_vtk(path), None)
        if path.name == "can.vtu":  # its faces are not plane, and VTK cuts them another way
            made.tolerance, made.note = 1e-3, "volume to 1e-3, its faces are not plane; "
        row = {"kind": path.name, "writer": "outside data"}
        found.append(row | attempt(made))
    return found


def main(argv: list[str] | None = None) -> list[dict[str, str]]:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, help="folder for files.md")
    parser.add_argument("--only", default="", help="kinds with this in their name")
    arguments = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as place:
        table = [*rows(Path(place), arguments.only)]
    if not arguments.only:
        table += public("*.vtu")
    for row in table:
        if arguments.only or row["outcome"] != "right":
            print(f"{row['kind']} ({row['writer']}): {row['outcome']}: {row['what']}")
    print(collections.Counter(row["outcome"] for row in table))
    if arguments.out:
        arguments.out.mkdir(parents=True, exist_ok=True)
        (arguments.out / "files.md").write_text(page(table))
    return table


if __name__ == "__main__":
    main()
