"""Tables of Bruneton's layout: texels against the solution, and against what a client's own solver stores."""

from __future__ import annotations

import numpy as np
import pytest

from atmo_jit.backend import doubles
from atmo_jit.bake.client import SCATTERING, BrunetonTables, bruneton_tables, scattering_nodes


@pytest.fixture(scope="module")
def tables(earth_sky) -> BrunetonTables:
    return bruneton_tables(earth_sky, np.cos(np.radians(102.0)))


def test_shapes_are_the_clients(tables):
    assert tables.transmittance.shape == (64, 256, 3)
    assert tables.irradiance.shape == (16, 64, 3)
    assert all(v.shape == (32, 128, 8, 32, 3) for v in (tables.rayleigh, tables.mie, tables.higher, tables.scattering))
    assert all(np.all(np.isfinite(v)) for v in (tables.transmittance, tables.irradiance, tables.scattering, tables.mie))


def test_transmittance_is_what_clients_compute(tables):
    """Three texels of @takram/three-atmosphere 0.19.1, from the Earth's preset: no phase function, no order in them."""
    probes = {
        (0, 0): (0.94038, 0.86766, 0.76241),
        (0, 128): (0.55629, 0.26258, 0.070853),
        (63, 255): (1.1332e-2, 9.185e-5, 2.717e-9),
    }
    for (i, j), values in probes.items():
        assert tables.transmittance[i, j] == pytest.approx(values, rel=2e-4)


def test_light_is_near_what_clients_compute(tables):
    """Theirs have four orders and a quadrature error, so a few per cent are left between the same quantities. Texel
    [altitude, mu row, column] with column = nu index * 32 + mu_s index."""
    column = np.unravel_index(255, (8, 32))
    assert tables.scattering[(4, 100, *column)] == pytest.approx((0.85771, 1.86726, 2.84126), rel=0.03)
    assert tables.mie[(4, 100, *column)][0] == pytest.approx(0.047378, rel=0.05)
    assert tables.irradiance[0, 40] == pytest.approx((0.035783, 0.079548, 0.154785), rel=0.08)


def test_texels_are_the_solution(tables, earth_sky):
    rng = np.random.default_rng(0)
    h, mu, mu_s, nu = scattering_nodes(tables.mapping, SCATTERING)
    at = tuple(rng.integers(1, n - 1, 3000) for n in SCATTERING)
    height, view, sun, angle = h[at[0], 0, 0, 0], mu[at[0], at[1], 0, 0], mu_s[at[3]], nu[at]
    by_day = (sun > np.cos(np.radians(85.0))) & ~np.isin(at[1], (63, 64))
    sines = np.maximum(np.sqrt((1 - view**2) * (1 - sun**2)), 1e-9)
    azimuth = np.arccos(np.clip((angle - view * sun) / sines, -1, 1))
    place = [doubles(v[by_day]) for v in (height, np.arccos(sun), np.arccos(view), azimuth)]
    exact = np.stack([v.numpy() for v in earth_sky.rays(*place, ground=False).radiance], axis=-1)
    air = earth_sky.atmosphere
    phases = [p.phase.value(angle).reshape(-1, 1) for p in (air.rayleigh, air.mie[0])]
    found = (tables.rayleigh[at] * phases[0] + tables.mie[at] * phases[1] + tables.higher[at])[by_day]
    error = np.abs(found - exact) / np.maximum(exact, 1e-3 * exact.max(axis=0))
    assert np.percentile(error, 95) < 4e-3 and error.max() < 3e-2
    # The clients put higher orders over Rayleigh's phase function.
    both = (tables.scattering[at] * phases[0] + tables.mie[at] * phases[1])[by_day]
    np.testing.assert_allclose(both, found, rtol=1e-4, atol=1e-7)


def test_black_planet_without_aerosol(earth_sky):
    from atmo_jit.solved import Sky

    bare = Sky({**earth_sky.atmosphere.to_dict(), "mie": None, "ground_albedo": 0}, orders=1)
    tables = bruneton_tables(bare, size=(4, 16, 4, 8))
    assert np.all(tables.mie == 0.0) and np.all(tables.higher == 0.0) and np.any(tables.rayleigh > 0.0)
