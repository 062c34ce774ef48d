"""Kinds of files, and what goes wrong with them: nothing is left out in silence."""

import enum
import errno
import os
import subprocess
import sys
import threading
import warnings
from typing import Any

import numpy as np
import pytest

from experiments import file_kinds, file_makers
from jaxvr.volume import Field, TetMesh, datasets, list_fields, read_mesh, write_mesh
from jaxvr.volume.io import exodus, fields, meshio_files, process, registry, sizes, write
from jaxvr.volume.io.content import Ask, Content, Part, Trouble, join

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
BY_NUMPY_2 = ("UGRID",)  # meshio writes np.int64(...) into it
MADE = [
    k
    for k in file_makers.KINDS
    if not any(word in k.writer for word in ELSEWHERE)
    and k.name not in (*HDF5, *BY_NUMPY_2, "gmsh 4.1 by meshio, binary")
]
BY_NAME = {k.name: k for k in file_makers.KINDS}
CORNER = """$MeshFormat
2.2 0 8
$EndMeshFormat
$PhysicalNames
2
3 7 "lower part"
3 8 "upper part"
$EndPhysicalNames
$Nodes
5
10 0 0 0
20 1 0 0
30 0 1 0
2147483647 0 0 1
50 0 0 -1
$EndNodes
$Elements
3
1 2 2 1 1 10 20 30
2 4 2 8 1 10 20 30 2147483647
3 4 2 7 1 10 30 20 50
$EndElements
$ElementNodeData
1
"k"
1
0.0
3
0
1
2
2 4 1 2 3 4
3 4 -1 2 3 5
$EndElementNodeData
$ElementData
1
"up"
1
0.0
3
0
1
1
2 3.5
$EndElementData
"""
STEP = '$NodeData\n1\n"temp"\n1\n{t}\n3\n{k}\n1\n5\n10 {v}\n20 {v}\n30 {v}\n2147483647 {v}\n50 {v}\n$EndNodeData\n'  # noqa: E501


@pytest.fixture
def msh(tmp_path):
    path = tmp_path / "a.msh"
    path.write_text(CORNER + "".join(STEP.format(t=0.5 * k, k=k, v=100 + k) for k in range(3)))
    return path


def quietly(path, *args, **kwargs):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return read_mesh(path, *args, **kwargs)


def volume(mesh):
    return file_kinds.volume_of(mesh).sum()


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


def test_gmsh_steps_blocks_and_corners(msh):
    assert list_fields(msh) == [
        Field("temp", "point", 1, ("lower part", "upper part"), (0.0, 0.5, 1.0)),
        Field("up", "cell", 1, ("upper part",)),
        Field("k", "corner", 1, ("lower part", "upper part")),
    ]
    with pytest.warns(UserWarning, match="3 time steps, at 0 to 1, of which the last"):
        assert read_mesh(msh).values.tolist() == [102.0] * 5
    assert read_mesh(msh, step=0).values.tolist() == [100.0] * 5
    assert read_mesh(msh, step=-2).values.tolist() == [101.0] * 5
    assert read_mesh(msh, step=0.5).values.tolist() == [101.0] * 5
    for bad, words in ((3, "has 3, at times 0, 0.5, 1"), (0.7, "no step at time 0.7")):
        with pytest.raises(ValueError, match=words):
            read_mesh(msh, step=bad)
    mesh = read_mesh(msh, "k")
    assert mesh.location == "corner" and mesh.report.ignored == (("triangle", 1),)
    at = np.asarray(mesh.points)[np.asarray(mesh.cells)]
    assert sorted(np.asarray(mesh.values)[at[..., 2] != 0].tolist()) == [4.0, 5.0]
    assert sorted(np.asarray(mesh.values)[(at == 0).all(-1)].tolist()) == [-1.0, 1.0]
    with pytest.raises(ValueError, match=r"1 in 'lower part' have no value. Pass block=\['upper"):
        read_mesh(msh, "up")
    for block in ("upper part", 1, ["upper part"]):
        assert read_mesh(msh, "up", block=block).values.tolist() == [3.5]
    with pytest.raises(ValueError, match="no block 'x'. It has 'lower part', 'upper part'"):
        read_mesh(msh, block="x")
    strange: Any = (True, "0", [0])
    for bad in strange:
        with pytest.raises(ValueError, match="step must be"):
            read_mesh(msh, step=bad)


