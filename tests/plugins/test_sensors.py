"""The sensors ``fisheye`` and ``latlong``: where their pixels look."""

from __future__ import annotations

import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")
dr = pytest.importorskip("drjit")


def sensor(kind, width=64, height=64, **options):
    film = {"type": "hdrfilm", "width": width, "height": height}
    film |= {key: options.pop(key) for key in list(options) if key.startswith("crop")}
    return mi.load_dict({"type": kind, "film": film, **options})


def look(sensor, u, v):
    """Direction and weight at a place in the picture."""
    ray, weight = sensor.sample_ray(0.0, 0.5, mi.Point2f(float(u), float(v)), mi.Point2f(0.5, 0.5), True)
    return np.array(ray.d).ravel(), float(np.array(weight).ravel()[0]), np.array(ray.o).ravel()


def up(origin=(0, 0, 0)):
    """A camera that looks at the zenith with +Y at the top of the picture."""
    return mi.ScalarTransform4f().look_at(origin, np.add(origin, (0, 0, 1)), (0, 1, 0))


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "scalar_rgb", "llvm_ad_spectral"])
def test_fisheye_is_equidistant(plugins, variant):
    mi.set_variant(variant)
    camera = sensor("fisheye", to_world=up((1, 2, 3)))
    d, weight, origin = look(camera, 0.5, 0.5)
    np.testing.assert_allclose(d, (0, 0, 1), atol=1e-6)
    np.testing.assert_allclose(origin, (1, 2, 3), atol=1e-6)
    assert weight > 0.0
    for radius in (0.1, 0.37, 0.49):
        for angle in (0.3, 2.0, 4.5):
            d, weight, _ = look(camera, 0.5 + radius * np.cos(angle), 0.5 + radius * np.sin(angle))
            assert np.arccos(d[2]) == pytest.approx(np.pi * radius, abs=1e-5)
            assert weight > 0.0
    assert look(camera, 0.5, 0.01)[0][1] > 0.99  # the top of the picture: +Y
    assert look(camera, 0.01, 0.5)[0][0] > 0.99  # the left: +X, as east is when one looks up with north at the top
    assert look(camera, 0.02, 0.02)[1] == 0.0


def test_narrow_fisheye_is_a_perspective_camera(rgb):
    options = {"to_world": mi.ScalarTransform4f().look_at((0, 0, 2), (1, 3, 4), (0, 0, 1)), "fov": 2.0}
    fisheye, perspective = sensor("fisheye", **options), sensor("perspective", **options)
    for u, v in ((0.5, 0.5), (0.2, 0.5), (0.6, 0.8)):
        np.testing.assert_allclose(look(fisheye, u, v)[0], look(perspective, u, v)[0], atol=1e-5)


def test_fisheye_circle_touches_the_shorter_side(rgb):
    camera = sensor("fisheye", width=100, height=50, to_world=up())
    assert look(camera, 0.5, 0.999)[1] > 0.0 and look(camera, 0.74, 0.5)[1] > 0.0
    assert look(camera, 0.76, 0.5)[1] == 0.0


@pytest.mark.parametrize("fov", [0.0, -10.0, 361.0])
def test_fov_outside_its_range_is_refused(rgb, fov):
    with pytest.raises(RuntimeError, match="fov"):
        sensor("fisheye", fov=fov)


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "scalar_rgb"])
def test_latlong_directions(plugins, variant):
    mi.set_variant(variant)
    camera = sensor("latlong", width=64, height=32)
    for (u, v), d in {
        (0.5, 0.5): (0, 1, 0),
        (0.75, 0.5): (1, 0, 0),
        (0.25, 0.5): (-1, 0, 0),
        (0.3, 0.0): (0, 0, 1),
        (0.3, 1.0): (0, 0, -1),
        (0.5, 0.25): (0, 0.5**0.5, 0.5**0.5),
    }.items():
        found, weight, _ = look(camera, u, v)
        np.testing.assert_allclose(found, d, atol=1e-6)
        assert weight > 0.0


def test_crop_shows_a_part_of_the_same_picture(rgb):
    whole = sensor("latlong", width=64, height=32)
    part = sensor("latlong", width=64, height=32, crop_offset_x=16, crop_offset_y=8, crop_width=32, crop_height=16)
    np.testing.assert_allclose(look(part, 0.5, 0.25)[0], look(whole, 0.5, 0.375)[0], atol=1e-6)


def test_picture_of_a_constant_light(rgb):
    light = {"type": "constant", "radiance": {"type": "rgb", "value": [1, 2, 3]}}
    for kind, mean in (("latlong", 1.0), ("fisheye", np.pi / 4)):
        film = {"type": "hdrfilm", "width": 64, "height": 64, "rfilter": {"type": "box"}}
        scene = {
            "type": "scene",
            "integrator": {"type": "path"},
            "light": light,
            "sensor": {"type": kind, "film": film},
        }
        picture = np.array(mi.render(mi.load_dict(scene), spp=64))
        np.testing.assert_allclose(picture.mean(axis=(0, 1)), mean * np.array([1, 2, 3]), rtol=5e-3)
