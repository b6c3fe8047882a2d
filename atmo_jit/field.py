"""The solved radiance field: harmonic moments of the light of all orders at the nodes, and what it scatters toward a
view ray.

A field stores, per altitude node, sun node and channel, a positive reference (the zeroth moment of order 1) and every
moment divided by it. The reference is interpolated in its logarithm, the quotients linearly: at twilight light falls
by a factor of two per degree, and linear interpolation of the moments themselves would be wrong by 8 %.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from .backend import floats, packet, padded, stored, types, uints
from .column import SunColumns
from .grid import Grid
from .harmonics import pair_count, pairs, recurrence
from .optics import Optics
from .refinement import Order, Refinement


class Field:
    """The light of a sum of orders at the refined nodes.

    ``first``: order 1, at its own suns; ``rest``: the sum of the later orders that scatter once more (None: there are
    none), ``arriving``: their sky irradiance [K, S, size], which may be of one order more. ``scatters``: whether any
    of it scatters once more.
    """

    def __init__(
        self,
        optics: Optics,
        columns: SunColumns,
        grid: Grid,
        refine: Refinement,
        first: Order,
        rest: Order | None,
        arriving: Any,
        *,
        scatters: bool = True,
    ) -> None:
        self.optics, self.columns, self.grid = optics, columns, grid
        self.log_reference = refine.log_reference
        self.scatters = scatters
        suns = len(grid.first_theta), grid.shape[1]
        once = refine.both(self._per_depth(first.sky, suns[0]), suns[0])
        self.sky = once if arriving is None else once + refine.both(self._per_depth(arriving, suns[1]), suns[1])
        if rest is None:
            self.reflected = dr.zeros(types().Float, dr.width(self.sky))
            return
        self.degree = first.degree
        self.reflected = once + refine.both(self._per_depth(rest.sky, suns[1]), suns[1])
        self.moments = _sum(
            refine.both(first.moments, suns[0], first.degree),
            first,
            refine.both(rest.moments, suns[1], rest.degree),
            rest,
        )
        self._chi = optics.phase_moments(self.degree, padded(optics.channel_count))
        l_, m = pairs(self.degree)
        rows = [[*row, float(a == b)] for row, a, b in zip(recurrence(self.degree), l_, m, strict=True)]
        self._recurrence, self._l = floats(rows), floats(l_)
        dr.eval(self.sky, self.reflected, self.moments)

    def _corners(self, h: Any, mu_s: Any, active: Any) -> tuple[list[Any], list[Any], list[list[Any]]]:
        """The four nodes about (h, mu_s), their weights, and the reference at the sun angle per altitude
        [2][channel]."""
        suns, size = self.grid.sources, padded(self.optics.channel_count)
        k, fk = self.grid.locate_altitude(h)
        s, fs = self.grid.locate_sun(mu_s)
        first = k * suns + s
        nodes = [first, first + 1, first + suns, first + suns + 1]
        weights = [(1.0 - fk) * (1.0 - fs), (1.0 - fk) * fs, fk * (1.0 - fs), fk * fs]
        logs = [packet(self.log_reference, node, size, active) for node in nodes]
        channels = range(self.optics.channel_count)
        return nodes, weights, [[dr.exp(dr.lerp(logs[i][c], logs[i + 1][c], fs)) for c in channels] for i in (0, 2)]

    def _per_depth(self, irradiance: Any, suns: int) -> Any:
        """Irradiance [K, S, size] over the scattering depth of the air above: finite at the top, where both vanish,
        and smooth up to it."""
        t, size = types(), padded(self.optics.channel_count)
        altitudes = self.grid.shape[0]
        above = self._depth_above(floats(self.grid.h))
        per_altitude = stored(
            [dr.select(d > 0.0, 1.0 / dr.select(d > 0.0, d, 1.0), 0.0) for d in above],
            dr.arange(t.UInt, altitudes),
            size,
        )
        row = suns * size
        lane = dr.arange(t.UInt, altitudes * row)
        quotient = irradiance * dr.gather(t.Float, per_altitude, lane // row * size + lane % size)
        dr.eval(quotient)
        # At the top itself 0 / 0: the quotient goes on as it changed over the interval below.
        end = altitudes * row - row + lane % row
        near, far = (dr.maximum(dr.gather(t.Float, quotient, end - n * row), 1e-30) for n in (1, 2))
        steady = near * dr.clip(near / far, 0.25, 4.0)
        return dr.select(lane >= (altitudes - 1) * row, steady, quotient)

    def _depth_above(self, h: Any) -> list[Any]:
        return self.optics.scattering_depths(self.columns.upward(h))

    def irradiance(self, h: Any, mu_s: Any, active: Any = True, *, reflected: bool = False) -> list[Any]:
        """Irradiance of the scattered light on a horizontal surface facing up, per channel.

        ``reflected``: only of the light whose reflection by that surface is still counted.
        """
        channels, size = range(self.optics.channel_count), padded(self.optics.channel_count)
        if not self.optics.scatterers:
            return [0.0 * h for _ in channels]
        suns = self.grid.sources
        k, fk = self.grid.locate_altitude(h)
        s, fs = self.grid.locate_sun(mu_s)
        buffer = self.reflected if reflected else self.sky
        logs = []
        for node in (k * suns + s, (k + 1) * suns + s):
            guide = [packet(self.log_reference, node + i, size, active) for i in (0, 1)]
            values = [packet(buffer, node + i, size, active) for i in (0, 1)]
            logs.append(
                [
                    dr.lerp(guide[0][c], guide[1][c], fs)
                    + dr.log(dr.maximum(dr.lerp(values[0][c], values[1][c], fs), 1e-30))
                    for c in channels
                ]
            )
        # Geometric between altitudes: at twilight the level below lies in the shadow and the one above in the light.
        above = self._depth_above(h)
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

        def pair(
            i: Any, diagonal: Any, last: Any, before: Any, cos_m: Any, cos_m1: Any, sums: list[Any]
        ) -> tuple[Any, ...]:
            a, b, start, is_diagonal = packet(self._recurrence, i, 4, active)
            new_m = start > 0.0
            diagonal = dr.select(new_m, diagonal * sine * start, diagonal)
            next_cos = dr.select(new_m, 2.0 * cos_phi * cos_m - cos_m1, cos_m)
            cos_m1 = dr.select(new_m, cos_m, cos_m1)
            value = dr.select(is_diagonal > 0.0, diagonal, a * (mu * last - b * before))
            before = dr.select(is_diagonal > 0.0, 0.0, last)
            basis = value * next_cos
            corner = [packet(self.moments, node * stride + i, size, active) for node in nodes]
            moment = [
                _blend([w * scales[i // 2][c] for i, w in enumerate(weights)], [v[c] for v in corner]) * basis
                for c in range(channels)
            ]
            degree = t.UInt(dr.gather(t.Float, self._l, i, active))
            chi = packet(self._chi, degree, kinds * size, active)
            sums = [
                dr.fma(chi[n], moment[n % size], sums[n]) if n % size < channels else sums[n]
                for n in range(kinds * size)
            ]
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
            [dr.zeros(t.Float, width) for _ in range(kinds * size)],
        )
        *_, sums = dr.while_loop(state, lambda i, *_: i < stride, pair, label="scattered")
        return [[dr.maximum(sums[n * size + c], 0.0) for c in range(channels)] for n in range(kinds)]


def _blend(weights: list[Any], values: list[Any]) -> Any:
    total = weights[0] * values[0]
    for weight, value in zip(weights[1:], values[1:], strict=True):
        total = dr.fma(weight, value, total)
    return total


def _sum(moments: Any, order: Order, others: Any, other: Order) -> Any:
    """``moments`` [nodes, pairs, size] of an order plus those of one of equal or lower degree."""
    t, size = types(), order.size
    stored_pairs = [list(zip(*(a.tolist() for a in pairs(o.degree)), strict=True)) for o in (order, other)]
    place = {pair: i for i, pair in enumerate(stored_pairs[1])}
    source = np.array([place.get(pair, -1) for pair in stored_pairs[0]])
    lane = dr.arange(t.UInt, dr.width(moments))
    pair, node = lane // size % len(source), lane // (size * len(source))
    there, held = dr.gather(t.UInt, uints(np.maximum(source, 0)), pair), dr.gather(t.UInt, uints(source >= 0), pair) > 0
    return moments + dr.gather(t.Float, others, (node * len(place) + there) * size + lane % size, held)