def test_corner_data_of_hexahedra_on_points_of_their_own(tmp_path):
    box = datasets.box((2, 1, 1), cell="hexahedron")
    grid = file_makers.unstructured([(12, [[0, 1, 4, 3, 6, 7, 10, 9]])], box.points)
    lines = ["$MeshFormat", "2.2 0 8", "$EndMeshFormat", "$Nodes", str(grid.n_points)]
    lines += [f"{k} {x} {y} {z}" for k, (x, y, z) in enumerate(grid.points.tolist())]
    lines += ["$EndNodes", "$Elements", "2", "1 5 0 0 1 4 3 6 7 10 9", "2 5 0 1 2 5 4 7 8 11 10"]
    lines += ["$EndElements", "$ElementNodeData", "1", '"k"', "1", "0", "3", "0", "1", "2"]
    lines += ["1 8 " + "1 " * 8, "2 8 " + "2 " * 8, "$EndElementNodeData", ""]
    (tmp_path / "a.msh").write_text("\n".join(lines))
    mesh = read_mesh(tmp_path / "a.msh")
    assert mesh.location == "point" and mesh.n_points == 16 and mesh.n_tets == 12
    assert mesh.n_boundary == 20 and volume(mesh) == pytest.approx(1)
    x = np.asarray(mesh.points)[np.asarray(mesh.cells)].mean(1)[:, 0]
    assert np.array_equal(np.asarray(mesh.values)[np.asarray(mesh.cells)[:, 0]], 1 + (x > 0.5))


def test_values_from_elsewhere(tmp_path):
    made = BY_NAME["Abaqus"].make(tmp_path)
    with pytest.raises(ValueError, match="It has no fields. If its values .* pass values="):
        read_mesh(made.path)
    mesh = read_mesh(made.path, values=file_makers.linear)
    assert np.allclose(mesh.values, file_makers.linear(mesh.points))
    same = read_mesh(made.path, values=np.asarray(mesh.values))
    assert np.array_equal(same.values, mesh.values)
    assert read_mesh(made.path, values=np.arange(8.0)).location == "cell"
    with pytest.raises(ValueError, match=r"a.inp: values must have shape"):
        read_mesh(made.path, values=np.zeros(3))
    with pytest.raises(ValueError, match="not both"):
        read_mesh(made.path, "t", values=file_makers.linear)


