"""The table of the sky: its map, and its error against the solver in directions that are not nodes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from atmo_jit.atmosphere import Atmosphere
from atmo_jit.backend import doubles
from atmo_jit.plugins.panorama import Panorama, Warp, solve_disc, solve_sky
from atmo_jit.solved import Sky

COUNT = 4000
# Error of the interpolated radiance relative to the brightest 99.9 %: worst of these cases 0.25 % near the horizon of
# twilight, from cells of 0.5 degrees where radiance curves most; elsewhere below 0.1 %.
P99, MEAN = 0.004, 0.0005


@pytest.fixture(scope="module")
def sky() -> Sky:
    return Sky("earth")


def view_of(sky: Sky, altitude_m: float, sun_zenith_deg: float) -> Panorama:
    air = sky.atmosphere
    return Panorama.of(air.bottom_radius_m, air.thickness_m, altitude_m, math.radians(sun_zenith_deg))


def test_warp_is_a_map_onto_the_unit_interval() -> None:
    warp = Warp.around(2.0, (0.0, 1e-3, 0.4), (0.7, 0.02, 0.3))
    nodes = warp.nodes(101)
    assert nodes[0] == 0.0 and nodes[-1] == 2.0
    np.testing.assert_allclose(warp(nodes), np.linspace(0.0, 1.0, 101), atol=1e-12)
    steps = np.diff(nodes)
    assert steps.min() > 0.0
    assert steps[0] < 1e-3 and steps[np.searchsorted(nodes, 0.7)] < 0.01 and steps.max() < 0.15


@pytest.mark.parametrize("altitude_m", [0.0, 1.0, 1e4, 5.9e4, 4e5])
def test_cells_cover_what_can_be_bright(altitude_m: float) -> None:
    view = Panorama.of(6.36e6, 6e4, altitude_m, 1.0)
    dip = math.acos(6.36e6 / (6.36e6 + altitude_m))
    assert view.dip == pytest.approx(dip, abs=1e-9)
    top = 1.0 if altitude_m < 6e4 else math.sin(view.up.length - view.dip)
    assert view.solid_angles().min() > 0.0
    assert view.solid_angles().sum() == pytest.approx(2.0 * math.pi * (1.0 + top), rel=1e-12)


@pytest.mark.parametrize(
    ("altitude_m", "sun_zenith_deg"), [(1.0, 0.0), (1.0, 45.0), (1.0, 88.0), (1.0, 94.0), (1e4, 60.0)]
)
def test_interpolation_error(sky: Sky, altitude_m: float, sun_zenith_deg: float) -> None:
    from scipy.interpolate import RegularGridInterpolator  # in place of the texture

    view = view_of(sky, altitude_m, sun_zenith_deg)
    table = np.array(solve_sky(sky, view)[1]).reshape(len(view.rows()), -1)
    rng = np.random.default_rng(1)
    spread = np.where(rng.random(COUNT) < 0.5, 1.0, 10.0 ** rng.uniform(-4.0, 0.0, COUNT))
    a = spread * rng.uniform(-0.5 * math.pi + view.dip, view.horizon_zenith, COUNT)
    a = a[np.abs(a) > 1e-5]
    phi = rng.uniform(0.0, math.pi, len(a))

    found = np.empty(len(a))
    for part, warp, rows in ((a >= 0.0, view.up, slice(-129, None)), (a < 0.0, view.down, slice(64, None, -1))):
        values = table[rows]
        axes = np.linspace(0.0, 1.0, len(values)), np.linspace(0.0, 1.0, values.shape[1])
        at = np.stack([warp(np.abs(a[part])), view.around(phi[part])], axis=-1)
        found[part] = RegularGridInterpolator(axes, values)(np.clip(at, 0.0, 1.0))

    zeros = np.zeros(len(a))
    rays = sky.rays(*map(doubles, (zeros + altitude_m, zeros + view.sun_zenith, view.horizon_zenith - a, phi)))
    exact = np.array(rays.radiance[1], dtype=np.float64)
    error = (found - exact) / np.maximum(exact, 1e-3 * exact.max())
    assert np.percentile(np.abs(error), 99) < P99
    assert abs(np.mean(found - exact)) < MEAN * np.mean(exact)


def test_disc_sets_through_the_horizon(sky: Sky) -> None:
    radius = math.radians(0.2678)
    discs = [solve_disc(sky, view_of(sky, 1.0, 90.0 - e), radius) for e in (1.0, 0.2, 0.0, -0.2, -1.0)]
    fractions = [d.mean[0] / max(d.brightness[:, 0, 0].mean(), 1e-30) for d in discs]
    assert fractions[0] == pytest.approx(1.0, abs=0.01)
    assert fractions == sorted(fractions, reverse=True)
    assert fractions[2] == pytest.approx(0.58, abs=0.06)  # half of it, and the horizon lies 0.03 degrees lower
    assert fractions[4] == 0.0
    low = discs[1].brightness[:, 0]
    assert low[0, 2] < low[-1, 2] and low[0, 0] > low[0, 2]  # redder and darker towards the horizon
    darkened = solve_disc(sky, view_of(sky, 1.0, 45.0), radius, limb_darkening=True).brightness[24]
    even = solve_disc(sky, view_of(sky, 1.0, 45.0), radius).brightness[24]
    assert darkened[0, 1] > even[0, 1] and darkened[-1, 1] < 0.5 * even[-1, 1]
    rings = 0.5 * (darkened[1:] + darkened[:-1])  # columns are even in area
    np.testing.assert_allclose(rings.mean(axis=0), even[0], rtol=1e-6)


def test_odd_planet() -> None:
    # No constant of the earth: a planet of 1000 km with 20 km of air.
    odd = Atmosphere.load("earth").replace({"bottom_radius_m": 1e6, "top_radius_m": 1.02e6})
    view = Panorama.of(odd.bottom_radius_m, odd.thickness_m, 1e3, 1.0)
    assert view.horizon_zenith == pytest.approx(math.pi / 2 + math.acos(1e6 / 1.001e6), rel=1e-9)
