"""`read_mesh`, `list_fields`, `write_mesh`: fields, round trips, and files that are no meshes."""

import contextlib
import io
import warnings
from typing import Any

import meshio
import numpy as np
import pytest

from jaxvr.volume import Field, TetMesh, datasets, list_fields, read_mesh, write_mesh
from tests.stand_ins import named

RNG = np.random.default_rng(0)
BOX = datasets.box((2, 2, 1), cell="hexahedron")
CUBE = np.array(
    [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]], float
)


@pytest.fixture
def sample(tmp_path):
    """A cube and a wedge beside it, two blocks of triangles, and every sort of field."""
    points = np.concatenate([CUBE, [[2, 0, 0], [2, 0, 1]]])
    mesh = meshio.Mesh(
        points,
        [
            ("triangle", np.array([[0, 1, 2]])),
            ("hexahedron", np.array([np.arange(8)])),
            ("triangle", np.array([[0, 2, 3]])),
            ("wedge", np.array([[1, 2, 8, 5, 6, 9]])),
        ],
        point_data={
            "v": RNG.normal(size=(10, 3)),
            "t": np.arange(10.0),
            "a.b": np.arange(10.0) + 1,
            "both": np.zeros(10),
        },
        cell_data={
            "c": [np.array([1.0]), np.array([2.0]), np.array([3.0]), np.array([4.0])],
            "both": [np.ones(1)] * 4,
        },
    )
    path = tmp_path / "sample.vtu"
    mesh.write(path)
    return path, mesh


def test_first_scalar_point_field_is_the_default(sample):
    mesh = read_mesh(sample[0])
    assert mesh.report.field == "t" and np.array_equal(mesh.values, np.arange(10))
    assert mesh.report.ignored == (("triangle", 2),) and mesh.report.inverted == 0
    assert mesh.n_tets == 9


def test_active_scalars_come_first(sample):
    text = sample[0].read_bytes()
    assert text.count(b"<PointData>") == 1
    sample[0].write_bytes(text.replace(b"<PointData>", b'<PointData Scalars="a.b">'))
    assert read_mesh(sample[0]).report.field == "a.b"


def test_fields_by_name_component_and_location(sample):
    path, source = sample
    v = source.point_data["v"]
    for name, expected in (
        ("v.x", v[:, 0]),
        ("v.2", v[:, 2]),
        ("v.magnitude", np.linalg.norm(v, axis=1)),
        ("a.b", np.arange(10.0) + 1),
    ):
        mesh = read_mesh(path, name)
        assert mesh.location == "point" and mesh.values == pytest.approx(expected)
    assert read_mesh(path, "v.2").report.field == "v.z"
    cell = read_mesh(path, "c")
    assert cell.location == "cell" and cell.values.tolist() == [2.0] * 6 + [4.0] * 3
    assert read_mesh(path, "both").values.tolist() == [0.0] * 10
    assert read_mesh(path, "both", location="cell").values.tolist() == [1.0] * 9


def test_list_fields(sample):
    assert set(list_fields(sample[0])) == {
        Field("v", "point", 3),
        Field("t", "point", 1),
        Field("a.b", "point", 1),
        Field("both", "point", 1),
        Field("c", "cell", 1),
        Field("both", "cell", 1),
    }


@pytest.mark.parametrize(
    ("field", "message"),
    [
        ("density", r"has no field 'density'. It has .*'v' \(point, 3 components\), 't' \(point\)"),
        ("v", r'field="v.x".*field="v.magnitude"'),
        ("v.w", "'w' was asked for"),
        ("v.3", "3 component"),
        ("t.y", "1 component"),
    ],
)
def test_missing_fields_list_those_there_are(sample, field, message):
    with pytest.raises(ValueError, match=message):
        read_mesh(sample[0], field)


def test_bad_location(sample):
    with pytest.raises(ValueError, match="location must be"):
        read_mesh(sample[0], location="middle")
    with pytest.raises(ValueError, match="no cell field 't'"):
        read_mesh(sample[0], "t", location="cell")


def test_only_vectors_or_nothing(tmp_path):
    path = tmp_path / "bare.vtu"
    cells: list[Any] = [("hexahedron", np.arange(8)[None])]
    meshio.Mesh(CUBE, cells, point_data={"v": CUBE}).write(path)
    with pytest.raises(ValueError, match="no scalar field to take.*magnitude"):
        read_mesh(path)
    meshio.Mesh(CUBE, cells).write(path)
    with pytest.raises(ValueError, match="It has no fields"):
        read_mesh(path)


def test_dtype(sample):
    assert read_mesh(sample[0]).dtype == np.float64
    assert read_mesh(sample[0], dtype="float32").dtype == np.float32


