"""PLOT3D in all the ways it is written, and as VTU: the blunt fin, and a tube."""

import itertools

import numpy as np
import pytest

from jaxvr.volume import read_mesh, read_plot3d
from jaxvr.volume.structured import grid_cells, right_handed
from tests.stand_ins import named
from tests.stand_ins import write_plot3d as write


def grid(ni, nj, nk, shift=0.0):
    k, j, i = np.meshgrid(np.arange(nk), np.arange(nj), np.arange(ni), indexing="ij")
    p = np.stack([i.ravel() + shift, j.ravel() * 1.5, k.ravel() * 0.5 + 0.125 * i.ravel()]).astype(
        float
    )
    return (ni, nj, nk), p


def flow(p):
    return np.stack([1 + p[0] ** 2, p[1], p[2], -p[0], 5 + p[1]])


def solution(blocks):
    return [(dims, flow(p), None) for dims, p, *_ in blocks]


@pytest.mark.parametrize("blank", [False, True])
@pytest.mark.parametrize("two", [False, True])
def test_every_way_of_writing(tmp_path, two, blank):
    one = grid(4, 3, 5)
    blocks = [one, grid(3, 3, 5, shift=3.0)] if two else [one]
    # the second block's first face is the first one's last
    if two:
        blocks[1][1][2] += 0.375
    blanks = [(np.arange(p.shape[1]) > 0) | (p is not one[1]) if blank else None for _, p in blocks]
    data = [(d, p, b) for (d, p), b in zip(blocks, blanks, strict=True)]
    xyz, q = tmp_path / "grid.xyz", tmp_path / "grid.q"
    for order, markers, counted, width in itertools.product(
        "<>", (False, True), (False, True), (4, 8)
    ):
        if two and not counted:
            continue
        write(xyz, data, order, markers, counted, width)
        write(q, solution(data), order, markers, counted, width, solution=True)
        mesh = read_plot3d(xyz, q, "momentum.y")
        p = np.concatenate([p for _, p in blocks], 1).T
        assert mesh.dtype == np.dtype(f"f{width}")
        assert np.array_equal(mesh.points, p.astype(mesh.dtype))
        assert np.array_equal(mesh.values, p[:, 2].astype(mesh.dtype))
        hexes = sum((a - 1) * (b - 1) * (c - 1) for (a, b, c), _ in blocks) - blank
        assert mesh.report.n_input == hexes
        if two:
            assert mesh.report.duplicate_points == 15
            assert mesh.report.seams == 16


def test_zero_bytes_behind_the_data(tmp_path):
    block = [(*grid(3, 3, 3), None)]
    xyz, q = tmp_path / "a.xyz", tmp_path / "a.q"
    write(xyz, block, ">")
    write(q, solution(block), ">", solution=True)
    for path in (xyz, q):
        path.write_bytes(path.read_bytes() + bytes(44))
    assert read_plot3d(xyz, q).report.field == "density"
    q.write_bytes(q.read_bytes() + b"x")
    with pytest.raises(ValueError, match="no binary 3-D PLOT3D solution"):
        read_plot3d(xyz, q)


def test_fields(tmp_path):
    dims, p = grid(3, 4, 3)
    xyz, q = tmp_path / "a.xyz", tmp_path / "a.q"
    write(xyz, [(dims, p, None)], width=8)
    write(q, solution([(dims, p)]), width=8, solution=True)
    rho, mx, my, mz, e = flow(p)
    square = mx**2 + my**2 + mz**2
    for name, expected in {
        "density": rho,
        "energy": e,
        "momentum.x": mx,
        "momentum.magnitude": np.sqrt(square),
        "speed": np.sqrt(square) / rho,
        "velocity.z": mz / rho,
        "pressure": 0.4 * (e - 0.5 * square / rho),
    }.items():
        assert read_plot3d(xyz, q, name).values == pytest.approx(expected, rel=1e-14)
    assert np.array_equal(read_plot3d(xyz).values, p[0])
    assert np.array_equal(read_plot3d(xyz, field="z").values, p[2])
    with pytest.raises(ValueError, match="no field 'mach'. They have density"):
        read_plot3d(xyz, q, "mach")
    with pytest.raises(ValueError, match="needs q_path"):
        read_plot3d(xyz, field="density")


