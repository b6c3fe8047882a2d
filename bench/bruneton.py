"""Precomputed scattering by gathering over directions, as published: the twin of what users have today.

E. Bruneton, F. Neyret: Precomputed Atmospheric Scattering, 2008, algorithm 4.1; E. Bruneton: Precomputed Atmospheric
Scattering, a New Implementation, 2017. Written from their text: tables over (r, mu, mu_s, nu), trapezoids with 500
steps for transmittance and 50 along a ray, 16 x 32 directions for the source of an order, four orders. For comparison
only: its tables hold what the method makes of multiple scattering, while single scattering, transmittance and the sun
on the ground come from this package, the same for every method.

    tables = Tables("earth", Sizes())        # transmittance, single, multiple, irradiance
    sky = solve("size 0.5", "earth")         # radiance of views
"""

from __future__ import annotations

from collections.abc import Mapping as MappingOf
from typing import Any

import drjit as dr
import numpy as np

from atmo_jit.atmosphere import Atmosphere
from atmo_jit.backend import padded, stored, types
from atmo_jit.optics import MAX_CHANNELS, Optics

from .methods import number_in
from .shared_light import SharedLight
from .tables4d import Mapping, Sizes

ORDERS = 4
DEPTH_STEPS, RAY_STEPS = 500, 50


