"""What is shown where nobody says how: ranges by volume, an axis that is up, no unused points."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import jaxvr
from jaxvr.defaults import best_up
from jaxvr.volume import statistics


def lattice(field, cells=(6, 5, 4), location="point", scale=(1.0, 1.0, 1.0)):
    mesh = jaxvr.datasets.box(cells)
    points = np.asarray(mesh.points) * scale
    at = points if location == "point" else points[np.asarray(mesh.cells)]
    at = at.mean(axis=1) if location == "cell" else at
    return mesh.replace(points=points, values=field(at), location=location)


def with_unused(mesh, value):
    """The same mesh with points that no cell uses, far away, of an extreme value."""
    points = np.concatenate([np.full((3, 3), 50.0), np.asarray(mesh.points)])
    values = np.concatenate([np.full(3, value), np.asarray(mesh.values)])
    with pytest.warns(UserWarning, match="inverted"):  # rows of `cells` ascend
        return jaxvr.TetMesh.from_cells(points, {"tetra": np.asarray(mesh.cells) + 3}, values)


@pytest.mark.parametrize("location", ["point", "cell", "corner"])
def test_quantiles_count_volume_not_values(location):
    """x^3 fills the unit interval as cube roots do, and goes on doing so where points crowd."""
    for power in (1.0, 2.5):  # points crowd at 0
        mesh = lattice(lambda p: p[..., 0], (40, 1, 1))
        points = np.asarray(mesh.points)
        points = np.stack([points[:, 0] ** power, *points.T[1:]], axis=1)
        x = points[:, 0] if location == "point" else points[np.asarray(mesh.cells)][..., 0]
        x = x.mean(axis=1) if location == "cell" else x
        mesh = mesh.replace(points=points, values=x**3, location=location)
        found = statistics.quantiles(mesh, (0.1, 0.5, 0.9))
        np.testing.assert_allclose(np.cbrt(found), (0.1, 0.5, 0.9), atol=0.05)
        values, parts = statistics.weighted_values(mesh)
        assert len(values) == len(parts) and abs(parts.sum() - 1) < 1e-12
        assert statistics.quantiles(mesh, (0, 1)) == [values.min(), values.max()]


def test_a_few_extreme_cells_do_not_take_all_colours():
    mesh = lattice(lambda p: p[..., 0], (10, 10, 10), "cell")
    values = np.asarray(mesh.values).copy()
    values[:5], values[-5:] = -1e3, 1e3  # of 6,000 cells of one size
    mesh = mesh.replace(values=values)
    ends = jaxvr.default_transfer(mesh).positions[np.array([0, -1])]
    assert 0 < ends[0] < 0.1 and 0.9 < ends[1] < 1
    whole = jaxvr.default_transfer(mesh, quantiles=(0, 1)).positions
    np.testing.assert_array_equal(whole[np.array([0, -1])], (-1e3, 1e3))
    camera = jaxvr.Camera.orbit(mesh, width=8, height=8)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # that ranges miss each other, as they seem to
        jaxvr.render(mesh, camera, jaxvr.default_transfer(mesh))


def test_a_field_that_is_nearly_everywhere_one_value_spans_its_range():
    mesh = lattice(lambda p: np.zeros(len(p)), (10, 10, 10), "cell")
    mesh = mesh.replace(values=np.asarray(mesh.values) + (np.arange(mesh.n_tets) == 7))
    positions = jaxvr.default_transfer(mesh).positions
    np.testing.assert_array_equal(positions[np.array([0, -1])], (0, 1))
    assert len(jaxvr.default_transfer(mesh.replace(values=np.ones(mesh.n_tets))).positions) == 1


def test_cells_without_volume_count_the_same_each():
    mesh = lattice(lambda p: p[..., 0], scale=(1.0, 1.0, 0.0))
    assert statistics.quantiles(mesh, (0, 0.5, 1)) == pytest.approx([0, 0.5, 1], abs=0.2)


@pytest.mark.parametrize("bad", [(0.5, 0.5), (0.9, 0.1), (-0.1, 1), (0, 1.1), (0.1,), (np.nan, 1)])
def test_quantiles_that_are_none(bad):
    with pytest.raises(ValueError, match="quantiles must be two rising numbers"):
        jaxvr.default_transfer(lattice(lambda p: p[..., 0]), quantiles=bad)


def test_points_that_no_cell_uses_count_in_no_statistic():
    from jaxvr.interact.viewer import Viewer

    mesh = lattice(lambda p: p[..., 0])
    other = with_unused(mesh, 1e6)
    assert other.n_points == mesh.n_points + 3
    assert statistics.value_range(other) == statistics.value_range(mesh) == (0, 1)
    assert statistics.quantiles(other, (0.1, 0.9)) == statistics.quantiles(mesh, (0.1, 0.9))
    a, b = jaxvr.default_transfer(mesh), jaxvr.default_transfer(other)
    np.testing.assert_array_equal(a.positions, b.positions)
    np.testing.assert_array_equal(a.extinctions, b.extinctions)
    assert "point data, 0 to 1\n" in other.describe()
    assert "point data, 0 to 1<" in str(other._repr_html_())
    views = [Viewer(m, size=8).setup() for m in (mesh, other)]
    assert views[0]["range"] == views[1]["range"] and views[0]["counts"] == views[1]["counts"]


@pytest.mark.parametrize(("fill", "far"), [(1e3, 0), (1e9, 0), (1e20, 3), (9.96921e36, 3)])
def test_fill_values_of_points_that_no_cell_uses(fill, far):
    """Of coordinates and of the field: the picture is that of the mesh without them."""
    mesh = lattice(lambda p: p[..., 0], (2, 2, 2))
    mesh = jaxvr.TetMesh.from_pyvista(mesh.to_pyvista(), dtype="float32")
    points = np.concatenate([np.full((3, 3), fill), np.asarray(mesh.points)])
    values = np.concatenate([np.full(3, fill), np.asarray(mesh.values)])
    cells = {"tetra": np.asarray(mesh.cells) + 3}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        other = jaxvr.TetMesh.from_cells(points, cells, values, dtype="float32")
    told = [w for w in caught if "that no cell uses" in str(w.message)]
    assert len(told) == (far > 0)
    if far:
        assert f"3 points that no cell uses, out to {fill:.3g}" in str(told[0].message)
        assert told[0].filename == __file__
    transfer = jaxvr.default_transfer(other)
    if fill == 1e20:  # where pictures were wrong without a word
        camera = jaxvr.Camera.orbit(other, width=8, height=8)
        want = jaxvr.render(mesh, camera, transfer)
        np.testing.assert_array_equal(jaxvr.render(other, camera, transfer), want)
    np.testing.assert_array_equal(other.points[3:], mesh.points)
    np.testing.assert_allclose(other.points[:3], 0.5 if far else fill)
    np.testing.assert_array_equal(transfer.positions, jaxvr.default_transfer(mesh).positions)


def test_the_axis_that_shows_most():
    """By pictures that are rendered; the rough ones choose one that shows 0.89 of the best here."""
    for thin, field in ((0, 1), (1, 2), (2, 0)):
        scale = np.ones(3)
        scale[thin] = 0.02
        mesh = lattice(lambda p, f=field: p[..., f], (8, 8, 8), scale=tuple(scale))
        transfer = jaxvr.default_transfer(mesh)
        chosen = best_up(mesh, transfer)
        shown = {}
        for name, up in (("y", (0, 1, 0)), ("z", (0, 0, 1)), ("x", (1, 0, 0))):
            camera = jaxvr.Camera.orbit(mesh, up=up, width=24, height=24)
            image = np.asarray(jaxvr.render(mesh, camera, transfer)).reshape(-1, 4)
            shown[name] = image.var(axis=0).sum()
        assert shown[chosen] >= 0.85 * max(shown.values()), (thin, chosen, shown)


@pytest.mark.parametrize("up", [(0, 0, 1), (1, 0, 0), (0, 0, -1), (0, -2, 0), (1, 1, 1)])
def test_an_orbit_about_another_axis(up):
    mesh = lattice(lambda p: p[..., 0])
    unit = np.asarray(up) / np.linalg.norm(up)
    eyes = []
    for azimuth in (0, 90, 200):
        camera = jaxvr.Camera.orbit(mesh, azimuth=azimuth, elevation=25, up=up)
        out = np.asarray(camera.eye - camera.target, float)
        eyes.append(out / np.linalg.norm(out))
        np.testing.assert_allclose(eyes[-1] @ unit, np.sin(np.deg2rad(25)), atol=1e-6)
        right = np.asarray(camera.basis()[0])
        np.testing.assert_allclose(right @ unit, 0, atol=1e-6)
    assert np.cross(eyes[0], eyes[1]) @ unit > 0.5  # azimuth turns to the right hand about up
    one = jaxvr.Camera.orbit(mesh, up=(0, 1, 0))
    np.testing.assert_array_equal(one.eye, jaxvr.Camera.orbit(mesh).eye)
    with pytest.raises(ValueError, match="zero vector"):
        jaxvr.Camera.orbit(mesh, up=(0, 0, 0))


def test_rounding_noise_takes_no_colours():
    """A ball of 1 in less than a hundredth of the volume, and noise of 1e-9 elsewhere."""
    mesh = lattice(lambda p: 1e-9 * p[..., 0], (10, 10, 10), "cell")
    values = np.asarray(mesh.values).copy()
    values[:5] = 1.0
    ends = jaxvr.default_transfer(mesh.replace(values=values)).positions[np.array([0, -1])]
    assert ends[0] < 1e-9 and ends[1] == 1.0


def test_few_numbers_between_the_ends_make_few_points():
    """A pressure of which float32 keeps some steps: positions stay apart."""
    mesh = jaxvr.datasets.box((6, 5, 4), dtype="float32")
    with pytest.warns(UserWarning, match="values come in float32, which has steps of 0.0078"):
        mesh = mesh.replace(values=101325 + np.float32(0.05) * mesh.points[:, 0])
    transfer = jaxvr.default_transfer(mesh)
    positions = np.asarray(transfer.positions)
    assert 2 <= len(positions) < 33 and (np.diff(positions) > 0).all()
    assert positions[0] >= 101325 and positions[-1] <= np.float32(101325.05)
