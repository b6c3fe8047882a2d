"""The sky-view table against the solution, at views that are none of its nodes; its edges; slices of 4-D tables."""

from __future__ import annotations

import numpy as np
import pytest

from atmo_jit.backend import doubles, floats
from atmo_jit.bake.error import sky_view_error
from atmo_jit.bake.sky_view import SkyView

DAY = [(1.0, 10.0), (1.0, 50.0), (300.0, 75.0), (1.0, 87.0), (2e4, 40.0)]


@pytest.mark.parametrize(("altitude", "sun_deg"), DAY)
def test_error_of_clear_air(earth_sky, altitude, sun_deg):
    error = sky_view_error(SkyView(earth_sky, altitude, np.radians(sun_deg)), earth_sky, seed=1)
    assert error.p99 < 3e-3 and error.median < 5e-4, str(error)


@pytest.mark.parametrize("sun_deg", [0.0, 30.0, 60.0])
def test_a_sharp_peak_is_right_near_the_sun(hazy_sky, sun_deg):
    """g = 0.9: the phase function changes tenfold within some degrees; a quarter of the views are within ten."""
    view = SkyView(hazy_sky, 1.0, np.radians(sun_deg))
    error = sky_view_error(view, hazy_sky, seed=2)
    assert error.p99 < 5e-3, str(error)
    near = np.radians(np.array([0.3, 1.0, 2.0, 4.0, 8.0]))
    zenith, sun = np.radians(sun_deg) + near, np.radians(sun_deg)
    found = view.radiance(floats(zenith), floats(np.zeros(5)))
    exact = hazy_sky.rays(*map(doubles, (np.ones(5), np.full(5, sun), zenith, np.zeros(5)))).radiance
    for a, b in zip(found, exact, strict=True):
        np.testing.assert_allclose(a.numpy(), b.numpy(), rtol=5e-3)


@pytest.mark.parametrize("sun_deg", [91.0, 95.0])
def test_error_of_twilight(earth_sky, sun_deg):
    error = sky_view_error(SkyView(earth_sky, 1.0, np.radians(sun_deg)), earth_sky, seed=3)
    assert error.p95 < 2e-3 and error.p99 < 6e-3, str(error)


@pytest.mark.parametrize(("altitude", "sun_deg"), [(0.0, 40.0), (5e3, 70.0), (4e5, 30.0)])
@pytest.mark.parametrize("fixture", ["small_sky", "odd_sky"])
def test_error_of_other_planets(fixture, altitude, sun_deg, request):
    sky = request.getfixturevalue(fixture)
    error = sky_view_error(SkyView(sky, altitude, np.radians(sun_deg)), sky, seed=4)
    assert error.p95 < 1e-2, str(error)


@pytest.mark.parametrize("altitude", [0.0, 2.0, 1e4])
def test_no_seam_at_the_horizon(earth_sky, altitude):
    """A hundredth of a degree on either side: each half of the table ends with its own light."""
    sun, radius = np.radians(60.0), earth_sky.atmosphere.bottom_radius_m
    edge = np.pi / 2 + np.arccos(radius / (radius + altitude))
    zenith = edge + np.radians(np.repeat([-1.0, -0.01, 0.01, 0.05, 1.0], 7))
    azimuth = np.tile(np.linspace(0.0, np.pi, 7), 5)
    found = SkyView(earth_sky, altitude, sun).radiance(floats(zenith), floats(azimuth))
    constant = (np.full(35, altitude), np.full(35, sun))
    exact = earth_sky.rays(*map(doubles, (*constant, zenith, azimuth))).radiance
    for a, b in zip(found, exact, strict=True):
        np.testing.assert_allclose(a.numpy(), b.numpy(), rtol=5e-3)


def test_directions_are_angles(earth_sky):
    """``along`` with unit vectors is ``radiance`` with angles, the poles and the sun's meridian included."""
    view = SkyView(earth_sky, 1.0, 0.9)
    zenith = np.array([0.0, 0.4, 0.9, 1.5, 2.2, np.pi])
    azimuth = np.array([0.0, np.pi, 0.0, -1.2, 1.2, 2.0])
    d = (np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith))
    pairs = zip(view.along(*map(floats, d)), view.radiance(floats(zenith), floats(azimuth)), strict=True)
    for a, b in pairs:
        np.testing.assert_allclose(a.numpy(), b.numpy(), rtol=1e-4)


def test_transmittance(earth_sky):
    view = SkyView(earth_sky, 500.0, 0.5)
    zenith = np.radians(np.array([0.0, 45.0, 85.0, 89.5, 92.0, 120.0, 180.0]))
    constant = (np.full(7, 500.0), np.full(7, 0.5))
    exact = earth_sky.rays(*map(doubles, (*constant, zenith, np.zeros(7)))).transmittance
    for a, b in zip(view.transmittance(floats(zenith)), exact, strict=True):
        np.testing.assert_allclose(a.numpy(), b.numpy(), atol=2e-3)


def test_space_beside_the_limb_is_black_and_clear(earth_sky):
    view = SkyView(earth_sky, 4e5, 0.6)
    zenith = floats(np.radians([0.0, 60.0, 100.0, 170.0]))
    light, clear = view.radiance(zenith, floats(np.zeros(4))), view.transmittance(zenith)
    for radiance, through in zip(light, clear, strict=True):
        assert radiance.numpy()[:3].tolist() == [0.0] * 3 and radiance.numpy()[3] > 0.0
        assert through.numpy()[:3].tolist() == [1.0] * 3 and through.numpy()[3] < 1.0


def test_without_the_ground(earth_sky):
    view = SkyView(earth_sky, 1e3, 0.7, ground=False)
    assert sky_view_error(view, earth_sky, ground=False).p99 < 3e-3


def test_night_is_dark_and_finite(earth_sky):
    found = SkyView(earth_sky, 10.0, np.radians(150.0)).radiance(floats([0.3, 1.5, 2.0]), floats([0.0, 1.0, 3.0]))
    assert all(np.all(np.isfinite(v.numpy())) and np.all(v.numpy() >= 0.0) for v in found)


def test_bytes_are_counted(earth_sky):
    small, large = (SkyView(earth_sky, 1.0, 0.5, size).nbytes for size in ((32, 16, 24), (64, 32, 48)))
    assert 3.5 * small < large < 4.2 * small