class Tables:
    """The tables of an atmosphere at up to four wavelengths.

    ``transmittance``, ``single[scatterer]`` (without its phase function), ``multiple`` (all orders >= 2),
    ``irradiance`` (of scattered light; as published it lacks the last order): buffers with ``size`` floats a texel.
    """

    def __init__(self, atmosphere: Any, sizes: Sizes, orders: int = ORDERS) -> None:
        air = Atmosphere.load(atmosphere)
        self.optics = optics = Optics(air, np.arange(min(len(air.wavelengths_nm), MAX_CHANNELS)))
        self.sizes, self.size = sizes, padded(optics.channel_count)
        self.map = Mapping(air.bottom_radius_m, air.top_radius_m, sizes)
        self.transmittance = self._transmittance()
        delta_irradiance = self._direct_irradiance()
        self.single = [self._store(values) for values in self._single()]
        self.irradiance = 0.0 * delta_irradiance
        self.multiple = dr.zeros(types().Float, sizes.texels * self.size)
        delta = None
        for _ in range(2, orders + 1):
            density = self._density(delta, delta_irradiance)
            delta_irradiance = self._indirect_irradiance(delta)
            delta = self._along_rays(density)
            self.irradiance = self.irradiance + delta_irradiance
            self.multiple = self.multiple + delta
            dr.eval(self.irradiance, self.multiple)
            del density
        dr.sync_thread()

    # --- what light meets ---

    def _scattering_coefficients(self, r: Any) -> list[list[Any]]:
        """1/m, [scatterer][channel]."""
        densities = self.optics.densities(dr.maximum(r - self.map.low, 0.0))
        return [[densities[k] * s for s in self.optics.scattering[k]] for k in self.optics.scatterers]

    def _through(self, r: Any, mu: Any, d: Any, ground: Any) -> list[Any]:
        """Transmittance over distance ``d``: a quotient of two entries of the table, of the rays that look up."""
        m = self.map
        r_d = dr.clip(dr.sqrt(dr.maximum(d * d + 2.0 * r * mu * d + r * r, 0.0)), m.low, m.top)
        mu_d = dr.clip((r * mu + d) / r_d, -1.0, 1.0)
        near = m.transmittance(self.transmittance, dr.select(ground, r_d, r), dr.select(ground, -mu_d, mu), self.size)
        far = m.transmittance(self.transmittance, dr.select(ground, r, r_d), dr.select(ground, -mu, mu_d), self.size)
        return [dr.minimum(a / dr.maximum(b, 1e-37), 1.0) for a, b in zip(near, far, strict=True)]

    def _to_sun(self, r: Any, mu_s: Any) -> list[Any]:
        """Transmittance to the sun times the visible part of its disc."""
        sine = self.map.low / r
        cosine = -dr.safe_sqrt(1.0 - sine * sine)
        half = dr.maximum(sine * self.optics.sun_radius, 1e-7)
        x = dr.clip(0.5 + 0.5 * (mu_s - cosine) / half, 0.0, 1.0)
        seen = x * x * (3.0 - 2.0 * x)
        return [seen * v for v in self.map.transmittance(self.transmittance, r, mu_s, self.size)]

    def _phases(self, nu: Any) -> list[list[Any]]:
        return [self.optics.phase_values(k, nu) for k in self.optics.scatterers]

    # --- the tables ---

    def _store(self, values: list[Any]) -> Any:
        return stored(values[: self.optics.channel_count], dr.arange(types().UInt, dr.width(values[0])), self.size)

    def _transmittance(self) -> Any:
        r, mu = self.map.transmittance_texels()
        step = self.map.to_top(r, mu) / DEPTH_STEPS

        def add(i: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
            d = types().Float(i) * step
            there = dr.sqrt(d * d + 2.0 * r * mu * d + r * r)
            weight = dr.select((i == 0) | (i == DEPTH_STEPS), 0.5, 1.0) * step
            densities = self.optics.densities(dr.maximum(there - self.map.low, 0.0))
            return i + 1, [dr.fma(weight, v, s) for v, s in zip(densities, sums, strict=True)]

        zeros = [dr.zeros(types().Float, dr.width(r)) for _ in self.optics.constituents]
        _, sums = dr.while_loop((types().UInt(0), zeros), lambda i, _: i <= DEPTH_STEPS, add, label="2017 depth")
        return self._store([dr.exp(-depth) for depth in self.optics.optical_depths(sums)])

    def _direct_irradiance(self) -> Any:
        r, mu_s = self.map.irradiance_texels()
        alpha = dr.maximum(self.optics.sun_radius, 1e-7)
        cosine = dr.select(mu_s > alpha, mu_s, (mu_s + alpha) ** 2 / (4.0 * alpha))
        cosine = dr.select(mu_s < -alpha, 0.0, cosine)
        through = self.map.transmittance(self.transmittance, r, mu_s, self.size)
        return self._store([e * v * cosine for e, v in zip(self.optics.solar, through, strict=False)])

    def _march(self, at: Any, count: int, label: str) -> list[Any]:
        """Trapezoid along the rays of all texels of ``at(d, r_d, mu_d, mu_s_d, texel)``: ``count`` values."""
        t, m = types(), self.map
        r, mu, mu_s, nu, ground = texel = m.scattering_texels()
        dr.eval(texel)
        step = dr.select(ground, m.to_ground(r, mu), m.to_top(r, mu)) / RAY_STEPS

        def add(i: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
            d = t.Float(i) * step
            there = dr.clip(dr.sqrt(dr.maximum(d * d + 2.0 * r * mu * d + r * r, 0.0)), m.low, m.top)
            mu_d = dr.clip((r * mu + d) / there, -1.0, 1.0)
            sun = dr.clip((r * mu_s + d * nu) / there, -1.0, 1.0)
            weight = dr.select((i == 0) | (i == RAY_STEPS), 0.5, 1.0) * step
            values = at(d, there, mu_d, sun, texel)
            return i + 1, [dr.fma(weight, v, s) for v, s in zip(values, sums, strict=True)]

        zeros = [dr.zeros(t.Float, dr.width(r)) for _ in range(count)]
        _, sums = dr.while_loop((t.UInt(0), zeros), lambda i, _: i <= RAY_STEPS, add, label=label)
        dr.eval(sums)
        return sums

    def _single(self) -> list[list[Any]]:
        """Single scattering without phase functions, [scatterer][channel]."""
        channels, kinds = self.optics.channel_count, len(self.optics.scatterers)

        def at(d: Any, there: Any, mu_d: Any, sun: Any, texel: Any) -> list[Any]:
            through = self._through(texel[0], texel[1], d, texel[4])
            lit = [a * b for a, b in zip(through, self._to_sun(there, sun), strict=True)]
            return [s * v for row in self._scattering_coefficients(there) for s, v in zip(row, lit, strict=False)]

        values = self._march(at, kinds * channels, "2017 single")
        solar = self.optics.solar * kinds
        lit = [v * e for v, e in zip(values, solar, strict=True)]
        return [lit[n * channels : (n + 1) * channels] for n in range(kinds)]

    def _radiance(self, delta: Any, place: tuple[Any, ...], nu: Any) -> list[Any]:
        """Radiance of the last order, per channel: ``delta``, or single scattering where that is None."""
        if delta is not None:
            return self.map.scattering(delta, place, nu, self.size)
        total = [0.0 * nu] * self.optics.channel_count
        for table, phase in zip(self.single, self._phases(nu), strict=True):
            held = self.map.scattering(table, place, nu, self.size)
            total = [dr.fma(p, v, w) for p, v, w in zip(phase, held, total, strict=False)]
        return total

    def _density(self, delta: Any, irradiance: Any) -> Any:
        """The source of the next order: light of the last one, from all directions and from the ground, scattered."""
        t, m, channels = types(), self.map, self.optics.channel_count
        steps = self.sizes.theta
        r, mu, mu_s, nu, _ = m.scattering_texels()
        dr.eval(r, mu, mu_s, nu)
        sine = dr.safe_sqrt(1.0 - mu * mu)
        sun_x = dr.select(sine == 0.0, 0.0, (nu - mu * mu_s) / dr.select(sine == 0.0, 1.0, sine))
        sun_y = dr.safe_sqrt(1.0 - sun_x * sun_x - mu_s * mu_s)
        delta_angle = float(np.pi / steps)
        coefficients = self._scattering_coefficients(r)

        def ring(j: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
            theta = (t.Float(j) + 0.5) * delta_angle
            sin_i, cos_i = dr.sincos(theta)
            meets = m.meets_ground(r, cos_i + 0.0 * r)
            distance = dr.select(meets, m.to_ground(r, cos_i), 0.0)
            through = self._through(r, cos_i + 0.0 * r, distance, meets)
            place = m.place(r, cos_i, mu_s, meets)
            solid_angle = delta_angle * delta_angle * sin_i

            def direction(i: Any, inner: list[Any]) -> tuple[Any, list[Any]]:
                sin_p, cos_p = dr.sincos((t.Float(i) + 0.5) * delta_angle)
                x, y = sin_i * cos_p, sin_i * sin_p
                nu_in = dr.clip(sun_x * x + sun_y * y + mu_s * cos_i, -1.0, 1.0)
                light = self._radiance(delta, place, nu_in)
                height = dr.sqrt(distance * distance + 2.0 * r * cos_i * distance + r * r)
                sun_there = (r * mu_s + distance * nu_in) / height
                on_ground = m.irradiance(irradiance, m.low + 0.0 * r, sun_there, self.size, meets)
                nu_out = sine * x + mu * cos_i
                phases = self._phases(nu_out)
                for c in range(channels):
                    glow = through[c] * self.optics.albedo[c] * dr.inv_pi * on_ground[c]
                    arriving = (light[c] + dr.select(meets, glow, 0.0)) * solid_angle
                    share = sum(row[c] * phase[c] for row, phase in zip(coefficients, phases, strict=True))
                    inner[c] = dr.fma(arriving, share, inner[c])
                return i + 1, inner

            _, sums = dr.while_loop((t.UInt(0), sums), lambda i, _: i < 2 * steps, direction, label="2017 directions")
            return j + 1, sums

        zeros = [dr.zeros(t.Float, dr.width(r)) for _ in range(channels)]
        _, sums = dr.while_loop((t.UInt(0), zeros), lambda j, _: j < steps, ring, label="2017 density")
        dr.eval(sums)
        return self._store(sums)

    def _indirect_irradiance(self, delta: Any) -> Any:
        """Irradiance by the sky of the last order."""
        t, m, channels = types(), self.map, self.optics.channel_count
        r, mu_s = m.irradiance_texels()
        dr.eval(r, mu_s)
        sin_s = dr.safe_sqrt(1.0 - mu_s * mu_s)
        steps = 2 * self.sizes.theta
        delta_angle = float(np.pi / steps)
        up = dr.zeros(t.Float, dr.width(r)) < 0.0

        def add(i: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
            sin_t, cos_t = dr.sincos((t.Float(i // (2 * steps)) + 0.5) * delta_angle)
            cos_p = dr.cos((t.Float(i % (2 * steps)) + 0.5) * delta_angle)
            nu = dr.clip(sin_s * sin_t * cos_p + mu_s * cos_t, -1.0, 1.0)
            light = self._radiance(delta, m.place(r, cos_t + 0.0 * r, mu_s, up), nu)
            weight = cos_t * sin_t * delta_angle * delta_angle
            return i + 1, [dr.fma(weight, light[c], sums[c]) for c in range(channels)]

        zeros = [dr.zeros(t.Float, dr.width(r)) for _ in range(channels)]
        count = steps // 2 * 2 * steps
        _, sums = dr.while_loop((t.UInt(0), zeros), lambda i, _: i < count, add, label="2017 irradiance")
        dr.eval(sums)
        return self._store(sums)

    def _along_rays(self, density: Any) -> Any:
        """The next order from its source, along every ray."""
        channels = self.optics.channel_count

        def at(d: Any, there: Any, mu_d: Any, sun: Any, texel: Any) -> list[Any]:
            r, mu, _, nu, ground = texel
            through = self._through(r, mu, d, ground)
            source = self.map.scattering(density, self.map.place(there, mu_d, sun, ground), nu, self.size)
            return [source[c] * through[c] for c in range(channels)]

        return self._store(self._march(at, channels, "2017 multiple"))

    # --- what a client reads ---

    def multiple_light(self, h: Any, mu: Any, mu_s: Any, nu: Any, ground: Any) -> list[Any]:
        """Radiance of all orders >= 2 that the table holds, per channel."""
        place = self.map.place(self.map.low + h, mu, mu_s, ground)
        return self.map.scattering(self.multiple, place, nu, self.size)[: self.optics.channel_count]

    def sky_on_ground(self, mu_s: Any) -> list[Any]:
        """Irradiance of the ground by the sky, per channel."""
        low = self.map.low + 0.0 * mu_s
        return self.map.irradiance(self.irradiance, low, mu_s, self.size)[: self.optics.channel_count]


class GatheredSky(SharedLight):
    """Radiance of views: this package's single scattering, the tables' multiple scattering."""

    def __init__(self, atmosphere: Any, sizes: Sizes) -> None:
        super().__init__(atmosphere)
        self.tables = Tables(self.atmosphere, sizes)

    def scattered(self, inside: MappingOf[str, Any]) -> list[Any]:
        """Radiance of orders >= 2 at the rays' entry, per channel."""
        return self.tables.multiple_light(*(inside[k] for k in ("h", "mu", "mu_s", "nu", "ground")))

    def sky_on_ground(self, mu_s: Any) -> list[Any]:
        """Irradiance of the ground by the sky, per channel."""
        return self.tables.sky_on_ground(mu_s)


def solve(setting: str, atmosphere: Any) -> GatheredSky:
    """The method at ``"size FACTOR"`` of the published sizes."""
    return GatheredSky(atmosphere, Sizes.times(number_in(setting, "size")))
