"""Isotropic multiple scattering by a geometric sum, as published: the twin of what game engines have today.

S. Hillaire: A Scalable and Production Ready Sky and Atmosphere Rendering Technique, 2020, section 5.5. At a point two
numbers are gathered over 64 directions with an isotropic phase function and 20 steps a ray: ``L_2nd``, the light of the
sun (and of sunlit ground) that arrives after one event, and ``f_ms``, what would arrive if all air around glowed with
radiance 1 (equations 5 to 8). All further orders are taken for a geometric sum, Psi_ms = L_2nd / (1 - f_ms) (9, 10),
kept in a table over sun and altitude. Along a view ray the source of orders >= 2 is scattering coefficient times
Psi_ms.

Written from the paper. The rest is this package's: exact single scattering and columns, and a fine march of Psi_ms
along the view, so that what is measured is the approximation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from atmo_jit.backend import floats, packet, padded, parameter, stored, types
from atmo_jit.column import SunColumns
from atmo_jit.geometry import altitude_along, distance_down, distance_up, hits_ground
from atmo_jit.march import visible_sun
from atmo_jit.optics import MAX_CHANNELS, Optics
from atmo_jit.quadrature import gauss_legendre, half_circle

from .methods import number_in
from .shared_light import SharedLight
from .tables4d import bilinear, coordinate, split

VIEW_STEPS = 256
GROUND_SUNS = 128


@dataclass(frozen=True)
class Sizes:
    """Table over (altitude, sun), directions along each side of the sphere's square, steps of a ray: as published."""

    altitudes: int = 32
    suns: int = 32
    directions: int = 8
    steps: int = 20

    @classmethod
    def times(cls, factor: float) -> Sizes:
        """The published sizes times ``factor``."""
        p = cls()
        return cls(*(max(2, round(factor * n)) for n in (p.altitudes, p.suns, p.directions, p.steps)))


