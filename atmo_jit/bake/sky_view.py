"""The sky of one observer under one sun as a table over elevation and azimuth: some square roots and one packet load
per look-up.

Latitude is split at the horizon and goes with the square root of the distance to it, azimuth with the sine of its half
(Hillaire 2020, section 5.3); in place of the elevation stands the sine of its half, which needs no arc functions.
Cells are those of :mod:`.cells`.

A forward peak would need many cells. So each peaked scatterer has a channel of its own: its single scattering without
phase function, the mean over the wavelengths. At look-up that is multiplied by the phase function and by the colour it
has in the sun's own direction. What it then is wrong elsewhere is part of the other channels, which hold the total
minus this product: exact at the nodes, and smooth, because the difference vanishes where the peak is. All this is made
by :mod:`.node_light`.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from .. import mapping
from ..backend import packet, padded, parameter, types
from .cells import Cells
from .mean_source import view_cosines, view_range
from .node_light import Baked, Nodes, light_at_nodes

SIZE = (96, 80, 64)  # rows above the horizon, rows below, columns
CROWDED = (0.1, 0.9)  # unit latitude below which rows crowd: of an observer some centimetres above the ground, far up
OFF_EDGE = 1e-4  # of the unit latitude: the first rows stand this far off the horizon


class SkyView:
    """Radiance seen from ``altitude_m`` under a sun at ``sun_zenith`` (rad), with the ground's own unless
    ``ground=False``.

    ``source``: a solved Sky, or Tables4D to take the light from. ``size``: rows above the horizon, rows below it,
    columns from the sun's azimuth to the opposite one.
    """

    def __init__(
        self,
        source: Any,
        altitude_m: float,
        sun_zenith: float,
        size: tuple[int, int, int] = SIZE,
        *,
        ground: bool = True,
    ) -> None:
        self.altitude_m, self.sun_zenith, self.size = float(altitude_m), float(sun_zenith), size
        air = source.atmosphere
        up_count, down_count, columns = size
        edge, end = view_range(air.bottom_radius_m, air.thickness_m, np.array(self.altitude_m))
        # Below the horizon light changes with the distance to the ground, and so on the scale of the horizon's dip.
        # Rows crowd up to the geometric middle of that and the whole half. A node lies where their density changes.
        dip = mapping.from_horizon(2.0 * edge, edge, -mapping.STEEPEST)
        place = float(np.clip(1.4 * np.sqrt(dip), *CROWDED))
        knee = max(round((0.45 + 0.55 * place) * (down_count - 1)) / (down_count - 1), place)
        below = mapping.crowded_inverse(mapping.texels(down_count), place, knee)
        x = np.maximum(np.concatenate([mapping.texels(up_count), below]), OFF_EDGE)
        up = np.arange(len(x)) < up_count
        mu = view_cosines(air.bottom_radius_m, air.thickness_m, np.array([[self.altitude_m]]), x, up)[0]
        cos_phi = mapping.half_azimuth_inverse(mapping.texels(columns))
        nodes = Nodes(self.altitude_m, x, mu, up, cos_phi, float(np.cos(sun_zenith)))
        self._edge = parameter(edge)
        self._per_range = (parameter(1.0 / (end - edge)), parameter(1.0 / (edge + mapping.STEEPEST)))
        self._limb = bool(end < mapping.STEEPEST)
        self._steep = (parameter(up_count - 1.0), parameter(knee / place * (down_count - 1.0)))
        flat = (1.0 - knee) / (1.0 - place)
        self._flat = (parameter(up_count - 1.0), parameter(flat * (down_count - 1.0)))
        self._start = (parameter(0.0), parameter((1.0 - flat) * (down_count - 1.0)))
        self._columns = parameter(columns - 1.0)
        self._mu_s, self._sin_s = parameter(np.cos(sun_zenith)), parameter(np.sin(sun_zenith))
        if hasattr(source, "light_at"):
            made = [
                (band.optics, Baked.of(band.optics, nodes, source.light_at(band, nodes, ground)))
                for band in source.bands
            ]
        else:
            made = [(band.optics, light_at_nodes(band, nodes, ground)) for band in source.solutions]
        self._bands = [_Table(*of_band, size) for of_band in made]

    def radiance(self, view_zenith: Any, azimuth: Any) -> list[Any]:
        """W Floats: radiance toward views at these angles (rad), ``azimuth`` from the sun's."""
        t = types()
        sine, cosine = dr.sincos(t.Float(view_zenith))
        sin_phi, cos_phi = dr.sincos(t.Float(azimuth))
        return self.along(sine * cos_phi, sine * sin_phi, cosine)

    def along(self, x: Any, y: Any, z: Any) -> list[Any]:
        """The same for unit vectors with z up and the sun above or below the x axis."""
        # The cosine of elevation from z and not from x and y: both roots are then taken at once.
        up, latitude = self._latitude(z, dr.sqrt(dr.maximum(dr.fma(-z, z, 1.0), 0.0)))
        cos_phi = x * dr.rsqrt(dr.maximum(dr.fma(x, x, y * y), 1e-24))
        column = dr.sqrt(dr.maximum(dr.fma(cos_phi, -0.5, 0.5), 0.0)) * self._columns
        nu = dr.fma(z, self._mu_s, x * self._sin_s)
        row = self._row(up, latitude)
        found = [v for table in self._bands for v in table.at(up, row, column, nu)]
        return [dr.select(up & (latitude > 1.0), 0.0, v) for v in found] if self._limb else found

    def transmittance(self, view_zenith: Any) -> list[Any]:
        """W Floats: transmittance to the ground or out of the air at this view zenith angle (rad)."""
        sine, cosine = dr.sincos(types().Float(view_zenith))
        up, latitude = self._latitude(cosine, sine)
        row = self._row(up, latitude)
        found = [v for table in self._bands for v in table.through(up, row)]
        return [dr.select(up & (latitude > 1.0), 1.0, v) for v in found] if self._limb else found

    def _row(self, up: Any, latitude: Any) -> Any:
        """Fractional row of a half of the table: mapping.crowded of the latitude, with the least arithmetic."""
        x = dr.minimum(latitude, 1.0) if self._limb else latitude
        steep, flat, start = (dr.select(up, *halves) for halves in (self._steep, self._flat, self._start))
        return dr.minimum(x * steep, dr.fma(x, flat, start))

    def _latitude(self, z: Any, across: Any) -> tuple[Any, Any]:
        """Whether a view of sine ``z`` and cosine ``across`` of elevation looks above the horizon, and its unit
        latitude: mapping.from_horizon of mapping.half_elevation, with the least arithmetic."""
        q = dr.fma(z, dr.rsqrt(dr.fma(2.0, across, 2.0)), -self._edge)
        return q >= 0.0, dr.sqrt(dr.abs(q) * dr.select(q >= 0.0, *self._per_range))

    @property
    def nbytes(self) -> int:
        """Bytes of the tables."""
        return sum(table.nbytes for table in self._bands)


