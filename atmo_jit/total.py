"""The sum of the orders of scattering, and what each counts beyond the moments that it was solved for."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from .backend import evaluated, floats, row_size, table_of, types, uints
from .column import SunColumns
from .grid import Grid
from .harmonics import pair_count, pair_index, pairs
from .optics import Optics
from .projection import Moments
from .refinement import Reference, Taps

# Of the reference, squared: order 1 that is weaker, deep in the shadow, says nothing about later orders, and the
# derivative of a quotient, which has a square below the line, must not leave single precision.
DARK = 1e-16
# Depth of air that scatters nothing to speak of: the square of a smaller one, which is below the line in a derivative,
# leaves single precision.
NOTHING = 1e-15
PEAKED = 2  # azimuthal orders, the highest, that tell what becomes of those that an order lacks
SAME = 1e-6  # share of an order, squared, that rounding may be: beside that two orders are multiples of each other
MISSED = 0.03  # of order 2: light that two modes of orders may fail to foretell


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
    t, channels, entries, few = types(), first.channels, pair_count(first.degree), grid.shape[1]
    per_depth = _per_depth(optics, columns, grid)
    # After the moments the irradiance twice: what may be reflected, and what arrives.
    suns, width = len(grid.first_theta), entries + 2
    lane = dr.arange(t.UInt, grid.shape[0] * suns * width * channels)
    channel, place = lane % channels, lane // channels
    entry, node = place % width, place // width
    sun, k = node % suns, node // suns
    total = dr.gather(t.Float, first.values, first.index(k, dr.minimum(entry, entries), sun, channel))
    total = total * dr.gather(t.Float, reference.inverse, node * row_size(channels) + channel)
    if rest:
        later = _rest(optics, grid, reference, first, rest, shares)
        taps = Taps(grid, t.Float(sun) / grid.first, few)
        values = [dr.gather(t.Float, later, ((k * few + at) * width + entry) * channels + channel) for at in taps.at]
        total = total + taps.sum(values, dr.gather(t.Float, parity(grid, first.degree), dr.minimum(entry, entries)))
    moments = dr.zeros(t.Float, grid.shape[0] * suns * entries * channels)
    reflected, sky = (dr.zeros(t.Float, grid.shape[0] * suns * channels) for _ in range(2))
    dr.scatter(moments, total, (node * entries + entry) * channels + channel, entry < entries)
    dr.scatter(reflected, total, node * channels + channel, entry == entries)
    dr.scatter(sky, total, node * channels + channel, entry == entries + 1)
    moments, reflected, sky = evaluated([moments, reflected, sky])
    return moments, _over(grid, sky, per_depth, channels), _over(grid, reflected, per_depth, channels)


def following(
    grid: Grid, reference: Reference, rest: list[Moments], shares: list[tuple[Any, Any]]
) -> list[tuple[Any, Any]]:
    """Shares of the orders that carry derivatives, for those of an extrapolation, which carry none.

    The last three orders foretell those that follow: u_(n+1) = a u_n + b u_(n-1), two modes that fade geometrically,
    with a and b from least squares over altitudes. So the last order counts as 1 / (1 - a - b), the one before as
    1 + b / (1 - a - b), and all others as 1. Shares that were given stay where that misses too much.
    """
    if len(rest) < 2:
        return shares
    t, channels, suns = types(), rest[-1].channels, grid.shape[1]
    wide = t.Float64  # two modes are told apart by a difference of squares
    lane = dr.arange(t.UInt, suns * channels)
    channel, sun = lane % channels, lane // channels
    some = [rest[0], *rest[-3:]]

    def add(i: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
        k, entry = i // 2, i % 2
        scale = dr.gather(t.Float, reference.inverse, reference.index(k, sun, channel))
        u = [wide(scale * dr.gather(t.Float, o.values, o.index(k, entry, sun, channel))) for o in some]
        products = [u[0] * u[0], *(u[i] * u[j] for i in range(1, len(u)) for j in range(i, len(u)))]
        return i + 1, [s + product for s, product in zip(sums, products, strict=True)]

    zeros = [dr.zeros(wide, suns * channels) for _ in range(4 if len(rest) == 2 else 7)]
    end = dr.opaque(t.UInt, 2 * grid.shape[0], 1)
    _, sums = dr.while_loop((t.UInt(0), zeros), lambda i, _: i < end, add, max_iterations=-1, label="following")
    whole, *products = evaluated(sums)
    if len(rest) == 2:
        older = older_before = older_last = dr.zeros(wide, suns * channels)
        before, mixed, last = products
    else:
        older, older_before, older_last, before, mixed, last = products
    lit = before > DARK
    per_before = dr.select(lit, 1.0 / dr.select(lit, before, 1.0), 0.0)
    ratio, shared = mixed * per_before, older_before * per_before
    apart = older - shared * older_before  # what of u_(n-2) is no multiple of u_(n-1), squared
    told = lit & (apart > SAME * older)
    b = dr.select(told, (older_last - shared * mixed) / dr.select(told, apart, 1.0), 0.0)
    a = ratio - b * shared
    missed = dr.maximum(last - a * mixed - b * older_last, 0.0)
    fades = (a + b >= 0.0) & (a + b < 1.0)
    per_left = 1.0 / dr.select(fades, 1.0 - a - b, 1.0)
    known = fades & (dr.detach(missed * per_left * per_left) < MISSED**2 * dr.detach(whole))
    counts = [dr.fma(b, per_left, 1.0), per_left][-min(2, len(rest)) :]
    counts = evaluated([dr.select(known, t.Float(count), 0.0) for count in counts])
    ends = [[dr.select(known, c, share) for share in both] for c, both in zip(counts, shares[-2:], strict=True)]
    return [*([dr.select(known, 1.0, share) for share in both] for both in shares[:-2]), *ends]


def _rest(
    optics: Optics,
    grid: Grid,
    reference: Reference,
    first: Moments,
    rest: list[Moments],
    shares: list[tuple[Any, Any]],
) -> Any:
    """Quotients [K, S, moments and two irradiances, channels] over the reference of the weighed sum of the later
    orders, at their suns.

    An order's forward peak beyond the moments that it has is taken from order 1. Light in a forward peak goes nearly
    straight on, and every further event multiplies its moments of degree l by one factor that does not depend on l, and
    by chi_l. So with n events more than order 1 has, and known moments up to degree L and azimuthal order M,

        L_lm = L_lm(order 1) r_l                          for l <= L, m > M,
        L_lm = L_lm(order 1) r_L (chi_l / chi_L)^n        for l > L,

    where r_l is how order and order 1 compare at degree l, m = M - 1 and M: lower ones, m = 0 above all, which has the
    horizon in it, fade otherwise from order to order than those that are lacking.
    """
    t, channels, entries, (altitudes, suns) = types(), first.channels, pair_count(first.degree), grid.shape
    alike: dict[tuple[int, int], list[tuple[int, Moments, tuple[Any, Any]]]] = {}
    for events, (order, counts) in enumerate(zip(rest, shares, strict=True), 1):
        alike.setdefault((order.degree, order.most), []).append((events, order, counts))
    parts = [
        (group[0][1], _weighed(grid, group), _peaks(optics, grid, reference, first, group)) for group in alike.values()
    ]
    lane = dr.arange(t.UInt, altitudes * suns * (entries + 2) * channels)
    channel, place = lane % channels, lane // channels
    entry, node = place % (entries + 2), place // (entries + 2)
    sun, k = node % suns, node // suns
    moment = entry < entries
    sharp, total = None, 0.0
    for order, weighed, peaks in parts:
        # Place + 1 among the moments of the orders; after them come the irradiances.
        there = dr.gather(t.UInt, _places(grid, first, order), dr.minimum(entry, entries))
        there = dr.select(moment, there, entry - entries + order.entries)
        held = there > 0
        index = (node * (order.entries + 1) + dr.maximum(there, 1) - 1) * channels + channel
        total = total + dr.gather(t.Float, weighed, index, held, mode=dr.ReduceMode.NoConflicts)
        if peaks is None:
            continue
        if sharp is None:
            index = first.index(k, dr.minimum(entry, entries), sun * grid.first, channel)
            sharp = dr.gather(t.Float, first.values, index, moment, mode=dr.ReduceMode.NoConflicts)
            l_ = dr.gather(t.UInt, _degrees(grid, first.degree), dr.minimum(entry, entries))
            size = (l_ * (altitudes * suns) + node) * channels + channel
        ratio = dr.gather(t.Float, peaks, size, ~held, mode=dr.ReduceMode.Expand)
        total = dr.fma(sharp, ratio, total)
    total = total * dr.gather(t.Float, reference.inverse, reference.index(k, sun, channel))
    return evaluated(total)


def _weighed(grid: Grid, orders: list[tuple[int, Moments, tuple[Any, Any]]]) -> Any:
    """Sum over orders of one degree of what they have, times what that counts: moments, and the irradiance as it
    reflects and as it arrives, [K, S, entries + 1, channels]."""
    light, (altitudes, suns) = orders[0][1], grid.shape
    t, channels, rows = types(), light.channels, light.entries + 1
    lane = dr.arange(t.UInt, altitudes * suns * rows * channels)
    channel, place = lane % channels, lane // channels
    entry, node = place % rows, place // rows
    sun, k = node % suns, node // suns
    arrives, total = entry == rows - 1, 0.0
    for _, order, both in orders:
        value = dr.gather(t.Float, order.values, order.index(k, dr.minimum(entry, rows - 2), sun, channel))
        counted, arriving = (dr.gather(t.Float, share, sun * channels + channel) for share in both)
        total = dr.fma(value, dr.select(arrives, arriving, counted), total)
    return evaluated(total)


def _peaks(
    optics: Optics,
    grid: Grid,
    reference: Reference,
    first: Moments,
    orders: list[tuple[int, Moments, tuple[Any, Any]]],
) -> Any:
    """What order 1's moments of degree l count in the sum of orders of one degree where these have none, [l, K, S,
    channels]; None: they have all."""
    light, (altitudes, suns) = orders[0][1], grid.shape
    if light.entries == first.entries:
        return None
    t, channels = types(), first.channels
    lane = dr.arange(t.UInt, (first.degree + 1) * altitudes * suns * channels)
    channel, node = lane % channels, lane // channels
    l_ = node // (altitudes * suns)
    fading = _fading(optics, l_, light.degree, first.degree, channel)
    known = lane - (l_ - dr.minimum(l_, light.degree)) * (altitudes * suns * channels)
    total, faded, done = 0.0, 1.0, 0
    for events, order, (counted, _) in orders:
        for _ in range(events - done):
            faded = faded * fading
        done = events
        ratio = dr.gather(t.Float, _peak(grid, reference, first, order), known)
        total = dr.fma(faded * dr.gather(t.Float, counted, node % suns * channels + channel), ratio, total)
    return evaluated(total)


def _fading(optics: Optics, l_: Any, degree: int, highest: int, channel: Any) -> Any:
    """chi_l / chi_L of the ``channel`` for l above L = ``degree``, 1 below. Beyond degree 2 only aerosols scatter; of
    several, the sharpest keeps its peak longest."""
    t, channels, kinds = types(), optics.channel_count, len(optics.scatterers)
    moments, length = optics.phase_moments(highest + 1), row_size(kinds * channels)
    chi = []
    for at in (l_, dr.minimum(l_, degree)):
        of_kinds = [dr.gather(t.Float, moments, at * length + n * channels + channel) for n in range(kinds)]
        largest = of_kinds[0]
        for value in of_kinds[1:]:
            largest = dr.maximum(largest, value)
        chi.append(largest)
    high, low = chi
    return dr.select(low > 0.0, dr.clip(high / dr.select(low > 0.0, low, 1.0), 0.0, 1.0), 0.0)


def _peak(grid: Grid, reference: Reference, first: Moments, order: Moments) -> Any:
    """r_l of an order's forward peak, [l, K, S, channels]."""
    t, channels, (altitudes, suns) = types(), first.channels, grid.shape
    lane = dr.arange(t.UInt, (order.degree + 1) * altitudes * suns * channels)
    channel, node = lane % channels, lane // channels
    sun, node = node % suns, node // suns
    sun = dr.maximum(sun, int(grid.whole_suns))  # under the zenith light has m = 0 alone: the next sun's ratio holds
    k, l_ = node % altitudes, node // altitudes
    product, square = 0.0, 0.0
    scale = dr.gather(t.Float, reference.inverse, reference.index(k, sun, channel))
    for m in range(max(min(order.most, 1), order.most - PEAKED + 1), order.most + 1):
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
    return evaluated(dr.select(lit, dr.maximum(product, 0.0) / dr.select(lit, square, 1.0), 0.0))


