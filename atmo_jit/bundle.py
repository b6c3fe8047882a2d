"""Many rays at once: every path of a list, under every sun of a list, at many azimuths.

A march (march.py) spends its time on looking sunlight and the field up at every piece of every ray. Here rays share
their paths: along each path geometry, densities and weights are made once, sunlight and the field are gathered at a few
azimuths only, since both change slowly with azimuth as long as no phase function is in them, and their cosine series
serves every azimuth asked for. That is how tables and pictures of the sky are filled.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np

from .backend import floats, not_negative, packet, row, table_of, types, uints
from .column import SunColumns
from .field import Field
from .gather import contracted, seen, weight_rows
from .geometry import safe_sine
from .grid import Grid
from .harmonics import pair_index
from .march import relative_azimuth
from .optics import Optics
from .path_weights import PathWeights, columns_along
from .paths import Paths, points_along
from .projection import add_harmonics
from .quadrature import half_circle
from .single_scattering import Sunbeam, azimuth_rows, azimuths_together, beam_along, sun_irradiance
from .visits import Visits

TWILIGHT = np.radians(85.0)  # beyond, the planet's shadow lies across the paths
REFINE = (4, 12)  # levels per interval of the grid's altitudes at which sunlight is known: by day, at twilight
AZIMUTHS = (8, 20)  # at which sunlight is followed
NODES = 3  # Gauss points between two levels


class Bundle:
    """Paths from altitudes ``h`` (m) in directions of zenith cosine ``mu`` [P] to the ground or the top, cut where they
    cross the levels of a grid: geometry only. ``h`` lies within the air."""

    def __init__(self, grid: Grid, h: np.ndarray, mu: np.ndarray) -> None:
        self.grid = grid
        self._paths = {refine: Paths.trace(grid, h, mu, refine) for refine in (1, *REFINE)}

    @property
    def paths(self) -> Paths:
        """The paths cut at the grid's own altitudes."""
        return self._paths[1]

    def transmittance(self, optics: Optics) -> list[Any]:
        """Along every path, per channel [P]."""
        count = len(self.paths.h)
        kinds = len(optics.constituents)
        if not kinds:
            return [dr.full(types().Float, 1.0, count) for _ in range(optics.channel_count)]
        whole = columns_along(optics, points_along(self._paths[REFINE[0]], NODES)).whole
        depths = optics.optical_depths(row(whole, dr.arange(types().UInt, count), kinds))
        return [dr.exp(-depth) for depth in depths]

    def radiance(
        self, optics: Optics, columns: SunColumns, field: Field, theta: np.ndarray, cos_phi: Any, *, ground: bool = True
    ) -> list[Any]:
        """Radiance toward the starts of the paths per channel, [P, S, A] flattened.

        ``theta`` [S] (radians): zenith angles of the sun there; ``cos_phi``: cosines of the azimuth between view and
        sun, A of them or [P, S, A] flattened. ``ground=False`` leaves the ground's own radiance out.
        """
        t, suns = types(), len(theta)
        sun = floats(np.column_stack([np.cos(theta), np.sin(theta)]))
        twilight = int(np.max(theta) > TWILIGHT)
        once = self._once(optics, columns, sun, ground, self._paths[REFINE[twilight]], AZIMUTHS[twilight])
        more = self._more(optics, field, sun, theta, ground, twilight)
        nodes = len(self.paths.h) * suns
        whole = dr.width(cos_phi) // nodes if dr.width(cos_phi) % nodes == 0 else 0
        count = whole or dr.width(cos_phi)
        lane = dr.arange(t.UInt, nodes * count)
        node = lane // count
        cos_phi = dr.gather(t.Float, cos_phi, lane if whole else lane % count)
        mu = dr.gather(t.Float, self.paths.device.mu_start, node // suns)
        mu_s, sin_s = packet(sun, node % suns, 2)
        nu = dr.clip(dr.fma(mu, mu_s, safe_sine(mu) * sin_s * cos_phi), -1.0, 1.0)
        channels, kinds = optics.channel_count, len(optics.scatterers)
        parts = _series(once, node, (kinds + 1) * channels, cos_phi)
        total = [not_negative(v) for v in parts[kinds * channels :]]
        for n, k in enumerate(optics.scatterers):
            for c, phase in enumerate(optics.phase_values(k, nu)):
                total[c] = dr.fma(optics.solar[c] * phase, not_negative(parts[n * channels + c]), total[c])
        if more is not None:
            total = [v + not_negative(m) for v, m in zip(total, _series(more, node, channels, cos_phi), strict=True)]
        return total

    def _once(
        self, optics: Optics, columns: SunColumns, sun: Any, ground: bool, paths: Paths, azimuths: int
    ) -> tuple[Any, int]:
        """Cosine series of sunlight scattered along the paths, phase functions apart, and of sunlit ground."""
        t, channels, kinds = types(), optics.channel_count, len(optics.scatterers)
        weights = PathWeights(optics, paths, NODES)
        scattered, _ = beam_along(optics, Sunbeam(optics, columns, paths), paths, weights, sun, azimuths)
        nodes = len(paths.h) * (dr.width(sun) // 2)
        lit = None
        if ground:
            lane = dr.arange(t.UInt, nodes * azimuths)
            mu_s, end = self._at_ends(paths, sun, lane, azimuths)
            light = sun_irradiance(optics, columns, dr.zeros(t.Float, dr.width(lane)), mu_s)
            share = row(weights.reflected, end, channels)
            lit = table_of([a * b for a, b in zip(share, light, strict=True)], lane)
        width = kinds * channels

        def values(node: Any, group: Any) -> list[list[Any]]:
            count = azimuths_together(azimuths)
            above = azimuth_rows(scattered, node, group, azimuths, width) if kinds else [[]] * count
            first = node * azimuths + group * count
            below = [row(lit, first + i, channels) if ground else [t.Float(0.0)] * channels for i in range(count)]
            return [[*a, *b] for a, b in zip(above, below, strict=True)]

        return self._cosine_series(values, nodes, azimuths, azimuths), azimuths

    def _cosine_series(
        self, rows: Callable[[Any, Any], list[list[Any]]], nodes: int, azimuths: int, orders: int
    ) -> Any:
        """Cosine series [nodes, m x width] of ``orders`` terms through the ``rows(node, group)`` [width] at each
        azimuth of a group."""
        t, lane = types(), dr.arange(types().UInt, nodes)
        cosines = self.grid.kept(("cosines", azimuths), lambda: floats(np.cos(half_circle(azimuths))))
        first = rows(lane, t.UInt(0))
        together, width = len(first), len(first[0])

        def add(group: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
            for part, cosine in zip(rows(lane, group), packet(cosines, group, together), strict=True):
                sums = add_harmonics(sums, part, cosine)
            return group + 1, sums

        zero = [dr.zeros(t.Float, nodes) for _ in range(orders * width)]
        end = dr.opaque(t.UInt, azimuths // together, 1)
        _, sums = dr.while_loop((t.UInt(0), zero), lambda i, _: i < end, add, max_iterations=-1, label="series")
        share = dr.opaque(t.Float, 1.0 / azimuths, 1)
        return table_of([share * s * (1.0 if j < width else 2.0) for j, s in enumerate(sums)], lane)

    def _at_ends(self, paths: Paths, sun: Any, lane: Any, azimuths: int) -> tuple[Any, Any]:
        """Cosine of the sun's zenith angle where paths end, and their last visits; lanes [P, S, azimuths]."""
        t, suns, device = types(), dr.width(sun) // 2, paths.device
        node = lane // azimuths
        mu_s, sin_s = packet(sun, node % suns, 2)
        cosines = self.grid.kept(("cosines", azimuths), lambda: floats(np.cos(half_circle(azimuths))))
        end = dr.gather(t.UInt, device.first_visit, node // suns + 1) - 1
        cos_turn, sin_turn = packet(device.turns, end, 2)
        across = sin_s * dr.gather(t.Float, cosines, lane % azimuths)
        return dr.clip(dr.fma(cos_turn, mu_s, sin_turn * across), -1.0, 1.0), end

    def _more(
        self, optics: Optics, field: Field, sun: Any, theta: np.ndarray, ground: bool, twilight: int
    ) -> tuple[Any, int] | None:
        """Cosine series of what the field scatters along the paths toward their starts, and of skylit ground."""
        t, channels, paths, grid = types(), optics.channel_count, self.paths, self.grid
        if not field.scatters or not optics.scatterers:
            return None
        suns, orders = len(theta), field.degree + 1
        azimuths = orders
        per_node = grid.first if twilight else 1
        low, high = self._nodes(theta, per_node)
        count = high - low + 1
        weights = PathWeights(optics, paths, 2)
        table = contracted(
            paths,
            self._moments(field, low, high, grid.first // per_node, channels),
            weight_rows(optics, paths, weights.scattered, None, field.degree),
            count + 2,
            field.degree,
            orders,
            channels,
        )
        visits, device = Visits.of(paths, orders * channels), paths.device
        first = visits.rows_of_suns(count + 2)
        lane = dr.arange(t.UInt, len(paths.h) * suns * azimuths)
        node = lane // azimuths
        ray = node // suns
        mu_s, sin_s = packet(sun, node % suns, 2)
        cosines = grid.kept(("cosines", azimuths), lambda: floats(np.cos(half_circle(azimuths))))
        across = sin_s * dr.gather(t.Float, cosines, lane % azimuths)
        mu0 = dr.gather(t.Float, device.mu_start, ray)
        nu = dr.fma(mu0, mu_s, safe_sine(mu0) * across)
        start, stop = dr.gather(t.UInt, device.first_visit, ray), dr.gather(t.UInt, device.first_visit, ray + 1)
        mus = paths.kept("mu of visits", lambda: floats(paths.mu[paths.station]))
        offset = float(low)

        def visit(i: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
            cos_turn, sin_turn = packet(device.turns, i, 2)
            turned = dr.clip(dr.fma(cos_turn, mu_s, sin_turn * across), -1.0, 1.0)
            x = grid.sun_position(turned)
            cos_phi = relative_azimuth(dr.gather(t.Float, mus, i), turned, nu)
            scale = field.reference.at(dr.gather(t.UInt, device.level, i), x)
            place = dr.clip(x * per_node - offset, 0.0, count - 1.0)
            inner = seen(table, dr.gather(t.UInt, first, i), place, count, cos_phi, orders, channels, visits.together)
            return i + 1, [dr.fma(a, b, s) for a, b, s in zip(scale, inner, sums, strict=True)]

        zero = [dr.zeros(t.Float, dr.width(lane)) for _ in range(channels)]
        _, sums = dr.while_loop((start, zero), lambda i, _: i < stop, visit, max_iterations=-1, label="bundle")
        sums = [e * s for e, s in zip(optics.solar, sums, strict=True)]
        if ground:
            dr.eval(sums)
            field.prepare()
            mu_end, end = self._at_ends(paths, sun, lane, azimuths)
            lit = field.irradiance(dr.zeros(t.Float, dr.width(lane)), mu_end, reflected=True)
            share = row(weights.reflected, end, channels)
            sums = [dr.fma(a, b, s) for a, b, s in zip(share, lit, sums, strict=True)]
        radiance = table_of([not_negative(s) for s in sums], lane)

        def seen_at(node: Any, azimuth: Any) -> list[list[Any]]:
            return [row(radiance, node * azimuths + azimuth, channels)]

        return self._cosine_series(seen_at, len(paths.h) * suns, azimuths, orders), azimuths

    def _nodes(self, theta: np.ndarray, per_node: int) -> tuple[int, int]:
        """First and last of the suns that the paths can see, counted ``per_node`` of the grid's."""
        turn = float(np.max(np.arctan2(self.paths.sin_turn, self.paths.cos_turn)))
        last = per_node * (self.grid.shape[1] - 1)
        x = per_node * np.interp(
            [np.min(theta) - turn, np.max(theta) + turn], self.grid.theta, np.arange(self.grid.shape[1])
        )
        low = max(0, min(int(np.floor(x[0])) - 1, last - 2))
        return low, min(last, max(int(np.ceil(x[1])) + 1, low + 2))

    def _moments(self, field: Field, low: int, high: int, every: int, channels: int) -> Any:
        """The field's quotients at the suns from ``low`` to ``high``, counted by ``every`` one of order 1's: table [K,
        suns + 2, l, m x channels], with an empty row after the last l."""
        t, grid, degree = types(), self.grid, field.degree
        entries, suns = (degree + 1) * (degree + 2) // 2, high - low + 3
        orders, rows = degree + 1, degree + 2

        def places() -> tuple[Any, Any]:
            place, sign = np.zeros((rows, orders), dtype=int), np.ones((rows, orders))
            for l_ in range(degree + 1):
                for m in range(l_ + 1):
                    place[l_, m] = pair_index(degree, l_, m) + 1
                    sign[l_, m] = (-1.0) ** m if grid.whole_suns else 1.0
            return uints(place), floats(sign)

        place, sign = grid.kept(("bundle rows", degree), places)
        index = np.arange(low - 1, high + 2)
        mirrored = index < 0
        index = (
            np.clip(np.where(mirrored, int(grid.whole_suns), index), 0, (len(grid.first_theta) - 1) // every) * every
        )
        source, flipped = uints(index), floats(mirrored)
        lane = dr.arange(t.UInt, grid.shape[0] * suns * rows)
        l_, node = lane % rows, lane // rows
        sun, k = node % suns, node // suns
        base = (k * len(grid.first_theta) + dr.gather(t.UInt, source, sun)) * entries
        turned = dr.gather(t.Float, flipped, sun) > 0.0
        values = []
        for m in range(orders):
            entry = dr.gather(t.UInt, place, l_ * orders + m)
            factor = dr.select(turned, dr.gather(t.Float, sign, l_ * orders + m), 1.0)
            at = (base + dr.maximum(entry, 1) - 1) * channels
            values += [factor * dr.gather(t.Float, field.moments, at + c, entry > 0) for c in range(channels)]
        return table_of(values, lane)


def _series(held: tuple[Any, int], node: Any, width: int, cos_phi: Any) -> list[Any]:
    """Cosine series [nodes, m x width] at cos_phi."""
    coefficients, orders = held
    values = row(coefficients, node, orders * width)
    total, cos_m, cos_before = values[:width], cos_phi, 1.0
    for m in range(1, orders):
        total = [dr.fma(cos_m, v, s) for v, s in zip(values[m * width : (m + 1) * width], total, strict=True)]
        cos_m, cos_before = dr.fma(2.0 * cos_phi, cos_m, -cos_before), cos_m
    return total
