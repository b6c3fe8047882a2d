"""The solved radiance field: harmonic moments of the light of all orders at the nodes, and what it scatters toward a
view ray.

A field stores, per altitude node, sun node and channel, a positive reference (the zeroth moment of order 1) and every
moment divided by it. The reference is interpolated in its logarithm, the quotients linearly: at twilight light falls
by a factor of two per degree, and linear interpolation of the moments themselves would be wrong by 8 %.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import drjit as dr
import numpy as np

from .backend import evaluated, floats, packet, padded, row, stored, types, uints
from .column import SunColumns
from .grid import Grid, split
from .harmonics import pair_count, pairs, recurrence
from .optics import Optics
from .paths import lagrange
from .refinement import Reference, Taps
from .total import parity


class Field:
    """The light of a sum of orders, at the altitudes of the grid and the suns of order 1, over the reference.

    ``moments`` [K, suns, pairs(degree), channels] of light that scatters once more, ``sky`` and ``reflected`` [K, suns,
    channels]: irradiance by all that arrives, and by what may be reflected, over the scattering depth of the air above.
    ``scatters``: whether any of it scatters once more.
    """

    def __init__(
        self,
        optics: Optics,
        columns: SunColumns,
        grid: Grid,
        reference: Reference,
        degree: int,
        moments: Any,
        sky: Any,
        reflected: Any,
        *,
        scatters: bool = True,
    ) -> None:
        self.optics, self.columns, self.grid, self.reference = optics, columns, grid, reference
        self.degree, self.moments, self.sky, self.reflected = degree, moments, sky, reflected
        self.scatters = scatters
        self._size = padded(optics.channel_count)

    def _refined(self, values: Any, entries: int) -> Any:
        """[K, first suns, entries, channels] -> [levels, sources, entries, size], interpolated cubically."""
        t, grid, channels = types(), self.grid, self.optics.channel_count
        suns = len(grid.first_theta)
        row_length = suns * entries * channels
        values = _between_levels(grid, values, row_length)
        lane = dr.arange(t.UInt, grid.level_count * grid.sources * entries)
        entry, node = lane % entries, lane // entries
        source, level = node % grid.sources, node // grid.sources
        taps = Taps(grid, t.Float(source) * (grid.first / grid.sun_refine), suns)
        sign = dr.gather(t.Float, parity(grid, self.degree), entry) if entries > 1 else 1.0
        places = [level * row_length + (at * entries + entry) * channels for at in taps.at]
        return stored(
            [taps.sum([dr.gather(t.Float, values, place + c) for place in places], sign) for c in range(channels)],
            lane,
            self._size,
        )

    def prepare(self) -> None:
        """Make the tables for look-ups, which cannot be made while a kernel is traced."""
        if self.scatters and self.optics.scatterers:
            dr.eval(self._tables)
        dr.eval(self._irradiances, self._guide)

    @cached_property
    def _tables(self) -> tuple[Any, Any, Any, Any]:
        """Moments at refined suns for look-ups, phase moments, and the recurrences of harmonics."""
        l_, m = pairs(self.degree)
        rows = [[*entry, float(a == b)] for entry, a, b in zip(recurrence(self.degree), l_, m, strict=True)]
        return (
            self._refined(self.moments, pair_count(self.degree)),
            self.optics.phase_moments(self.degree),
            floats(rows),
            floats(l_),
        )

    @cached_property
    def _guide(self) -> Any:
        """The reference at refined levels, interpolated in its logarithm."""
        logs = dr.log(dr.maximum(self.reference.fine, 1e-37))
        dr.eval(logs)
        guide = dr.exp(_between_levels(self.grid, logs, dr.width(logs) // self.grid.shape[0]))
        dr.eval(guide)
        return guide

    @cached_property
    def _irradiances(self) -> tuple[Any, Any]:
        return self._refined(self.sky, 1), self._refined(self.reflected, 1)

    def _corners(self, h: Any, mu_s: Any, active: Any) -> tuple[list[Any], list[Any], list[list[Any]]]:
        """The four nodes about (h, mu_s), their weights, and the reference at the sun angle per altitude
        [2][channel]."""
        suns = self.grid.sources
        k, fk = self.grid.locate_altitude(h)
        x = self.grid.sun_position(mu_s)
        s, fs = split(x * float(self.grid.sun_refine), suns)
        first = k * suns + s
        nodes = [first, first + 1, first + suns, first + suns + 1]
        weights = [(1.0 - fk) * (1.0 - fs), (1.0 - fk) * fs, fk * (1.0 - fs), fk * fs]
        return nodes, weights, [self.reference.at(level, x, active, self._guide) for level in (k, k + 1)]

    def irradiance(self, h: Any, mu_s: Any, active: Any = True, *, reflected: bool = False) -> list[Any]:
        """Irradiance of the scattered light on a horizontal surface facing up, per channel.

        ``reflected``: only of the light whose reflection by that surface is still counted.
        """
        channels, size = range(self.optics.channel_count), padded(self.optics.channel_count)
        if not self.optics.scatterers:
            return [0.0 * h for _ in channels]
        suns = self.grid.sources
        k, fk = self.grid.locate_altitude(h)
        x = self.grid.sun_position(mu_s)
        s, fs = split(x * float(self.grid.sun_refine), suns)
        buffer = self._irradiances[int(reflected)]
        logs = []
        for level in (k, k + 1):
            guide = self.reference.at(level, x, active, self._guide)
            values = [packet(buffer, level * suns + s + i, size, active) for i in (0, 1)]
            logs.append(
                [dr.log(guide[c] * dr.maximum(dr.lerp(values[0][c], values[1][c], fs), 1e-30)) for c in channels]
            )
        # Geometric between altitudes: at twilight the level below lies in the shadow and the one above in the light.
        above = self.optics.scattering_depths(self.columns.upward(h))
        return [dr.exp(dr.lerp(logs[0][c], logs[1][c], fk)) * above[c] for c in channels]

    def scattered(self, h: Any, mu_s: Any, mu: Any, cos_phi: Any, active: Any) -> list[list[Any]]:
        """Integral of phase function times radiance over the sphere, toward (mu, phi): [scatterer][channel]
        (march.Source)."""
        t = types()
        channels, kinds = self.optics.channel_count, len(self.optics.scatterers)
        size = padded(channels)
        nodes, weights, scales = self._corners(h, mu_s, active)
        sine = dr.safe_sqrt((1.0 - mu) * (1.0 + mu))
        count = pair_count(self.degree)
        stride = dr.opaque(t.UInt, count, 1)
        moments, phases, recurrences, degrees = self._tables

        def pair(
            i: Any, diagonal: Any, last: Any, before: Any, cos_m: Any, cos_m1: Any, sums: list[Any]
        ) -> tuple[Any, ...]:
            a, b, start, is_diagonal = packet(recurrences, i, 4, active)
            new_m = start > 0.0
            diagonal = dr.select(new_m, diagonal * sine * start, diagonal)
            next_cos = dr.select(new_m, 2.0 * cos_phi * cos_m - cos_m1, cos_m)
            cos_m1 = dr.select(new_m, cos_m, cos_m1)
            value = dr.select(is_diagonal > 0.0, diagonal, a * (mu * last - b * before))
            before = dr.select(is_diagonal > 0.0, 0.0, last)
            basis = value * next_cos
            corner = [packet(moments, node * stride + i, size, active) for node in nodes]
            moment = [
                _blend([w * scales[i // 2][c] for i, w in enumerate(weights)], [v[c] for v in corner]) * basis
                for c in range(channels)
            ]
            degree = t.UInt(dr.gather(t.Float, degrees, i, active))
            chi = row(phases, degree, kinds * channels, active=active)
            sums = [dr.fma(chi[n], moment[n % channels], sums[n]) for n in range(kinds * channels)]
            return i + 1, diagonal, value, before, next_cos, cos_m1, sums

        width = dr.width(h)
        zero, one = dr.zeros(t.Float, width), dr.full(t.Float, 1.0, width)
        # cos(0 phi) = 1, and cos(-1 phi) = cos phi starts the recurrence cos((m + 1) phi) = 2 cos phi cos(m phi) -
        # cos((m - 1) phi).
        state = (
            t.UInt(0),
            one * 0.28209479,
            zero,
            zero,
            one,
            cos_phi + zero,
            [dr.zeros(t.Float, width) for _ in range(kinds * channels)],
        )
        *_, sums = dr.while_loop(state, lambda i, *_: i < stride, pair, label="scattered")
        return [[dr.maximum(sums[n * channels + c], 0.0) for c in range(channels)] for n in range(kinds)]


def _blend(weights: list[Any], values: list[Any]) -> Any:
    total = weights[0] * values[0]
    for weight, value in zip(weights[1:], values[1:], strict=True):
        total = dr.fma(weight, value, total)
    return total


def _between_levels(grid: Grid, values: Any, length: int) -> Any:
    """[K, length] -> [levels, length]: cubic in the altitude coordinate."""
    t = types()

    def taps() -> tuple[Any, Any]:
        level = np.arange(grid.level_count) / grid.refine
        first = np.clip(np.floor(level).astype(int) - 1, 0, max(grid.shape[0] - 4, 0))
        nodes = (first[:, None] + np.arange(min(4, grid.shape[0]))).astype(float)
        return uints(first), floats(lagrange(nodes, level))

    first, weights = grid.kept("between levels", taps)
    lane = dr.arange(t.UInt, grid.level_count * length)
    level, place = lane // length, lane % length
    start, count = dr.gather(t.UInt, first, level), min(4, grid.shape[0])
    total = 0.0
    for i in range(count):
        value = dr.gather(t.Float, values, (start + i) * length + place)
        total = dr.fma(dr.gather(t.Float, weights, level * count + i), value, total)
    return evaluated(total)
