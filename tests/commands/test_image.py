"""The display transform keeps brightness order, hue and the exposure's meaning; files carry what they were given."""

from __future__ import annotations

import struct

import numpy as np
import OpenEXR
import pytest

from atmo_jit import image

mi = pytest.importorskip("mitsuba")


@pytest.fixture
def rgb():
    return np.random.default_rng(5).lognormal(0.0, 2.0, (20, 30, 3))


def test_display_stays_in_range_and_keeps_luminance(rgb):
    shown = image.display(rgb)
    assert shown.min() >= 0.0 and shown.max() <= 1.0
    exposed = image.luminance(rgb) * image.automatic_exposure(rgb)
    assert np.allclose(image.luminance(shown), 1.0 - np.exp(-exposed), atol=1e-6)


def test_display_keeps_hue(rgb):
    shown = image.display(rgb)
    assert np.array_equal(shown.argmax(-1)[shown.max(-1) < 1], rgb.argmax(-1)[shown.max(-1) < 1])
    grey = image.display(np.full((4, 4, 3), 7.0))
    assert np.allclose(grey, grey[0, 0, 0])


def test_one_stop_doubles_the_light(rgb):
    dim = rgb * 1e-6  # far below the roll-off the transform is linear
    bright = rgb.copy()
    bright[:, 5:] = dim[:, 5:]
    before, after = image.display(bright, -8.0), image.display(bright, -7.0)
    assert np.allclose(after[:, 5:], 2 * before[:, 5:], rtol=1e-3)


def test_exposure_ignores_scale_and_stray_pixels(rgb):
    assert image.automatic_exposure(rgb * 1000) == pytest.approx(image.automatic_exposure(rgb) / 1000)
    stray = rgb.copy()
    stray[0, 0], stray[1, 1], stray[2, 2] = 1e12, np.nan, np.inf
    assert image.automatic_exposure(stray) == pytest.approx(image.automatic_exposure(rgb), rel=0.1)


def test_a_picture_without_light_is_black():
    assert image.automatic_exposure(np.zeros((3, 3, 3))) == 1.0
    assert not image.display(np.zeros((3, 3, 3))).any()


def test_invalid_and_negative_pixels(rgb):
    rgb[0, 0], rgb[0, 1], rgb[0, 2] = (np.nan, 1, 1), (1, np.inf, 1), (-1, -1, -1)
    shown = image.display(rgb)
    assert np.array_equal(shown[0, 0], image.INVALID_COLOUR) and np.array_equal(shown[0, 1], image.INVALID_COLOUR)
    assert not shown[0, 2].any()
    assert np.isfinite(shown).all()
    picture = image.Picture(rgb.astype(np.float32), ("R", "G", "B"))
    assert picture.invalid.sum() == 2


def test_a_luminance_picture_is_grey():
    picture = image.Picture(np.full((2, 2, 1), 0.5, np.float32), ("Y",))
    assert picture.rgb.shape == (2, 2, 3) and (picture.rgb == 0.5).all()


def test_exr_holds_pixels_primaries_and_metadata(tmp_path, rgb):
    pixels = np.concatenate([rgb, rgb[..., :1]], axis=-1).astype(np.float32)
    picture = image.Picture(pixels, ("R", "G", "B", "A"))
    image.write_exr(tmp_path / "x.exr", picture, {"scene": "noon", "samplesPerPixel": 8})
    with OpenEXR.File(str(tmp_path / "x.exr"), separate_channels=True) as file:
        header = file.header()
        assert header["scene"] == "noon" and header["samplesPerPixel"] == 8
        assert header["chromaticities"] == pytest.approx(image.SRGB_CHROMATICITIES)
        for index, name in enumerate("RGBA"):
            assert np.array_equal(file.channels()[name].pixels, pixels[..., index])


def test_png_has_the_srgb_curve(tmp_path):
    image.write_png(tmp_path / "x.png", np.array([[[0.0, 0.0, 0.0], [0.214041, 0.5, 1.0]]]))
    shown = np.array(mi.Bitmap(str(tmp_path / "x.png")))
    assert shown.dtype == np.uint8
    assert np.abs(shown.astype(int) - [[[0, 0, 0], [128, 188, 255]]]).max() <= 1


def test_channels_come_back_as_they_were(tmp_path):
    planes = {name: np.random.default_rng(1).random((5, 7), np.float32) for name in ("R", "G", "depth.Z")}
    image.write_planes(tmp_path / "a.exr", {}, planes)
    back = image.read_planes(tmp_path / "a.exr")
    assert set(back) == set(planes) and all(np.array_equal(back[name], planes[name]) for name in planes)


def test_damaged_pictures_are_an_exception_and_no_lines(tmp_path, capfd):
    """And their size is known before memory is taken."""
    image.write_planes(tmp_path / "a.exr", {}, {name: np.ones((8, 16), np.float32) for name in "RGB"})
    good = (tmp_path / "a.exr").read_bytes()
    start = good.index(b"dataWindow\0box2i\0") + 22
    bad = tmp_path / "b.exr"
    for content in (b"", good[:50], good[:-1], good[:-20], good[:-1] + b"\0" * 3, good[: start + 8] + b"\xff" * 8):
        bad.write_bytes(content)
        try:
            planes = image.read_planes(bad)
        except (OSError, RuntimeError, ValueError):
            continue
        assert all(plane.shape == (8, 16) for plane in planes.values())
    bad.write_bytes(good[: start + 8] + struct.pack("<2i", 20_000, 200_000) + good[start + 16 :])
    with pytest.raises(ValueError, match="would take more than 2147483648 bytes"):
        image.read_planes(bad)
    assert capfd.readouterr() == ("", "")
