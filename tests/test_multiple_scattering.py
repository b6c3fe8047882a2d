"""All orders: against spherical Monte Carlo, adding and doubling where the planet is flat, and energy."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.polynomial import legendre
from twins import Twin, cosines

import atmo_jit
from bench.slab import Slab
from bench.worlds import WORLDS, world

FLAT_RADIUS = 1.0e9  # m; a layer of scale height 8 km is then plane-parallel to 8e-6 / mu^2


@pytest.fixture(scope="module")
def rays(reference):
    """(reference arrays, the package's radiance of all 711 rays)."""
    from bench.accuracy import sky_radiance
    from bench.reference import load

    return load("sky_radiance", reference), sky_radiance(path=reference)


def shares(rays, mask):
    """Parts of the masked rays within 1 % and 3 % plus three sigma, and the worst ray for the message."""
    from bench.accuracy import all_orders_row, worst_rays

    data, value = rays
    row = all_orders_row(value, data, np.flatnonzero(mask))
    return row["within_1"], row["within_3"], worst_rays(np.where(mask, value, np.nan), data, 3)


def test_rays_without_a_flag(rays):
    """The issue's figures: 95 % within 1 % + 3 sigma, all within 3 % + 3 sigma."""
    within_1, within_3, worst = shares(rays, rays[0]["flag"] == 0)
    assert within_1 >= 0.95, worst
    assert within_3 == 1.0, worst


def test_rays_with_a_flag(rays):
    """The issue's figure for horizon, limb, twilight and the sun's neighbourhood: 90 % within 3 % + 3 sigma."""
    _, within_3, worst = shares(rays, rays[0]["flag"] > 0)
    assert within_3 >= 0.90, worst


# --- the flat limit ---


def test_slab_twin_satisfies_known_results():
    """Adding and doubling against Chandrasekhar's H(mu) for isotropic conservative scattering, and energy."""
    h = {0.1: 1.2474, 0.5: 2.0128, 1.0: 2.9078}  # Chandrasekhar 1960, table XI
    slab = Slab([1.0], 1.0, list(h))
    _, up = slab.radiance(0.0, 2000.0, 0.0, 1.0, 0.0)
    for (mu, value), radiance in zip(h.items(), up[:, 0], strict=True):
        assert radiance == pytest.approx(value * h[1.0] / (4 * np.pi * (mu + 1.0)), rel=3e-4)
    x, w = legendre.leggauss(24)
    mu = (x + 1) / 2
    slab = Slab(0.5 ** np.arange(25), 1.0, np.r_[mu, 0.6])
    _, up = slab.radiance(0.0, 1.3, 0.0, 0.6, np.pi * (np.arange(32) + 0.5) / 32)
    down, _ = slab.radiance(1.3, 0.0, 0.0, 0.6, np.pi * (np.arange(32) + 0.5) / 32)
    flux = np.sum((up + down)[:24].mean(axis=1) * 2 * np.pi * mu * w / 2)
    assert flux == pytest.approx(0.6 * (1 - np.exp(-1.3 / 0.6)), rel=1e-5)


FLAT = {
    "conservative gas": ([1.0, 0.0, 0.1], 1.0, 0.35, 0.3),
    "isotropic haze, bright ground": ([1.0], 0.9, 0.8, 0.8),
    "forward haze": (0.5 ** np.arange(30), 0.95, 0.5, 0.1),
    "thick cloud": (0.5 ** np.arange(30), 0.99, 4.0, 0.1),
}
"""Legendre moments, single-scattering albedo, optical depth and ground albedo of homogeneous flat layers."""


def flat_world(moments, scattered: float, depth: float, albedo: float) -> dict:
    """A planet so large that it is flat: one species, exponential, with optical depth ``depth``."""
    scale_height, top = 8000.0, 60000.0
    extinction = depth / (scale_height * (1 - np.exp(-top / scale_height)))
    if len(moments) == 30:
        phase = {"type": "henyey_greenstein", "g": float(moments[1])}
    else:
        phase = {"type": "legendre", "moments": list(moments)}
    return world(
        wavelengths_nm=[550],
        solar_irradiance=1,
        bottom_radius_m=FLAT_RADIUS,
        top_radius_m=FLAT_RADIUS + top,
        rayleigh=None,
        mie={
            "scattering_per_m": scattered * extinction,
            "single_scattering_albedo": scattered,
            "scale_height_m": scale_height,
            "phase": phase,
        },
        ground_albedo=albedo,
    )


@pytest.mark.parametrize("name", FLAT)
def test_flat_limit(name):
    """Sky from the ground, from one scale height and from above, sun at 60 and 25 degrees.

    The limits are the issue's for the Monte Carlo rays; here the truth has no noise.
    """
    moments, scattered, depth, albedo = FLAT[name]
    spec = flat_world(*FLAT[name])
    view_mu, azimuth = np.array([0.25, 0.5, 0.75, 1.0]), np.radians([0.0, 60.0, 180.0])
    twin = Twin(spec)
    suns = np.cos(np.radians([60.0, 25.0]))
    slab = Slab(moments, scattered, np.r_[view_mu, suns])
    views, want = [], []
    for mu_0 in suns:
        for h in (0.0, 8000.0, 60000.0):
            above = float(twin.optical_depth(twin.columns(h, 1.0))[0, 0])
            above = 0.0 if above < 1e-9 else above
            down, up = slab.radiance(above, max(depth - above, 0.0), albedo, mu_0, azimuth)
            for sign, radiance in ((1, down), (-1, up)):
                if (sign > 0 and h < 60000) or (sign < 0 and h > 0):
                    zenith = np.degrees(np.arccos(sign * view_mu))
                    mesh = np.meshgrid(zenith, np.degrees(azimuth), indexing="ij")
                    sun = np.degrees(np.arccos(mu_0))
                    views.append([(h, sun, v, a) for v, a in zip(*map(np.ravel, mesh), strict=True)])
                    want.append(radiance[:4].ravel())
    columns = np.concatenate(views).T
    names = ("altitude_m", "sun_zenith_deg", "view_zenith_deg", "azimuth_deg")
    got = atmo_jit.sky(spec, dict(zip(names, columns, strict=True))).radiance[:, 0]
    error = np.abs(got / np.concatenate(want) - 1)
    assert np.mean(error < 0.01) >= 0.95
    assert error.max() < 0.03


# --- our own Monte Carlo, where the reference has no atmosphere ---

WALK_VIEWS = np.array(
    [
        (0, 50, 0, 0),
        (0, 50, 60, 30),
        (0, 50, 87, 150),
        (0, 84, 40, 60),
        (5000, 50, 80, 90),
        (12000, 70, 110, 20),
        (75000, 50, 180, 0),
        (75000, 70, 150, 100),
    ],
    float,
)
"""Altitude (m), sun zenith, view zenith, azimuth (deg) of the rays of WALKS."""

WALKS = {
    "small planet": [
        [0.011809, 0.021673, 0.036099],
        [0.046121, 0.071711, 0.099914],
        [0.064562, 0.109155, 0.142292],
        [0.007870, 0.014411, 0.021835],
        [0.009498, 0.022396, 0.044691],
        [0.078926, 0.090884, 0.099728],
        [0.092415, 0.083271, 0.061283],
        [0.048690, 0.046712, 0.041381],
    ],
    "two aerosols, five wavelengths": [
        [0.032098, 0.042540, 0.051304, 0.061669, 0.075517],
        [0.135178, 0.175001, 0.203983, 0.225107, 0.237647],
        [0.090100, 0.114817, 0.132763, 0.149101, 0.160590],
        [0.015970, 0.019699, 0.023019, 0.026638, 0.029590],
        [0.056336, 0.072861, 0.087042, 0.103217, 0.125084],
        [0.081077, 0.103084, 0.118728, 0.132934, 0.143455],
        [0.063580, 0.077131, 0.086448, 0.095533, 0.105417],
        [0.034826, 0.042575, 0.048914, 0.056153, 0.064893],
    ],
}
"""Radiance by ``bench.monte_carlo.truth(WORLDS[name], views, 1_000_000, seed=7)``; sigma is below 0.16 % everywhere."""


def walk_views() -> dict[str, np.ndarray]:
    names = ("altitude_m", "sun_zenith_deg", "view_zenith_deg", "azimuth_deg")
    return dict(zip(names, WALK_VIEWS.T, strict=True))


@pytest.mark.parametrize("name", WALKS)
def test_other_worlds(name):
    """Several species, profiles, wavelengths, another radius: within 1 % + 3 sigma, below the horizon too."""
    got, want = atmo_jit.sky(WORLDS[name], walk_views()).radiance, np.array(WALKS[name])
    assert np.abs(got / want - 1).max() < 0.01 + 3 * 0.0016


def test_monte_carlo_agrees_with_adding_and_doubling():
    """The judge is judged: the random walk in a flat layer, orders two and up, within four standard errors."""
    from bench.monte_carlo import MonteCarlo

    moments, scattered, depth, albedo = FLAT["forward haze"]
    twin = Twin(flat_world(moments, scattered, depth, albedo))
    view_mu, turn, mu_0 = np.array([0.3, 0.6, 1.0]), np.array([0.0, 2.0]), 0.5
    slab = Slab(moments, scattered, np.r_[view_mu, mu_0])
    down, up = slab.radiance(depth, 0.0, albedo, mu_0, turn)[0], slab.radiance(0.0, depth, albedo, mu_0, turn)[1]
    want = np.concatenate([down[:3].ravel(), up[:3].ravel()])
    h = np.repeat([0.0, 60000.0 - 1e-3], 6)
    zenith = np.degrees(np.arccos(np.concatenate([np.repeat(view_mu, 2), -np.repeat(view_mu, 2)])))
    mu, mu_s, nu = cosines(60.0, zenith, np.tile(np.degrees(turn), 6))
    mu_s = np.full(12, mu_s)
    one = twin.single_scattering(h, mu, mu_s, nu) + twin.ground_direct(h, mu, mu_s, nu)
    more, sigma = MonteCarlo(twin).orders_from_two({"h": h, "mu": mu, "mu_s": mu_s, "nu": nu}, 20_000)
    assert np.all(np.abs((one + more)[:, 0] - want) < 4 * sigma[:, 0] + 1e-3 * want)
    assert np.all(sigma[:, 0] < 0.02 * want)


# --- energy ---


def test_nothing_is_lost():
    """Air and ground that only scatter give back to space all the light that falls on the planet (1 %).

    Outgoing flux through the top, integrated over the planet's sun zeniths, equals what the disc of the planet and its
    air takes from the sunbeam: E pi r_top^2 minus what passes straight through the limb.
    """
    spec = world(
        wavelengths_nm=[640, 450],
        solar_irradiance=1,
        rayleigh={"scattering_per_m": [7e-6, 3e-5], "scale_height_m": 5000},
        mie=None,
        ground_albedo=1.0,
    )
    radius, top = spec["bottom_radius_m"], spec["top_radius_m"]
    twin = Twin(spec)
    mu_s, weight_s = _rule([-0.9, -0.5, -0.3, -0.15, 0.0, 0.15, 1.0], 6)
    horizon = -np.sqrt(1 - (radius / top) ** 2)
    mu, weight = _rule([-1.0, 2 * horizon, horizon, 0.5 * horizon, 0.0], 6)
    azimuth = np.pi * (np.arange(8) + 0.5) / 8
    mesh = np.meshgrid(np.arccos(mu_s), np.arccos(mu), azimuth, indexing="ij")
    sun, view, turn = (np.degrees(part).ravel() for part in mesh)
    views = {"altitude_m": 0 * sun + top - radius, "sun_zenith_deg": sun, "view_zenith_deg": view, "azimuth_deg": turn}
    radiance = atmo_jit.sky(spec, views).radiance.reshape(*mesh[0].shape, 2).mean(axis=2) * 2 * np.pi
    flux = np.einsum("svw,v->sw", radiance, -mu * weight)
    outgoing = 2 * np.pi * top**2 * weight_s @ flux
    perigee, ring = _rule([radius, radius + 2e4, top], 24)
    through = np.exp(-twin.optical_depth(twin.columns(np.full(48, top - radius), -np.sqrt(1 - (perigee / top) ** 2))))
    passed = (2 * np.pi * perigee * ring) @ through
    assert outgoing == pytest.approx(np.pi * top**2 - passed, rel=0.01)


def _rule(edges, nodes):
    """Gauss-Legendre nodes and weights on each interval between ``edges``, joined."""
    x, w = legendre.leggauss(nodes)
    low, high = np.array(edges[:-1])[:, None], np.array(edges[1:])[:, None]
    return (low + (high - low) * (x + 1) / 2).ravel(), ((high - low) * w / 2).ravel()


def test_bare_ground_under_vacuum():
    """Without air the ground shines with albedo E mu_s / pi, and the sky is black."""
    spec = world(rayleigh={"scattering_per_m": 1e-16, "scale_height_m": 5000}, mie=None)
    horizon = np.degrees(np.arccos(-np.sqrt(1 - (1e6 / 1.1e6) ** 2)))
    views = {
        "altitude_m": [1e4, 1e4, 1e5, 1e5, 0.0],
        "sun_zenith_deg": [30.0, 70.0, 30.0, 0.0, 120.0],
        "view_zenith_deg": [180.0, 180.0, horizon - 0.1, 180.0, 95.0],
        "azimuth_deg": [0.0, 0.0, 180.0, 0.0, 0.0],
    }
    result = atmo_jit.sky(spec, {key: np.array(value) for key, value in views.items()})
    mu_s = np.array([np.cos(np.radians(30)), np.cos(np.radians(70)), 0.0, 1.0, 0.0])
    want = mu_s[:, None] * np.array(spec["ground_albedo"]) * np.array(spec["solar_irradiance"]) / np.pi
    assert result.radiance == pytest.approx(want, rel=1e-5, abs=1e-9)
    assert result.transmittance == pytest.approx(np.ones((5, 3)), abs=1e-6)
