"""Column densities (m) of every constituent from any point to the sun: one small table per atmosphere's profiles.

Columns, not transmittance, are stored: exp(-sum beta_k N_k) neither underflows nor divides 0 by 0 in haze, and
coefficients, wavelengths and ozone amount drop out of the table.

Only rays that rise (mu >= 0) are tabulated. A ray that descends passes its perigee at altitude h_p and rises again,
so that N(h, -mu) = 2 N(h_p, 0) - N(h, mu). What is stored is the mean density along the path to the top, N / d_top:
finite and smooth up to the top, where both vanish, and constant in mu for a flat layer.

Rows are altitudes, some in every shell between two breaks of the profiles, with rows of their own at both its ends.
Just below a kink a horizontal ray's column has a root, sqrt(h_break - h), and an oblique one's a line: rows lie at
h_break - width x^2, and profiles with kinks are interpolated linearly in the distance s to the break, exact for both.
Where density changes linearly, by q per metre of depth below a break of radius r, the column of the shell is a cubic,
rho s + q (mu s^2 / 2 + s^3 / 3r): its divided difference is what a line lacks. Exponential profiles have no kinks; the
logarithm of their mean is interpolated linearly in h.
"""

from __future__ import annotations

from copy import copy
from typing import Any

import drjit as dr
import numpy as np

from . import noted
from ._trees import flat
from .backend import floats, packet, parameter, row, sum_loop, table_of, types
from .geometry import altitude_along, distance_up, perigee_altitude
from .grid import Grid
from .kept import Keeper
from .levels import thinnest
from .optics import Optics
from .profile import Exponential, Tabulated
from .profile_tangents import Part, few_numbers, tangents
from .quadrature import gauss_legendre

NODES_PER_LAYER = 4
LEAST = 1e-37  # mean density of which a logarithm is made
# Rows in a shell where densities are tabulated: what is above a step is steep in its light. Fewer in many shells.
LEAST_ROWS, MANY_ROWS = 24, 1536
MANY_SHELLS = 500  # so thin that two nodes do in each
_CELLS = 4096  # of the look-up from altitude to shell, uniform in the square root of altitude


