"""Image measures against independent implementations, and conversions there and back."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import correlate1d

from jaxvr.view import images


def pair(shape=(20, 17, 3), dtype="float64", noise=0.1):
    rng = np.random.default_rng(1)
    a = rng.random(shape)
    return a.astype(dtype), (a + noise * rng.normal(size=shape)).astype(dtype)


def ssim_by_scipy(a, b):
    offsets = np.arange(-5, 6)
    window = np.exp(-(offsets**2) / (2 * 1.5**2))
    window /= window.sum()

    def mean(x):
        for axis in (0, 1):
            x = correlate1d(x, window, axis=axis)
        return x[5:-5, 5:-5]

    maps = []
    for x, y in zip(np.moveaxis(a, -1, 0), np.moveaxis(b, -1, 0), strict=True):
        mx, my = mean(x), mean(y)
        vx, vy, cxy = mean(x * x) - mx**2, mean(y * y) - my**2, mean(x * y) - mx * my
        top = (2 * mx * my + 1e-4) * (2 * cxy + 9e-4)
        maps.append(top / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4)))
    return np.mean(maps)


def test_ssim_against_scipy(dtype):
    a, b = pair(dtype=dtype)
    want = ssim_by_scipy(a.astype(np.float64), b.astype(np.float64))
    got = images.ssim(a, b)
    assert got.dtype == dtype and 0.1 < want < 0.99
    assert float(got) == pytest.approx(want, rel=1e-12 if dtype == "float64" else 1e-5)
    assert float(images.ssim(a[..., 0], b[..., 0])) == pytest.approx(
        ssim_by_scipy(a[..., :1].astype(float), b[..., :1].astype(float)), rel=1e-5
    )


def test_ssim_of_equal_images_is_one_and_peak_scales(dtype):
    a, b = pair(dtype=dtype)
    assert float(images.ssim(a, a)) == pytest.approx(1.0, abs=1e-6)
    assert float(images.ssim(255 * a, 255 * b, peak=255.0)) == pytest.approx(
        float(images.ssim(a, b)), rel=1e-5
    )


def test_psnr(dtype):
    a, b = pair(dtype=dtype)
    want = 10 * np.log10(1 / np.mean((a.astype(float) - b.astype(float)) ** 2))
    assert float(images.psnr(a, b)) == pytest.approx(want, rel=1e-5)
    assert float(images.psnr(255 * a, 255 * b, peak=255)) == pytest.approx(want, rel=1e-5)
    assert images.psnr(a, a) == np.inf
    assert images.psnr(np.zeros((2, 2)), np.full((2, 2), 0.1)) == pytest.approx(20.0)


def test_measures_are_differentiable():
    a, b = pair((13, 12, 3))
    d = np.random.default_rng(2).normal(size=a.shape)
    for measure in (images.psnr, images.ssim):
        got = np.vdot(jax.grad(measure)(jnp.asarray(a), b), d)
        want = (measure(a + 1e-5 * d, b) - measure(a - 1e-5 * d, b)) / 2e-5
        assert got == pytest.approx(float(want), rel=1e-6)
    assert not np.isnan(jax.grad(images.psnr)(jnp.asarray(a), a)).any()


def test_measures_refuse_what_does_not_fit():
    for measure in (images.psnr, images.ssim):
        with pytest.raises(ValueError, match=r"\(20, 17, 3\) and \(20, 17, 4\)"):
            measure(np.zeros((20, 17, 3)), np.zeros((20, 17, 4)))
        with pytest.raises(ValueError, match="empty"):
            measure(np.zeros((0, 4)), np.zeros((0, 4)))
    with pytest.raises(ValueError, match=">= 11"):
        images.ssim(np.zeros((10, 20, 3)), np.zeros((10, 20, 3)))


def test_composite_over(dtype):
    image = np.array([[[0.2, 0.1, 0.0, 0.5], [0.0, 0.0, 0.0, 0.0]]], dtype)
    got = images.composite_over(image, (1.0, 0.5, 0.25))
    assert got.dtype == dtype
    np.testing.assert_allclose(got, [[[0.7, 0.35, 0.125, 1], [1, 0.5, 0.25, 1]]], rtol=1e-6)
    np.testing.assert_allclose(images.composite_over(image, (0, 0, 0, 0.0)), image)
    np.testing.assert_allclose(images.composite_over(image, np.zeros((1, 2, 4))), image)
    for background in (1.0, (1.0, 2.0), np.zeros((3, 3, 3))):
        with pytest.raises(ValueError, match="background"):
            images.composite_over(image, background)
    with pytest.raises(ValueError, match="RGBA"):
        images.composite_over(image[..., :3], (0, 0, 0))


def test_srgb_there_and_back(dtype):
    x = np.linspace(-0.1, 1.2, 300).astype(dtype)
    tolerance = 1e-5 if dtype == "float32" else 2e-7  # the standard's two pieces do not quite meet
    np.testing.assert_allclose(images.srgb_to_linear(images.linear_to_srgb(x)), x, atol=tolerance)
    assert float(images.linear_to_srgb(0.5)) == pytest.approx(0.7353569831)
    assert float(images.srgb_to_linear(0.5)) == pytest.approx(0.2140411405)
    assert float(images.linear_to_srgb(1.0)) == pytest.approx(1.0)
    assert np.isfinite(jax.vmap(jax.grad(images.linear_to_srgb))(jnp.asarray(x))).all()


def test_unpremultiply():
    image = jnp.array([[0.25, 0.1, 0.0, 0.5], [0.0, 0.0, 0.0, 0.0]])
    np.testing.assert_allclose(images.unpremultiply(image), [[0.5, 0.2, 0, 0.5], [0, 0, 0, 0]])
    assert np.isfinite(jax.grad(lambda i: jnp.sum(images.unpremultiply(i)))(image)).all()


def test_to_uint8():
    got = images.to_uint8([[-1.0, 0.0, 0.5, 1.0, 2.0]])
    assert got.dtype == np.uint8 and got.tolist() == [[0, 0, 128, 255, 255]]
    coded = images.to_uint8(np.array([[[0.5, 0.5, 0.5, 0.5]]]), srgb=True)
    assert coded.tolist() == [[[188, 188, 188, 128]]]
    with pytest.raises(ValueError, match="NaN"):
        images.to_uint8([np.nan])
