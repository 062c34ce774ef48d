"""Plots: what they show, light and dark, on axes that are given or new, without pyplot."""

from __future__ import annotations

import dataclasses
import io
import subprocess
import sys
from types import SimpleNamespace

import jax
import matplotlib.colors
import matplotlib.image
import matplotlib.text
import numpy as np
import pytest
from matplotlib.axes import Axes

import jaxvr
from jaxvr import plot
from jaxvr.files import pixels
from jaxvr.optics.transfer import TransferFunction
from jaxvr.view.images import srgb_to_linear


def picture(height=6, width=9):
    rng = np.random.default_rng(0)
    alpha = rng.random((height, width, 1))
    alpha[0, 0] = 0
    return np.concatenate([alpha * rng.random((height, width, 3)), alpha], axis=-1)


JUMP = TransferFunction.from_colormap("viridis", [0.0, 0.4, 0.4, 1.0], [0.0, 2.0, 0.5, 1.0])
NOTHING = TransferFunction([0.5], [[1.0, 0.0, 0.0]], [0.0])
SLOPE = TransferFunction.tree_unflatten(
    0.0, (np.zeros(4), np.linspace(-1, 2, 12).reshape(4, 3), np.array([1.0, -3.0, 0.0, 2.0]))
)
KMAP = jaxvr.KMap(
    entries=np.array([[1, 1, 2, 3], [6, 7, 90, 1]]),
    moved=np.zeros((2, 4), int),
    fragments=np.array([[0, 2, 4, 6], [8, 9, 99, 1]]),
)
RESULT = SimpleNamespace(
    loss_history=np.array([1.0, 0.1, 0.0, 0.01]),
    report=lambda: {"held_out": [{"psnr": 41.234, "ssim": 0.99}]},
)
A, B = picture(), picture()[::-1]
SCALARS = np.linspace(-0.5, 1.2, 99)

# Every plot once: from axes (None for new ones) to the axes that it drew on.
PLOTS = {
    "image": lambda ax: plot.image(A, ax=ax, title="one", axes=True),
    "image_transfer": lambda ax: plot.image(A, ax, transfer=JUMP, label="heat (K)"),
    "image_point": lambda ax: plot.image(A, ax=ax, transfer=NOTHING, background=(0, 0, 1)),
    "difference": lambda ax: plot.difference(A, B, title="a - b", ax=ax),
    "equal": lambda ax: plot.difference(A, A, ax),
    "transfer": lambda ax: plot.transfer(JUMP, ax),
    "transfer_title": lambda ax: plot.transfer(JUMP, ax, title="one"),
    "transfer_reference": lambda ax: plot.transfer(JUMP, ax, JUMP.with_points(5), SCALARS),
    "transfer_nothing": lambda ax: plot.transfer(NOTHING, ax),
    "history": lambda ax: plot.history(RESULT, ax),
    "gradient": lambda ax: plot.gradient(A - B, ax, title="slope"),
    "transfer_gradient": lambda ax: plot.transfer_gradient(JUMP, SLOPE, ax, title="slope"),
    "k_map": lambda ax: plot.k_map(KMAP, ax, title="entries"),
}
SEVERAL = {
    "compare": (3, lambda axes: plot.compare([A, B, A], ["a", "b", "c"], axes=axes)),
    "against": (6, lambda axes: plot.against([A, B], B, ["a", "b", "b"], axes=axes)),
    "against_window": (
        9,
        lambda axes: plot.against([A, B], B, ["a", "b", "b"], window=(1, 2, 3), axes=axes),
    ),
}

ALL = {name: (1, draw) for name, draw in PLOTS.items()} | SEVERAL


def figure_axes(count):
    figure = plot.Figure(figsize=(3 * count, 4))
    axes = figure.subplots(1, count, squeeze=False)
    return figure, axes


@pytest.mark.parametrize("name", ALL)
def test_new_axes_show_themselves_and_given_ones_are_returned(name, tmp_path):
    count, draw = ALL[name]
    new = draw(None)
    assert new._repr_png_().startswith(b"\x89PNG")
    new.savefig(tmp_path / "a.png")
    shown = matplotlib.image.imread(tmp_path / "a.png")
    assert min(shown.shape[:2]) >= 200 and shown[..., :3].std() > 0.02
    assert matplotlib.image.imread(io.BytesIO(new.figure._repr_png_())).shape == shown.shape
    figure, axes = figure_axes(count)
    if name in SEVERAL:
        assert len(new) == count
        got = draw(axes)
        assert all(a is b for a, b in zip(got, axes.ravel(), strict=True))
        with pytest.raises(ValueError, match=f"{count} axes, but was given 1"):
            draw(axes[0, 0])
    else:
        assert draw(axes[0, 0]) is axes[0, 0]
    figure.savefig(tmp_path / "b.png")
    assert matplotlib.image.imread(tmp_path / "b.png")[..., :3].std() > 0.01


