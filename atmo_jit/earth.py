"""The Earth's air at any wavelengths, from cross sections and a type of aerosol.

>>> from atmo_jit.earth import earth_at
>>> air = earth_at([440, 550, 680], "desert", ozone_du=250)
>>> round(float(air.mie[0].extinction_per_m[1]) * 1e3, 3)  # 1/km at 550 nm
0.145

- **Rayleigh scattering**: cross section of Bodhaine et al. 1999 (eq. 29) times the number of molecules. Density at the
  ground and column are those of the US Standard Atmosphere 1976 (288.15 K, 1013.25 hPa), which sets the scale height:
  8.43 km.
- **Ozone**: cross section at 233 K (Serdyuchenko et al. 2014) times the column, as a tent from 10 to 40 km.
- **Aerosol**: types of OPAC (Hess, Koepke and Schult 1998, Bull. Am. Meteorol. Soc. 79, 831, table 4): extinction,
  single-scattering albedo, asymmetry and optical depth at 550 nm and 80 % relative humidity, and Angstrom exponents
  from 350 to 500 and from 500 to 800 nm. Extinction follows lambda^-exponent on either side of 500 nm; albedo and
  asymmetry are held at all wavelengths. The scale height is optical depth over extinction, and the phase function that
  of Henyey and Greenstein.
- **Sunlight**: ASTM G173-03, mean over 10 nm.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ._fields import FRACTION, NOT_NEGATIVE, POSITIVE, number, numbers
from .atmosphere import Atmosphere
from .errors import AtmosphereError, shown
from .spectrum import solar_irradiance
from .wavelengths import ozone_cross_section, rayleigh_cross_section

__all__ = ["AEROSOLS", "Aerosol", "earth_at"]

MOLECULES_PER_M3 = 2.546899e25  # at 288.15 K and 1013.25 hPa (Bodhaine et al. 1999, section 2)
MOLECULES_PER_M2 = 2.15e29  # above the ground: 1013.25 hPa / (9.80 m/s^2 x 28.96 g/mol), US Standard Atmosphere 1976
DOBSON_UNIT_PER_M2 = 2.687e20
OZONE_CENTER_M, OZONE_HALF_WIDTH_M = 25e3, 15e3
BOTTOM_RADIUS_M, TOP_RADIUS_M = 6.36e6, 6.46e6


@dataclass(frozen=True)
class Aerosol:
    """A type of aerosol at 550 nm: extinction at the ground (1/m), vertical optical depth, single-scattering albedo,
    asymmetry (mean scattering cosine), Angstrom exponents below and above 500 nm."""

    extinction_per_m: float
    optical_depth: float
    single_scattering_albedo: float
    asymmetry: float
    angstrom: tuple[float, float]

    def relative_extinction(self, wavelengths_nm: Any) -> np.ndarray:
        """Extinction over that at 550 nm: Angstrom's law lambda^-exponent, continuous at 500 nm."""
        nm = np.asarray(wavelengths_nm, float)
        below, above = self.angstrom
        return np.where(nm < 500.0, (nm / 500.0) ** -below * (500.0 / 550.0) ** -above, (nm / 550.0) ** -above)


AEROSOLS = {
    "continental_clean": Aerosol(2.6e-5, 0.064, 0.972, 0.709, (1.10, 1.42)),
    "continental": Aerosol(7.5e-5, 0.151, 0.925, 0.703, (1.11, 1.42)),
    "continental_polluted": Aerosol(1.75e-4, 0.327, 0.892, 0.698, (1.13, 1.45)),
    "urban": Aerosol(3.53e-4, 0.643, 0.817, 0.689, (1.14, 1.43)),
    "desert": Aerosol(1.45e-4, 0.286, 0.888, 0.729, (0.20, 0.17)),
    "maritime": Aerosol(9.0e-5, 0.096, 0.997, 0.772, (0.12, 0.08)),
}
"""OPAC's types by the names that ``earth_at`` takes; "continental" is its average, "maritime" its clean one."""


def earth_at(
    wavelengths_nm: Any,
    aerosol: str | None = "continental",
    *,
    optical_depth: float | None = None,
    angstrom: float | None = None,
    ozone_du: float = 300.0,
    ground_albedo: float = 0.1,
) -> Atmosphere:
    """The Earth's atmosphere described at ``wavelengths_nm`` [W].

    ``aerosol``: one of :data:`AEROSOLS`, or None for clear air. ``optical_depth``: of the aerosol at 550 nm, in place
    of the type's own (the scale height stays). ``angstrom``: its exponent at all wavelengths, in place of the type's.
    ``ozone_du``: ozone column in Dobson units. Raises AtmosphereError, naming the argument.
    """
    nm = numbers(wavelengths_nm, "wavelengths_nm", POSITIVE)
    albedo = number(ground_albedo, "ground_albedo", FRACTION)
    ozone = number(ozone_du, "ozone_du", NOT_NEGATIVE) * DOBSON_UNIT_PER_M2 / OZONE_HALF_WIDTH_M
    return Atmosphere(
        {
            "wavelengths_nm": nm.tolist(),
            "solar_irradiance": solar_irradiance(nm).tolist(),
            "bottom_radius_m": BOTTOM_RADIUS_M,
            "top_radius_m": TOP_RADIUS_M,
            "rayleigh": {
                "scattering_per_m": (MOLECULES_PER_M3 * rayleigh_cross_section(nm)).tolist(),
                "scale_height_m": MOLECULES_PER_M2 / MOLECULES_PER_M3,
            },
            "mie": None if aerosol is None else _species(nm, aerosol, optical_depth, angstrom),
            "ozone": {
                "absorption_per_m": (ozone * ozone_cross_section(nm)).tolist(),
                "center_m": OZONE_CENTER_M,
                "half_width_m": OZONE_HALF_WIDTH_M,
            },
            "ground_albedo": albedo,
        }
    )


def _species(nm: np.ndarray, name: str, optical_depth: float | None, angstrom: float | None) -> Mapping[str, Any]:
    """The ``mie`` object of an aerosol type."""
    if name not in AEROSOLS:
        raise AtmosphereError("aerosol", shown(name), f"None or one of {', '.join(AEROSOLS)}")
    kind = AEROSOLS[name]
    depth = kind.optical_depth if optical_depth is None else number(optical_depth, "optical_depth", NOT_NEGATIVE)
    relative = kind.relative_extinction(nm) if angstrom is None else (nm / 550.0) ** -float(angstrom)
    extinction = kind.extinction_per_m * depth / kind.optical_depth * relative
    return {
        "scattering_per_m": (kind.single_scattering_albedo * extinction).tolist(),
        "single_scattering_albedo": kind.single_scattering_albedo,
        "scale_height_m": kind.optical_depth / kind.extinction_per_m,
        "phase": {"type": "henyey_greenstein", "g": kind.asymmetry},
    }
