"""The solved radiance field: harmonic moments of the light of all orders at the nodes, and what it scatters toward a
view ray.

A field stores, per unit of solar irradiance and per altitude node, sun node and channel, a positive reference (the
zeroth moment of order 1) and every moment divided by it. Light is the sun's irradiance times that: linear in it to
rounding, however ill-conditioned the sum of orders is. The reference is interpolated in its logarithm, the quotients
linearly: at twilight light falls by a factor of two per degree, and linear interpolation of the moments themselves
would be wrong by 8 %.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import drjit as dr
import numpy as np

from .backend import evaluated, floats, packet, padded, row, row_size, stored, table, types, uints
from .column import SunColumns
from .geometry import safe_sine
from .grid import Grid
from .harmonics import Harmonics, pair_count, pairs, recurrence
from .look_ups import LookUps
from .optics import Optics
from .paths import lagrange
from .refinement import Reference, Taps
from .slopes import steep_nodes
from .total import parity


class Field:
    """The light of a sum of orders, at the altitudes of the grid and the suns of order 1, over the reference.

    ``moments`` [K, suns, pairs(degree), channels] of light that scatters once more, ``sky`` and ``reflected`` [K, suns,
    channels]: irradiance by all that arrives, and by what may be reflected, over the scattering depth of the air above.
    ``scatters``: whether any of it scatters once more. ``shares``: what each order above the first counts in them, the
    last with what remainder.Remainder holds where it stands for all that follow; ``known``: what
    multiple_scattering.orders_again need not compute once more, where that was asked for.
    """

    shares: list[Any]
    known: dict[str, Any] | None = None

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

    @classmethod
    def of(
        cls, optics: Optics, columns: SunColumns, grid: Grid, degree: int, held: dict[str, Any], *, scatters: bool
    ) -> Field:
        """The field that ``held`` came from."""
        log, inverse, fine = (held[f"reference.{name}"] for name in ("log", "inverse", "fine"))
        reference = Reference.of(grid, optics.channel_count, {"log": log, "inverse": inverse, "fine": fine})
        parts = (held[name] for name in ("moments", "sky", "reflected"))
        return cls(optics, columns, grid, reference, degree, *parts, scatters=scatters)

    @classmethod
    def of_tables(
        cls, optics: Optics, columns: SunColumns, grid: Grid, degree: int, tables: dict[str, Any], *, scatters: bool
    ) -> Field:
        """A field that has nothing but the ``tables`` of look-ups of another."""
        reference = Reference(grid, optics.channel_count)  # its guide serves
        field = cls(optics, columns, grid, reference, degree, *[None] * 3, scatters=scatters)
        field.__dict__ |= {"_guide": tables["guide"], "_irradiances": tables["irradiances"]}
        if "moments" in tables:
            field.__dict__["_refined_moments"] = tables["moments"]
        return field

    @property
    def tables(self) -> dict[str, Any]:
        """Its tables of look-ups, by name."""
        self.prepare()
        found = {"guide": self._guide, "irradiances": list(self._irradiances)}
        return found | ({"moments": self._refined_moments} if self._looks_up else {})

    @property
    def _looks_up(self) -> bool:
        return bool(self.scatters and self.optics.scatterers)

    @property
    def held(self) -> dict[str, Any]:
        """Its numbers, by name."""
        reference = {f"reference.{name}": value for name, value in self.reference.held.items()}
        return {"moments": self.moments, "sky": self.sky, "reflected": self.reflected, **reference}

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
        self.grid.prepare()
        if self._looks_up:
            dr.eval(self._tables)
        dr.eval(self._irradiances, self._guide)

    @cached_property
    def _tables(self) -> tuple[Any, Any, Any]:
        """Moments at refined suns for look-ups, the phase moments of every pair, and the recurrence of harmonics."""
        width = len(self.optics.scatterers) * self.optics.channel_count

        def steps() -> tuple[Any, Any]:
            l_, m = pairs(self.degree)
            rows = [[*entry, float(a == b)] for entry, a, b in zip(recurrence(self.degree), l_, m, strict=True)]
            size = row_size(width)
            return table(np.pad(rows, ((0, -len(rows) % 8), (0, 0)))), uints(l_[:, None] * size + np.arange(size))

        recurrences, places = self.grid.kept(("recurrences", self.degree, width), steps)
        return (
            self._refined_moments,
            evaluated(dr.gather(types().Float, self.optics.phase_moments(self.degree), places)),
            recurrences,
        )

    @cached_property
    def _refined_moments(self) -> Any:
        return self._refined(self.moments, pair_count(self.degree))

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

    def refined_moments(self) -> np.ndarray:
        """Moments over the reference at the nodes of look-ups, float32 [levels x suns, pairs, channels]."""
        moments = np.array(dr.detach(self._tables[0]), dtype=np.float32)
        moments = moments.reshape(-1, pair_count(self.degree), padded(self.optics.channel_count))
        return moments[..., : self.optics.channel_count]

    def corners(self, h: Any, mu_s: Any, active: Any) -> tuple[list[Any], list[Any], list[list[Any]]]:
        """The four nodes about (h, mu_s), their weights, and the reference at the sun angle per altitude
        [2][channel]."""
        k, fk = self.grid.locate_altitude(h)
        x = self.grid.sun_position(mu_s)
        s, fs = self.grid.locate_source(x)
        if self._steep(h, mu_s):
            fk, fs, x = dr.detach(fk), dr.detach(fs), dr.detach(x)  # see _moved
        nodes = [self.grid.node(level, sun) for level in (k, k + 1) for sun in (s, s + 1)]
        weights = [(1.0 - fk) * (1.0 - fs), (1.0 - fk) * fs, fk * (1.0 - fs), fk * fs]
        return nodes, weights, [self.reference.at(level, x, active, self._guide) for level in (k, k + 1)]

    def irradiance(self, h: Any, mu_s: Any, active: Any = True, *, reflected: bool = False) -> list[Any]:
        """Irradiance of the scattered light on a horizontal surface facing up, per channel.

        ``reflected``: only of the light whose reflection by that surface is still counted.
        """
        channels, size = range(self.optics.channel_count), padded(self.optics.channel_count)
        if not self.optics.scatterers:
            return [0.0 * h for _ in channels]
        k, fk = self.grid.locate_altitude(h)
        x = self.grid.sun_position(mu_s)
        s, fs = self.grid.locate_source(x)
        buffer = self._irradiances[int(reflected)]
        logs = []
        for level in (k, k + 1):
            guide = self.reference.at(level, x, active, self._guide)
            values = [packet(buffer, self.grid.node(level, s + i), size, active) for i in (0, 1)]
            logs.append(
                # Deep in the shadow the product of both leaves single precision.
                [dr.log(dr.maximum(guide[c] * dr.lerp(values[0][c], values[1][c], fs), 1e-37)) for c in channels]
            )
        # Geometric between altitudes: at twilight the level below lies in the shadow and the one above in the light.
        optics = self.optics.spread(dr.width(h))
        above = optics.scattering_depths(self.columns.upward(h, optics))
        return [optics.solar[c] * dr.exp(dr.lerp(logs[0][c], logs[1][c], fk)) * above[c] for c in channels]

    def scattered(self, h: Any, mu_s: Any, mu: Any, cos_phi: Any, active: Any) -> list[list[Any]]:
        """Integral of phase function times radiance over the sphere, toward (mu, phi): [scatterer][channel]
        (march.Source)."""
        values = self.unclipped(h, mu_s, mu, cos_phi, active)
        return [[dr.maximum(value, 0.0) for value in of_kind] for of_kind in values]

    def unclipped(self, h: Any, mu_s: Any, mu: Any, cos_phi: Any, active: Any) -> list[list[Any]]:
        """The same, below 0 where few moments cannot tell it from 0: a sum, whose derivatives do not ask what it is."""
        t = types()
        channels, kinds = self.optics.channel_count, len(self.optics.scatterers)
        nodes, weights, scales = self.corners(h, mu_s, active)
        weights = [[w * scales[i // 2][c] for c in range(channels)] for i, w in enumerate(weights)]
        sine = safe_sine(mu)
        x = sine * cos_phi
        basis = Harmonics(dr.detach(mu), dr.detach(x), slopes=dr.grad_enabled(mu, cos_phi))
        moments, phases, recurrences = self._tables
        width = dr.width(h)
        if dr.grad_enabled(moments, phases, weights) or basis.slopes:
            look_ups = LookUps(self.grid, self.degree, channels, kinds, nodes[0], basis, recurrences, active)
            total, slopes = look_ups(moments, phases, weights)
            # Directions have no derivative in there; theirs follow from the slopes.
            for step, of_step in zip((mu - basis.mu, x - basis.x), slopes, strict=False):
                total = [dr.fma(step, slope, value) for slope, value in zip(of_step, total, strict=True)]
        else:
            stride = dr.opaque(t.UInt, pair_count(self.degree), 1)

            def pair(i: Any, state: Any, sums: list[Any]) -> tuple[Any, ...]:
                (value,), state = basis.next(packet(recurrences, i, 4, active), state)
                corner = [packet(moments, node * stride + i, padded(channels), active) for node in nodes]
                moment = [_blend([w[c] for w in weights], [v[c] for v in corner]) for c in range(channels)]
                chi = row(phases, i, kinds * channels, active=active)
                light = [chi[n] * moment[n % channels] for n in range(kinds * channels)]
                return i + 1, state, [dr.fma(value, part, s) for part, s in zip(light, sums, strict=True)]

            sums = [dr.zeros(t.Float, width) for _ in range(kinds * channels)]
            state = (t.UInt(0), basis.start(width), sums)
            *_, total = dr.while_loop(state, lambda i, *_: i < stride, pair, label="scattered")
        if self._steep(h, mu_s):
            total = [a + b for a, b in zip(total, self._moved(h, mu_s, basis, active), strict=True)]
        solar = self.optics.spread(width).solar
        return [[e * v for e, v in zip(solar, total[n * channels :], strict=False)] for n in range(kinds)]

    def _steep(self, h: Any, mu_s: Any) -> bool:
        """Whether derivatives by a place or sun, of a fine solve, pass through look-ups there."""
        return self.grid.resolution.twice and dr.grad_enabled(h, mu_s)

    def _moved(self, h: Any, mu_s: Any, basis: Harmonics, active: Any) -> list[Any]:
        """0, with the derivatives of what ``unclipped`` sums by level and sun: [scatterer x channel]."""
        t, channels, kinds = types(), self.optics.channel_count, len(self.optics.scatterers)
        moved, parts = steep_nodes(self.grid, self.reference, self._guide, h, mu_s, active)
        total = [0.0] * (kinds * channels)
        with dr.suspend_grad():
            moments, phases, recurrences = (dr.detach(v) for v in self._tables)
            basis, stride = Harmonics(basis.mu, basis.x, slopes=False), dr.opaque(t.UInt, pair_count(self.degree), 1)

            def pair(i: Any, state: Any, sums: list[list[Any]]) -> tuple[Any, ...]:
                (value,), state = basis.next(packet(recurrences, i, 4, active), state)
                chi = row(phases, i, kinds * channels, active=active)
                new, size = [], padded(channels)
                for (nodes, weights), old in zip(parts, sums, strict=True):
                    corner = [packet(moments, node * stride + i, size, active, alone=True) for node in nodes]
                    slope = [_blend([w[c] for w in weights], [v[c] for v in corner]) for c in range(channels)]
                    new.append([dr.fma(value, chi[n] * slope[n % channels], s) for n, s in enumerate(old)])
                return i + 1, state, new

            sums = [[dr.zeros(t.Float, dr.width(h)) for _ in total] for _ in parts]
            state = (t.UInt(0), basis.start(dr.width(h)), sums)
            *_, slopes = dr.while_loop(state, lambda i, *_: i < stride, pair, label="slopes")
            dr.eval(slopes)
        for step, of_step in zip(moved, slopes, strict=True):
            total = [dr.fma(step, slope, value) for slope, value in zip(of_step, total, strict=True)]
        return total


def _blend(weights: list[Any], values: list[Any]) -> Any:
    total = weights[0] * values[0]
    for weight, value in zip(weights[1:], values[1:], strict=True):
        total = dr.fma(weight, value, total)
    return total


def _between_levels(grid: Grid, values: Any, length: int) -> Any:
    """[K, length] -> [levels, length]: by the polynomial in the altitude coordinate through four nodes, or six where
    derivatives are wanted."""
    t, count = types(), min(6 if grid.resolution.twice else 4, grid.shape[0])

    def taps() -> tuple[Any, Any]:
        level = np.arange(grid.level_count) / grid.refine
        first = np.clip(np.floor(level).astype(int) + 1 - count // 2, 0, grid.shape[0] - count)
        nodes = (first[:, None] + np.arange(count)).astype(float)
        return uints(first), floats(lagrange(nodes, level))

    first, weights = grid.kept("between levels", taps)
    lane = dr.arange(t.UInt, grid.level_count * length)
    level, place = lane // length, lane % length
    start, total = dr.gather(t.UInt, first, level), 0.0
    for i in range(count):
        value = dr.gather(t.Float, values, (start + i) * length + place)
        total = dr.fma(dr.gather(t.Float, weights, level * count + i), value, total)
    return evaluated(total)
