"""Targets that no picture can be like are refused, or told before the fit."""

from __future__ import annotations

import re
import warnings

import numpy as np
import pytest

import jaxvr
from jaxvr.fit import Parameters, Sigmoid, Softplus
from jaxvr.fit.targets import images_of, look_at_targets
from jaxvr.hints import ViewWarning

START = jaxvr.TransferFunction([0.0, 1.0], [[0.2, 0.4, 0.9], [0, 0.3, 0.8]], [1.0, 2.0])
RNG = np.random.default_rng(0)
ALPHA = 0.8 * RNG.random((6, 5, 1))
PICTURE = np.concatenate([ALPHA * RNG.random((6, 5, 3)), ALPHA], -1)


def test_bytes_are_refused_by_fit():
    volume = jaxvr.datasets.box((1, 1, 1))
    camera = jaxvr.Camera.orbit(volume, width=5, height=6)
    kinds = [("uint8", 255), ("uint16", 65535), ("int64", 255), ("bool", 255)]
    for dtype, full in kinds:
        with pytest.raises(ValueError, match=rf"targets\[0\] has dtype {dtype}.*divide by {full}"):
            jaxvr.fit(START, volume, camera, [(full * PICTURE).astype(dtype)], iterations=1)
    with pytest.raises(ValueError, match=r"targets\[0\] holds .* Divide bytes by 255"):
        jaxvr.fit(START, volume, camera, [255 * PICTURE], iterations=1)


def changed(channel, by):
    image = PICTURE.copy()
    image[2, 3, channel] += by
    return image


@pytest.mark.parametrize(
    ("image", "background", "message"),
    [
        (changed(0, 3.0), None, "has 1 of 90 numbers outside of 0 to 1, .*free="),
        (changed(1, -2.0), None, "outside of 0 to 1, from -"),
        (changed(3, 1.0), None, r"The alpha of targets\[1\] has 1 of 30"),
        (np.concatenate([PICTURE[..., :3] / ALPHA, ALPHA], -1), None, "colour exceeds their alpha"),
        (np.concatenate([PICTURE[..., :3], np.ones_like(ALPHA)], -1), (1.0, 1, 1), None),
        (PICTURE, (1.0, 1, 1), "targets are transparent"),
        (PICTURE[..., :3] + 0.5, (0.0, 0, 0), "outside of 0 to 1"),
        (PICTURE[..., :3] + 0.4, (1.5, 0, 0), None),
        (PICTURE + 0.001, None, None),
    ],
)
def test_what_no_picture_can_reach_is_told(image, background, message):
    good = image if background is not None and message is None else PICTURE
    good = good[..., : image.shape[-1]] if image.shape[-1] == 3 else good
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        look_at_targets([good, image], Parameters.of(START), background)
    if message is None:
        assert not caught
    else:
        assert any(w.category is ViewWarning and w.filename == __file__ for w in caught)
        assert [w for w in caught if re.search(message, str(w.message))]


def test_opaque_targets_without_a_background_are_told():
    opaque = np.concatenate([PICTURE[..., :3], np.ones_like(ALPHA)], -1)
    with pytest.warns(ViewWarning, match="All targets are opaque everywhere"):
        look_at_targets([opaque, opaque], Parameters.of(START), None)


def test_bounds_of_colours_decide():
    bright = changed(0, 3.0)
    bright[..., 3] = 0.9
    free = {"colors": Sigmoid(0.0, 5.0), "extinctions": Softplus(1.0)}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        look_at_targets([bright], Parameters.of(START, free), None)
    told = pytest.warns(ViewWarning, match="colour exceeds their alpha")
    with told, pytest.warns(ViewWarning, match="outside of 0 to 0.9"):
        look_at_targets([bright], Parameters.of(START, "extinctions"), None)


def test_one_kind_of_channels():
    with pytest.raises(ValueError, match="Some targets are RGBA"):
        images_of([PICTURE, PICTURE[..., :3]], [(6, 5)] * 2, (0, 0, 0))
