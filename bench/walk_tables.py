"""What the Monte Carlo looks up: an atmosphere tabulated finely, in double precision, from the quadrature twin."""

from __future__ import annotations

from collections.abc import Mapping

import drjit as dr
import numpy as np
from drjit.llvm.ad import Float64, UInt32

DENSITY_NODES, QUANTILES, SHELLS = 8192, 4096, 48
COLUMNS = (500, 360)  # altitudes, cosines


def buffer(values: np.ndarray) -> Float64:
    """A flat double-precision buffer."""
    return Float64(np.ascontiguousarray(values, dtype=np.float64).ravel())


def lookup(table: Float64, position: Float64, count: int, offset: UInt32 | int = 0) -> Float64:
    """Linear interpolation at a position in [0, count - 1] of the ``count`` numbers that start at ``offset``."""
    index = dr.minimum(UInt32(dr.maximum(position, 0.0)), count - 2)
    fraction = dr.clip(position - Float64(index), 0.0, 1.0)
    low, high = (dr.gather(Float64, table, offset + index + step) for step in (0, 1))
    return dr.fma(high - low, fraction, low)


class Tables:
    """Densities, columns to the sun, phase functions and majorants of a ``twins.Twin``."""

    def __init__(self, twin) -> None:
        self.twin, self.width = twin, twin.width
        self.radius, self.top = twin.radius, twin.top
        species = twin.species
        self.count = len(species)
        h = np.linspace(0.0, self.top, DENSITY_NODES)
        density = np.array([s.density(h) for s in species])
        self.density = [buffer(d) for d in density]
        self.scattering = [buffer(s.scattering) for s in species]
        self.extinction = [buffer(s.extinction) for s in species]
        levels = self.top * (np.arange(SHELLS + 1) / SHELLS) ** 1.5
        shell = np.clip(np.searchsorted(levels, h, side="right") - 1, 0, SHELLS - 1)
        total = np.array([s.extinction for s in species]).T @ density
        largest = np.zeros((self.width, SHELLS))
        for offset in (-1, 0, 1):  # a shell's majorant holds for interpolation across its edges too
            np.maximum.at(largest.T, np.roll(shell, offset), total.T)
        self.majorant, self.levels = buffer(largest * 1.0001 + 1e-30), buffer(levels)
        self._tabulate_columns()
        self._tabulate_phases()
        self.albedo = buffer(twin.albedo)

    def _tabulate_columns(self) -> None:
        n_h, n_mu = COLUMNS
        self.knee = 0.01
        h = self.top * (np.arange(n_h) / (n_h - 1)) ** 2
        mu = self.knee * np.expm1(np.arange(n_mu) / (n_mu - 1) * np.log1p(1 / self.knee))
        grid = np.meshgrid(h, np.minimum(mu, 1.0), indexing="ij")
        parts = [self.twin.columns(a, b) for a, b in zip(*(np.array_split(g.ravel(), 60) for g in grid), strict=True)]
        self.sun_columns = [buffer(column) for column in np.concatenate(parts).T]

    def _tabulate_phases(self) -> None:
        x = np.linspace(0.0, np.pi, 200_001)
        nu = np.cos(x)
        rank = np.linspace(0.0, 1.0, QUANTILES)
        self.phase_value, self.phase_quantile = [], []
        for s in self.twin.species:
            if s.phase is None:
                self.phase_value.append(None)
                self.phase_quantile.append(None)
                continue
            p = s.phase(nu) * np.sin(x)[:, None]
            cumulative = np.vstack([np.zeros(self.width), np.cumsum((p[1:] + p[:-1]) / 2, axis=0)])
            cumulative /= cumulative[-1]
            self.phase_quantile.append(buffer(np.array([np.interp(rank, c, x) for c in cumulative.T])))
            self.phase_value.append(buffer(s.phase(np.cos(np.linspace(0.0, np.pi, 20_001))).T))

    def densities(self, h: Float64) -> list[Float64]:
        """Density of every species at altitudes."""
        position = h / self.top * (DENSITY_NODES - 1)
        return [lookup(table, position, DENSITY_NODES) for table in self.density]

    def coefficient(self, tables: list[Float64], densities: list[Float64], w: UInt32) -> list[Float64]:
        """Scattering or extinction coefficient of every species, 1/m."""
        return [dr.gather(Float64, table, w) * d for table, d in zip(tables, densities, strict=True)]

    def sunlight(self, h: Float64, mu_s: Float64, w: UInt32) -> Float64:
        """Transmittance to the sun times the visible fraction of its disc."""
        r = self.radius + h
        horizon = -dr.sqrt(h * (2 * self.radius + h)) / r
        half = max(self.twin.disc, 1e-12) * self.radius / r
        x = dr.clip((mu_s - horizon + half) / (2 * half), 0.0, 1.0)
        mu = dr.maximum(mu_s, horizon)
        perigee = dr.maximum(r * dr.safe_sqrt(1 - mu * mu) - self.radius, 0.0)
        own, low = self._rising(h, dr.abs(mu)), self._rising(perigee, Float64(0.0))
        depth = Float64(0.0)
        for table, up, down in zip(self.extinction, own, low, strict=True):
            depth += dr.gather(Float64, table, w) * dr.select(mu < 0, dr.maximum(2 * down - up, up), up)
        return x * x * (3 - 2 * x) * dr.exp(-depth)

    def _rising(self, h: Float64, mu: Float64) -> list[Float64]:
        n_h, n_mu = COLUMNS
        y = dr.sqrt(dr.clip(h / self.top, 0.0, 1.0)) * (n_h - 1)
        row = dr.minimum(UInt32(y), n_h - 2)
        low, high = (self.top * (Float64(row + step) / (n_h - 1)) ** 2 for step in (0, 1))
        f = (h - low) / (high - low)
        x = dr.log(1 + mu / self.knee) / np.log1p(1 / self.knee) * (n_mu - 1)
        return [
            dr.lerp(lookup(t, x, n_mu, row * n_mu), lookup(t, x, n_mu, (row + 1) * n_mu), f) for t in self.sun_columns
        ]

    def first_events(self, views: Mapping[str, np.ndarray]) -> None:
        """Quantiles of the distance to the first event of each view ray and wavelength, and its probability."""
        twin = self.twin
        h, mu = views["h"], views["mu"]
        enter, leave = twin.limits(h, mu)
        steps = 1500
        x = (
            1 - np.cos(np.linspace(0, np.pi, steps + 1))
        ) / 2  # dense at both ends: sinking rays meet their density there
        perigee = np.clip(-(twin.radius + h) * mu, enter, leave)
        quantiles = np.zeros((h.size, self.width, QUANTILES))
        self.hits, inside = twin.hits_ground(h, mu), np.zeros((h.size, self.width))
        for i in range(h.size):
            d = np.unique(
                np.concatenate([enter[i] + (perigee[i] - enter[i]) * x, perigee[i] + (leave[i] - perigee[i]) * x])
            )
            if d.size < 2:
                continue
            pieces = twin.optical_depth(
                twin.columns(np.full(d.size - 1, h[i]), np.full(d.size - 1, mu[i]), d[:-1], d[1:])
            )
            depth = np.vstack([np.zeros(self.width), np.cumsum(pieces, axis=0)])
            for w in range(self.width):
                event = -np.expm1(-depth[:, w])
                inside[i, w] = event[-1]
                if event[-1] > 0:
                    quantiles[i, w] = np.interp(np.linspace(0, event[-1], QUANTILES), event, d)
        self.first_distance, self.first_probability = buffer(quantiles), buffer(inside)
