"""gmsh's files: steps, blocks, data per corner; steps and blocks of files without them."""

import enum
from typing import Any

import numpy as np
import pytest

from experiments import file_makers
from jaxvr.volume import Field, datasets, list_fields, read_mesh, write_mesh
from jaxvr.volume.io import process
from jaxvr.volume.io.content import Ask, Trouble
from tests.mesh_files import BY_NAME, MSH_OF_TWO_BLOCKS, quietly, volume

CORNER = f"""{MSH_OF_TWO_BLOCKS}$Nodes
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


def test_cell_values_where_groups_take_turns(msh):
    lines = msh.read_text().replace(
        "3 4 2 7 1 10 30 20 50", "3 4 2 7 1 10 30 20 50\n4 4 2 8 1 10 20 30 50"
    )
    msh.write_text(lines.replace("$Elements\n3\n", "$Elements\n4\n"))
    with pytest.raises(ValueError, match="physical groups.*take turns"):
        read_mesh(msh, values=[1.0, 2.0, 3.0])


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
