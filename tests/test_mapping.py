"""The maps of light tables: round trips with edges, values given in the papers' own terms, single precision."""

from __future__ import annotations

import math

import numpy as np
import pytest

from atmo_jit import mapping
from atmo_jit.mapping import Bruneton, Hillaire, Power3D, horizon, texels

# Three planets, none with the Earth's numbers in the code: the preset's, a small one, a thick one.
PLANETS = [(6_360_000.0, 6_420_000.0), (1.0e6, 1.05e6), (6_360_000.0, 6_460_000.0)]
ROUND_TRIP = 1e-6  # of unit coordinates and cosines; float64 leaves 1e-9 at square roots


@pytest.fixture(params=PLANETS, ids=["earth", "small", "thick"])
def planet(request) -> tuple[float, float]:
    return request.param


def grid(*counts: int) -> list[np.ndarray]:
    return [v.ravel() for v in np.meshgrid(*map(texels, counts), indexing="ij")]


def assert_close(got, expected):
    for a, b in zip(got, expected, strict=True):
        np.testing.assert_allclose(a, b, atol=ROUND_TRIP)


def altitudes(planet) -> np.ndarray:
    return (planet[1] - planet[0]) * np.array([0.0, 1e-6, 0.01, 0.3, 0.999, 1.0])


def test_texels_and_texture_coordinates():
    assert texels(5).tolist() == [0.0, 0.25, 0.5, 0.75, 1.0]
    assert texels(4, ends=False).tolist() == [0.125, 0.375, 0.625, 0.875]
    # The first and last texel's centres, at 1/2 texel from the edges, hold 0 and 1.
    u = mapping.texture_coordinate(texels(8), 8)
    np.testing.assert_allclose(u, (np.arange(8) + 0.5) / 8, atol=1e-15)
    np.testing.assert_allclose(mapping.unit_coordinate(u, 8), texels(8), atol=1e-15)


def test_horizon_is_the_tangent(planet):
    bottom, _ = planet
    h = altitudes(planet)
    sine = bottom / (bottom + h)
    np.testing.assert_allclose(horizon(bottom, h), -np.sqrt(1.0 - sine**2), atol=1e-7)
    assert horizon(bottom, np.float64(1.0)) == pytest.approx(-math.sqrt(2.0 / bottom), rel=1e-5)


def test_transmittance_round_trip(planet):
    m = Bruneton(*planet)
    x = grid(64, 256)
    h, mu = m.transmittance_inverse(*x)
    assert h.min() == 0.0 and h.max() == pytest.approx(planet[1] - planet[0], rel=1e-12)
    back = m.transmittance(h, mu)
    inside = x[0] < 1.0  # at the top itself all upward rays have length 0
    assert_close([v[inside] for v in back], [v[inside] for v in x])
    # x_mu: zenith 0, horizon 1.
    assert_close(m.transmittance(h[inside], np.ones(inside.sum())), (x[0][inside], np.zeros(inside.sum())))
    assert_close(m.transmittance(h, horizon(planet[0], h)), (x[0], np.ones(h.size)))


def test_irradiance_round_trip(planet):
    m = Bruneton(*planet)
    x = grid(16, 64)
    assert_close(m.irradiance(*m.irradiance_inverse(*x)), x)


def test_scattering_view_round_trip(planet):
    m = Bruneton(*planet)
    x_r, x_mu = grid(32, 64)
    h, _ = m.transmittance_inverse(x_r, np.zeros_like(x_r))
    for ground in (True, False):
        hits = np.full(h.size, ground)
        mu = m.view_inverse(h, x_mu, hits)
        told = x_r > 0.0 if ground else x_r < 1.0  # a ray of no length has any direction
        # Square roots at the horizon amplify float64's 1e-16: 1e-6 of x is 1e-9 of the range of mu there.
        np.testing.assert_allclose(m.view(h, mu, hits)[told], x_mu[told], atol=ROUND_TRIP)
        edge = horizon(planet[0], h)
        assert np.all((mu <= edge + 1e-9) if ground else (mu >= edge - 1e-9))
        level = told & (x_mu == 1.0)
        assert_close((mu[level],), (edge[level],))
        steepest = -1.0 if ground else 1.0
        assert_close((mu[x_mu == 0.0],), (np.full(np.sum(x_mu == 0.0), steepest),))


