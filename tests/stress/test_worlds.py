"""Atmospheres of bench.stress in which light was wrong, and what was: each against the twin, in double precision."""

from __future__ import annotations

from random import Random

import numpy as np
import pytest
from twins import Twin

import atmo_jit
from atmo_jit.backend import doubles
from bench.extremes import extreme_views, extreme_world
from bench.stress import PER_WORLD, Solved, check_derivatives, check_world, of_twin
from bench.worlds import world

# Quantity, and the worst that single precision is allowed there.
LIMITS = {"transmittance, twin": 1e-4, "sun irradiance, twin": 5e-4, "single scattering, twin": 1e-2}


# 38: air 205 m deep under a top 35,000 km up, which no ray was cut for. 161, 3031: the sun sets between two nodes of a
# ray. 184: the sun seen from 56 m under a step of density 56,000 km up.
@pytest.mark.parametrize("number", [38, 161, 184, 3031])
def test_light_is_that_of_the_twin(number):
    rng = Random(number)
    air = extreme_world(rng)
    views = extreme_views(rng, air, PER_WORLD)
    solved = Solved(air)
    errors = of_twin(air, views, [*solved.rays(views), *solved.irradiances(views)], Twin(air))
    worst = {name: float(np.max(values, initial=0.0)) for name, values in errors.items()}
    assert {name: worst[name] for name, limit in LIMITS.items() if worst.get(name, 0.0) > limit} == {}


# Light behind some optical depths of air whose density falls linearly over a thick shell: 4e-3 off with 128 rows of
# columns.
@pytest.mark.parametrize("number", [37, 40, 61])
def test_columns_to_the_sun_have_rows_enough(number):
    rng = Random(number)
    air = extreme_world(rng)
    views = extreme_views(rng, air, PER_WORLD)
    solved = Solved(air, 1)
    errors = of_twin(air, views, [*solved.rays(views), *solved.irradiances(views)], Twin(air, tolerance=1e-6))
    assert errors["single scattering, twin"].max() < 5e-4


def test_a_horizontal_sun_shines_into_the_top_of_a_layer():
    """Into 200 m of 42 km, on a planet of 42,000 km: between two nodes of a ray, of the twin's as well where it has
    few."""
    layer = {"scattering_per_m": 1.7e-5, "profile": {"altitude_m": [1e4, 5e4], "density": [1.0, 1.0]}}
    air = world(wavelengths_nm=[550], solar_irradiance=1, bottom_radius_m=4e7, top_radius_m=4.02e7, rayleigh=layer)
    air |= {"mie": None, "ground_albedo": 0.0}
    sun, view = np.radians([90.0, 89.9, 90.05]), np.radians([30.0, 45.0, 60.0])
    azimuth = np.radians([100.0, 30.0, 60.0])
    found = atmo_jit.Sky(air, 1).rays(np.zeros(3), sun, view, azimuth, ground=False).radiance[0].numpy()
    mu, mu_s = np.cos(view), np.cos(sun)
    nu = mu * mu_s + np.sin(view) * np.sin(sun) * np.cos(azimuth)
    twins = Twin(air, 6, 12, tolerance=1e-6), Twin(air, 96, 24)
    want, of_many_nodes = (twin.single_scattering(np.zeros(3), mu, mu_s, nu)[:, 0] for twin in twins)
    assert want == pytest.approx(of_many_nodes, rel=1e-3)
    assert found == pytest.approx(want, rel=0.01)


# 3011: observers 4 cm under the edge of fog at 39 km. 72: a ray that grazes a step of density 29,500 km up had another
# transmittance back than forth, by 0.03. 75: halves of a ray through steps, by 0.003. 137: the sun from beside one.
@pytest.mark.parametrize("number", [72, 75, 137, 3011])
def test_steps_of_density_are_where_they_are(number):
    """Nearer to an observer or to a perigee than altitudes in single precision can be: Optics.exact."""
    rng = Random(number)
    air = extreme_world(rng)
    errors = check_world(air, extreme_views(rng, air, PER_WORLD), Twin(air), solves=False)
    for name in ("reciprocity", "additivity", "transmittance, twin", "sun irradiance, twin"):
        assert np.max(errors[name], initial=0.0) < 1e-4, name


def test_rays_beside_the_horizon_know_on_which_side_they_are():
    air = world(bottom_radius_m=5e6, top_radius_m=2e7, sun_angular_radius_deg=0.0)
    twin, radius = Twin(air), 5e6
    h = np.repeat(np.geomspace(1e-3, 1e7, 11), 2)
    horizon = 0.5 * np.pi + np.arctan2(np.sqrt(h * (2.0 * radius + h)), radius)
    zenith = horizon + np.tile([-1e-7, 1e-7], 11)
    sky = atmo_jit.Sky(air, 1)
    rays, *_ = sky.enter(*(doubles(v) for v in (h, np.zeros(22), zenith, np.zeros(22))))
    assert rays.ground.numpy().tolist() == [False, True] * 11 == twin.hits_ground(h, np.cos(zenith)).tolist()
    through = sky.rays(h, np.zeros(22), zenith, np.zeros(22)).transmittance
    want = np.exp(-twin.optical_depth(twin.columns(h, np.cos(zenith), 0.0, twin.limits(h, np.cos(zenith))[1])))
    assert np.stack([t.numpy() for t in through], axis=1) == pytest.approx(want, abs=2e-4)