def luminance(color):
    return np.asarray(srgb_to_linear(matplotlib.colors.to_rgb(color))) @ [
        0.2126,
        0.7152,
        0.0722,
    ]


def contrast(a, b):
    """As the Web Content Accessibility Guidelines have it: 21 for black on white."""
    low, high = sorted([luminance(a), luminance(b)])
    return (high + 0.05) / (low + 0.05)


def colors_of(figure):
    """Of all text and lines that are drawn, with what they are."""
    figure.draw_without_rendering()
    for text in figure.findobj(matplotlib.text.Text):
        if text.get_text() and text.get_visible():
            yield f"text {text.get_text()!r}", text.get_color()
    for ax in figure.findobj(Axes):
        for line in (
            [] if not ax.axison else [*ax.lines, *ax.get_xticklines(), *ax.get_yticklines()]
        ):
            yield f"line {line.get_label()!r}", line.get_color()
        for name, spine in ax.spines.items() if ax.axison else ():
            yield name, spine.get_edgecolor()


@pytest.mark.parametrize("name", ALL)
def test_text_and_lines_stand_out_light_and_dark(name):
    count, draw = ALL[name]
    light = draw(None).figure
    with plot.dark():
        dark = draw(None).figure
        given, axes = figure_axes(count)
    # Outside of the style, on axes made inside of it.
    draw(axes if name in SEVERAL else axes[0, 0])
    for figure, page in ((light, "white"), (dark, "black"), (given, "black")):
        assert matplotlib.colors.to_hex(figure.get_facecolor()) == matplotlib.colors.to_hex(page)
        found = list(colors_of(figure))
        for what, color in found:
            assert contrast(color, page) >= 3, (what, color, page)
    got = matplotlib.image.imread(io.BytesIO(dark._repr_png_()))
    np.testing.assert_array_equal(got[0, 0], [0, 0, 0, 1])  # though saved outside of the style


@pytest.mark.parametrize("size", [(6, 9), (37, 20), (400, 401), (600, 450)])
def test_a_picture_has_its_pixels_as_they_are(size):
    image = np.random.default_rng(1).random((*size, 3))
    for draw in (
        lambda: plot.image(image, title="some title", transfer=JUMP, axes=True),
        lambda: plot.compare([image[:, ::-1], image], ["a", "a long title " * 9])[1],
    ):
        ax = draw()
        shown = matplotlib.image.imread(io.BytesIO(ax._repr_png_()))
        low = np.rint(ax.get_window_extent().min).astype(int)
        high = np.rint(ax.get_window_extent().max).astype(int)
        part = shown[shown.shape[0] - high[1] : shown.shape[0] - low[1], low[0] : high[0], :3]
        k = part.shape[0] // size[0]
        assert part.shape == (k * size[0], k * size[1], 3)
        if draw().axison:  # the frame lies on the outer pixels
            part, inner = part[2:-2, 2:-2], np.s_[2:-2, 2:-2]
        else:
            inner = np.s_[:]
        want = pixels(image).repeat(k, 0).repeat(k, 1)[inner]
        np.testing.assert_array_equal(np.rint(part * 255), want)


def test_titles_fit_their_pictures():
    axes = plot.compare([A, A], ["a", "a title that is much longer than its picture is wide " * 2])
    box, ax = (x.get_window_extent() for x in (axes[1].title, axes[1]))
    assert box.width < 1.1 * ax.width and axes[0].title.get_fontsize() > 10


@pytest.mark.parametrize("bad", [np.zeros((4, 4)), np.zeros((4, 4, 2)), np.zeros((0, 4, 4))])
def test_what_is_no_image_is_refused(bad):
    with pytest.raises(ValueError, match="image"):
        plot.image(bad)
    with pytest.raises(ValueError, match="NaN"):
        plot.image(np.full((4, 4, 4), np.nan))


def test_the_bar_of_a_picture_has_the_colours_as_opaque_as_they_are():
    tf = TransferFunction([10.0, 20.0], [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], [0.0, 3.0])
    bar = plot.image(A, transfer=tf, label="heat (K)").child_axes[0]
    assert bar.get_ylim() == (10, 20) and bar.get_ylabel() == "heat (K)"
    _, strip, opaque = (np.asarray(x.get_array()) for x in bar.images)
    strip, opaque = strip[:, 0], opaque[:, 0]
    np.testing.assert_allclose(strip[:, 3], np.linspace(255, 0, 512), atol=1)
    for shown in (strip, opaque):
        np.testing.assert_allclose(shown[128, :3], [64, 0, 191], atol=1)
    assert opaque.shape == (512, 3)
    over = plot.image(A, transfer=tf, background=(0, 0, 0)).child_axes[0].images[1].get_array()
    assert over.shape[-1] == 3 and not over[-1].any()
    coded = plot.image(A, transfer=tf, srgb=True).child_axes[0].images[1].get_array()
    np.testing.assert_allclose(coded[256, 0], [188, 0, 188, 128], atol=1)


