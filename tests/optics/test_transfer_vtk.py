"""Transfer functions from VTK's objects, against what those give themselves, and back."""

from __future__ import annotations

import importlib
import warnings
from typing import Any

import jax
import numpy as np
import pytest
import vtk

from jaxvr.optics.transfer import TransferFunction

with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)  # in what PyVista imports
    pyvista: Any = importlib.import_module("pyvista")  # its types are unions of unions

NODES = [(0.1, 0.2, 0.9, 0.5), (0.8, 0.3, 0.2, 0.9), (2.0, 0.2, 0.9, 0.4), (2.5, 0.6, 0.6, 0.6)]
AT = np.sort(np.random.default_rng(0).uniform(-0.5, 3.0, 400))
SPACES = ["RGB", "HSV", "Lab", "Diverging", "Prolab", "Step"]


def color_of(nodes=NODES, space="RGB", shape=()):
    color = vtk.vtkColorTransferFunction()
    getattr(color, f"SetColorSpaceTo{space}")()
    for node in nodes:
        color.AddRGBPoint(*node, *shape)
    return color


def opacity_of(nodes=((0.0, 0.1), (1.0, 0.9), (2.5, 0.3)), shape=()):
    opacity = vtk.vtkPiecewiseFunction()
    for node in nodes:
        opacity.AddPoint(*node, *shape)
    return opacity


def vtk_colors(color, at=AT):
    return np.array([color.GetColor(s) for s in at])


def vtk_opacities(opacity, at=AT):
    return np.array([opacity.GetValue(s) for s in at])


def test_all_nodes_of_both_count():
    color, opacity = color_of(), opacity_of()
    tf = TransferFunction.from_vtk(color, opacity)
    np.testing.assert_array_equal(tf.positions, [0.0, 0.1, 0.8, 1.0, 2.0, 2.5])
    colors, extinctions = tf(AT)
    np.testing.assert_allclose(colors, vtk_colors(color), atol=1e-14)
    np.testing.assert_allclose(extinctions, vtk_opacities(opacity), atol=1e-14)


@pytest.mark.parametrize("wrap", [True, False])
@pytest.mark.parametrize("space", SPACES)
def test_color_spaces(space, wrap):
    color = color_of(space=space)
    color.SetHSVWrap(wrap)
    tf = TransferFunction.from_vtk(color, opacity_of(), points=3000)
    error = np.abs(np.asarray(tf(AT)[0]) - vtk_colors(color))
    assert error.max() < 2e-3 and error.mean() < 2e-5, (error.max(), error.mean())


def test_ciede2000():
    color = color_of(NODES[:2], "LabCIEDE2000")
    tf = TransferFunction.from_vtk(color, opacity_of(), points=400)
    table = [0.0] * 300
    color.GetTable(*color.GetRange(), 100, table)  # on a lattice of colours, off its nodes too
    at = np.linspace(*color.GetRange(), 100)
    np.testing.assert_allclose(tf(at)[0], np.reshape(table, (100, 3)), atol=0.03)
    np.testing.assert_allclose(tf(0.1)[0], NODES[0][1:], atol=1e-12)


@pytest.mark.parametrize("shape", [(0.3, 0.0), (0.5, 0.5), (0.2, 0.8), (0.7, 0.02), (0.4, 0.995)])
@pytest.mark.parametrize("space", ["RGB", "HSV", "Lab", "Diverging", "Step"])
def test_midpoints_and_sharpness(space, shape):
    color, opacity = color_of(space=space, shape=shape), opacity_of(shape=shape)
    tf = TransferFunction.from_vtk(color, opacity, points=3000)
    colors, extinctions = tf(AT)
    np.testing.assert_allclose(colors, vtk_colors(color), atol=2e-3)
    if shape[1] < 0.99:  # else VTK's opacity is merely steep, its colour a step
        np.testing.assert_allclose(extinctions, vtk_opacities(opacity), atol=2e-4)


