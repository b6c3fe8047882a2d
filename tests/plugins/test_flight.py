"""Flights through the air: optical depth against quadrature in double precision, points drawn against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from bench.worlds import WORLDS, world

mi = pytest.importorskip("mitsuba")
dr = pytest.importorskip("drjit")

FOG = world(
    rayleigh=None,
    mie={
        "scattering_per_m": [1e-2, 2e-2, 5e-2],
        "single_scattering_albedo": 1,
        "scale_height_m": 300,
        "phase": {"type": "henyey_greenstein", "g": 0.5},
    },
)
WHITE = world(
    mie={
        "scattering_per_m": [1e-5, 3e-5, 6e-5],
        "single_scattering_albedo": 1,
        "scale_height_m": 1500,
        "phase": {"type": "isotropic"},
    },
)
RNG = np.random.default_rng(11)


def air_of(atmosphere):
    from atmo_jit import Atmosphere
    from atmo_jit.plugins.planet import planet

    loaded = Atmosphere.load(atmosphere)
    channels = None if len(loaded.wavelengths_nm) == 3 else [0, 0, 0]
    parts = planet(loaded, sun_direction=[0, 0, 1], wavelength_rule="channels", channels=channels)
    return loaded, parts["air"].air


def rays(h, mu):
    ray = dr.zeros(mi.Ray3f, len(h))
    sine = np.sqrt((1.0 - mu) * (1.0 + mu))
    ray.o = mi.Point3f(0.0, 0.0, mi.Float(np.float32(h)))
    ray.d = mi.Vector3f(mi.Float(np.float32(sine)), 0.0, mi.Float(np.float32(mu)))
    return ray


def exact_depth(atmosphere, h, mu):
    """Optical depth [3] from altitude ``h`` to the ground or the top, by fine quadrature in double precision."""
    bottom, top = atmosphere.bottom_radius_m, atmosphere.thickness_m
    r = bottom + h
    to_ground = (r * mu) ** 2 - h * (2.0 * bottom + h)
    if mu < 0.0 and to_ground >= 0.0:
        length = -r * mu - np.sqrt(to_ground)
    else:
        length = -r * mu + np.sqrt((r * mu) ** 2 + (top - h) * (2.0 * bottom + top + h))
    x, w = np.polynomial.legendre.leggauss(8)
    edges = [np.linspace(0.0, length, 2001)]
    for k in {k for c in atmosphere.constituents for k in c.profile.kinks_m}:  # where it is not smooth
        root = np.sqrt(max((r * mu) ** 2 + (k - h) * (2.0 * bottom + k + h), 0.0))
        edges.append(np.clip([-r * mu - root, -r * mu + root], 0.0, length))
    edges = np.unique(np.concatenate(edges))
    t = (0.5 * (edges[1:] + edges[:-1]))[:, None] + (0.5 * np.diff(edges))[:, None] * x
    step = t * (2.0 * r * mu + t)
    there = np.clip(h + step / (r + np.sqrt(r * r + step)), 0.0, None)
    weight = 0.5 * np.diff(edges)[:, None] * w
    total = np.zeros(3)
    for c in atmosphere.constituents:
        extinction = c.extinction_per_m if len(c.extinction_per_m) == 3 else np.repeat(c.extinction_per_m[:1], 3)
        total += np.sum(weight * np.asarray(c.profile.density(there))) * extinction
    return total


@pytest.mark.parametrize("name", ["earth", *(n for n in WORLDS if "five" not in n), "fog"])
def test_transmittance_is_that_of_fine_quadrature(rgb, name):
    from atmo_jit.plugins.flight import Airway, flight

    atmosphere, air = air_of("earth" if name == "earth" else FOG if name == "fog" else WORLDS[name])
    h = np.float32(RNG.choice([0.5, 300.0, 4e3, 12e3, 3e4], 60)).astype(np.float64)
    mu = np.float32(np.concatenate([RNG.uniform(-1, 1, 30), RNG.uniform(-0.1, 0.1, 30)])).astype(np.float64)
    ray = rays(h, mu)
    found = np.array(Airway(air, ray).transmittance(flight(air, ray, mi.Float(dr.inf)))).T
    truth = np.exp(-np.stack([exact_depth(atmosphere, *one) for one in zip(h, mu, strict=True)]))
    # What rounding the direction and the altitude in single precision does to grazing rays is not the quadrature's.
    np.testing.assert_allclose(found, truth, rtol=0.0, atol=2e-5)


@pytest.mark.parametrize("world", [WHITE, FOG])
def test_what_does_not_arrive_is_scattered(rgb, world):
    """Without absorption the mean weight of the points drawn is 1 - transmittance, in every channel."""
    from atmo_jit.plugins.flight import Airway, flight

    _, air = air_of(world)
    count = 2**18
    for h, mu in ((0.5, 0.8), (200.0, 0.02), (3e3, -0.3), (20e3, -0.05)):
        ray = rays(np.full(count, h), np.full(count, mu))
        u, v = (mi.Float(RNG.random(count, dtype=np.float32)) for _ in range(2))
        f = flight(air, ray, mi.Float(dr.inf))
        fly = Airway(air, ray).fly(f, mi.UnpolarizedSpectrum(1.0), u, v)
        weight = np.array(fly.weight, dtype=np.float64)
        sigma = weight.std(axis=1) / np.sqrt(count)
        missing = np.abs(weight.mean(axis=1) - (1.0 - np.array(fly.transmittance)[:, 0]))
        assert np.all(missing < 4.5 * sigma + 1e-5), (h, mu, missing, sigma)
        seen = weight.mean(axis=1) > 1e-6
        assert np.all((sigma * np.sqrt(count) < 1.5 * weight.mean(axis=1))[seen])  # no weight is far from the others
        distance = np.array(fly.distance)
        assert np.all((distance >= 0.0) & (distance <= np.array(f.length) * (1.0 + 1e-6)))


def test_where_there_is_no_air(rgb):
    from atmo_jit.plugins.flight import Airway, flight

    _, air = air_of("earth")
    h, mu = np.array([400e3, 400e3, -5.0, -5.0, 2.0]), np.array([0.1, -0.1, -0.5, 1.0, 1.0])
    ray = rays(h, mu)
    reach = mi.Float(dr.inf, dr.inf, dr.inf, dr.inf, 0.0)
    f = flight(air, ray, reach)
    length = np.array(f.length)
    assert length[[0, 1, 2, 4]].tolist() == [0.0, 0.0, 0.0, 0.0] and length[3] > 59e3
    fly = Airway(air, ray).fly(f, mi.UnpolarizedSpectrum(1.0), mi.Float(0.5), mi.Float(0.5))
    for values in (fly.transmittance, fly.weight):
        assert np.all(np.isfinite(np.array(values)))
    assert np.all(np.array(fly.transmittance)[:, [0, 1, 2, 4]] == 1.0)
    assert np.all(np.array(fly.weight)[:, [0, 1, 2, 4]] == 0.0)


def test_the_end_at_the_top_is_reached_from_everywhere(rgb):
    """Ends that are known a little differently must not hold a flight up for ever."""
    from atmo_jit.plugins.flight import Airway, flight

    _, air = air_of("earth")
    count = 200_000
    h, mu = RNG.uniform(0.0, 60e3, count) ** 1.0, RNG.uniform(-1.0, 1.0, count) ** 3
    ray = rays(h, mu)
    found = np.array(Airway(air, ray).transmittance(flight(air, ray, mi.Float(dr.inf))))
    assert np.all((found >= 0.0) & (found <= 1.0))
