"""What the emitter ``atmosphere`` shows: irradiance, places of light, units and colours."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from emitters import LUMINANCE, columns, looking, plane, sampled, seen, sun

from atmo_jit.atmosphere import Atmosphere
from atmo_jit.backend import doubles
from atmo_jit.solved import Sky
from atmo_jit.spectrum import SpectralBasis, xyz_to_srgb
from atmo_jit.wavelengths import at_wavelengths

# Asked of the emitter: irradiance within 0.5 % of the tables' plus three standard deviations.
IRRADIANCE = 0.005


@pytest.fixture(scope="module")
def sky() -> Sky:
    return Sky("earth")


def irradiance(sky: Sky, altitude_m: float, elevation_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Linear sRGB irradiance of sun and sky on a horizontal plane, from the solver."""
    matrix = SpectralBasis.of("earth").srgb_matrix
    parts = sky.irradiance(doubles([altitude_m]), doubles([math.radians(90.0 - elevation_deg)]))
    return tuple(matrix @ np.array([float(np.array(v).ravel()[0]) for v in part]) for part in parts)


def estimate(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean over the pixels and its standard deviation."""
    pixels = picture.reshape(-1, 3)
    return pixels.mean(axis=0), pixels.std(axis=0) / math.sqrt(len(pixels))


@pytest.mark.parametrize(
    ("elevation_deg", "altitude_m"),
    [
        (45.0, 1.0),
        (5.0, 1.0),
        pytest.param(90.0, 1.0, marks=pytest.mark.slow),
        pytest.param(45.0, 3000.0, marks=pytest.mark.slow),
    ],
)
def test_irradiance_on_a_plane(rgb: None, sky: Sky, elevation_deg: float, altitude_m: float) -> None:
    light = {"type": "atmosphere", "sun_direction": sun(elevation_deg), "altitude": altitude_m}
    mean, sigma = estimate(plane(light, 256))
    expected = sum(irradiance(sky, altitude_m, elevation_deg))
    assert np.all(np.abs(mean - expected) < IRRADIANCE * expected + 3.0 * sigma)


@pytest.mark.parametrize("elevation_deg", [90.0, 45.0, 5.0, 0.0, -4.0])
def test_energy_by_part_of_the_sky(emitter, sky: Sky, elevation_deg: float) -> None:
    both = emitter(elevation_deg)
    ds, weight = sampled(both, 1 << 19)
    d, weight = columns(ds.d), columns(weight)
    angle = np.degrees(2.0 * np.arcsin(np.linalg.norm(d - sun(elevation_deg), axis=1) / 2.0))
    disc = angle <= 0.2678
    flux = weight * np.maximum(d[:, 2], 0.0)[:, None]
    direct, scattered = irradiance(sky, 1.0, elevation_deg)

    # The disc holds the sun's irradiance. At its setting the solver's figure is that of the centre, so only a bound.
    if elevation_deg >= 5.0:
        np.testing.assert_allclose(flux[disc].mean(axis=0) * disc.mean(), direct, rtol=0.005)
    else:
        assert np.all(flux[disc].sum(axis=0) / len(d) < 0.03 * scattered)
    # The sky holds the rest: the solver's own two ways to it differ by 1 % in twilight.
    rest = flux[~disc].sum(axis=0) / len(d)
    sigma = flux[~disc].std(axis=0) * math.sqrt((~disc).sum()) / len(d)
    assert np.all(np.abs(rest - scattered) < 0.013 * scattered + 3.0 * sigma)
    # Nobody sees a sun below the horizon.
    below = seen(both, sun(-3.0))
    assert below.max() < 1.0 and below.min() > -1e-3


@pytest.mark.parametrize("elevation_deg", [45.0, 5.0, 0.0, -4.0])
def test_brightest_towards_the_sun(emitter, elevation_deg: float) -> None:
    both = emitter(elevation_deg)
    steps = np.radians(np.arange(0.5, 90.0, 1.0)), np.radians(np.arange(-179.0, 180.0, 2.0))
    e, a = np.meshgrid(*steps, indexing="ij")
    d = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1).reshape(-1, 3)
    far = np.linalg.norm(d - sun(elevation_deg), axis=1) > math.radians(0.5)
    bright = d[far][np.argmax((seen(both, d) @ LUMINANCE)[far])]
    assert abs(math.degrees(math.atan2(bright[1], bright[0]))) <= 3.0
    if elevation_deg < 30.0:
        assert math.degrees(math.asin(bright[2])) < elevation_deg + 8.0


def test_disc_is_where_the_sun_is(emitter) -> None:
    both, sky_only = emitter(30.0), emitter(30.0, sun_scale=0.0)
    rim = 0.2678
    for step in (rim - 0.02, rim + 0.02):
        turn = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
        stretch = 1.0 / math.cos(math.radians(30.0))
        around = np.array([sun(30.0 + step * math.cos(t), step * stretch * math.sin(t)) for t in turn])
        extra = seen(both, around) - seen(sky_only, around)
        assert np.all(extra > 1e3) if step < rim else np.abs(extra).max() == 0.0
    low = emitter(0.0)
    centre = seen(low, np.array([sun(0.1), sun(-0.1), sun(0.22)])) @ LUMINANCE
    assert centre[0] > 100.0 * centre[1]  # half set: dark below the horizon
    assert centre[2] > centre[0]  # dimmed by more air lower down


def test_ground_begins_with_an_edge(emitter) -> None:
    for altitude in (1.0, 1e4):
        both = emitter(45.0, altitude=altitude)
        dip = math.degrees(both._light.view.dip)
        above, below, nadir = seen(both, np.array([sun(1e-3 - dip, 120.0), sun(-1e-3 - dip, 120.0), sun(-90.0)]))
        assert np.all(np.isfinite([above, below, nadir]))
        if altitude == 1.0:
            assert above[2] > 2.0 * below[2]  # the sky is blue, the ground is not
            # A Lambertian ground a metre away: albedo times irradiance over pi.
            light = sum(irradiance(Sky("earth"), 0.0, 45.0))
            np.testing.assert_allclose(nadir, 0.1 * light / np.pi, rtol=0.005)


def test_scales_remove_their_part(emitter) -> None:
    d = np.array([sun(30.0), sun(50.0, 90.0), sun(-20.0, 10.0)])
    no_sky, no_sun = emitter(30.0, sky_scale=0.0), emitter(30.0, sun_scale=0.0)
    none = emitter(30.0, sun_scale=0.0, sky_scale=0.0)
    assert np.all(seen(no_sky, d)[1:] == 0.0) and np.all(seen(no_sky, d)[0] > 1e3)
    assert np.all(seen(no_sun, d)[0] < 1.0) and np.all(seen(no_sun, d)[1:] > 0.0)
    assert np.all(seen(none, d) == 0.0)
    np.testing.assert_allclose(seen(no_sky, d) + seen(no_sun, d), seen(emitter(30.0), d), rtol=1e-6)
    ds, weight = sampled(none, 100)
    assert np.all(columns(weight) == 0.0) and np.all(np.array(ds.pdf) > 0.0)


def test_units_are_those_of_sunsky(rgb: None, emitter) -> None:
    # The preset's air is clearer than sunsky's at turbidity 2 (half the aerosol, so half the sky and a bluer sun):
    # another unit or another white point would be off by more.
    common = {"sun_direction": sun(45.0), "albedo": 0.1}
    theirs = mi.load_dict({"type": "sunsky", "turbidity": 2.0, **common})
    d = np.array([sun(45.0), sun(60.0, 180.0), sun(30.0, 120.0), sun(80.0, 60.0)])
    ratio = seen(emitter(45.0), d) / seen(theirs, d)
    assert ratio[0] @ LUMINANCE == pytest.approx(1.2, abs=0.1)
    assert np.ptp(ratio, axis=1).max() < 0.25
    assert np.all((ratio[1:] > 0.4) & (ratio[1:] < 0.8))


def test_turning_the_frame_turns_the_light(rgb: None, emitter) -> None:
    turn = mi.ScalarTransform4f().rotate([0.6, 0.0, 0.8], 77.0)
    matrix = np.array(turn.matrix)[:3, :3]
    turned = mi.load_dict({"type": "atmosphere", "sun_direction": list(matrix @ sun(20.0)), "to_world": turn})
    rng = np.random.default_rng(3)
    d = rng.normal(size=(2000, 3))
    d /= np.linalg.norm(d, axis=1)[:, None]
    d = d[np.abs(d[:, 2]) > 1e-3]
    np.testing.assert_allclose(seen(turned, d @ matrix.T), seen(emitter(20.0), d), rtol=2e-3, atol=1e-6)
    ds, _ = sampled(turned, 1000)
    plain, _ = sampled(emitter(20.0), 1000)
    np.testing.assert_allclose(columns(ds.d), columns(plain.d) @ matrix.T, atol=1e-5)


def test_sun_irradiance_does_not_depend_on_its_size(emitter) -> None:
    found = []
    for options in ({}, {"sun_aperture": 2.0}, {"complex_sun": True}):
        ds, weight = sampled(emitter(60.0, sky_scale=0.0, **options), 1 << 16)
        found.append((columns(weight) * columns(ds.d)[:, 2:]).mean(axis=0))
    np.testing.assert_allclose(found[1], found[0], rtol=5e-3)
    np.testing.assert_allclose(found[2], found[0], rtol=5e-3)


@pytest.mark.slow
def test_particles_agree_with_paths(rgb: None) -> None:
    light = {"type": "atmosphere", "sun_direction": sun(50.0)}
    sphere = {
        "type": "scene",
        "light": light,
        "ball": {"type": "sphere", "bsdf": {"type": "diffuse"}},
        "sensor": {
            "type": "perspective",
            "fov": 60.0,
            "to_world": mi.ScalarTransform4f().look_at([3, 2, 2], [0, 0, 0], [0, 0, 1]),
            "film": {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}},
        },
    }
    scene = mi.load_dict(sphere)
    pictures = []
    for integrator, spp in (("path", 512), ("ptracer", 4096)):
        tracer = mi.load_dict({"type": integrator, "max_depth": 2, "hide_emitters": True})
        pictures.append(np.array(mi.render(scene, integrator=tracer, spp=spp)).reshape(-1, 3).mean(axis=0))
    np.testing.assert_allclose(pictures[1], pictures[0], rtol=0.015)


def test_looking_is_defined_everywhere(emitter) -> None:
    both = emitter(10.0)
    special = np.array([[0, 0, 1], [0, 0, -1], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [1e-20, 0, 1]], dtype=np.float64)
    assert np.isfinite(columns(both.eval(looking(special)))).all()
    assert dr.all(both.eval(looking(special), mi.Bool(False)) == 0.0, axis=None)


@pytest.mark.parametrize("elevation", [40.0, 2.0, -4.0])
def test_fast_wavelengths_have_the_colours_of_forty(rgb, elevation):
    """CIE Delta E 2000 under the exposure that gives the true colour half the luminance of white."""
    pytest.importorskip("colour")
    from bench.colour import difference, true_xyz

    nm = np.arange(380.0, 771.0, 10.0)
    rng = np.random.default_rng(2)
    zenith, azimuth = np.arccos(rng.uniform(0.05, 1.0, 60)), rng.uniform(0.0, np.pi, 60)
    views = [np.zeros(60), np.full(60, np.radians(90.0 - elevation)), zenith, azimuth]
    truth = Sky(at_wavelengths(Atmosphere.load("earth"), nm))
    light = np.stack([v.numpy() for v in truth.rays(*views).radiance], axis=-1)
    directions = np.stack([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)], axis=-1)
    worst = {}
    for given in ({}, {"wavelengths": "fast"}):
        options = {"sun_direction": sun(elevation), "sun_scale": 0.0, "altitude": 0.0, **given}
        found = seen(mi.load_dict({"type": "atmosphere", **options}), directions)
        worst[len(given)] = difference(found @ np.linalg.inv(xyz_to_srgb()).T, true_xyz(light)).max()
    assert worst[1] < 1.5
    assert elevation > 30.0 or worst[0] > 3.0  # and the preset's own three are not enough at twilight


def test_refraction_lifts_the_sun(rgb):
    """The sun is half a degree higher at the horizon, also where the air is path-traced; derivatives pass through."""
    from atmo_jit.refraction import apparent_zenith

    true = math.radians(90.3)
    direction = [math.sin(true), 0.0, math.cos(true)]
    lifted = mi.load_dict({"type": "atmosphere", "sun_direction": direction, "refraction": True})
    straight = mi.load_dict({"type": "atmosphere", "sun_direction": direction})
    seen_at = float(apparent_zenith("earth", true, 1.0))
    assert math.degrees(true - seen_at) > 0.4
    np.testing.assert_allclose(lifted.sun, [math.sin(seen_at), 0.0, math.cos(seen_at)], atol=1e-6)
    np.testing.assert_allclose(straight.sun, direction, atol=1e-6)
    there = np.array([[math.sin(seen_at), 0.0, math.cos(seen_at)]])
    assert seen(lifted, there)[0, 0] > 100.0 * seen(straight, there)[0, 0]
    twin = mi.load_dict({"type": "atmosphere_sun", "sun_direction": direction, "refraction": True})
    np.testing.assert_allclose(twin.sun_direction, lifted.sun, atol=1e-6)
