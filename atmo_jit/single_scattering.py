"""Light after one event: sunlight on horizontal ground, directly lit ground, and order 1 at the nodes of the solver."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from .backend import floats, packet, padded, parameter, stored, types
from .column import SunColumns
from .field import Field
from .geometry import safe_sine
from .grid import Grid
from .march import Rays, point_along, visible_sun
from .optics import PHASE_NODES, Optics
from .path_weights import PathWeights
from .paths import Directions, Paths, paths_along
from .quadrature import cosine_interpolation, half_circle
from .resolution import Resolution


class Sunbeam:
    """Direct sunlight at altitude levels: transmittance toward the sun times the visible part of its disc, linear in
    mu_s.

    ``table`` [levels, COSINES, size]: from the lowest mu_s at which the top still sees the sun up to 1.
    """

    COSINES = 768

    def __init__(self, optics: Optics, columns: SunColumns, levels: np.ndarray) -> None:
        t = types()
        self.optics, self.size = optics, padded(optics.channel_count)
        radius, top = optics.atmosphere.bottom_radius_m, optics.atmosphere.thickness_m
        dip = np.arccos(radius / (radius + top)) + np.deg2rad(optics.atmosphere.sun_angular_radius_deg)
        lowest = max(-np.sin(min(dip, 0.5 * np.pi)), -1.0)
        self._lowest, self._per_step = parameter(lowest), parameter((self.COSINES - 1) / (1.0 - lowest))
        lane = dr.arange(t.UInt, len(levels) * self.COSINES)
        h = dr.gather(t.Float, floats(levels), lane // self.COSINES)
        mu_s = dr.minimum(dr.fma(t.Float(lane % self.COSINES), 1.0 / self._per_step, self._lowest), 1.0)
        seen = visible_sun(optics, h, optics.radius + h, mu_s)
        depths = optics.optical_depths(columns.toward(h, mu_s))
        self._table = stored(
            [seen * dr.exp(-d) * e for d, e in zip(depths, optics.solar, strict=True)], lane, self.size
        )

    def at(self, level: Any, mu_s: Any) -> list[Any]:
        """Irradiance normal to the beam per channel, at a level and a sun cosine; 0 below the lowest."""
        t = types()
        x = (mu_s - self._lowest) * self._per_step
        up = x >= 0.0
        cell = dr.minimum(t.UInt(dr.maximum(x, 0.0)), self.COSINES - 2)
        f = x - t.Float(cell)
        index = level * self.COSINES + cell
        low, high = packet(self._table, index, self.size, up), packet(self._table, index + 1, self.size, up)
        return [dr.fma(f, b - a, a) for a, b in zip(low, high, strict=True)][: self.optics.channel_count]


def first_order(optics: Optics, columns: SunColumns, grid: Grid, directions: Directions, r: Resolution) -> Any:
    """Radiance of order 1 at the nodes, [K, D, S, first_azimuths, size]: single scattering and directly lit ground.

    Without its phase function, single scattering changes slowly with azimuth: it is gathered along the paths at a few
    azimuths, interpolated by its cosine series, and only then multiplied by the phase function of the angle to the
    sun. Phase functions are smoothed to ``phase_degree``: a peak narrower than the directions would be hit or missed
    by them.
    """
    paths = paths_along(grid, directions, r.beam_refine)
    weights = PathWeights(optics, paths)
    beam = Sunbeam(optics, columns, grid.levels_at(r.beam_refine))
    glow = _beam_along(optics, beam, paths, weights, grid, r.beam_azimuths)
    return _times_phase(optics, glow, grid, directions, r)


def _beam_along(optics: Optics, beam: Sunbeam, paths: Paths, weights: PathWeights, grid: Grid, azimuths: int) -> Any:
    """Scattered sunlight per scatterer without its phase function, then light from the ground: [rays, S, azimuths, 1
    + scatterers, size]."""
    t = types()
    kinds, channels, size = len(optics.scatterers), optics.channel_count, beam.size
    suns = len(grid.first_theta)
    lane = dr.arange(t.UInt, len(paths.h) * suns * azimuths)
    azimuth, rest = lane % azimuths, lane // azimuths
    sun, ray = rest % suns, rest // suns
    mu_s = dr.gather(t.Float, floats(np.cos(grid.first_theta)), sun)
    across = dr.gather(t.Float, floats(np.sin(grid.first_theta)), sun) * dr.gather(
        t.Float, floats(np.cos(half_circle(azimuths))), azimuth
    )
    visits = len(paths.station)
    device = paths.device
    rows = stored(
        [weights.weights[n * channels + c] if c < channels else t.Float(0.0) for n in range(kinds) for c in range(size)]
        or [t.Float(0.0)],
        dr.arange(t.UInt, visits),
        max(kinds * size, 1),
    )
    start, stop = dr.gather(t.UInt, device.first_visit, ray), dr.gather(t.UInt, device.first_visit, ray + 1)

    def turned(visit: Any) -> Any:
        cos_turn, sin_turn = packet(device.turns, visit, 2)
        return dr.fma(cos_turn, mu_s, sin_turn * across)

    def visit(i: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
        light = beam.at(dr.gather(t.UInt, device.level, i), turned(i))
        weight = packet(rows, i, kinds * size)
        return i + 1, [
            dr.fma(weight[n * size + c], light[c], sums[n * channels + c])
            for n in range(kinds)
            for c in range(channels)
        ]

    sums = [dr.zeros(t.Float, dr.width(lane)) for _ in range(kinds * channels)]
    if kinds:
        _, sums = dr.while_loop((start, sums), lambda i, _: i < stop, visit, label="beam")
    end = stop - 1
    falling_on = turned(end)
    lit = beam.at(t.UInt(0), falling_on)
    dr.make_opaque(lit)
    reflected = [
        dr.gather(t.Float, weights.reflected[c], end) * dr.maximum(falling_on, 0.0) * lit[c] for c in range(channels)
    ]
    blank = [t.Float(0.0)] * (size - channels)
    out = [*reflected, *blank]
    for n in range(kinds):
        out += [*sums[n * channels : (n + 1) * channels], *blank]
    return stored(out, lane, (1 + kinds) * size)


def _times_phase(optics: Optics, glow: Any, grid: Grid, directions: Directions, r: Resolution) -> Any:
    """Radiance [K, D, S, first_azimuths, size] from the ground's and the scatterers' parts at ``beam_azimuths``."""
    t = types()
    kinds, channels, size = len(optics.scatterers), optics.channel_count, padded(optics.channel_count)
    suns, azimuths, few = len(grid.first_theta), r.first_azimuths, r.beam_azimuths
    rays = directions.mu.size
    lane = dr.arange(t.UInt, rays * suns * azimuths)
    azimuth, rest = lane % azimuths, lane // azimuths
    mu = dr.gather(t.Float, floats(directions.mu), rest // suns)
    mu_s, sin_s = (dr.gather(t.Float, floats(f(grid.first_theta)), rest % suns) for f in (np.cos, np.sin))
    cos_phi = dr.gather(t.Float, floats(np.cos(half_circle(azimuths))), azimuth)
    nu = dr.clip(dr.fma(mu, mu_s, safe_sine(mu) * sin_s * cos_phi), -1.0, 1.0)
    taps = floats(cosine_interpolation(few, half_circle(azimuths)))
    count = dr.opaque(t.UInt, few, 1)

    def add(j: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
        values = packet(glow, rest * few + j, (1 + kinds) * size)
        tap = dr.gather(t.Float, taps, azimuth * few + j)
        return j + 1, [dr.fma(tap, v, s) for v, s in zip(values, sums, strict=True)]

    zero = [dr.zeros(t.Float, dr.width(lane)) for _ in range((1 + kinds) * size)]
    _, sums = dr.while_loop((t.UInt(0), zero), lambda j, _: j < count, add, label="azimuths")
    values = [dr.maximum(v, 0.0) for v in sums[:channels]]
    if kinds:
        table = optics.phase_table(r.phase_degree, size)
        x = (nu + 1.0) * (0.5 * (PHASE_NODES - 1))
        cell = dr.minimum(t.UInt(x), PHASE_NODES - 2)
        f = x - t.Float(cell)
        low, high = packet(table, cell, kinds * size), packet(table, cell + 1, kinds * size)
        for n in range(kinds):
            for c in range(channels):
                i = n * size + c
                values[c] = dr.fma(dr.maximum(sums[size + i], 0.0), dr.fma(f, high[i] - low[i], low[i]), values[c])
    return stored(values, lane, size)


def horizontal_irradiance(
    optics: Optics, columns: SunColumns, field: Field, h: Any, mu_s: Any, *, reflected: bool = False
) -> tuple[list[Any], list[Any]]:
    """Irradiance of the sun and of the sky on a horizontal surface facing up at altitude ``h``, per channel, evaluated.

    ``reflected``: only of the sky light whose reflection by that surface is still counted.
    """
    sun = sun_irradiance(optics, columns, h, mu_s)
    sky = field.irradiance(h, mu_s, reflected=reflected)
    dr.eval(sun, sky)
    return sun, sky


def ground_light(optics: Optics, columns: SunColumns, rays: Rays, field: Field) -> list[Any]:
    """Radiance of the Lambertian ground at the end of each ray, albedo E / pi; 0 for rays that do not end there."""
    _, _, mu_s = point_along(optics, rays, rays.stop)
    # Evaluated first, so that the ground and any other surface share one kernel.
    h = dr.zeros(types().Float, dr.width(mu_s))
    dr.make_opaque(h, mu_s)
    light = horizontal_irradiance(optics, columns, field, h, mu_s, reflected=True)
    return [
        dr.select(rays.ground, albedo * dr.inv_pi * (sun + sky), 0.0)
        for albedo, sun, sky in zip(optics.albedo, *light, strict=True)
    ]


def sun_irradiance(optics: Optics, columns: SunColumns, h: Any, mu_s: Any) -> list[Any]:
    """Irradiance of direct sunlight on a horizontal surface facing up at altitude ``h``, per channel."""
    cosine = disc_cosine(mu_s, optics.sun_radius)
    depths = optics.optical_depths(columns.toward(h, mu_s)) if optics.constituents else [0.0] * optics.channel_count
    return [solar * cosine * dr.exp(-depth) for solar, depth in zip(optics.solar, depths, strict=True)]


def disc_cosine(mu_s: Any, radius: Any) -> Any:
    """Mean of max(mu, 0) over a disc of angular ``radius`` about mu_s: how much of a setting sun falls on a surface.

    It is mu_s while the whole disc is up, 0 when it is all down; between, with x = mu_s / radius, the integral of
    (x + t) 2 sqrt(1 - t^2) / pi over t from -x to 1, times the radius.
    """
    x = dr.clip(mu_s / dr.maximum(radius, 1e-7), -1.0, 1.0)
    half = dr.safe_sqrt(1.0 - x * x)
    part = x * (0.5 + (dr.asin(x) + x * half) * dr.inv_pi) + (2.0 / 3.0 * dr.inv_pi) * half * half * half
    return dr.select(dr.abs(x) < 1.0, radius * dr.maximum(part, 0.0), dr.maximum(mu_s, 0.0))
