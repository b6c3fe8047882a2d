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
from .transposed import Readers, by_moments, by_phase, by_table, by_weight, by_weights, multilinear
from .visits import Visits, weighed

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
        # Before the first sun of a table comes the second, mirrored, if suns start at the zenith.
        self.skipped = int(not grid.whole_suns)

    def readers(self, visits: Visits) -> Readers:
        """Who reads each row of a table of all visits and suns."""
        x = self.place.numpy().reshape(-1, self.per_visit, 2)[..., 0]
        return self.paths.kept(
            ("readers", visits.together, self.per_visit), lambda: Readers(x, self.suns, self.skipped, visits)
        )


class Gather:
    """The step from one order to the next for one atmosphere, along ``directions`` seen at ``azimuths``; the light that
    it returns has azimuthal orders up to ``most``. ``held``: what another of the same kind made of the atmosphere;
    ``like``: one of this atmosphere whose weights serve, if its directions are the same."""

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
        like: Gather | None = None,
    ) -> None:
        self.optics, self.grid, self.reference = optics, grid, reference
        self.azimuths, self.most, self.cuts = azimuths, most, True
        key = ("samples", directions, azimuths)
        self.samples = grid.kept(key, lambda: Samples(grid, directions, azimuths))
        self.paths = self.samples.paths
        if held is None and like is not None and like.paths is self.paths:
            held = {**like.held, "scale": self._reference_at_samples()}
        elif held is None:
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
        return self.along(light, self.weights(light.degree))

    def weights(self, degree: int) -> Any:
        """What moments up to ``degree`` count along the paths (weight_rows): the same for every order."""
        key = f"weights {degree}"
        if key not in self.held:
            both = self.held["scattered"], self.held["reflected"]
            self.held[key] = weight_rows(self.optics, self.paths, *both, degree)
        return self.held[key]

    def along(self, light: Moments, weights: Any) -> Any:
        """The same, with ``weights`` made before."""
        channels, suns = self.optics.channel_count, self.grid.shape[1]
        orders, skipped = min(light.most, self.most) + 1, self.samples.skipped
        moments = self._rows(light, orders)
        table = contracted(self.paths, moments, weights, suns + 1 - skipped, light.degree, orders, channels)
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
        """Moments over the reference as a table [K, S, l, m x channels], irradiance after the last l.

        Where suns start at the zenith one more comes first, which mirrors the second (the sun has passed through the
        zenith: (-1)^m).
        """
        t, channels, grid, degree = types(), self.optics.channel_count, self.grid, light.degree
        altitudes, suns = grid.shape
        mirrored = int(grid.whole_suns)
        rows, width, count = degree + 2, row_size(orders * channels), suns + mirrored

        def places() -> tuple[Any, Any]:
            """Where each entry of a row comes from, and its sign when mirrored."""
            place, sign = np.full((rows, width), -1), np.ones((rows, width))
            for l_ in range(degree + 1):
                for m in range(min(l_ + 1, orders)):
                    for c in range(channels):
                        place[l_, m * channels + c] = pair_index(degree, l_, m)
                        sign[l_, m * channels + c] = (-1.0) ** m
            place[-1, :channels] = light.entries - 1
            return uints(place + 1), floats(sign)

        place, sign = grid.kept(("rows", degree, light.most, orders, channels), places)
        lane = dr.arange(t.UInt, altitudes * count * rows * width)
        size = dr.opaque(t.UInt, rows * width, 1)
        node = lane // size
        entry = lane - node * size
        sun, k = node % count, node // count
        # Mirrored by the first of them is the second of the light, which comes third.
        behind = (sun == 0) & t.Bool(grid.whole_suns)
        there, channel = dr.select(behind, 1, sun - mirrored), entry % width % channels
        index = dr.gather(t.UInt, place, entry)
        held = index > 0
        every = (light.suns - 1) // (suns - 1)
        strides = (light.index(*place) for place in ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, every, 0)))
        of_k, of_entry, of_sun = (dr.opaque(t.UInt, stride, 1) for stride in strides)
        index = k * of_k + (dr.maximum(index, 1) - 1) * of_entry + there * of_sun + channel
        value = dr.gather(t.Float, light.values, index, held)
        inverse = dr.gather(t.Float, self.reference.inverse, self.reference.index(k, there, channel), held)
        return evaluated(value * inverse * dr.select(behind, dr.gather(t.Float, sign, entry), 1.0))


