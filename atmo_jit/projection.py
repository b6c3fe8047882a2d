"""From radiance in discrete directions to the moments and the irradiance of the light of one order."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import drjit as dr
import numpy as np

from .backend import floats, packet, padded, stored, types, uints
from .grid import Grid
from .harmonics import legendre, pair_count, pairs
from .paths import Directions
from .quadrature import half_circle


@lru_cache(maxsize=32)
def projection(grid: Grid, suns: int, directions: Directions, azimuths: int, degree: int, channels: int) -> Projection:
    """The projection for a grid, kept with it."""
    return Projection(grid, suns, directions, azimuths, degree, channels)


class Projection:
    """From radiance in discrete directions at the nodes to moments and irradiance: sums over azimuth, then over
    zenith cosine."""

    def __init__(
        self, grid: Grid, suns: int, directions: Directions, azimuths: int, degree: int, channels: int
    ) -> None:
        t = types()
        self.grid, self.suns, self.directions, self.azimuths, self.degree = grid, suns, directions, azimuths, degree
        self.size = padded(channels)
        self.count = directions.mu.shape[1]
        m = np.arange(degree + 1)
        self._cosines = floats(np.cos(m[:, None] * half_circle(azimuths)) * (2.0 * np.pi / azimuths))
        basis = legendre(degree, directions.mu) * directions.weight[..., None]  # [K, D, pairs]
        self._basis = floats(basis)
        self._upward = floats(directions.facing_up)
        self._m = uints(pairs(degree)[1])
        self._types = t

    def __call__(self, radiance: Any) -> tuple[Any, Any]:
        """``radiance`` [K, D, S, azimuths, channels] -> moments [K, S, pairs, channels], irradiance [K, S,
        channels]."""
        t, size = self._types, self.size
        altitudes, suns = self.grid.shape[0], self.suns
        orders, count, azimuths = self.degree + 1, self.count, self.azimuths
        lane = dr.arange(t.UInt, altitudes * count * orders * suns)
        sun, rest = lane % suns, lane // suns
        m, ray = rest % orders, rest // orders
        start = (ray * suns + sun) * azimuths

        def add_azimuth(j: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
            weight = dr.gather(t.Float, self._cosines, m * azimuths + j)
            values = packet(radiance, start + j, size)
            return j + 1, [dr.fma(weight, v, s) for v, s in zip(values, sums, strict=True)]

        zero = [dr.zeros(t.Float, dr.width(lane)) for _ in range(size)]
        end = dr.opaque(t.UInt, azimuths, 1)
        _, sums = dr.while_loop((t.UInt(0), zero), lambda j, _: j < end, add_azimuth, label="azimuths")
        harmonics = stored(sums, lane, size)  # [K, D, m, S]

        pair_total = pair_count(self.degree)
        lane = dr.arange(t.UInt, altitudes * suns * pair_total)
        pair, rest = lane % pair_total, lane // pair_total
        sun, k = rest % suns, rest // suns
        m = dr.gather(t.UInt, self._m, pair)
        moments = self._sum_directions(
            harmonics, k, m, sun, lambda ray: dr.gather(t.Float, self._basis, ray * pair_total + pair)
        )
        lane0 = dr.arange(t.UInt, altitudes * suns)
        sun, k = lane0 % suns, lane0 // suns
        irradiance = self._sum_directions(
            harmonics, k, t.UInt(0), sun, lambda ray: dr.gather(t.Float, self._upward, ray)
        )
        return stored(moments, lane, size), stored(irradiance, lane0, size)

    def _sum_directions(self, harmonics: Any, k: Any, m: Any, sun: Any, weight: Any) -> list[Any]:
        t, size = self._types, self.size
        suns, orders, count = self.suns, self.degree + 1, self.count

        def add(i: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
            ray = k * count + i
            values = packet(harmonics, (ray * orders + m) * suns + sun, size)
            w = weight(ray)
            return i + 1, [dr.fma(w, v, s) for v, s in zip(values, sums, strict=True)]

        zero = [dr.zeros(t.Float, dr.width(sun)) for _ in range(size)]
        end = dr.opaque(t.UInt, count, 1)
        _, sums = dr.while_loop((t.UInt(0), zero), lambda i, _: i < end, add, label="directions")
        return sums
