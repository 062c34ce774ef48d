"""Common mistakes, made as users make them: each is told, with what to do about it."""

from __future__ import annotations

import re
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvr
from jaxvr.hints import ViewWarning
from jaxvr.volume import cells as zoo
from jaxvr.volume.structured import grid_cells

pytestmark = pytest.mark.usefixtures("quick_code")

SIZE = {"width": 16, "height": 12}


@pytest.fixture(scope="module")
def mesh():
    """The unit cube with values from 0 to 1."""
    return jaxvr.datasets.box((2, 2, 2), dtype="float32", field=lambda p: p[:, 0])


@pytest.fixture(scope="module")
def camera(mesh):
    return jaxvr.Camera.orbit(mesh, **SIZE)


def ramp(low=0.0, high=1.0, top=2.0):
    return jaxvr.TransferFunction.from_colormap("viridis", [low, high], [0.5 * top, top])


def told(*args, **kwargs) -> str:
    """What one render warns of, once, on this very line of the caller."""
    with pytest.warns(ViewWarning) as caught:
        jaxvr.render(*args, **kwargs)
    assert len(caught) == 1 and caught[0].filename == __file__
    return str(caught[0].message)


def test_wrong_field_name(mesh, tmp_path):
    path = tmp_path / "box.vtu"
    jaxvr.write_mesh(path, mesh)  # as "values"
    with pytest.raises(ValueError, match=r"box.vtu has no field 'density'. It has 'values' .point"):
        jaxvr.read_mesh(path, field="density")
    with pytest.raises(ValueError, match="has no field 'Value'. Did you mean \"values\"[?] It has"):
        jaxvr.read_mesh(path, field="Value")


def test_nodes_in_another_order():
    z, y, x = np.meshgrid(*[np.linspace(0, 1, 3)] * 3, indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), z.ravel()], 1)
    cubes = grid_cells(3, 3, 3)
    middle = points[cubes].mean(1)
    right = {
        "hexahedron": cubes,
        "wedge": cubes[:, [[0, 2, 1, 4, 6, 5], [0, 3, 2, 4, 7, 6]]].reshape(-1, 6),
        "pyramid": np.concatenate([cubes[:, :4], 27 + np.arange(8)[:, None]], 1),
    }
    points = np.concatenate([points, middle])
    for kind, cells in right.items():
        jaxvr.TetMesh.from_cells(points, {kind: cells}, points[:, 0], location="point")
        for order in zoo.ORDERS[kind]:
            wrong = cells[:, np.argsort(order)]
            with pytest.raises(ValueError) as e:
                jaxvr.TetMesh.from_cells(points, {kind: wrong}, points[:, 0], location="point")
            assert f"{len(cells)} of {len(cells)} {kind} cells are twisted" in str(e.value)
            columns = re.search(rf'{{"{kind}": cells\[:, \[([\d, ]+)\]\]}}', str(e.value))
            assert columns, str(e.value)
            assert np.array_equal(wrong[:, [int(c) for c in columns[1].split(",")]], cells)
    voxels = {"voxel": cubes}  # in a hexahedron's order
    with pytest.raises(ValueError, match=r'"hexahedron": cells\[:, \[0, 1, 2, 3, 4, 5, 6, 7\]\]'):
        jaxvr.TetMesh.from_cells(points, voxels, points[:, 0], location="point")
    unknown = cubes[:, [0, 6, 1, 3, 7, 2, 4, 5]]
    with pytest.raises(ValueError, match=r"twisted.*not in VTK's order, which is one face [^{]*$"):
        jaxvr.TetMesh.from_cells(points, {"hexahedron": unknown}, points[:, 0], location="point")


