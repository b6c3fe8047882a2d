"""Nodes, their maps and the interpolation between them."""

import numpy as np
import pytest

import atmo_jit
from atmo_jit.backend import floats
from atmo_jit.grid import Grid
from atmo_jit.resolution import Resolution

EARTH = atmo_jit.Atmosphere.load("earth")


def grid(**changes):
    return Grid(EARTH, Resolution(**changes))


def test_nodes_span_the_air_and_the_sun_s_way():
    g = grid(altitudes=12, suns=25)
    assert g.h[0] == 0.0 and g.h[-1] == EARTH.thickness_m and np.all(np.diff(g.h) > 0)
    assert g.theta[0] == 0.0 and np.all(np.diff(g.theta) > 0) and np.degrees(g.theta[-1]) > 100
    day, twilight = np.diff(g.theta)[2], np.min(np.diff(g.theta))
    assert day > 3 * twilight
    assert set(np.round(g.h, 3)) <= set(np.round(g.levels, 3))
    assert np.allclose(g.first_theta[::2], g.theta)


def test_locate_finds_the_nodes():
    g = grid(altitudes=12, suns=25, refine=(2, 4))
    level, share = g.locate_altitude(floats(g.levels))
    found = level.numpy() + share.numpy()
    assert found == pytest.approx(np.arange(len(g.levels)), abs=2e-3)
    sun, share = g.locate_sun(floats(np.cos(g.theta)))
    assert sun.numpy() + share.numpy() == pytest.approx(4 * np.arange(25), abs=5e-3)


def test_refinement_is_exact_for_parabolas_and_keeps_parity():
    g = grid(altitudes=12, suns=25, refine=(2, 4))
    x = np.arange(25.0)
    fine = np.arange(97) / 4
    even, odd = g.sun_refinement
    inside = fine < 23  # the last interval goes straight on
    assert (even @ (3 - x**2))[inside] == pytest.approx((3 - fine**2)[inside])
    assert (odd @ (2 * x))[inside] == pytest.approx((2 * fine)[inside])
    assert np.allclose(even.sum(axis=1), 1.0)


def test_a_small_change_of_haze_moves_no_node():
    """Fits change coefficients at every step: what is built on a grid is kept."""
    changed = EARTH.replace({"mie.scattering_per_m": 4.2e-6})
    assert Grid.of(EARTH, Resolution()) is Grid.of(changed, Resolution())
    cloud = EARTH.replace({"mie.scattering_per_m": 4e-3})
    assert Grid.of(EARTH, Resolution()) is not Grid.of(cloud, Resolution())
