"""The step from one order of scattering to the next, along straight paths between the nodes.

For visit t of a path and sun s there: G_m = sum_l P_lm(mu_t) (sum_c W_c chi_l^c) L_lm(h_t, s); the radiance at the
path's origin is the sum over t and m of cos(m phi_t) G_m(t, s_t). The weights W contain all optics and no sun; sun
angle s_t and azimuth phi_t at a visit are geometry. Ground reflection joins m = 0 at the last visit of a path that
ends on the ground. G is tabulated at the solved suns and interpolated cubically between them: its table stays small
enough for the cache.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import drjit as dr
import numpy as np

from .backend import floats, packet, padded, scatter_packet, stored, types
from .geometry import safe_sine
from .grid import Grid
from .harmonics import legendre, pair_count
from .march import relative_azimuth
from .optics import Optics
from .path_weights import PathWeights
from .paths import Directions, paths_along
from .quadrature import half_circle
from .refinement import Order, Refinement


class Samples:
    """Where sun and azimuth stand at every visit of the paths, for every solved sun and azimuth: geometry that serves
    every order.

    ``sun``: coordinate in units of the solved suns, ``cos_phi``: [visits, S, azimuths].
    """

    def __init__(self, grid: Grid, directions: Directions, azimuths: int) -> None:
        t = types()
        self.paths = paths = paths_along(grid, directions, grid.refine)
        suns, device = grid.shape[1], self.paths.device
        lane = dr.arange(t.UInt, len(paths.station) * suns * azimuths)
        azimuth, rest = lane % azimuths, lane // azimuths
        sun, station = rest % suns, dr.gather(t.UInt, device.station, rest // suns)
        cos_phi = dr.gather(t.Float, floats(np.cos(half_circle(azimuths))), azimuth)
        mu_s, sin_s = (dr.gather(t.Float, floats(f(grid.theta)), sun) for f in (np.cos, np.sin))
        mu0 = dr.gather(t.Float, device.mu_start, dr.gather(t.UInt, device.ray, station))
        mu, cos_turn, sin_turn = (dr.gather(t.Float, b, station) for b in (device.mu, device.cos_turn, device.sin_turn))
        nu = dr.fma(mu0, mu_s, safe_sine(mu0) * sin_s * cos_phi)
        turned = dr.clip(dr.fma(cos_turn, mu_s, sin_turn * sin_s * cos_phi), -1.0, 1.0)
        self.sun = grid.sun_position(turned) / grid.sun_refine
        self.cos_phi = relative_azimuth(mu, turned, nu)
        dr.eval(self.sun, self.cos_phi)
        self._basis: dict[int, Any] = {}

    def basis(self, degree: int) -> Any:
        """P_lm(mu) at the visits, [visits, pairs]."""
        if degree not in self._basis:
            self._basis[degree] = floats(legendre(degree, self.paths.mu[self.paths.station]))
        return self._basis[degree]


@lru_cache(maxsize=16)
def _samples(grid: Grid, directions: Directions, azimuths: int) -> Samples:
    return Samples(grid, directions, azimuths)


class Gather:
    """The step from one order to the next for one atmosphere."""

    def __init__(self, optics: Optics, grid: Grid, directions: Directions, azimuths: int) -> None:
        self.optics, self.grid, self.directions, self.azimuths = optics, grid, directions, azimuths
        self.samples = _samples(grid, directions, azimuths)
        self.paths = self.samples.paths
        self.size = padded(optics.channel_count)
        self._weights = PathWeights(optics, self.paths)

    def __call__(self, refine: Refinement, light: Order) -> Any:
        """Radiance at the solved nodes, [K, D, S, azimuths, size], of ``light`` after one more event."""
        t, size, channels = types(), self.size, self.optics.channel_count
        samples, device, fine = self.samples, self.paths.device, self.grid.sun_refine
        suns, sources, azimuths, orders = self.grid.shape[1], self.grid.sources, self.azimuths, light.degree + 1
        contracted = self._contract(refine.altitudes(light.moments), light.sky, light.degree)
        count = dr.opaque(t.UInt, orders, 1)
        per_visit = suns * azimuths
        lane = dr.arange(t.UInt, len(self.paths.h) * per_visit)
        ray, sample = lane // per_visit, lane % per_visit
        start, stop = dr.gather(t.UInt, device.first_visit, ray), dr.gather(t.UInt, device.first_visit, ray + 1)

        def visit(i: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
            place = i * per_visit + sample
            x, cos_phi = dr.gather(t.Float, samples.sun, place), dr.gather(t.Float, samples.cos_phi, place)
            s = dr.minimum(t.UInt(x), suns - 2)
            taps = _cubic(x - t.Float(s))
            # The table has one more sun before the first and after the last.
            at = [dr.fma(dr.fma(i, suns + 2, s + n), count, 0) for n in range(4)]

            def harmonic(m: Any, inner: list[Any], cos_m: Any, cos_m1: Any) -> tuple[Any, ...]:
                corner = [packet(contracted, a + m, size) for a in at]
                for c in range(channels):
                    value = taps[0] * corner[0][c]
                    for tap, values in zip(taps[1:], corner[1:], strict=True):
                        value = dr.fma(tap, values[c], value)
                    inner[c] = dr.fma(value, cos_m, inner[c])
                return m + 1, inner, dr.fma(2.0 * cos_phi, cos_m, -cos_m1), cos_m

            nothing = [0.0 * x for _ in range(channels)]
            state = (t.UInt(0), nothing, 0.0 * x + 1.0, cos_phi + 0.0)
            _, inner, _, _ = dr.while_loop(state, lambda m, *_: m < count, harmonic, label="harmonics")
            x = x * fine
            s = dr.minimum(t.UInt(x), sources - 2)
            f = x - t.Float(s)
            there = dr.gather(t.UInt, device.level, i) * sources + s
            low, high = packet(refine.log_reference, there, size), packet(refine.log_reference, there + 1, size)
            scale = [dr.exp(dr.fma(f, high[c] - low[c], low[c])) for c in range(channels)]
            return i + 1, [dr.fma(scale[c], inner[c], sums[c]) for c in range(channels)]

        zero = [dr.zeros(t.Float, dr.width(lane)) for _ in range(channels)]
        _, sums = dr.while_loop((start, zero), lambda i, _: i < stop, visit, label="gather")
        return stored([dr.maximum(s, 0.0) for s in sums], lane, size)

    def _contract(self, moments: Any, sky: Any, degree: int) -> Any:
        """G [visits, S + 2, m, size] over the reference: ``moments`` [levels, S, pairs, size] seen along each path,
        weighed and summed over l.

        The first sun mirrors the second (the sun has passed through the zenith: (-1)^m), the last goes straight on.
        """
        t, device, optics = types(), self.paths.device, self.optics
        size, channels, suns, orders = self.size, optics.channel_count, self.grid.shape[1], degree + 1
        pair_total, visits, kinds = pair_count(degree), len(self.paths.station), len(optics.scatterers)
        # Weight times phase moment, [visits, l, size].
        chi = optics.phase_moments(degree, size)
        lane = dr.arange(t.UInt, visits * orders)
        visit, l_ = lane // orders, lane % orders
        products = [dr.zeros(t.Float, dr.width(lane)) for _ in range(channels)]
        for n in range(kinds):
            moment = packet(chi, l_ * kinds + n, size)
            for c in range(channels):
                products[c] = dr.fma(
                    dr.gather(t.Float, self._weights.weights[n * channels + c], visit), moment[c], products[c]
                )
        weights = stored(products, lane, size)

        basis = self.samples.basis(degree)
        # Suns vary fastest: eight neighbouring lanes share path and m, and run equally long loops.
        lane = dr.arange(t.UInt, visits * orders * suns)
        sun, rest = lane % suns, lane // suns
        m, visit = rest % orders, rest // orders
        node = dr.gather(t.UInt, device.level, visit) * suns + sun
        first = m * (2 * degree + 3 - m) // 2 - m  # place of (l, m) is first + l

        def add(l_: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
            value = dr.gather(t.Float, basis, visit * pair_total + first + l_)
            weight = packet(weights, visit * orders + l_, size)
            moment = packet(moments, node * pair_total + first + l_, size)
            return l_ + 1, [dr.fma(value * weight[c], moment[c], sums[c]) for c in range(channels)]

        zero = [dr.zeros(t.Float, dr.width(lane)) for _ in range(channels)]
        end = dr.opaque(t.UInt, orders, 1)
        _, sums = dr.while_loop((m + 0, zero), lambda l_, _: l_ < end, add, label="contract")
        # The ground scatters into every direction alike: it joins m = 0 at the visit where a path ends on it.
        light = packet(sky, sun, size, m == 0)
        reflected = [dr.gather(t.Float, b, visit, m == 0) for b in self._weights.reflected]
        sums = [dr.fma(a, b, c) for a, b, c in zip(reflected, light, sums, strict=False)]
        table = dr.zeros(t.Float, visits * (suns + 2) * orders * size)
        scatter_packet(table, sums, (visit * (suns + 2) + sun + 1) * orders + m, size)
        dr.eval(table)
        lane = dr.arange(t.UInt, visits * orders)
        m, start = lane % orders, lane // orders * (suns + 2)
        mirrored = packet(table, (start + 2) * orders + m, size)
        last, before = (
            packet(table, (start + suns) * orders + m, size),
            packet(table, (start + suns - 1) * orders + m, size),
        )
        sign = dr.select(m % 2 == 1, -1.0, 1.0)
        scatter_packet(table, [sign * v for v in mirrored], start * orders + m, size)
        scatter_packet(
            table, [2.0 * a - b for a, b in zip(last, before, strict=True)], (start + suns + 1) * orders + m, size
        )
        dr.eval(table)
        return table


def _cubic(f: Any) -> list[Any]:
    """Catmull-Rom weights of the four nodes about a fraction ``f`` of the middle interval."""
    g = 1.0 - f
    return [
        -0.5 * f * g * g,
        dr.fma(f * f, dr.fma(1.5, f, -2.5), 1.0),
        dr.fma(g * g, dr.fma(1.5, g, -2.5), 1.0),
        -0.5 * g * f * f,
    ]
