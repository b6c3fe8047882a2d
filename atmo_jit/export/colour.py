"""From an atmosphere's wavelengths to the three channels of a client, and the constants that turn them into luminance.

"samples": the three wavelengths are red, green and blue, as in Bruneton's programs; the client multiplies by constants.
"spectral": radiance at all wavelengths becomes linear sRGB (:class:`atmo_jit.spectrum.SpectralBasis`), which is
luminance up to a factor.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..atmosphere import Atmosphere
from ..errors import InputError
from ..spectrum import SpectralBasis, cie_1931, xyz_to_srgb

COLOURS = ("samples", "spectral")
LUMINOUS_EFFICACY = 683.0  # lm/W at 555 nm
SKY_POWER = -3.0  # of wavelength, what skylight is assumed to do between the three samples (Bruneton 2017)


@dataclass(frozen=True, eq=False)
class Channels:
    """``matrix`` [3, W]: radiance at W wavelengths to three channels; ``solar`` [3]: irradiance of the sun in them;
    ``sun_to_luminance``, ``sky_to_luminance`` [3]: channels to luminance (lm/W nm), for the sun and for the sky."""

    kind: str
    matrix: np.ndarray
    solar: np.ndarray
    sun_to_luminance: np.ndarray
    sky_to_luminance: np.ndarray

    def radiance(self, values: np.ndarray) -> np.ndarray:
        """Channels [..., 3] of light [..., W]; what lies outside of sRGB is brought to its edge."""
        if self.kind == "samples":
            return values
        return np.maximum(values @ self.matrix.T.astype(values.dtype), 0.0)

    def transmittance(self, values: np.ndarray, sun: np.ndarray) -> np.ndarray:
        """Channels of a factor [..., W] to sunlight ``sun`` [W]."""
        if self.kind == "samples":
            return values
        return np.clip(self.radiance(values * sun.astype(values.dtype)) / self.solar.astype(values.dtype), 0.0, 1.0)


def channels(air: Atmosphere, kind: str) -> Channels:
    """The channels of an atmosphere. Raises InputError where its wavelengths do not give red, green and blue."""
    if kind not in COLOURS:
        raise InputError(f"colour: is {kind!r}; must be one of {', '.join(COLOURS)}")
    nm, sun = air.wavelengths_nm, air.solar_irradiance
    if kind == "spectral":
        matrix = SpectralBasis.of(air).srgb_matrix
        factor = np.full(3, LUMINOUS_EFFICACY * cie_1931()[1][:, 1].sum())
        return Channels(kind, matrix, np.maximum(matrix @ sun, 0.0), factor, factor)
    if len(nm) != 3 or not nm[0] > nm[1] > nm[2]:
        shown = ", ".join(f"{v:g}" for v in nm[:8]) + (", ..." if len(nm) > 8 else "")
        raise InputError(
            f"wavelengths_nm: found [{shown}]; allowed with colour samples: three, red before green before blue "
            "(take --colour spectral for others)"
        )
    return Channels(kind, np.eye(3), sun.copy(), *(_luminance_factors(air, power) for power in (0.0, SKY_POWER)))


def _luminance_factors(air: Atmosphere, power: float) -> np.ndarray:
    """Bruneton 2017, ComputeSpectralRadianceToLuminanceFactors: linear sRGB x 683 of a spectrum that goes as sunlight
    times wavelength^power, over its value at each of the three wavelengths."""
    nm, functions = cie_1931()
    spectrum = SpectralBasis.of(air).sun(nm)
    at = air.wavelengths_nm
    relative = spectrum[:, None] / np.maximum(air.solar_irradiance, 1e-30) * (nm[:, None] / at) ** power
    return LUMINOUS_EFFICACY * np.einsum("nc,nc->c", functions @ xyz_to_srgb().T, relative)


def described(colours: Channels, air: Atmosphere) -> dict[str, Any]:
    """What the three channels are, for metadata."""
    if colours.kind == "samples":
        return {"channels": "radiance at three wavelengths", "wavelengthsNm": air.wavelengths_nm.tolist()}
    return {
        "channels": "linear sRGB from a spectral solution; luminance (cd/m^2) = channel x luminancePerUnit",
        "wavelengthsNm": air.wavelengths_nm.tolist(),
        "luminancePerUnit": float(colours.sky_to_luminance[0]),
    }
