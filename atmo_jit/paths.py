"""The straight paths along which light is gathered at the nodes: geometry only, float64 NumPy, once per planet and
resolution.

From every node altitude h_k a few directions mu leave. A path is cut where it crosses a level, and at its perigee: so
the field is never interpolated in altitude except at the perigee, and everything about a path node (its altitude,
zenith cosine there, angle travelled about the planet's centre) is independent of sun and azimuth.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from types import SimpleNamespace
from typing import Any

import numpy as np

from .backend import floats, table, uints
from .grid import Grid
from .kept import Keeper
from .quadrature import gauss_legendre, running_integral, split_directions

OPAQUE = 80.0  # optical depth, by the grid's bound (at most twice the true one), behind which points are left out
ON_LEVEL = 1e-3  # of a level's interval: so near a station is taken to be on the level
PIECE_DEPTH = 1.0  # optical depth between two sets of Gauss points


@dataclass(frozen=True, eq=False)
class Directions:
    """Directions at every node altitude: ``mu`` and ``weight`` [K, D] (weights sum to 2), ``facing_up`` [K, D]: those
    of the irradiance."""

    mu: np.ndarray
    weight: np.ndarray
    facing_up: np.ndarray

    @classmethod
    def at_nodes(cls, grid: Grid, up: int, down: int) -> Directions:
        """Gauss-Legendre directions split at each altitude's own horizon."""
        r = grid.radius_m + grid.h
        horizon = -np.sqrt(grid.h * (2.0 * grid.radius_m + grid.h)) / r
        return cls(*(np.array(rows) for rows in zip(*(split_directions(m, up, down) for m in horizon), strict=True)))


