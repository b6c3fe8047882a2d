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
from ..backend import floats, packet, padded, types
from ..quadrature import half_circle
from .sightlines import Sightlines

ALTITUDES = 8
# Nodes above and below the horizon and in azimuth at least; the latter where altitudes share them.
LEAST, LEAST_COARSE = (16, 10, 8), (12, 8, 6)
STRETCHES = 8
COARSE_DEGREE = 9  # of tables over all suns and altitudes


class MeanSource:
    """Means for the suns ``mu_s`` [S], at Chebyshev nodes from the ground to the top or at the one altitude ``h`` [1]
    (m), which may lie above it.

    ``harmonics`` [altitude, channel, scatterer, up + down, sun, azimuthal order]. How many nodes follows from the
    degree of the field: what is scattered toward the observer has the harmonics of the light that it comes from.
    """

    def __init__(self, band: Any, mu_s: np.ndarray, h: np.ndarray | None = None) -> None:
        self.optics = band.optics
        self.thickness = self.optics.atmosphere.thickness_m
        self.single = h is not None
        degree = band.field.degree if self.single else min(band.field.degree, COARSE_DEGREE)
        least = LEAST if self.single else LEAST_COARSE
        counts = (4 * degree // 3, 2 * degree // 3 + 2, 4 * degree // 3 - 6)
        self.up, self.down, self.azimuths = map(max, least, counts)
        azimuths = self.azimuths
        h = self.thickness * chebyshev_nodes(ALTITUDES) ** 2 if h is None else h
        x = np.concatenate([chebyshev_nodes(self.up), chebyshev_nodes(self.down)])
        up = np.arange(len(x)) < self.up
        radius = self.optics.atmosphere.bottom_radius_m
        mu = view_cosines(radius, self.thickness, h[:, None], x, up)
        lines = Sightlines(self.optics, np.repeat(h, len(x)), mu.ravel(), stretches=0 if self.single else STRETCHES)
        t = types()
        suns = len(mu_s)
        lane = dr.arange(t.UInt, mu.size * suns * azimuths)
        rest = lane // azimuths
        sun = dr.gather(t.Float, floats(mu_s), rest % suns)
        sin_s = dr.gather(t.Float, floats(np.sqrt((1.0 - mu_s) * (1.0 + mu_s))), rest % suns)
        across = sin_s * dr.gather(t.Float, floats(np.cos(half_circle(azimuths))), lane % azimuths)
        ray = rest // suns
        light = lines.multiple(band.source, ray, sun, across, lines.nu(ray, sun, across))
        values = np.stack([np.stack([c.numpy() for c in kind], axis=-1) for kind in light], axis=-2)
        values = values.reshape(len(h), len(x), suns, azimuths, *values.shape[1:])
        whole = lines.scattering.reshape(len(h), len(x), 1, 1, *values.shape[4:])
        mean = np.divide(values, whole, out=np.zeros_like(values), where=whole > 0.0)
        m = np.arange(azimuths)
        series = np.cos(m[:, None] * half_circle(azimuths)) * np.where(m == 0, 1.0, 2.0)[:, None] / azimuths
        self.harmonics = np.einsum("mj,avsjkc->ackvsm", series.astype(np.float32), mean, optimize=True)

    def along(self, h: np.ndarray, x: np.ndarray, up: np.ndarray, scattering: np.ndarray) -> np.ndarray:
        """Cosine series in azimuth of the radiance along rays, float32 [A, V, S, azimuthal order, C].

        ``h`` [A] (m); ``x`` [A, V]: place between the horizon (0) and zenith or nadir (1) as in :func:`view_cosines`,
        ``up`` [V] or [A, V]: which of the two; ``scattering`` [A, V, K, C]: of :class:`Sightlines` for these rays.
        """
        altitudes, channels, kinds, v, suns, orders = self.harmonics.shape
        values = self.harmonics.reshape(altitudes, -1)
        if not self.single:
            place = chebyshev_matrix(ALTITUDES, np.sqrt(np.clip(h / self.thickness, 0.0, 1.0)))
            values = place.astype(np.float32) @ values
        matrix = np.zeros((*x.shape, v), dtype=np.float32)
        up = np.broadcast_to(up, x.shape)
        for half, nodes in ((up, slice(0, self.up)), (~up, slice(self.up, v))):
            matrix[..., nodes][half] = chebyshev_matrix(nodes.stop - nodes.start, x[half])
        # All at once, scatterers added up: one product of matrices per altitude and channel.
        weights = np.einsum("avkc,avn->acvkn", scattering.astype(np.float32), matrix)
        sums = weights.reshape(len(h), channels, -1, kinds * v) @ values.reshape(len(h), channels, kinds * v, -1)
        return np.moveaxis(sums.reshape(len(h), channels, -1, suns, orders), 1, -1)


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


class Series:
    """Cosine series in azimuth, [row, azimuthal order, C], evaluated by a kernel."""

    def __init__(self, series: np.ndarray) -> None:
        *_, self.orders, self.channels = series.shape
        self.size = padded(self.channels)
        extra = [(0, 0)] * (series.ndim - 1) + [(0, self.size - self.channels)]
        self.buffer = floats(np.pad(series, extra))

    def at(self, row: Any, cos_phi: Any) -> list[Any]:
        """Per channel: sum over m of series[row, m] cos(m phi)."""
        before, now = cos_phi, types().Float(1.0)
        total = [types().Float(0.0)] * self.channels
        for m in range(self.orders):
            values = packet(self.buffer, dr.fma(row, self.orders, m), self.size)
            total = [dr.fma(now, v, s) for v, s in zip(values, total, strict=False)]
            before, now = now, dr.fma(2.0 * cos_phi, now, -before)
        return total
