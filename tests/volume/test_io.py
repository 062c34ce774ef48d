"""Files: what goes wrong with them, and that nothing is left out in silence."""

import errno
import os

import numpy as np
import pytest

from experiments import file_makers
from jaxvr.volume import TetMesh, datasets, read_mesh, write_mesh
from jaxvr.volume.io import fields, registry, sizes, write
from jaxvr.volume.io.content import Ask, Content, Part, Trouble, join
from tests.mesh_files import BY_NAME, quietly, volume


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


def test_blocks_whose_field_has_other_components():
    def block(data):
        nodes = np.arange(4)[None]
        return Content(np.eye(4, 3), [Part("tetra", nodes)], cell={"a": [data]})

    both = join([block(np.ones(1)), block(np.ones((1, 3)))], ["one", "two"])
    with pytest.raises(Trouble, match="1 in 'two' have no value"):
        fields.arrays_of(both, "f", "a", None)
    assert "other numbers of components" in both.notes[0]


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
