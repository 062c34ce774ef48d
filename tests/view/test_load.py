"""Pictures from elsewhere: what their numbers mean is done, or told."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image, ImageCms, PngImagePlugin

import jaxvr
from jaxvr.fit import l1
from jaxvr.view import (
    PictureWarning,
    composite_over,
    linear_to_srgb,
    load_image,
    srgb_to_linear,
    to_uint8,
    unpremultiply,
)

RNG = np.random.default_rng(0)
ALPHA = RNG.random((5, 4, 1))
PICTURE = np.concatenate([ALPHA * RNG.random((5, 4, 3)), ALPHA], -1)


def png(path: Path, pixels: np.ndarray, interlaced: bool = False) -> Path:
    """A PNG written here, of uint8 or uint16 (H, W, 1 to 4)."""
    height, width, channels = pixels.shape
    bits = 8 * pixels.dtype.itemsize
    raw = b"".join(b"\0" + row.astype(f">u{bits // 8}").tobytes() for row in pixels)

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    kind = {1: 0, 2: 4, 3: 2, 4: 6}[channels]
    head = struct.pack(">IIBBBBB", width, height, bits, kind, 0, 0, interlaced)
    parts = chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(raw)) + chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + parts)
    return path


@pytest.mark.parametrize("srgb", [False, True])
@pytest.mark.parametrize("suffix", [".png", ".npy", ".exr"])
def test_what_save_image_wrote_comes_back(suffix, srgb, tmp_path):
    if srgb and suffix != ".png":
        pytest.raises(ValueError, jaxvr.save_image, tmp_path / f"a{suffix}", PICTURE, srgb=True)
        return
    path = tmp_path / f"a{suffix}"
    jaxvr.save_image(path, PICTURE, srgb=srgb)
    back = load_image(path, srgb=srgb or None)
    assert back.shape == (5, 4, 4)
    if suffix == ".png":  # half a step of straight codes
        code = np.array(unpremultiply(back))
        want = np.array(unpremultiply(PICTURE))
        if srgb:
            code[..., :3], want[..., :3] = (
                linear_to_srgb(code[..., :3]),
                linear_to_srgb(want[..., :3]),
            )
        np.testing.assert_allclose(code, want, atol=0.5 / 255 + 1e-6)
    else:
        tolerance = 0 if suffix == ".npy" else 1e-7
        np.testing.assert_allclose(back, PICTURE, atol=tolerance, rtol=0)
        assert back.dtype == (np.float64 if suffix == ".npy" else np.float32)


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
def test_all_bits_of_a_png(dtype, channels, tmp_path):
    full = np.iinfo(dtype).max
    pixels = RNG.integers(0, full + 1, (6, 7, channels)).astype(dtype)
    back = load_image(png(tmp_path / "a.png", pixels), dtype="float64")
    color = pixels[..., :1] if channels < 3 else pixels[..., :3]
    alpha = pixels[..., -1:] / full if channels in (2, 4) else np.ones((6, 7, 1))
    np.testing.assert_allclose(back[..., 3:], alpha, atol=1e-15)
    want = np.broadcast_to(color / full * alpha, (6, 7, 3))
    np.testing.assert_allclose(back[..., :3], want, atol=1e-15)


def test_coding_alpha_and_background(tmp_path):
    pixels = RNG.integers(0, 256, (6, 7, 4)).astype("uint8")
    path = png(tmp_path / "a.png", pixels)
    code = pixels / 255
    decoded = np.asarray(srgb_to_linear(jnp.asarray(code[..., :3])))
    np.testing.assert_allclose(
        load_image(path, srgb=True)[..., :3], decoded * code[..., 3:], atol=1e-6
    )
    np.testing.assert_allclose(load_image(path, alpha="premultiplied"), code, atol=1e-6)
    back = (0.2, 0.5, 1.0)
    on = load_image(path, background=back)
    np.testing.assert_allclose(on, composite_over(load_image(path), back), atol=1e-6)
    assert (on[..., 3] == 1).all()
    np.save(tmp_path / "bytes.npy", pixels)
    np.testing.assert_array_equal(load_image(tmp_path / "bytes.npy"), load_image(path))
    straight = load_image(tmp_path / "bytes.npy", alpha="straight")
    np.testing.assert_array_equal(straight, load_image(path))


def test_other_modes_of_pillow(tmp_path):
    rgb = RNG.integers(0, 256, (6, 8, 3)).astype("uint8")
    flat = Image.fromarray(rgb)
    flat.quantize(8).save(tmp_path / "p.png")
    looked_up = np.asarray(flat.quantize(8).convert("RGB")) / 255
    np.testing.assert_allclose(load_image(tmp_path / "p.png")[..., :3], looked_up, atol=1e-6)
    Image.fromarray(rgb[..., 0] > 99).save(tmp_path / "bw.png")
    np.testing.assert_array_equal(load_image(tmp_path / "bw.png")[..., 1], rgb[..., 0] > 99)
    flat.save(tmp_path / "hole.png", transparency=tuple(rgb[2, 3].tolist()))
    assert load_image(tmp_path / "hole.png")[2, 3].tolist() == [0, 0, 0, 0]
    turned = Image.Exif()
    turned[0x0112] = 6
    flat.save(tmp_path / "turned.tif", exif=turned)
    assert load_image(tmp_path / "turned.tif").shape == (8, 6, 4)
    np.save(tmp_path / "gray.npy", rgb[..., 0])
    np.testing.assert_allclose(
        load_image(tmp_path / "gray.npy")[..., 2], rgb[..., 0] / 255, atol=1e-6
    )


def test_what_a_file_says_of_its_coding_is_told(tmp_path):
    flat = Image.fromarray(np.full((4, 4, 3), 128, "uint8"))
    chunk = PngImagePlugin.PngInfo()
    chunk.add(b"sRGB", b"\0")
    flat.save(tmp_path / "srgb.png", pnginfo=chunk)
    flat.save(tmp_path / "photo.jpg")
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    flat.save(tmp_path / "profile.png", icc_profile=profile)
    for name, why in (
        ("srgb.png", "sRGB chunk"),
        ("photo.jpg", "JPEG"),
        ("profile.png", "profile"),
    ):
        with pytest.warns(PictureWarning, match=f"{name}' says .*{why}.*Pass srgb=True") as caught:
            as_it_stands = load_image(tmp_path / name)
        assert caught[0].filename == __file__
        np.testing.assert_array_equal(as_it_stands, load_image(tmp_path / name, srgb=False))
        np.testing.assert_allclose(
            load_image(tmp_path / name, srgb=True)[..., 0], 0.2158605, atol=1e-6
        )
    lab = ImageCms.ImageCmsProfile(ImageCms.createProfile("XYZ")).tobytes()
    flat.save(tmp_path / "other.png", icc_profile=lab)
    with pytest.warns(PictureWarning, match="is decoded as sRGB"):
        load_image(tmp_path / "other.png", srgb=True)


def bad_files(folder: Path) -> dict[str, tuple[str, str]]:
    rgb = np.zeros((4, 4, 3))
    np.save(folder / "bytes_in_floats.npy", rgb + 200.0)
    np.save(folder / "nan.npy", rgb * np.nan)
    np.save(folder / "long.npy", rgb.astype("int64"))
    np.save(folder / "shape.npy", np.zeros((4, 4, 5)))
    np.save(folder / "empty.npy", np.zeros((0, 4, 3)))
    np.save(folder / "objects.npy", np.array([None]), allow_pickle=True)
    head = "{'descr': '<f4', 'fortran_order': False, 'shape': (1000000, 1000000, 4), }"
    data = b"\x93NUMPY\x01\x00v\x00" + head.ljust(117).encode() + b"\n"
    (folder / "giant.npy").write_bytes(data)
    Image.new("CMYK", (4, 4)).save(folder / "cmyk.jpg")
    Image.new("I", (4, 4)).save(folder / "int.tif")
    frames = [Image.new("L", (4, 4), k) for k in (0, 99)]
    frames[0].save(folder / "two.gif", save_all=True, append_images=frames[1:])
    whole = png(folder / "whole.png", np.zeros((40, 40, 3), "uint8")).read_bytes()
    (folder / "cut.png").write_bytes(whole[: len(whole) // 2])
    (folder / "text.png").write_text("hello")
    (folder / "folder.png").mkdir()
    return {
        "bytes_in_floats.npy": ("holds 200, but .* Divide bytes by 255", "ValueError"),
        "nan.npy": ("48 NaN or infinite", "ValueError"),
        "long.npy": ("int64, whose full intensity is not known", "ValueError"),
        "shape.npy": (r"no picture \(H, W\)", "ValueError"),
        "empty.npy": ("no picture", "ValueError"),
        "objects.npy": ("cannot be read as a picture", "ValueError"),
        "giant.npy": ("cannot be read as a picture", "ValueError"),
        "cmyk.jpg": ("colour space CMYK", "ValueError"),
        "int.tif": ("32-bit integers", "ValueError"),
        "two.gif": ("holds 2 frames", "ValueError"),
        "cut.png": ("cannot be read as a picture", "ValueError"),
        "text.png": ("cannot be read as a picture", "ValueError"),
        "folder.png": ("is no file", "ValueError"),
        "none.png": ("There is no file", "FileNotFoundError"),
    }


def test_what_cannot_be_a_picture_is_named(tmp_path):
    for name, (message, kind) in bad_files(tmp_path).items():
        error = {"ValueError": ValueError, "FileNotFoundError": FileNotFoundError}[kind]
        with pytest.raises(error, match=message) as caught:
            load_image(tmp_path / name)
        assert name in str(caught.value)
    with pytest.raises(ValueError, match="leave out srgb"):
        np.save(tmp_path / "a.npy", np.zeros((4, 4, 3)))
        load_image(tmp_path / "a.npy", srgb=True)
    np.save(tmp_path / "a.npy", np.full((4, 4, 3), 1.5))
    with pytest.warns(PictureWarning, match="from 1.5 to 1.5, outside of 0 to 1"):
        load_image(tmp_path / "a.npy")
    mistakes: list[Any] = [{"alpha": "none"}, {"srgb": "yes"}, {"background": (255, 0, 0)}]
    for keywords in mistakes:
        with pytest.raises(ValueError, match="must be|Divide"):
            load_image(tmp_path / "whole.png", **keywords)


BYTES = (PICTURE * 255).astype("uint8")


@pytest.mark.parametrize(
    "door",
    [
        lambda x: jaxvr.psnr(x, PICTURE),
        lambda x: jaxvr.psnr(x, x),
        lambda x: jaxvr.ssim(np.tile(x, (3, 4, 1)), np.tile(x, (3, 4, 1))),
        lambda x: jaxvr.psnr(x.astype(float), PICTURE),
        lambda x: l1(x, x),
        lambda x: composite_over(x, (0, 0, 0)),
        unpremultiply,
        linear_to_srgb,
        srgb_to_linear,
        to_uint8,
        lambda x: to_uint8(x.astype(float)),
    ],
)
def test_bytes_are_refused_by_every_door(door):
    with pytest.raises(ValueError, match="255"):
        door(BYTES)
    with pytest.raises(ValueError, match="255"):
        door(jnp.asarray(BYTES) if door is not to_uint8 else BYTES)


def test_measures_in_bytes_say_so():
    want = 10 * np.log10(255**2 / 4)
    assert float(jaxvr.psnr(BYTES % 200, BYTES % 200 + 2, peak=255)) == pytest.approx(
        want, rel=1e-5
    )


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pictures_of_16_bits_are_turned_like_those_of_8(orientation, tmp_path):
    grey = np.arange(24, dtype=np.uint8).reshape(4, 6)
    exif = Image.Exif()
    exif[0x0112] = orientation
    for name, pixels in (("8.png", grey), ("16.png", grey.astype(np.uint16) * 257)):
        Image.fromarray(pixels).save(tmp_path / name, exif=exif)
    eight, sixteen = (jaxvr.load_image(tmp_path / name, srgb=False) for name in ("8.png", "16.png"))
    assert eight.shape == ((4, 6, 4) if orientation < 5 else (6, 4, 4))
    np.testing.assert_array_equal(eight, sixteen)


def test_one_bit_may_be_transparent(tmp_path):
    picture = Image.fromarray(np.array([[0, 255], [255, 0]], np.uint8)).convert("1")
    picture.save(tmp_path / "a.png", transparency=0)
    found = jaxvr.load_image(tmp_path / "a.png", srgb=False)
    assert found[..., 3].tolist() == [[0, 1], [1, 0]]


def test_a_link_to_a_file_without_a_suffix(tmp_path):
    image = np.full((2, 3, 4), 0.25, np.float32)
    np.save(tmp_path / "a.npy", image)
    (tmp_path / "a.npy").rename(tmp_path / "blob")
    (tmp_path / "link.npy").symlink_to(tmp_path / "blob")
    np.testing.assert_array_equal(jaxvr.load_image(tmp_path / "link.npy"), image)
