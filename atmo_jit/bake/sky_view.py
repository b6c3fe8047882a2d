"""The sky of one observer under one sun as a table over elevation and azimuth: two square roots and one packet load per
look-up.

Latitude is split at the horizon and goes with the square root of the distance to it, azimuth with the sine of its half
(Hillaire 2020, section 5.3); in place of the elevation stands the sine of its half, which needs no arc functions. A
cell holds its four corners side by side in half precision.

A forward peak would need many cells. So each peaked scatterer has a channel of its own: its single scattering without
phase function, the mean over the wavelengths. At look-up that is multiplied by the phase function and by the colour it
has in the sun's own direction. What it then is wrong elsewhere is part of the other channels, which hold the total
minus this product: exact at the nodes, and smooth, because the difference vanishes where the peak is.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from .. import mapping
from ..backend import floats, packet, padded, parameter, types, uints
from ..phase import Isotropic, RayleighPhase
from ..sky import Sky
from .mean_source import MeanSource, view_cosines, view_range
from .sightlines import Sightlines, Sunlight

SIZE = (96, 48, 64)  # rows above the horizon, rows below, columns
OFF_EDGE = 1e-4  # of the unit latitude: the first rows stand this far off the horizon
LARGEST_HALF = 3e4  # tables are scaled to this: half precision then is exact to 0.05 % over nine decades


class SkyView:
    """Radiance of the solved ``sky`` seen from ``altitude_m`` under a sun at ``sun_zenith`` (rad), ground included.

    ``size``: rows above the horizon, rows below it, columns from the sun's azimuth to the opposite one.
    """

    def __init__(self, sky: Sky, altitude_m: float, sun_zenith: float, size: tuple[int, int, int] = SIZE) -> None:
        self.sky, self.altitude_m, self.sun_zenith, self.size = sky, altitude_m, sun_zenith, size
        air = sky.atmosphere
        up_count, down_count, columns = size
        h = np.array([float(altitude_m)])
        edge, end = view_range(air.bottom_radius_m, air.thickness_m, h)
        x = np.maximum(np.concatenate([mapping.texels(up_count), mapping.texels(down_count)]), OFF_EDGE)
        up = np.arange(len(x)) < up_count
        mu = view_cosines(air.bottom_radius_m, air.thickness_m, h[:, None], x, up)[0]
        cos_phi = mapping.half_azimuth_inverse(mapping.texels(columns))
        self._edge, self._end = parameter(edge[0]), parameter(end[0])
        self._ends_above = parameter(2.0 if end[0] == mapping.STEEPEST else 1.0)
        self._up, self._down = parameter(up_count - 1.0), parameter(down_count - 1.0)
        self._columns = parameter(columns - 1.0)
        self._mu_s, self._sin_s = parameter(np.cos(sun_zenith)), parameter(np.sin(sun_zenith))
        self._bands = [self._bake(band, h, x, up, mu, cos_phi) for band in sky.bands]

    def _bake(
        self, band: Any, h: np.ndarray, x: np.ndarray, up: np.ndarray, mu: np.ndarray, cos_phi: np.ndarray
    ) -> _Table:
        optics = band.optics
        channels, shape = optics.channel_count, (len(mu), len(cos_phi))
        lines = Sightlines(optics, np.full(len(mu), h[0]), mu)
        ray = uints(np.repeat(np.arange(shape[0]), shape[1]))
        mu_s, sin_s = np.cos(self.sun_zenith), np.sin(self.sun_zenith)
        sun, across = floats(np.full(shape, mu_s)), floats(np.broadcast_to(sin_s * cos_phi, shape))
        nu = lines.nu(ray, sun, across)
        single = _arrays(lines.single(Sunlight(optics, band.columns), ray, sun, across, nu), shape)
        total = np.stack([g.numpy().reshape(shape) for g in lines.ground_light(band, ray, sun, across)], axis=-1)
        if band.source is not None:
            whole = lines.scattering.reshape(1, *lines.scattering.shape)
            series = MeanSource(band, np.array([mu_s]), h).along(h, x[None], up, whole)[0, :, 0]
            m = np.arange(series.shape[1])[:, None]
            total = total + np.einsum("vmc,mp->vpc", series, np.cos(m * np.arccos(np.clip(cos_phi, -1.0, 1.0))))
        peaks, colours = [], []
        for n, k in enumerate(optics.scatterers):
            phase = optics.phase_values(k, nu)
            dr.eval(phase)
            value = np.stack([np.broadcast_to(p.numpy(), nu.shape).reshape(shape) for p in phase], axis=-1)
            total = total + single[n] * value
            if not isinstance(optics.constituents[k].phase, RayleighPhase | Isotropic):
                grey = single[n].mean(axis=-1)
                toward_sun = grey[:, :1]
                colour = np.divide(single[n][:, 0], toward_sun, out=np.zeros((shape[0], channels)), where=toward_sun > 0)
                total = total - grey[..., None] * colour[:, None] * value
                peaks.append((k, grey))
                colours.append(colour)
        values = np.concatenate([total, *(grey[..., None] for _, grey in peaks)], axis=-1)
        return _Table(optics, values, self.size, [k for k, _ in peaks], colours, lines.transmittance)

    def radiance(self, view_zenith: Any, azimuth: Any) -> list[Any]:
        """W Floats: radiance toward views at these angles (rad), ``azimuth`` from the sun's."""
        t = types()
        sine, cosine = dr.sincos(t.Float(view_zenith))
        sin_phi, cos_phi = dr.sincos(t.Float(azimuth))
        return self.along(sine * cos_phi, sine * sin_phi, cosine)

    def along(self, x: Any, y: Any, z: Any) -> list[Any]:
        """The same for unit vectors: z up, x toward the sun's azimuth."""
        across = dr.sqrt(dr.fma(x, x, y * y))
        q, up, latitude = self._latitude(z, across)
        row = latitude * dr.select(up, self._up, self._down)
        column = mapping.half_azimuth(x / dr.maximum(across, 1e-12)) * self._columns
        nu = dr.fma(z, self._mu_s, x * self._sin_s)
        beyond = up & (latitude > self._ends_above)
        return [v for table in self._bands for v in table.at(up, row, column, nu, ~beyond)]

    def transmittance(self, view_zenith: Any) -> list[Any]:
        """W Floats: transmittance to the ground or out of the air at this view zenith angle (rad)."""
        t = types()
        sine, cosine = dr.sincos(t.Float(view_zenith))
        _, up, latitude = self._latitude(cosine, sine)
        row = latitude * dr.select(up, self._up, self._down)
        beyond = up & (latitude > self._ends_above)
        return [dr.select(beyond, 1.0, v) for table in self._bands for v in table.through(up, row)]

    def _latitude(self, z: Any, across: Any) -> tuple[Any, Any, Any]:
        q = z * dr.rsqrt(dr.fma(2.0, across, 2.0))
        up = q >= self._edge
        end = dr.select(up, self._end, -mapping.STEEPEST)
        return q, up, dr.sqrt(dr.maximum((q - self._edge) / (end - self._edge), 0.0))

    @property
    def nbytes(self) -> int:
        """Bytes of the tables."""
        return sum(table.nbytes for table in self._bands)


