"""The step from one order of scattering to the next, along straight paths between the nodes.

For visit t of a path and sun s there: G_m = sum_l P_lm(mu_t) (sum_c W_c chi_l^c) L_lm(h_t, s); the radiance at the
path's origin is the sum over t and m of cos(m phi_t) G_m(t, s_t). The weights W contain all optics and no sun; sun
angle s_t and azimuth phi_t at a visit are geometry. Ground reflection joins m = 0 at the last visit of a path that
ends on the ground. G is tabulated at the solved suns and interpolated cubically between them: its table stays small
enough for the cache.

A path turns little about the planet's centre, so that what arrives with azimuthal order m left with nearly the same:
moments of a higher m than the result keeps are left out, of whatever degree they are.
"""

from __future__ import annotations

from copy import copy
from functools import cached_property
from typing import Any

import drjit as dr
import numpy as np

from . import noted
from .backend import evaluated, floats, packet, row, row_size, stored, table, table_of, types, uints
from .geometry import safe_sine
from .grid import Grid, cubic
from .harmonics import legendre, pair_index, pairs
from .march import relative_azimuth
from .optics import Optics
from .path_weights import PathWeights
from .paths import Directions, Paths, paths_along
from .projection import Moments, add_harmonics, room, stored_harmonics
from .quadrature import half_circle
from .refinement import Reference
from .transposed import Readers, by_moments, by_table, by_weights, multilinear

FAINT = 1e-15  # light of which no quotient is made: a derivative has its square below the line


class Samples:
    """Where sun and azimuth stand at every visit of the paths, for every solved sun and azimuth: geometry that serves
    every order.

    ``place`` [visits, S, azimuths, 2]: sun coordinate and cos phi.
    """

    def __init__(self, grid: Grid, directions: Directions, azimuths: int) -> None:
        t = types()
        self.paths = paths = paths_along(grid, directions, 1)
        suns = grid.shape[1]
        lane = dr.arange(t.UInt, len(paths.station) * suns * azimuths)
        azimuth, rest = lane % azimuths, lane // azimuths
        sun, visit = rest % suns, rest // suns
        cos_phi = dr.gather(t.Float, floats(np.cos(half_circle(azimuths))), azimuth)
        mu_s, sin_s = packet(floats(np.column_stack([np.cos(grid.theta), np.sin(grid.theta)])), sun, 2)
        # One packet per visit: gathers of single numbers take long to compile.
        of_visit = paths.station
        turns = paths.cos_turn[of_visit], paths.sin_turn[of_visit]
        places = floats(np.column_stack([*turns, paths.mu[of_visit], paths.mu_start[paths.ray[of_visit]]]))
        cos_turn, sin_turn, mu, mu0 = packet(places, visit, 4)
        nu = dr.fma(mu0, mu_s, safe_sine(mu0) * sin_s * cos_phi)
        turned = dr.clip(dr.fma(cos_turn, mu_s, sin_turn * sin_s * cos_phi), -1.0, 1.0)
        self.place = stored([grid.sun_position(turned), relative_azimuth(mu, turned, nu)], lane, 2)
        self.suns, self.per_visit = suns, suns * azimuths

    @cached_property
    def readers(self) -> Readers:
        """Who reads each sun of a table of all visits."""
        return Readers(self.place.numpy().reshape(-1, self.per_visit, 2)[..., 0], self.suns)


