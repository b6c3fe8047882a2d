"""Many suns along shared view rays: what all tables are filled with.

A table asks for the same view rays again and again, under other suns. What a ray scatters toward its origin, density
times transmittance at the nodes of a quadrature, has no sun in it: :class:`Sightlines` computes it once, in double
precision, and :meth:`Sightlines.single` and :meth:`Sightlines.multiple` then sum sunlight and the solved field over
those nodes for any number of suns. Single scattering comes per constituent and without its phase function, which
varies too fast to be interpolated.

Two approximations set this apart from the march of ``Sky.rays``. Direct sunlight at a node is interpolated in a table
over altitude and sun cosine. Pieces are not cut at the planet's shadow; instead the sun's visible part is averaged
over the stretch that a node stands for. ``python -m bench.tables`` prints what both cost.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from ..backend import floats, packet, padded, types, uints
from ..march import relative_azimuth
from ..optics import Optics
from ..quadrature import gauss_legendre, running_integral
from ..single_scattering import horizontal_irradiance
from .sunlight import Sunlight

NODES = 3  # Gauss-Legendre nodes per piece
MAX_DEPTH = 1.0  # optical depth of a piece
SPENT_DEPTH = 16.0  # what lies behind 1e-7 of transmittance is not seen
LONGEST = 32  # pieces into which one shell is cut at most


class Sightlines:
    """View rays of one band, from altitude ``h`` (m, also above the air) at zenith cosine ``mu``, between the
    distances ``start`` and ``stop`` (m; by default from the observer to the ground or out of the air).

    ``ground``: which rays end on the ground, where rounding must not decide it (the horizon itself) or where rays are
    to go on through it, in air as it is on the ground. ``stretches``: the field of later orders is asked once in about
    so many parts of a ray (0: in every piece). All arrays are float64 [R].

    Attributes: ``start``, ``stop`` [R]; ``ground`` [R]: the ray ends there; ``transmittance`` [R, C]; ``scattering``
    [R, K, C]: integral of scattering coefficient times transmittance along the ray, for every scatterer.
    """

    def __init__(
        self,
        optics: Optics,
        h: np.ndarray,
        mu: np.ndarray,
        start: np.ndarray | None = None,
        stop: np.ndarray | None = None,
        ground: np.ndarray | bool | None = None,
        stretches: int = 0,
        nodes: int = NODES,
    ) -> None:
        self.optics, self.mu, self._parts = optics, mu, stretches
        radius, top = optics.atmosphere.bottom_radius_m, optics.atmosphere.top_radius_m
        r = radius + h
        self.r = r
        # Altitude first, as in geometry.py: b is the ray's least distance from the centre, on its whole line.
        sine = np.sqrt((1.0 - mu) * (1.0 + mu))
        middle = -r * mu  # distance to the perigee
        levels = optics.breaks_m
        lowest = h - r * mu * mu / (1.0 + sine)
        half = np.sqrt(np.maximum((levels - lowest[:, None]) * (2.0 * radius + levels + lowest[:, None]), 0.0))
        meets = half[:, -1] > 0.0
        hits = (mu < 0.0) & (lowest < 0.0) if ground is None else np.broadcast_to(ground, mu.shape)
        end = np.where(hits, np.maximum(middle - half[:, 0], 0.0), middle + half[:, -1])
        begin = np.maximum(middle - half[:, -1], 0.0) if np.any(r > top) else np.zeros_like(h)
        end = np.where(meets & (end > begin), end, begin)
        self.start = begin if start is None else np.clip(start, begin, end)
        self.stop = end if stop is None else np.clip(stop, self.start, end)
        self.ground = hits & (self.stop >= end) & (end >= begin)
        # Shells passed on the way down, from the top on; what lies below the ground, where a ray is told to go on
        # through it; the shells on the way up.
        bounds = np.concatenate([middle[:, None] - half[:, ::-1], middle[:, None] + half], axis=1)
        near, far = bounds[:, :-1], bounds[:, 1:]
        near, far = (np.clip(d, self.start[:, None], self.stop[:, None]) for d in (near, far))
        ray, shell = np.nonzero(far > near)
        self._cut(sine, ray, near[ray, shell], far[ray, shell], nodes)

    def _cut(self, sine: np.ndarray, ray: np.ndarray, near: np.ndarray, far: np.ndarray, nodes: int) -> None:
        """Pieces thin enough for the quadrature; columns from the start of each ray; weights at the nodes."""
        optics = self.optics
        scattering, extinction = _coefficients(optics)
        few_x, few_w = gauss_legendre(4)
        density = self._densities(ray, near + (far - near) * few_x[:, None])  # [constituent, node, piece]
        column = np.einsum("g,kgp->kp", few_w, density) * (far - near)
        depth = (extinction.T @ column).max(axis=0, initial=0.0)
        parts = np.clip(np.ceil(depth / MAX_DEPTH), 1, LONGEST).astype(int)
        which = np.repeat(np.arange(len(ray)), parts)
        place = np.arange(len(which)) - np.repeat(np.cumsum(parts) - parts, parts)
        step = (far - near)[which] / parts[which]
        ray, near = ray[which], near[which] + place * step

        density = self._densities(ray, near + step * few_x[:, None])
        column = np.einsum("g,kgp->kp", few_w, density) * step
        before = np.cumsum(column, axis=1) - column
        first = np.searchsorted(ray, np.arange(len(self.mu)))
        from_start = before - before[:, np.minimum(first, len(ray) - 1)][:, ray] if len(ray) else before
        total = np.zeros((len(column), len(self.mu)))
        np.add.at(total.T, ray, column.T)
        self.transmittance = np.exp(-(extinction.T @ total)).T
        seen = (extinction.T @ from_start).min(axis=0, initial=np.inf) < SPENT_DEPTH
        ray, near, step = ray[seen], near[seen], step[seen]
        from_start, density = from_start[:, seen], density[..., seen]
        x, w = gauss_legendre(nodes)
        inner = from_start[:, None] + np.einsum("gf,kfp->kgp", running_integral(4, tuple(x)), density) * step
        distance = near + step * x[:, None]
        here = self._densities(ray, distance)
        through = np.exp(-np.einsum("kc,kgp->gpc", extinction, inner)) * (w[:, None] * step)[..., None]
        weight = np.einsum("kc,kgp,gpc->pgkc", scattering, here[optics.scatterers], through)
        self.scattering = np.zeros((len(self.mu), *weight.shape[2:]))
        np.add.at(self.scattering, ray, weight.sum(axis=1))
        self._gather_stretches(sine, ray, distance.T, weight)
        self._nodes = self._table(sine, np.repeat(ray, nodes), distance.T.ravel(), np.repeat(0.5 * step / nodes, nodes))
        self._weights = _padded_channels(weight.reshape(len(ray) * nodes, *weight.shape[2:]))
        self._first_node = uints(np.searchsorted(ray, np.arange(len(self.mu) + 1)) * nodes)
        end = self._altitude(np.arange(len(self.mu)), self.stop)[1]
        self._ends = floats(
            np.column_stack([(self.r + self.stop * self.mu) / end, self.stop * sine / end, sine, self.mu])
        )
        through = np.where(self.ground[:, None], self.transmittance, 0.0)
        self._through = floats(np.pad(through, ((0, 0), (0, padded(optics.channel_count) - optics.channel_count))))

    def _gather_stretches(self, sine: np.ndarray, ray: np.ndarray, distance: np.ndarray, weight: np.ndarray) -> None:
        """Neighbouring pieces as stretches with about equal shares of what the ray scatters, and the centroid of each.

        ``distance`` [piece, node], ``weight`` [piece, node, scatterer, channel].
        """
        channels = np.maximum(self.scattering.sum(axis=1), 1e-300)
        share = (weight.sum(axis=2) / channels[ray][:, None]).mean(axis=2)
        by_piece = share.sum(axis=1)
        sums = np.cumsum(by_piece) - 0.5 * by_piece
        start = (np.cumsum(by_piece) - by_piece)[np.searchsorted(ray, ray)]
        part = np.clip((sums - start) * self._parts, 0, max(self._parts - 1, 0)).astype(int)
        rising = distance[:, 0] >= -(self.r * self.mu)[ray]
        key = (ray * (self._parts + 1) + part) * 2 + rising if self._parts else np.arange(len(ray))
        first = np.flatnonzero(np.diff(key, prepend=-1))
        total, moment = (np.add.reduceat(v, first) for v in (by_piece, (share * distance).sum(axis=1)))
        ray = ray[first]
        lit = total > 0.0
        centre = np.where(lit, moment / np.where(lit, total, 1.0), distance[first, 0])
        self._stretches = self._table(sine, ray, centre, np.zeros(len(first)))
        self._stretch_weights = _padded_channels(np.add.reduceat(weight.sum(axis=1), first))
        self._first_stretch = uints(np.searchsorted(ray, np.arange(len(self.mu) + 1)))

    def _altitude(self, ray: np.ndarray, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Altitude and radius (m) of points on rays, [..., len(ray)]."""
        r, mu = self.r[ray], self.mu[ray]
        there = np.sqrt(np.maximum(r * r + distance * (2.0 * r * mu + distance), 0.0))
        return np.maximum(there - self.optics.atmosphere.bottom_radius_m, 0.0), there

    def _densities(self, ray: np.ndarray, distance: np.ndarray) -> np.ndarray:
        h, constituents = self._altitude(ray, distance)[0], self.optics.constituents
        return np.array([np.asarray(c.profile.density(h)) for c in constituents]).reshape(len(constituents), *h.shape)

    def _table(self, sine: np.ndarray, ray: np.ndarray, distance: np.ndarray, half: np.ndarray) -> Any:
        """Per point: square root of altitude over thickness, horizon cosine, 1 / (1 - horizon), cosine and sine of the
        turn about the planet's centre, the ray's zenith cosine there, half the stretch over r, half the disc's height
        in cosines."""
        atmosphere = self.optics.atmosphere
        h, r = self._altitude(ray, distance)
        horizon = -np.sqrt(h * (2.0 * atmosphere.bottom_radius_m + h)) / r
        disc = np.maximum(np.deg2rad(atmosphere.sun_angular_radius_deg) * atmosphere.bottom_radius_m / r, 1e-7)
        return floats(
            np.column_stack(
                [
                    np.sqrt(np.clip(h / atmosphere.thickness_m, 0.0, 1.0)),
                    horizon,
                    1.0 / (1.0 - horizon),
                    (self.r[ray] + distance * self.mu[ray]) / r,
                    distance * sine[ray] / r,
                    np.clip((self.r[ray] * self.mu[ray] + distance) / r, -1.0, 1.0),
                    half / r,
                    disc,
                ]
            )
        )

    def nu(self, ray: Any, mu_s: Any, across: Any) -> Any:
        """Cosine of the angle between the rays ``ray`` (UInt indices) and suns at zenith cosine ``mu_s``, evaluated.

        ``across`` = sin(sun zenith) cos(azimuth of the view from the sun), here and below.
        """
        _, _, sine, mu = packet(self._ends, ray, 4)
        nu = dr.clip(dr.fma(mu, mu_s, sine * across), -1.0, 1.0)
        dr.eval(ray, mu_s, across, nu)
        return nu

    def single(self, sunlight: Sunlight, ray: Any, mu_s: Any, across: Any, nu: Any) -> list[list[Any]]:
        """Single scattering without phase functions, [scatterer][channel], evaluated."""
        t = types()
        kinds, channels, size = len(self.optics.scatterers), self.optics.channel_count, sunlight.size
        solar = self.optics.solar

        def node(i: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
            root, horizon, scale, cos_turn, sin_turn, mu, half, disc = packet(self._nodes, i, 8)
            there = dr.fma(cos_turn, mu_s, sin_turn * across)
            above = there - horizon
            width = dr.maximum(disc, dr.abs(dr.fma(-there, mu, nu)) * half)
            x = dr.clip(dr.fma(0.5, above / width, 0.5), 0.0, 1.0)
            seen = x * x * dr.fma(-2.0, x, 3.0)
            light = sunlight.at(root, dr.sqrt(dr.maximum(above * scale, 0.0)))
            weight = packet(self._weights, i, kinds * size)
            for n in range(kinds):
                for c in range(channels):
                    sums[n * channels + c] = dr.fma(weight[n * size + c] * seen, light[c], sums[n * channels + c])
            return i + 1, sums

        sums = [dr.zeros(t.Float, dr.width(ray)) for _ in range(kinds * channels)]
        if kinds:
            start, end = (dr.gather(t.UInt, self._first_node, ray + o) for o in (0, 1))
            _, sums = dr.while_loop((start, sums), lambda i, _: i < end, node, label="sightlines: single")
        single = [[sums[n * channels + c] * solar[c] for c in range(channels)] for n in range(kinds)]
        dr.eval(single)
        return single

    def multiple(self, source: Any, ray: Any, mu_s: Any, across: Any, nu: Any) -> list[list[Any]]:
        """Radiance of all orders after the first by the scatterer that sent it here, [scatterer][channel], evaluated:
        the field, asked once per stretch."""
        t = types()
        kinds, channels = len(self.optics.scatterers), self.optics.channel_count
        size = padded(channels)
        thickness = self.optics.thickness

        def stretch(i: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
            root, _, _, cos_turn, sin_turn, mu, _, _ = packet(self._stretches, i, 8)
            there = dr.clip(dr.fma(cos_turn, mu_s, sin_turn * across), -1.0, 1.0)
            toward = source.scattered(root * root * thickness, there, mu, relative_azimuth(mu, there, nu), True)
            weight = packet(self._stretch_weights, i, kinds * size)
            for n in range(kinds):
                for c in range(channels):
                    sums[n * channels + c] = dr.fma(weight[n * size + c], toward[n][c], sums[n * channels + c])
            return i + 1, sums

        sums = [dr.zeros(t.Float, dr.width(ray)) for _ in range(kinds * channels)]
        start, end = (dr.gather(t.UInt, self._first_stretch, ray + o) for o in (0, 1))
        _, sums = dr.while_loop((start, sums), lambda i, _: i < end, stretch, label="sightlines: multiple")
        dr.eval(sums)
        return [sums[n * channels : (n + 1) * channels] for n in range(kinds)]

    def ground_light(self, band: Any, ray: Any, mu_s: Any, across: Any) -> list[Any]:
        """The ground's own radiance seen through the air, per channel, evaluated; 0 on rays that do not end there."""
        cos_turn, sin_turn, _, _ = packet(self._ends, ray, 4)
        there = dr.clip(dr.fma(cos_turn, mu_s, sin_turn * across), -1.0, 1.0)
        h = dr.zeros(types().Float, dr.width(ray))
        dr.make_opaque(h, there)
        sun, sky = horizontal_irradiance(self.optics, band.columns, band.field, h, there, reflected=True)
        through = packet(self._through, ray, padded(self.optics.channel_count))
        glow = [through[c] * albedo * dr.inv_pi * (sun[c] + sky[c]) for c, albedo in enumerate(self.optics.albedo)]
        dr.eval(glow)
        return glow


def _coefficients(optics: Optics) -> tuple[np.ndarray, np.ndarray]:
    """Scattering [scatterer, channel] and extinction [constituent, channel], 1/m."""
    count = optics.channel_count
    scattering = [optics.constituents[k].scattering_per_m[optics.indices] for k in optics.scatterers]
    extinction = [c.extinction_per_m[optics.indices] for c in optics.constituents]
    return np.array(scattering).reshape(-1, count), np.array(extinction).reshape(-1, count)


def _padded_channels(values: np.ndarray) -> Any:
    """[rows, scatterers, channels] as a buffer with channels padded for packet loads."""
    extra = padded(values.shape[-1]) - values.shape[-1]
    return floats(np.pad(values, ((0, 0), (0, 0), (0, extra))))
