"""Aerial perspective against ``Sky.rays`` with distances."""

from __future__ import annotations

import numpy as np
import pytest

from atmo_jit.backend import doubles, floats
from atmo_jit.bake.error import froxels_error
from atmo_jit.bake.froxels import Froxels


def corners(pitch: float) -> np.ndarray:
    """A camera of 60 by 36 degrees, 15 degrees beside the sun."""
    yaw = np.radians(15.0)
    forward = np.array([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    up = np.cross(right, forward)
    return np.array([[forward + 0.58 * x * right + 0.32 * y * up for x in (-1, 1)] for y in (1, -1)])


@pytest.mark.parametrize(("altitude", "sun_deg", "pitch"), [(50.0, 40.0, 0.1), (3e3, 75.0, -0.2), (1e4, 20.0, -0.6)])
def test_error_by_day(earth_sky, altitude, sun_deg, pitch):
    froxels = Froxels.frustum(earth_sky, altitude, np.radians(sun_deg), corners(pitch))
    error = froxels_error(froxels, earth_sky, seed=1)
    assert error.median < 1.5e-3 and error.p99 < 2e-2, str(error)


def test_no_distance_no_light_and_short_ones_in_proportion(earth_sky):
    froxels = Froxels.frustum(earth_sky, 2.0, 0.7, corners(0.1))
    light = froxels.at(floats([0.3] * 4), floats([0.6] * 4), floats([0.0, 0.01, 0.02, 100.0]))
    for radiance, clear in zip(light.radiance, light.transmittance, strict=True):
        values = radiance.numpy()
        assert values[0] == 0.0 and clear.numpy()[0] == 1.0
        assert values[2] == pytest.approx(2.0 * values[1], rel=1e-3)
        assert values[3] == pytest.approx(10_000.0 * values[1], rel=2e-2)


def test_light_grows_and_transmittance_falls_with_distance(earth_sky):
    froxels = Froxels.frustum(earth_sky, 2.0, np.radians(88.0), corners(0.05))
    distance = np.linspace(0.0, froxels.reach_m, 300)
    light = froxels.at(floats(np.full(300, 0.4)), floats(np.full(300, 0.2)), floats(distance))
    for radiance, clear in zip(light.radiance, light.transmittance, strict=True):
        assert np.all(np.diff(radiance.numpy()) >= -1e-6 * radiance.numpy()[1:])
        assert np.all(np.diff(clear.numpy()) <= 1e-6)


def test_transmittance(earth_sky):
    froxels = Froxels.frustum(earth_sky, 2.0, 0.7, corners(0.3))
    rng = np.random.default_rng(0)
    v, u, d = rng.random(300), rng.random(300), 1e5 * rng.random(300)
    x, y, z = (c.numpy().astype(float) for c in froxels.direction(floats(v), floats(u)))
    place = (np.full(300, 2.0), np.full(300, 0.7), np.arctan2(np.hypot(x, y), z), np.arctan2(y, x), d)
    above = z > 0.0
    exact = earth_sky.rays(*map(doubles, place), ground=False).transmittance
    found = froxels.at(floats(v), floats(u), floats(d)).transmittance
    for a, b in zip(found, exact, strict=True):
        np.testing.assert_allclose(a.numpy()[above], b.numpy()[above], atol=1e-2)


def test_views_of_any_arrangement(small_sky):
    """A panorama: rows of zenith angles, columns of azimuths; five kilometres."""
    zenith, azimuth = np.meshgrid(np.radians(np.linspace(20, 85, 24)), np.linspace(0, np.pi, 24), indexing="ij")
    froxels = Froxels(small_sky, 10.0, 0.9, zenith, azimuth, reach_m=5e3, slices=8)
    assert froxels_error(froxels, small_sky, seed=2).p95 < 1e-2
