"""What notebooks and prompts show of meshes, transfer functions, cameras, segments and images."""

from __future__ import annotations

import io
import xml.etree.ElementTree as ET

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

import jaxvr
from jaxvr._core import svg
from jaxvr.fit import LoopResult
from jaxvr.interact import load_ipython_extension, unload_ipython_extension
from jaxvr.interact.ipython import png

TRANSFER = jaxvr.TransferFunction([0.0, 0.5, 0.5, 1.0], np.eye(4)[:, :3], [0.0, 2.0, 1.0, 3.0])


def parsed(html):
    """HTML here is well-formed XML too."""
    return ET.fromstring(f"<all>{html}</all>")


def test_mesh_shows_a_table_and_a_histogram():
    mesh = jaxvr.datasets.box((3, 2, 2), cell="hexahedron", dtype="float32")
    page = parsed(mesh._repr_html_())
    rows = {row[0].text: row[1].text or "" for row in page.iter("tr")}
    assert rows["tetrahedra"] == f"{mesh.n_tets:,}"
    assert rows["box"] == "(0, 0, 0) to (1, 1, 1)"
    assert rows["cells given"] == "12 hexahedron" and rows["repaired"] == "nothing"
    low, high = float(mesh.values.min()), float(mesh.values.max())
    assert rows["field"] == f"values, point data, {low:.6g} to {high:.6g}"
    assert any(e.tag.endswith("path") for e in page.iter())


def test_box_of_a_mesh_is_that_of_points_in_use():
    mesh = jaxvr.datasets.box((1, 1, 1))
    points = np.concatenate([np.asarray(mesh.points), [[9.0, 9.0, 9.0]]])
    with pytest.warns(UserWarning, match="turned round"):  # rows of a mesh are sorted
        one_more = jaxvr.TetMesh.from_cells(
            points, {"tetra": np.asarray(mesh.cells)}, np.zeros(9), location="point"
        )
    assert "(0, 0, 0) to (1, 1, 1)" in str(one_more._repr_html_())


@pytest.mark.parametrize(
    "values", [[2.5] * 8, [0, np.nan] * 4, [-3e38, 3e38] * 4, [np.inf, 1.0] * 4], ids=str
)
def test_mesh_with_odd_values_still_shows(values):
    mesh = jaxvr.datasets.box((1, 1, 1), dtype="float32")
    odd = jax.tree.unflatten(
        jax.tree.structure(mesh),
        [jnp.asarray(values, "float32") if x is mesh.values else x for x in jax.tree.leaves(mesh)],
    )
    parsed(odd._repr_html_())


def test_names_of_fields_are_escaped():
    import dataclasses

    mesh = jaxvr.datasets.box((1, 1, 1))
    report = dataclasses.replace(mesh.report, field="<b>&")
    html = dataclasses.replace(mesh, report=report)._repr_html_()
    assert html and "<b>" not in html


def everything():
    mesh = jaxvr.datasets.box((1, 1, 1))
    camera = jaxvr.Camera.orbit(mesh, width=4, height=3)
    nodes, two = jnp.zeros(5), jnp.arange(2)
    segments = jaxvr.Segments(nodes, nodes, jnp.arange(3), two, two, (2,))
    return [mesh, TRANSFER, camera, segments]


@pytest.mark.parametrize("tree", everything(), ids=lambda x: type(x).__name__)
def test_reprs_are_short_and_never_fail(tree):
    name = type(tree).__name__
    inside = []

    @jax.jit
    def traced(x):
        inside.append((repr(x), x._repr_html_() if hasattr(x, "_repr_html_") else None))
        return x

    jax.eval_shape(traced, tree)
    assert inside[0][1] is None
    shapes = jax.eval_shape(lambda x: x, tree)
    others = [jax.tree.map(lambda x, leaf=leaf: leaf, tree) for leaf in (None, object(), 1.0, "a")]
    for text in (repr(tree), inside[0][0], repr(shapes), *map(repr, others)):
        assert text.startswith(f"{name}(") and len(text) < 160 and "\n" not in text
    for other in (shapes, *others):
        assert not hasattr(other, "_repr_html_") or other._repr_html_() is None


def test_reprs_say_what_matters():
    mesh, transfer, camera, segments = everything()
    assert repr(transfer) == (
        "TransferFunction(4 control points, 0 to 1, extinction up to 3, float64)"
    )
    assert "target=(0.5, 0.5, 0.5)" in repr(camera) and "4 x 3 pixels" in repr(camera)
    assert repr(segments) == "Segments(2 rays, 2 nodes, float64)"
    flat = jaxvr.Camera.orthographic((0, 0, 3), (0, 0, 0), extent=2)
    assert "extent=2" in repr(flat)


