"""The twin of the gather over directions: its maps, and the numbers that the published implementation gives."""

from __future__ import annotations

import numpy as np
import pytest

import atmo_jit
from atmo_jit.backend import floats
from bench.accuracy import earth
from bench.bruneton import GatheredSky, Tables
from bench.shared_light import entered
from bench.tables4d import Mapping, Sizes

# Texels of the published implementation's tables for the default Earth (float): T[r, mu], S[r, mu, nu * 32 + mu_s] and
# E[r, mu_s]; measured in a browser.
T_PROBES = {
    (0, 0): (0.94038, 0.86766, 0.76241),
    (0, 128): (0.55629, 0.26258, 0.070853),
    (63, 255): (1.1332e-2, 9.185e-5, 2.717e-9),
}
S_PROBES = {
    (4, 100, 255): (0.85771, 1.86726, 2.84126, 0.047378),
    (16, 10, 112): (0.60471, 0.59917, 0.69478, 0.046381),
}
E_PROBE = (0.035783, 0.079548, 0.154785)


@pytest.fixture(scope="module")
def once():
    """The tables of full size up to single scattering."""
    return Tables(earth(), Sizes(), orders=1)


def scattering(values, sizes):
    return values.numpy().reshape(sizes.r, sizes.mu, sizes.nu * sizes.mu_s, 4)


def test_transmittance_is_the_published_one(once):
    table = once.transmittance.numpy().reshape(64, 256, 4)
    for texel, value in T_PROBES.items():
        # single precision at an optical depth of 20: 5e-4 of the smallest
        assert np.allclose(table[texel][:3], value, rtol=1e-3)


def test_single_scattering_by_aerosol_is_the_published_one(once):
    mie = scattering(once.single[1], once.sizes)
    for texel, value in S_PROBES.items():
        assert mie[texel][0] == pytest.approx(value[3], rel=5e-4)


@pytest.mark.slow
def test_four_orders_are_the_published_ones():
    tables = Tables(earth(), Sizes())
    single, multiple = (scattering(v, tables.sizes) for v in (tables.single[0], tables.multiple))
    nu = tables.map.scattering_texels()[3].numpy().reshape(32, 128, 256)
    phase = 3 / (16 * np.pi) * (1 + nu**2)
    for texel, value in S_PROBES.items():
        # single precision in two implementations; measured 3e-4
        assert np.allclose((single[texel] + multiple[texel] / phase[texel])[:3], value[:3], rtol=1e-3)
    assert np.allclose(tables.irradiance.numpy().reshape(16, 64, 4)[0, 40, :3], E_PROBE, rtol=2e-3)


def test_texels_find_themselves():
    """Reading a table at the coordinates of its texels gives the texels."""
    sizes = Sizes.times(0.25)
    air = atmo_jit.Atmosphere.load("earth")
    mapping = Mapping(air.bottom_radius_m, air.top_radius_m, sizes)
    r, mu, mu_s, nu, ground = mapping.scattering_texels()
    values = np.random.default_rng(0).random((sizes.texels, 4))
    # What changes from texel to texel of r and mu alone: mu_s and nu have ends at which single precision matters.
    values[:] = values.reshape(sizes.r, sizes.mu, -1, 4)[:, :, :1].repeat(sizes.nu * sizes.mu_s, 2).reshape(-1, 4)
    found = mapping.scattering(floats(values), mapping.place(r, mu, mu_s, ground), nu, 4)
    # At the horizon's own rows mu is decided by rounding.
    row = np.arange(sizes.texels) // (sizes.nu * sizes.mu_s) % sizes.mu
    altitude = np.arange(sizes.texels) // (sizes.nu * sizes.mu_s * sizes.mu)
    inner = (row > 0) & (abs(row - sizes.mu / 2 + 0.5) > 1) & (row < sizes.mu - 1)
    inner &= (altitude > 0) & (altitude < sizes.r - 1)
    error = np.abs(found[2].numpy() - values[:, 2])[inner]
    assert inner.sum() > 1000 and np.percentile(error, 99) < 0.02
    # the middle of the day, away from where the sun sets: nu is not cut there
    assert (np.abs(mu_s.numpy()) <= 1).all() and (np.abs(nu.numpy()) <= 1).all()


def test_black_air_over_white_ground_scatters_only_once():
    """Nothing is gathered where nothing scatters twice: with hardly any air, orders >= 2 vanish as its square."""

    def sky(factor):
        thin = atmo_jit.Atmosphere.load("earth").replace(
            {"rayleigh.scattering_per_m": 1e-8 * factor, "mie": None, "ozone": None, "ground_albedo": 0.0}
        )
        return float(Tables(thin, Sizes.times(0.25), orders=2).multiple.numpy().max())

    assert sky(2.0) / sky(1.0) == pytest.approx(4.0, rel=0.01)


def test_radiance_by_day_is_near_the_solver():
    """At half the published size the tables are some per cent off by day, and not more."""
    views = {
        "altitude_m": np.full(4, 500.0),
        "sun_zenith_deg": np.full(4, 50.0),
        "view_zenith_deg": np.array([0.0, 40.0, 75.0, 130.0]),
        "azimuth_deg": np.array([0.0, 90.0, 150.0, 60.0]),
    }
    own = atmo_jit.sky("earth", views).radiance
    found = GatheredSky("earth", Sizes.times(0.5)).radiance(views)
    assert found.shape == own.shape
    assert np.abs(found / own - 1.0).max() < 0.1


def test_rays_from_space_enter_where_they_must():
    low, top = 6.36e6, 6.42e6
    views = {"altitude_m": [1e6] * 2, "sun_zenith_deg": [30.0] * 2, "view_zenith_deg": [180.0, 10.0]}
    views["azimuth_deg"] = [0.0] * 2
    found = entered(views, low, top)
    assert found["meets_air"].tolist() == [True, False] and found["ground"].tolist() == [True, False]
    assert found["h"][0] == top - low and found["mu"][0] == pytest.approx(-1.0)
    assert found["ground_mu_s"][0] == pytest.approx(np.cos(np.radians(30.0)))
