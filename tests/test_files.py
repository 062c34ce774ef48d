"""Files of images and animations: what is written is read back."""

from __future__ import annotations

import importlib
import shutil
import subprocess

import numpy as np
import pytest
from PIL import Image, ImageSequence

import jaxvr
from jaxvr import files
from jaxvr.files import save_animation, save_image, turntable

# `jaxvr.render` is the function.
RENDER = importlib.import_module("jaxvr.render")

pytestmark = pytest.mark.usefixtures("quick_code")


def picture(height=6, width=9):
    rng = np.random.default_rng(0)
    alpha = rng.random((height, width, 1))
    alpha[0, 0] = 0
    return np.concatenate([alpha * rng.random((height, width, 3)), alpha], axis=-1)


def read(path):
    with Image.open(path) as image:
        return np.asarray(image)


def read_gif(path):
    with Image.open(path) as image:
        shown = ImageSequence.Iterator(image)
        return np.stack([np.asarray(x.convert("RGB")) for x in shown]), image.info


def read_mp4(path, height, width):
    command = [files._ffmpeg(), "-loglevel", "error", "-i", path, "-f", "rawvideo"]
    done = subprocess.run([*command, "-pix_fmt", "rgb24", "-"], capture_output=True, check=True)
    return np.frombuffer(done.stdout, np.uint8).reshape(-1, height, width, 3)


def test_transparent_png_has_straight_alpha(tmp_path, dtype):
    path, image = tmp_path / "a.png", picture().astype(dtype)
    save_image(path, image)
    got = read(path) / 255
    assert got.shape == (6, 9, 4)
    np.testing.assert_allclose(got[..., 3], image[..., 3], atol=0.51 / 255)
    straight = image[..., :3] / np.maximum(image[..., 3:], 1e-9)
    seen = image[..., 3] > 0
    np.testing.assert_allclose(got[seen][:, :3], straight[seen], atol=0.51 / 255)
    np.testing.assert_array_equal(got[0, 0], 0)


def test_opaque_png_over_a_background(tmp_path):
    image, white = picture(), np.ones(3)
    save_image(tmp_path / "a.PNG", image, background=white)
    got = read(tmp_path / "a.PNG") / 255
    np.testing.assert_allclose(got, image[..., :3] + 1 - image[..., 3:], atol=0.51 / 255)
    save_image(str(tmp_path / "b.png"), np.full((2, 3, 3), 0.5), srgb=True)
    np.testing.assert_array_equal(read(tmp_path / "b.png"), np.full((2, 3, 3), 188))
    data = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    save_image(tmp_path / "c.png", data)
    np.testing.assert_array_equal(read(tmp_path / "c.png"), data)


def test_npy_holds_the_floats(tmp_path, dtype):
    image = picture().astype(dtype)
    save_image(tmp_path / "a.npy", image)
    got = np.load(tmp_path / "a.npy")
    assert got.dtype == dtype
    np.testing.assert_array_equal(got, image)
    save_image(tmp_path / "a.NPY", image, background=(1, 0, 0))
    got = np.load(tmp_path / "a.NPY")
    np.testing.assert_allclose(got[0, 0], [1, 0, 0], atol=1e-7)


def test_exr_holds_premultiplied_float32(tmp_path):
    module = importlib.import_module("OpenEXR")
    image = 3 * picture()
    save_image(tmp_path / "a.exr", image)
    save_image(tmp_path / "b.exr", image, background=(0, 0, 0))
    for name, channels in (("a", 4), ("b", 3)):
        with module.File(str(tmp_path / f"{name}.exr")) as file:
            (got,) = (channel.pixels for channel in file.channels().values())
        assert got.dtype == np.float32
        np.testing.assert_array_equal(got, image[..., :channels].astype(np.float32))


def test_what_is_missing_is_named(tmp_path, monkeypatch):
    def nowhere(name):
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", nowhere)
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(ValueError, match=r"pip install 'OpenEXR>=3.3'"):
        save_image(tmp_path / "a.exr", picture())
    with pytest.raises(ValueError, match=r"install the program, or pip install imageio-ffmpeg"):
        save_animation(tmp_path / "a.mp4", [picture()])