def test_results_of_fits_are_short():
    picture = np.zeros((4, 4, 4))
    numbers = {"fitted_views": [{"psnr": 31.25}, {"psnr": None}], "held_out": [{"psnr": None}]}
    losses = np.linspace(0.5, 0.01, 300)
    result = jaxvr.FitResult(TRANSFER, losses, [picture] * 2, [picture], "iterations", numbers)
    assert repr(result) == (
        "FitResult(transfer of 4 control points, iterations 300 (stopped by iterations), "
        "loss 0.5 to 0.01, views 2 at 31.2 dB, held out 1)"
    )
    page = parsed(result._repr_html_())
    rows = {row[0].text: row[1].text or "" for row in page.iter("tr")}
    assert rows["loss"] == "0.5 to 0.01" and any(e.tag.endswith("polyline") for e in page.iter())
    assert "loss none" in repr(jaxvr.FitResult(TRANSFER, losses[:0], [], [], "callback", {}))
    loop = LoopResult({"a": np.zeros(999)}, losses, losses, "patience")
    assert repr(loop) == "LoopResult(300 iterations, loss 0.5 to 0.01, stopped by patience)"


def test_transfer_function_shows_its_curve():
    page = parsed(TRANSFER._repr_html_())
    stops = [e for e in page.iter() if e.tag.endswith("stop")]
    assert [s.get("stop-color") for s in stops] == ["#ff0000", "#00ff00", "#0000ff", "#000000"]
    assert stops[1].get("offset") == stops[2].get("offset")  # the jump
    assert sum(e.tag.endswith("circle") for e in page.iter()) == 4


@pytest.mark.parametrize(
    "transfer",
    [
        jaxvr.TransferFunction([0.3], [[1, 0, 0]], [2.0]),
        jaxvr.TransferFunction([0.3, 0.3], [[1, 0, 0], [0, 1, 0]], [2.0, 1.0]),
        jaxvr.TransferFunction([0, 1], [[9.0, 0, 0], [-1.0, 0, 0]], [0.0, 0.0]),
        jaxvr.TransferFunction([-3e38, 3e38], np.eye(2, 3), [0.0, 3e38], dtype="float32"),
        jaxvr.TransferFunction(np.arange(1000.0), np.zeros((1000, 3)), np.arange(1000.0)),
    ],
    ids=["one", "jump", "clear", "huge", "many"],
)
def test_any_transfer_function_shows(transfer):
    text = transfer._repr_html_()
    assert "nan" not in text and "inf" not in text and len(text) < 60_000
    parsed(text)


def test_a_gradient_is_not_drawn_as_a_transfer_function():
    gradient = jax.tree.map(lambda x: x * np.nan, TRANSFER)
    assert gradient._repr_html_() is None and repr(gradient)


def test_histogram_counts_each_value_once():
    counts, every = svg.histogram(np.linspace(0, 1, 101), 0.0, 1.0, bins=10)
    assert (counts.sum(), every) == (101, 1) and counts.min() >= 10
    counts, every = svg.histogram(np.zeros(5_000_000, "float32"), 0.0, 1.0)
    assert every == 5 and counts[0] == counts.sum() == 1_000_000


class FakePrinters:
    """What IPython's formatters do with types."""

    def __init__(self):
        self.type_printers = {}

    def for_type(self, kind, function):
        before = self.type_printers.get(kind)
        self.type_printers[kind] = function
        return before

    def pop(self, kind):
        return self.type_printers.pop(kind)


class FakeIPython:
    def __init__(self):
        self.display_formatter = self
        self.formatters = {"image/png": FakePrinters()}


def test_extension_registers_and_puts_back():
    ipython = FakeIPython()
    printers = ipython.formatters["image/png"].type_printers
    printers[np.ndarray] = repr
    load_ipython_extension(ipython)
    load_ipython_extension(ipython)
    assert printers[np.ndarray] is png and printers[type(jnp.zeros(1))] is png
    unload_ipython_extension(ipython)
    unload_ipython_extension(ipython)
    assert printers == {np.ndarray: repr}


@pytest.mark.parametrize("make", [np.asarray, jnp.asarray])
def test_images_are_shown_with_their_pixels(make):
    rng = np.random.default_rng(0)
    alpha = rng.random((9, 12, 1))
    image = np.concatenate([alpha * rng.random((9, 12, 3)), alpha], axis=-1)
    data = png(make(image))
    assert data is not None
    got = np.asarray(Image.open(io.BytesIO(data)))
    straight = np.concatenate([image[..., :3] / alpha, alpha], axis=-1)
    np.testing.assert_array_equal(got, np.rint(255 * straight))


IMAGE = np.full((8, 8, 4), 0.5, "float32")


@pytest.mark.parametrize(
    "array",
    [
        IMAGE[:7],
        IMAGE[..., :3],
        IMAGE[None],
        IMAGE.astype(int),
        IMAGE.astype(complex),
        IMAGE * np.nan,
        IMAGE * -1,
        IMAGE * 3,
        np.zeros(3),
        np.float64(1),
    ],
    ids=lambda a: f"{a.dtype}{a.shape}",
)
def test_other_arrays_stay_text(array):
    assert png(array) is None


def test_traced_images_stay_text():
    found = []
    jax.eval_shape(lambda x: found.append(png(x)), IMAGE)
    assert found == [None]