class MultipleScattering:
    """The table Psi_ms [altitudes, suns, size] and its parts, of up to four wavelengths.

    ``second`` and ``transfer``: L_2nd and f_ms, lists of Floats [altitudes * suns] per channel.
    """

    def __init__(self, optics: Optics, columns: SunColumns, sizes: Sizes) -> None:
        t = types()
        self.optics, self.columns, self.sizes = optics, columns, sizes
        self.size = padded(optics.channel_count)
        lane = dr.arange(t.UInt, sizes.altitudes * sizes.suns)
        h = t.Float(lane // sizes.suns) / (sizes.altitudes - 1.0) * optics.thickness
        mu_s = 2.0 * t.Float(lane % sizes.suns) / (sizes.suns - 1.0) - 1.0
        dr.eval(h, mu_s)
        self.second, self.transfer = self.gathered(h, mu_s)
        # Rounding, and 20 steps, could bring f_ms to 1 in a conservative cloud.
        psi = [s / (1.0 - dr.minimum(f, 0.999)) for s, f in zip(self.second, self.transfer, strict=True)]
        self.table = stored(psi, lane, self.size)
        dr.sync_thread()

    def gathered(self, h: Any, mu_s: Any) -> tuple[list[Any], list[Any]]:
        """(L_2nd, f_ms) per channel at altitudes ``h`` (m) and sun cosines ``mu_s``: means over all directions."""
        t, optics, side = types(), self.optics, self.sizes.directions
        count, channels = side * side, optics.channel_count
        sin_s = dr.safe_sqrt(1.0 - mu_s * mu_s)
        zero = [dr.zeros(t.Float, dr.width(h)) for _ in range(channels)]

        def direction(i: Any, second: list[Any], transfer: list[Any]) -> tuple[Any, ...]:
            mu = 1.0 - 2.0 * (t.Float(i // side) + 0.5) / side + 0.0 * h
            phi = (t.Float(i % side) + 0.5) * (2.0 * np.pi / side)
            nu = dr.clip(mu * mu_s + dr.safe_sqrt(1.0 - mu * mu) * sin_s * dr.cos(phi), -1.0, 1.0)
            light, glow = self._along(h, mu, mu_s, nu)
            second = [dr.fma(a, 1.0 / count, s) for a, s in zip(light, second, strict=True)]
            transfer = [dr.fma(a, 1.0 / count, s) for a, s in zip(glow, transfer, strict=True)]
            return i + 1, second, transfer

        state = (t.UInt(0), list(zero), list(zero))
        _, second, transfer = dr.while_loop(state, lambda i, *_: i < count, direction, label="2020 directions")
        dr.eval(second, transfer)
        return second, transfer

    def _along(self, h: Any, mu: Any, mu_s: Any, nu: Any) -> tuple[list[Any], list[Any]]:
        """(light of the sun scattered isotropically once or reflected, light of a medium that glows) along rays."""
        t, optics, steps = types(), self.optics, self.sizes.steps
        channels = range(optics.channel_count)
        ground = hits_ground(optics.radius, h, mu)
        end = dr.select(
            ground,
            distance_down(optics.radius, h, mu, 0.0),
            distance_up(optics.radius, h, mu, optics.thickness),
        )
        step = end / steps

        def march(i: Any, through: list[Any], light: list[Any], glow: list[Any]) -> tuple[Any, ...]:
            d = (t.Float(i) + 0.5) * step
            there, r = altitude_along(optics.radius, h, mu, d)
            sun = dr.clip(((optics.radius + h) * mu_s + d * nu) / r, -1.0, 1.0)
            lit = self.sunlight(there, r, sun)
            density = optics.densities(there)
            for c in channels:
                scattering = sum((optics.scattering[k][c] * density[k] for k in optics.scatterers), start=0.0 * d)
                extinction = sum((optics.extinction[k][c] * density[k] for k in range(len(density))), start=0.0 * d)
                # Constant over a step: its integral is exact (section 5.5, energy conserving); in thin air by its
                # series, which does not cancel.
                depth = extinction * step
                passed = dr.exp(-depth)
                thin = depth < 0.01
                series = 1.0 - depth * (0.5 - depth * (1.0 / 6.0))
                held = step * dr.select(thin, series, (1.0 - passed) / dr.select(thin, 1.0, depth))
                share = through[c] * held * scattering
                glow[c] = glow[c] + share
                light[c] = dr.fma(share * lit[c], 0.25 * dr.inv_pi, light[c])
                through[c] = through[c] * passed
            return i + 1, through, light, glow

        width = dr.width(h)
        ones = [dr.full(t.Float, 1.0, width) for _ in channels]
        zeros = [[dr.zeros(t.Float, width) for _ in channels] for _ in range(2)]
        _, through, light, glow = dr.while_loop(
            (t.UInt(0), ones, *zeros), lambda i, *_: i < steps, march, label="2020 march"
        )
        sun = dr.clip(((optics.radius + h) * mu_s + end * nu) / optics.radius, -1.0, 1.0)
        on_ground = self.sunlight(0.0 * h, optics.radius + 0.0 * h, sun)
        for c in channels:
            lit = optics.albedo[c] * dr.inv_pi * dr.maximum(sun, 0.0) * on_ground[c]
            light[c] = dr.fma(through[c], dr.select(ground, lit, 0.0), light[c])
        return light, glow

    def sunlight(self, h: Any, r: Any, mu_s: Any) -> list[Any]:
        """Irradiance of the sun across its beam, per channel."""
        optics = self.optics
        seen = visible_sun(optics, h, r, mu_s)
        depths = optics.optical_depths(self.columns.toward(h, mu_s))
        return [e * seen * dr.exp(-d) for e, d in zip(optics.solar, depths, strict=True)]

    def at(self, h: Any, mu_s: Any) -> list[Any]:
        """Psi_ms per channel, linear in the table."""
        s = self.sizes
        i, f = split(coordinate(0.5 * mu_s + 0.5, s.suns), s.suns)
        j, g = split(coordinate(h / self.optics.thickness, s.altitudes), s.altitudes)
        return bilinear(self.table, i, f, j, g, s.suns, self.size)[: self.optics.channel_count]

    def along_view(self, h: Any, mu: Any, mu_s: Any, nu: Any, ground: Any) -> list[Any]:
        """Radiance of orders >= 2 along views, per channel: midpoints of VIEW_STEPS steps, short ones at both ends."""
        t, optics = types(), self.optics
        channels = range(optics.channel_count)
        end = dr.select(
            ground,
            distance_down(optics.radius, h, mu, 0.0),
            distance_up(optics.radius, h, mu, optics.thickness),
        )
        dr.make_opaque(h, mu, mu_s, nu, end)

        def edge(i: Any) -> Any:
            x = t.Float(i) * (1.0 / VIEW_STEPS)
            return end * x * x * (3.0 - 2.0 * x)

        def march(i: Any, depth: list[Any], total: list[Any]) -> tuple[Any, ...]:
            step = edge(i + 1) - edge(i)
            d = edge(i) + 0.5 * step
            there, r = altitude_along(optics.radius, h, mu, d)
            sun = dr.clip(((optics.radius + h) * mu_s + d * nu) / r, -1.0, 1.0)
            density, psi = optics.densities(there), self.at(there, sun)
            for c in channels:
                scattering = sum((optics.scattering[k][c] * density[k] for k in optics.scatterers), start=0.0 * d)
                extinction = sum((optics.extinction[k][c] * density[k] for k in range(len(density))), start=0.0 * d)
                own = extinction * step
                total[c] = dr.fma(scattering * psi[c] * step, dr.exp(-(depth[c] + 0.5 * own)), total[c])
                depth[c] = depth[c] + own
            return i + 1, depth, total

        width = dr.width(h)
        zeros = [[dr.zeros(t.Float, width) for _ in channels] for _ in range(2)]
        state = (t.UInt(0), *zeros)
        _, _, total = dr.while_loop(state, lambda i, *_: i < VIEW_STEPS, march, label="2020 view")
        dr.eval(total)
        return total


class GeometricSky(SharedLight):
    """Radiance of views: this package's single scattering, Psi_ms for the rest."""

    def __init__(self, atmosphere: Any, sizes: Sizes) -> None:
        super().__init__(atmosphere)
        air = self.atmosphere
        self.optics = Optics(air, np.arange(min(len(air.wavelengths_nm), MAX_CHANNELS)))
        self.multiple = MultipleScattering(self.optics, SunColumns(self.optics), sizes)
        self._on_ground = self._ground_table()
        dr.sync_thread()

    def scattered(self, inside: Mapping[str, Any]) -> list[Any]:
        """Radiance of orders >= 2 at the rays' entry, per channel."""
        return self.multiple.along_view(*(inside[k] for k in ("h", "mu", "mu_s", "nu", "ground")))

    def _ground_table(self) -> Any:
        """Irradiance of the ground by orders >= 2 over mu_s, [GROUND_SUNS, size]."""
        x, w = gauss_legendre(8)
        azimuths = half_circle(4)
        mu, phi, mu_s = np.meshgrid(x, azimuths, np.linspace(-1.0, 1.0, GROUND_SUNS), indexing="ij")
        nu = mu * mu_s + np.sqrt((1 - mu**2) * (1 - mu_s**2)) * np.cos(phi)
        h, mu, mu_s, nu = (floats(v) for v in (0.0 * mu, mu, mu_s, nu))
        light = self.multiple.along_view(h, mu, mu_s, nu, h > 1.0)
        weight = (2.0 * np.pi * w * x / len(azimuths))[:, None, None]
        sums = [floats((weight * v.numpy().reshape(len(x), len(azimuths), -1)).sum(axis=(0, 1))) for v in light]
        return stored(sums, dr.arange(types().UInt, GROUND_SUNS), self.multiple.size)

    def sky_on_ground(self, mu_s: Any) -> list[Any]:
        """Irradiance of the ground by the sky, per channel: order 1 exact, the rest from Psi_ms."""
        _, once = self.once.irradiance(parameter(0.0) + 0.0 * mu_s, dr.acos(mu_s))
        i, f = split(coordinate(0.5 * mu_s + 0.5, GROUND_SUNS), GROUND_SUNS)
        low, high = (packet(self._on_ground, i + n, self.multiple.size) for n in (0, 1))
        return [a + dr.lerp(b, c, f) for a, b, c in zip(once, low, high, strict=False)]


def solve(setting: str, atmosphere: Any) -> GeometricSky:
    """The method at ``"size FACTOR"`` of the published sizes."""
    return GeometricSky(atmosphere, Sizes.times(number_in(setting, "size")))
