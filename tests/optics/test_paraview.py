"""ParaView's colour maps: logarithmic scales, names of spaces, and what is refused or told."""

from __future__ import annotations

import json

import numpy as np
import pytest
from vtkmodules.vtkCommonDataModel import vtkPiecewiseFunction
from vtkmodules.vtkRenderingCore import vtkColorTransferFunction

from jaxvr.optics.transfer import TransferFunction

NODES = [0.1, 0.9, 0.5, 0.8, 1.0, 0.2, 0.9, 0.4, 50.0, 0.3, 0.2, 0.1]
POINTS = [0.1, 0.0, 0.5, 0.0, 3.0, 0.8, 0.5, 0.0, 50.0, 0.3, 0.5, 0.0]


def entry(**changes):
    return {"Name": "mine", "ColorSpace": "RGB", "RGBPoints": NODES} | changes


@pytest.mark.parametrize("space", ["RGB", "HSV", "Lab", "Diverging"])
def test_a_logarithmic_scale_is_vtks(space):
    color, opacity = vtkColorTransferFunction(), vtkPiecewiseFunction()
    for x, r, g, b in np.reshape(NODES, (-1, 4)).tolist():
        color.AddRGBPoint(x, r, g, b)
    for x, o, _, _ in np.reshape(POINTS, (-1, 4)).tolist():
        opacity.AddPoint(x, o)
    getattr(color, f"SetColorSpaceTo{space}")()
    if space == "HSV":
        color.HSVWrapOff()
    color.SetScaleToLog10()
    opacity.UseLogScaleOn()
    tf = TransferFunction.from_json(
        entry(ColorSpace=space, Points=POINTS, UseLogScale=True), points=4000
    )
    x = np.geomspace(0.1, 50, 77)[1:-1]
    colors, extinctions = tf(x)
    np.testing.assert_allclose(colors, [color.GetColor(v) for v in x], atol=2e-3)
    np.testing.assert_allclose(extinctions, [opacity.GetValue(v) for v in x], atol=1e-4)
    assert set(NODES[::4]) <= set(np.asarray(tf.positions).tolist())
    with pytest.raises(ValueError, match="UseLogScale needs positions above 0, but 'RGBPoints'"):
        TransferFunction.from_json(entry(RGBPoints=[0.0, *NODES[1:]], UseLogScale=1))
    with pytest.raises(ValueError, match="'UseLogScale' must be true or false, but is 'no'"):
        TransferFunction.from_json(entry(UseLogScale="no"))


def test_cielab_is_lab():
    one, other = (TransferFunction.from_json(entry(ColorSpace=s)) for s in ("CIELAB", "Lab"))
    np.testing.assert_array_equal(one.colors, other.colors)
    with pytest.raises(ValueError, match="'Lab/CIEDE2000' cannot be read, only RGB.*from_vtk"):
        TransferFunction.from_json(entry(ColorSpace="Lab/CIEDE2000"))


def own(**changes):
    tf = TransferFunction([0.0, 1.0], [[0.2, 0.4, 1.0], [0.0, 0.3, 0.9]], [0.0, 2.0])
    return json.loads(tf.to_json()) | changes


@pytest.mark.parametrize(
    "document",
    [
        own(colors=[[51.0, 102.0, 255.0], [0.0, 76.5, 229.5]]),
        own(colors=[[0, 0, 2], [1, 1, 1]]),
        entry(RGBPoints=[0, 255, 0, 0, 1, 0, 127.5, 0]),
        entry(RGBPoints=[0, 3, 0, 0, 1, 0, 1, 0]),
        entry(RGBPoints=[0, -0.5, 0, 0, 1, 0, 1, 0]),
    ],
)
def test_colours_in_bytes_are_refused(document):
    for source in (document, json.dumps(document)):
        with pytest.raises(ValueError, match="1 is full intensity. Divide 8-bit colours by 255"):
            TransferFunction.from_json(source)


def test_lights_brighter_than_bytes_come_back():
    tf = TransferFunction([0.0, 1.0], [[50.5, 0.0, 0.0], [0.0, 0.3, 300.0]], [0.0, 2.0])
    np.testing.assert_array_equal(TransferFunction.from_json(tf.to_json()).colors, tf.colors)


def test_what_would_be_lost_is_told(tmp_path):
    with pytest.raises(ValueError, match="'colors' stands there twice"):
        TransferFunction.from_json('{"colors": 1, "colors": 2}')
    with pytest.raises(ValueError, match=r"\['extinction'\] are not known"):
        TransferFunction.from_json(own(extinction=[1, 2]))
    with pytest.warns(UserWarning, match="'points' is not read; ParaView's name is 'Points'"):
        TransferFunction.from_json(entry(points=POINTS))
    with pytest.warns(UserWarning, match="UseAboveRangeColor is not read"):
        TransferFunction.from_json(entry(UseAboveRangeColor=True))
    marked = tmp_path / "bom.json"
    marked.write_text(json.dumps(own()), encoding="utf-8-sig")
    assert TransferFunction.from_json(marked).positions.shape == (2,)
    with pytest.raises(ValueError, match="neither JSON text nor a readable file"):
        TransferFunction.from_json(tmp_path)
