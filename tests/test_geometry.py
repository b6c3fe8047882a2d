"""Float32 sphere arithmetic against float64, on planets where careless formulas lose everything."""

import numpy as np
import pytest

import atmo_jit  # noqa: F401  (finds LLVM before Dr.Jit is imported)
from atmo_jit.backend import floats
from atmo_jit.geometry import (
    altitude_along,
    distance_down,
    distance_up,
    hits_ground,
    perigee_altitude,
)

RADII = [1e5, 6.36e6, 7e7]


def exact_altitude(radius, h, mu, distance):
    r = np.longdouble(radius) + h
    return np.sqrt(r * r + 2 * r * np.longdouble(mu) * distance + np.longdouble(distance) ** 2) - radius


@pytest.mark.parametrize("radius", RADII)
def test_altitude_along_keeps_millimetres(radius):
    rng = np.random.default_rng(1)
    top = 0.01 * radius
    h = (top * rng.random(2000) ** 4).astype(np.float32).astype(float)
    mu = rng.uniform(0.0, 1.0, 2000).astype(np.float32).astype(float)
    distance = (rng.random(2000) ** 3 * np.sqrt(2 * radius * top)).astype(np.float32).astype(float)
    ours, _ = altitude_along(floats([radius]), floats(h), floats(mu), floats(distance))
    exact = exact_altitude(radius, h, mu, distance).astype(float)
    assert np.max(np.abs(ours.numpy() - exact) / np.maximum(exact, 1.0)) < 1e-6


@pytest.mark.parametrize("radius", RADII)
def test_crossings_lie_on_their_sphere(radius):
    rng = np.random.default_rng(2)
    h = 0.01 * radius * rng.random(1000)
    mu = rng.uniform(-1.0, 1.0, 1000)
    level = h + 0.005 * radius * rng.random(1000)
    r, start, cosine, target = floats([radius]), floats(h), floats(mu), floats(level)
    up = distance_up(r, start, cosine, target).numpy().astype(float)
    assert np.all(up >= 0.0)
    reached = exact_altitude(radius, h.astype(np.float32), mu.astype(np.float32), up).astype(float)
    assert np.max(np.abs(reached - level)) < 1e-6 * radius
    falls = (mu < 0.0) & hits_ground(r, start, cosine).numpy()
    down = distance_down(r, start, cosine, floats([0.0])).numpy().astype(float)
    ground = exact_altitude(radius, h.astype(np.float32), mu.astype(np.float32), down).astype(float)
    assert falls.sum() > 100
    assert np.max(np.abs(ground[falls])) < 1e-6 * radius


def test_horizon_is_found_from_eye_height():
    """A ray grazing the horizon from 2 m is told from one that hits the ground a second of arc below it."""
    radius, h = 6.36e6, 2.0
    horizon = -np.sqrt(h * (2 * radius + h)) / (radius + h)
    cosines = floats([horizon + 5e-6, horizon - 5e-6])
    assert hits_ground(floats([radius]), floats([h]), cosines).numpy().tolist() == [False, True]
    perigee = perigee_altitude(floats([radius]), floats([h]), cosines).numpy()
    assert perigee[0] > 0.0 > perigee[1]