def test_scattering_rows_of_a_table_with_128():
    n = 128
    rows = Bruneton.view_row(np.array([0.0, 1.0, 0.0, 1.0]), np.array([True, True, False, False]), n) * n - 0.5
    np.testing.assert_allclose(rows, [63, 0, 64, 127], atol=1e-12)


@pytest.mark.parametrize("lowest_deg", [102.0, 120.0])
def test_scattering_sun_round_trip(planet, lowest_deg):
    m = Bruneton(*planet, mu_s_min=math.cos(math.radians(lowest_deg)))
    x = texels(32)
    mu_s = m.sun_inverse(x)
    assert mu_s[0] == pytest.approx(m.mu_s_min, abs=1e-12) and mu_s[-1] == pytest.approx(1.0, abs=1e-12)
    assert np.all(np.diff(mu_s) > 0)
    assert_close((m.sun(mu_s),), (x,))
    assert m.sun(np.array([-1.0, m.mu_s_min])) == pytest.approx([0.0, 0.0], abs=1e-12)


def test_scattering_angle_round_trip_and_range():
    x, mu, mu_s = grid(8, 9, 9)
    mu, mu_s = 2.0 * mu - 1.0, 2.0 * mu_s - 1.0
    nu = Bruneton.angle_inverse(x, mu, mu_s)
    sines = np.sqrt((1 - mu**2) * (1 - mu_s**2))
    assert np.all(nu >= mu * mu_s - sines - 1e-15) and np.all(nu <= mu * mu_s + sines + 1e-15)
    free = np.abs(2 * x - 1 - mu * mu_s) < sines
    assert free.sum() > 100
    assert_close((Bruneton.angle(nu)[free],), (x[free],))


def test_hillaire_round_trips(planet):
    m = Hillaire(*planet)
    x = grid(32, 32)
    assert_close(m.multiple_scattering(*m.multiple_scattering_inverse(*x)), x)
    x_r, x_mu = (v.ravel() for v in np.meshgrid(texels(64, ends=False), texels(256, ends=False), indexing="ij"))
    assert_close(m.transmittance(*m.transmittance_inverse(x_r, x_mu)), (x_r, x_mu))
    w = texels(32, ends=False)
    assert_close((m.slice(m.slice_inverse(w, 128e3), 128e3),), (w,))


def test_hillaire_sky_view_round_trip(planet):
    m = Hillaire(*planet)
    v, u = (a.ravel() for a in np.meshgrid(texels(108), texels(192), indexing="ij"))
    for h in altitudes(planet):
        mu, cos_phi, ground = m.sky_view_inverse(np.full(v.size, h), v, u)
        assert np.array_equal(ground, v > 0.5)
        # acos at the zenith and the nadir turns float64's 1e-16 into 1e-8.
        assert_close(m.sky_view(np.full(v.size, h), mu, cos_phi, ground), (v, u))
    ends = m.sky_view(np.zeros(3), np.array([1.0, 0.0, -1.0]), np.array([1.0, 0.0, -1.0]), np.array([0, 0, 1], bool))
    assert_close(ends, ([0.0, 0.5, 1.0], [0.0, math.sqrt(0.5), 1.0]))


@pytest.mark.parametrize("about_horizon", [False, True])
@pytest.mark.parametrize("powers", [(0.5, 0.5, 0.5), (0.25, 0.33, 1.0)])
def test_power_round_trip(planet, powers, about_horizon):
    m = Power3D(*planet, *powers, about_horizon=about_horizon)
    x = grid(16, 33, 32)
    h, mu, mu_s = m.inverse(*x)
    assert mu.min() == pytest.approx(-1.0) and mu.max() == pytest.approx(1.0)
    assert_close(m.coordinates(h, mu, mu_s), x)
    level = x[1] == 0.5
    assert_close((mu[level],), (horizon(planet[0], h[level]) if about_horizon else np.zeros(level.sum()),))