def test_opacity_instead_of_extinction(mesh):
    opacities = [0.1, 0.6]
    transfer = jaxvr.TransferFunction([0.0, 1.0], [[0, 0, 1], [1, 1, 0]], opacities)
    for size, what in ((0.001, "The picture is blank"), (0.01, "The picture is faint")):
        small = mesh.replace(points=size * mesh.points)
        camera = jaxvr.Camera.orbit(small, **SIZE)
        message = told(small, camera, transfer)
        assert message.startswith(what) and "0.6 and the volume's diagonal 0.0" in message
        unit = re.search(r"from_opacity\(..., unit_distance=([\d.e-]+)\)", message)
        factor = re.search(r"transfer.scaled\(([\d.e+]+)\)", message)
        assert unit and factor
        meant = jaxvr.TransferFunction.from_opacity(
            transfer.positions, transfer.colors, opacities, float(unit[1])
        )
        for better in (meant, transfer.scaled(float(factor[1]))):
            alpha = jaxvr.render(small, camera, better)[..., 3]
            assert 0.5 < alpha.max() < 1
    # Behind a background too, where alpha is 1 everywhere.
    assert "opacities" in told(small.replace(points=0.1 * small.points),
                               camera.replace(eye=0.1 * camera.eye, target=0.1 * camera.target),
                               transfer, background=(1.0, 1.0, 1.0))  # fmt: skip


def test_opacity_instead_of_extinction_on_a_large_mesh(mesh, camera):
    large = mesh.replace(points=1000 * mesh.points)
    camera = camera.replace(eye=1000 * camera.eye, target=1000 * camera.target)
    transfer = jaxvr.TransferFunction([0.0, 1.0], [[0, 0, 1], [1, 1, 0]], [0.1, 0.6])
    message = told(large, camera, transfer)
    assert message.startswith("One cell hides what is behind it.") and "up to 0.6" in message
    unit = re.search(r"from_opacity\(..., unit_distance=([\d.e-]+)\)", message)
    factor = re.search(r"transfer.scaled\(([\d.e-]+)\)", message)
    assert unit and factor
    meant = jaxvr.TransferFunction.from_opacity(
        transfer.positions, transfer.colors, transfer.extinctions, float(unit[1])
    )
    jaxvr.render(large, camera, meant)
    assert 0.5 < jaxvr.render(large, camera, transfer.scaled(float(factor[1])))[..., 3].max() < 1
    jaxvr.render(large, camera, jaxvr.default_transfer(large))
    solid = transfer.replace(extinctions=[1.0, 1.0])
    jaxvr.render(large, camera, solid)  # hides what is behind it, on purpose


def test_values_in_other_units(mesh, camera):
    celsius, kelvin = mesh.replace(values=20 + 60 * mesh.values), ramp(293.15, 353.15)
    message = told(celsius, camera, kelvin)
    assert "field lies from 20 to 80" in message and "from 293.15 to 353.15" in message
    assert "colour of the first" in message and "same units" in message
    kilopascal, pascal = mesh.replace(values=101 * mesh.values), ramp(0, 101e3)
    assert "field takes 0.1 %: it is of one colour" in told(kilopascal, camera, pascal)
    other_way = mesh.replace(values=101e3 * mesh.values - 1)
    assert "0 % of the volume is" in told(other_way, camera, ramp(0, 101))
    jaxvr.render(kilopascal, camera, ramp(0, 101))
    for factor in (50, 100):  # percent against parts of one
        assert "it is of one colour" in told(mesh, camera, ramp(0, factor))
        percent = mesh.replace(values=factor * mesh.values)
        fading = jaxvr.TransferFunction.from_colormap("viridis", [0.0, 1.0], [0.0, 2.0])
        for transfer in (ramp(), fading):
            assert "0 % of the volume is" in told(percent, camera, transfer)
    # Control points far away, or close together, are no mistake where others are at work.
    far = ramp().resample([-1e9, 0.0, 0.3, 1.0, 1e9])
    jaxvr.render(mesh, camera, far)
    peak = jaxvr.TransferFunction([0.499, 0.5, 0.501], np.ones((3, 3)), [0.0, 1e3, 0.0])
    jaxvr.render(mesh, camera, peak)
    step = jaxvr.TransferFunction([0.495, 0.505], np.ones((2, 3)), [0.0, 9.0])
    jaxvr.render(mesh, camera, step)