def interpolated(samples: Samples, scale: Any, table: Any, orders: int, channels: int) -> Any:
    """Radiance at the nodes, [rays, S, azimuths, 4]: sum over visits of ``scale`` [visits, S, azimuths, 4] times the
    ``table`` of ``contracted`` at the samples, with one more sun first as Gather has it."""
    t, paths, suns, per_visit, skipped = types(), samples.paths, samples.suns, samples.per_visit, samples.skipped
    visits, count = Visits.of(paths, orders * channels), suns + 1 - skipped
    first = visits.rows_of_suns(count)

    def transposed(grad: Any, _: int, __: Any) -> Any:
        return by_table(samples.readers(visits), paths, samples.place, scale, grad, per_visit, orders, channels)

    def radiance(table: Any) -> Any:
        lane = dr.arange(t.UInt, len(paths.h) * per_visit)
        ray, sample = lane // per_visit, lane % per_visit
        start, stop = (dr.gather(t.UInt, paths.device.first_visit, ray + i) for i in (0, 1))

        def visit(i: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
            place = i * per_visit + sample
            x, cos_phi = packet(samples.place, place, 2)
            factor = packet(scale, place, 4)
            place, beside = dr.gather(t.UInt, first, i), (skipped, count - 1)
            inner = seen(table, place, x, suns, cos_phi, orders, channels, visits.together, beside)
            return i + 1, [dr.fma(factor[c], inner[c], sums[c]) for c in range(channels)]

        zero = [dr.zeros(t.Float, dr.width(lane)) for _ in range(channels)]
        _, sums = dr.while_loop((start, zero), lambda i, _: i < stop, visit, max_iterations=-1, label="gather")
        return stored(sums, lane, 4)

    return multilinear(radiance, transposed, table)


def seen(
    table: Any,
    first: Any,
    x: Any,
    suns: int,
    cos_phi: Any,
    orders: int,
    channels: int,
    apart: int,
    ends: tuple[int, int] | None = None,
) -> list[Any]:
    """Sum over m of cos(m phi) times a table [suns + 2, m x channels], cubic at the sun coordinate ``x``. Its rows are
    so far ``apart``, from ``first`` on. The table has one sun more before the first and after the last; with ``ends``
    not as many as it says before, and none after that row: light there is that of the nearest."""
    t = types()
    s = dr.minimum(t.UInt(x), suns - 2)
    taps = cubic(x - t.Float(s))
    places = [s + n for n in range(4)]
    if ends:
        skipped, last = ends
        places = [dr.minimum(dr.maximum(place, skipped) - skipped, last) for place in places]
    corners = [row(table, first + place * apart, orders * channels, alone=True) for place in places]
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
    """G, table of rows [m x channels] of visits and suns (visits.rows_of_suns): ``moments`` [K, suns, l, m x channels]
    seen along each path, each times its harmonic in the path's direction, weighed by ``weights`` [visits, l, channels]
    and summed over l."""
    visits, shape = Visits.of(paths, orders * channels), (suns, degree + 2, orders, channels)
    basis = harmonics_along(paths, degree, orders)

    def transposed(grad: Any, number: int, moments: Any, weights: Any) -> Any:
        if number:
            return by_weights(visits, grad, moments, basis, *shape)
        nodes = dr.width(moments) // (suns * (degree + 2) * row_size(orders * channels))
        return by_moments(visits, grad, weights, basis, nodes, *shape)

    with noted.passing():
        return multilinear(lambda *both: _contracted(visits, *both, basis, *shape), transposed, moments, weights)


def _contracted(
    visits: Visits, moments: Any, weights: Any, basis: Any, suns: int, rows: int, orders: int, channels: int
) -> Any:
    t, width = types(), orders * channels
    # A lane takes the visits of a group: what it reads of the light at their level serves all of them.
    lane = dr.arange(t.UInt, visits.groups * suns)
    group = lane // suns
    sun, members = lane - group * suns, packet(visits.members, group, visits.together)
    node, size = dr.gather(t.UInt, visits.level, group) * suns + sun, dr.opaque(t.UInt, rows, 1)

    def add(l_: Any, sums: list[list[Any]]) -> tuple[Any, list[list[Any]]]:
        light, new = row(moments, node * size + l_, width, alone=True), []
        for visit, old in zip(members, sums, strict=True):
            counts = weighed(basis, weights, visit * size + l_, orders, channels)
            new.append([dr.fma(w, v, s) for w, v, s in zip(counts, light, old, strict=True)])
        return l_ + 1, new

    zero = [[dr.zeros(t.Float, dr.width(lane)) for _ in range(width)] for _ in members]
    _, sums = dr.while_loop((t.UInt(0), zero), lambda i, _: i < size, add, max_iterations=-1, label="contract")
    fill = [t.Float(0.0)] * (row_size(width) - width)
    return stored([v for values in sums for v in [*values, *fill]], lane, visits.together * row_size(width))


def harmonics_along(paths: Paths, degree: int, orders: int) -> Any:
    """P_lm(mu) at every visit, table [visits, l, m]; after the last l 1 for m = 0: the irradiance has no direction."""

    def make() -> Any:
        values = legendre(degree, paths.mu[paths.station])
        out = np.zeros((len(values), degree + 2, orders))
        for place, (l_, m) in enumerate(zip(*pairs(degree), strict=True)):
            if m < orders:
                out[:, l_, m] = values[:, place]
        out[:, -1, 0] = 1.0
        return table(out)

    return paths.kept(("harmonics", degree, orders), make)


def weight_rows(optics: Optics, paths: Paths, scattered: Any, reflected: Any, degree: int) -> Any:
    """What a moment counts at each visit beside its harmonic, table [visits, l, channels]: weight times phase moment;
    after the last l the ground's part of the irradiance (None: left out)."""
    t, channels, kinds = types(), optics.channel_count, len(optics.scatterers)
    rows, width = degree + 2, kinds * channels
    if reflected is None:
        reflected = dr.zeros(t.Float, len(paths.station) * row_size(channels))

    def counted(scattered: Any, chi: Any, reflected: Any) -> Any:
        lane = dr.arange(t.UInt, len(paths.station) * rows)
        # Sizes are read from memory: one kernel for all of them.
        size = dr.opaque(t.UInt, rows, 1)
        visit = lane // size
        l_ = lane - visit * size
        last = l_ == size - 1
        values = [t.Float(0.0)] * channels
        if kinds:
            for j, both in enumerate(zip(row(scattered, visit, width), row(chi, l_, width), strict=True)):
                values[j % channels] = dr.fma(*both, values[j % channels])
        ground = row(reflected, visit, channels, active=last)
        return table_of([dr.select(last, r, v) for r, v in zip(ground, values, strict=True)], lane)

    def transposed(grad: Any, number: int, scattered: Any, chi: Any, reflected: Any) -> Any:
        sizes = len(paths.station), rows, channels, kinds
        if number < 2:
            return by_phase(grad, scattered, *sizes) if number else by_weight(grad, chi, *sizes)
        visit = dr.arange(t.UInt, len(paths.station))
        return table_of(row(grad, visit * dr.opaque(t.UInt, rows, 1) + (rows - 1), channels), visit)

    return multilinear(counted, transposed, scattered, optics.phase_moments(degree + 1), reflected, alone=(2,))
