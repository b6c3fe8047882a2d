"""Solved skies that the tests of tables share: clear air, thick haze, planets unlike the Earth."""

from __future__ import annotations

import pytest

from atmo_jit.atmosphere import Atmosphere
from atmo_jit.solved import Sky
from bench.differences import shorter_pieces
from bench.worlds import WORLDS


@pytest.fixture(scope="package")
def earth_sky() -> Sky:
    return Sky("earth")


@pytest.fixture(scope="package")
def hazy_sky() -> Sky:
    """Its rays are cut at twice as many levels: long pieces through haze are up to 0.2 per cent off."""
    with shorter_pieces():
        return Sky(Atmosphere.load("earth").replace({"mie.scattering_per_m": 1e-4, "mie.phase.g": 0.9}))


@pytest.fixture(scope="package")
def small_sky() -> Sky:
    return Sky(WORLDS["small planet"])


@pytest.fixture(scope="package")
def odd_sky() -> Sky:
    """Two aerosols, one in a layer with a step and a tabulated phase function; ozone; five wavelengths in two bands."""
    return Sky(WORLDS["two aerosols, five wavelengths"])
