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

from .backend import floats, packet, padded, row, row_size, stored, table_of, types, uints
from .column import SunColumns
from .grid import Grid, split
from .harmonics import pair_count, pair_index, pairs, recurrence
from .optics import Optics
from .paths import lagrange
from .projection import Moments
from .refinement import Reference, Taps


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
        sign = dr.gather(t.Float, _parity(grid, self.degree), entry) if entries > 1 else 1.0
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


def total_of(
    optics: Optics,
    columns: SunColumns,
    grid: Grid,
    reference: Reference,
    first: Moments,
    rest: list[Moments],
    shares: list[tuple[Any, Any]],
) -> tuple[Any, Any, Any]:
    """Moments, sky and reflected irradiance of a Field from order 1 and the later ones.

    ``shares``, per later order: what it counts [S, channels] in the light that scatters or reflects once more, and in
    the light that arrives.
    """
    counted, arriving = ([pair[i] for pair in shares] for i in (0, 1))
    entries = pair_count(first.degree)
    per_depth = _per_depth(optics, columns, grid)
    peaks = [
        _peak(optics, grid, first, order, n) if order.entries < first.entries else None
        for n, order in enumerate(rest, 1)
    ]
    return (
        _sum(grid, reference, first, rest, counted, 0, entries, peaks),
        _over(grid, _sum(grid, reference, first, rest, arriving, entries, 1), per_depth, first.channels),
        _over(grid, _sum(grid, reference, first, rest, counted, entries, 1), per_depth, first.channels),
    )


def _sum(
    grid: Grid,
    reference: Reference,
    first: Moments,
    rest: list[Moments],
    shares: list[Any],
    start: int,
    entries: int,
    peaks: list[Any] | None = None,
) -> Any:
    """Quotients [K, first suns, entries, channels] over the reference of the weighed sum of orders, from entry
    ``start`` of order 1 on."""
    t, channels = types(), first.channels
    suns, few = len(grid.first_theta), grid.shape[1]
    lane = dr.arange(t.UInt, grid.shape[0] * suns * entries * channels)
    channel, place = lane % channels, lane // channels
    entry, node = place % entries, place // entries
    sun, k = node % suns, node // suns
    total = dr.gather(t.Float, first.values, first.index(k, start + entry, sun, channel))
    total = total * dr.gather(t.Float, reference.inverse, node * channels + channel)
    if rest:
        later = _rest(grid, reference, first, rest, shares, start, entries, peaks)
        taps = Taps(grid, t.Float(sun) / grid.first, few)
        values = [dr.gather(t.Float, later, ((k * few + at) * entries + entry) * channels + channel) for at in taps.at]
        total = total + taps.sum(values, dr.gather(t.Float, _parity(grid, first.degree), start + entry))
    dr.eval(total)
    return total


def _rest(
    grid: Grid,
    reference: Reference,
    first: Moments,
    rest: list[Moments],
    shares: list[Any],
    start: int,
    entries: int,
    peaks: list[Any] | None,
) -> Any:
    """The same of the later orders, at their suns [K, S, entries, channels]."""
    t, channels, suns = types(), rest[0].channels, grid.shape[1]
    lane = dr.arange(t.UInt, grid.shape[0] * suns * entries * channels)
    channel, place = lane % channels, lane // channels
    entry, node = place % entries, place // entries
    sun, k = node % suns, node // suns
    total = 0.0
    sharp = None
    if peaks and any(peak is not None for peak in peaks):
        sharp = dr.gather(t.Float, first.values, first.index(k, entry, sun * grid.first, channel))
    for order, share, peak in zip(rest, shares, peaks or [None] * len(rest), strict=True):
        there = dr.gather(t.UInt, _places(grid, first, order), start + entry)
        held = there > 0
        index = order.index(k, dr.maximum(there, 1) - 1, sun, channel)
        weight = dr.gather(t.Float, share, sun * channels + channel)
        value = dr.gather(t.Float, order.values, index, held)
        if peak is not None:
            size, fading = peak
            l_ = dr.minimum(dr.gather(t.UInt, _degrees(grid, first.degree), entry), order.degree)
            more = dr.gather(t.Float, size, ((l_ * grid.shape[0] + k) * suns + sun) * channels + channel)
            value = dr.select(held, value, sharp * more * dr.gather(t.Float, fading, entry * channels + channel))
        total = dr.fma(value, weight, total)
    total = total * dr.gather(t.Float, reference.inverse, reference.index(k, sun, channel))
    dr.eval(total)
    return total