def test_a_sharpness_of_one_is_a_step():
    color = color_of([(0.0, 0.25, 0.25, 0.25), (1.0, 0.75, 0.75, 0.75)], shape=(0.25, 1.0))
    opacity = opacity_of([(0.0, 0.25), (1.0, 0.75)], shape=(0.25, 1.0))
    tf = TransferFunction.from_vtk(color, opacity)
    at = np.array([-1.0, 0.0, 0.2, 0.249, 0.251, 0.6, 1.0])
    np.testing.assert_allclose(tf(at)[1], [0.25, 0.25, 0.25, 0.25, 0.75, 0.75, 0.75])
    np.testing.assert_allclose(tf(at)[0], vtk_colors(color, at))
    np.testing.assert_array_equal(tf.positions, [0, 0.25, 0.25, 1])


def test_jumps():
    color, opacity = vtk.vtkColorTransferFunction(), vtk.vtkPiecewiseFunction()
    color.AllowDuplicateScalarsOn()
    opacity.AllowDuplicateScalarsOn()
    for x, r in ((0.0, 0.1), (1.0, 0.2), (1.0, 0.8), (2.0, 0.9)):
        color.AddRGBPoint(x, r, 0.5, 1 - r)
        opacity.AddPoint(x, r)
    tf = TransferFunction.from_vtk(color, opacity)
    np.testing.assert_array_equal(tf.positions, [0, 1, 1, 2])
    np.testing.assert_array_equal(tf.extinctions, [0.1, 0.2, 0.8, 0.9])
    np.testing.assert_allclose(tf(AT)[0], vtk_colors(color), atol=1e-14)
    np.testing.assert_allclose(tf(AT)[1], vtk_opacities(opacity), atol=1e-14)


def test_clamping_off_ends_in_jumps():
    color, opacity = color_of(), opacity_of(((0.2, 0.1), (1.0, 0.9), (2.2, 0.0)))
    color.ClampingOff()
    opacity.ClampingOff()
    tf = TransferFunction.from_vtk(color, opacity)
    np.testing.assert_allclose(tf(AT)[0], vtk_colors(color), atol=1e-14)
    np.testing.assert_allclose(tf(AT)[1], vtk_opacities(opacity), atol=1e-14)
    np.testing.assert_array_equal(tf.positions, [0.1, 0.1, 0.2, 0.2, 0.8, 1, 2, 2.2, 2.5, 2.5])


def test_logarithmic_scales():
    color, opacity = color_of(), opacity_of(((0.01, 0.1), (1.0, 0.9), (2.5, 0.3)))
    color.SetScaleToLog10()
    opacity.UseLogScaleOn()
    tf = TransferFunction.from_vtk(color, opacity, points=4000)
    at = AT[AT > 0]
    np.testing.assert_allclose(tf(at)[0], vtk_colors(color, at), atol=1e-5)
    np.testing.assert_allclose(tf(at)[1], vtk_opacities(opacity, at), atol=1e-5)


def test_properties_and_units(dtype):
    look = vtk.vtkVolumeProperty()
    look.SetColor(color_of())
    look.SetScalarOpacity(opacity_of())
    look.SetScalarOpacityUnitDistance(0.25)
    tf = TransferFunction.from_vtk(look, dtype=dtype)
    assert tf.dtype == dtype
    rtol = 4 * np.finfo(dtype).eps
    np.testing.assert_allclose(tf(1.0)[1], 0.9 / 0.25, rtol=rtol)
    half = TransferFunction.from_vtk(look, unit_distance=0.5, dtype=dtype)
    np.testing.assert_allclose(half(1.0)[1], 0.9 / 0.5, rtol=rtol)
    grid = TransferFunction.from_vtk(look, convention="grid", dtype=dtype)
    np.testing.assert_allclose(grid(1.0)[1], -np.log1p(-0.9) / 0.25, rtol=16 * rtol)
    volume = vtk.vtkVolume()
    volume.SetProperty(look)
    for a, b in zip(
        *(jax.tree.leaves(TransferFunction.from_vtk(x)) for x in (look, volume)), strict=True
    ):
        np.testing.assert_array_equal(a, b)
    look.SetColor(opacity_of())  # gray
    tf = TransferFunction.from_vtk(look)
    np.testing.assert_allclose(tf(1.0)[0], [0.9] * 3)


def test_opacities_above_one_are_extinctions():
    tf = TransferFunction.from_vtk(color_of(), opacity_of([(0.0, 0.5), (1.0, 8.0)]), 2.0)
    np.testing.assert_allclose(tf(np.array([0.0, 1.0]))[1], [0.25, 4.0])
    with pytest.raises(ValueError, match="between 0 and 1"):
        TransferFunction.from_vtk(color_of(), opacity_of([(0.0, 8.0)]), convention="grid")


