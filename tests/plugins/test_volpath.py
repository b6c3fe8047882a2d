"""The integrator ``atmosphere_volpath`` against ``volpath``, which shares nothing with it but the medium."""

from __future__ import annotations

import numpy as np
import pictures
import pytest
from ztests import assert_agree, of_passes

from atmo_jit.errors import AtmosphereError

mi = pytest.importorskip("mitsuba")

PASSES = 32


@pytest.mark.parametrize("name", pictures.PICTURES)
def test_picture_is_as_stored(rgb, name):
    own = of_passes(pictures.render(pictures.scene(name, "atmosphere_volpath"), PASSES, seed=50))
    assert_agree(own, pictures.stored(name))


@pytest.mark.parametrize("name", ["earth_ground_sun85", pytest.param("layer_10km_sun75", marks=pytest.mark.slow)])
def test_a_guide_leaves_the_picture_as_it_is(rgb, name):
    scene = pictures.scene(name, "atmosphere_volpath", guided=True)
    assert_agree(of_passes(pictures.render(scene, PASSES, seed=90)), pictures.stored(name))


def things(integrator, **options):
    """A glossy ball, a mirror and a lamp on the ground, in haze lit by a low sun with a disc."""
    from atmo_jit import Atmosphere
    from atmo_jit.plugins.planet import planet

    air = Atmosphere.load("earth").replace({"mie.scattering_per_m": 4e-4, "mie.phase.g": 0.7})
    parts = planet(air, sun_direction=[0.6, 0.3, 0.25], sun_radius_deg=6.0)
    medium = parts.pop("air")
    at = mi.ScalarTransform4f()
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": integrator, "max_depth": -1, **options},
            **parts,
            "ball": {"type": "sphere", "center": [300, 0, 60], "radius": 60, "bsdf": {"type": "roughconductor"}},
            "mirror": {
                "type": "rectangle",
                "to_world": at.look_at([420, 80, 60], [0, 0, 60], [0, 0, 1]).scale(60),
                "bsdf": {"type": "twosided", "bsdf": {"type": "conductor"}},
            },
            "lamp": {
                "type": "sphere",
                "center": [250, -90, 40],
                "radius": 15,
                "emitter": {"type": "area", "radiance": {"type": "uniform", "value": 2.0}},
            },
            "sensor": {
                "type": "perspective",
                "fov": 50,
                "far_clip": 1e8,
                "medium": medium,
                "to_world": at.look_at([0, 0, 30], [300, 0, 45], [0, 0, 1]),
                "film": {"type": "hdrfilm", "width": 12, "height": 8, "rfilter": {"type": "box"}},
                "shutter_open": 0.0,
                "shutter_close": 1.0,
            },
        }
    )


def blocks(passes):
    """Means of 4 x 4 pixels: sums of many paths are nearly normal where single pixels have fireflies."""
    return passes.reshape(len(passes), 2, 4, 3, 4, 3).mean(axis=(2, 4))


def test_things_in_the_air(rgb):
    """Surfaces that are glossy or mirrors, a lamp among them, shadows, and a sun that is seen."""
    own = of_passes(blocks(pictures.render(things("atmosphere_volpath"), 32, seed=0)))
    stock = of_passes(blocks(pictures.render(things("volpath", rr_depth=64), 64, seed=7000)))
    assert_agree(own, stock)


@pytest.mark.parametrize("most", [1, pytest.param(2, marks=pytest.mark.slow), 3])
def test_depth_counts_as_in_volpath(rgb, most):
    stock = {"rr_depth": 64, "max_depth": most}
    own = of_passes(blocks(pictures.render(things("atmosphere_volpath", max_depth=most), 24, seed=0)))
    other = of_passes(blocks(pictures.render(things("volpath", **stock), 48, seed=7000)))
    assert_agree(own, other)


