"""The presets: complete, valid, and with the numbers that their sources give."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from atmo_jit import presets
from atmo_jit.atmosphere import Atmosphere
from atmo_jit.earth import earth_at
from atmo_jit.optics import Optics


@pytest.mark.parametrize("name", presets.NAMES)
def test_presets_are_complete(name):
    air = Atmosphere.load(name)
    assert air.to_dict() == presets.read(name)
    assert len(air.constituents) >= 2 and presets.SOURCES[name]


@pytest.mark.parametrize("name", presets.NAMES)
def test_presets_need_no_altitudes_in_double_precision(name):
    """Which take a tenth longer."""
    assert Optics(Atmosphere.load(name), np.arange(1)).exact is None


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


PAGE = (Path(__file__).parents[1] / "docs" / "presets.md").read_text(encoding="utf-8")
COMMON = {"wavelengths_nm", "solar_irradiance", "sun_angular_radius_deg"}
"""What the page's head describes for all presets."""


@pytest.mark.parametrize("name", presets.NAMES)
def test_every_value_has_its_source_on_the_page(name):
    head, *sections = re.split(r"^## ", PAGE, flags=re.MULTILINE)
    (section,) = [section for section in sections if f"`{name}`" in section.splitlines()[0]]
    rows = [line.split("|")[1] for line in section.splitlines() if line.startswith("| `")]
    described = {key for row in rows for key in re.findall(r"`(\w+)`", row)}
    assert described == {key for key, value in presets.read(name).items() if value is not None} - COMMON
    assert all(f"`{key}`" in head for key in COMMON)


def test_mars_has_the_gas_it_claims():
    """Carbon dioxide of Sneep and Ubachs 2005: refractivity at 15 C and 1013.25 hPa, King factor; cm^-1."""
    mars = Atmosphere.load("mars")
    wavenumber = 1e7 / mars.wavelengths_nm
    strengths = [5799.25, 120.05, 5.3334, 4.3244, 1.218145e-5]
    poles = [128908.9, 89223.8, 75037.5, 67837.7, 2418.136]
    index = 1 + 1.1427e3 * sum(a / (pole**2 - wavenumber**2) for a, pole in zip(strengths, poles, strict=True))
    lorentz = (index**2 - 1) / (index**2 + 2)
    king = 1.1364 + 25.3e-12 * wavenumber**2
    section = 24 * np.pi**3 * (100 * wavenumber) ** 4 / 2.546899e25**2 * lorentz**2 * king
    per_m3 = 610 / (1.380649e-23 * 210)
    np.testing.assert_allclose(mars.get("rayleigh.scattering_per_m"), section * per_m3, rtol=2e-3)


def test_haze_has_the_gas_it_claims():
    haze = Atmosphere.load("haze")
    air = earth_at(haze.wavelengths_nm, "continental").get("rayleigh.scattering_per_m")
    denser = 1.47 / 1.01325 * 288.15 / 94
    np.testing.assert_allclose(haze.get("rayleigh.scattering_per_m"), denser * np.asarray(air), rtol=2e-3)