def test_camera_that_looks_away_or_stands_inside(mesh):
    def look_at(eye, target):
        return jaxvr.Camera.look_at(eye, target, **SIZE)

    away = told(mesh, look_at((0.5, 0.5, 4), (0.5, 0.5, 8)), ramp())
    assert "blank. The volume lies behind the camera, which stands at (0.5, 0.5, 4)" in away
    assert "from (0, 0, 0) to (1, 1, 1)" in away and "target=(0.5, 0.5, 0.5)" in away
    side = told(mesh, look_at((0.5, 0.5, 4), (9, 0.5, 3)), ramp())
    assert "volume lies left of the picture" in side and "Camera.orbit" in side
    wide = jaxvr.Camera.orthographic((0.5, 4, 4), (0.5, 4, 0), **SIZE)
    assert "volume lies below the picture" in told(mesh, wide, ramp())
    assert "pixels large" in told(mesh, look_at((0.5, 0.5, 4e4), (0.5, 0.5, 0)), ramp())
    inside = told(mesh, look_at((0.5, 0.6, 0.7), (0.5, 0.5, 0)), ramp())
    assert "eye lies inside the volume's box, from (0, 0, 0) to (1, 1, 1)" in inside
    # The same words from elsewhere in it: Python tells them once in a flight through a volume.
    assert told(mesh, look_at((0.5, 0.4, 0.3), (0.5, 0.5, 0)), ramp()) == inside
    cut = jaxvr.Camera.orthographic((0.5, 0.5, 0.5), (0.5, 0.5, 0), **SIZE)
    assert "plane through the camera's eye, which cuts" in told(mesh, cut, ramp())


def test_integers(mesh):
    blue = np.array([[0, 0, 255], [255, 255, 0]], np.uint8)
    with pytest.raises(ValueError, match="colors holds integers up to 255.*Divide.*by 255"):
        jaxvr.TransferFunction([0, 1], blue, [1, 2])
    with pytest.raises(ValueError, match="colour table holds integers up to 255"):
        jaxvr.TransferFunction.from_colormap(blue, [0, 1], [1, 2])
    same = jaxvr.TransferFunction([0, 1], blue / 255, [1, 2], dtype="float32")
    other = jaxvr.TransferFunction([0, 1], [[0, 0, 1], [1, 1, 0]], [1, 2], dtype="float32")
    assert all(map(np.array_equal, jax.tree.leaves(same), jax.tree.leaves(other)))
    labels = 2**24 + np.arange(mesh.n_points)
    exact = mesh.replace(values=labels)  # close together, they are held relative to an offset
    assert np.array_equal(exact.absolute_values(), labels)
    labels[0] = 0
    told = r"values has 13 integers that float32 cannot hold, the first is 16777217.*offset"
    with pytest.warns(UserWarning, match=told) as caught:
        mesh.replace(values=labels)
    with pytest.warns(UserWarning, match=told) as again:
        jaxvr.TetMesh.from_cells(mesh.points, {"hexahedron": grid_cells(3, 3, 3)}, labels)
    assert len(caught) == len(again) == 1 and caught[0].filename == again[0].filename == __file__
    mesh.replace(values=2 * (labels - 2**23))
    with pytest.raises(ValueError, match="must hold integers, but has dtype float32"):
        jaxvr.TetMesh.from_cells(
            mesh.points, {"tetra": np.asarray(mesh.cells, np.float32)}, mesh.values
        )


def test_transfer_function_outside_of_the_field(mesh, camera):
    message = told(mesh, camera, ramp(2, 3))
    assert "field lies from 0 to 1" in message and "from 2 to 3" in message
    assert "colour of the first" in message and "positions from 0 to 1" in message
    empty = jaxvr.TransferFunction([-2.0, -1.0], np.eye(3)[:2], [1.0, 0.0])
    message = told(mesh, camera, empty)
    assert "picture is blank" in message and "of the last and no extinction" in message
    gap = jaxvr.TransferFunction([-2.0, -1.0, 2.0, 3.0], np.ones((4, 3)), [1.0, 0.0, 0.0, 1.0])
    assert "has no extinction where the field lies, from 0 to 1" in told(mesh, camera, gap)
    # Cells have no values between theirs.
    cellwise = mesh.replace(values=np.arange(mesh.n_tets) % 2)
    between = jaxvr.TransferFunction([0.0, 0.5, 1.0], np.ones((3, 3)), [0.0, 1.0, 0.0])
    assert "no extinction where the field lies" in told(cellwise, camera, between)