@pytest.mark.parametrize("bad", [np.zeros((4, 4)), np.zeros((4, 4, 2)), np.zeros((0, 4, 4))])
@pytest.mark.parametrize("suffix", ["png", "npy"])
def test_what_is_no_image_is_refused(bad, suffix, tmp_path):
    path = tmp_path / f"a.{suffix}"
    with pytest.raises(ValueError, match=r"An image is \(H, W, 4\)"):
        save_image(path, bad)
    with pytest.raises(ValueError, match="16 NaN or infinite entries, the first at"):
        save_image(path, np.concatenate([np.ones((4, 4, 3)), np.full((4, 4, 1), np.nan)], -1))
    assert not path.exists()


def test_paths_and_options_that_cannot_be(tmp_path):
    image, data = picture(), np.zeros((2, 3, 4), np.uint8)
    with pytest.raises(ValueError, match=r"\.png, \.npy or \.exr, but the path is .*a\.jpg"):
        save_image(tmp_path / "a.jpg", image)
    with pytest.raises(ValueError, match=r"\.gif, \.mp4 or \.png, but the path is 'movie'"):
        save_animation("movie", [image])
    with pytest.raises(FileNotFoundError, match="no folder .*none' to write 'a.png' in"):
        save_image(tmp_path / "none" / "a.png", image)
    with pytest.raises(ValueError, match="leave out srgb"):
        save_image(tmp_path / "a.npy", image, srgb=True)
    with pytest.raises(ValueError, match="leave out srgb"):
        save_image(tmp_path / "a.png", data, srgb=True)
    with pytest.raises(ValueError, match="pass floats"):
        save_image(tmp_path / "a.png", data, background=(0, 0, 0))
    with pytest.raises(ValueError, match="video has no alpha"):
        save_animation(tmp_path / "a.gif", [data])
    with pytest.raises(ValueError, match="at least one frame"):
        save_animation(tmp_path / "a.gif", [])
    with pytest.raises(ValueError, match=r"frame 0 is \(6, 9, 3\) and frame 1 is \(5, 9, 3\)"):
        save_animation(tmp_path / "a.gif", [image, image[1:]])
    for fps in (0, -1, np.nan, "fast"):
        with pytest.raises(ValueError, match="fps must be a number above 0"):
            save_animation(tmp_path / "a.gif", [image], fps)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="at most 50 frames a second, but fps is 60"):
        save_animation(tmp_path / "a.gif", [image], 60)
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def scene():
    mesh = jaxvr.datasets.box((2, 1, 1), dtype="float32")
    return mesh, jaxvr.TransferFunction.from_colormap("turbo", [0.0, 1.0], [0.5, 4.0])


@pytest.fixture(scope="module")
def movie(scene):
    return turntable(*scene, frames=6, width=17, height=15, background=(0.2, 0, 0), progress=False)


def test_turntable_is_orbit_in_one_compiled_function(scene, movie, tmp_path, capsys):
    assert movie.shape == (6, 15, 17, 3) and movie.dtype == np.uint8
    for k in range(6):
        assert (movie[k] != movie[(k + 1) % 6]).any()
    camera = jaxvr.Camera.orbit(scene[0], azimuth=120.0, width=17, height=15)
    want = jaxvr.render(scene[0], camera, scene[1], background=(0.2, 0, 0))
    np.testing.assert_array_equal(movie[2], files.pixels(want)[..., :3])
    compiled = RENDER._render._cache_size()
    path = tmp_path / "a.gif"
    mesh, transfer = scene
    again = turntable(
        mesh,
        transfer,
        path,
        frames=6,
        width=17,
        height=15,
        background=(0.2, 0, 0),
        fps=10,
        zoom=2.0,
    )
    assert RENDER._render._cache_size() == compiled
    assert "6/6" in capsys.readouterr().err and (again != movie).any()
    assert len(read_gif(path)[0]) == 6


def test_turntable_looks_before_it_renders(scene, tmp_path):
    mesh, transfer = scene
    with pytest.raises(ValueError, match=r"\.gif, \.mp4 or \.png"):
        turntable(mesh, transfer, tmp_path / "a.avi", frames=0)
    with pytest.raises(FileNotFoundError, match="no folder"):
        turntable(mesh, transfer, tmp_path / "none" / "a.gif", frames=0)
    with pytest.raises(ValueError, match="frames must be at least 1, but is 0"):
        turntable(*scene, frames=0)
    with pytest.raises(ValueError, match="frames must be a whole number, but is 2.5"):
        turntable(*scene, frames=2.5)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="status"):
        turntable(*scene, status=True)


