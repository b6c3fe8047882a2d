"""The parameter ``albedo``: a Mitsuba texture, read at the atmosphere's wavelengths."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from atmo_jit.errors import AtmosphereError


def values(texture: Any, wavelengths_nm: np.ndarray) -> np.ndarray:
    """Reflectance [W] of a texture that does not vary in space, in the current variant.

    Spectral variants evaluate it; in rgb variants a colour that is not grey becomes a smooth spectrum by the same
    model that Mitsuba's spectral variants use for sRGB reflectances (Jakob and Hanika 2019). Raises AtmosphereError
    for a texture that varies in space.
    """
    if texture.is_spatially_varying():
        raise AtmosphereError("albedo", "a texture that varies in space", "a number, a colour or a spectrum")
    si = dr.zeros(mi.SurfaceInteraction3f)
    if not mi.is_spectral:
        colour = np.array(texture.eval(si), dtype=np.float64).ravel()
        if np.ptp(colour) == 0.0:
            return np.full(len(wavelengths_nm), colour[0])
        return _upsampled(colour, wavelengths_nm)
    found = []
    for wavelength in wavelengths_nm:
        si.wavelengths = float(wavelength)
        found.append(float(np.array(texture.eval(si), dtype=np.float64).ravel()[0]))
    return np.array(found)


def _upsampled(colour: np.ndarray, wavelengths_nm: np.ndarray) -> np.ndarray:
    """The sigmoid of a quadratic in wavelength that has this linear sRGB value."""
    if colour.min() < 0.0 or colour.max() > 1.0:
        return colour  # out of range: the caller's check names it
    c = np.array(mi.srgb_model_fetch(mi.ScalarColor3f(*(float(v) for v in colour))), dtype=np.float64)
    x = (c[0] * wavelengths_nm + c[1]) * wavelengths_nm + c[2]
    return 0.5 + 0.5 * x / np.sqrt(1.0 + x * x)
