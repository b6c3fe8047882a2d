"""The sun lifted by the air: Laplace's series away from the horizon, Bennett's fit on it."""

from __future__ import annotations

import numpy as np
import pytest

from atmo_jit import AtmosphereError, earth_at
from atmo_jit.refraction import REFRACTIVITY, apparent_zenith, bending


def test_away_from_the_horizon_it_is_laplaces() -> None:
    # Laplace's formula (Smart 1977, Textbook on Spherical Astronomy, section 37): no more is known of the air than its
    # scale height H and its refractivity a at the observer:  a (1 - H/R) tan z - a (H/R - a/2) tan^3 z.
    air = earth_at([550.0], None)
    z = np.radians([20.0, 45.0, 60.0, 70.0])
    ratio = air.rayleigh.profile.scale_height_m / air.bottom_radius_m
    tan = np.tan(z)
    laplace = REFRACTIVITY * ((1.0 - ratio) * tan - (ratio - REFRACTIVITY / 2.0) * tan**3)
    np.testing.assert_allclose(bending(air, z), laplace, rtol=5e-4)


def test_on_the_horizon_it_is_bennetts() -> None:
    # Bennett 1982, J. Navigation 35, 255: 34.5' at 0, 24.3' at 1, 9.9' at 5 degrees, for 10 C; here it is 15 C. Its air
    # has a troposphere, in which density falls less than exponentially.
    found = 60.0 * np.degrees(bending(earth_at([550.0]), np.radians([90.0, 89.0, 85.0])))
    np.testing.assert_allclose(found, [34.5, 24.3, 9.9], rtol=0.06)


def test_true_and_apparent_agree() -> None:
    true = np.radians([0.0, 40.0, 85.0, 90.0, 90.5, 92.0])
    seen = apparent_zenith("earth", true, 100.0)
    np.testing.assert_allclose(seen[:5] + bending("earth", seen[:5], 100.0), true[:5], atol=1e-7)
    assert np.all(np.diff(seen) > 0.0) and seen[4] < np.pi / 2 < seen[5]
    with pytest.raises(AtmosphereError, match="altitude_m: found 100000"):
        bending("earth", 1.0, 1e5)


def test_a_disc_on_the_horizon_is_flattened_by_a_sixth():
    radius = 0.2678
    top, bottom = np.degrees(apparent_zenith("earth", np.radians([90.0 - radius, 90.0 + radius])))
    assert (bottom - top) / (2.0 * radius) == pytest.approx(5.0 / 6.0, abs=0.01)
