"""The straight paths along which light is gathered at the nodes: geometry only, float64 NumPy, once per planet and
resolution.

From every node altitude h_k a few directions mu leave. A path is cut where it crosses a refined level, and at its
perigee: so the field is never interpolated in altitude except at the perigee, and everything about a path node (its
altitude, zenith cosine there, angle travelled about the planet's centre) is independent of sun and azimuth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np

from .backend import floats, uints
from .grid import Grid
from .quadrature import split_directions


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
class Paths:
    """Stations of all rays (k, direction), concatenated ray after ray: T stations in all, N rays.

    ``first`` [N + 1]: where each ray's stations start. Per station: ``ray``, ``distance`` (m) from the ray's origin,
    ``mu`` (zenith cosine there), ``cos_turn``, ``sin_turn`` (angle about the centre), ``u`` (altitude coordinate).
    Per ray: ``h``, ``mu_start``; ``ground``: it ends on it.

    The field is looked up at visits: one per station on a level, two (the levels below and above) at a perigee. Per
    visit: its ``station``, ``level``, and ``factor``, the share of that level. ``first_visit`` [N + 1]: where each
    ray's visits start. ``locate`` gives level and share of an altitude.
    """

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
    locate: Callable[[Any], tuple[Any, Any]]

    @cached_property
    def device(self) -> SimpleNamespace:
        """Every array as a Dr.Jit buffer, and ``turns`` [visits, 2], ``follows`` (a station follows on the same ray),
        ``on_ground``."""
        real = ("distance", "mu", "cos_turn", "sin_turn", "u", "h", "mu_start", "factor")
        whole = ("first", "ray", "station", "level", "first_visit")
        ends = np.append(self.ray[1:] != self.ray[:-1], True)
        return SimpleNamespace(
            **{name: floats(getattr(self, name)) for name in real},
            **{name: uints(getattr(self, name)) for name in whole},
            turns=floats(np.column_stack([self.cos_turn[self.station], self.sin_turn[self.station]])),
            follows=uints(~ends),
            on_ground=floats(ends & self.ground[self.ray]),
        )

    @property
    def count(self) -> int:
        """T, the number of stations."""
        return len(self.ray)

    @classmethod
    def trace(cls, grid: Grid, directions: Directions, refine: int) -> Paths:
        """Trace every direction of every node altitude to the ground or the top, with ``refine`` levels per altitude
        interval."""
        radius, levels = grid.radius_m, grid.levels_at(refine)
        count = len(levels)
        k = np.repeat(np.arange(len(grid.h)) * refine, directions.mu.shape[1])
        h, mu = levels[k], directions.mu.ravel()
        r = radius + h
        r_mu = r * mu
        sine = np.sqrt((1.0 - mu) * (1.0 + mu))
        perigee = h - r * mu * mu / (1.0 + sine)
        falls = mu < 0.0
        ground = falls & (perigee <= 0.0)

        # Columns of the padded table: falling through the levels from the top down, the perigee, rising through the
        # levels.
        level = np.concatenate([levels[::-1], [0.0], levels])
        index = np.concatenate([np.arange(count)[::-1], [-1], np.arange(count)])
        falling = np.arange(2 * count + 1) < count
        at_perigee = index == -1
        altitude = np.where(at_perigee, perigee[:, None], level)
        reached = np.where(
            falling,
            falls[:, None] & (index <= k[:, None]) & (altitude >= np.where(ground, -1.0, perigee)[:, None]),
            np.where(falls[:, None], ~ground[:, None] & (altitude > perigee[:, None]), index >= k[:, None]),
        )
        reached = np.where(at_perigee, (falls & ~ground)[:, None], reached)

        square = r_mu[:, None] ** 2 - (h[:, None] - altitude) * (2.0 * radius + h[:, None] + altitude)
        root = np.where(at_perigee, 0.0, np.sqrt(np.maximum(square, 0.0)))
        signed = np.where(falling, -root, root)  # distance past the perigee
        distance = np.maximum(signed - r_mu[:, None], 0.0)
        distance = np.where(index == k[:, None], np.where(falling == falls[:, None], 0.0, distance), distance)
        there = radius + altitude

        ray, column = np.nonzero(reached)
        u = refine * grid.u_of(altitude)
        u = np.where(at_perigee, u, index)[ray, column]
        d, r_there = distance[ray, column], there[ray, column]
        below = np.minimum(np.floor(u).astype(int), count - 2)
        share = u - below
        twice = (share > 0.0) & (share < 1.0)
        station = np.repeat(np.arange(len(u)), 1 + twice)
        upper = np.append(False, station[1:] == station[:-1]) | (share == 1.0)[station]
        first = np.concatenate([[0], np.cumsum(reached.sum(axis=1))])
        return cls(
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
            level=below[station] + upper,
            factor=np.where(upper, share[station], 1.0 - share[station]),
            first_visit=np.searchsorted(station, first),
            locate=lambda altitude: grid.locate_altitude(altitude, refine),
        )


@lru_cache(maxsize=32)
def directions_at(grid: Grid, up: int, down: int) -> Directions:
    """Directions at the solved altitudes, kept with the grid."""
    return Directions.at_nodes(grid, up, down)


@lru_cache(maxsize=32)
def paths_along(grid: Grid, directions: Directions, refine: int) -> Paths:
    """Paths along directions, kept with the grid."""
    return Paths.trace(grid, directions, refine)
