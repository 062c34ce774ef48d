"""Transfer functions through JSON and back, and colour maps as ParaView exports them."""

from __future__ import annotations

import json
import warnings

import jax
import numpy as np
import pytest

import jaxvr
from jaxvr.optics import colormaps
from jaxvr.optics.transfer import TransferFunction

RGB = [0.0, 0.1, 0.2, 0.9, 0.5, 0.8, 0.3, 0.2, 2.0, 0.2, 0.9, 0.4]
X, NODES = np.array(RGB[::4]), np.array(RGB).reshape(3, 4)[:, 1:]


def paraview(**changes):
    return [
        {"Name": "mine", "ColorSpace": "RGB", "NanColor": [1, 1, 0], "RGBPoints": RGB} | changes
    ]


def test_round_trip_is_exact(tmp_path, dtype):
    rng = np.random.default_rng(0)
    positions = np.sort(rng.normal(size=9) * 1e-7)
    positions[4] = positions[3]
    tf = TransferFunction(positions, rng.random((9, 3)), rng.random(9) * 1e12, dtype=dtype)
    path = tmp_path / "tf.json"
    text = tf.to_json(path)
    for source in (text, path, str(path), json.loads(text)):
        again = TransferFunction.from_json(source)
        assert again.dtype == dtype
        for a, b in zip(jax.tree.leaves(tf), jax.tree.leaves(again), strict=True):
            np.testing.assert_array_equal(a, b)
    assert TransferFunction.from_json(path, dtype="float32").dtype == np.float32


def test_paraview_rgb_without_opacities_gets_a_ramp(tmp_path):
    path = tmp_path / "map.json"
    path.write_text(json.dumps(paraview()))
    tf = TransferFunction.from_json(path, unit_distance=0.25)
    np.testing.assert_array_equal(tf.positions, X)
    np.testing.assert_allclose(tf.colors, NODES)
    np.testing.assert_allclose(tf.extinctions, X / 2.0 / 0.25)


def test_paraview_opacity_nodes_between_colour_nodes_count():
    # VTK's ray caster draws a peak between two colour nodes as nothing.
    points = [0.0, 0, 0.5, 0, 0.7, 0, 0.5, 0, 0.75, 1, 0.5, 0, 0.8, 0, 0.5, 0, 2.0, 0, 0.5, 0]
    tf = TransferFunction.from_json(paraview(Points=points))
    assert float(tf(0.75)[1]) == 1
    s = np.linspace(-0.5, 2.5, 301)
    np.testing.assert_allclose(tf(s)[1], np.interp(s, points[::4], points[1::4]), atol=1e-14)
    for c in range(3):
        np.testing.assert_allclose(tf(s)[0][:, c], np.interp(s, X, NODES[:, c]), atol=1e-14)
    grid = TransferFunction.from_json(
        paraview(Points=[0, 0, 0.5, 0, 1, 0.5, 0.5, 0]), convention="grid", unit_distance=2.0
    )
    assert float(grid.extinctions[-1]) == pytest.approx(np.log(2) / 2)


def test_paraview_midpoint_and_sharpness():
    tf = TransferFunction.from_json(paraview(Points=[0, 0, 0.25, 0, 1, 0.8, 0.5, 0]))
    np.testing.assert_allclose(tf(np.array([0.125, 0.25, 0.5]))[1], [0.2, 0.4, 0.4 + 0.4 / 3])
    step = TransferFunction.from_json(paraview(Points=[0, 0.1, 0.25, 1, 1, 0.8, 0.5, 0]))
    np.testing.assert_allclose(step(np.array([0.2, 0.249, 0.25, 0.9]))[1], [0.1, 0.1, 0.8, 0.8])
    # Numbers from vtkPiecewiseFunction (VTK 9.7.2).
    bent = paraview(Points=[0, 0.2, 0.3, 0.7, 1, 0.9, 0.5, 0])
    tf = TransferFunction.from_json(bent, points=4000)
    np.testing.assert_allclose(tf(np.array(VTK_BENT_AT))[1], VTK_BENT, atol=1e-5)


VTK_BENT_AT = [0.1, 0.25, 0.3, 0.35, 0.6]
VTK_BENT = [0.200016012195, 0.242756003172, 0.55, 0.750369373626, 0.898759013173]

# Colours at 0.5, 1.0 and 1.7 of vtkColorTransferFunction (VTK 9.7.2) with the nodes RGB.
VTK_COLORS = {
    "RGB": [[0.8, 0.3, 0.2], [0.6, 0.5, 0.26666666666667], [0.32, 0.78, 0.36]],
    "HSV": [
        [0.8, 0.3, 0.2],
        [0.83333333333333, 0.75298843817362, 0.20061728395062],
        [0.29428783068783, 0.88, 0.20044444444444],
    ],
    "HSVWrap": [
        [0.8, 0.3, 0.2],
        [0.83333333333333, 0.75298843817362, 0.20061728395062],
        [0.29428783068783, 0.88, 0.20044444444444],
    ],
    "Lab": [
        [0.79999750971637, 0.30003185805749, 0.20000391550797],
        [0.71567891712349, 0.53736172559584, 0.2600062500584],
        [0.47421654133316, 0.79653874893502, 0.35590046041751],
    ],
    "Diverging": [
        [0.79999750971637, 0.30003185805749, 0.20000391550797],
        [1.0, 0.89125114856893, 0.68868717493875],
        [0.66674586745443, 1.0, 0.69869836010956],
    ],
}


