"""Aerosol from Mie theory: the limit of small particles, a published sphere, and the three forms of phase function."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from atmo_jit import Atmosphere, AtmosphereError, InputError, mie

NM = [680.0, 550.0, 440.0]
DUST = {"median_radius_um": 0.1, "geometric_deviation": 1.6, "refractive_index": 1.53 - 0.005j}
AIR = {"extinction_per_m": 5e-5, "scale_height_m": 2000.0}


@pytest.fixture
def theory() -> None:
    pytest.importorskip("miepython", reason="miepython is not installed (pip install 'atmo-jit[mie]')")


def test_small_particles_are_rayleighs(theory: None) -> None:
    small = {"median_radius_um": 1e-3, "geometric_deviation": 1.0, "refractive_index": 1.5}
    found = mie.species(NM, **small, **AIR, phase="legendre")
    np.testing.assert_allclose(found["scattering_per_m"], 5e-5 * (np.array(NM) / 550.0) ** -4, rtol=1e-3)
    np.testing.assert_allclose(found["phase"]["moments"][:4], [1.0, 0.0, 0.1, 0.0], atol=1e-4)


def test_a_sphere_is_wiscombes(theory: None) -> None:
    # Wiscombe 1979, Mie scattering calculations (NCAR/TN-140+STR), tables: m = 1.5 - i, x = 1: Q_ext 2.336321, Q_sca
    # 0.663454, g 0.192136.
    one = {"median_radius_um": 0.55 / (2.0 * np.pi), "geometric_deviation": 1.0, "refractive_index": 1.5 + 1j}
    found = mie.species([550.0], **one, **AIR, phase="henyey_greenstein")
    np.testing.assert_allclose(found["single_scattering_albedo"], [0.663454 / 2.336321], rtol=1e-5)
    np.testing.assert_allclose(found["phase"]["g"], [0.192136], rtol=1e-5)


def test_three_forms_of_one_phase_function(theory: None) -> None:
    forms = [mie.species(NM, **DUST, **AIR, phase=kind) for kind in mie.PHASES]
    species = [Atmosphere.load("earth").replace({"mie": form}).mie[0] for form in forms]
    assert species[0].extinction_per_m[1] == pytest.approx(5e-5)
    table, series = (s.phase.moments(40) for s in species[:2])
    np.testing.assert_allclose(table, series, atol=2e-3)  # the table is linear between its 400 angles
    assert species[2].phase.moments(1)[1, 1] == pytest.approx(series[1], abs=1e-6)
    np.testing.assert_allclose(species[0].phase.value(0.3), species[1].phase.value(0.3), rtol=0.02)


def test_errors(theory: None, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(AtmosphereError, match="phase: found 'mie'; allowed: one of tabulated, legendre"):
        mie.species(NM, **DUST, **AIR, phase="mie")
    with pytest.raises(AtmosphereError, match="refractive_index: found .*; allowed: one complex number, or 3"):
        mie.species(NM, **(DUST | {"refractive_index": [1.5, 1.4]}), **AIR)
    monkeypatch.setitem(sys.modules, "miepython", None)
    with pytest.raises(InputError, match=r"pip install 'atmo-jit\[mie\]'"):
        mie.species(NM, **DUST, **AIR)