class _Table:
    """One band's cells and the rows of its transmittance."""

    def __init__(
        self,
        optics: Any,
        values: np.ndarray,
        size: tuple[int, int, int],
        peaks: list[int],
        colours: list[np.ndarray],
        transmittance: np.ndarray,
    ) -> None:
        self.optics, self.peaks = optics, peaks
        self.channels = optics.channel_count
        self.count = 1 << (values.shape[-1] - 1).bit_length()
        self.up, self.down, self.columns = size
        largest = float(np.abs(values).max())
        scale = LARGEST_HALF / largest if largest > 0.0 else 1.0
        self.unit = parameter(1.0 / scale)
        corner = np.zeros((*values.shape[:2], self.count), dtype=np.float16)
        corner[..., : values.shape[-1]] = values * scale
        cells = np.concatenate([corner[:-1, :-1], corner[:-1, 1:], corner[1:, :-1], corner[1:, 1:]], axis=-1)
        t = types()
        self.cells = t.Float16(np.ascontiguousarray(cells).ravel())
        extra = ((0, 0), (0, padded(self.channels) - self.channels))
        self.rows, *self.colours = [floats(np.pad(rows, extra)) for rows in (transmittance, *colours)]
        dr.eval(self.cells, self.rows, self.colours)
        self.nbytes = 2 * dr.width(self.cells) + 4 * (1 + len(peaks)) * dr.width(self.rows)

    def _row(self, up: Any, row: Any) -> tuple[Any, Any]:
        """First row of the cell (those below the horizon follow those above), and the fraction."""
        t = types()
        i = dr.minimum(t.Int(row), dr.select(up, self.up - 2, self.down - 2))
        return i + dr.select(up, 0, self.up), dr.minimum(row - t.Float(i), 1.0)

    def at(self, up: Any, row: Any, column: Any, nu: Any, active: Any) -> list[Any]:
        t = types()
        i, fy = self._row(up, row)
        j = dr.minimum(t.Int(column), self.columns - 2)
        fx = column - t.Float(j)
        n = self.count
        cell = t.UInt(i * (self.columns - 1) + j)
        c = [t.Float(v) for v in dr.gather(t.ArrayXf16, self.cells, cell, active, shape=(4 * n, dr.width(cell)))]
        used = self.channels + len(self.peaks)
        value = [
            self.unit * dr.lerp(dr.lerp(c[k], c[n + k], fx), dr.lerp(c[2 * n + k], c[3 * n + k], fx), fy)
            for k in range(used)
        ]
        radiance = value[: self.channels]
        for k, grey, colour in zip(self.peaks, value[self.channels :], self.colours, strict=True):
            phase = self.optics.phase_values(k, nu)
            shades = self._between_rows(colour, i, fy)
            radiance = [dr.fma(p * shade, grey, v) for p, shade, v in zip(phase, shades, radiance, strict=True)]
        return [dr.maximum(v, 0.0) for v in radiance]

    def through(self, up: Any, row: Any) -> list[Any]:
        return self._between_rows(self.rows, *self._row(up, row))

    def _between_rows(self, rows: Any, i: Any, f: Any) -> list[Any]:
        t, size = types(), padded(self.channels)
        low, high = packet(rows, t.UInt(i), size), packet(rows, t.UInt(i + 1), size)
        return [dr.lerp(a, b, f) for a, b in zip(low, high, strict=True)][: self.channels]


def _arrays(parts: list[list[Any]], shape: tuple[int, ...]) -> list[np.ndarray]:
    """[scatterer] float32 arrays of ``shape`` and channels."""
    return [np.stack([c.numpy().reshape(shape) for c in kind], axis=-1) for kind in parts]