def test_paths(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    mesh = datasets.box((1, 1, 1))
    write_mesh("~/a b.vtu", mesh)
    assert (tmp_path / "a b.vtu").is_file() and read_mesh("~/a b.vtu").n_tets == mesh.n_tets
    with pytest.raises(ValueError, match="is an address.*download"):
        read_mesh("https://example.org/a.vtu")
    for name, words in (
        ("a.unv", "gmsh converts it"), ("a.qqq", "suffix '.qqq' is unknown.*read: .*.vtu"),
        ("a", "no suffix"), ("a.npz", "numpy.load"),
    ):  # fmt: skip
        (tmp_path / name).write_text("something")
        with pytest.raises(ValueError, match=f"unknown kind: .*{words}"):
            read_mesh(tmp_path / name)
    (tmp_path / "a b.vtu").rename(tmp_path / "nothing")  # its first bytes tell
    assert read_mesh(tmp_path / "nothing").n_tets == mesh.n_tets


def test_a_missing_package_is_named(tmp_path, monkeypatch):
    (tmp_path / "a.med").write_bytes(b"\x89HDF\r\n\x1a\n")

    def reader(*_):
        raise ImportError("No module named 'h5py'", name="h5py")

    monkeypatch.setattr(registry, "_readers", lambda suffix, vtk: [reader])
    with pytest.raises(
        Trouble, match="package h5py, which is not installed: pip install h5py"
    ) as e:
        registry.read(tmp_path / "a.med", Ask(), str)
    assert e.value.kind == "package"


def test_small_files_that_ask_for_much(tmp_path):
    (tmp_path / "a.vti").write_text(
        '<VTKFile type="ImageData"><ImageData WholeExtent="0 99999 0 99999 0 99999" Origin="0 0 0" '
        'Spacing="1 1 1"><Piece Extent="0 99999 0 99999 0 99999"/></ImageData></VTKFile>'
    )
    with pytest.raises(ValueError, match="takes more memory than the 2048 MB that it may.*extent"):
        read_mesh(tmp_path / "a.vti")
    claims = (
        ("a.vtu", b'<VTKFile type="UnstructuredGrid"><UnstructuredGrid><Piece NumberOfPoints='
         b'"999999999" NumberOfCells="1"/></UnstructuredGrid></VTKFile>', "999999999 points"),
        ("a.vtk", b"# vtk DataFile Version 3.0\na\nASCII\nDATASET UNSTRUCTURED_GRID\n"
         b"POINTS 999999999 float\n0 0 0\n", "999999999 points"),
        ("a.msh", b"$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n999999999\n1 0 0 0\n$EndNodes\n",
         "999999999 nodes"),
        ("b.msh", b"$MeshFormat\n4.1 0 8\n$EndMeshFormat\n$Nodes\n1 9999999999 1 2\n3 1 0 "
         b"9999999999\n1\n0 0 0\n$EndNodes\n", "asks for 9999999999 numbers"),
        ("a.ugrid", b"999999999 0 0 1 0 0 0\n0 0 0\n", "999999999 points"),
    )  # fmt: skip
    for name, text, words in claims:
        (tmp_path / name).write_bytes(text)
        with pytest.raises(ValueError, match=f"damaged, cut|{words}") as e:
            read_mesh(tmp_path / name)
        assert words in str(e.value)


def test_limits(tmp_path):
    path = tmp_path / "a.vtu"
    write_mesh(path, datasets.box((2, 2, 2)))
    assert sizes.memory(10) == 2 << 30 and sizes.memory(1 << 30) == 200 << 30
    image = BY_NAME["VTI"].make(tmp_path).path
    assert read_mesh(image).n_tets == 72
    with pytest.raises(ValueError, match="more memory than the 0 MB.*max_memory="):
        read_mesh(image, max_memory=8000)
    for limit in (None, 2**31):
        assert read_mesh(path, max_memory=limit).n_tets == 48
    for bad in (0, -1, "much", True):
        with pytest.raises(ValueError, match="max_memory must be"):
            read_mesh(path, max_memory=bad)


def test_a_reader_that_crashes(tmp_path, monkeypatch):
    """What it does to its process does not reach this one; the next file is read."""
    path = tmp_path / "a.vtu"
    write_mesh(path, datasets.box((1, 1, 1)))
    crashing = tmp_path / "child.py"  # takes the request, and is killed
    crashing.write_text(
        "import os, sys\nsys.stdin.buffer.read(1)\nos.write(1, b'!')\nos.kill(os.getpid(), 9)\n"
    )
    monkeypatch.setattr(process, "_CHILD", crashing)
    monkeypatch.setattr(process._pool, "idle", [])
    with pytest.raises(ValueError, match="takes more memory"):  # as the system ends those that do
        read_mesh(path)
    assert process._pool.idle == []
    monkeypatch.undo()
    assert read_mesh(path).n_tets == 6


def test_a_process_that_ended_while_idle_is_replaced(tmp_path):
    path = tmp_path / "a.vtu"
    write_mesh(path, datasets.box((1, 1, 1)))
    for worker in process._pool.idle:
        worker.kill()
        worker.wait()
    assert read_mesh(path).n_tets == 6


def test_threads_change_nothing_of_the_process(tmp_path, capsys):
    streams, filters = (sys.stdout, sys.stderr), list(warnings.filters)
    mesh = datasets.box((2, 2, 2), field=lambda p: p[:, 0])
    failed = []

    def work(k):
        try:
            for n in range(5):
                path = tmp_path / f"{k}.{'vtu' if n % 2 else 'vtk'}"
                write_mesh(path, mesh)
                assert np.array_equal(read_mesh(path).values, mesh.values)
                with pytest.raises(ValueError, match="damaged"):
                    (tmp_path / f"{k}.bad.vtu").write_text("<VTKFile")
                    list_fields(tmp_path / f"{k}.bad.vtu")
        except BaseException as e:
            failed.append(e)

    threads = [threading.Thread(target=work, args=(k,)) for k in range(6)]
    for t in threads:
        t.start()
    for n in range(2000):
        print("a line")
    for t in threads:
        t.join()
    assert not failed
    assert (sys.stdout, sys.stderr) == streams and warnings.filters == filters
    said = capsys.readouterr()
    assert said.out.count("a line") == 2000 and not said.err


def test_what_was_there_stays_where_writing_fails(tmp_path):
    mesh = datasets.box((1, 1, 1))
    for name in ("a.stl", "a.inp"):
        (tmp_path / name).write_text("old")
        with pytest.raises(ValueError, match="cannot be written"):
            write_mesh(tmp_path / name, mesh)
        assert (tmp_path / name).read_text() == "old"
    with pytest.raises(OSError, match="File name too long"):
        write_mesh(tmp_path / ("a" * 300 + ".vtu"), mesh)
    (tmp_path / "link.vtu").symlink_to(tmp_path / "real.vtu")
    write_mesh(tmp_path / "link.vtu", mesh)
    assert (tmp_path / "link.vtu").is_symlink() and read_mesh(tmp_path / "real.vtu").n_tets == 6
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "a.inp", "a.stl", "link.vtu", "real.vtu",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("link", "real"),
    [
        ("a.vtu", "store"), ("a", "real.vtu"), ("a", "sub/real.vtk"), ("a.vtk", "store.tmp"),
        ("a.vtk", "real.vtu"), ("a.mesh", "x.y"),
    ],
)  # fmt: skip
def test_links_to_names_with_other_suffixes(link, real, tmp_path):
    """The link's suffix says the format, or else that of the file that it leads to."""
    mesh = datasets.box((1, 1, 1), field=lambda p: p[:, 0])
    (tmp_path / "sub").mkdir()
    (tmp_path / link).symlink_to(tmp_path / real)
    for _ in range(2):  # the file is made, and replaced
        if link.endswith(".mesh"):  # holds no such field
            with pytest.raises(ValueError, match="cannot be written"):
                write_mesh(tmp_path / link, mesh)
            assert not (tmp_path / real).exists()
            continue
        write_mesh(tmp_path / link, mesh)
        assert (tmp_path / link).is_symlink() and (tmp_path / real).is_file()
        head = (tmp_path / real).read_bytes()[:30]
        vtu = (link if "." in link else real).endswith("vtu")
        assert (b"<VTKFile" if vtu else b"# vtk DataFile") in head
        assert np.array_equal(read_mesh(tmp_path / link).values, mesh.values)
    assert not list(tmp_path.rglob(".*"))