def test_left_handed_blocks_need_no_repair(tmp_path):
    dims, p = grid(3, 3, 3)
    p[2] *= -1
    write(tmp_path / "a.xyz", [(dims, p, None)])
    assert read_plot3d(tmp_path / "a.xyz").report.inverted == 0


def test_bad_files(tmp_path):
    xyz = tmp_path / "a.xyz"
    with pytest.raises(FileNotFoundError):
        read_plot3d(xyz)
    with pytest.raises(ValueError, match="folder"):
        read_plot3d(tmp_path)
    for raw in (b"", b"3 3 3\n0.0 0.0", np.random.default_rng(0).bytes(5000), bytes(100)):
        xyz.write_bytes(raw)
        with pytest.raises(ValueError, match="no binary 3-D PLOT3D grid"):
            read_plot3d(xyz)
    block = [(*grid(3, 3, 3), None)]
    write(xyz, block)
    raw = xyz.read_bytes()
    for n in range(0, len(raw), 7):
        xyz.write_bytes(raw[:n])
        with pytest.raises(ValueError, match="no binary 3-D PLOT3D grid"):
            read_plot3d(xyz)
    write(xyz, block)
    other = tmp_path / "b.q"
    write(other, solution([grid(3, 3, 4)]), solution=True)
    with pytest.raises(ValueError, match="do not belong together"):
        read_plot3d(xyz, other)
    write(xyz, [(*grid(3, 3, 1), None)])
    with pytest.raises(ValueError, match="No cells left"):
        read_plot3d(xyz)
    write(xyz, [(*grid(3, 3, 3), np.zeros(27, int))])
    with pytest.raises(ValueError, match="blanked"):
        read_plot3d(xyz)


def test_density_that_is_not_positive(tmp_path):
    dims, p = grid(3, 3, 3)
    write(tmp_path / "a.xyz", [(dims, p, None)])
    p[0, 4] = np.nan
    write(tmp_path / "a.q", solution([(dims, p)]), solution=True)
    with pytest.raises(ValueError, match="1 points have none, the first at index 4"):
        read_plot3d(tmp_path / "a.xyz", tmp_path / "a.q", "pressure")


@pytest.mark.parametrize(
    "grid_file, solution_file, vtu_file",
    named(
        ("plot3d/bluntfinxyz.bin", "plot3d/bluntfinq.bin", "bluntfin.vtu"),
        ("tube.xyz", "tube.q", "tube.vtu"),
    ),
)
@pytest.mark.parametrize("field", ["density", "energy", "pressure", "speed", "momentum.y"])
def test_files_equal_their_vtu_file(file_of, grid_file, solution_file, vtu_file, field):
    degenerate = {"bluntfin.vtu": "115 degenerate", "tube.vtu": "42 degenerate"}[vtu_file]
    with pytest.warns(UserWarning, match=degenerate):
        mesh = read_plot3d(file_of(grid_file), file_of(solution_file), field)
    with pytest.warns(UserWarning, match=degenerate):
        vtu = read_mesh(file_of(vtu_file), field)
    assert mesh.dtype == np.float32
    for name in ("points", "values", "cells", "neighbors", "boundary", "duplicates"):
        assert np.array_equal(getattr(mesh, name), getattr(vtu, name)), name


def test_grid_cells():
    cells = grid_cells(3, 2, 2)
    assert cells.tolist() == [[0, 1, 4, 3, 6, 7, 10, 9], [1, 2, 5, 4, 7, 8, 11, 10]]
    _, p = grid(3, 2, 2)
    assert np.array_equal(right_handed(p.T, cells), cells)
    assert np.array_equal(right_handed(-p.T, cells), cells[:, [4, 5, 6, 7, 0, 1, 2, 3]])
