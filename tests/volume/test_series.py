"""Files that list files, and blocks in blocks: fields that some of them lack; counts of headers."""

import importlib
import warnings
from typing import Any

import numpy as np
import pytest

from jaxvr.volume import Field, list_fields, read_mesh
from jaxvr.volume.io import series, sizes

with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)  # in what PyVista imports
    pyvista: Any = importlib.import_module("pyvista")


def box(x, *fields):
    grid = pyvista.ImageData(dimensions=(2, 2, 2), origin=(x, 0, 0)).cast_to_unstructured_grid()
    for name in fields:
        grid.point_data[name] = x + np.arange(8.0)
    grid.cell_data["c"] = [x]
    return grid


def collection(path, *entries):
    """entries: (time, part, file)."""
    sets = "".join(f'<DataSet timestep="{t}" part="{p}" file="{f}"/>' for t, p, f in entries)
    path.write_text(f'<VTKFile type="Collection"><Collection>{sets}</Collection></VTKFile>')
    return path


@pytest.fixture
def folder(tmp_path):
    blocks = {"left": box(0.0, "t"), "right": box(1.0, "t", "only")}
    pyvista.MultiBlock(blocks).save(tmp_path / "a.vtm")
    box(5.0, "t").save(tmp_path / "b.vtu")
    box(5.0, "other").save(tmp_path / "c.vtu")
    return tmp_path


def test_blocks_in_parts(folder):
    """A point field on one inner block is not NaN on the others, but told."""
    path = collection(folder / "a.pvd", (0, "fluid", "a.vtm"), (0, "solid", "b.vtu"))
    names = ("fluid/left", "fluid/right", "solid")
    assert list_fields(path) == [
        Field("t", "point", 1, names),
        Field("only", "point", 1, ("fluid/right",)),
        Field("c", "cell", 1, names),
    ]
    for block in (None, "fluid", 0, ["fluid/left", "fluid/right"]):
        with pytest.raises(ValueError, match=r"have no value. Pass block=\['fluid/right'\]"):
            read_mesh(path, "only", block=block)
    assert read_mesh(path, "only", block="fluid/right").values.tolist() == list(range(1, 9))
    for block, values in (
        ("fluid/left", {0.0}),
        ("fluid/right", {1.0}),
        (["fluid/left", "solid"], {0.0, 5.0}),
        (["fluid/left", "fluid"], {0.0, 1.0}),
        (1, {5.0}),
        (None, {0.0, 1.0, 5.0}),
    ):
        assert set(read_mesh(path, "c", block=block).values.tolist()) == values
    for bad in ("left", "fluid/middle", "fluid/", 2):
        with pytest.raises(ValueError, match="There is no block"):
            read_mesh(path, "c", block=bad)


def test_the_blocks_of_the_only_part_keep_their_names(folder):
    path = collection(folder / "a.pvd", (0, "fluid", "a.vtm"))
    assert list_fields(path)[1] == Field("only", "point", 1, ("right",))
    assert read_mesh(path, "only", block="right").n_tets == 6


@pytest.mark.parametrize("with_header", [True, False])
def test_fields_of_all_steps(folder, with_header, monkeypatch):
    """Also those that the last step has not."""
    if not with_header:
        monkeypatch.setattr(series, "_names", lambda *_: None)
        run_here(monkeypatch)
    entries = [(0, "0", "b.vtu"), (0.5, "0", "c.vtu"), (1, "0", "a.vtm"), (2, "0", "c.vtu")]
    path = collection(folder / "a.pvd", *entries)
    found = {f.name: f.steps for f in list_fields(path)}
    assert found == {
        "other": (0.5, 2.0), "c": (0.0, 0.5, 1.0, 2.0), "t": (0.0, 1.0), "only": (1.0,),
    }  # fmt: skip
    with pytest.raises(ValueError, match=r"a.pvd, at time 2, has no field 't'. It has 'other'"):
        read_mesh(path, "t", step=-1)
    for step in (0, 0.0, -4):
        assert read_mesh(path, "t", step=step).n_tets == 6


def run_here(monkeypatch):
    """Readers in this process, where they can be looked at."""
    from jaxvr.volume.io import process

    monkeypatch.setattr(process, "python", lambda: None)
    monkeypatch.setattr(process, "_warned", True)


def test_steps_that_are_not_looked_at_are_told(folder, monkeypatch):
    monkeypatch.setattr(series, "_names", lambda *_: None)
    monkeypatch.setattr(series, "MOST", 2)
    run_here(monkeypatch)
    path = collection(folder / "a.pvd", *((k, "0", "b.vtu") for k in range(5)))
    with pytest.warns(UserWarning, match="a.pvd: It has 5 steps, of which 2 .* from 2 to 3."):
        found = list_fields(path)
    assert [f.steps for f in found] == [(0.0, 1.0, 4.0)] * 2