def test_cells_of_another_size_than_their_type(tmp_path):
    """As in a public file that came out with a third of its volume."""
    (tmp_path / "a.vtk").write_text(
        "# vtk DataFile Version 5.1\na\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS 20 double\n"
        + "\n".join(f"{k % 3} {k // 3 % 3} {k // 9}" for k in range(20))
        + "\nCELLS 2 20\nOFFSETS vtktypeint64\n0 20\nCONNECTIVITY vtktypeint64\n"
        + " ".join(map(str, range(20)))
        + "\nCELL_TYPES 1\n12\nPOINT_DATA 20\nSCALARS t double\nLOOKUP_TABLE default\n"
        + " ".join(map(str, range(20)))
        + "\n"
    )
    with pytest.raises(ValueError, match="1 of 1 hexahedron cells .* nodes than 8: .* 0 with 20"):
        read_mesh(tmp_path / "a.vtk")


@pytest.mark.parametrize("part", [0.08, 0.2, 1.0])
def test_repairs_of_more_than_a_tenth(part, tmp_path):
    points, cells = file_makers.lattice(5)
    turned = np.arange(len(cells)) < part * len(cells)
    cells[turned] = cells[turned][:, [4, 5, 6, 7, 0, 1, 2, 3]]
    grid = file_makers.unstructured([(12, cells)], points)
    grid.save(str(tmp_path / "a.vtu"))
    if part == 0.2:
        for read in (
            lambda: read_mesh(tmp_path / "a.vtu", "t"),
            lambda: TetMesh.from_pyvista(grid),
        ):
            with pytest.raises(ValueError, match="25 of 125 cells are turned inside out"):
                read()
    else:
        with pytest.warns(UserWarning, match="inverted tetrahedra turned round"):
            assert volume(read_mesh(tmp_path / "a.vtu", "t")) == pytest.approx(
                125 * 1.002, rel=1e-6
            )


