"""The presets: complete, valid, and with the numbers that their sources give."""

from __future__ import annotations

import numpy as np
import pytest

from atmo_jit import presets
from atmo_jit.atmosphere import Atmosphere
from atmo_jit.earth import earth_at


@pytest.mark.parametrize("name", presets.NAMES)
def test_presets_are_complete(name):
    air = Atmosphere.load(name)
    assert air.to_dict() == presets.read(name)
    assert len(air.constituents) >= 2 and presets.SOURCES[name]


@pytest.mark.parametrize("kind", ["continental", "maritime", "desert", "urban"])
def test_earths_are_what_their_source_says(kind):
    air = Atmosphere.load(f"earth_{kind}")
    made = earth_at(air.wavelengths_nm, kind)
    for name in made.names():
        np.testing.assert_allclose(air.get(name), made.get(name), rtol=1e-4, err_msg=name)


def test_haze_has_the_optical_depth_it_claims():
    haze = Atmosphere.load("haze")
    altitude, density = (haze.get(f"mie.profile.{name}") for name in ("altitude_m", "density"))
    depth = haze.mie[0].extinction_per_m * np.trapezoid(density, altitude)
    assert depth[1] == pytest.approx(8.1, rel=1e-3)
    np.testing.assert_allclose(depth / depth[1], (haze.wavelengths_nm / 550.0) ** -2, rtol=1e-3)


def test_earth_is_the_block_of_the_manual():
    assert presets.read("earth") == {
        "wavelengths_nm": [680, 550, 440],
        "solar_irradiance": [1.474, 1.8504, 1.91198],
        "bottom_radius_m": 6360000,
        "top_radius_m": 6420000,
        "rayleigh": {"scattering_per_m": [5.802e-6, 13.558e-6, 33.1e-6], "scale_height_m": 8000},
        "mie": {
            "scattering_per_m": [3.996e-6, 3.996e-6, 3.996e-6],
            "single_scattering_albedo": [0.9, 0.9, 0.9],
            "scale_height_m": 1200,
            "phase": {"type": "cornette_shanks", "g": 0.8},
        },
        "ozone": {"absorption_per_m": [6.5e-7, 1.881e-6, 8.5e-8], "center_m": 25000, "half_width_m": 15000},
        "ground_albedo": [0.1, 0.1, 0.1],
        "sun_angular_radius_deg": 0.2678,
    }


def test_mars_has_the_optical_depth_it_claims_and_a_blue_aureole():
    mars = Atmosphere.load("mars")
    dust = mars.mie[0]
    depth = dust.extinction_per_m * dust.profile.scale_height_m
    assert depth[1] == pytest.approx(0.5, rel=1e-3)  # the preset's coefficients have four digits
    forward = dust.scattering_per_m * dust.phase.value(1.0)
    sideways = dust.scattering_per_m * dust.phase.value(0.0)
    assert forward[2] > forward[1] > forward[0] and sideways[2] < sideways[1] < sideways[0]