@dataclass(frozen=True, eq=False)
class Paths(Keeper):
    """Stations of all rays (k, direction), concatenated ray after ray: T stations in all, N rays.

    ``first`` [N + 1]: where each ray's stations start. Per station: ``ray``, ``distance`` (m) from the ray's origin,
    ``mu`` (zenith cosine there), ``cos_turn``, ``sin_turn`` (angle about the centre), ``u`` (altitude coordinate in
    levels). Per ray: ``h``, ``mu_start``; ``ground``: it ends on it.

    Light is looked up at visits: one per station on a level, four (two levels below, two above) at another, a perigee.
    Per visit: its ``station``, ``level``, and ``factor``, the share of that level. ``first_visit`` [N + 1]: where each
    ray's visits start. Where stations off the levels have levels ``of_their_own``, there is one visit per station.

    ``levels`` (m): altitudes of the levels, those of the grid first.
    """

    grid: Grid
    refine: int
    levels: np.ndarray
    first: np.ndarray
    ray: np.ndarray
    distance: np.ndarray
    mu: np.ndarray
    cos_turn: np.ndarray
    sin_turn: np.ndarray
    u: np.ndarray
    h: np.ndarray
    mu_start: np.ndarray
    ground: np.ndarray
    station: np.ndarray
    level: np.ndarray
    factor: np.ndarray
    first_visit: np.ndarray
    _kept: dict[Any, Any] = field(default_factory=dict)

    @cached_property
    def device(self) -> SimpleNamespace:
        """What kernels read, as Dr.Jit buffers: per visit ``level``, ``turns`` [visits, 2], ``factor``, ``station``,
        ``ray``, ``on_ground``; per ray ``first_visit``, ``mu_start``."""
        ends = np.append(self.ray[1:] != self.ray[:-1], True)
        of_visit = self.station
        return SimpleNamespace(
            level=uints(self.level),
            turns=floats(np.column_stack([self.cos_turn[of_visit], self.sin_turn[of_visit]])),
            factor=floats(self.factor),
            station=uints(self.station),
            ray=uints(self.ray[of_visit]),
            on_ground=floats((ends & self.ground[self.ray])[of_visit]),
            first_visit=uints(self.first_visit),
            mu_start=floats(self.mu_start),
        )

    @property
    def count(self) -> int:
        """T, the number of stations."""
        return len(self.ray)

    @classmethod
    def trace(
        cls, grid: Grid, h: np.ndarray, mu: np.ndarray, refine: int, *, of_their_own: bool = False
    ) -> Paths:
        """Trace rays from altitudes ``h`` [N] (m) in directions ``mu`` [N] to the ground or the top, with ``refine``
        levels per altitude interval."""
        radius, levels = grid.radius_m, grid.levels_at(refine)
        count = len(levels)
        r = radius + h
        r_mu = r * mu
        sine = np.sqrt((1.0 - mu) * (1.0 + mu))
        perigee = h - r * mu * mu / (1.0 + sine)
        falls = mu < 0.0
        ground = falls & (perigee <= 0.0)

        # Columns of the padded table: the start, falling through the levels from the top down, the perigee, rising
        # through the levels.
        level = np.concatenate([[0.0], levels[::-1], [0.0], levels])
        index = np.concatenate([[-2], np.arange(count)[::-1], [-1], np.arange(count)])
        falling = np.arange(2 * count + 2) <= count
        at_start, at_perigee = index == -2, index == -1
        altitude = np.where(at_start, h[:, None], np.where(at_perigee, perigee[:, None], level))
        above, below = altitude > h[:, None], altitude < h[:, None]
        reached = np.where(
            falling,
            falls[:, None] & below & (altitude >= np.where(ground, -1.0, perigee)[:, None]),
            np.where(falls[:, None], ~ground[:, None] & (altitude > perigee[:, None]), above),
        )
        reached = np.where(at_perigee, (falls & ~ground)[:, None], reached) | at_start

        square = r_mu[:, None] ** 2 - (h[:, None] - altitude) * (2.0 * radius + h[:, None] + altitude)
        root = np.where(at_perigee, 0.0, np.sqrt(np.maximum(square, 0.0)))
        signed = np.where(falling, -root, root)  # distance past the perigee
        distance = np.where(at_start, 0.0, np.maximum(signed - r_mu[:, None], 0.0))
        signed = np.where(at_start, r_mu[:, None], signed)
        there = radius + altitude

        ray, column = np.nonzero(reached)
        u = np.where(at_perigee | at_start, refine * grid.u_of(altitude), index)[ray, column]
        d, r_there = distance[ray, column], there[ray, column]
        u = np.where(np.abs(u - np.round(u)) < ON_LEVEL, np.round(u), u)
        below = np.clip(np.floor(u).astype(int), 0, count - 2)
        share = u - below
        apart = (share > 0.0) & (share < 1.0)
        if of_their_own:
            station, factor = np.arange(len(u)), np.ones(len(u))
            level = np.where(apart, count + np.cumsum(apart) - 1, below + (share == 1.0))
            levels = np.concatenate([levels, np.where(at_perigee, perigee[:, None], h[:, None])[ray, column][apart]])
        else:
            around = np.clip(below - 1, 0, max(count - 4, 0))[:, None] + np.arange(min(count, 4))
            shares = lagrange(around.astype(float), u)
            station, place = np.nonzero(np.where(apart[:, None], np.abs(shares) > 0.0, around == np.round(u)[:, None]))
            level, factor = around[station, place], np.where(apart[station], shares[station, place], 1.0)
        first = np.concatenate([[0], np.cumsum(reached.sum(axis=1))])
        return cls(
            grid=grid,
            refine=refine,
            levels=levels,
            first=first,
            ray=ray,
            distance=d,
            mu=np.clip(signed[ray, column] / r_there, -1.0, 1.0),
            cos_turn=(r[ray] + d * mu[ray]) / r_there,
            sin_turn=d * sine[ray] / r_there,
            u=u,
            h=h,
            mu_start=mu,
            ground=ground,
            station=station,
            level=level,
            factor=factor,
            first_visit=np.searchsorted(station, first),
        )

    def points(self, nodes: int) -> Points:
        """Gauss points along every path, ``nodes`` for each piece between two stations, more where it is opaque."""
        follows = np.flatnonzero(self.ray[1:] == self.ray[:-1])
        ray, length = self.ray[follows], self.distance[follows + 1] - self.distance[follows]
        x, w = gauss_legendre(nodes)
        middle = self._altitude(ray, self.distance[follows] + 0.5 * length)
        ends = self._altitude(ray, self.distance[follows]), self._altitude(ray, self.distance[follows + 1])
        depth = length * np.max([self.grid.extinction_bound(h) for h in (middle, *ends)], axis=0)
        passed = np.concatenate([[0.0], np.cumsum(depth)])[:-1]
        passed -= passed[np.searchsorted(follows, self.first[:-1])[ray].clip(0, len(passed) - 1)]
        parts = np.clip(np.ceil(np.minimum(depth, OPAQUE - passed) / PIECE_DEPTH), 1, None).astype(int)
        parts = np.where(passed < OPAQUE, parts, 0)
        part_length = np.where(passed + depth > OPAQUE, length * OPAQUE / np.maximum(depth, OPAQUE), length)
        part_length = part_length / np.maximum(parts, 1)

        piece = np.repeat(np.arange(len(follows)), parts)
        number = np.arange(len(piece)) - np.repeat(np.cumsum(parts) - parts, parts)
        start = self.distance[follows[piece]] + number * part_length[piece]
        end = (self.distance[follows] + parts * part_length)[piece]
        piece, start, end = self._cut_at_kinks(follows, piece, start, end)
        last = np.append(piece[1:] != piece[:-1], True)
        step = np.where(last, end, np.roll(start, -1)) - start
        at = start[:, None] + step[:, None] * x
        h = self._altitude(np.repeat(ray[piece], nodes), at.ravel())
        behind = np.repeat(follows[piece], nodes)
        shares = self._shares(behind, at.ravel())
        per_station = np.zeros(self.count, dtype=int)
        per_station[follows] = np.bincount(piece, minlength=len(follows))
        first_part = np.concatenate([[0], np.cumsum(per_station)])
        return Points(
            paths=self,
            nodes=nodes,
            h=h,
            length=np.repeat(step, nodes),
            weight=(step[:, None] * w).ravel(),
            shares=shares,
            first_part=first_part,
            part_ray=ray[piece],
        )

    def _cut_at_kinks(
        self, follows: np.ndarray, piece: np.ndarray, start: np.ndarray, end: np.ndarray
    ) -> tuple[np.ndarray, ...]:
        """Parts, in order, by the ``piece`` that each is of, where it starts and where that piece ends: also cut where
        a piece, after the stations ``follows``, crosses a kink of a profile. Gauss points do not know of kinks between
        them, and the derivative by the altitude of one is a step there."""
        ray, pieces = self.ray[follows], np.arange(len(follows))
        low, high = (self._altitude(ray, self.distance[follows + i]) for i in (0, 1))
        whole = np.zeros(len(follows))
        whole[piece] = end
        r, r_mu = self.grid.radius_m + self.h[ray], (self.grid.radius_m + self.h[ray]) * self.mu_start[ray]
        for kink in self.grid.kinks_m:
            square = r_mu**2 - (self.h[ray] - kink) * (self.grid.radius_m + kink + r)
            crossing = np.copysign(np.sqrt(np.maximum(square, 0.0)), high - low) - r_mu
            cut = (np.minimum(low, high) < kink) & (kink < np.maximum(low, high))
            cut &= (crossing > self.distance[follows]) & (crossing < whole)
            piece, start = np.append(piece, pieces[cut]), np.append(start, crossing[cut])
        order = np.lexsort((start, piece))
        piece = piece[order]
        return piece, start[order], whole[piece]

    def _shares(self, behind: np.ndarray, distance: np.ndarray) -> np.ndarray:
        """Lagrange polynomials in the distance through two stations behind and two ahead, or as many as there are:
        light is known at the stations alone."""
        at = behind[:, None] + np.arange(-1, 3)
        there = np.clip(at, 0, self.count - 1)
        held = (there == at) & (self.ray[there] == self.ray[behind][:, None])
        return lagrange(np.where(held, self.distance[there], np.nan), distance)

    def _altitude(self, ray: np.ndarray, distance: np.ndarray) -> np.ndarray:
        radius = self.grid.radius_m
        r = radius + self.h[ray]
        step = distance * (2.0 * r * self.mu_start[ray] + distance)
        r_there = np.sqrt(np.maximum(r * r + step, radius * radius))
        return np.clip(self.h[ray] + step / (r + r_there), 0.0, self.grid.thickness_m)


