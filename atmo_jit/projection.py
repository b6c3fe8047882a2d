"""From radiance in discrete directions to the moments and the irradiance of the light of one order: sums over azimuth,
then over zenith cosine."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from .backend import floats, packet, padded, row_size, stored, table_of, types, uints
from .grid import Grid
from .harmonics import legendre, pair_count, pairs
from .paths import Directions

TOGETHER = 4  # suns that one lane sums: they share the weights, and load in one packet


def add_harmonics(sums: list[Any], values: list[Any], cos_phi: Any) -> list[Any]:
    """Add ``values`` [channel] seen at the azimuth phi, times cos(m phi), to ``sums`` [m x channel]."""
    channels = len(values)
    new, cos_m, cos_before = [], 1.0, cos_phi
    for m in range(len(sums) // channels):
        new += [dr.fma(cos_m, v, s) for v, s in zip(values, sums[m * channels : (m + 1) * channels], strict=True)]
        cos_m, cos_before = dr.fma(2.0 * cos_phi, cos_m, -cos_before), cos_m
    return new


def stored_harmonics(sums: list[Any], channels: int, azimuths: int) -> Any:
    """Sums [m x channel] over ``azimuths`` of the half circle, one lane per ray and sun, as azimuthal harmonics: table
    [rays, suns, m x padded channels], evaluated."""
    t, size = types(), padded(channels)
    share = dr.opaque(t.Float, 2.0 * np.pi / azimuths, 1)
    values: list[Any] = []
    for first in range(0, len(sums), channels):
        values += [share * s for s in sums[first : first + channels]] + [t.Float(0.0)] * (size - channels)
    return table_of(values, dr.arange(t.UInt, dr.width(sums)))


def room(suns: int) -> int:
    """Suns for which rays are gathered: whole blocks of TOGETHER."""
    return -(-suns // TOGETHER) * TOGETHER


@dataclass
class Moments:
    """Moments and irradiance of one order at the nodes: ``values`` [K, pairs + 1, room(suns), channels].

    Moments are of degrees up to ``degree`` and azimuthal orders up to ``most``. The irradiance of a horizontal surface
    facing up comes after the last pair. ``suns``: how many there are.
    """

    values: Any
    degree: int
    most: int
    suns: int
    channels: int

    @property
    def entries(self) -> int:
        """Pairs and the irradiance."""
        return pair_count(self.degree, self.most) + 1

    def index(self, k: Any, entry: Any, sun: Any, channel: Any) -> Any:
        """Place of a value."""
        return ((k * self.entries + entry) * room(self.suns) + sun) * self.channels + channel

    def numpy(self) -> np.ndarray:
        """``values`` with their axes."""
        return self.values.numpy().reshape(-1, self.entries, room(self.suns), self.channels)


class Projection:
    """From azimuthal harmonics at the nodes to moments and irradiance.

    Weights of the directions for every pair (l, m), and after them those of the irradiance.
    """

    def __init__(self, directions: Directions, degree: int, most: int) -> None:
        self.degree, self.most = degree, most
        self.altitudes, self.count = directions.mu.shape
        count = pair_count(degree, most)
        m = pairs(degree)[1][:count]
        basis = legendre(degree, directions.mu)[..., :count] * directions.weight[..., None]  # [K, D, pairs]
        basis = np.concatenate([basis, directions.facing_up[..., None]], axis=-1)
        # One row per altitude and pair, directions within.
        self._basis = floats(np.swapaxes(basis, 1, 2))
        self._m = uints(np.append(m, 0))
        self.entries = count + 1

    def upright(self) -> np.ndarray:
        """Weights of the directions for the pairs with m = 0 and the irradiance, float64 [K, degree + 2, D]."""
        weights = self._basis.numpy().reshape(self.altitudes, self.entries, self.count)
        return weights[:, [*range(self.degree + 1), self.entries - 1]].astype(float)

    @classmethod
    def at(cls, grid: Grid, directions: Directions, degree: int, most: int) -> Projection:
        """The projection for a grid, kept with it."""
        return grid.kept(("projection", directions, degree, most), lambda: cls(directions, degree, most))

    def __call__(self, harmonics: Any, suns: int, channels: int) -> Moments:
        """``harmonics`` [K, D, room(suns), m x padded channels] -> moments and irradiance."""
        t, entries, count, size = types(), self.entries, self.count, padded(channels)
        lane = dr.arange(t.UInt, self.altitudes * entries * (room(suns) // TOGETHER))
        # Sizes are read from memory: one kernel for all of them.
        entries, blocks, per_sun, count = (
            dr.opaque(t.UInt, v, 1)
            for v in (entries, room(suns) // TOGETHER, row_size((self.most + 1) * size) // size, count)
        )
        rest = lane // blocks
        k = rest // entries
        block, entry = lane - rest * blocks, rest - k * entries
        first = (k * (count * blocks) + block) * (TOGETHER * per_sun) + dr.gather(t.UInt, self._m, entry)

        def add(i: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
            weight = dr.gather(t.Float, self._basis, rest * count + i)
            place = first + i * (blocks * TOGETHER * per_sun)
            values = [packet(harmonics, place + s * per_sun, size, alone=True) for s in range(TOGETHER)]
            return i + 1, [
                dr.fma(weight, values[s][c], sums[s * channels + c]) for s in range(TOGETHER) for c in range(channels)
            ]

        zero = [dr.zeros(t.Float, dr.width(lane)) for _ in range(TOGETHER * channels)]
        _, sums = dr.while_loop((t.UInt(0), zero), lambda i, _: i < count, add, max_iterations=-1, label="directions")
        return Moments(stored(sums, lane, len(sums)), self.degree, self.most, suns, channels)
