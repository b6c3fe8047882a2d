"""Light of the orders after the first along many view rays, from few.

What a ray gathers of them is, per scatterer, the integral of its scattering along the ray (``Sightlines.scattering``)
times a mean of the light scattered there. That mean changes slowly with altitude, elevation and azimuth, however
sharp the horizon is: polynomials through Chebyshev nodes and a cosine series give it everywhere.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from .. import mapping
from ..backend import floats, packet, padded, stored, types, uints
from ..optics import Optics
from ..quadrature import half_circle
from .sightlines import Sightlines

ALTITUDES = 8
# Nodes above and below the horizon and in azimuth at least; the latter where altitudes share them.
LEAST, LEAST_COARSE = (16, 10, 8), (12, 8, 6)
STRETCHES = 8
COARSE_DEGREE = 9  # of tables over all suns and altitudes


class MeanSource:
    """Means for the suns ``mu_s`` [S], at Chebyshev nodes from the ground to the top; all sums are kernels.

    NumPy's products of matrices would do too, but they wait for each other where other programs run: several times as
    long as they take alone.
    """

    def __init__(self, band: Any, mu_s: np.ndarray) -> None:
        t, self.optics = types(), band.optics
        air, suns = self.optics.atmosphere, len(mu_s)
        self.thickness, self.suns = air.thickness_m, suns
        self.up, down, self.azimuths = counts(min(band.field.degree, COARSE_DEGREE), LEAST_COARSE)
        azimuths = self.azimuths
        h = self.thickness * chebyshev_nodes(ALTITUDES) ** 2
        x, up = places(self.up, down)
        self.count = len(x)
        mu = view_cosines(air.bottom_radius_m, self.thickness, h[:, None], x, up)
        lines = Sightlines(self.optics, np.repeat(h, len(x)), mu.ravel(), stretches=STRETCHES)
        lane = dr.arange(t.UInt, mu.size * suns * azimuths)
        rest = lane // azimuths
        sun = dr.gather(t.Float, floats(mu_s), rest % suns)
        sin_s = dr.gather(t.Float, floats(np.sqrt((1.0 - mu_s) * (1.0 + mu_s))), rest % suns)
        across = sin_s * dr.gather(t.Float, floats(np.cos(half_circle(azimuths))), lane % azimuths)
        self._mean = means(lines, band.source, rest // suns, sun, across)

    def along(self, h: np.ndarray, x: np.ndarray, up: np.ndarray, scattering: Any) -> Series:
        """Cosine series in azimuth of the radiance along rays, [A x V x S] rows.

        ``h`` [A] (m); ``x`` [A, V]: place between the horizon (0) and zenith or nadir (1) as in :func:`view_cosines`,
        ``up`` [V] or [A, V]: which of the two; ``scattering``: Sightlines.scattering_table of these rays.
        """
        t, azimuths, count, suns = types(), self.azimuths, self.count, self.suns
        place = floats(chebyshev_matrix(ALTITUDES, np.sqrt(np.clip(h / self.thickness, 0.0, 1.0))))
        series, mean = floats(cosine_series(azimuths)), self._mean
        width = row_length(self.optics)
        lane = dr.arange(t.UInt, len(h) * count * suns * azimuths)
        order, rest = lane % azimuths, lane // azimuths
        altitude, place_in = rest // (count * suns), rest % (count * suns)

        def sample(i: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
            node = i // azimuths
            j = i - node * azimuths
            weight = dr.gather(t.Float, place, dr.fma(altitude, ALTITUDES, node))
            weight *= dr.gather(t.Float, series, dr.fma(order, azimuths, j))
            here = packet(mean, (node * (count * suns) + place_in) * azimuths + j, width)
            return i + 1, [dr.fma(weight, a, b) for a, b in zip(here, sums, strict=True)]

        sums = [dr.zeros(t.Float, dr.width(lane)) for _ in range(width)]
        end = dr.opaque(t.UInt, ALTITUDES * azimuths, 1)
        _, sums = dr.while_loop((t.UInt(0), sums), lambda i, _: i < end, sample, label="mean source: altitudes")
        there = stored(sums, lane, width)
        matrix = floats(interpolation(self.up, count, x, up))
        start, stop = (uints(v) for v in halves(self.up, count, np.broadcast_to(up, x.shape).ravel()))
        lane = dr.arange(t.UInt, x.size * suns * azimuths)
        ray, of_sun = lane // (suns * azimuths), lane % (suns * azimuths)
        first = ray // x.shape[1] * (count * suns * azimuths) + of_sun
        end = dr.gather(t.UInt, stop, ray)

        def node(i: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
            weight = dr.gather(t.Float, matrix, dr.fma(ray, count, i))
            here = packet(there, dr.fma(i, suns * azimuths, first), width)
            return i + 1, [dr.fma(weight, a, b) for a, b in zip(here, sums, strict=True)]

        state = (dr.gather(t.UInt, start, ray), [dr.zeros(t.Float, dr.width(lane)) for _ in range(width)])
        _, sums = dr.while_loop(state, lambda i, _: i < end, node, label="mean source: rays")
        return Series(self.optics, sums, packet(scattering, ray, width), azimuths)


def counts(degree: int, least: tuple[int, int, int]) -> tuple[int, int, int]:
    """Nodes above and below the horizon and in azimuth for a field of a degree: what is scattered toward the observer
    has the harmonics of the light that it comes from."""
    up, down, azimuths = map(max, least, (4 * degree // 3, 2 * degree // 3 + 2, 4 * degree // 3 - 6))
    return up, down, azimuths


def places(up: int, down: int) -> tuple[np.ndarray, np.ndarray]:
    """Where those nodes lie, as in :func:`view_cosines`, and which of them are above the horizon."""
    return np.concatenate([chebyshev_nodes(up), chebyshev_nodes(down)]), np.arange(up + down) < up


def cosine_series(azimuths: int) -> np.ndarray:
    """Matrix [order, azimuth] from values at half_circle(azimuths) to their cosine series, float32."""
    m = np.arange(azimuths)
    series = np.cos(m[:, None] * half_circle(azimuths)) * np.where(m == 0, 1.0, 2.0)[:, None] / azimuths
    return series.astype(np.float32)


def interpolation(above: int, count: int, x: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Matrix [..., count] from values at the nodes, the first ``above`` of them above the horizon, to those at ``x``,
    ``up`` or not, float32."""
    matrix = np.zeros((*x.shape, count), dtype=np.float32)
    up = np.broadcast_to(up, x.shape)
    for half, nodes in ((up, slice(0, above)), (~up, slice(above, count))):
        matrix[..., nodes][half] = chebyshev_matrix(nodes.stop - nodes.start, x[half])
    return matrix