def test_emitters_hidden(rgb):
    shown, hidden = (
        pictures.render(things("atmosphere_volpath", max_depth=1, hide_emitters=h), 1, seed=0) for h in (False, True)
    )
    assert shown.max() > 0.1 and hidden.max() == 0.0


def test_less_noise_than_volpath(plugins):
    """At equal samples, of one wavelength; `python -m bench.reference_medium efficiency` has what it costs."""
    mi.set_variant("llvm_ad_mono")
    from atmo_jit.plugins.rays import PathTracedSky

    zenith = np.array([0.0, 60.0, 85.0])
    views = {"altitude_m": 2.0 + 0.0 * zenith, "sun_zenith_deg": 40.0 + 0.0 * zenith, "view_zenith_deg": zenith}
    views["azimuth_deg"] = 90.0 + 0.0 * zenith
    sky = PathTracedSky("earth")
    (own, error, _), (other, stock, _) = (
        sky.radiance(views, 2**14, integrator=name) for name in ("atmosphere_volpath", "volpath")
    )
    np.testing.assert_array_less(np.abs(own - other), 5.0 * np.hypot(error, stock))
    ratio = (stock / error) ** 2
    assert ratio.min() > 2.0 and np.median(ratio) > 20.0


def test_spectral_variant(plugins):
    mi.set_variant("llvm_ad_spectral")
    own = of_passes(pictures.render(pictures.scene("earth_ground_sun30", "atmosphere_volpath"), PASSES, seed=0))
    stock = of_passes(pictures.render(pictures.scene("earth_ground_sun30", "volpath"), 64, seed=900))
    assert_agree(own, stock)


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_mono_polarized"])
def test_variants_that_it_is_not_for(plugins, variant):
    mi.set_variant(variant)
    with pytest.raises(RuntimeError, match="variant"):
        mi.load_dict({"type": "atmosphere_volpath"})


def test_errors_name_the_parameter(rgb):
    with pytest.raises(RuntimeError, match="max_depth"):
        mi.load_dict({"type": "atmosphere_volpath", "max_depth": -2})
    bare = mi.load_dict({"type": "scene", "sensor": {"type": "fisheye"}, "integrator": {"type": "atmosphere_volpath"}})
    with pytest.raises(AtmosphereError, match="medium"):
        bare.integrator().render(bare, bare.sensors()[0], spp=1)
    guided = pictures.scene("earth_ground_sun30", "atmosphere_volpath", guided=True, sun=False)
    with pytest.raises(AtmosphereError, match="guided"):
        guided.integrator().render(guided, guided.sensors()[0], spp=1)


def test_guide_knows_the_light(rgb):
    """Sunlight and mean radiance against the solved sky at places between the guide's nodes."""
    import drjit as dr

    from atmo_jit import Sky
    from atmo_jit.plugins.guide import Guide
    from atmo_jit.plugins.planet import planet

    parts = planet("earth", sun_direction=[0.0, 0.6, 0.8], wavelength_rule="channels")
    guide = Guide(parts["air"].air, np.array([0.0, 0.6, 0.8]))
    h, zenith = np.array([50.0, 3e3, 9e3, 50.0]), np.radians([20.0, 60.0, 85.0, 95.0])
    sunlight, mean = guide.light(mi.UInt32(0), mi.Float(np.float32(h)), mi.Float(np.float32(np.cos(zenith))))
    sky = Sky({**parts["air"].air.atmosphere.to_dict(), "solar_irradiance": 1.0})
    direct, _ = sky.irradiance(mi.Float(np.float32(h)), mi.Float(np.float32(zenith)))
    truth = np.mean([np.array(c) for c in direct], axis=0)[:3] / np.cos(zenith[:3])
    np.testing.assert_allclose(np.array(sunlight)[:3], truth, rtol=0.1)
    assert np.array(sunlight)[3] < 1e-6 and np.all(np.array(mean) > 0.0) and dr.all(mean[0] > mean[3])
