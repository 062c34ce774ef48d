"""Plots and PNG files: what is written can be read back, and no display or pyplot is needed."""

from __future__ import annotations

import subprocess
import sys

import matplotlib.image
import numpy as np
import pytest

from jaxvr import plot
from jaxvr.optics.transfer import TransferFunction


def picture(height=6, width=9):
    rng = np.random.default_rng(0)
    alpha = rng.random((height, width, 1))
    alpha[0, 0] = 0
    return np.concatenate([alpha * rng.random((height, width, 3)), alpha], axis=-1)


def test_transparent_png_has_straight_alpha(tmp_path, dtype):
    path, image = tmp_path / "a.png", picture().astype(dtype)
    plot.save_png(path, image)
    got = matplotlib.image.imread(path)
    assert got.shape == (6, 9, 4)
    np.testing.assert_allclose(got[..., 3], image[..., 3], atol=0.51 / 255)
    straight = image[..., :3] / np.maximum(image[..., 3:], 1e-9)
    seen = image[..., 3] > 0
    np.testing.assert_allclose(got[seen][:, :3], straight[seen], atol=0.51 / 255)
    np.testing.assert_array_equal(got[0, 0], 0)


def test_opaque_png_over_a_background(tmp_path):
    image, white = picture(), np.ones(3)
    plot.save_png(tmp_path / "a.png", image, background=white)
    got = matplotlib.image.imread(tmp_path / "a.png")[..., :3]
    np.testing.assert_allclose(got, image[..., :3] + 1 - image[..., 3:], atol=0.51 / 255)
    plot.save_png(str(tmp_path / "b.png"), np.full((2, 3, 3), 0.5), srgb=True)
    got = matplotlib.image.imread(tmp_path / "b.png")
    assert got.shape[:2] == (2, 3)
    np.testing.assert_allclose(got[..., :3], 188 / 255, rtol=1e-6)


@pytest.mark.parametrize("bad", [np.zeros((4, 4)), np.zeros((4, 4, 2)), np.zeros((0, 4, 4))])
def test_what_is_no_image_is_refused(bad, tmp_path):
    with pytest.raises(ValueError, match="image"):
        plot.save_png(tmp_path / "a.png", bad)
    with pytest.raises(ValueError, match="NaN"):
        plot.show(np.full((4, 4, 4), np.nan))


def test_figures_are_drawn(tmp_path):
    positions, extinctions = [0.0, 0.4, 0.4, 1.0], [0.0, 2.0, 0.5, 1.0]
    jump = TransferFunction.from_colormap("viridis", positions, extinctions)
    nothing = TransferFunction([0.5], [[1.0, 0.0, 0.0]], [0.0])
    a, b = picture(), picture()[::-1]
    figures = [
        plot.show(a, title="one"),
        plot.comparison([a, b, a], ["a", "b", "c"], background=(1, 1, 1)),
        plot.difference(a, b, title="a - b"),
        plot.difference(a, a),
        plot.against([a, b], b, ["a", "b", "reference"], window=(1, 2, 3)),
        plot.plot_transfer(jump),
        plot.plot_transfer(jump, reference=jump.with_points(5)),
        plot.plot_transfer(nothing),
    ]
    for k, figure in enumerate(figures):
        path = tmp_path / f"{k}.png"
        figure.savefig(path)
        pixels = matplotlib.image.imread(path)
        assert pixels.shape[0] >= 300 and pixels[..., :3].std() > 0.02
        assert figure._repr_png_().startswith(b"\x89PNG")


def test_difference_states_its_scale():
    a, b = np.zeros((4, 5, 4)), np.zeros((4, 5, 4))
    b[1, 2, 0] = 0.25  # one number of 80
    title = plot.difference(a, b).axes[0].get_title()
    assert "max 2.50e-01" in title and "mean 3.1" in title and "scale ±2.50e-01" in title
    drawn = plot.difference(a, b, scale=0.5).axes[0].images[0]
    assert drawn.get_clim() == (-0.5, 0.5) and np.asarray(drawn.get_array())[1, 2] == -0.25
    with pytest.raises(ValueError, match=r"\(4, 5, 4\) and \(4, 5, 3\)"):
        plot.difference(a, b[..., :3])
    with pytest.raises(ValueError, match="scale"):
        plot.difference(a, b, scale=0.0)
    with pytest.raises(ValueError, match="2 images, but 1 titles"):
        plot.comparison([a, b], ["a"])
    with pytest.raises(ValueError, match="at least one"):
        plot.comparison([])


def test_against_has_one_scale_and_the_sign_of_picture_less_reference():
    dark, bright = np.zeros((4, 5, 3)), np.full((4, 5, 3), 0.5)
    axes = plot.against([dark, bright], bright, ["dark", "bright", "reference"]).axes
    first, second = axes[3].images[0], axes[4].images[0]
    assert first.get_clim() == second.get_clim() == (-0.5, 0.5)
    np.testing.assert_array_equal(first.get_array(), -0.5)
    np.testing.assert_array_equal(second.get_array(), 0)
    with pytest.raises(ValueError, match="1 images and 1 titles"):
        plot.against([dark], bright, ["dark"])


def test_nothing_imports_pyplot_and_only_plot_draws():
    code = (
        "import sys; from jaxvr.optics.transfer import TransferFunction as T; "
        "assert 'matplotlib' not in sys.modules; T.from_colormap('viridis', [0, 1], [0, 1]); "
        "assert 'matplotlib.figure' not in sys.modules; "
        "import jaxvr.plot; assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
