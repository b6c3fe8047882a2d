"""Single scattering: against the reference grid, against the twin in other worlds, and against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from twins import Twin, cosines

import atmo_jit
from bench.worlds import WORLDS, views_of, world

MEDIAN, P99 = 0.1, 1.0  # per cent, where radiance > 1e-3 of the peak: the figures
BRIGHT = 1e-3


@pytest.fixture(scope="module")
def grid(reference):
    from bench.accuracy import single_scattering

    return single_scattering(path=reference)["radiance"]


@pytest.mark.parametrize("sun", [0, 30, 60, 80, 88, 90, 94, 100])
def test_reference_grid(grid, sun):
    """The 2017 Earth at six altitudes: over all of them, and at each by itself."""
    rows = [row for row in grid if row["sun_zenith_deg"] == sun]
    assert [row["altitude_m"] for row in rows] == [1, 500, 5000, 20000, 59000, 400000, "all"]
    for row in rows:
        assert row["rays"] > 40, row
        assert row["median"] < MEDIAN, row
        assert row["p99"] < P99, row


def test_aerial_perspective_of_the_reference_grid(reference):
    """Segments of 100 m to 200 km; the reference has no light there at 100 degrees."""
    from bench.accuracy import aerial_perspective

    for row in aerial_perspective(path=reference):
        if row["sun_zenith_deg"] < 100:
            assert row["rays"] > 500, row
            assert row["median"] < MEDIAN, row
            assert row["p99"] < P99, row


def test_all_reference_rays_to_the_ground(reference):
    """Directly lit ground and single scattering of the 711 rays: ``orders=1`` is their exact first two terms."""
    from bench.accuracy import sky_radiance
    from bench.reference import load

    data = load("sky_radiance", reference)
    truth = data["L_single"] + data["L_ground_direct"]
    value = sky_radiance(path=reference, orders=1)
    lit = truth > 1e-3 * data["L"]
    error = 100 * np.abs(value[lit] / truth[lit] - 1)
    assert np.median(error) < MEDIAN
    assert np.percentile(error, 99) < P99


def test_twin_agrees_with_the_reference(reference):
    """The twin is fit to judge: a part of every reference set, to 1e-4 or better (it is 1e-5 at six nodes a piece)."""
    from bench.accuracy import earth
    from bench.reference import load, single_scattering_views, sky_cases

    data = load("single_scattering_earth", reference)
    shape, views = single_scattering_views(data)
    part = np.arange(0, views["altitude_m"].size, 7)
    mu, mu_s, nu = cosines(*(views[f"{k}_deg"][part] for k in ("sun_zenith", "view_zenith", "azimuth")))
    value = Twin(earth().to_dict()).single_scattering(views["altitude_m"][part], mu, mu_s, nu)
    truth = data["radiance_single_brute"].astype(float)
    peak = np.broadcast_to(truth.max(axis=(2, 3), keepdims=True), truth.shape).reshape(-1, 3)[part]
    truth = truth.reshape(-1, 3)[part]
    bright = truth > BRIGHT * peak
    assert np.abs(value / np.where(bright, truth, 1) - 1)[bright].max() < 1e-4

    data = load("sky_radiance", reference)
    for case in sky_cases(data):
        twin = Twin(case.atmosphere)
        h = case.views["altitude_m"]
        mu, mu_s, nu = cosines(*(case.views[f"{k}_deg"] for k in ("sun_zenith", "view_zenith", "azimuth")))
        one = np.arange(h.size), case.channel
        single = twin.single_scattering(h, mu, mu_s, nu)[one]
        direct = twin.ground_direct(h, mu, mu_s, nu)[one]
        clear = twin.transmittance(h, mu)[one]
        assert single == pytest.approx(data["L_single"][case.rows], rel=1e-5, abs=1e-15)
        assert direct == pytest.approx(data["L_ground_direct"][case.rows], rel=1e-6, abs=1e-15)
        assert clear == pytest.approx(data["T_view"][case.rows], rel=1e-6)


@pytest.mark.parametrize("name", WORLDS)
def test_other_worlds(name):
    """Radiance of order 1 with the ground's, relative where > 1e-3 of the peak of that observer and sun."""
    spec = WORLDS[name]
    views = views_of(spec)
    got = atmo_jit.sky(spec, views, orders=1).radiance
    twin = Twin(spec)
    mu, mu_s, nu = cosines(*(views[f"{k}_deg"] for k in ("sun_zenith", "view_zenith", "azimuth")))
    want = twin.single_scattering(views["altitude_m"], mu, mu_s, nu) + twin.ground_direct(
        views["altitude_m"], mu, mu_s, nu
    )
    groups = want.reshape(6, -1, twin.width)
    bright = (groups > BRIGHT * groups.max(axis=1, keepdims=True)).reshape(want.shape)
    assert bright.sum() > 0.3 * bright.size
    error = 100 * np.abs(got / np.where(bright, want, 1) - 1)[bright]
    assert np.median(error) < MEDIAN
    assert np.percentile(error, 99) < P99


