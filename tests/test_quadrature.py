"""Rules against integrals in closed form."""

import numpy as np
import pytest

from atmo_jit.quadrature import (
    LOW_HORIZON,
    cosine_interpolation,
    gauss_legendre,
    half_circle,
    running_integral,
    split_directions,
)


@pytest.mark.parametrize("count", [1, 3, 4, 8])
def test_gauss_legendre_is_exact_to_its_degree(count):
    x, w = gauss_legendre(count)
    for power in range(2 * count):
        assert w @ x**power == pytest.approx(1 / (power + 1), rel=1e-13)
    assert abs(w @ x ** (2 * count) - 1 / (2 * count + 1)) > 1e-13  # and not beyond


def test_running_integral_of_polynomials():
    x, _ = gauss_legendre(4)
    at = (0.0, 0.2, 0.5, 1.0)
    matrix = running_integral(4, at)
    for power in range(4):
        assert matrix @ x**power == pytest.approx(np.array(at) ** (power + 1) / (power + 1), abs=1e-13)


@pytest.mark.parametrize("horizon", [0.0, -0.02, 2 * LOW_HORIZON, -0.6])
def test_split_directions_integrate_a_jump_at_the_horizon(horizon):
    mu, weight, facing_up = split_directions(horizon, 9, 6)
    assert weight.sum() == pytest.approx(2.0)
    assert np.all(np.abs(mu) <= 1.0)
    sky = np.where(mu > horizon, 1.0 + 0.5 * mu, 0.2)  # a bright sky over dark ground
    low, high = horizon, 1.0
    exact = (high - low) + 0.25 * (high**2 - low**2) + 0.2 * (low + 1.0)
    assert weight @ sky == pytest.approx(exact, rel=1e-12)
    # A horizontal surface sees mu >= 0 only: integral of mu (1 + mu / 2).
    assert facing_up @ sky == pytest.approx(0.5 + 0.5 / 3.0, rel=1e-9)


def test_half_circle_integrates_cosines():
    phi = half_circle(5)
    for m in range(1, 10):
        assert np.cos(m * phi).mean() == pytest.approx(0.0, abs=1e-13)
    assert abs(np.cos(10 * phi).mean()) == pytest.approx(1.0)


def test_cosine_interpolation_reproduces_a_short_series():
    few, many = half_circle(5), np.linspace(0.0, np.pi, 17)

    def series(phi):
        return 2.0 - 0.7 * np.cos(phi) + 0.3 * np.cos(4 * phi)

    assert cosine_interpolation(5, many) @ series(few) == pytest.approx(series(many), abs=1e-12)
