"""From W wavelengths to the variant's channels where there is no table between them (:mod:`.channels` is for those)."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from atmo_jit.atmosphere import Atmosphere
from atmo_jit.spectrum import SpectralBasis

from .channels import Channels
from .exposed import number


class Colours:
    """The colours of an atmosphere's W wavelengths in the current variant, by the rule of the emitter."""

    def __init__(self, atmosphere: Atmosphere) -> None:
        basis = SpectralBasis.of(atmosphere)
        self._channels = Channels(basis)
        matrix = self._channels.matrix
        if mi.is_spectral:
            self._order = [int(i) for i in np.argsort(basis.wavelengths_nm, kind="stable")]
            self._inverse = [number(matrix[i].sum()) for i in range(len(matrix))]
            return
        white = matrix * basis.solar_irradiance
        total = white.sum(axis=1, keepdims=True)
        self._rows = [[number(m) for m in row] for row in matrix]
        self._white = [[number(m) for m in row] for row in white / np.where(total != 0.0, total, 1.0)]

    def of(self, values: list[Any], wavelengths: Any) -> Any:
        """Radiance at the W wavelengths as the variant's spectrum."""
        if mi.is_spectral:
            relative = [values[w] * k for w, k in zip(self._order, self._inverse, strict=True)]
            return self._between(relative, wavelengths, solar=True)
        return self._sum(self._rows, values)

    def white(self, values: list[Any], wavelengths: Any) -> Any:
        """Factors at the W wavelengths as those of white sunlight in the variant's channels."""
        if mi.is_spectral:
            return self._between([values[w] for w in self._order], wavelengths, solar=False)
        return self._sum(self._white, values)

    @staticmethod
    def _sum(rows: list[list[Any]], values: list[Any]) -> Any:
        found = [sum(m * v for m, v in zip(row, values, strict=True)) for row in rows]
        return mi.UnpolarizedSpectrum(*found) if len(found) > 1 else mi.UnpolarizedSpectrum(found[0])

    def _between(self, values: list[Any], wavelengths: Any, solar: bool) -> Any:
        """Interpolated to the wavelengths of the path, times the solar spectrum where ``solar``."""
        c = self._channels
        result = mi.UnpolarizedSpectrum(0.0)
        for i in range(len(result)):
            position, sun = c.spectrum.eval((wavelengths[i] - c.first + 0.5 * c.step) / (c.step * c.count))
            x = position * len(values) - 0.5
            for w, value in enumerate(values):
                result[i] += value * dr.clip(1.0 - dr.abs(x - w), 0.0, 1.0)
            if solar:
                result[i] *= sun
        return result

