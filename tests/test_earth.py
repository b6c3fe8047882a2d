"""The Earth's air at any wavelengths: against the papers' own numbers, and Hulburt's blue hour."""

from __future__ import annotations

import numpy as np
import pytest

from atmo_jit import AtmosphereError, Sky
from atmo_jit.earth import AEROSOLS, earth_at
from atmo_jit.spectrum import SpectralBasis
from atmo_jit.wavelengths import rayleigh_cross_section


def test_rayleigh_is_bodhaines() -> None:
    # Bodhaine et al. 1999, table 3: cross sections (cm^2) at 550 and 400 nm; optical depth at sea level, 45 deg N.
    np.testing.assert_allclose(rayleigh_cross_section([400.0, 550.0]) * 1e4, [1.6735e-26, 4.5102e-27], rtol=2e-3)
    gas = earth_at([550.0], None).rayleigh
    assert gas.scattering_per_m[0] * gas.profile.scale_height_m == pytest.approx(0.0972, rel=0.01)


def test_aerosol_is_opacs() -> None:
    air = earth_at([380.0, 500.0, 550.0, 700.0], "continental_polluted", optical_depth=0.2)
    species = air.mie[0]
    depth = species.extinction_per_m * species.profile.scale_height_m
    assert depth[2] == pytest.approx(0.2)
    exponents = np.diff(np.log(depth)) / -np.diff(np.log(air.wavelengths_nm))
    np.testing.assert_allclose(exponents, [1.13, 1.45, 1.45])
    np.testing.assert_allclose(species.phase.moments(1)[1], AEROSOLS["continental_polluted"].asymmetry)


def test_errors_name_the_argument() -> None:
    with pytest.raises(AtmosphereError, match="aerosol: found 'smog'; allowed: None or one of continental_clean"):
        earth_at([550.0], "smog")
    with pytest.raises(AtmosphereError, match="ozone_du"):
        earth_at([550.0], ozone_du=-1.0)


def test_the_twilight_zenith_is_blue_by_ozone() -> None:
    # Hulburt 1953, J. Opt. Soc. Am. 43, 113: with Rayleigh scattering alone the zenith would turn yellowish while the
    # sun sinks below the horizon; Chappuis absorption keeps it blue. By day ozone hardly matters.
    nm = np.arange(400.0, 701.0, 20.0)

    def chromaticity(ozone_du: float) -> np.ndarray:
        air = earth_at(nm, "continental_clean", ozone_du=ozone_du)
        sun = np.radians([30.0, 96.0])
        light = Sky(air).rays(np.zeros(2), sun, np.zeros(2), np.zeros(2)).radiance
        xyz = np.stack([v.numpy() for v in light], axis=-1) @ SpectralBasis.of(air).xyz_matrix.T
        return xyz[:, :2] / xyz.sum(axis=1, keepdims=True)

    (day, dusk), (day_without, dusk_without) = chromaticity(300.0), chromaticity(0.0)
    assert np.all(dusk < dusk_without - 0.03)  # x and y: bluer
    assert np.abs(day - day_without).max() < 0.01
    assert dusk_without[0] > day_without[0] + 0.02


def test_a_type_of_aerosol_is_what_opac_computes() -> None:
    """OPAC 3.1's own output for continental polluted air at 80 % humidity and 550 nm (IPSL, ether, iasi/aerosol)."""
    kind = AEROSOLS["continental_polluted"]
    found = (kind.extinction_per_m, kind.single_scattering_albedo, kind.asymmetry, kind.optical_depth)
    np.testing.assert_allclose(found, (1.746e-4, 0.8925, 0.6977, 0.3270), rtol=3e-3)
