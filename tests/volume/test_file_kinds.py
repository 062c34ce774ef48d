"""Kinds of files, read right or refused: those that the packages of the tests can write."""

import warnings

import numpy as np
import pytest

from experiments import file_formats, file_kinds, file_makers
from jaxvr.volume import TetMesh, read_mesh
from jaxvr.volume.io import exodus, meshio_files, process
from jaxvr.volume.io.content import Ask, Content, Trouble
from tests.mesh_files import BY_NAME, quietly, volume

# What packages that are not among those of the tests write.
ELSEWHERE = ("gmsh", "netCDF4")
HDF5 = (
    "XDMF, numbers in HDF5",
    "XDMF, numbers in the XML",
    "XDMF, mixed cells",
    "Exodus by meshio",
    "MED",
    "MOAB",
    "HMF",
)
REFUSED = {
    "VTU, a polyhedron that is not convex": "not convex or not closed.*cells 0, 2, 4, 6",
    "VTM, a field on one block, both asked for": r"4 in 'left' have no .*Pass block=\['right'\]",
    "a compressed VTU (.vtu.gz)": "gunzip it first",
}
MADE = [
    k
    for k in file_formats.KINDS
    if not any(word in k.writer for word in ELSEWHERE)
    and k.name not in (*HDF5, "gmsh 4.1 by meshio, binary")
]


@pytest.mark.parametrize("kind", MADE, ids=lambda k: k.name)
def test_kinds(kind, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Warning)  # of the writers
        made = kind.make(tmp_path)
    if kind.name in REFUSED:
        with pytest.raises(ValueError, match=REFUSED[kind.name]):
            read_mesh(made.path, made.field, **made.how)
    else:
        row = file_kinds.attempt(made)
        assert row["outcome"] == "right", row


@pytest.mark.parametrize(
    "name",
    [k.name for k in MADE if k.name.startswith(("VTU", "legacy VTK", "XDMF", "AVS"))],
)
def test_without_vtk_the_same_or_a_clear_refusal(name, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Warning)
        made = BY_NAME[name].make(tmp_path)
    more = {"field": made.field, "location": None, "values": False, "path": str(made.path)}
    step = made.how.get("step")
    try:
        got = process.run("read", None, None, ask=Ask(step, vtk=False), **more)
    except Trouble as e:
        if e.kind == "package":  # meshio asks for it, also where numbers are in the XML
            assert name.startswith("XDMF") and "h5py" in e.message
        else:
            assert e.kind in ("unsupported", "damaged", "suffix"), e
        return
    mesh = TetMesh.from_cells(
        got["points"],
        {t: range(c) if isinstance(c, int) else c for t, c in got["cells"].items()},
        got["values"],
        location=got["location"],
    )
    other = quietly(made.path, made.field, dtype=mesh.dtype, step=step)
    assert volume(mesh) == pytest.approx(volume(other), rel=1e-12)
    assert sorted(mesh.report.input_cells) == sorted(other.report.input_cells)
    assert np.array_equal(np.sort(mesh.values), np.sort(other.values))


def test_parts_that_meshio_passes_over_are_refused_without_vtk(tmp_path):
    for name, words in (("VTU, several pieces", "has 27 cells"), ("VTU, voxels among", "cells")):
        kind = next(k for k in MADE if k.name.startswith(name))
        place = tmp_path / words
        place.mkdir()
        made = kind.make(place)
        with pytest.raises(Trouble, match=words):
            process.run("fields", None, None, path=str(made.path), ask=Ask(vtk=False))


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.su2", "NZONE= 2\nIZONE= 1\nNDIME= 3\n", "2 zones"),
        ("a.inp", "*PART, NAME=A\n*END PART\n*Part, name=B\n*END PART\n", "2 parts"),
        ("a.inp", "*INSTANCE, NAME=A, PART=A\n*END INSTANCE\n" * 2, "2 instances"),
        ("a.inp", "*Instance, name=A, part=A\n 0., 0., 5.\n*End Instance\n", "is moved"),
        ("a.bdf", "BEGIN BULK\nGRID           1       5     0.0     0.0     0.0\n", "system 5"),
        ("a.bdf", "BEGIN BULK\nGRID,1,2,0.,0.,0.\n", "system 2"),
        ("a.bdf", "BEGIN BULK\nGRDSET,,7\n", "system 7"),
    ],
)
def test_files_of_which_a_part_would_be_read_or_misplaced(name, text, words, tmp_path):
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=f"kind that is not supported: .*{words}"):
        read_mesh(tmp_path / name)


def test_all_zones_of_a_tecplot_file(tmp_path):
    zone = "ZONE N=4, E=1, F=FEPOINT, ET=TETRAHEDRON\n"
    rows = [[0, 0, 0, 1], [1, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 1]]
    text = 'VARIABLES = "X" "Y" "Z" "t"\n'
    for k in range(2):
        text += zone + "".join(f"{x + 3 * k} {y} {z} {t + k}\n" for x, y, z, t in rows)
        text += "1 2 3 4\n"
    (tmp_path / "a.dat").write_text(text)
    assert quietly(tmp_path / "a.dat").n_tets == 2
    with pytest.raises(Trouble, match="2 zones"):
        meshio_files.read(tmp_path / "a.dat", Ask(), str, ".dat")


def test_exodus_scalar_with_the_name_of_a_stem():
    names = ("vel", "velx", "vely", "velz", "u_x", "u_y", "u_z")
    content = Content(np.eye(4, 3), [], point={n: np.full(4, k) for k, n in enumerate(names)})
    exodus._vectors(content)
    assert sorted(content.point) == ["u", "vel", "velx", "vely", "velz"]
    assert content.point["vel"].tolist() == [0] * 4


def test_digits_of_ugrid_files_of_text(tmp_path):
    """Which meshio keeps as float32; and numbers as it writes them with NumPy 2."""
    points = np.array([[5e6, 4e6, 0.0]]) + np.eye(4, 3) * 1.25
    grid = file_makers.unstructured([(10, [[3, 0, 1, 2]])], points)
    text = file_formats.ugrid(grid, "")
    (tmp_path / "a.ugrid").write_bytes(text)
    mesh = read_mesh(tmp_path / "a.ugrid", values=np.arange(4.0), dtype="float64")
    np.testing.assert_array_equal(mesh.points, points)
    assert mesh.report.ignored == (("triangle", 2),)
    head, _, rest = text.partition(b"\n")
    counts = b" ".join(b"np.int64(%s)" % n for n in head.split())
    (tmp_path / "b.ugrid").write_bytes(counts + b"\n" + rest)
    again = read_mesh(tmp_path / "b.ugrid", values=np.arange(4.0), dtype="float64")
    np.testing.assert_array_equal(again.points, points)


@pytest.mark.parametrize("form", ["", "b8", "lb4", "lr8", "b8l"])
def test_ugrid_files_cut_short(form, tmp_path):
    """Wherever they are cut: an error, or, behind the last cell, the mesh."""
    grid = file_makers.zoo()
    whole = file_formats.ugrid(grid, form)
    path = tmp_path / (f"a.{form}.ugrid" if form else "a.ugrid")
    for part in np.linspace(0.05, 0.97, 9):
        path.write_bytes(whole[: int(part * len(whole))])
        with pytest.raises(ValueError, match="damaged, cut short|not supported"):
            read_mesh(path, values=file_makers.linear)