def _degrees(grid: Grid, degree: int) -> Any:
    """l of every pair, and 0 for the irradiance."""
    return grid.kept(("degrees", degree), lambda: uints(np.append(pairs(degree)[0], 0)))


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
    optics = optics.spread(grid.shape[0])
    above = optics.scattering_depths(columns.upward(grid.kept("altitudes", lambda: floats(grid.h)), optics))
    inverse = [dr.select(d > NOTHING, 1.0 / dr.select(d > NOTHING, d, 1.0), 0.0) for d in above]
    return table_of(inverse, dr.arange(types().UInt, grid.shape[0]))


def _over(grid: Grid, irradiance: Any, per_depth: Any, channels: int) -> Any:
    """Irradiance [K, suns, channels] over the scattering depth of the air above: finite at the top, where both vanish,
    and smooth up to it."""
    t = types()
    altitudes, width = grid.shape[0], len(grid.first_theta) * channels
    lane = dr.arange(t.UInt, altitudes * width)

    def over(level: Any) -> Any:
        column = lane % width
        depth = dr.gather(t.Float, per_depth, level * row_size(channels) + column % channels)
        return dr.gather(t.Float, irradiance, level * width + column) * depth

    # At the top itself 0 / 0: the quotient goes on as it changed over the interval below.
    level = lane // width
    near, far = (dr.maximum(over(dr.opaque(t.UInt, altitudes - 1 - n, 1)), 1e-30) for n in (1, 2))
    # By logarithms: the derivative of near / far has the square of far in it, which leaves single precision.
    steady = near * dr.exp(dr.clip(dr.log(near) - dr.log(far), np.log(0.25), np.log(4.0)))
    return evaluated(dr.select(level >= altitudes - 1, steady, over(level)))
