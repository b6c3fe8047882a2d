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

from .backend import evaluated, packet, padded, row_size, stored, table, types, uints
from .column import SunColumns
from .geometry import safe_sine
from .grid import Grid
from .harmonics import Harmonics, pair_count, pair_index, pairs, recurrence
from .look_ups import LookUps
from .optics import Optics
from .pair_sums import sums_of_pairs
from .phase import RayleighPhase
from .refinement import Reference, Taps, between_levels
from .slopes import steep_nodes
from .total import parity

SMOOTH = 2  # degree of the phase function of air: beyond it only aerosols scatter


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
            field.__dict__["_refined_moments"] = list(tables["moments"])
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

    def _refined(self, values: Any, degree: int | None = None) -> Any:
        """[K, first suns, entries, channels] -> [levels, sources, entries, size], interpolated cubically. ``degree``:
        of moments; None: one entry."""
        t, grid, channels = types(), self.grid, self.optics.channel_count
        suns, entries = len(grid.first_theta), 1 if degree is None else pair_count(degree)
        row_length = suns * entries * channels
        values = between_levels(grid, values, row_length)
        lane = dr.arange(t.UInt, grid.level_count * grid.sources * entries)
        entry, node = lane % entries, lane // entries
        source, level = node % grid.sources, node // grid.sources
        taps = Taps(grid, t.Float(source) * (grid.first / grid.sun_refine), suns)
        sign = 1.0 if degree is None else dr.gather(t.Float, parity(grid, degree), entry)
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
    def _groups(self) -> list[tuple[int, list[int]]]:
        """Scatterers that are summed together, and up to which degree: phase functions of air end at SMOOTH."""
        scatterers = enumerate(self.optics.scatterers)
        smooth = [n for n, k in scatterers if isinstance(self.optics.constituents[k].phase, RayleighPhase)]
        sharp = [n for n in range(len(self.optics.scatterers)) if n not in smooth]
        if not smooth or not sharp or self.degree <= SMOOTH:
            return [(self.degree, sorted(smooth + sharp))]
        return [(self.degree, sharp), (SMOOTH, smooth)]

    @cached_property
    def _tables(self) -> list[tuple[Any, Any, Any]]:
        """Per group moments at refined suns for look-ups, the phase moments of every pair, and the recurrence of
        harmonics."""
        channels, all_kinds = self.optics.channel_count, len(self.optics.scatterers)
        found = []
        for (degree, kinds), moments in zip(self._groups, self._refined_moments, strict=True):

            def steps(degree: int = degree, kinds: list[int] = kinds) -> tuple[Any, Any]:
                l_, m = pairs(degree)
                rows = [[*entry, float(a == b)] for entry, a, b in zip(recurrence(degree), l_, m, strict=True)]
                columns = np.array([n * channels + c for n in kinds for c in range(channels)])
                columns = np.pad(columns, (0, row_size(len(columns)) - len(columns)), mode="edge")
                places = l_[:, None] * row_size(all_kinds * channels) + columns
                return table(np.pad(rows, ((0, -len(rows) % 8), (0, 0)))), uints(places)

            key = ("recurrences", degree, *kinds, all_kinds, channels)
            recurrences, places = self.grid.kept(key, steps)
            phases = dr.gather(types().Float, self.optics.phase_moments(self.degree), places)
            found.append((moments, evaluated(phases), recurrences))
        return found

    @cached_property
    def _refined_moments(self) -> list[Any]:
        return [self._refined(self._up_to(degree), degree) for degree, _ in self._groups]

    def _up_to(self, degree: int) -> Any:
        """The moments up to a degree."""
        if degree == self.degree:
            return self.moments
        t, channels = types(), self.optics.channel_count

        def find() -> Any:
            places = [pair_index(self.degree, l_, m) for l_, m in zip(*pairs(degree), strict=True)]
            nodes = np.arange(self.grid.shape[0] * len(self.grid.first_theta))
            rows = nodes[:, None] * pair_count(self.degree) + np.array(places)
            return uints(rows[..., None] * channels + np.arange(channels))

        place = self.grid.kept(("up to", self.degree, degree, channels), find)
        return evaluated(dr.gather(t.Float, self.moments, place, mode=dr.ReduceMode.NoConflicts))

    @cached_property
    def _guide(self) -> Any:
        """The reference at refined levels, interpolated in its logarithm."""
        logs = dr.log(dr.maximum(self.reference.fine, 1e-37))
        dr.eval(logs)
        guide = dr.exp(between_levels(self.grid, logs, dr.width(logs) // self.grid.shape[0]))
        dr.eval(guide)
        return guide

    @cached_property
    def _irradiances(self) -> tuple[Any, Any]:
        return self._refined(self.sky), self._refined(self.reflected)

    def refined_moments(self) -> np.ndarray:
        """Moments over the reference at the nodes of look-ups, float32 [levels x suns, pairs, channels]."""
        moments = np.array(dr.detach(self._refined_moments[0]), dtype=np.float32)
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
        channels, kinds = self.optics.channel_count, len(self.optics.scatterers)
        nodes, weights, scales = self.corners(h, mu_s, active)
        weights = [[w * scales[i // 2][c] for c in range(channels)] for i, w in enumerate(weights)]
        sine = safe_sine(mu)
        x = sine * cos_phi
        basis = Harmonics(dr.detach(mu), dr.detach(x), slopes=dr.grad_enabled(mu, cos_phi))
        width, total = dr.width(h), [None] * (kinds * channels)
        before = None
        for (degree, members), (moments, phases, recurrences) in zip(self._groups, self._tables, strict=True):
            count = len(members)
            if dr.grad_enabled(moments, phases, weights) or basis.slopes:
                look_ups = LookUps(self.grid, degree, channels, count, nodes[0], basis, recurrences, active, before)
                found, slopes = look_ups(moments, phases, weights)
                before = before or look_ups
                # Directions have no derivative in there; theirs follow from the slopes.
                for step, of_step in zip((mu - basis.mu, x - basis.x), slopes, strict=False):
                    found = [dr.fma(step, slope, value) for slope, value in zip(of_step, found, strict=True)]
            else:
                tables = moments, phases, recurrences
                (found,) = sums_of_pairs(degree, (channels, count), [(nodes, weights)], basis, *tables, active)
            for i, n in enumerate(members):
                total[n * channels : (n + 1) * channels] = found[i * channels : (i + 1) * channels]
        if self._steep(h, mu_s):
            total = [a + b for a, b in zip(total, self._moved(h, mu_s, basis, active), strict=True)]
        solar = self.optics.spread(width).solar
        return [[e * v for e, v in zip(solar, total[n * channels :], strict=False)] for n in range(kinds)]

    def _steep(self, h: Any, mu_s: Any) -> bool:
        """Whether derivatives by a place or sun, of a fine solve, pass through look-ups there."""
        return self.grid.resolution.twice and dr.grad_enabled(h, mu_s)

    def _moved(self, h: Any, mu_s: Any, basis: Harmonics, active: Any) -> list[Any]:
        """0, with the derivatives of what ``unclipped`` sums by level and sun: [scatterer x channel]."""
        t, channels = types(), self.optics.channel_count
        moved, parts = steep_nodes(self.grid, self.reference, self._guide, h, mu_s, active)
        total = [t.Float(0.0)] * (len(self.optics.scatterers) * channels)
        basis = Harmonics(basis.mu, basis.x, slopes=False)
        for (degree, members), tables in zip(self._groups, self._tables, strict=True):
            with dr.suspend_grad():
                tables = [dr.detach(v) for v in tables]
                flat = sums_of_pairs(degree, (channels, len(members)), parts, basis, *tables, active)
                dr.eval(flat)
            for step, of_step in zip(moved, flat, strict=True):
                for i, n in enumerate(members):
                    for c in range(channels):
                        place = n * channels + c
                        total[place] = dr.fma(step, of_step[i * channels + c], total[place])
        return total