def test_difference_states_its_scale():
    a, b = np.zeros((4, 5, 4)), np.zeros((4, 5, 4))
    b[1, 2, 0] = 0.25  # one number of 80
    title = plot.difference(a, b).get_title()
    assert "max 2.50e-01" in title and "mean 3.1" in title and "scale ±2.50e-01" in title
    drawn = plot.difference(a, b, scale=0.5).images[0]
    assert drawn.get_clim() == (-0.5, 0.5) and np.asarray(drawn.get_array())[1, 2] == -0.25
    with pytest.raises(ValueError, match=r"\(4, 5, 4\) and \(4, 5, 3\)"):
        plot.difference(a, b[..., :3])
    with pytest.raises(ValueError, match="scale"):
        plot.difference(a, b, scale=0.0)
    with pytest.raises(ValueError, match="2 images, but 1 titles"):
        plot.compare([a, b], ["a"])
    with pytest.raises(ValueError, match="at least one"):
        plot.compare([])


def test_against_has_one_scale_and_the_sign_of_picture_less_reference():
    dark, bright = np.zeros((4, 5, 3)), np.full((4, 5, 3), 0.5)
    axes = plot.against([dark, bright], bright, ["dark", "bright", "reference"])
    first, second = axes[3].images[0], axes[4].images[0]
    assert first.get_clim() == second.get_clim() == (-0.5, 0.5)
    np.testing.assert_array_equal(first.get_array(), -0.5)
    np.testing.assert_array_equal(second.get_array(), 0)
    with pytest.raises(ValueError, match="1 images and 1 titles"):
        plot.against([dark], bright, ["dark"])
    with pytest.raises(ValueError, match=r"'dark' is \(3, 5\) and the reference \(4, 5\)"):
        plot.against([dark[1:]], bright, ["dark", "bright"])


def test_the_histogram_counts_the_data_and_widens_the_axis():
    mesh = jaxvr.datasets.box((2, 2, 2), field=lambda p: 3 * p[:, 0])
    ax = plot.transfer(JUMP, values=mesh)
    low, high = ax.get_xlim()
    assert low < 0 and high > 3
    levels = ax.patches[0].get_data().values
    # 27 points, 9 of them at each of 0, 1.5 and 3.
    assert (levels > 0).sum() == 3 and np.ptp(levels[levels > 0]) == 0
    bottom, top = ax.get_ylim()
    assert bottom == 0 and top < 2.2  # the histogram does not change the other axis
    with pytest.raises(ValueError, match="values has 1 NaN"):
        plot.transfer(JUMP, values=[1.0, np.nan])
    with pytest.raises(ValueError, match="no values"):
        plot.transfer(JUMP, values=[])
    with pytest.raises(ValueError, match="TransferFunction, but got a list"):
        plot.transfer([1.0])  # type: ignore[arg-type]


def test_history_of_losses_and_of_a_fit():
    ax = plot.history(RESULT)
    assert ax.get_yscale() == "log" and ax.get_title() == "held out: PSNR 41.23 dB"
    assert plot.history([3.0, -1.0]).get_yscale() == "linear"
    assert plot.history([2.0]).get_title() == ""
    for scores, title in (
        ([None], "equal to the target"),
        ([40.0, 42.0], "PSNR 41.00 dB, mean of 2 views"),
        ([40.0, None], "PSNR 40.00 dB or more, 2 views"),
    ):
        report = {"held_out": [{"psnr": x} for x in scores]}
        result = SimpleNamespace(loss_history=[1.0], report=lambda report=report: report)
        assert title in plot.history(result).get_title()
        assert plot.history(result, title="mine").get_title() == "mine"
    with pytest.raises(ValueError, match="no losses"):
        plot.history([])