@pytest.mark.parametrize("flat", [False, True])
def test_points_that_no_cell_uses_hide_no_mistake(mesh, camera, flat):
    """Neither the range that one of them has, nor its place."""
    far = 1e4 if flat else 0.5
    points = np.concatenate([np.asarray(mesh.points), [[far] * 3]])
    values = np.concatenate([np.asarray(mesh.values), [1e3]])
    tets = {"tetra": np.asarray(mesh.cells)}
    with pytest.warns(UserWarning, match="inverted"):
        other = jaxvr.TetMesh.from_cells(points, tets, values, dtype="float32")
    if flat:
        camera = camera.replace(extent=2.0)
    units = ramp(0, 1000)  # the field takes a thousandth of it
    message = told(other, camera, units)
    assert message == told(mesh, camera, units) and "the field takes 0.1 %" in message
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        same = jaxvr.render(other, camera, ramp())
    np.testing.assert_allclose(same, jaxvr.render(mesh, camera, ramp()), atol=1e-6)


def test_points_that_lose_digits_in_float32():
    z, y, x = np.meshgrid(*[np.linspace(0, 1, 5)] * 3, indexing="ij")
    points, cells = np.stack([x.ravel(), y.ravel(), z.ravel()], 1), grid_cells(5, 5, 5)

    def build(points):
        cube = {"hexahedron": cells}
        return jaxvr.TetMesh.from_cells(
            points, cube, points[:, 0], location="point", dtype="float32"
        )

    told = "points lose digits in float32, .*jax_enable_x64"
    assert build(5e6 + 1.5 * points).report.collapsed == 0  # held relative to an origin
    pair = np.concatenate([cells, cells + len(points)])

    def build_two(first, second):
        both = np.concatenate([first, second])
        return jaxvr.TetMesh.from_cells(
            both, {"hexahedron": pair}, both[:, 0], location="point", dtype="float32"
        )

    with pytest.warns(UserWarning) as caught:
        assert build_two(1.5 * points, 5e6 + 1.5 * points).report.collapsed > 0
    messages = "; ".join(str(w.message) for w in caught)
    assert re.search(f"degenerate .* have a volume in float64: {told}", messages)
    assert "are so small beside the steps of float32" in messages
    with pytest.raises(ValueError, match=f"No cells left.*{told}"):
        build_two(points - 1e9, 1e9 + points)
    flat = 0.1 * np.concatenate([points, points[:1]])  # cells without volume in float64 too
    with pytest.warns(UserWarning, match=r"1 flat tetrahedra \(no volume\) kept, of 2 .*mesh.$"):
        jaxvr.TetMesh.from_cells(
            flat, {"tetra": [[0, 1, 5, 25], [0, 1, 2, 3]]}, flat[:, 0], dtype="float32"
        )


def test_nan_in_the_data(mesh):
    values = np.asarray(mesh.values).copy()
    values[[3, 5]] = np.nan
    with pytest.raises(ValueError, match="values has 2 NaN.*first at index 3. Remove or replace"):
        jaxvr.TetMesh.from_cells(mesh.points, {"tetra": mesh.cells}, values)
    with pytest.raises(ValueError, match="values has 2 NaN.*first at index 3. Remove or replace"):
        mesh.replace(values=values)


def test_what_is_no_mistake_gives_no_warning(mesh, camera):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jaxvr.render(mesh, camera, ramp())
        jaxvr.render(mesh, camera, ramp().scaled(0.0))  # nothing, on purpose
        constant = jaxvr.TransferFunction([7.0], [[1.0, 0.0, 0.0]], [2.0])
        jaxvr.render(mesh, camera, constant)
        jaxvr.render(mesh.replace(values=jnp.full(mesh.n_points, 0.5)), camera, ramp())


