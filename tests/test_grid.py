"""Nodes, their maps and the interpolation between them."""

import drjit as dr
import numpy as np
import pytest

import atmo_jit
from atmo_jit.backend import floats, types
from atmo_jit.grid import Grid
from atmo_jit.refinement import Taps
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
    assert set(np.round(g.h, 3)) <= set(np.round(g.levels_at(3), 3))
    assert np.allclose(grid(altitudes=12, suns=25, first_suns=2).first_theta[::2], g.theta)


def test_locate_finds_the_nodes():
    g = grid(altitudes=12, suns=25, refine=2, sun_refine=4)
    level, share = g.locate_altitude(floats(g.levels_at(2)))
    assert level.numpy() + share.numpy() == pytest.approx(np.arange(23), abs=2e-3)
    sun, share = g.locate_sun(floats(np.cos(g.theta)))
    assert sun.numpy() + share.numpy() == pytest.approx(4 * np.arange(25), abs=5e-3)


def test_a_range_of_suns_keeps_the_nodes_of_the_full_grid():
    whole = Grid(EARTH, Resolution())
    part = Grid(EARTH, Resolution(), tuple(np.radians([60.0, 62.0])))
    assert set(part.theta) < set(whole.theta) and len(part.theta) < len(whole.theta)
    assert part.theta[0] < np.radians(60.0) and part.theta[-1] > np.radians(62.0)
    inside = floats(np.cos(part.theta))
    assert part.sun_position(inside).numpy() == pytest.approx(np.arange(len(part.theta)), abs=2e-3)


def test_taps_are_exact_for_quintics_and_keep_parity():
    g = grid(suns=25)
    fine = np.arange(89) / 4  # up to the last but two intervals: beyond the last node the last is repeated
    taps = Taps(g, floats(fine), 25)
    even = taps.sum([3 - _as_float(at) ** 4 / 1e3 for at in taps.at], 1.0)
    odd = taps.sum([2 * _as_float(at) + _as_float(at) ** 5 / 1e4 for at in taps.at], -1.0)
    assert even.numpy() == pytest.approx(3 - fine**4 / 1e3, rel=1e-5, abs=1e-4)
    assert odd.numpy() == pytest.approx(2 * fine + fine**5 / 1e4, rel=1e-5, abs=1e-4)


def test_the_slope_of_the_altitude_coordinate_is_smooth():
    """Light moves with it: derivatives by altitude do."""
    g = grid(altitudes=12)
    h = floats(np.linspace(190.0, 230.0, 81))
    dr.enable_grad(h)
    level, share = g.locate_altitude(h)
    dr.forward(h)
    slopes = dr.grad(share).numpy()
    assert np.all(np.diff(slopes) < 1e-4 * slopes.mean())  # it falls as the air thins, and nowhere rises


def test_nodes_near_the_ground():
    """As many altitudes, more of them in the lowest hundreds of metres."""
    usual, fine = grid(altitudes=18), grid(altitudes=18, near_ground=1.0)
    assert fine.h[1] < usual.h[1] / 4 and len(fine.h) == len(usual.h)


def test_nodes_in_a_layer_that_absorbs():
    """As many altitudes, more of them where the layer is."""
    usual, fine = (grid(altitudes=18, absorbers=share) for share in (0.0, 1.0))
    inside = [np.count_nonzero((g.h > 10e3) & (g.h < 40e3)) for g in (usual, fine)]
    assert inside[1] >= inside[0] + 3 and len(fine.h) == len(usual.h)


def _as_float(index):
    return types().Float(index)


def test_a_small_change_of_haze_moves_no_node():
    """Fits change coefficients at every step: what is built on a grid is kept."""
    changed = EARTH.replace({"mie.scattering_per_m": 4.2e-6})
    assert Grid.of(EARTH, Resolution()) is Grid.of(changed, Resolution())
    cloud = EARTH.replace({"mie.scattering_per_m": 4e-3})
    assert Grid.of(EARTH, Resolution()) is not Grid.of(cloud, Resolution())