class Gather:
    """The step from one order to the next for one atmosphere, along ``directions`` seen at ``azimuths``; the light that
    it returns has azimuthal orders up to ``most``. ``held``: what another of the same kind made of the atmosphere."""

    def __init__(
        self,
        optics: Optics,
        grid: Grid,
        reference: Reference,
        directions: Directions,
        azimuths: int,
        most: int,
        nodes: int,
        held: dict[str, Any] | None = None,
    ) -> None:
        self.optics, self.grid, self.reference = optics, grid, reference
        self.azimuths, self.most, self.cuts = azimuths, most, True
        key = ("samples", directions, azimuths)
        self.samples = grid.kept(key, lambda: Samples(grid, directions, azimuths))
        self.paths = self.samples.paths
        if held is None:
            weights = PathWeights(optics, self.paths, nodes)
            scale = self._reference_at_samples()
            held = {"scattered": weights.scattered, "reflected": weights.reflected, "scale": scale}
        self.held = held

    def signed(self, reference: Any, scale: Any = None) -> Gather:
        """The same step, linear, for light that may be below 0, over another reference; ``scale``: that at the
        samples."""
        other = copy(self)
        other.reference, other.cuts = reference, False
        other.held = {**self.held, "scale": other._reference_at_samples() if scale is None else scale}
        return other

    def _reference_at_samples(self) -> Any:
        """The reference at every sample, [visits, S, azimuths, 4]."""
        t = types()
        count = len(self.paths.station) * self.grid.shape[1] * self.azimuths
        lane = dr.arange(t.UInt, count)
        level = dr.gather(t.UInt, self.paths.device.level, lane // (self.grid.shape[1] * self.azimuths))
        x, _ = packet(self.samples.place, lane, 2)
        return stored(self.reference.at(level, x), lane, 4)

    def __call__(self, light: Moments) -> Any:
        """Azimuthal harmonics at the nodes (projection.stored_harmonics) of ``light`` after one more event."""
        return self.along(light, self.weights(light.degree, min(light.most, self.most) + 1))

    def weights(self, degree: int, orders: int) -> Any:
        """What moments up to ``degree``, of as many azimuthal ``orders``, count along the paths (weight_rows)."""
        return weight_rows(self.optics, self.paths, self.held["scattered"], self.held["reflected"], degree, orders)

    def along(self, light: Moments, weights: Any) -> Any:
        """The same, with ``weights`` made before."""
        channels, suns = self.optics.channel_count, self.grid.shape[1]
        orders = min(light.most, self.most) + 1
        table = contracted(self.paths, self._rows(light, orders), weights, suns + 2, light.degree, orders, channels)
        return self._harmonics(interpolated(self.samples, self.held["scale"], table, orders, channels))

    def _harmonics(self, radiance: Any) -> Any:
        t, channels, suns, azimuths = types(), self.optics.channel_count, self.grid.shape[1], self.azimuths
        per_ray = room(suns)
        lane = dr.arange(t.UInt, len(self.paths.h) * per_ray)
        node = lane // per_ray * suns + dr.minimum(lane % per_ray, suns - 1)
        cosines = self.grid.kept(("cosines", azimuths), lambda: floats(np.cos(half_circle(azimuths))))

        def add(j: Any, sums: list[Any], means: list[Any]) -> tuple[Any, ...]:
            values = packet(radiance, node * azimuths + j, 4)[:channels]
            means = [v + mean for v, mean in zip(values, means, strict=True)]
            values = [dr.maximum(v, 0.0) for v in values] if self.cuts else values
            return j + 1, add_harmonics(sums, values, dr.gather(t.Float, cosines, j)), means

        zero = [dr.zeros(t.Float, dr.width(lane)) for _ in range((self.most + 2) * channels)]
        end = dr.opaque(t.UInt, azimuths, 1)
        state = (t.UInt(0), zero[channels:], zero[:channels])
        _, sums, means = dr.while_loop(state, lambda j, *_: j < end, add, max_iterations=-1, label="azimuths")
        # A few azimuthal harmonics swing below 0 beside a forward peak. Left there they may grow from order to order;
        # cut off they add light: so what is left is made as much as there was.
        for c in range(channels) if self.cuts else ():
            lit = sums[c] > FAINT
            share = dr.select(lit, dr.maximum(means[c], 0.0) / dr.select(lit, sums[c], 1.0), 1.0)
            sums[c::channels] = [share * value for value in sums[c::channels]]
        return stored_harmonics(sums, channels, azimuths)

    def _rows(self, light: Moments, orders: int) -> Any:
        """Moments over the reference as a table [K, S + 2, l, m x channels], irradiance after the last l.

        The first sun mirrors the second (the sun has passed through the zenith: (-1)^m), the last is the one before.
        """
        t, channels, grid, degree = types(), self.optics.channel_count, self.grid, light.degree
        altitudes, suns = grid.shape
        rows, width = degree + 2, row_size(orders * channels)

        def places() -> tuple[Any, Any, Any]:
            """Where each entry of a row comes from, and its sign when mirrored; which sun is read."""
            place, sign = np.full((rows, width), -1), np.ones((rows, width))
            for l_ in range(degree + 1):
                for m in range(min(l_ + 1, orders)):
                    for c in range(channels):
                        place[l_, m * channels + c] = pair_index(degree, l_, m)
                        sign[l_, m * channels + c] = (-1.0) ** m if grid.whole_suns else 1.0
            place[-1, :channels] = light.entries - 1
            sun = np.arange(suns + 2) - 1
            sun[0], sun[-1] = int(grid.whole_suns), suns - 1
            return uints(place + 1), floats(sign), uints(sun)

        place, sign, which = grid.kept(("rows", degree, light.most, orders, channels), places)
        lane = dr.arange(t.UInt, altitudes * (suns + 2) * rows * width)
        size = dr.opaque(t.UInt, rows * width, 1)
        node = lane // size
        entry = lane - node * size
        sun, k = node % (suns + 2), node // (suns + 2)
        there, channel = dr.gather(t.UInt, which, sun), entry % width % channels
        index = dr.gather(t.UInt, place, entry)
        held = index > 0
        every = (light.suns - 1) // (suns - 1)
        strides = (light.index(*place) for place in ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, every, 0)))
        of_k, of_entry, of_sun = (dr.opaque(t.UInt, stride, 1) for stride in strides)
        index = k * of_k + (dr.maximum(index, 1) - 1) * of_entry + there * of_sun + channel
        value = dr.gather(t.Float, light.values, index, held)
        inverse = dr.gather(t.Float, self.reference.inverse, self.reference.index(k, there, channel), held)
        mirrored = dr.select(sun == 0, dr.gather(t.Float, sign, entry), 1.0)
        values = value * inverse * mirrored
        return evaluated(values)