@dataclass(frozen=True, eq=False)
class Points:
    """Gauss points along paths, in sets of ``nodes``: one set for every part of a piece.

    Per point: altitude ``h`` (m), ``length`` of its part and ``weight`` (m), and the ``shares`` [points, 4] that
    stations have in what happens there, two behind and two ahead. ``first_part`` [T + 1]: where the parts of the piece
    after each station start; ``part_ray``.
    """

    paths: Paths
    nodes: int
    h: np.ndarray
    length: np.ndarray
    weight: np.ndarray
    shares: np.ndarray
    first_part: np.ndarray
    part_ray: np.ndarray

    @cached_property
    def device(self) -> SimpleNamespace:
        """What kernels read: per point ``h``, ``length``, ``weight``, and ``shares`` times weight; per part ``first``
        (first part of its ray); per station ``bounds``, table [T, shares + 1]: where the points begin for which it is
        the last of the stations that share, the last but one, ..., and where they end; per ray ``ray_parts`` [N, 2];
        ``running`` integrals."""
        paths = self.paths
        per_ray, reach = self.first_part[paths.first], self.shares.shape[1] // 2
        station = np.arange(paths.count)[:, None] + np.arange(-reach, reach + 1)
        within = np.clip(station, paths.first[paths.ray][:, None], paths.first[paths.ray + 1][:, None])
        return SimpleNamespace(
            h=floats(self.h),
            length=floats(self.length),
            weight=floats(self.weight),
            shares=floats(self.weight[:, None] * self.shares),
            first=uints(per_ray[self.part_ray]),
            bounds=table(self.nodes * self.first_part[within]),
            ray_parts=uints(np.column_stack([per_ray[:-1], per_ray[1:]])),
            running=table(running_integral(self.nodes, tuple(gauss_legendre(self.nodes)[0].tolist()))),
        )


