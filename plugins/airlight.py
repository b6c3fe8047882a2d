"""Light that the air sends along a ray of the scene, what it takes of the light behind, and the planet's ground: from
the solved atmosphere, for the integrator ``atmosphere_path``.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from atmo_jit.bake.source import SourceTable
from atmo_jit.geometry import altitude_along, hits_ground
from atmo_jit.march import Rays, Shells, march, point_along, rays_to_boundary, visible_sun
from atmo_jit.quadrature import gauss_legendre
from atmo_jit.resolution import moments_of
from atmo_jit.single_scattering import disc_cosine
from atmo_jit.solved import Sky

from .exposed import number
from .globe import Globe

NODES = 2  # of each piece of a ray; `python -m bench.airlight` has what that costs beside the four of Sky.rays
STEP = 0.6180339887498949  # of random numbers from point to point of a ray: the golden ratio's
QUADRATURE = gauss_legendre(4)
FIRST_PARTS = 4  # of the way to where shadows may begin
FULL_DEPTH = 0.25  # optical depth from which a stretch gets all of its points
LEAST_EXTINCTION = 1e-9  # 1/m: thinner air makes points even in distance


@dataclass
class Stretch:
    """A ray's way through the air; lists have one entry for each of the atmosphere's W wavelengths.

    ``light`` scattered by the air (radiance, nothing in the sun's way) and ``transmittance`` of all of it; ``ground``:
    it ends on the planet's ground, ``distance`` (scene units) where. ``rays``: in metres, from where the ray enters the
    air, after ``gap``.
    """

    light: list[Any]
    transmittance: list[Any]
    ground: Any
    distance: Any
    rays: Rays
    gap: Any


class Airlight:
    """The air of a solved ``sky`` around ``globe``, lit by a sun in the direction ``sun`` (unit vector, scene)."""

    def __init__(self, sky: Sky, globe: Globe, sun: np.ndarray) -> None:
        self.globe = globe
        self._take(sky)
        self._shells = [Shells(band.optics) for band in self.bands]
        for shells in self._shells:
            shells.rule(NODES)
        # These say where shadows are looked for.
        self.guide = self.bands[0].optics
        self.asymmetry = asymmetry(self.bands[0])
        self.count = len(sky.atmosphere.wavelengths_nm)
        ground = [band.optics.largest_extinction(band.optics.densities(mi.Float(0.0))) for band in self.bands]
        self.densest = float(max(np.array(v).max(initial=0.0) for v in ground))  # 1/m, at the ground
        self.sun = mi.Vector3f(*(float(v) for v in sun))
        dr.make_opaque(self.sun)

    def _take(self, sky: Sky) -> None:
        self.sky, self.bands = sky, sky.bands
        self.sources = [band.source and SourceTable(band.field) for band in self.bands]

    def moved(self, sky: Sky) -> Airlight:
        """The light of another sky, at the points and by the pieces of rays that serve this one."""
        other = copy(self)
        other._take(sky)
        return other

    @property
    def solar(self) -> list[Any]:
        """Solar irradiance (W)."""
        return [e for band in self.bands for e in band.optics.solar]

    def along(self, ray: Any, length: Any) -> Stretch:
        """The air between a ray's origin and ``length`` (scene units, inf: to the end)."""
        scale = self.globe.scale
        optics = self.bands[0].optics
        top, radius = optics.thickness, optics.radius
        h, mu, mu_s, nu = self.globe.cosines(ray.o, ray.d, self.sun)
        outside = h > top
        r = radius + h
        # From outside the ray starts where it enters: the nearer root of d^2 + 2 r mu d + excess = 0.
        excess = dr.select(outside, (h - top) * (2.0 * radius + h + top), 0.0)
        square = dr.fma(r * mu, r * mu, -excess)
        meets = ~outside | ((mu < 0.0) & (square > 0.0))
        gap = dr.select(outside & meets, excess / (dr.safe_sqrt(square) - r * mu), 0.0)
        r_in = dr.select(outside, radius + top, r)
        mu, mu_s = (
            dr.select(outside, dr.clip(v, -1.0, 1.0), v)
            for v in (dr.fma(r, mu, gap) / r_in, dr.fma(r, mu_s, gap * nu) / r_in)
        )
        rays = rays_to_boundary(optics, dr.minimum(h, top), mu, mu_s, nu)
        left = dr.maximum(length * (1.0 / scale) - gap, 0.0)
        rays.ground &= meets & (left >= rays.stop)
        rays.stop = dr.select(meets, dr.minimum(rays.stop, left), 0.0)
        found = Stretch([], [], rays.ground, (gap + rays.stop) * scale, rays, gap)
        for band, source, shells in zip(self.bands, self.sources, self._shells, strict=True):
            light = march(band.optics, band.columns, rays, nodes=NODES, source=source, shells=shells)
            found.light += [a + b for a, b in zip(light.single, light.multiple, strict=True)]
            found.transmittance += light.transmittance
        return found

    def on_ground(self, p: Any, lit: Any) -> list[Any]:
        """Radiance (W) of the planet's ground at a point; ``lit``: the part of sunlight that nothing keeps away."""
        zero = dr.zeros(mi.Float, dr.width(p))
        _, mu_s, _, _ = self.globe.cosines(p, self.sun, self.sun)
        found = []
        for band in self.bands:
            sky = band.field.irradiance(zero, mu_s, reflected=True)
            sun = self.sunlit(band, zero, mu_s, disc_cosine(mu_s, band.optics.sun_radius) * lit)
            found += [a * dr.inv_pi * (d + s) for a, d, s in zip(band.optics.albedo, sun, sky, strict=True)]
        return found

    def sunlight(self, p: Any, d: Any) -> list[Any]:
        """Irradiance (W) across the direction ``d`` of a sun of which that one point shines; 0 where the planet is in
        its way."""
        optics = self.bands[0].optics
        h, mu, _, _ = self.globe.cosines(p, d, self.sun)
        # Beyond the top a ray that enters the air again has its whole column: from the top, twice to the perigee.
        r_in = optics.radius + dr.minimum(h, optics.thickness)
        sine = (optics.radius + h) / r_in * dr.safe_sqrt((1.0 - mu) * (1.0 + mu))
        inside = (h <= optics.thickness) | ((mu < 0.0) & (sine < 1.0))
        at_top = -dr.safe_sqrt((1.0 - sine) * (1.0 + sine))
        mu = dr.select(h > optics.thickness, dr.select(inside, at_top, 1.0), mu)
        h = dr.minimum(h, optics.thickness)
        seen = dr.select(hits_ground(optics.radius, h, mu) & inside, 0.0, 1.0)
        found = []
        for band in self.bands:
            found += self.sunlit(band, h, mu, seen)
        return found

    def sunlit(self, band: Any, h: Any, mu: Any, factor: Any) -> list[Any]:
        optics = band.optics
        depths = optics.optical_depths(band.columns.toward(h, mu)) if optics.constituents else [0.0] * len(optics.solar)
        return [e * factor * dr.exp(-depth) for e, depth in zip(optics.solar, depths, strict=True)]

    def shade(
        self, part: Stretch, start: Any, end: Any, sample: Any, most: int, lit: Callable[[Any], Any]
    ) -> list[Any]:
        """Light of order 1 (radiance, W) that is missing from a stretch because shapes keep the sun from it.

        They can do so only between the distances ``start`` and ``end`` (scene units). There up to ``most`` points are
        drawn, fewer where little is scattered: one from each of as many parts of equal weight exp(-distance x
        extinction at the start), by the random number ``sample``. ``lit`` says whether the sun is seen (1 or 0) from a
        distance along the ray."""
        rays, scale = part.rays, self.globe.scale
        optics = self.bands[0].optics
        first = dr.clip(start * (1.0 / scale) - part.gap, 0.0, rays.stop)
        length = dr.clip(end * (1.0 / scale) - part.gap, 0.0, rays.stop) - first
        before = [0.0 for _ in optics.constituents]
        amounts = self.columns(rays, dr.zeros(mi.Float, dr.width(first)), first, before, FIRST_PARTS)
        h, _, _ = point_along(optics, rays, first)
        rate = dr.maximum(self.guide.largest_extinction(self.guide.densities(h)), LEAST_EXTINCTION)
        rest = dr.exp(-rate * length)
        count = dr.clip(dr.ceil(most * (1.0 - rest) / FULL_DEPTH), 1.0, float(most))
        count = dr.select(length > 0.0, count, 0.0)
        phases = [{k: band.optics.phase_values(k, rays.nu) for k in band.optics.scatterers} for band in self.bands]

        def part_of(i: Any, d: Any, amounts: list[Any], sums: list[Any]) -> tuple[Any, ...]:
            jitter = sample + i * STEP
            s = (i + (jitter - dr.floor(jitter))) / count
            left = dr.fma(s, rest - 1.0, 1.0)
            there = dr.minimum(first - dr.log(left) / rate, first + length)
            amounts = self.columns(rays, d, there, amounts, 1)
            h, r, mu_s = point_along(optics, rays, there)
            dark = (1.0 - lit((part.gap + there) * scale)) * (1.0 - rest) / (rate * left * count)
            shining = dark * visible_sun(optics, h, r, mu_s)
            new = []
            for band, values in zip(self.bands, phases, strict=True):
                o = band.optics
                here, seen = o.densities(h), o.optical_depths(amounts)
                for c, light in enumerate(self.sunlit(band, h, mu_s, shining)):
                    scattering = sum(o.scattering[k][c] * here[k] * values[k][c] for k in o.scatterers)
                    new.append(scattering * light * dr.exp(-seen[c]))
            return i + 1.0, there, amounts, [a + b for a, b in zip(sums, new, strict=True)]

        zero = dr.zeros(mi.Float, dr.width(first))
        state = (zero + 0.0, first + 0.0, amounts, [zero + 0.0 for _ in range(self.count)])
        *_, sums = dr.while_loop(state, lambda i, *_: i < count, part_of, label="shafts")
        return sums

    def columns(self, rays: Rays, start: Any, end: Any, amounts: list[Any], parts: int) -> list[Any]:
        """Column densities (m) of all constituents up to ``end``, given those up to ``start``."""
        optics = self.bands[0].optics
        length = (end - start) * (1.0 / parts)

        def part(i: Any, amounts: list[Any]) -> tuple[Any, list[Any]]:
            for x, w in zip(*QUADRATURE, strict=True):
                h, _ = altitude_along(optics.radius, rays.h, rays.mu, dr.fma(length, i + float(x), start))
                amounts = [dr.fma(length * float(w), v, a) for v, a in zip(optics.densities(h), amounts, strict=True)]
            return i + 1.0, amounts

        if parts == 1:
            return part(0.0, amounts)[1]
        zero = dr.zeros(mi.Float, dr.width(length))
        state = zero + 0.0, [zero + amount for amount in amounts]
        # A loop: written out, these nodes were a good part of what a picture's kernel compiles.
        return dr.while_loop(state, lambda i, _: i < float(parts), part, label="columns")[1]


def asymmetry(band: Any) -> Any:
    """Of the phase function of Henyey and Greenstein whose second moment, g^2, is that of all scattering at the
    ground."""
    optics, whole, second = band.optics, 0.0, 0.0
    density = optics.densities(mi.Float(0.0))
    for k in optics.scatterers:
        phase = optics.constituents[k].phase
        for c, i in enumerate(optics.indices):
            amount = float(np.array(optics.scattering[k][c] * density[k]).ravel()[0])
            whole, second = whole + amount, second + amount * float(moments_of(phase.at(int(i)), 2)[2])
    return number(max(second / whole, 0.0) ** 0.5 if whole > 0.0 else 0.0)