def _peak(optics: Optics, grid: Grid, first: Moments, order: Moments, events: int) -> tuple[Any, Any]:
    """Forward peak of an order beyond the moments that it has, as a part of order 1: (size [l, K, S, channels], fading
    [entries, channels]).

    Light in a forward peak goes nearly straight on, and every further event multiplies its moments of degree l by one
    factor that does not depend on l, and by chi_l. So with n ``events`` more than order 1 has, and known moments up to
    degree L and azimuthal order M,

        L_lm = L_lm(order 1) r_l                          for l <= L, m > M,
        L_lm = L_lm(order 1) r_L (chi_l / chi_L)^n        for l > L,

    where r_l is how order and order 1 compare at degree l, m >= 1: m = 0 has the horizon in it.
    """
    t, channels, kinds, (altitudes, suns) = types(), first.channels, len(optics.scatterers), grid.shape
    lane = dr.arange(t.UInt, (order.degree + 1) * altitudes * suns * channels)
    channel, node = lane % channels, lane // channels
    sun, node = node % suns, node // suns
    k, l_ = node % altitudes, node // altitudes
    product, square = 0.0, 0.0
    for m in range(min(order.most, 1), order.most + 1):
        held = l_ >= m
        # Places of (l, m) are consecutive in l.
        a, b = (
            dr.gather(t.Float, light.values, light.index(k, l_ - m + pair_index(light.degree, m, m), there, channel), held)
            for light, there in ((first, sun * grid.first), (order, sun))
        )
        product, square = dr.fma(a, b, product), dr.fma(a, a, square)
    size = dr.select(square > 0.0, dr.maximum(product, 0.0) / dr.select(square > 0.0, square, 1.0), 0.0)

    l_ = _degrees(grid, first.degree)
    moments = optics.phase_moments(first.degree + 1)
    there, last = (row(moments, at, kinds * channels) for at in (l_, dr.minimum(l_, order.degree)))
    values = []
    for c in range(channels):
        # Beyond degree 2 only aerosols scatter; of several, the sharpest keeps its peak longest.
        high, low = there[c], last[c]
        for n in range(1, kinds):
            high, low = dr.maximum(high, there[n * channels + c]), dr.maximum(low, last[n * channels + c])
        quotient = dr.select(low > 0.0, dr.clip(high / dr.select(low > 0.0, low, 1.0), 0.0, 1.0), 0.0)
        power = quotient
        for _ in range(events - 1):
            power = power * quotient
        values.append(power)
    fading = dr.ravel(t.ArrayXf(values), order="F")
    dr.eval(size, fading)
    return size, fading


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
    dr.eval(total)
    return total


def _degrees(grid: Grid, degree: int) -> Any:
    """l of every pair."""
    return grid.kept(("degrees", degree), lambda: uints(pairs(degree)[0]))


def _places(grid: Grid, light: Moments, lower: Moments) -> Any:
    """Place + 1 among the entries of ``lower`` for every entry of ``light``; 0: it is not there."""

    def find() -> Any:
        stored_pairs = [
            list(zip(*(a[: moments.entries - 1].tolist() for a in pairs(moments.degree)), strict=True))
            for moments in (light, lower)
        ]
        place = {pair: i + 1 for i, pair in enumerate(stored_pairs[1])}
        return uints([*(place.get(pair, 0) for pair in stored_pairs[0]), len(place) + 1])

    return grid.kept(("places", light.degree, lower.degree, lower.most), find)


def _parity(grid: Grid, degree: int) -> Any:
    """(-1)^m of every entry."""
    return grid.kept(("parity", degree), lambda: floats(np.append(1.0 - 2.0 * (pairs(degree)[1] % 2), 1.0)))


def _per_depth(optics: Optics, columns: SunColumns, grid: Grid) -> Any:
    """1 / scattering depth of the air above, table [K, channels]; 0 where there is none."""
    above = optics.scattering_depths(columns.upward(grid.kept("altitudes", lambda: floats(grid.h))))
    inverse = [dr.select(d > 0.0, 1.0 / dr.select(d > 0.0, d, 1.0), 0.0) for d in above]
    return table_of(inverse, dr.arange(types().UInt, grid.shape[0]))


def _over(grid: Grid, irradiance: Any, per_depth: Any, channels: int) -> Any:
    """Irradiance [K, suns, channels] over the scattering depth of the air above: finite at the top, where both vanish,
    and smooth up to it."""
    t = types()
    altitudes, width = grid.shape[0], len(grid.first_theta) * channels
    lane = dr.arange(t.UInt, altitudes * width)
    quotient = irradiance * dr.gather(t.Float, per_depth, lane // width * row_size(channels) + lane % channels)
    dr.eval(quotient)
    # At the top itself 0 / 0: the quotient goes on as it changed over the interval below.
    end = altitudes * width - width + lane % width
    near, far = (dr.maximum(dr.gather(t.Float, quotient, end - n * width), 1e-30) for n in (1, 2))
    steady = near * dr.clip(near / far, 0.25, 4.0)
    quotient = dr.select(lane >= (altitudes - 1) * width, steady, quotient)
    dr.eval(quotient)
    return quotient