def same(a: TetMesh, b: TetMesh):
    """Equal up to the numbering of points: coordinates and values at each cell's corners."""

    def flat(m):
        cells, values = np.asarray(m.cells), np.asarray(m.values)
        v = {"point": lambda: values[cells], "corner": lambda: values}.get(
            m.location, lambda: np.repeat(values[:, None], 4, 1)
        )()
        rows = np.concatenate([np.asarray(m.points)[cells], v[..., None]], 2)
        return sorted(sorted(map(tuple, r)) for r in rows.tolist())

    assert flat(a) == flat(b)
    assert a.n_boundary == b.n_boundary


@pytest.mark.parametrize("suffix", [".vtu", ".vtk"])
@pytest.mark.parametrize("where", ["point", "cell", "corner"])
def test_round_trips(tmp_path, where, suffix, dtype):
    mesh = datasets.box((2, 3, 2), 0.2, shuffle=True, cell="hexahedron", dtype=dtype)
    shape = {"point": (mesh.n_points,), "cell": (mesh.n_tets,), "corner": (mesh.n_tets, 4)}[where]
    mesh = mesh.replace(values=RNG.normal(size=shape))
    path = tmp_path / f"mesh{suffix}"
    write_mesh(path, mesh)
    back = read_mesh(str(path), "values")
    assert back.dtype == np.dtype(dtype)
    assert back.location == ("cell" if where == "cell" else "point")
    assert back.report.inverted == 0
    same(mesh, back)
    if where != "corner":
        assert np.array_equal(back.points, mesh.points)
        assert np.array_equal(back.cells, mesh.cells)
        assert np.array_equal(back.values, mesh.values)


def test_write_keeps_the_name_of_the_field(tmp_path):
    write_mesh(tmp_path / "flow.vtu", datasets.cylinder_flow((2, 6, 1), field="pressure"))
    assert list_fields(tmp_path / "flow.vtu") == [Field("pressure", "point", 1)]


def test_formats_that_lose_something_are_refused(tmp_path):
    for name in ("x.stl", "x.unknown", "noextension", "x.inp"):
        with pytest.raises(ValueError, match=".vtu"):
            write_mesh(tmp_path / name, BOX)
    with pytest.raises(FileNotFoundError):
        write_mesh(tmp_path / "nowhere" / "x.vtu", BOX)


def test_files_that_are_not_there_or_no_meshes(tmp_path, capfd):
    with pytest.raises(FileNotFoundError, match=r"none\.vtu"):
        read_mesh(tmp_path / "none.vtu")
    with pytest.raises(ValueError, match="folder"):
        read_mesh(tmp_path)
    with pytest.raises(ValueError, match="path must be"):
        read_mesh(3)
    (tmp_path / "empty.vtu").touch()
    with pytest.raises(ValueError, match="is empty"):
        read_mesh(tmp_path / "empty.vtu")
    noise = RNG.bytes(3000)
    for suffix in (".vtu vtk msh inp xdmf mesh med stl ply obj off su2 ugrid bdf avs exo node"
                   " f3grid dat e vol post h5m cgns tec").split():  # fmt: skip
        path = tmp_path / f"noise.{suffix.lstrip('.')}"
        for content in (noise, b"hello\nworld\n", b"<VTKFile/>", b"0 0 0\n", b"\0" * 100):
            path.write_bytes(content)
            with pytest.raises(ValueError, match=path.name):
                read_mesh(path)
    assert capfd.readouterr() == ("", "")


def attempt(path):
    """Reading gives a mesh or a ValueError, whatever the file holds."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # repairs, of whatever came out
        try:
            mesh = read_mesh(path)
        except ValueError as e:
            assert path.name in str(e)
            return False
    assert np.isfinite(mesh.points).all() and np.isfinite(mesh.values).all()
    return True


@pytest.mark.parametrize("suffix", [".vtu", ".vtk", ".msh", ".su2", ".mesh", ".ply", ".tec"])
def test_damaged_files(tmp_path, suffix):
    source = tmp_path / f"good{suffix}"
    mesh = meshio.Mesh(
        np.asarray(BOX.points),
        [("tetra", np.asarray(BOX.cells))],
        point_data={"t": np.asarray(BOX.values)},
    )
    with warnings.catch_warnings(), contextlib.redirect_stderr(io.StringIO()):
        warnings.simplefilter("ignore")
        with contextlib.redirect_stdout(io.StringIO()):
            mesh.write(source)
    raw = source.read_bytes()
    path = tmp_path / f"bad{suffix}"
    rng = np.random.default_rng(1)
    for n in rng.integers(0, len(raw), 25):
        path.write_bytes(raw[:n])
        attempt(path)
    for _ in range(40):
        data = bytearray(raw)
        for i in rng.integers(0, len(raw), 3):
            data[i] = rng.integers(0, 256)
        path.write_bytes(data)
        attempt(path)


@pytest.mark.parametrize("file", named("football_zoo.vtu", "beam.vtu", "cells.vtu"))
def test_truncated_real_file(file_of, file, tmp_path):
    raw = file_of(file).read_bytes()
    path = tmp_path / "cut.vtu"
    for n in range(0, len(raw) - 40, len(raw) // 20):
        path.write_bytes(raw[:n])
        assert not attempt(path)
