"""What holds in every atmosphere: a search by hypothesis, a part of the sweep of bench.stress, and energy.

``pytest -m slow tests/stress`` runs more of it, ``python -m bench.stress`` all.
"""

from __future__ import annotations

from random import Random

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from twins import Twin

from bench.extremes import extreme_views, extreme_world
from bench.invariants import returned_light
from bench.stress import ABOUT, COUNTS, Solved, check_derivatives, check_world, sweep, sweep_derivatives
from bench.worlds import world

# By quantity, the worst that is allowed; docs/limits.md has what was found and why.
LIMITS = dict.fromkeys(COUNTS, 0.0) | {
    "transmittance above 1": 0.0,
    "transmittance rises along a ray": 1e-6,
    "mirror symmetry": 1e-3,
    "zero distance": 0.0,
    "reciprocity": 1e-3,
    "additivity": 1e-3,
    "transmittance, twin": 1e-4,
    "adjoint identity": 1e-3,
}


def too_large(errors):
    return {name: float(np.max(errors[name], initial=0.0)) for name in LIMITS.keys() & errors.keys()
            if np.max(errors[name], initial=0.0) > LIMITS[name]}  # fmt: skip


@settings(max_examples=2, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(st.randoms(use_true_random=False))
def test_a_search_for_atmospheres_in_which_something_fails(rng):
    air = extreme_world(rng, widths=(1, 3))
    errors = check_world(air, extreme_views(rng, air, 40), Twin(air), solves=False)
    assert too_large(errors) == {}


# Seeds of bench.stress that failed once: irradiance 0 times infinity in the deepest shadow (4), no air between 9 scale
# heights and the top (12), light behind a cloud of depth 1e5 many times that of the sun (22).
@pytest.mark.parametrize("number", [4, 12, pytest.param(22, marks=pytest.mark.slow)])
def test_atmospheres_that_failed_once(number):
    rng = Random(number)
    air = extreme_world(rng, widths=(1, 3))
    assert too_large(check_world(air, extreme_views(rng, air, 40), Twin(air), solves=False)) == {}


def test_fog_in_one_wavelength_costs_no_more_than_fog():
    """A ramp from fog to nothing over a thousand km, beside a clear wavelength: took minutes for one ray."""
    air = world(
        wavelengths_nm=[550, 450],
        solar_irradiance=1,
        ground_albedo=0.2,
        top_radius_m=5e6,
        rayleigh={"scattering_per_m": [0.0, 0.04], "profile": {"altitude_m": [1e5, 3e6], "density": [1, 0]}},
        mie=None,
    )
    n = 50
    views = {"altitude_m": np.geomspace(1.0, 3e6, n), "view_zenith_deg": np.linspace(80.0, 100.0, n)}
    views |= {"sun_zenith_deg": np.full(n, 50.0), "azimuth_deg": np.zeros(n), "distance_m": np.full(n, np.inf)}
    radiance, transmittance = Solved(air, 1).rays(views)
    assert np.isfinite(radiance).all() and transmittance[:, 0] == pytest.approx(1.0, abs=1e-6)


SLOW_DEPTHS = [pytest.param(depth, marks=pytest.mark.slow) for depth in (20.0, 80.0, 160.0)]


@pytest.mark.parametrize("depth", [1.0, 10.0, 40.0, *SLOW_DEPTHS])
def test_nothing_is_lost_in_white_clouds(depth):
    """A gas over white ground; from depth 20 on a hundred orders would not do."""
    gas = {"scattering_per_m": depth / 5000.0, "scale_height_m": 5000}
    air = world(wavelengths_nm=[550], solar_irradiance=1, rayleigh=gas, mie=None, ground_albedo=1.0)
    assert returned_light(air, Twin(air), azimuths=8, nodes=8) == pytest.approx(1.0, abs=0.002)


@pytest.mark.parametrize("depth", [pytest.param(0.3, marks=pytest.mark.slow), 3.0, *SLOW_DEPTHS, 40.0])
def test_nothing_is_gained_or_lost_in_white_haze(depth):
    """Radiance of one order, made of a few azimuthal harmonics, swings below 0 beside a forward peak: cut off there it
    gained 2 %. Nor is anything lost where it is thick."""
    haze = {
        "scattering_per_m": depth / 2000.0,
        "single_scattering_albedo": 1.0,
        "scale_height_m": 2000,
        "phase": {"type": "henyey_greenstein", "g": 0.85},
    }
    air = world(wavelengths_nm=[550], solar_irradiance=1, rayleigh=None, mie=haze, ground_albedo=1.0)
    assert returned_light(air, Twin(air)) == pytest.approx(1.0, abs=0.002)


@pytest.mark.slow
def test_more_of_the_sweep():
    holds(sweep(5000, first=500, per_world=500))


@pytest.mark.slow
def test_more_derivatives():
    holds(sweep_derivatives(300, first=500))


def holds(tally):
    rows = tally.rows()
    assert {row[0] for row in rows} <= set(ABOUT) and not tally.failed()
    assert [row for row in rows if row[3] > LIMITS.get(row[0], np.inf)] == []


@pytest.mark.slow
def test_derivatives_hold_at_the_ends_too():
    rng = Random(2)
    air = extreme_world(rng, widths=(1, 3))
    errors = check_derivatives(rng, air, extreme_views(rng, air, 10), 3)
    assert too_large(errors) == {}
