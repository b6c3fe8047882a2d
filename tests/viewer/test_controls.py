"""What the viewer's sliders make of an atmosphere."""

from __future__ import annotations

import numpy as np
import pytest

from atmo_jit.atmosphere import Atmosphere, AtmosphereError
from atmo_jit.viewer.controls import AEROSOL, ALBEDO, ASYMMETRY, OZONE, changed, controls

EARTH = Atmosphere.load("earth")
TWO = EARTH.replace(
    {
        "mie": [
            {"scattering_per_m": [1e-6, 2e-6, 3e-6], "absorption_per_m": [1e-7, 2e-7, 3e-7], "scale_height_m": 1200,
             "phase": {"type": "cornette_shanks", "g": 0.8}},
            {"scattering_per_m": 2e-6, "single_scattering_albedo": 0.9, "scale_height_m": 3000,
             "phase": {"type": "isotropic"}},
        ],
        "ground_albedo": [0.1, 0.2, 0.6],
    }
)  # fmt: skip


def test_what_is_not_touched_stays():
    assert changed(TWO, {}) == TWO
    assert controls(TWO)[ALBEDO] == pytest.approx(0.3)


def test_values_are_those_of_the_controls():
    values = {AEROSOL: 1e-5, ASYMMETRY: -0.2, OZONE: 3e-6, ALBEDO: 0.7}
    for air in (EARTH, TWO):
        assert controls(changed(air, values)) == pytest.approx(values)


def test_aerosols_keep_their_ratios():
    air = changed(TWO, {AEROSOL: 2 * controls(TWO)[AEROSOL]})
    for after, before in zip(air.mie, TWO.mie, strict=True):
        np.testing.assert_allclose(after.scattering_per_m, 2 * before.scattering_per_m)
        np.testing.assert_allclose(after.single_scattering_albedo, before.single_scattering_albedo)


def test_controls_are_those_that_there_are():
    assert set(controls(EARTH.replace({"mie": None, "ozone": None}))) == {ALBEDO}
    with pytest.raises(AtmosphereError, match="ozone.absorption_per_m'?: found an unknown key"):
        changed(EARTH.replace({"ozone": None}), {OZONE: 1e-6})


@pytest.mark.parametrize(
    "values", [{ASYMMETRY: 1.0}, {ASYMMETRY: "0.5"}, {AEROSOL: 0.0}, {AEROSOL: float("nan")}, {ALBEDO: 1.1}, [0.5]]
)
def test_bad_values_are_refused_with_their_name(values):
    name = next(iter(values)) if isinstance(values, dict) else "parameters"
    with pytest.raises(AtmosphereError, match=f"{name}: found .*; allowed: "):
        changed(EARTH, values)
