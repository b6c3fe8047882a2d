"""Where the tables of precomputed atmospheric scattering have their texels, and how they are read.

Bruneton and Neyret 2008, section 4, and Bruneton 2017: transmittance over (r, mu), irradiance over (r, mu_s),
scattering over (r, mu, mu_s, nu), packed in three dimensions with nu and mu_s along the first. ``r`` is the distance
from the planet's centre (m), ``mu`` and ``mu_s`` the cosines of view and sun zenith, ``nu`` that of the angle between
view and sun. Textures are read linearly between texel centres and held beyond the last, in single precision.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from atmo_jit.backend import packet, parameter, types

SUN_LOWEST_DEG = 120.0  # zenith angle of the lowest sun in the tables


@dataclass(frozen=True)
class Sizes:
    """Texels: as published, times a factor. ``theta``: steps of the zenith angle of the gathered directions, with
    twice as many azimuths."""

    t_mu: int = 256
    t_r: int = 64
    e_mu_s: int = 64
    e_r: int = 16
    r: int = 32
    mu: int = 128
    mu_s: int = 32
    nu: int = 8
    theta: int = 16

    @classmethod
    def times(cls, factor: float) -> Sizes:
        """The published sizes times ``factor``; mu has two halves."""

        def size(count: int) -> int:
            return max(2, round(factor * count))

        p = cls()
        rest = (size(n) for n in (p.t_mu, p.t_r, p.e_mu_s, p.e_r, p.r))
        return cls(*rest, 2 * size(p.mu // 2), size(p.mu_s), size(p.nu), size(p.theta))

    @property
    def texels(self) -> int:
        """Of the scattering table."""
        return self.r * self.mu * self.mu_s * self.nu


def coordinate(x: Any, count: int) -> Any:
    """Position among ``count`` texel centres, 0 to count - 1, of x in [0, 1]."""
    return dr.clip(x, 0.0, 1.0) * (count - 1.0)


def split(position: Any, count: int) -> tuple[Any, Any]:
    """Index of the texel before a position and the fraction of the way to the next."""
    t = types()
    index = dr.minimum(t.UInt(position), count - 2)
    return index, position - t.Float(index)


class Mapping:
    """The maps of a planet between physical coordinates and texels. ``low``, ``top``: radii of ground and top (m)."""

    def __init__(self, low: float, top: float, sizes: Sizes) -> None:
        self.sizes = sizes
        self.low, self.top = parameter(low), parameter(top)
        self.H = parameter(np.sqrt((top - low) * (top + low)))
        thickness, self._horizon_span = top - low, float(np.sqrt((top - low) * (top + low)) - (top - low))
        lowest = np.cos(np.radians(SUN_LOWEST_DEG))
        to_top = -low * lowest + np.sqrt((low * lowest) ** 2 + (top - low) * (top + low))
        self._thickness, self._span = parameter(thickness), parameter(self._horizon_span)
        self.A = parameter((to_top - thickness) / self._horizon_span)

    def to_top(self, r: Any, mu: Any) -> Any:
        """Distance to the top (m)."""
        square = r * r * (mu * mu - 1.0) + self.top * self.top
        return dr.maximum(-r * mu + dr.safe_sqrt(square), 0.0)

    def to_ground(self, r: Any, mu: Any) -> Any:
        """Distance to the ground (m), of rays that meet it."""
        square = r * r * (mu * mu - 1.0) + self.low * self.low
        return dr.maximum(-r * mu - dr.safe_sqrt(square), 0.0)

    def meets_ground(self, r: Any, mu: Any) -> Any:
        """Whether a ray meets the ground."""
        return (mu < 0.0) & (r * r * (mu * mu - 1.0) + self.low * self.low >= 0.0)

    def rho(self, r: Any) -> Any:
        """Distance to the horizon (m)."""
        return dr.safe_sqrt((r - self.low) * (r + self.low))

    # --- transmittance and irradiance ---

    def transmittance_texels(self) -> tuple[Any, Any]:
        """(r, mu) of the texels [t_r, t_mu]."""
        t, s = types(), self.sizes
        lane = dr.arange(t.UInt, s.t_r * s.t_mu)
        x_mu, x_r = t.Float(lane % s.t_mu) / (s.t_mu - 1.0), t.Float(lane // s.t_mu) / (s.t_r - 1.0)
        rho = self.H * x_r
        r = dr.sqrt(rho * rho + self.low * self.low)
        d = (self.top - r) + x_mu * (rho + self.H - (self.top - r))
        mu = dr.select(d == 0.0, 1.0, (self.H * self.H - rho * rho - d * d) / (2.0 * r * d))
        return r, dr.clip(mu, -1.0, 1.0)

    def transmittance(self, table: Any, r: Any, mu: Any, size: int) -> list[Any]:
        """To the top, from the table [t_r, t_mu, size]."""
        s = self.sizes
        rho, least = self.rho(r), self.top - r
        i, f = split(coordinate((self.to_top(r, mu) - least) / (rho + self.H - least), s.t_mu), s.t_mu)
        j, g = split(coordinate(rho / self.H, s.t_r), s.t_r)
        return bilinear(table, i, f, j, g, s.t_mu, size)

    def irradiance_texels(self) -> tuple[Any, Any]:
        """(r, mu_s) of the texels [e_r, e_mu_s]."""
        t, s = types(), self.sizes
        lane = dr.arange(t.UInt, s.e_r * s.e_mu_s)
        x_s, x_r = t.Float(lane % s.e_mu_s) / (s.e_mu_s - 1.0), t.Float(lane // s.e_mu_s) / (s.e_r - 1.0)
        return self.low + x_r * self._thickness, 2.0 * x_s - 1.0

    def irradiance(self, table: Any, r: Any, mu_s: Any, size: int, active: Any = True) -> list[Any]:
        """From the table [e_r, e_mu_s, size]."""
        s = self.sizes
        i, f = split(coordinate(0.5 * mu_s + 0.5, s.e_mu_s), s.e_mu_s)
        j, g = split(coordinate((r - self.low) / self._thickness, s.e_r), s.e_r)
        return bilinear(table, i, f, j, g, s.e_mu_s, size, active)

    # --- scattering ---

    def scattering_texels(self) -> tuple[Any, Any, Any, Any, Any]:
        """(r, mu, mu_s, nu, meets the ground) of the texels [r, mu, nu, mu_s]."""
        t, s = types(), self.sizes
        lane = dr.arange(t.UInt, s.texels)
        i_s, i_nu = lane % s.mu_s, lane // s.mu_s % s.nu
        i_mu, i_r = lane // (s.mu_s * s.nu) % s.mu, lane // (s.mu_s * s.nu * s.mu)
        half = s.mu // 2
        rho = self.H * (t.Float(i_r) / (s.r - 1.0))
        r = dr.sqrt(rho * rho + self.low * self.low)
        ground = i_mu < half
        x = t.Float(dr.select(ground, half - 1 - i_mu, i_mu - half)) / (half - 1.0)
        least = dr.select(ground, r - self.low, self.top - r)
        most = dr.select(ground, rho, rho + self.H)
        d = dr.fma(x, most - least, least)
        down = -(rho * rho + d * d) / (2.0 * r * d)
        up = (self.H * self.H - rho * rho - d * d) / (2.0 * r * d)
        mu = dr.select(d == 0.0, dr.select(ground, -1.0, 1.0), dr.clip(dr.select(ground, down, up), -1.0, 1.0))
        x_s = t.Float(i_s) / (s.mu_s - 1.0)
        a = (self.A - x_s * self.A) / (1.0 + x_s * self.A)
        d = self._thickness + dr.minimum(a, self.A) * self._span
        mu_s = dr.select(d == 0.0, 1.0, dr.clip((self.H * self.H - d * d) / (2.0 * self.low * d), -1.0, 1.0))
        nu = t.Float(i_nu) * (2.0 / (s.nu - 1.0)) - 1.0
        reach = dr.safe_sqrt((1.0 - mu * mu) * (1.0 - mu_s * mu_s))
        return r, mu, mu_s, dr.clip(nu, mu * mu_s - reach, mu * mu_s + reach), ground

    def place(self, r: Any, mu: Any, mu_s: Any, ground: Any) -> tuple[Any, ...]:
        """All of a place among the texels but nu, so that several nu can share it."""
        t, s = types(), self.sizes
        half = s.mu // 2
        rho, r_mu = self.rho(r), r * mu
        square = r_mu * r_mu - rho * rho
        d = dr.select(ground, -r_mu - dr.safe_sqrt(square), -r_mu + dr.safe_sqrt(square + self.H * self.H))
        least = dr.select(ground, r - self.low, self.top - r)
        most = dr.select(ground, rho, rho + self.H)
        x = dr.select(most == least, 0.0, (d - least) / dr.select(most == least, 1.0, most - least))
        j, g = split(coordinate(x, half), half)
        # Rows of rays to the ground run backwards from the middle.
        row = dr.select(ground, half - 2 - j, half + j)
        g = dr.select(ground, 1.0 - g, g)
        a = (self.to_top(self.low, mu_s) - self._thickness) / self._span
        i, f = split(coordinate(dr.maximum(1.0 - a / self.A, 0.0) / (1.0 + a), s.mu_s), s.mu_s)
        k, e = split(coordinate(rho / self.H, s.r), s.r)
        base = (k * s.mu + row) * t.UInt(s.nu * s.mu_s) + i
        return base, f, g, e

    def scattering(self, table: Any, place: tuple[Any, ...], nu: Any, size: int, active: Any = True) -> list[Any]:
        """From a table [r, mu, nu, mu_s, size], at a ``place`` and nu: linear in all four."""
        s = self.sizes
        base, f, g, e = place
        n, c = split(coordinate(0.5 * nu + 0.5, s.nu), s.nu)
        corner = base + n * s.mu_s
        row, layer = s.nu * s.mu_s, s.mu * s.nu * s.mu_s
        total: list[Any] | None = None
        for dk, we in ((0, 1.0 - e), (layer, e)):
            for dj, wg in ((0, 1.0 - g), (row, g)):
                for dn, wc in ((0, 1.0 - c), (s.mu_s, c)):
                    for di, wf in ((0, 1.0 - f), (1, f)):
                        weight = we * wg * wc * wf
                        held = packet(table, corner + (dk + dj + dn + di), size, active)
                        if total is None:
                            total = [weight * v for v in held]
                        else:
                            total = [dr.fma(weight, v, w) for v, w in zip(held, total, strict=True)]
        return total


def bilinear(table: Any, i: Any, f: Any, j: Any, g: Any, columns: int, size: int, active: Any = True) -> list[Any]:
    """Linear in two dimensions, from a table [rows, columns, size]."""
    corner = j * columns + i
    a, b, c, d = (packet(table, corner + o, size, active) for o in (0, 1, columns, columns + 1))
    return [dr.lerp(dr.lerp(p, q, f), dr.lerp(u, v, f), g) for p, q, u, v in zip(a, b, c, d, strict=True)]
