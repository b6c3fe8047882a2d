"""What an atmosphere needs."""

from dataclasses import replace

import numpy as np
import pytest

import atmo_jit
from atmo_jit.backend import doubles
from atmo_jit.phase import HenyeyGreenstein
from atmo_jit.resolution import FIRST_DEGREES, Resolution, moments_of
from atmo_jit.solved import Sky

EARTH = atmo_jit.Atmosphere.load("earth")


def suited(changes=None, tolerance=0.01):
    return Resolution.suited(EARTH.replace(changes or {}), tolerance)


def test_gas_alone_needs_two_moments():
    assert [stage.degree for stage in suited({"mie": None}).stages] == [2]
    assert suited({"mie": None}).first_degree == 2


def test_haze_needs_more_moments_the_more_it_peaks():
    degrees = [suited({"mie.scattering_per_m": 5e-5, "mie.phase.g": g}).first_degree for g in (0.0, 0.5, 0.8, 0.9)]
    assert degrees == sorted(degrees) and degrees[0] < degrees[-1]
    assert all(d in FIRST_DEGREES for d in degrees)


def test_fog_needs_more_altitudes_and_accuracy_costs():
    assert suited({"mie.scattering_per_m": 5e-3}).altitudes > suited().altitudes
    assert suited(tolerance=0.001).first_degree > suited().first_degree


def test_thick_air_that_absorbs_needs_fewer_altitudes_than_white_clouds():
    clouds = [{"mie.scattering_per_m": 5e-3, "mie.single_scattering_albedo": albedo} for albedo in (1.0, 0.99, 0.9)]
    altitudes = [suited(cloud).altitudes for cloud in clouds]
    assert altitudes == sorted(altitudes, reverse=True) and altitudes[0] >= altitudes[-1] + 8


@pytest.mark.parametrize(("scattering", "stages"), [(4e-6, 2), (1e-4, 1)])
def test_azimuthal_orders_of_fine_solves(scattering, stages):
    """Orders above 2 have fewer where aerosols are thin, and only there."""
    fine = Resolution.suited(EARTH.replace({"mie.scattering_per_m": scattering}), 0.01, fine=True)
    assert len(fine.stages) == stages
    assert all(stage.most < fine.stages[0].most and stage.degree == fine.first_degree for stage in fine.stages[1:])


def test_fine_solves_have_all_degrees_in_all_orders():
    for changes in ({}, {"mie.scattering_per_m": 1e-4, "mie.phase.g": 0.85}):
        air = EARTH.replace(changes)
        usual, fine = (Resolution.suited(air, 0.01, fine=fine) for fine in (False, True))
        assert all(stage.degree == fine.first_degree for stage in fine.stages)
        assert fine.first_degree > usual.first_degree and fine.altitudes > usual.altitudes
        assert fine.stages[0].most == usual.stages[0].most + 2 and fine.twice and not usual.twice


def test_haze_with_a_narrow_peak_has_no_ripple():
    """Moments cut off too early ripple along the horizon: against twice as many the light is smooth there to 1 %."""
    air = EARTH.replace({"mie.scattering_per_m": 1e-4, "mie.phase": {"type": "cornette_shanks", "g": 0.9}})
    azimuth = np.radians(np.arange(90.0, 181.0, 5.0))
    rays = [np.zeros(azimuth.shape), np.full(azimuth.shape, np.radians(70.0)), np.full(azimuth.shape, np.radians(89.0))]
    usual = Resolution.suited(air, 0.01)
    many = {"first_degree": 48, "first_up": 60, "first_down": 58, "first_azimuths": 64, "phase_degree": 64}
    light = []
    for resolution in (usual, replace(usual, **many)):
        sky = Sky(air, resolution=resolution)
        found = sky.rays(*map(doubles, [*rays, azimuth]), ground=False).radiance
        light.append(np.stack([channel.numpy() for channel in found]))
    assert light[0] == pytest.approx(light[1], rel=0.01)


def test_views_that_keep_away_from_the_horizon_need_fewer_degrees():
    aerosol = {"mie.scattering_per_m": 3e-5, "mie.phase": {"type": "henyey_greenstein", "g": 0.94}}
    air = EARTH.replace({**aerosol, "mie.scale_height_m": 1500.0})
    usual, high = Resolution.suited(air, 0.02), Resolution.suited(air, 0.02, air_mass=5.0)
    assert high.stages[0].degree < 0.75 * usual.stages[0].degree
    zenith, azimuth = (v.ravel() for v in np.meshgrid(np.radians([0.0, 40.0, 78.0]), np.radians([5.0, 60.0, 180.0])))
    rays = [np.zeros(len(zenith)), np.full(len(zenith), np.radians(40.0)), zenith, azimuth]
    exact = {"first_degree": 48, "first_up": 60, "first_down": 58, "first_azimuths": 64, "phase_degree": 64}
    light = []
    for resolution in (high, replace(Resolution.suited(air, 0.002), **exact)):
        found = Sky(air, tolerance=0.002, resolution=resolution).rays(*map(doubles, rays)).radiance
        light.append(np.stack([channel.numpy() for channel in found]))
    assert light[0] == pytest.approx(light[1], rel=0.01)


def test_as_many_moments_as_are_asked_for():
    few, many = (moments_of(HenyeyGreenstein(0.83), degree) for degree in (10, 60))
    assert len(few) == 11 and many == pytest.approx(0.83 ** np.arange(61))