@pytest.mark.parametrize("name", ["small planet, wide sun", "two aerosols, five wavelengths"])
def test_segments_of_other_worlds(name):
    """Aerial perspective is the integral over the segment itself, down to a metre, never a difference of long rays."""
    spec = WORLDS[name]
    views = views_of(spec, seed=3)
    rng = np.random.default_rng(4)
    views["distance_m"] = 10 ** rng.uniform(0, 5.5, views["altitude_m"].size)
    inside = views["altitude_m"] < spec["top_radius_m"] - spec["bottom_radius_m"]
    views = {key: value[inside & (views["sun_zenith_deg"] < 90)] for key, value in views.items()}
    result = atmo_jit.sky(spec, views, orders=1, ground=False)
    mu, mu_s, nu = cosines(*(views[f"{k}_deg"] for k in ("sun_zenith", "view_zenith", "azimuth")))
    twin = Twin(spec)
    want = twin.single_scattering(views["altitude_m"], mu, mu_s, nu, views["distance_m"])
    error = 100 * np.abs(result.radiance / want - 1)
    assert np.median(error) < MEDIAN
    assert np.percentile(error, 99) < P99
    assert np.abs(result.transmittance - twin.transmittance(views["altitude_m"], mu, views["distance_m"])).max() < 1e-4


def test_sky_irradiance_of_order_one():
    """The singly scattered sky on a horizontal surface is the integral of its radiance (24 x 16 directions)."""
    spec = WORLDS["small planet"]
    twin = Twin(spec)
    h, sun = np.array([0.0, 5000.0, 0.0, 20000.0]), np.array([30.0, 60.0, 85.0, 92.0])
    views = {"altitude_m": h, "sun_zenith_deg": sun, "view_zenith_deg": 0 * h, "azimuth_deg": 0 * h}
    got = atmo_jit.sky(spec, views, orders=1).sky_irradiance
    want = np.array([twin.sky_irradiance(a, np.cos(np.radians(s))) for a, s in zip(h, sun, strict=True)])
    assert got == pytest.approx(want, rel=0.01)


def test_absorbers_do_not_shine():
    """Ozone alone takes light away and gives none back."""
    spec = world(rayleigh=None, mie=None, ozone={"absorption_per_m": 1e-5, "center_m": 2e4, "half_width_m": 1e4})
    result = atmo_jit.sky(spec, views_of(spec, 5), orders=1, ground=False)
    assert np.all(result.radiance == 0)
    assert result.transmittance.min() < 0.9


def test_thin_air_is_its_own_closed_form():
    """Optically thin air of constant density: radiance = beta E p(nu) times the sunlit distance."""
    beta, solar = 1e-12, 2.0
    flat = {"scattering_per_m": beta, "profile": {"altitude_m": [0, 50000], "density": [1, 1]}}
    spec = world(rayleigh=flat, mie=None, solar_irradiance=solar, ground_albedo=0.0)
    views = {
        "altitude_m": [0, 0, 50000, 1e5],
        "sun_zenith_deg": [0, 0, 0, 45],
        "view_zenith_deg": [0, 60, 180, 180],
        "azimuth_deg": [0, 0, 0, 0],
    }
    views = {key: np.array(value, float) for key, value in views.items()}
    got = atmo_jit.sky(spec, views, orders=1).radiance
    slant = -1e6 * 0.5 + np.sqrt(1.05e6**2 - 1e12 * 0.75)
    path = np.array([5e4, slant, 5e4, 5e4])
    nu = np.cos(np.radians([0, 60, 180, 135]))
    want = beta * solar * 3 / (16 * np.pi) * (1 + nu**2) * path
    assert got == pytest.approx(np.repeat(want[:, None], 3, axis=1), rel=2e-5)
