"""Columns along paths: the NumPy and the traced way agree, and both with closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from atmo_jit import Atmosphere
from atmo_jit.grid import Grid
from atmo_jit.optics import Optics
from atmo_jit.path_weights import _columns, _traced_columns
from atmo_jit.paths import Paths
from atmo_jit.resolution import Resolution
from bench.worlds import WORLDS


@pytest.fixture(scope="module")
def points():
    """Gauss points of three paths: straight up, past a perigee, down to the ground."""
    air = Atmosphere.load(WORLDS["two aerosols, five wavelengths"])
    grid = Grid.of(air, Resolution.suited(air, 0.03))
    paths = Paths.trace(grid, np.array([0.0, 30000.0, 20000.0]), np.array([1.0, -0.05, -1.0]), 2)
    return Optics(air, np.arange(3)), paths.points(3)


def test_traced_columns_are_those_of_numpy(points):
    host, traced = _columns(*points), _traced_columns(*points)
    for name in ("density", "column", "whole"):
        a, b = (np.array(getattr(c, name).numpy()) for c in (host, traced))
        assert np.allclose(a, b, rtol=2e-5, atol=1e-5 * a.max()), name


def test_columns_of_an_exponential(points):
    """Straight up and straight down, H (exp(-h0 / H) - exp(-h1 / H)), to the accuracy of three Gauss points a piece."""
    optics, at = points
    size = 4  # constituents are three: gas, dust, layer
    height, top = optics.constituents[0].profile.scale_height_m, optics.atmosphere.thickness_m
    whole = _columns(optics, at).whole.numpy().reshape(-1, size)
    assert whole[0, 0] == pytest.approx(height * -np.expm1(-top / height), rel=1e-4)
    assert whole[2, 0] == pytest.approx(height * -np.expm1(-20000.0 / height), rel=1e-4)


def test_columns_of_a_tent_and_of_a_change_of_its_place():
    """Straight up, half width times the height, and next to nothing more where the tent moves: Gauss points lie on both
    sides of its corners, wherever those are between two levels."""
    air = Atmosphere.load("earth")
    for centre in (24000.0, 25000.0, 26100.0):
        there = air.replace({"ozone.center_m": centre})
        grid = Grid.of(there, Resolution.suited(there, 0.03))
        paths = Paths.trace(grid, np.zeros(1), np.ones(1), 1)
        whole = _columns(Optics(there, np.arange(3)), paths.points(2)).whole.numpy().reshape(-1, 4)
        assert whole[0, 2] == pytest.approx(15000.0, rel=1e-6)
