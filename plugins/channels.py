"""From W wavelengths to the channels of a Mitsuba variant, and the table look-ups that differ between variants.

- rgb: three channels, linear sRGB; mono: one, the luminance. Both are constant linear maps of the W radiances.
- spectral: the tables keep radiance / solar irradiance at the atmosphere's wavelengths; a look-up interpolates
  between them and multiplies
  with the solar spectrum (:mod:`atmo_jit.spectrum` has the rule, which is the one behind the rgb values too).
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from atmo_jit.spectrum import SpectralBasis, interpolation_weights

from .exposed import number
from .lookup import texture


class Channels:
    """The linear map from W values to table channels in the current variant.

    ``matrix`` [C, W]: channels of a radiance; ``luminance`` [C]: luminance of the channels.
    """

    def __init__(self, basis: SpectralBasis) -> None:
        if mi.is_spectral:
            own = basis.solar_irradiance
            inverse = np.divide(1.0, own, out=np.zeros_like(own), where=own > 0.0)
            order = np.argsort(basis.wavelengths_nm, kind="stable")
            self.matrix = np.diag(inverse)[order]
            self.luminance = (basis.xyz_matrix[1] * own)[order]
            nm = basis.grid_nm
            weights = interpolation_weights(basis.wavelengths_nm[order], nm)
            position = (weights @ np.arange(len(order)) + 0.5) / len(order)
            self.first, self.step = float(nm[0]), float(nm[1] - nm[0])
            self.count = len(nm)
            self.spectrum = texture(np.stack([position, basis.sun(nm)], axis=-1))
        elif mi.is_rgb:
            self.matrix = basis.srgb_matrix
            self.luminance = np.array([0.212671, 0.715160, 0.072169])  # mi.luminance's weights
        else:
            self.matrix = basis.xyz_matrix[1:2]
            self.luminance = np.ones(1)

    def tensor(self, values: list[Any], shape: tuple[int, ...]) -> Any:
        """Table [*shape, C], in spectral variants [*shape, C, 1], from W Dr.Jit Floats.

        Keeps gradients where the solver's types are the variant's.
        """
        trailing = (1,) if mi.is_spectral else ()
        count = len(self.matrix)
        full = (*shape, count, *trailing)
        if type(values[0]) is mi.Float:
            lane = dr.arange(mi.UInt32, int(np.prod(shape)))
            array = dr.zeros(mi.Float, len(lane) * count)
            for c, row in enumerate(self.matrix):
                parts = [number(m) * v for m, v in zip(row, values, strict=True) if m != 0.0]
                dr.scatter(array, sum(parts, dr.zeros(mi.Float, len(lane))), lane * count + c)
            return mi.TensorXf(array, full)
        stacked = np.stack([np.array(v, dtype=np.float64) for v in values], axis=-1) @ self.matrix.T
        return mi.TensorXf(np.ascontiguousarray(stacked.reshape(full), dtype=np.float32))

    def node_luminance(self, tensor: Any) -> np.ndarray:
        """Luminance [rows, columns] of a table, float64."""
        array = np.array(dr.detach(tensor) if dr.is_jit_v(mi.Float) else tensor, dtype=np.float64)
        return array.reshape(*array.shape[:2], len(self.luminance)) @ self.luminance

    def read(self, table: Any, x: Any, y: Any, wavelengths: Any, active: Any) -> Any:
        """Unpolarised spectrum of a table at texture coordinates (x, y)."""
        if not mi.is_spectral:
            values = table.eval(mi.Point2f(x, y), active)
            return mi.UnpolarizedSpectrum(*values) if len(values) == 3 else mi.UnpolarizedSpectrum(values[0])
        result = mi.UnpolarizedSpectrum(0.0)
        for i in range(len(result)):
            at = (wavelengths[i] - self.first + 0.5 * self.step) / (self.step * self.count)
            position, sun = self.spectrum.eval(at, active)
            result[i] = table.eval(mi.Point3f(position, x, y), active)[0] * sun
        return result