def test_lookup_tables():
    table = pyvista.LookupTable("viridis", scalar_range=(1.0, 3.0), n_values=16)
    table.apply_opacity([0.0, 0.5, 1.0])
    tf = TransferFunction.from_vtk(table)
    np.testing.assert_allclose(tf.positions, np.linspace(1, 3, 16))
    np.testing.assert_allclose(tf.colors, table.values[:, :3] / 255, atol=1e-12)
    np.testing.assert_allclose(tf.extinctions, table.values[:, 3] / 255, atol=1e-12)
    np.testing.assert_allclose(tf(AT)[0], vtk_colors(table.to_color_tf()), atol=1e-12)
    mixed = TransferFunction.from_vtk(table, opacity_of())
    np.testing.assert_allclose(mixed(AT)[1], vtk_opacities(opacity_of()), atol=1e-12)


def test_volumes_of_pyvista():
    grid = pyvista.ImageData(dimensions=(3, 3, 3))
    grid.point_data["x"] = np.linspace(0.0, 5.0, 27)
    plotter = pyvista.Plotter(off_screen=True)
    volume = plotter.add_volume(
        grid.cast_to_unstructured_grid().triangulate(), cmap="viridis", opacity_unit_distance=0.5
    )
    tf = TransferFunction.from_vtk(volume)
    look = volume.GetProperty()
    at = np.linspace(-1, 6, 100)
    np.testing.assert_allclose(tf(at)[0], vtk_colors(look.GetRGBTransferFunction(), at), atol=1e-12)
    np.testing.assert_allclose(tf(at)[1], vtk_opacities(look.GetScalarOpacity(), at) / 0.5)
    plotter.close()


def test_round_trip_is_exact(dtype):
    rng = np.random.default_rng(1)
    positions = np.sort(rng.normal(size=9))
    positions[4] = positions[3]
    positions[8] = positions[7]
    tf = TransferFunction(positions, rng.random((9, 3)), 30 * rng.random(9), dtype=dtype)
    for unit in (2.0**-5, 2.0**-9):
        color, opacity = tf.to_vtk(unit)
        assert opacity.GetSize() == color.GetSize() == 9
        again = TransferFunction.from_vtk(color, opacity, unit, dtype=dtype)
        for a, b in zip(jax.tree.leaves(tf), jax.tree.leaves(again), strict=True):
            np.testing.assert_array_equal(a, b)
        np.testing.assert_allclose(tf(AT)[0], vtk_colors(color), atol=8 * np.finfo(dtype).eps)


def test_to_vtk_says_which_unit_is_small_enough():
    tf = TransferFunction([0.0, 1.0], np.eye(3)[:2], [0.1, 37.0])
    with pytest.raises(ValueError, match="reach 37,.*unit_distance=0.027 or less"):
        tf.to_vtk()
    assert tf.to_vtk(0.027)[1].GetValue(1.0) <= 1
    with pytest.raises(ValueError, match="above 0"):
        tf.to_vtk(0.0)


def test_errors():
    color, opacity = color_of(), opacity_of()
    with pytest.raises(ValueError, match="opacity must be a vtkPiecewiseFunction.*NoneType"):
        TransferFunction.from_vtk(color)
    with pytest.raises(ValueError, match="color must be .* but is str"):
        TransferFunction.from_vtk("viridis", opacity)
    with pytest.raises(ValueError, match="not both"):
        TransferFunction.from_vtk(vtk.vtkVolumeProperty(), opacity)
    with pytest.raises(ValueError, match="colour function has no nodes"):
        TransferFunction.from_vtk(vtk.vtkColorTransferFunction(), opacity)
    with pytest.raises(ValueError, match="opacity function has no nodes"):
        TransferFunction.from_vtk(color, vtk.vtkPiecewiseFunction())
    with pytest.raises(ValueError, match="must not be negative"):
        TransferFunction.from_vtk(color, opacity_of([(0.0, -0.5)]))
    with pytest.raises(ValueError, match="points"):
        TransferFunction.from_vtk(color, opacity, points=0)
    with pytest.raises(ValueError, match="unit_distance"):
        TransferFunction.from_vtk(color, opacity, 0.0)