class SunColumns:
    """Table of mean densities over altitude and mu in [0, 1] (logarithmic from the horizontal); bilinear.

    ``size`` = (altitudes, cosines), the altitudes shared out among the shells. The cosine nodes are mu = c (e^{s x} -
    1), fine where the thinnest layer's path length turns from 1/mu to horizontal, mu about sqrt(2 H / R). ``table``:
    the numbers, where they are known already.
    """

    def __init__(self, optics: Optics, size: tuple[int, int] = (96, 128), table: Any = None) -> None:
        self.optics = optics
        self._count = len(optics.constituents)
        self._logarithmic = [isinstance(c.profile, Exponential) for c in optics.constituents]
        # Behind them in a row of the table: how density changes with depth, where that is worth a correction.
        self._sloping = [k for k, c in enumerate(optics.constituents) if isinstance(c.profile, Tabulated)]
        atmosphere, breaks = optics.atmosphere, optics.breaks_m
        knee = 0.7 * np.sqrt(2.0 * thinnest(atmosphere) / atmosphere.bottom_radius_m)
        self._knee, self._log_range = parameter(knee), parameter(np.log1p(1.0 / knee))
        self._shells, self._cosines = len(breaks) - 1, size[1]
        # Intervals per shell. It and their number are parameters: where a level more is cut no kernel is compiled.
        most = max(1, MANY_ROWS // self._shells)
        self._intervals = max(min(LEAST_ROWS if self._sloping else 4, most), round(size[0] / self._shells))
        self._rows, self._last = parameter(self._intervals), parameter(self._shells - 1.0)
        edges = np.sqrt(breaks / atmosphere.thickness_m) * _CELLS
        cell_start = np.searchsorted(edges, np.arange(_CELLS + 1), side="right") - 1
        # Mostly one shell at most begins inside a cell; under a step of density there may be several.
        several = int(np.max(np.diff(cell_start))) - 1
        self._steps = [1 << i for i in reversed(range(max(several, 0).bit_length()))]
        # Low, high, 1 / width and number of every shell, and of the shell at the start of every cell.
        bounds = np.column_stack([breaks[:-1], breaks[1:], 1.0 / np.diff(breaks), np.arange(self._shells)])
        self._bounds, self._cells = floats(bounds), floats(bounds[np.clip(cell_start, 0, self._shells - 1)])
        self._per_metre = parameter(1.0 / atmosphere.thickness_m)
        self._rule = integration_rule(optics)
        self._tangents: tuple[list[Part], Any] | None = None
        self.table = table if table is not None else self._build() if self._count else None

    def of(self, optics: Optics, table: Any = None, known: Any = None) -> SunColumns:
        """The table for other optics with profiles of the same kind, cut at the same altitudes; ``table``: its
        numbers, which carry derivatives, ``known``: which do not, where they are known already."""
        other = copy(self)
        other.optics, other._tangents = optics, None
        other.table = table if table is not None else other._build(known) if self._count else None
        return other

    @property
    def _row(self) -> int:
        """Numbers in a row of the table."""
        return self._count + len(self._sloping)

    def _build(self, known: Any = None) -> Any:
        """The table. ``known``: its numbers; then only derivatives are made."""
        t = types()
        rows, cosines = t.UInt(self._rows) + 1, self._cosines
        lane = dr.arange(t.UInt, self._shells * (self._intervals + 1) * cosines)
        place, column = lane // cosines % rows, lane % cosines
        low, high, _, _ = packet(self._bounds, lane // (cosines * rows), 4)
        x = t.Float(place) / self._rows
        h = dr.maximum(dr.fma(low - high, x * x, high), low)
        mu = dr.minimum(self._knee * (dr.exp(t.Float(column) / (cosines - 1) * self._log_range) - 1.0), 1.0)
        totals = column_up(self.optics, h, mu, self._rule, lane // (cosines * rows))
        path = distance_up(self.optics.radius, h, mu, self.optics.thickness)
        # Where the path has no length: that on this shell's side of the break.
        at_top = self.optics.densities(dr.fma(low - high, dr.maximum(x, 1e-3) ** 2, high))
        per_path = dr.select(path > 0.0, 1.0 / dr.select(path > 0.0, path, 1.0), 0.0)
        means = [dr.select(path > 0.0, total * per_path, top) for total, top in zip(totals, at_top, strict=True)]
        upper, lower = (self.optics.densities(dr.fma(low - high, part, high)) for part in (0.25, 0.75))
        grows = [2.0 * (lower[k] - upper[k]) / (high - low) for k in self._sloping]
        if known is None:
            flags = zip(means, self._logarithmic, strict=True)
            means = [dr.log(dr.maximum(mean, LEAST)) if log else mean for mean, log in flags]
            return table_of([*means, *grows], lane)
        # The derivative of a logarithm needs its number alone: the integral is not computed again.
        logs = row(known, lane, self._count, self._row)
        slopes = [
            dr.select(v > np.log(2.0 * LEAST), dr.exp(-v), 0.0) if log else 1.0
            for v, log in zip(logs, self._logarithmic, strict=True)
        ]
        with noted.knowing([known]):
            return table_of([*(slope * mean for slope, mean in zip(slopes, means, strict=True)), *grows], lane)

    def following(self, optics: Optics, keeper: Keeper) -> SunColumns:
        """The same for optics whose profiles, of few numbers, carry derivatives: look-ups then do. ``keeper``, which is
        for these profiles alone, keeps the derivatives of the table."""

        def make() -> tuple[list[Part], Any]:
            parts = tangents(optics, [range(self._count)], lambda other: [self.of(other).table])
            return parts, table_of([p.values for p in parts], dr.arange(types().UInt, dr.width(parts[0].values)))

        other = self.of(optics, self.table)
        other._tangents = keeper.kept("tangents of sun columns", make)
        return other

    def toward(self, h: Any, mu: Any, active: Any = True, optics: Optics | None = None) -> list[Any]:
        """Column density (m) of every constituent from altitude ``h`` to the top in direction ``mu`` of either sign.

        ``optics``: whose profiles' derivatives it carries, where these are spread over lanes.

        A ray that would pass below the ground is lifted to its horizon, the ray that grazes the ground: while the
        sun's centre is below the horizon, the part of the disc still seen is there.
        """
        if not self._count:
            return []
        radius = self.optics.radius
        mu = dr.maximum(mu, -dr.safe_sqrt(h * (2.0 * radius + h)) / (radius + h))
        up = self._rising(h, dr.abs(mu), active, optics)
        sinks = active & (mu < 0.0)
        lowest = dr.maximum(perigee_altitude(radius, h, mu), 0.0)
        whole = self._rising(lowest, 0.0, sinks, optics)
        return [dr.select(mu < 0.0, dr.maximum(2.0 * w - u, u), u) for u, w in zip(up, whole, strict=True)]

    def upward(self, h: Any, optics: Optics | None = None) -> list[Any]:
        """Column density (m) of every constituent straight up from altitude ``h``; ``optics``: see toward."""
        return self._rising(h, 1.0, True, optics) if self._count else []

    def _rising(self, h: Any, mu: Any, active: Any, optics: Optics | None) -> list[Any]:
        """Columns to the top from ``h`` along mu >= 0; a number for it is 0.0 or 1.0, an edge of the table."""
        t = types()
        cosines = self._cosines
        position = dr.safe_sqrt(dr.clip(h * self._per_metre, 0.0, 1.0)) * _CELLS
        _, high, _, shell = packet(self._cells, dr.minimum(t.UInt(position), _CELLS), 4, active)
        shell = t.UInt(dr.minimum(dr.select(h >= high, shell + 1.0, shell), self._last))
        for step in self._steps:
            farther = dr.minimum(shell + step, t.UInt(self._last))
            shell = dr.select(h >= dr.gather(t.Float, self._bounds, 4 * farther, active), farther, shell)
        _, high, per_width, _ = packet(self._bounds, shell, 4, active)
        depth = dr.clip((high - h) * per_width, 0.0, 1.0)
        y = dr.safe_sqrt(depth) * self._rows
        below = dr.minimum(t.UInt(y), t.UInt(self._rows) - 1)
        start = t.Float(below)
        by_altitude = dr.fma(depth, self._rows * self._rows, -start * start) / dr.fma(2.0, start, 1.0)
        corner = dr.fma(shell, t.UInt(self._rows) + 1, below) * cosines
        if isinstance(mu, float):
            corner += 0 if mu == 0.0 else cosines - 1
            fx = None
        else:
            x = dr.log(1.0 + mu / self._knee) / self._log_range * (cosines - 1)
            column = dr.minimum(t.UInt(x), cosines - 2)
            corner, fx = corner + column, x - t.Float(column)

        def rows(table: Any, count: int) -> list[list[Any]]:
            """Those of a table at the altitudes before and after."""
            if fx is None:
                return [row(table, corner + offset, count, active=active) for offset in (0, cosines)]
            pairs = [[row(table, corner + o + i, count, active=active) for i in (0, 1)] for o in (0, cosines)]
            return [[dr.lerp(v, w, fx) for v, w in zip(*pair, strict=True)] for pair in pairs]

        path = distance_up(self.optics.radius, h, mu, self.optics.thickness)
        if not all(self._logarithmic):
            # x under the break is sqrt(bend + x^2) - sqrt(bend) away from it, in units of a horizontal ray's first row.
            r = self.optics.radius + high
            bend = mu * mu * r * (0.5 * self._rows * self._rows) * per_width
            here, nearer, farther = (dr.sqrt(dr.fma(x, x, bend)) for x in (y, start, start + 1.0))
            above, beneath = dr.maximum(here + nearer, 1e-30), here + farther
            by_distance = by_altitude * ((farther + nearer) / above)
            # Columns, not means, are linear: the paths to the top of the rows. Roots are large beside their difference.
            step = dr.sqrt(2.0 * r / per_width) * (dr.fma(2.0, start, 1.0) / self._rows)
            sums = here + nearer + farther
            nearer = dr.maximum(dr.fma(-step, by_altitude / above, path), 0.0)
            farther = dr.fma(step, (1.0 - by_altitude) / beneath, path)
            # mu / 2 + (s_i + s + s_j) / 3r, times (s - s_i) (s_j - s).
            turn = sums * dr.sqrt(2.0 / (9.0 * r * per_width)) / self._rows
            lacking = (turn - 0.5 * mu) * step * step * by_altitude * (1.0 - by_altitude) / (above * beneath)
        near, far = rows(self.table, self._row)
        result = []
        for k in range(self._count):
            if self._logarithmic[k]:
                result.append(dr.exp(dr.lerp(near[k], far[k], by_altitude)) * path)
            else:
                column = dr.lerp(near[k] * nearer, far[k] * farther, by_distance)
                if k in self._sloping:
                    column -= near[self._count + self._sloping.index(k)] * lacking
                result.append(dr.maximum(column, 0.0))
        numbers = flat((optics or self.optics).profiles)
        if self._tangents is None or not dr.grad_enabled(numbers):
            return result
        parts, table = self._tangents
        for part, *ends in zip(parts, *rows(table, len(parts)), strict=True):
            number, k = numbers[part.number], part.column
            near, far = (dr.detach(end) for end in ends)
            if self._logarithmic[k]:
                slope = dr.lerp(near, far, by_altitude) * result[k]
            else:
                slope = dr.lerp(near * nearer, far * farther, by_distance)
            result[k] = dr.fma(number - dr.detach(number), dr.detach(slope), result[k])
        return result


def sun_columns(optics: Optics, grid: Grid, table: Any = None, known: Any = None) -> SunColumns:
    """The table for an atmosphere, kept with the grid unless the profiles carry derivatives; ``table``, ``known``: see
    SunColumns.of."""
    with dr.suspend_grad():
        columns = grid.kept("sun columns", lambda: SunColumns(optics, grid.resolution.columns))
    if not optics.profiles_differentiable or columns.table is None:
        return columns
    return columns.following(optics, grid) if few_numbers(optics) else columns.of(optics, table, known)


def integration_rule(optics: Optics) -> tuple[Any, Any]:
    """What column_up integrates by: the altitudes between which profiles are smooth; nodes and weights in between."""
    nodes = NODES_PER_LAYER if len(optics.breaks_m) < MANY_SHELLS else 2
    return floats(optics.breaks_m), floats(np.column_stack(gauss_legendre(nodes)))


def column_up(
    optics: Optics, h: Any, mu: Any, rule: tuple[Any, Any] | None = None, shell: Any = 0
) -> list[Any]:
    """Column density (m) of every constituent from ``h`` to the top along mu >= 0, by Gauss-Legendre between the
    profile's breaks. ``rule``: see integration_rule; ``shell``: one that ``h`` is not below."""
    t = types()
    breaks, nodes = rule or integration_rule(optics)
    nodes_in_each = dr.opaque(t.UInt, dr.width(nodes) // 2, 1)
    optics = optics.spread(dr.width(h))

    # One node per pass, not one layer: a quarter of the code to compile.
    def add(index: Any, totals: list[Any], profiles: list[Any]) -> tuple[Any, list[Any]]:
        low, high = (dr.maximum(dr.gather(t.Float, breaks, index // nodes_in_each + i), h) for i in (0, 1))
        node, weight = packet(nodes, index % nodes_in_each, 2)
        start = distance_up(optics.radius, h, mu, low)
        length = distance_up(optics.radius, h, mu, high) - start
        there, _ = altitude_along(optics.radius, h, mu, dr.fma(length, node, start))
        length = length * weight
        densities = optics.with_values({"profiles": profiles}).densities(there)
        return index + 1, [dr.fma(length, d, total) for d, total in zip(densities, totals, strict=True)]

    last = nodes_in_each * (dr.opaque(t.UInt, dr.width(breaks), 1) - 1)
    zero = [dr.zeros(t.Float, dr.width(h)) for _ in optics.constituents]
    start = t.UInt(shell) * nodes_in_each, zero
    _, totals = sum_loop(start, lambda i, _: i < last, add, optics.profiles, "column_up")
    return totals