def test_cell_values_where_types_take_turns(tmp_path):
    points, hexes = file_makers.lattice(2)
    import pyvista as pv

    a, b, c = hexes[0][[0, 1, 3, 4]], hexes[1], hexes[3][[0, 1, 3, 4]]
    cells = np.concatenate([[4], a, [8], b, [4], c])
    grid = pv.UnstructuredGrid(cells, np.array([10, 12, 10], np.uint8), points)
    grid.save(str(tmp_path / "a.vtu"))
    with pytest.raises(ValueError, match="types of cells take turns.*dict by type"):
        read_mesh(tmp_path / "a.vtu", values=[10.0, 20.0, 30.0])
    mesh = quietly(tmp_path / "a.vtu", values={"tetra": [10.0, 30.0], "hexahedron": [20.0]})
    assert sorted(set(np.asarray(mesh.values).tolist())) == [10.0, 20.0, 30.0]


def test_cell_values_where_groups_take_turns(msh):
    lines = msh.read_text().replace(
        "3 4 2 7 1 10 30 20 50", "3 4 2 7 1 10 30 20 50\n4 4 2 8 1 10 20 30 50"
    )
    msh.write_text(lines.replace("$Elements\n3\n", "$Elements\n4\n"))
    with pytest.raises(ValueError, match="physical groups.*take turns"):
        read_mesh(msh, values=[1.0, 2.0, 3.0])


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


def test_blocks_whose_field_has_other_components():
    def block(data):
        nodes = np.arange(4)[None]
        return Content(np.eye(4, 3), [Part("tetra", nodes)], cell={"a": [data]})

    both = join([block(np.ones(1)), block(np.ones((1, 3)))], ["one", "two"])
    with pytest.raises(Trouble, match="1 in 'two' have no value"):
        fields.arrays_of(both, "f", "a", None)
    assert "other numbers of components" in both.notes[0]


def test_exodus_scalar_with_the_name_of_a_stem():
    names = ("vel", "velx", "vely", "velz", "u_x", "u_y", "u_z")
    content = Content(np.eye(4, 3), [], point={n: np.full(4, k) for k, n in enumerate(names)})
    exodus._vectors(content)
    assert sorted(content.point) == ["u", "vel", "velx", "vely", "velz"]
    assert content.point["vel"].tolist() == [0] * 4


def test_steps_and_blocks_of_files_without(tmp_path, msh):
    write_mesh(tmp_path / "a.vtu", datasets.box((1, 1, 1)))
    (tmp_path / "a.pvd").write_text(
        '<VTKFile type="Collection"><Collection><DataSet timestep="0.5" file="a.vtu"/>'
        "</Collection></VTKFile>"
    )
    msh.write_text(CORNER + STEP.format(t=0.5, k=0, v=1))
    image = BY_NAME["VTI"].make(tmp_path).path
    for path in (tmp_path / "a.vtu", image, tmp_path / "a.pvd", msh):
        with pytest.raises(ValueError, match="There is no step 7: it has"):
            read_mesh(path, step=7)
        with pytest.raises(ValueError, match="There is no block 'x'"):
            read_mesh(path, block="x")
        assert read_mesh(path, step=0).n_tets
    assert read_mesh(tmp_path / "a.pvd", step=0.5).n_tets == 6
    assert quietly(msh, "temp", step=0.5).n_tets == 2
    for bad in (True, [0.9], [True], 0.5, np.True_):
        with pytest.raises(ValueError, match="block must be a name, an index"):
            read_mesh(msh, block=bad)


class Name(enum.StrEnum):
    TEMP = "temp"
    LOWER = "lower part"
    POINT = "point"