def test_what_stands_in_the_place_of_something_else(mesh, camera):
    given = mesh, camera, ramp()
    wrongs: list[tuple[str, Any, str]] = [
        ("integrator", "analytic", r"such as jaxvr.Analytic\(\), but is 'analytic'"),
        ("adjoint", "replay", r"such as jaxvr.Replay\(\), but is 'replay'"),
        ("tracer", jaxvr.RayCast, r"is the class RayCast.* did you forget the \(\)"),
        ("compositor", jaxvr.Over, r"is the class Over.* did you forget the \(\)"),
        ("compositor", jaxvr.Analytic(), r"such as jaxvr.Over\(\), but is a Analytic"),
    ]
    for name, wrong, match in wrongs:
        with pytest.raises(ValueError, match=f"{name} .*{match}"):
            jaxvr.render(*given, **{name: wrong})
    with pytest.raises(ValueError, match="tracer is the class"):
        jaxvr.trace(mesh, camera, tracer=jaxvr.RayCast)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="adjoint is the class"):
        jaxvr.fit(ramp(), mesh, camera, [], adjoint=jaxvr.Replay)  # type: ignore[arg-type]
    verbs: list[Any] = [jaxvr.Camera.orbit, jaxvr.default_transfer]
    for verb in verbs:
        with pytest.raises(ValueError, match="must be a jaxvr.TetMesh, but is a str.*read_mesh"):
            verb("a.vtu")
    with pytest.raises(ValueError, match="segments must be a jaxvr.Segments.*jaxvr.trace"):
        jaxvr.shade(mesh, ramp())


def test_colours_of_a_background_in_bytes(mesh, camera, tmp_path):
    dark = np.array([2, 8, 5], np.uint8)
    for background in ((255, 255, 255), (0, 128, 0), dark, jnp.asarray(dark)):
        with pytest.raises(ValueError, match="background holds .* from 0 to 1. Divide .* by 255"):
            jaxvr.render(mesh, camera, ramp(), background=background)
        with pytest.raises(ValueError, match="background holds .* from 0 to 1. Divide .* by 255"):
            jaxvr.save_image(tmp_path / "a.png", np.zeros((4, 4, 4)), background=background)
        with pytest.raises(ValueError, match="background holds .* from 0 to 1. Divide .* by 255"):
            jaxvr.plot.image(np.zeros((4, 4, 4)), background=background)


def test_a_fit_that_sees_nothing(mesh, camera):
    def told_by_fit(start, cameras):
        targets = [np.zeros((12, 16, 4), "float32")] * len(cameras)
        with pytest.warns(ViewWarning) as caught:
            jaxvr.fit(start, mesh, cameras, targets, iterations=1, progress=False)
        assert len(caught) == 1 and caught[0].filename == __file__
        return str(caught[0].message)

    away = jaxvr.Camera.look_at((0.5, 0.5, 4), (0.5, 0.5, 8), **SIZE)
    message = told_by_fit(ramp(), [camera, away, away])
    assert "2 of 3 cameras do not see the volume" in message
    assert "The first is cameras[1]: The volume lies behind the camera" in message
    constant = jaxvr.TransferFunction([5.0, 6.0], np.ones((2, 3)), [1.0, 1.0])
    for start in (ramp(5, 6), constant):
        assert "from 0 to 1, the control points" in told_by_fit(start, [camera])


def test_no_hints_while_tracing(mesh, camera):
    off = ramp(2, 3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jax.jit(lambda t: jaxvr.render(mesh, camera, t))(off)
        jax.grad(lambda t: jaxvr.render(mesh, camera, t).sum())(off)
        jax.vmap(lambda s: jaxvr.render(mesh, camera, off.scaled(s)))(jnp.ones(2))
        jaxvr.render(mesh, camera, off, status=True)
