"""The rule between an atmosphere's wavelengths and colour: what it promises, and how good three wavelengths are."""

from __future__ import annotations

import warnings

import mitsuba as mi
import numpy as np
import pytest

from atmo_jit.errors import InputError
from atmo_jit.spectrum import (
    SpectralBasis,
    cie_1931,
    interpolation_weights,
    solar_irradiance,
    xyz_to_rgb,
    xyz_to_srgb,
)

PRESET = np.array([680.0, 550.0, 440.0])
# Mitsuba tabulates the colour matching functions at 5 nm, colour-science at 1 nm; their sRGB matrices have 6 and 4
# digits.
MITSUBA = 1e-3


def test_weights_are_an_interpolation() -> None:
    at = np.linspace(360.0, 830.0, 95)
    weights = interpolation_weights(PRESET, at)
    assert weights.min() >= 0.0
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-14)
    np.testing.assert_array_equal(interpolation_weights(PRESET, PRESET), np.eye(3))
    np.testing.assert_array_equal(weights[at > 680.0], np.eye(3)[[0] * np.sum(at > 680.0)])
    rayleigh_and_grey = 2.0 + (at / 500.0) ** -4.0
    inside = (at >= 440.0) & (at <= 680.0)
    found = weights @ (2.0 + (PRESET / 500.0) ** -4.0)
    np.testing.assert_allclose(found[inside], rayleigh_and_grey[inside], rtol=1e-14)


@pytest.mark.parametrize("wavelengths", [[550.0], [440.0, 550.0, 680.0], np.arange(380.0, 781.0, 20.0)], ids=len)
def test_constant_spectrum_is_mitsubas(rgb: None, wavelengths: np.ndarray) -> None:
    wavelengths = np.asarray(wavelengths)
    basis = SpectralBasis(wavelengths, np.ones(len(wavelengths)))
    constant = mi.load_dict({"type": "constant", "radiance": {"type": "spectrum", "value": 1.0}})
    theirs = np.array(constant.eval(mi.SurfaceInteraction3f())).ravel()
    np.testing.assert_allclose(basis.to_srgb(np.ones(len(wavelengths))), theirs, atol=MITSUBA)
    np.testing.assert_allclose(basis.xyz_matrix[1].sum(), 1.0, rtol=1e-12)


def test_sun_passes_through_the_atmospheres_values() -> None:
    basis = SpectralBasis.of("earth")
    np.testing.assert_allclose(basis.sun(PRESET), basis.solar_irradiance, rtol=1e-12)
    np.testing.assert_allclose(basis.matrix(PRESET), np.eye(3), atol=1e-12)
    assert solar_irradiance(250.0) == 0.0
    # ASTM G173-03: the band 505-515 nm carries 19.2 W m^-2.
    np.testing.assert_allclose(solar_irradiance(510.0), 1.92, rtol=0.02)


def test_beyond_the_visible_and_without_light() -> None:
    basis = SpectralBasis(np.array([350.0, 1050.0]), np.array([0.0, 0.6]))
    assert np.all(np.isfinite(basis.srgb_matrix))
    assert basis.grid_nm[0] == 350.0 and basis.grid_nm[-1] == 1050.0


def test_three_wavelengths_against_the_spectrum(reference) -> None:
    # The figures in the module's text. Spectra by Bouguer's law and single scattering, Rayleigh + grey aerosol + ozone.
    table = np.genfromtxt(reference / "spectra_10nm.csv", delimiter=",", comments="#")
    table = table[np.isfinite(table).all(axis=1)]
    nm, functions = cie_1931()
    sun, cross_section = solar_irradiance(nm), np.interp(nm, table[:, 0] + 5.0, table[:, 2])
    rayleigh, aerosol = 0.2648 * (nm / 440.0) ** -4.0, 0.0053
    ozone = cross_section * 300.0 * 2.687e20

    def error(spectrum: np.ndarray, wavelengths: np.ndarray) -> np.ndarray:
        """Error of the three channels, relative to the brightest one."""
        truth = xyz_to_srgb() @ (functions.T @ spectrum) / functions[:, 1].sum()
        basis = SpectralBasis(wavelengths, np.interp(wavelengths, nm, sun))
        return (basis.to_srgb(np.interp(wavelengths, nm, spectrum)) - truth) / truth.max()

    def direct(air_mass: float) -> np.ndarray:
        return sun * np.exp(-air_mass * (rayleigh + aerosol + ozone))

    def sky(air_mass: float) -> np.ndarray:
        depth = air_mass * (rayleigh + aerosol)
        return sun * (0.06 * rayleigh + 0.1 * aerosol) * -np.expm1(-depth) / depth * np.exp(-air_mass * ozone)

    for air_mass in (0.5, 1.0, 2.0):
        assert np.abs(error(sky(air_mass), PRESET)).max() < 0.05
    assert error(direct(1.0), PRESET)[0] == pytest.approx(0.02, abs=0.01)
    assert error(direct(10.0), PRESET)[0] == pytest.approx(0.27, abs=0.02)
    ten = np.linspace(400.0, 700.0, 10)
    for spectrum in (sky(1.0), sky(5.0), direct(1.0), direct(10.0)):
        assert np.abs(error(spectrum, ten)).max() < 0.02


@pytest.mark.parametrize("space, theirs", [("srgb", "sRGB"), ("rec2020", "ITU-R BT.2020"), ("acescg", "ACEScg")])
def test_colour_spaces_are_those_of_colour_science(space: str, theirs: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import colour
    sky = np.array([0.25, 0.3, 0.62])
    d65 = colour.CCS_ILLUMINANTS["CIE 1931 2 Degree Standard Observer"]["D65"]
    found = colour.XYZ_to_RGB(sky, theirs, illuminant=d65, chromatic_adaptation_transform="Bradford")
    np.testing.assert_allclose(xyz_to_rgb(space) @ sky, found, atol=2e-4)  # their sRGB has four digits
    with pytest.raises(InputError, match="space: is 'rgb'; must be one of srgb, rec2020, acescg"):
        xyz_to_rgb("rgb")


def test_white_balance_makes_the_named_light_grey() -> None:
    basis = SpectralBasis.of("earth")
    sun = basis.solar_irradiance * [0.9, 0.8, 0.6]
    for space in ("srgb", "rec2020", "acescg"):
        grey = basis.to_rgb(sun, space, white=sun)
        np.testing.assert_allclose(grey, basis.xyz_matrix[1] @ sun, rtol=2e-4)
    assert np.ptp(basis.to_rgb(sun)) > 0.1