# 0: rays without end, whose end was moved by infinity. 1: 92 scale heights of air, of which the topmost scatter 1e-40.
# 6: irradiance over depth is 1e-30 just under the top, its square 0.
@pytest.mark.parametrize("number", [0, 1, 6])
def test_derivatives_are_finite(number):
    rng = Random(number)
    air = extreme_world(rng, widths=(1, 1, 3))
    errors = check_derivatives(rng, air, extreme_views(rng, air, 50), 4)
    assert errors["derivatives not finite"].sum() == 0.0 and errors["adjoint identity"] < 1e-5


def test_light_is_linear_in_that_of_the_sun():
    """A white gas of depth 330, whose light single precision does not determine: 1e-3 apart where its orders were
    summed under another sun."""
    gas = {"scattering_per_m": 330.0 / 5000.0, "scale_height_m": 5000}
    views = np.array([0.0, 100.0, 7e4]), np.radians([10.0, 60.0, 80.0]), np.radians([0.0, 70.0, 120.0]), np.zeros(3)
    one, seven = (
        atmo_jit.Sky(
            world(wavelengths_nm=[550], solar_irradiance=sun, rayleigh=gas, mie=None, ground_albedo=1.0)
        ).rays(*views).radiance[0].numpy()
        for sun in (1.0, 7.0)
    )  # fmt: skip
    assert one.min() > 0.0 and seven == pytest.approx(7.0 * one, rel=1e-6)


def test_orders_of_a_sharp_peak_shrink():
    """48: fog with g = 0.99. Radiance that swings below 0 beside its peak grew fourfold with every order."""
    sky = atmo_jit.Sky(extreme_world(Random(48)))
    assert max(len(band.field.shares) for band in sky.solutions) < 50


def test_rounding_that_grows_from_order_to_order_is_left_out():
    """194: a white cloud of depth 25; in the deepest shadow late orders were brighter than the first."""
    sky = atmo_jit.Sky(extreme_world(Random(194), widths=(1,)))
    assert max(len(band.field.shares) for band in sky.solutions) < 60


# The planet's radius in single precision is 1 m off, 6 cm off.
@pytest.mark.parametrize(("radius", "height"), [(18_715_831.0, 42.0), (1_169_399.4375, 10.0)])
def test_rays_from_space_pass_as_low_as_they_do(radius, height):
    """From half a radius up to the lowest point of the ray: transmittances were off by 3e-3 and 7e-4."""
    top = 10.0 * height
    gas = {"scattering_per_m": 1.0 / np.sqrt(2.0 * np.pi * radius * height), "scale_height_m": height}
    air = world(wavelengths_nm=[550], solar_irradiance=1, bottom_radius_m=radius, top_radius_m=radius + top)
    air |= {"rayleigh": gas, "mie": None, "ground_albedo": 0.0}
    lowest = height * np.array([0.3, 1.0, 3.0])
    up = np.full(3, 0.5 * radius)
    far = np.arcsin((radius + lowest) / (radius + up))
    sky = atmo_jit.Sky(air, 1)
    out = sky.rays(lowest, np.zeros(3), np.full(3, 0.5 * np.pi), np.zeros(3)).transmittance[0].numpy()
    across = sky.rays(up, np.zeros(3), np.pi - far, np.zeros(3)).transmittance[0].numpy()
    assert across == pytest.approx(out**2, abs=2e-6)


# 0.05 and 4e-3 off with four nodes to a piece of the ray.
@pytest.mark.parametrize(
    ("number", "altitude", "sun", "view", "off"),
    [(64, 73_190.8235198, 92.6189536286, 90.0, 5e-3), (16, 4285.36188, 94.501944, 0.0, 1e-3)],
)
def test_sunlight_that_grazes_a_step_of_density(number, altitude, sun, view, off):
    air = extreme_world(Random(number))
    h, zenith, toward = np.array([altitude]), np.radians([sun]), np.radians([view])
    found = [v.numpy() for v in atmo_jit.Sky(air, 1).rays(h, zenith, toward, np.zeros(1), ground=False).radiance]
    nu = np.cos(zenith - toward)
    want = Twin(air, tolerance=1e-6).single_scattering(h, np.cos(toward), np.cos(zenith), nu)[0]
    assert np.ravel(found) == pytest.approx(want, rel=off)


@pytest.mark.parametrize("depth", [2400.0, 8000.0, 40_000.0])
def test_air_that_is_white_in_name_only(depth):
    """Of the Earth's wavelengths at least one took no end of the iteration for its light: 1e9 times the sun's, NaN."""
    air = atmo_jit.presets.read("earth")
    air["rayleigh"]["scattering_per_m"] = depth / 8000.0
    views = {"altitude_m": [0.0, 10.0, 1e3, 1e4, 3e4, 1e5], "view_zenith_deg": [0.0, 45.0, 80.0, 120.0, 100.0, 170.0]}
    found = atmo_jit.sky(air, {**views, "sun_zenith_deg": 40.0, "azimuth_deg": 90.0})
    for light in (found.radiance, found.sky_irradiance):
        assert np.isfinite(light).all() and light.min() >= 0.0
        assert np.all(light < air["solar_irradiance"])