def interpolated(samples: Samples, scale: Any, table: Any, orders: int, channels: int) -> Any:
    """Radiance at the nodes, [rays, S, azimuths, 4]: sum over visits of ``scale`` [visits, S, azimuths, 4] times the
    ``table`` [visits, S + 2, m x channels] at the samples."""
    t, paths, suns, per_visit = types(), samples.paths, samples.suns, samples.per_visit

    def transposed(grad: Any, _: int, __: Any) -> Any:
        return by_table(samples.readers, paths, samples.place, scale, grad, per_visit, suns, orders, channels)

    def radiance(table: Any) -> Any:
        lane = dr.arange(t.UInt, len(paths.h) * per_visit)
        ray, sample = lane // per_visit, lane % per_visit
        start, stop = (dr.gather(t.UInt, paths.device.first_visit, ray + i) for i in (0, 1))

        def visit(i: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
            place = i * per_visit + sample
            x, cos_phi = packet(samples.place, place, 2)
            factor = packet(scale, place, 4)
            # The table has one more sun before the first and after the last.
            inner = seen(table, i * (suns + 2), x, suns, cos_phi, orders, channels)
            return i + 1, [dr.fma(factor[c], inner[c], sums[c]) for c in range(channels)]

        zero = [dr.zeros(t.Float, dr.width(lane)) for _ in range(channels)]
        _, sums = dr.while_loop((start, zero), lambda i, _: i < stop, visit, max_iterations=-1, label="gather")
        return stored(sums, lane, 4)

    return multilinear(radiance, transposed, table)


def seen(table: Any, first: Any, x: Any, suns: int, cos_phi: Any, orders: int, channels: int) -> list[Any]:
    """Sum over m of cos(m phi) times a table [suns + 2, m x channels], from row ``first`` on, cubic at the sun
    coordinate ``x``."""
    t = types()
    s = dr.minimum(t.UInt(x), suns - 2)
    taps = cubic(x - t.Float(s))
    corners = [row(table, first + s + n, orders * channels, alone=True) for n in range(4)]
    cos_m, cos_before = 1.0, cos_phi
    total = [0.0] * channels
    for m in range(orders):
        for c in range(channels):
            j = m * channels + c
            value = taps[0] * corners[0][j]
            for n in range(1, 4):
                value = dr.fma(taps[n], corners[n][j], value)
            total[c] = value if m == 0 else dr.fma(value, cos_m, total[c])
        cos_m, cos_before = dr.fma(2.0 * cos_phi, cos_m, -cos_before), cos_m
    return total


def contracted(paths: Paths, moments: Any, weights: Any, suns: int, degree: int, orders: int, channels: int) -> Any:
    """G, table [visits, suns, m x channels]: ``moments`` [K, suns, l, m x channels] seen along each path, weighed by
    ``weights`` [visits, l, m x channels] and summed over l."""
    rows, width = degree + 2, orders * channels

    def transposed(grad: Any, number: int, moments: Any, weights: Any) -> Any:
        if number:
            return by_weights(paths, grad, moments, suns, rows, width)
        nodes = dr.width(moments) // (suns * rows * row_size(width))
        return by_moments(paths, grad, weights, nodes, suns, rows, width)

    with noted.passing():
        return multilinear(lambda *both: _contracted(paths, *both, suns, rows, width), transposed, moments, weights)


def _contracted(paths: Paths, moments: Any, weights: Any, suns: int, rows: int, width: int) -> Any:
    t = types()
    lane = dr.arange(t.UInt, len(paths.station) * suns)
    sun, visit = lane % suns, lane // suns
    node = dr.gather(t.UInt, paths.device.level, visit) * suns + sun

    size = dr.opaque(t.UInt, rows, 1)

    def add(l_: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
        weight, value = (
            row(table, place * size + l_, width, alone=True) for table, place in ((weights, visit), (moments, node))
        )
        return l_ + 1, [dr.fma(w, v, s) for w, v, s in zip(weight, value, sums, strict=True)]

    zero = [dr.zeros(t.Float, dr.width(lane)) for _ in range(width)]
    _, sums = dr.while_loop((t.UInt(0), zero), lambda i, _: i < size, add, max_iterations=-1, label="contract")
    return table_of(sums, lane)


def weight_rows(optics: Optics, paths: Paths, scattered: Any, reflected: Any, degree: int, orders: int) -> Any:
    """What a moment counts at each visit, table [visits, l, m x channels]: harmonic times weight times phase moment;
    after the last l the ground's part of the irradiance (None: left out)."""
    t, channels, kinds = types(), optics.channel_count, len(optics.scatterers)
    rows = degree + 2

    def harmonics() -> Any:
        values = legendre(degree, paths.mu[paths.station])
        out = np.zeros((len(values), rows, orders))
        for place, (l_, m) in enumerate(zip(*pairs(degree), strict=True)):
            if m < orders:
                out[:, l_, m] = values[:, place]
        return table(out)

    basis = paths.kept(("harmonics", degree, orders), harmonics)
    chi = optics.phase_moments(degree + 1)
    lane = dr.arange(t.UInt, len(paths.station) * rows)
    # Sizes are read from memory: one kernel for all of them.
    size = dr.opaque(t.UInt, rows, 1)
    visit = lane // size
    l_ = lane - visit * size
    products = [0.0] * channels
    if kinds:
        weight, moment = row(scattered, visit, kinds * channels), row(chi, l_, kinds * channels)
        for n in range(kinds):
            products = [
                dr.fma(weight[n * channels + c], moment[n * channels + c], products[c]) for c in range(channels)
            ]
    values = [harmonic * p for harmonic in row(basis, lane, orders) for p in products]
    if reflected is not None:
        last = l_ == size - 1
        ground = row(reflected, visit, channels, active=last)
        values[:channels] = [dr.select(last, r, v) for r, v in zip(ground, values, strict=False)]
    return table_of(values, lane)
