"""The sum of the orders of scattering, and what each counts beyond the moments that it was solved for."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from .backend import evaluated, floats, row, row_size, table_of, types, uints
from .column import SunColumns
from .grid import Grid
from .harmonics import pair_count, pair_index, pairs
from .optics import Optics
from .projection import Moments
from .refinement import Reference, Taps

# Of the reference, squared: order 1 that is weaker, deep in the shadow, says nothing about later orders, and the
# derivative of a quotient, which has a square below the line, must not leave single precision.
DARK = 1e-16


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
        _peak(optics, grid, reference, first, order, n) if order.entries < first.entries else None
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
        total = total + taps.sum(values, dr.gather(t.Float, parity(grid, first.degree), start + entry))
    return evaluated(total)


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
    return evaluated(total)


def _peak(
    optics: Optics, grid: Grid, reference: Reference, first: Moments, order: Moments, events: int
) -> tuple[Any, Any]:
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
    scale = dr.gather(t.Float, reference.inverse, reference.index(k, sun, channel))
    for m in range(min(order.most, 1), order.most + 1):
        held = l_ >= m
        # Places of (l, m) are consecutive in l.
        a, b = (
            scale * dr.gather(t.Float, light.values, light.index(k, l_ - m + start, there, channel), held)
            for light, there, start in (
                (first, sun * grid.first, pair_index(first.degree, m, m)),
                (order, sun, pair_index(order.degree, m, m)),
            )
        )
        product, square = dr.fma(a, b, product), dr.fma(a, a, square)
    lit = square > DARK
    size = dr.select(lit, dr.maximum(product, 0.0) / dr.select(lit, square, 1.0), 0.0)

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
    return evaluated(size), evaluated(fading)


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


def parity(grid: Grid, degree: int) -> Any:
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
    quotient = evaluated(quotient)
    # At the top itself 0 / 0: the quotient goes on as it changed over the interval below.
    end = altitudes * width - width + lane % width
    near, far = (dr.maximum(dr.gather(t.Float, quotient, end - n * width), 1e-30) for n in (1, 2))
    steady = near * dr.clip(near / far, 0.25, 4.0)
    return evaluated(dr.select(lane >= (altitudes - 1) * width, steady, quotient))