def halves(above: int, count: int, up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First node and the one after the last on each ray's side of the horizon: all that its polynomial has."""
    return np.where(up, 0, above), np.where(up, above, count)


def view_cosines(radius: float, thickness: float, h: np.ndarray, x: np.ndarray, up: np.ndarray) -> np.ndarray:
    """mu at ``x``: 0 on the horizon, 1 at the zenith (above the air: at the top of its limb) or, where not ``up``, at
    the nadir; mapping.from_horizon of mapping.half_elevation."""
    edge, end = view_range(radius, thickness, h)
    q = mapping.from_horizon_inverse(x, edge, np.where(up, end, -mapping.STEEPEST))
    return mapping.half_elevation_inverse(q)


def view_range(radius: float, thickness: float, h: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """half_elevation of the horizon and of the highest view that meets air."""
    edge = mapping.half_elevation(mapping.horizon(radius, h))
    above = np.maximum(h - thickness, 0.0)
    limb = mapping.half_elevation(mapping.horizon(radius + thickness, above))
    return edge, np.where(above > 0.0, limb, mapping.STEEPEST)


def chebyshev_nodes(count: int) -> np.ndarray:
    """Chebyshev nodes of the first kind on (0, 1), ascending."""
    return 0.5 - 0.5 * np.cos((np.arange(count) + 0.5) * np.pi / count)


def chebyshev_matrix(count: int, x: np.ndarray) -> np.ndarray:
    """Matrix [..., count] that takes values at ``chebyshev_nodes(count)`` to their polynomial's at ``x`` in [0, 1]."""
    m = np.arange(count)
    angle = np.arccos(np.clip(1.0 - 2.0 * np.asarray(x), -1.0, 1.0))
    nodes = (m + 0.5) * np.pi / count
    return np.cos(angle[..., None] * m) @ (np.cos(m[:, None] * nodes) * np.where(m == 0, 1.0, 2.0)[:, None] / count)


class MeanSourceHere:
    """The same as seen from one altitude ``h`` (m), which may lie above the air, under one sun at a time; by kernels
    alone, so that it can be recorded.

    ``x`` [V], ``up`` [V]: the rays that are asked for, as for :meth:`MeanSource.along`.
    """

    def __init__(self, band: Any, h: float, x: np.ndarray, up: np.ndarray) -> None:
        air = band.optics.atmosphere
        above, below, self.azimuths = counts(band.field.degree, LEAST)
        at, is_up = places(above, below)
        self.count = len(at)
        self._h = np.full(self.count, h)
        self._mu = view_cosines(air.bottom_radius_m, air.thickness_m, np.array([[h]]), at, is_up)[0]
        self._cosines = floats(np.cos(half_circle(self.azimuths)))
        self._series = floats(cosine_series(self.azimuths))
        self._matrix = floats(interpolation(above, self.count, x, up))
        self._start, self._end = (uints(v) for v in halves(above, self.count, up))

    def lines(self, optics: Optics) -> Sightlines:
        """The rays along which it is asked."""
        return Sightlines(optics, self._h, self._mu)

    def along(self, lines: Sightlines, source: Any, mu_s: Any, sin_s: Any, scattering: Any) -> Series:
        """Cosine series in azimuth of the radiance along the rays.

        ``lines``: those of this object for the values at hand; ``scattering``: of the rays, as
        Sightlines.scattering_table gives it.
        """
        t, azimuths = types(), self.azimuths
        width = row_length(lines.optics)
        lane = dr.arange(t.UInt, self.count * azimuths)
        across = sin_s * dr.gather(t.Float, self._cosines, lane % azimuths)
        mean = means(lines, source, lane // azimuths, mu_s + dr.zeros(t.Float, dr.width(lane)), across)
        lane = dr.arange(t.UInt, dr.width(self._start) * azimuths)
        ray, order = lane // azimuths, lane % azimuths
        start, end = (dr.gather(t.UInt, which, ray) * azimuths for which in (self._start, self._end))

        def sample(i: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
            node = i // azimuths
            weight = dr.gather(t.Float, self._matrix, dr.fma(ray, self.count, node))
            weight *= dr.gather(t.Float, self._series, dr.fma(order, azimuths, i - node * azimuths))
            return i + 1, [dr.fma(weight, a, b) for a, b in zip(packet(mean, i, width), sums, strict=True)]

        sums = [dr.zeros(t.Float, dr.width(lane)) for _ in range(width)]
        _, sums = dr.while_loop((start, sums), lambda i, _: i < end, sample, label="mean source: along")
        return Series(lines.optics, sums, packet(scattering, ray, width), azimuths)


def means(lines: Sightlines, source: Any, ray: Any, mu_s: Any, across: Any) -> Any:
    """What the rays gather of later orders over what they scatter, by scatterer: table [lane, scatterer x padded
    channel]. Arguments as for Sightlines.multiple."""
    t, optics = types(), lines.optics
    none = [t.Float(0.0)] * (padded(optics.channel_count) - optics.channel_count)
    width, table = row_length(optics), lines.scattering_table
    light = lines.multiple(source, ray, mu_s, across, lines.nu(ray, mu_s, across))
    pairs = zip([v for kind in light for v in (*kind, *none)], packet(table, ray, width), strict=True)
    mean = [dr.select(w > 0.0, v / dr.select(w > 0.0, w, 1.0), 0.0) for v, w in pairs]
    return stored(mean, dr.arange(t.UInt, dr.width(ray)), width)


def row_length(optics: Optics) -> int:
    """Floats per row of tables by scatterer and padded channel."""
    return len(optics.scatterers) * padded(optics.channel_count)


class Series:
    """Cosine series in azimuth, [row, azimuthal order, channel], stored and evaluated by kernels: the sum over
    scatterers of their means times what a ray scatters, both [scatterer x padded channel] per row and order."""

    def __init__(self, optics: Optics, mean: list[Any], scattering: list[Any], orders: int) -> None:
        self.orders, self.channels, size = orders, optics.channel_count, padded(optics.channel_count)
        sums = [sum(m * s for m, s in zip(mean[c::size], scattering[c::size], strict=True)) for c in range(size)]
        self.buffer = stored(sums, dr.arange(types().UInt, dr.width(mean)), size)

    def at(self, row: Any, cos_phi: Any) -> list[Any]:
        """Per channel: sum over m of series[row, m] cos(m phi)."""
        before, now = cos_phi, types().Float(1.0)
        total = [types().Float(0.0)] * self.channels
        for m in range(self.orders):
            values = packet(self.buffer, dr.fma(row, self.orders, m), padded(self.channels))
            total = [dr.fma(now, v, s) for v, s in zip(values, total, strict=False)]
            before, now = now, dr.fma(2.0 * cos_phi, now, -before)
        return total