def lagrange(nodes: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Weights [N, n] of values at ``nodes`` [N, n] (NaN: there is none) in the polynomial through them, at ``at``."""
    held = np.isfinite(nodes)
    weights = np.where(held, 1.0, 0.0)
    for i in range(nodes.shape[1]):
        for j in range(nodes.shape[1]):
            both = (i != j) & held[:, i] & held[:, j]
            gap = np.where(both, nodes[:, i] - nodes[:, j], 1.0)
            weights[:, i] *= np.where(both, (at - np.where(both, nodes[:, j], 0.0)) / gap, 1.0)
    return weights


def directions_at(grid: Grid, up: int, down: int) -> Directions:
    """Directions at the solved altitudes, kept with the grid."""
    return grid.kept(("directions", up, down), lambda: Directions.at_nodes(grid, up, down))


def paths_along(grid: Grid, directions: Directions, refine: int, *, of_their_own: bool = False) -> Paths:
    """Paths along the directions at the solved altitudes, kept with the grid."""

    def trace() -> Paths:
        h, mu = np.repeat(grid.h, directions.mu.shape[1]), directions.mu.ravel()
        return Paths.trace(grid, h, mu, refine, of_their_own=of_their_own)

    return grid.kept(("paths", directions, refine, of_their_own), trace)


def points_along(paths: Paths, nodes: int) -> Points:
    """Gauss points along paths, kept with them."""
    return paths.kept(("points", nodes), lambda: paths.points(nodes))