def test_names_of_the_callers_classes(msh):
    mesh = quietly(msh, Name.TEMP, location=Name.POINT, block=Name.LOWER)
    assert mesh.report.field == "temp" and mesh.n_tets == 1
    assert quietly(msh, Name.TEMP, block=[Name.LOWER]).n_tets == 1
    with pytest.raises(ValueError, match="field must be a name, but is int"):
        read_mesh(msh, 3)  # type: ignore[arg-type]
    with pytest.raises(Trouble, match="an argument cannot be passed on"):
        process.run("fields", None, None, path=Name.TEMP, ask=Ask())


def test_python_that_does_not_start(tmp_path, monkeypatch):
    write_mesh(tmp_path / "a.vtu", datasets.box((1, 1, 1)))
    (tmp_path / "child.py").write_text("raise SystemExit(3)")
    monkeypatch.setattr(process, "_CHILD", tmp_path / "child.py")
    monkeypatch.setattr(process._pool, "idle", [])
    with pytest.raises(OSError, match="Python could not be started to read files .exit code 3"):
        read_mesh(tmp_path / "a.vtu")


def test_the_end_of_much_output_is_kept():
    code = (
        f"import runpy, sys; child = runpy.run_path({process.child.__file__!r});"
        "import os; out = os.dup(1); q = child['_Quiet']();"
        "print('first' + 'x' * 100000 + 'last'); said = q.take();"
        "os.write(out, (said[:5] + said.strip()[-4:] + str(len(said) < 50000)).encode())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    assert done.stdout == b"firstlastTrue"


def test_gmsh_entities_in_several_groups(tmp_path):
    (tmp_path / "a.msh").write_text(
        "$MeshFormat\n4.1 0 8\n$EndMeshFormat\n"
        '$PhysicalNames\n2\n3 1 "one"\n3 2 "two"\n$EndPhysicalNames\n'
        "$Entities\n0 0 0 1\n1 0 0 0 1 1 1 2 1 2 0\n$EndEntities\n"
        "$Nodes\n1 4 1 4\n3 1 0 4\n1\n2\n3\n4\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n$EndNodes\n"
        "$Elements\n1 1 1 1\n3 1 4 1\n1 1 2 3 4\n$EndElements\n"
    )
    for block in ("one", "two"):
        assert read_mesh(tmp_path / "a.msh", block=block, values=np.zeros(4)).n_tets == 1
    with open(tmp_path / "a.msh", "a") as f:
        f.write(STEP.format(t=0.0, k=0, v=1).replace("\n5\n10", "\n4\n10"))
    text = (tmp_path / "a.msh").read_text()
    for k, node in enumerate(("10 ", "20 ", "30 ", "2147483647 ")):
        text = text.replace(f"\n{node}1", f"\n{k + 1} 1")
    (tmp_path / "a.msh").write_text(text.replace("50 1\n", ""))
    (field,) = list_fields(tmp_path / "a.msh")
    assert field == Field("temp", "point", 1, ("one", "two"))


def test_a_forked_process_closes_what_it_got(tmp_path, monkeypatch):
    write_mesh(tmp_path / "a.vtu", datasets.box((1, 1, 1)))
    pool = process._Pool()
    monkeypatch.setattr(process, "_pool", pool)
    read_mesh(tmp_path / "a.vtu")
    (worker,) = pool.idle
    process._forked()
    assert process._pool is not pool and worker.stdin and worker.stdout
    assert worker.stdin.closed and worker.stdout.closed
    os.waitpid(worker.pid, 0)  # it ends with its input
    assert worker.returncode == 0


def test_a_mesh_that_may_not_be_written_stays(tmp_path, monkeypatch):
    place = tmp_path / "a.vtu"
    write_mesh(place, datasets.box((1, 1, 1)))
    before = place.read_bytes()
    access = os.access  # root may write to anything
    monkeypatch.setattr(os, "access", lambda p, mode: access(p, mode) and mode != os.W_OK)
    mesh = np.eye(4)[:, :3], np.arange(4)[None], "s", np.arange(4.0), "point"
    with pytest.raises(Trouble) as caught:
        write.write(str, str(place), *mesh, str(tmp_path / "workshop"), ".vtu")
    assert caught.value.kind == "system" and str(errno.EACCES) in caught.value.message
    assert place.read_bytes() == before and list(tmp_path.iterdir()) == [place]
