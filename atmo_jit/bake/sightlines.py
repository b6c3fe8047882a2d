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

from copy import copy
from functools import cached_property
from typing import Any

import drjit as dr
import numpy as np

from ..backend import doubles, floats, packet, padded, stored, types, uints
from ..column import SunColumns
from ..field import Field
from ..march import relative_azimuth
from ..optics import Optics
from ..single_scattering import horizontal_irradiance
from .ray_pieces import Rays, sums
from .sunlight import Sunlight

NODES = 3  # Gauss-Legendre nodes per piece
SPENT_DEPTH = 16.0  # what lies behind 1e-7 of transmittance is not seen
STEPS_PER_OCTAVE = 4


class Sightlines:
    """View rays of one band, from altitude ``h`` (m, also above the air) at zenith cosine ``mu``, between the
    distances ``start`` and ``stop`` (m; by default from the observer to the ground or out of the air).

    ``ground``: which rays end on the ground, where rounding must not decide it (the horizon itself) or where rays are
    to go on through it, in air as it is on the ground. ``stretches``: the field of later orders is asked once in about
    so many parts of a ray (0: in every piece). All arrays are float64 [R].

    Attributes: ``start``, ``stop`` [R]; ``ground`` [R]: the ray ends there; ``transmittance`` [R, C]; ``scattering``.
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
        self.optics = optics
        rays = Rays.of(optics, h, mu, start, stop, ground)
        self.start, self.stop, self.ground = rays.start, rays.stop, rays.ground
        extinction = np.array([c.extinction_per_m for c in optics.constituents])
        extinction = extinction.reshape(-1, len(optics.atmosphere.wavelengths_nm))
        # Nodes for all bands, and for somewhat more and somewhat less matter: a small change of it then moves none.
        whole = rays.pieces(in_steps(extinction, up=True))
        self.transmittance = np.exp(-(extinction[:, optics.indices].T @ whole.total)).T
        self._pieces, self._parts, self._ends = whole, stretches, rays.ends
        depth = in_steps(extinction, up=False).T @ whole.from_start
        self._seen = depth.min(axis=0, initial=np.inf) < SPENT_DEPTH
        self._place(nodes)

    def with_nodes(self, nodes: int) -> Sightlines:
        """The same rays with so many nodes per piece."""
        other = self._anew()
        other._place(nodes)
        return other

    def of(self, optics: Optics, through: Any) -> Sightlines:
        """The same rays, nodes and all, in air of other values, for kernels alone: ``transmittance`` and ``scattering``
        are those of the first. ``through``: as the attribute of rays made for that air."""
        other = self._anew()
        other.optics, other.through = optics, through
        return other

    def _anew(self) -> Sightlines:
        """These without what follows from values and nodes."""
        other = copy(self)
        for kept in ("_weights", "_by_node", "_stretches", "scattering_table"):
            vars(other).pop(kept, None)
        return other

    def _place(self, nodes: int) -> None:
        self._count, self.at = nodes, self._pieces.nodes(self._seen, nodes)
        vars(self).pop("scattering", None)

    @cached_property
    def through(self) -> Any:
        """Transmittance to the ground, 0 on rays that do not end there: a table [ray, padded channel]."""
        return padded_channels(np.where(self.ground[:, None], self.transmittance, 0.0))

    @cached_property
    def _weights(self) -> Any:
        """Scattering coefficient times transmittance times length at every node: [node, scatterer, padded channel]."""
        t, optics, at = types(), self.optics, self.at
        if not optics.scatterers or not len(at.ray):
            return t.Float()
        channels = optics.channel_count
        through = [at.length * dr.exp(-t.Float64(depth)) for depth in optics.optical_depths(at.columns)]
        none = [t.Float(0.0)] * (padded(channels) - channels)
        weights = []
        for k in optics.scatterers:
            weights += [t.Float(optics.scattering[k][c] * at.densities[k] * through[c]) for c in range(channels)] + none
        return stored(weights, dr.arange(t.UInt, dr.width(at.length)), len(weights))

    @cached_property
    def _by_node(self) -> np.ndarray:
        """Those weights, [piece, node, scatterer, channel]."""
        kinds, channels = len(self.optics.scatterers), self.optics.channel_count
        return self._weights.numpy().reshape(len(self.at.ray), self._count, kinds, padded(channels))[..., :channels]

    @cached_property
    def scattering(self) -> np.ndarray:
        """Integral of scattering coefficient times transmittance along the rays [R, K, C], for every scatterer."""
        return sums(self._by_node.sum(axis=1, dtype=np.float64), self.at.first)

    @cached_property
    def scattering_table(self) -> Any:
        """``scattering`` by a kernel, for the values at hand: [ray, scatterer, padded channel]."""
        t, size, weights = types(), self._row, self._weights
        ray = dr.arange(t.UInt, len(self.stop))

        def node(i: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
            return i + 1, [a + b for a, b in zip(sums, packet(weights, i, size), strict=True)]

        sums = [dr.zeros(t.Float, dr.width(ray)) for _ in range(size)]
        start, end = (dr.gather(t.UInt, self.at.first_node, ray + o) for o in (0, 1))
        _, sums = dr.while_loop((start, sums), lambda i, _: i < end, node, label="sightlines: scattering")
        return stored(sums, ray, size)

    @property
    def _row(self) -> int:
        """Length of a row of weights."""
        return len(self.optics.scatterers) * padded(self.optics.channel_count)

    @cached_property
    def _stretches(self) -> tuple[Any, Any, Any]:
        """Neighbouring pieces as stretches with about equal shares of what the ray scatters: table of their centroids,
        weights, and the first of each ray."""
        if not self._parts:
            return (*self._centroids(), self.at.first_piece)
        at, weight, parts = self.at, self._by_node, self._parts
        rays, ray, distance = at.rays, at.ray, at.distance
        channels = np.maximum(self.scattering.sum(axis=1), 1e-300)
        share = (weight.sum(axis=2) / channels[ray][:, None]).mean(axis=2)
        by_piece = share.sum(axis=1)
        before = np.cumsum(by_piece) - 0.5 * by_piece
        start = (np.cumsum(by_piece) - by_piece)[np.searchsorted(ray, ray)]
        part = np.clip((before - start) * parts, 0, parts - 1).astype(int)
        rising = distance[:, 0] >= rays.middle[ray]
        key = (ray * (parts + 1) + part) * 2 + rising
        first = np.flatnonzero(np.diff(key, prepend=-1))
        total, moment = (np.add.reduceat(v, first) for v in (by_piece, (share * distance).sum(axis=1)))
        ray = ray[first]
        lit = total > 0.0
        centre = np.where(lit, moment / np.where(lit, total, 1.0), distance[first, 0])
        return (
            rays.at(uints(ray), doubles(centre), types().Float64(0.0))[0],
            padded_channels(np.add.reduceat(weight.sum(axis=1), first)),
            uints(np.searchsorted(ray, np.arange(len(self.stop) + 1))),
        )

    def _centroids(self) -> tuple[Any, Any]:
        """Every piece as a stretch, by a kernel: table of their centroids, and weights."""
        t, at, size, kinds = types(), self.at, self._row, len(self.optics.scatterers)
        if not len(at.ray):
            return t.Float(), t.Float()
        wide = size // max(kinds, 1)
        piece = dr.arange(t.UInt, len(at.ray))
        whole = packet(self.scattering_table, at.ray_of_piece, size)
        # A channel's share counts as much as another's.
        inverse = [dr.rcp(dr.maximum(sum(whole[c::wide]), 1e-30)) for c in range(self.optics.channel_count)]
        total, moment, weights = t.Float64(0.0), t.Float64(0.0), [t.Float(0.0)] * size
        for n in range(self._count):
            node = dr.fma(piece, self._count, n)
            here = packet(self._weights, node, size)
            share = t.Float64(sum(sum(here[c::wide]) * v for c, v in enumerate(inverse)))
            total, moment = total + share, dr.fma(share, dr.gather(t.Float64, at.place, node), moment)
            weights = [a + b for a, b in zip(weights, here, strict=True)]
        lit = total > 0.0
        first = dr.gather(t.Float64, at.place, piece * self._count)
        centre = dr.select(lit, moment / dr.select(lit, total, 1.0), first)
        return at.rays.at(at.ray_of_piece, centre, t.Float64(0.0))[0], stored(weights, piece, size)

    def nu(self, ray: Any, mu_s: Any, across: Any) -> Any:
        """Cosine of the angle between the rays ``ray`` (UInt indices) and suns at zenith cosine ``mu_s``.

        ``across`` = sin(sun zenith) cos(azimuth of the view from the sun), here and below.
        """
        _, _, sine, mu = packet(self._ends, ray, 4)
        return dr.clip(dr.fma(mu, mu_s, sine * across), -1.0, 1.0)

    def single(self, sunlight: Sunlight, ray: Any, mu_s: Any, across: Any, nu: Any) -> list[list[Any]]:
        """Single scattering without phase functions, [scatterer][channel], evaluated."""
        t = types()
        kinds, channels, size = len(self.optics.scatterers), self.optics.channel_count, sunlight.size
        solar, weights = self.optics.solar, self._weights

        def node(i: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
            row, horizon, scale, cos_turn, sin_turn, mu, half, disc = packet(self.at.table, i, 8)
            there = dr.fma(cos_turn, mu_s, sin_turn * across)
            above = there - horizon
            width = dr.maximum(disc, dr.abs(dr.fma(-there, mu, nu)) * half)

            def lit(sums: list[Any]) -> list[Any]:
                x = dr.minimum(dr.fma(0.5, above / width, 0.5), 1.0)
                seen = x * x * dr.fma(-2.0, x, 3.0)
                light = sunlight.at(row, dr.sqrt(dr.maximum(above * scale, 0.0)))
                weight = packet(weights, i, kinds * size)
                return [
                    dr.fma(weight[n * size + c] * seen, light[c], sums[n * channels + c])
                    for n in range(kinds)
                    for c in range(channels)
                ]

            # Under a low sun most nodes lie in the planet's shadow, and neighbouring lanes' together.
            (sums,) = dr.if_stmt((sums,), above > -width, lambda s: (lit(s),), lambda s: (s,))
            return i + 1, sums

        sums = [dr.zeros(t.Float, dr.width(ray)) for _ in range(kinds * channels)]
        if kinds:
            start, end = (dr.gather(t.UInt, self.at.first_node, ray + o) for o in (0, 1))
            _, sums = dr.while_loop((start, sums), lambda i, _: i < end, node, label="sightlines: single")
        single = [[sums[n * channels + c] * solar[c] for c in range(channels)] for n in range(kinds)]
        dr.eval(single)
        return single

    def multiple(self, source: Any, ray: Any, mu_s: Any, across: Any, nu: Any) -> list[list[Any]]:
        """Radiance of all orders after the first by the scatterer that sent it here, [scatterer][channel]: the field,
        asked once per stretch. Not evaluated, so that what is made of it is part of the same kernel."""
        t = types()
        kinds, channels = len(self.optics.scatterers), self.optics.channel_count
        size = padded(channels)
        thickness = self.optics.thickness
        table, weights, first = self._stretches

        def stretch(i: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
            root, _, _, cos_turn, sin_turn, mu, _, _ = packet(table, i, 8)
            there = dr.clip(dr.fma(cos_turn, mu_s, sin_turn * across), -1.0, 1.0)
            toward = source.scattered(root * root * thickness, there, mu, relative_azimuth(mu, there, nu), True)
            weight = packet(weights, i, kinds * size)
            for n in range(kinds):
                for c in range(channels):
                    sums[n * channels + c] = dr.fma(weight[n * size + c], toward[n][c], sums[n * channels + c])
            return i + 1, sums

        sums = [dr.zeros(t.Float, dr.width(ray)) for _ in range(kinds * channels)]
        start, end = (dr.gather(t.UInt, first, ray + o) for o in (0, 1))
        _, sums = dr.while_loop((start, sums), lambda i, _: i < end, stretch, label="sightlines: multiple")
        return [sums[n * channels : (n + 1) * channels] for n in range(kinds)]

    def ground_light(self, columns: SunColumns, field: Field, ray: Any, mu_s: Any, across: Any) -> list[Any]:
        """The ground's own radiance seen through the air, per channel, evaluated; 0 on rays that do not end there."""
        cos_turn, sin_turn, _, _ = packet(self._ends, ray, 4)
        there = dr.clip(dr.fma(cos_turn, mu_s, sin_turn * across), -1.0, 1.0)
        h = dr.zeros(types().Float, dr.width(ray))
        dr.make_opaque(h, there)
        sun, sky = horizontal_irradiance(self.optics, columns, field, h, there, reflected=True)
        through = packet(self.through, ray, padded(self.optics.channel_count))
        glow = [through[c] * albedo * dr.inv_pi * (sun[c] + sky[c]) for c, albedo in enumerate(self.optics.albedo)]
        dr.eval(glow)
        return glow


def in_steps(values: np.ndarray, *, up: bool) -> np.ndarray:
    """Values >= 0 rounded up or down to powers of 2^(1 / STEPS_PER_OCTAVE)."""
    some = values > 0.0
    steps = np.log2(np.where(some, values, 1.0)) * STEPS_PER_OCTAVE
    return np.where(some, 2.0 ** ((np.ceil if up else np.floor)(steps) / STEPS_PER_OCTAVE), 0.0)


def padded_channels(values: np.ndarray) -> Any:
    """[..., channels] as a buffer with channels padded for packet loads."""
    wide = np.zeros((*values.shape[:-1], padded(values.shape[-1])), dtype=np.float32)
    wide[..., : values.shape[-1]] = values
    return floats(wide)
