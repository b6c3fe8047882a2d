"""The step from one order of scattering to the next, along straight paths between the nodes.

For visit t of a path and sun s' there: G_m = sum_l P_lm(mu_t) (sum_c W_c chi_l^c) L_lm(h_t, s'); the radiance at the path's origin is
the sum over t and m of cos(m phi_t) G_m(t, s_t). The weights W contain all optics and no sun; sun angle s_t and azimuth phi_t at a
visit are geometry. Ground reflection joins m = 0 at the last visit of a path that ends on the ground.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from .backend import floats, packet, padded, stored, types, uints
from .geometry import safe_sine
from .grid import Grid
from .harmonics import legendre, pair_count
from .march import relative_azimuth
from .optics import Optics
from .path_weights import PathWeights
from .paths import Directions, Paths
from .quadrature import half_circle
from .refinement import Order, Refinement


class Gather:
    """The step from one order to the next: path weights of an atmosphere, and the march over the path nodes."""

    def __init__(self, optics: Optics, grid: Grid, directions: Directions, azimuths: int) -> None:
        self.optics, self.grid, self.directions, self.azimuths = optics, grid, directions, azimuths
        self.paths = Paths.trace(grid, directions, grid.refine)
        self._weights = PathWeights(optics, self.paths)
        self.size = padded(optics.channel_count)
        self._place_samples()

    def _place_samples(self) -> None:
        """Sun coordinate and azimuth cosine at every visit, sun node and azimuth: they serve every order."""
        t, p, grid = types(), self.paths, self.grid
        suns, azimuths = grid.shape[1], self.azimuths
        lane = dr.arange(t.UInt, len(p.station) * suns * azimuths)
        azimuth, rest = lane % azimuths, lane // azimuths
        sun, visit = rest % suns, rest // suns
        cos_phi = dr.gather(t.Float, floats(np.cos(half_circle(azimuths))), azimuth)
        mu_s, sin_s = (
            dr.gather(t.Float, floats(np.cos(grid.theta)), sun),
            dr.gather(t.Float, floats(np.sin(grid.theta)), sun),
        )
        mu0, mu, cos_turn, sin_turn = (
            dr.gather(t.Float, floats(a[p.station]), visit) for a in (p.mu_start[p.ray], p.mu, p.cos_turn, p.sin_turn)
        )
        nu = dr.fma(mu0, mu_s, safe_sine(mu0) * sin_s * cos_phi)
        turned = dr.clip(dr.fma(cos_turn, mu_s, sin_turn * sin_s * cos_phi), -1.0, 1.0)
        self._sun = grid.sun_position(turned)
        self._cos_phi = relative_azimuth(mu, turned, nu)
        dr.eval(self._sun, self._cos_phi)

    def __call__(self, refine: Refinement, light: Order) -> Any:
        """Radiance at the solved nodes, [K, D, S, azimuths, size], of ``light`` after one more event."""
        t, p, size, channels = types(), self.paths, self.size, self.optics.channel_count
        suns, sources, azimuths, orders = self.grid.shape[1], self.grid.sources, self.azimuths, light.degree + 1
        contracted = refine.suns(
            self._contract(refine.altitudes(light.moments), light.sky, light.degree), len(p.station)
        )
        per_visit = suns * azimuths
        lane = dr.arange(t.UInt, len(p.h) * per_visit)
        ray, sample = lane // per_visit, lane % per_visit
        first = uints(p.first_visit)
        start, stop = dr.gather(t.UInt, first, ray), dr.gather(t.UInt, first, ray + 1)
        level = uints(p.level)

        def visit(i: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
            place = i * per_visit + sample
            x, cos_phi = dr.gather(t.Float, self._sun, place), dr.gather(t.Float, self._cos_phi, place)
            s = dr.minimum(t.UInt(x), sources - 2)
            f = x - t.Float(s)
            there = dr.gather(t.UInt, level, i) * sources + s
            low, high = packet(refine.log_reference, there, size), packet(refine.log_reference, there + 1, size)
            at = i * sources + s
            inner = [0.0] * channels
            cos_m, cos_m1 = t.Float(1.0), cos_phi
            for m in range(orders):
                a, b = packet(contracted, at * orders + m, size), packet(contracted, (at + 1) * orders + m, size)
                for c in range(channels):
                    inner[c] = dr.fma(dr.fma(f, b[c] - a[c], a[c]), cos_m, inner[c])
                cos_m, cos_m1 = dr.fma(2.0 * cos_phi, cos_m, -cos_m1), cos_m
            scale = [dr.exp(dr.fma(f, high[c] - low[c], low[c])) for c in range(channels)]
            return i + 1, [dr.fma(scale[c], inner[c], sums[c]) for c in range(channels)]

        zero = [dr.zeros(t.Float, dr.width(lane)) for _ in range(channels)]
        _, sums = dr.while_loop((start, zero), lambda i, _: i < stop, visit, label="gather")
        return stored([dr.maximum(s, 0.0) for s in sums], lane, size)

    def _contract(self, moments: Any, sky: Any, degree: int) -> Any:
        """G [visits, S, m, size] over the reference: ``moments`` [levels, S, pairs, size] seen along each path, weighed and summed over l."""
        t, p, optics = types(), self.paths, self.optics
        size, channels, suns, orders = self.size, optics.channel_count, self.grid.shape[1], degree + 1
        pair_total = pair_count(degree)
        visits = len(p.station)
        # Weight times phase moment, [visits, l, size].
        chi = [optics.phase_moments(k, degree) for k in optics.scatterers]
        lane = dr.arange(t.UInt, visits * orders)
        visit, l_ = lane // orders, lane % orders
        products = [dr.zeros(t.Float, dr.width(lane)) for _ in range(channels)]
        for n in range(len(chi)):
            for c in range(channels):
                weight = dr.gather(t.Float, self._weights.weights[n * channels + c], visit)
                products[c] = dr.fma(weight, dr.gather(t.Float, chi[n][c], l_), products[c])
        weights = stored(products, lane, size)

        basis = floats(legendre(degree, p.mu[p.station]))  # [visits, pairs]
        lane = dr.arange(t.UInt, visits * suns * orders)
        m, rest = lane % orders, lane // orders
        sun, visit = rest % suns, rest // suns
        node = dr.gather(t.UInt, uints(p.level), visit) * suns + sun
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
        return stored(
            [dr.fma(dr.gather(t.Float, self._weights.reflected[c], visit, m == 0), light[c], sums[c]) for c in range(channels)],
            lane,
            size,
        )
