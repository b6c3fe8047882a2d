"""Cross sections, and an atmosphere at other wavelengths than it was described at.

Values are interpolated as ratios to spectra of known shape, so that three wavelengths are enough to know the rest:
Rayleigh scattering as a ratio to Bodhaine et al. 1999, eq. 29; ozone to its absorption cross section at 233 K
(Serdyuchenko et al. 2014). Sunlight is ASTM G173-03 times the mean ratio of the given values to it, since values that
stand for broad bands are off it by some per cent each. Everything else is linear in the wavelength, aerosol
coefficients in the logarithm of both. Beyond the given wavelengths the ratios are held.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .atmosphere import Atmosphere
from .errors import InputError, shown
from .spectrum import FAST_NM, solar_irradiance

# Mean over 10 nm from each of 360, 370, ... 830 nm, 1e-27 m^2: Serdyuchenko et al. 2014, as in Bruneton's
# precomputed_atmospheric_scattering (2017), demo.cc.
_OZONE = (
    1.18, 0.2182, 0.2818, 0.6636, 1.527, 2.763, 5.52, 8.451, 15.82, 23.16, 36.69, 49.24, 77.52, 90.16, 148.0, 160.2,
    213.9, 275.5, 309.1, 350.0, 426.6, 467.2, 439.8, 470.1, 501.9, 430.5, 374.0, 321.5, 266.2, 223.8, 185.2, 147.3,
    120.9, 94.23, 74.55, 65.66, 51.05, 41.5, 42.28, 32.37, 24.51, 28.01, 25.34, 16.24, 14.65, 20.78, 13.83, 7.105,
)  # fmt: skip


def rayleigh_cross_section(wavelengths_nm: Any) -> np.ndarray:
    """Scattering cross section of a molecule of dry air (m^2) at ``wavelengths_nm``; shape as given.

    Bodhaine et al. 1999, eq. 29: 360 ppm CO2, within 0.1 % of their theory from 250 to 850 nm.
    """
    square = (np.asarray(wavelengths_nm, float) * 1e-3) ** 2
    above = 1.0455996 - 341.29061 / square - 0.90230850 * square
    return 1e-32 * above / (1.0 + 0.0027059889 / square - 85.968563 * square)


def ozone_cross_section(wavelengths_nm: Any) -> np.ndarray:
    """Absorption cross section of an ozone molecule at 233 K (m^2) at ``wavelengths_nm``; shape as given.

    Serdyuchenko et al. 2014 as means over 10 nm, linear in between; the last value held outside of 365 to 835 nm.
    """
    return 1e-27 * np.interp(np.asarray(wavelengths_nm, float), 365.0 + 10.0 * np.arange(len(_OZONE)), _OZONE)


def chosen(text: str, name: str) -> list[float]:
    """Wavelengths (nm) by a word of options: "fast", the four that give colours nearly as forty do
    (spectrum.FAST_NM), or numbers with commas between. Raises InputError under ``name``."""
    try:
        nm = list(FAST_NM[4]) if text == "fast" else [float(part) for part in text.split(",")]
    except ValueError:
        nm = []
    if not nm or not all(0.0 < v < math.inf for v in nm):
        raise InputError(f"{name}: found {shown(text)}; allowed: fast, or numbers > 0 (nm) with commas between")
    return nm


def at_wavelengths(atmosphere: Atmosphere, wavelengths_nm: Any) -> Atmosphere:
    """``atmosphere`` described at ``wavelengths_nm`` [W]; itself where these are its own."""
    nm = np.asarray(wavelengths_nm, float)
    own = atmosphere.wavelengths_nm
    if np.array_equal(nm, own):
        return atmosphere
    order = np.argsort(own)
    x = own[order]

    def linear(values: Any) -> list[float]:
        return np.interp(nm, x, np.broadcast_to(values, own.shape)[order]).tolist()

    def like(values: np.ndarray, shape: Any) -> list[float]:
        ratio = np.asarray(values) / shape(own)
        return (np.interp(nm, x, ratio[order]) * shape(nm)).tolist()

    def logarithmic(values: np.ndarray) -> list[float]:
        if not np.all(values > 0.0):
            return linear(values)
        return np.exp(np.interp(np.log(nm), np.log(x), np.log(values[order]))).tolist()

    document = atmosphere.to_dict()
    document["wavelengths_nm"] = nm.tolist()
    document["solar_irradiance"] = _sunlight(atmosphere, nm).tolist()
    document["ground_albedo"] = linear(atmosphere.ground_albedo)
    if atmosphere.rayleigh is not None:
        document["rayleigh"]["scattering_per_m"] = like(atmosphere.rayleigh.scattering_per_m, rayleigh_cross_section)
    if atmosphere.ozone is not None:
        document["ozone"]["absorption_per_m"] = like(atmosphere.ozone.absorption_per_m, ozone_cross_section)
    species = document["mie"] if isinstance(document["mie"], list) else [document["mie"]]
    for described, constituent in zip(species, atmosphere.mie, strict=False):
        described["scattering_per_m"] = logarithmic(constituent.scattering_per_m)
        if "absorption_per_m" in described:
            described["absorption_per_m"] = logarithmic(constituent.absorption_per_m)
        else:
            described["single_scattering_albedo"] = linear(constituent.single_scattering_albedo)
        g = described["phase"].get("g")
        if isinstance(g, list):
            described["phase"]["g"] = linear(np.asarray(g))
    return Atmosphere(document)


def _sunlight(atmosphere: Atmosphere, nm: np.ndarray) -> np.ndarray:
    own, given = atmosphere.wavelengths_nm, atmosphere.solar_irradiance
    if np.ptp(given) == 0.0:
        return np.full(nm.shape, given[0])
    reference = solar_irradiance(own)
    if not np.all(reference > 0.0):  # no shape is known there
        order = np.argsort(own)
        return np.interp(nm, own[order], given[order])
    sunlight = solar_irradiance(nm) * np.mean(given / reference)
    for value, at in zip(given, own, strict=True):
        sunlight[nm == at] = value
    return sunlight
