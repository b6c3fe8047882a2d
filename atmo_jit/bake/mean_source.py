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
from .sightlines import Sightlines, padded_channels

ALTITUDES = 8
# Nodes above and below the horizon and in azimuth at least; the latter where altitudes share them.
LEAST, LEAST_COARSE = (16, 10, 8), (12, 8, 6)
STRETCHES = 8
COARSE_DEGREE = 9  # of tables over all suns and altitudes


class MeanSource:
    """Means for the suns ``mu_s`` [S], at Chebyshev nodes from the ground to the top.

    ``harmonics`` [altitude, channel, scatterer, up + down, sun, azimuthal order].
    """

    def __init__(self, band: Any, mu_s: np.ndarray) -> None:
        self.optics = band.optics
        self.thickness = self.optics.atmosphere.thickness_m
        self.up, down, azimuths = counts(min(band.field.degree, COARSE_DEGREE), LEAST_COARSE)
        h = self.thickness * chebyshev_nodes(ALTITUDES) ** 2
        x, up = places(self.up, down)
        radius = self.optics.atmosphere.bottom_radius_m
        mu = view_cosines(radius, self.thickness, h[:, None], x, up)
        lines = Sightlines(self.optics, np.repeat(h, len(x)), mu.ravel(), stretches=STRETCHES)
        t = types()
        suns = len(mu_s)
        lane = dr.arange(t.UInt, mu.size * suns * azimuths)
        rest = lane // azimuths
        sun = dr.gather(t.Float, floats(mu_s), rest % suns)
        sin_s = dr.gather(t.Float, floats(np.sqrt((1.0 - mu_s) * (1.0 + mu_s))), rest % suns)
        across = sin_s * dr.gather(t.Float, floats(np.cos(half_circle(azimuths))), lane % azimuths)
        ray = rest // suns
        light = lines.multiple(band.source, ray, sun, across, lines.nu(ray, sun, across))
        dr.eval(light)
        values = np.stack([np.stack([c.numpy() for c in kind], axis=-1) for kind in light], axis=-2)
        values = values.reshape(len(h), len(x), suns, azimuths, *values.shape[1:])
        whole = lines.scattering.reshape(len(h), len(x), 1, 1, *values.shape[4:])
        mean = np.divide(values, whole, out=np.zeros_like(values), where=whole > 0.0)
        self.harmonics = np.einsum("mj,avsjkc->ackvsm", cosine_series(azimuths), mean, optimize=True)

    def along(self, h: np.ndarray, x: np.ndarray, up: np.ndarray, scattering: np.ndarray) -> np.ndarray:
        """Cosine series in azimuth of the radiance along rays, float32 [A, V, S, azimuthal order, C].

        ``h`` [A] (m); ``x`` [A, V]: place between the horizon (0) and zenith or nadir (1) as in :func:`view_cosines`,
        ``up`` [V] or [A, V]: which of the two; ``scattering`` [A, V, K, C]: of :class:`Sightlines` for these rays.
        """
        altitudes, channels, kinds, v, suns, orders = self.harmonics.shape
        place = chebyshev_matrix(ALTITUDES, np.sqrt(np.clip(h / self.thickness, 0.0, 1.0)))
        values = place.astype(np.float32) @ self.harmonics.reshape(altitudes, -1)
        matrix = interpolation(self.up, v, x, up)
        # All at once, scatterers added up: one product of matrices per altitude and channel.
        weights = np.einsum("avkc,avn->acvkn", scattering.astype(np.float32), matrix)
        sums = weights.reshape(len(h), channels, -1, kinds * v) @ values.reshape(len(h), channels, kinds * v, -1)
        return np.moveaxis(sums.reshape(len(h), channels, -1, suns, orders), 1, -1)


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
        # The nodes on a ray's side of the horizon are all that its polynomial has.
        self._start, self._end = uints(np.where(up, 0, above)), uints(np.where(up, above, self.count))

    def lines(self, optics: Optics) -> Sightlines:
        """The rays along which it is asked."""
        return Sightlines(optics, self._h, self._mu)

    def along(self, lines: Sightlines, source: Any, mu_s: Any, sin_s: Any, scattering: Any) -> Series:
        """Cosine series in azimuth of the radiance along the rays.

        ``lines``: those of this object for the values at hand; ``scattering``: of the rays, as
        Sightlines.scattering_table gives it.
        """
        t, optics, azimuths = types(), lines.optics, self.azimuths
        channels, kinds = optics.channel_count, len(optics.scatterers)
        size = padded(channels)
        lane = dr.arange(t.UInt, self.count * azimuths)
        across = sin_s * dr.gather(t.Float, self._cosines, lane % azimuths)
        ray, sun = lane // azimuths, mu_s + dr.zeros(t.Float, dr.width(lane))
        table = lines.scattering_table
        light = lines.multiple(source, ray, sun, across, lines.nu(ray, sun, across))
        light = [v for kind in light for v in (*kind, *[t.Float(0.0)] * (size - channels))]
        whole = packet(table, ray, kinds * size)
        mean = [dr.select(w > 0.0, v / dr.select(w > 0.0, w, 1.0), 0.0) for v, w in zip(light, whole, strict=True)]
        mean = stored(mean, lane, kinds * size)
        lane = dr.arange(t.UInt, dr.width(self._start) * azimuths)
        ray, order = lane // azimuths, lane % azimuths
        start, end = (dr.gather(t.UInt, which, ray) for which in (self._start, self._end))

        def sample(i: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
            node = i // azimuths
            weight = dr.gather(t.Float, self._matrix, dr.fma(ray, self.count, node))
            weight *= dr.gather(t.Float, self._series, dr.fma(order, azimuths, i - node * azimuths))
            here = packet(mean, i, kinds * size)
            return i + 1, [dr.fma(weight, a, b) for a, b in zip(here, sums, strict=True)]

        sums, end = [dr.zeros(t.Float, dr.width(lane)) for _ in range(kinds * size)], end * azimuths
        _, sums = dr.while_loop((start * azimuths, sums), lambda i, _: i < end, sample, label="mean source: along")
        whole = packet(scattering, ray, kinds * size)
        series = [sum(sums[n * size + c] * whole[n * size + c] for n in range(kinds)) for c in range(size)]
        return Series(stored(series, lane, size), azimuths, channels)


class Series:
    """Cosine series in azimuth, a table [row, azimuthal order, padded channel], evaluated by a kernel."""

    def __init__(self, buffer: Any, orders: int, channels: int) -> None:
        self.buffer, self.orders, self.channels = buffer, orders, channels

    @classmethod
    def of(cls, series: np.ndarray) -> Series:
        """Those of an array [..., azimuthal order, C]."""
        *_, orders, channels = series.shape
        return cls(padded_channels(series), orders, channels)

    def at(self, row: Any, cos_phi: Any) -> list[Any]:
        """Per channel: sum over m of series[row, m] cos(m phi)."""
        before, now = cos_phi, types().Float(1.0)
        total = [types().Float(0.0)] * self.channels
        for m in range(self.orders):
            values = packet(self.buffer, dr.fma(row, self.orders, m), padded(self.channels))
            total = [dr.fma(now, v, s) for v, s in zip(values, total, strict=False)]
            before, now = now, dr.fma(2.0 * cos_phi, now, -before)
        return total