class _Table:
    """One band's cells and the rows of its transmittance."""

    def __init__(self, optics: Any, baked: Baked, size: tuple[int, int, int]) -> None:
        self.phases = [optics.phase_function(k) for k in baked.peaks]
        self.channels = optics.channel_count
        self.up, self.down, columns = size
        self.cells = Cells.of(baked.words, self.channels + len(baked.peaks), columns)
        self.colours, self.rows = baked.colours, baked.transmittance
        self.nbytes = self.cells.nbytes + 4 * dr.width(self.rows)

    def _row(self, up: Any, row: Any) -> tuple[Any, Any]:
        """First row of the cell (those below the horizon follow those above), and the fraction."""
        i = types().Int(row)
        return i + dr.select(up, 0, self.up), row - types().Float(i)

    def at(self, up: Any, row: Any, column: Any, nu: Any) -> list[Any]:
        """Radiance per channel at a fractional row of either half and a fractional column."""
        i, y = self._row(up, row)
        j = types().Int(column)
        value = self.cells.at(i, y, j, column - types().Float(j))
        radiance = value[: self.channels]
        for phase, grey, colour in zip(self.phases, value[self.channels :], self.colours, strict=True):
            radiance = [dr.fma(p * grey, shade, v) for p, shade, v in zip(phase(nu), colour, radiance, strict=True)]
        return [dr.maximum(v, 0.0) for v in radiance]

    def through(self, up: Any, row: Any) -> list[Any]:
        t, size = types(), padded(self.channels)
        i, f = self._row(up, row)
        after = dr.minimum(i + 1, dr.select(up, self.up, self.up + self.down) - 1)
        low, high = packet(self.rows, t.UInt(i), size), packet(self.rows, t.UInt(after), size)
        return [dr.lerp(a, b, f) for a, b in zip(low, high, strict=True)][: self.channels]