def test_gif_loops_with_one_palette(movie, tmp_path):
    path = tmp_path / "a.gif"
    assert save_animation(path, movie, fps=24) == [path]
    got, info = read_gif(path)
    assert got.shape == movie.shape and info["loop"] == 0
    assert len(np.unique(got.reshape(-1, 3), axis=0)) <= 256
    assert np.abs(got.astype(int) - movie).mean() < 3
    # The background is what it was in all frames.
    np.testing.assert_array_equal(got[:, 0, 0], movie[:, 0, 0])
    with Image.open(path) as image:
        durations = [x.info["duration"] for x in ImageSequence.Iterator(image)]
    assert sum(durations) == 250 and set(durations) == {40, 50}


def test_gif_of_few_colours_is_exact(tmp_path):
    data = np.random.default_rng(0).integers(0, 6, (4, 8, 9, 3)).astype(np.uint8) * 51
    save_animation(tmp_path / "a.gif", data)
    np.testing.assert_array_equal(read_gif(tmp_path / "a.gif")[0], data)
    save_animation(tmp_path / "b.gif", data[:1])
    np.testing.assert_array_equal(read_gif(tmp_path / "b.gif")[0], data[:1])


def test_one_colour_is_the_same_in_all_frames_of_a_gif():
    """A colour that stays must not flicker, whatever the others do."""
    data = np.random.default_rng(0).integers(0, 256, (5, 30, 30, 3)).astype(np.uint8)
    data[:, 3, 4] = 77, 130, 200
    palette, index = files._indexed(data)
    assert palette.shape == (256, 3) and palette.dtype == np.uint8
    assert (index[:, 3, 4] == index[0, 3, 4]).all()
    assert np.abs(palette[index].astype(int) - data).mean() < 20


def test_smooth_colours_of_a_gif_are_mixed(tmp_path):
    """A colour between two of the palette becomes so many pixels of the one and of the other."""
    greys = np.arange(193)[:, None].repeat(3, 1).astype(np.uint8)
    first, second, part = files._mixtures(greys, greys[::8])
    mixed = 8 * (first + part / 64 * (second - first))
    np.testing.assert_allclose(mixed, np.arange(193), atol=1e-9)
    # Over 8 x 8 pixels of one colour, in a picture with too many others.
    data = np.random.default_rng(0).integers(0, 256, (2, 32, 32, 3)).astype(np.uint8)
    data[:, 8:24, 8:24] = 200, 100, 50
    save_animation(tmp_path / "a.gif", data)
    patch = read_gif(tmp_path / "a.gif")[0][:, 8:24, 8:24]
    assert np.abs(patch.mean((1, 2)) - [200, 100, 50]).max() < 4
    np.testing.assert_array_equal(patch[0], patch[1])


def test_mp4_has_all_frames_and_even_sizes(movie, tmp_path):
    path = tmp_path / "a.mp4"
    large = movie.repeat(4, 1).repeat(4, 2)[:, 1:, 1:]  # 59 x 67
    assert save_animation(path, large, fps=12) == [path]
    got = read_mp4(path, 60, 68)
    assert len(got) == 6
    gap = np.abs(got[:, :59, :67].astype(int) - large)
    assert gap.mean() < 6
    flat = np.full((3, 32, 32, 3), (200, 60, 30), np.uint8)  # no edges: the colours come through
    save_animation(path, flat)
    assert np.abs(read_mp4(path, 32, 32).astype(int) - flat).max() <= 6


def test_frames_of_png_and_of_floats(movie, tmp_path):
    written = save_animation(tmp_path / "turn.png", movie)
    assert [path.name for path in written] == [f"turn_00{k}.png" for k in range(6)]
    np.testing.assert_array_equal(np.stack([read(path) for path in written]), movie)
    image = picture()  # transparent: over black
    (path,) = save_animation(tmp_path / "one.png", [image])
    np.testing.assert_array_equal(read(path), np.rint(255 * image[..., :3]))


def test_the_package_says_what_ffmpeg_said(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "_ffmpeg", lambda: shutil.which("false"))
    with pytest.raises(RuntimeError, match="could not write .*a.mp4'. It said: nothing"):
        save_animation(tmp_path / "a.mp4", [picture()])