@pytest.mark.parametrize("lowest", [-0.3, -1.0, 0.0])
def test_twilight_sun_round_trip(lowest):
    x = texels(50)
    for steepness in (1.0, 4.0, 20.0):
        mu_s = mapping.twilight_sun_inverse(x, lowest, steepness)
        assert mu_s[0] == pytest.approx(lowest, abs=1e-12) and mu_s[-1] == pytest.approx(1.0, abs=1e-12)
        assert_close((mapping.twilight_sun(mu_s, lowest, steepness),), (x,))


def test_half_elevation_round_trip_and_ends():
    mu = np.concatenate([np.linspace(-1, 1, 1001), [1e-9, -1e-9]])
    q = mapping.half_elevation(mu)
    np.testing.assert_allclose(q, np.sin(0.5 * np.arcsin(mu)), atol=1e-12)
    assert_close((mapping.half_elevation_inverse(q),), (mu,))
    assert mapping.half_elevation(np.float64(1.0)) == pytest.approx(mapping.STEEPEST, rel=1e-15)
    x = texels(100)
    for edge, end in ((-0.05, mapping.STEEPEST), (-0.05, -mapping.STEEPEST), (0.0, mapping.STEEPEST)):
        q = mapping.from_horizon_inverse(x, edge, end)
        assert q[0] == edge and q[-1] == pytest.approx(end)
        assert_close((mapping.from_horizon(q, edge, end),), (x,))
    for place, knee in ((0.01, 0.25), (0.3, 0.3), (0.5, 0.6)):
        y = mapping.crowded(x, place, knee)
        assert y[0] == 0.0 and y[-1] == 1.0 and mapping.crowded(place, place, knee) == pytest.approx(knee)
        assert mapping.crowded(0.5 * place, place, knee) == pytest.approx(0.5 * knee)
        assert_close((mapping.crowded_inverse(y, place, knee),), (x,))
    assert_close((mapping.half_azimuth(mapping.half_azimuth_inverse(x)),), (x,))
    assert_close((mapping.half_azimuth_inverse(x),), (np.cos(2 * np.arcsin(x)),))


def test_single_precision_follows_double(planet):
    """The same code on Dr.Jit's float32: inverse in double, forward in single, coordinates within a thousandth."""
    from atmo_jit.backend import floats, types

    bruneton, hillaire, power = Bruneton(*planet), Hillaire(*planet), Power3D(*planet, about_horizon=True)
    x_r, x = grid(16, 33)
    x_r, x = 0.01 + 0.98 * x_r, 0.01 + 0.98 * x
    h, mu = bruneton.transmittance_inverse(x_r, x)

    def check(got, expected, limit=1e-3):
        for a, b in zip(got, expected, strict=True):
            assert np.abs(a.numpy() - b).max() < limit

    check(bruneton.transmittance(floats(h), floats(mu)), (x_r, x))
    for ground in (True, False):
        hits = np.full(h.size, ground)
        told = bruneton.view_inverse(h, x, hits)
        check((bruneton.view(floats(h), floats(told), types().Bool(ground)),), (x,))
    check((bruneton.sun(floats(bruneton.sun_inverse(x))),), (x,))
    for ground, part in ((False, 0.5 * x), (True, 0.5 + 0.5 * x)):
        told, cos_phi, _ = hillaire.sky_view_inverse(h, part, x)
        check(hillaire.sky_view(floats(h), floats(told), floats(cos_phi), types().Bool(ground)), (part, x))
    check(power.coordinates(*map(floats, power.inverse(x_r, x, x))), (x_r, x, x))
    check((mapping.half_elevation(floats(mu)),), (mapping.half_elevation(mu),), 1e-6)