def pieces(folder, names):
    text = "".join(f'<Piece Source="{n}"/>' for n in names)
    points = '<PPoints><PDataArray type="Float64" NumberOfComponents="3"/></PPoints>'
    data = '<PPointData><PDataArray type="Float64" Name="t"/></PPointData>'
    path = folder / "a.pvtu"
    path.write_text(
        f'<VTKFile type="PUnstructuredGrid"><PUnstructuredGrid>{data}{points}{text}'
        "</PUnstructuredGrid></VTKFile>"
    )
    return path


def test_pieces_and_blocks_whose_file_is_not_there(folder):
    box(6.0, "t").save(folder / "d.vtu")
    assert read_mesh(pieces(folder, ["b.vtu", "d.vtu"])).n_tets == 12
    with pytest.raises(ValueError, match="damaged|cut short") as e:
        read_mesh(pieces(folder, ["b.vtu", "none.vtu"]))
    assert "'none.vtu', which is not there" in str(e.value)
    next((folder / "a").glob("*_1.vtu")).unlink()
    with pytest.raises(ValueError, match=r"_1.vtu', which is not there"):
        read_mesh(folder / "a.vtm", "t")


@pytest.mark.parametrize("name", ["b.vtu", "a.vtm", "a.pvtu", "a.vtk", "b.vtk", "c.vtk"])
@pytest.mark.parametrize("what", ["points", "cells"])
def test_what_comes_out_is_compared_with_the_header(name, what, folder, monkeypatch):
    if name == "a.pvtu":
        pieces(folder, ["b.vtu"])
    if name.endswith(".vtk"):  # in both versions of the format
        text = "# vtk DataFile Version {}\na\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS 4 float\n"
        text += "0 0 0 1 0 0 0 1 0 0 0 1\n"
        old = "CELLS 1 5\n4 0 1 2 3\n"
        new = "CELLS 2 4\nOFFSETS vtktypeint64\n0 4\nCONNECTIVITY vtktypeint64\n0 1 2 3\n"
        text = text.format("3.0") + old if name == "a.vtk" else text.format("5.1") + new
        text += "CELL_TYPES 1\n10\n"
        if name == "c.vtk":
            text = "# vtk DataFile Version 3.0\na\nASCII\nDATASET STRUCTURED_POINTS\n"
            text += "DIMENSIONS 2 2 2\nORIGIN 0 0 0\nSPACING 1 1 1\n"
        values = " ".join(map(str, range(8 if name == "c.vtk" else 4)))
        text += (
            f"POINT_DATA {len(values.split())}\nSCALARS t float\nLOOKUP_TABLE default\n{values}\n"
        )
        (folder / name).write_text(text)
    run_here(monkeypatch)
    assert read_mesh(folder / name, "t").n_tets
    claims = sizes.claims

    def more(path, suffix):
        found = claims(path, suffix)
        return found | {what: found[what] + 1}

    monkeypatch.setattr(sizes, "claims", more)
    with pytest.raises(ValueError, match=rf"it has \d+ {what}, of which \w+ reads \d+"):
        read_mesh(folder / name, "t")


def written(path, data):
    """A file by VTK's own writer."""
    kinds = {
        ".vti": "ImageData", ".vtr": "RectilinearGrid", ".vts": "StructuredGrid",
        ".pvti": "PImageData", ".pvtr": "PRectilinearGrid", ".pvts": "PStructuredGrid",
        ".vtpd": "PartitionedDataSet", ".vtpc": "PartitionedDataSetCollection",
    }  # fmt: skip
    parallel = path.suffix.startswith(".p")
    plain = path.suffix in (".vti", ".vtr", ".vts")
    module = importlib.import_module(f"vtkmodules.vtkIO{'' if plain else 'Parallel'}XML")
    writer = getattr(module, f"vtkXML{kinds[path.suffix]}Writer")()
    writer.SetFileName(str(path))
    writer.SetInputData(data)
    writer.SetDataModeToAscii()
    if parallel:
        writer.SetNumberOfPieces(1)
    assert writer.Write()
    return path