@pytest.mark.parametrize("space", ["RGB", "HSV", "HSVWrap", "Lab", "Diverging"])
def test_colour_spaces_agree_with_vtk(space):
    entry = dict(ColorSpace="HSV", HSVWrap=True) if space == "HSVWrap" else dict(ColorSpace=space)
    tf = TransferFunction.from_json(paraview(**entry), points=3000)
    np.testing.assert_allclose(tf(np.array([0.5, 1.0, 1.7]))[0], VTK_COLORS[space], atol=2e-3)
    exact = tf(X)[0]
    np.testing.assert_array_equal(exact, NODES)


def test_interpolate_agrees_with_vtk_to_rounding():
    for space, want in VTK_COLORS.items():
        lo, hi = NODES[[0, 1, 1]], NODES[[1, 2, 2]]
        got = colormaps.interpolate(space, lo, hi, np.array([1.0, 0.5 / 1.5, 1.2 / 1.5]))
        np.testing.assert_allclose(got, want, atol=1e-12)
    with pytest.raises(ValueError, match="'CMYK' is not known, only RGB"):
        colormaps.interpolate("CMYK", NODES, NODES, np.zeros(3))


def test_step_becomes_jumps():
    tf = TransferFunction.from_json(paraview(ColorSpace="Step"))
    np.testing.assert_array_equal(tf(np.array([-1.0, 0.2, 0.6, 3.0]))[0], NODES[[0, 1, 2, 2]])
    np.testing.assert_array_equal(tf.positions, [0.0, 0.0, 0.5, 0.5, 2.0])


def test_several_maps_are_chosen_by_name():
    two = paraview() + paraview(Name="other", RGBPoints=[0, 1, 1, 1, 1, 0, 0, 0])
    assert TransferFunction.from_json(two, name="other").positions.shape == (2,)
    with pytest.raises(ValueError, match=r"choose by name among \['mine', 'other'\]"):
        TransferFunction.from_json(two)
    with pytest.raises(ValueError, match="no colour map 'third'"):
        TransferFunction.from_json(two, name="third")


def test_nearby_nodes_survive_rounding_to_float32():
    points = [0, 0, 0.5, 0, 1, 0.2, 0.5, 1, 1 + 1e-10, 0.9, 0.5, 0, 1 + 2e-10, 0.1, 0.5, 0]
    tf = TransferFunction.from_json(paraview(Points=points), dtype="float32")
    np.testing.assert_allclose(
        tf(np.array([0.99999, 1.0001], np.float32))[1], [0.2, 0.1], atol=1e-4
    )


OWN = {
    "format": "jaxvr.TransferFunction",
    "version": 1,
    "positions": [0, 1],
    "colors": [[0, 0, 0], [1, 1, 1]],
    "extinctions": [0, 1],
}


@pytest.mark.parametrize(
    "source, message",
    [
        ("no/such/file.json", "neither JSON text nor a readable file"),
        ("a\0b", "neither JSON text nor a readable file"),
        ("{", "not valid JSON"),
        ("[" * 100_000, "not valid JSON"),
        ("[]", "holds no colour maps"),
        ("[1, 2]", "holds no colour maps"),
        ("{}", "'RGBPoints' is missing"),
        (3, "A path, JSON text, a dict or a list"),
        (paraview(RGBPoints=RGB[:-1]), "4 numbers a node"),
        (paraview(RGBPoints=[]), "4 numbers a node|numbers only"),
        (paraview(RGBPoints=["a"] * 4), "numbers only"),
        (paraview(RGBPoints=[[1], [2, 3]]), "not a regular array"),
        (paraview(RGBPoints=[float("nan")] * 4), "NaN or infinite"),
        (paraview(RGBPoints={"a": 1}), "numbers only"),
        (paraview(RGBPoints=RGB[4:] + RGB[:4]), "sorted"),
        (paraview(Points=[0, 2, 0.5, 0, 1, 0, 0.5, 0]), r"opacities"),
        (paraview(ColorSpace="CIEDE2000"), "'CIEDE2000' cannot be read"),
        (paraview(ColorSpace=["RGB"]), "cannot be read"),
        ([{"IndexedColors": [0, 0, 0]}], "categorical"),
        (OWN | {"version": 2}, "only 'jaxvr.TransferFunction', version 1"),
        (OWN | {"dtype": "int8"}, "dtype must be"),
        (OWN | {"dtype": [1]}, "dtype must be"),
        (OWN | {"colors": [[0, 0], [1, 1]]}, "colors must have shape"),
        (OWN | {"positions": ["0", "1"]}, "numbers only"),
        (OWN | {"positions": [0, None]}, "numbers only"),
        (OWN | {"extinctions": [0, -1]}, "negative"),
        ({k: v for k, v in OWN.items() if k != "colors"}, "'colors' is missing"),
    ],
)
def test_malformed_input_is_refused(source, message):
    with pytest.raises(ValueError, match=message):
        TransferFunction.from_json(source)


def test_a_binary_file_is_refused(tmp_path):
    path = tmp_path / "tf.json"
    path.write_bytes(bytes(range(256)))
    with pytest.raises(ValueError, match="not a text file"):
        TransferFunction.from_json(path)
    with pytest.raises(ValueError, match="readable file"):
        TransferFunction.from_json(tmp_path)


def test_a_colour_for_nan_is_not_missed():
    """It is left out, and the fields that would need it are refused, in words that say so."""
    preset = paraview(NanColor=[1, 0, 0], NanOpacity=0.5, RGBPoints=RGB)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        transfer = TransferFunction.from_json(preset)
    same = TransferFunction.from_json(paraview(RGBPoints=RGB))
    np.testing.assert_array_equal(transfer.colors, same.colors)
    points, tets = np.eye(4, 3), {"tetra": [[0, 1, 2, 3]]}
    for location, values in (("point", [0, 1, np.nan, 2]), ("cell", [np.nan])):
        with pytest.raises(ValueError, match="values has 1 NaN.* there is no colour for NaN"):
            jaxvr.TetMesh.from_cells(points, tets, values, location=location)