def test_gradient_is_red_above_zero_and_of_the_strongest_channel():
    x = np.zeros((5, 7, 3))
    x[1, 2] = [1.0, -4.0, 2.0]
    x[3, 4] = [0.5, 0.25, 0.0]
    drawn = plot.gradient(x).images[0]
    assert drawn.get_clim() == pytest.approx((-3.414, 3.414), abs=0.6)
    values = np.asarray(drawn.get_array())
    assert values[1, 2] == -4 and values[3, 4] == 0.5
    red, blue = (drawn.get_cmap()(t)[:3] for t in (0.9, 0.1))
    assert red[0] > red[2] and blue[2] > blue[0]
    ax = plot.gradient(x, channel=2, scale=1.0)
    assert np.asarray(ax.images[0].get_array())[1, 2] == 2 and "max 2.00e+00" in ax.get_title()
    plot.gradient(np.zeros((5, 7)))
    with pytest.raises(ValueError, match=r"\(H, W\) or \(H, W, C\), but this one is \(5,\)"):
        plot.gradient(np.zeros(5))
    with pytest.raises(ValueError, match="3 channels, but channel is 3"):
        plot.gradient(x, channel=3)
    with pytest.raises(ValueError, match="no channels"):
        plot.gradient(x[..., 0], channel=0)
    with pytest.raises(ValueError, match="use transfer_gradient"):
        plot.gradient(SLOPE)


def test_a_gradient_by_a_transfer_function_has_its_bars_and_lines():
    gradient = jax.grad(lambda tf: (tf(0.2)[1] * tf(0.2)[0] * np.array([1.0, 2.0, -3.0])).sum())(
        JUMP
    )
    ax = plot.transfer_gradient(JUMP, gradient)
    right = next(x for x in ax.figure.axes if x is not ax)
    bars = np.array([segment[1, 1] for segment in ax.collections[0].get_segments()])
    np.testing.assert_allclose(bars, gradient.extinctions)
    for line, channel in zip(right.lines, np.asarray(gradient.colors).T, strict=True):
        np.testing.assert_allclose(line.get_ydata(), channel)
        np.testing.assert_allclose(line.get_xdata(), JUMP.positions)
    for axes in (ax, right):
        assert axes.get_ylim()[0] == -axes.get_ylim()[1]  # both are 0 at the same height
    with pytest.raises(ValueError, match=r"gradient.extinctions must have shape \(1,\)"):
        plot.transfer_gradient(NOTHING, SLOPE)


def test_k_map_has_the_colours_of_the_paper_and_counts_pixels():
    ax = plot.k_map(KMAP)
    shown = np.asarray(ax.images[0].get_array())
    assert shown[0, 0, 3] == 0 and (shown[..., 3] == 255).sum() == 7
    green, yellow, red = shown[0, 1], shown[0, 3], shown[1, 2]
    assert green[:3].argmax() == 1 and red[:3].argmax() == 0 and min(yellow[:2]) > 200
    np.testing.assert_array_equal(shown[1, 0], yellow)
    texts = [text.get_text() for text in ax.get_legend().get_texts()]
    assert texts == ["up to 2: 3 pixels", "3 to 6: 2 pixels", "7 or more: 2 pixels"]
    assert ax.get_legend().get_title().get_text() == "entries needed, at most 90"
    texts = plot.k_map(KMAP, limits=(1, 2)).get_legend().get_texts()
    assert [t.get_text() for t in texts][:2] == ["up to 1: 2 pixels", "2: 1 pixels"]
    with pytest.raises(ValueError, match="limits"):
        plot.k_map(KMAP, limits=(6, 2))


def test_a_title_and_the_name_of_the_field():
    mesh = jaxvr.datasets.box((1, 1, 1))
    ax = plot.transfer(JUMP, title="mine", values=mesh)
    assert (ax.get_title(), ax.get_xlabel()) == ("mine", mesh.report.field or "scalar")
    named = dataclasses.replace(mesh, report=dataclasses.replace(mesh.report, field="pressure"))
    assert plot.transfer(JUMP, values=named).get_xlabel() == "pressure"


def test_what_stands_in_the_place_of_something_else():
    with pytest.raises(ValueError, match="kmap must be a jaxvr.KMap, but is a ndarray.*measure_k"):
        plot.k_map(np.zeros((4, 4)))
    with pytest.raises(ValueError, match="transfer must be a jaxvr.TransferFunction, but is a str"):
        plot.image(A, transfer="viridis")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"takes a list of images.*\(6, 9, 4\).*plot.image"):
        plot.compare(A)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="against takes a list of images"):
        plot.against(A, B, ["a", "b"])  # type: ignore[arg-type]
    plot.compare(np.stack([A, B]))  # type: ignore[arg-type]


def test_nothing_imports_pyplot_and_only_plot_draws():
    code = (
        "import sys, jaxvr, jaxvr.files; assert not hasattr(jaxvr, 'plots'); "
        "assert 'matplotlib' not in sys.modules; T = jaxvr.TransferFunction; "
        "T.from_colormap('viridis', [0, 1], [0, 1]); "
        "assert 'matplotlib.figure' not in sys.modules and 'jaxvr.plot' not in sys.modules; "
        "p = jaxvr.plot; p.transfer(T([0, 1], [[1, 0, 0]] * 2, [0, 1]))._repr_png_()\n"
        "with p.dark(): assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