def structured(suffix):
    """Of 4 x 3 x 2 points, and what VTK's files of this suffix hold."""
    from vtkmodules.vtkCommonDataModel import vtkPartitionedDataSet, vtkPartitionedDataSetCollection

    image = pyvista.ImageData(dimensions=(4, 3, 2))
    image.point_data["t"] = np.arange(24.0)
    if suffix in (".vtpd", ".vtpc"):
        parts = vtkPartitionedDataSet()
        parts.SetPartition(0, image)
        parts.SetPartition(1, image.cast_to_structured_grid().translate((5, 0, 0)))
        if suffix == ".vtpd":
            return parts
        parts_of_parts = vtkPartitionedDataSetCollection()
        parts_of_parts.SetPartitionedDataSet(0, parts)
        return parts_of_parts
    return {
        "i": lambda: image, "r": image.cast_to_rectilinear_grid, "s": image.cast_to_structured_grid
    }[suffix[-1]]()  # fmt: skip


STRUCTURED = (".vti", ".vtr", ".vts", ".pvti", ".pvtr", ".pvts")


@pytest.mark.parametrize("suffix", [*STRUCTURED, ".vtpd", ".vtpc"])
def test_structured_grids_are_compared_with_their_extents(suffix, tmp_path, monkeypatch):
    run_here(monkeypatch)
    path = written(tmp_path / f"a{suffix}", structured(suffix))
    n = 1 if suffix in STRUCTURED else 2
    claims = sizes.claims
    assert claims(path, suffix) == {"points": 24 * n, "cells": 6 * n}
    assert read_mesh(path, "t").n_tets == 36 * n
    for what in ("points", "cells"):
        monkeypatch.setattr(sizes, "claims", lambda *a, w=what: {w: claims(*a)[w] + 1})
        with pytest.raises(ValueError, match=rf"it has \d+ {what}, of which \w+ reads \d+"):
            read_mesh(path, "t")


@pytest.mark.parametrize("suffix", STRUCTURED)
def test_pieces_that_do_not_cover_the_whole(suffix, tmp_path):
    """VTK gives what it finds in the memory for what is in none of them."""
    path = written(tmp_path / f"a{suffix}", structured(suffix))
    assert read_mesh(path, "t").n_tets == 36
    text = path.read_text()
    assert text.count('WholeExtent="0 3 0 2 0 1"') == 1
    path.write_text(text.replace('WholeExtent="0 3 0 2 0 1"', 'WholeExtent="0 4 0 2 0 1"'))
    with pytest.raises(ValueError, match=rf"a\{suffix} has 8 cells, of which pieces hold 6"):
        read_mesh(path, "t")
    if suffix.startswith(".p"):
        path.write_text(text)
        (tmp_path / f"a_0.{suffix[2:]}").unlink()
        with pytest.raises(ValueError, match="it names 'a_0.*', which is not there"):
            read_mesh(path, "t")


def test_cells_that_pieces_cover():
    rng = np.random.default_rng(0)
    counts = set()
    for k in range(200):
        last = rng.integers(0 if k % 3 == 0 else 1, 5, 3)
        whole = tuple(np.stack([[0, 0, 0], last], 1).ravel().tolist())
        hit = np.zeros(np.maximum(last, 1), bool)
        pieces = []
        for _ in range(rng.integers(0, 5)):
            ends = np.sort(rng.integers(0, last + 1, (2, 3)), axis=0)
            pieces.append(tuple(ends.T.ravel().tolist()))
            box = (slice(a, b + (m == 0)) for a, b, m in zip(*ends, last, strict=True))
            hit[tuple(box)] = True
        assert sizes._covered(whole, pieces) == hit.sum()
        counts.add(int(hit.sum()))
    assert len(counts) > 10


def test_counts_of_all_blocks_are_compared_when_some_are_read(folder, monkeypatch):
    run_here(monkeypatch)
    assert read_mesh(folder / "a.vtm", "t", block="left").n_tets == 6
    monkeypatch.setattr(sizes, "claims", lambda *_: {"points": 24, "cells": 2})
    with pytest.raises(ValueError, match="it has 24 points, of which .* reads 16"):
        read_mesh(folder / "a.vtm", "t", block="left")


def test_ghosts_are_left_out_and_counted(tmp_path):
    """What a header counts is what is read, before ghosts are left out."""
    grid = pyvista.ImageData(dimensions=(3, 2, 2)).cast_to_unstructured_grid()
    grid.point_data["t"] = np.arange(12.0)
    grid.cell_data["vtkGhostType"] = np.array([0, 1], np.uint8)
    grid.save(tmp_path / "a.vtu")
    assert sizes.claims(tmp_path / "a.vtu", ".vtu") == {"points": 12, "cells": 2}
    assert read_mesh(tmp_path / "a.vtu").n_tets == 6
