"""Light after one event: sunlight on horizontal ground, directly lit ground, and order 1 at the nodes of the solver."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from .backend import (
    floats,
    not_negative,
    packet,
    padded,
    parameter,
    row,
    row_size,
    stored,
    sum_loop,
    table,
    table_of,
    tables_of,
    types,
)
from .column import SunColumns
from .field import Field
from .geometry import distance_up, safe_sine
from .grid import Grid
from .march import Rays, march, point_along, visible_sun
from .optics import Optics
from .path_weights import PathWeights
from .paths import Directions, Paths, paths_along
from .phase_series import PHASE_NODES, phase_node
from .profile_tangents import SUN, following_profiles
from .projection import add_harmonics, room, stored_harmonics
from .quadrature import cosine_interpolation, half_circle
from .resolution import Resolution


class Sunbeam:
    """Direct sunlight at the levels of paths per unit of ``Optics.solar``: transmittance toward the sun times the
    visible part of its disc, linear in mu_s.

    ``table`` [levels, COSINES, size]: from the lowest mu_s at which the top still sees the sun up to 1.
    """

    COSINES = 768

    def __init__(self, optics: Optics, columns: SunColumns, paths: Paths) -> None:
        t = types()
        self.optics, self.size = optics, padded(optics.channel_count)
        radius, top = optics.atmosphere.bottom_radius_m, optics.atmosphere.thickness_m
        dip = np.arccos(radius / (radius + top)) + np.deg2rad(optics.atmosphere.sun_angular_radius_deg)
        lowest = max(-np.sin(min(dip, 0.5 * np.pi)), -1.0)
        self._lowest, self._per_step = parameter(lowest), parameter((self.COSINES - 1) / (1.0 - lowest))
        kinds = len(optics.constituents)

        def beams(other: Optics) -> list[Any]:
            lane = dr.arange(t.UInt, len(paths.levels) * self.COSINES)
            h = dr.gather(t.Float, paths.kept("levels", lambda: floats(paths.levels)), lane // self.COSINES)
            mu_s = dr.minimum(dr.fma(t.Float(lane % self.COSINES), 1.0 / self._per_step, self._lowest), 1.0)
            seen = visible_sun(other, h, other.radius + h, mu_s)
            return [table_of([seen, *columns.toward(h, mu_s, optics=other)], lane)]

        keeper = paths if len(paths.levels) > len(paths.grid.levels_at(paths.refine)) else paths.grid
        owners = [[SUN, *range(kinds)]]
        (held,) = following_profiles(optics, keeper, ("sunbeams", paths.refine), owners, beams)
        lane = dr.arange(t.UInt, dr.width(held) // row_size(1 + kinds))
        seen, *column = row(held, lane, 1 + kinds, once=True)
        optics = optics.spread(dr.width(lane))
        depths = optics.optical_depths(column) if kinds else [0.0] * optics.channel_count
        light = [seen * dr.exp(-d) for d in depths]
        self._table = stored(light, lane, self.size)

    def at(self, level: Any, mu_s: Any) -> list[Any]:
        """Irradiance normal to the beam per channel, at a level and a sun cosine; 0 below the lowest."""
        t = types()
        x = (mu_s - self._lowest) * self._per_step
        up = x >= 0.0
        cell = dr.minimum(t.UInt(dr.maximum(x, 0.0)), self.COSINES - 2)
        f = x - t.Float(cell)
        index = level * self.COSINES + cell
        low, high = (packet(self._table, index + i, self.size, up, alone=True) for i in (0, 1))
        return [dr.fma(f, b - a, a) for a, b in zip(low, high, strict=True)][: self.optics.channel_count]


def first_order(optics: Optics, columns: SunColumns, grid: Grid, directions: Directions, r: Resolution) -> Any:
    """Light of order 1 at the nodes, single scattering and directly lit ground, as azimuthal harmonics
    (projection.Projection) of degree ``first_degree``.

    Without its phase function, single scattering changes slowly with azimuth: it is gathered along the paths at a few
    azimuths, interpolated by its cosine series, and only then multiplied by the phase function of the angle to the
    sun. Phase functions are smoothed to ``phase_degree``: a peak narrower than the directions would be hit or missed
    by them.
    """
    paths = paths_along(grid, directions, r.beam_refine, of_their_own=True)
    weights = PathWeights(optics, paths, r.beam_nodes)
    beam = Sunbeam(optics, columns, paths)
    glow = beam_along(optics, beam, paths, weights, _suns(grid), r.beam_azimuths)
    return _times_phase(optics, *glow, grid, directions, r)


def beam_along(
    optics: Optics, beam: Sunbeam, paths: Paths, weights: PathWeights, theta: Any, azimuths: int
) -> tuple[Any, Any]:
    """Sunlight scattered along the paths without the phase functions, a table [rays, suns, azimuths, scatterers x
    channels], and light from the ground, [rays, suns, azimuths, channels]; ``azimuth_rows`` reads them. ``theta``
    [suns, 2]: cosine and sine of the sun's zenith angle where the paths start."""
    t, together = types(), azimuths_together(azimuths)
    channels, kinds = optics.channel_count, len(optics.scatterers)
    suns, groups = dr.width(theta) // 2, azimuths // together
    lane = dr.arange(t.UInt, len(paths.h) * suns * groups)
    node = lane // groups
    sun, ray = node % suns, node // suns
    mu_s, sin_s = packet(theta, sun, 2)
    cosines = paths.grid.kept(("cosines", azimuths), lambda: floats(np.cos(half_circle(azimuths))))
    across = [sin_s * c for c in packet(cosines, lane % groups, together)]
    device = paths.device
    start, stop = dr.gather(t.UInt, device.first_visit, ray), dr.gather(t.UInt, device.first_visit, ray + 1)

    def turned(visit: Any) -> list[Any]:
        cos_turn, sin_turn = packet(device.turns, visit, 2)
        return [dr.fma(cos_turn, mu_s, sin_turn * part) for part in across]

    def visit(i: Any, sums: list[list[Any]]) -> tuple[Any, ...]:
        weight = row(weights.scattered, i, kinds * channels, alone=True) if kinds else []
        level = dr.gather(t.UInt, device.level, i)
        lights = [beam.at(level, mu) for mu in turned(i)]
        new = [
            [dr.fma(w, light[j % channels], s) for j, (w, s) in enumerate(zip(weight, old, strict=False))]
            for light, old in zip(lights, sums, strict=True)
        ]
        return i + 1, new

    def zeros(count: int) -> list[list[Any]]:
        return [[dr.zeros(t.Float, dr.width(lane)) for _ in range(count)] for _ in range(together)]

    _, sums = dr.while_loop(
        (start, zeros(kinds * channels)), lambda i, _: i < stop, visit, max_iterations=-1, label="beam"
    )
    # Light at the last visit is that of the ground, where the path ends there.
    level = dr.gather(t.UInt, device.level, stop - 1)
    reflected = row(weights.reflected, stop - 1, channels)
    ground = []
    for mu in turned(stop - 1):
        ground += [part * dr.maximum(mu, 0.0) * e for part, e in zip(reflected, beam.at(level, mu), strict=True)]
    scattered = [value for part in sums for value in part] or [t.Float(0.0)]
    return tuple(tables_of([scattered, ground], lane))


def azimuths_together(azimuths: int) -> int:
    """Azimuths that one lane of ``beam_along`` follows: they share the weights."""
    return next(count for count in (4, 3, 2, 1) if azimuths % count == 0)


def azimuth_rows(buffer: Any, node: Any, group: Any, azimuths: int, width: int) -> list[list[Any]]:
    """Rows [width] of a group of azimuths of a table that ``beam_along`` made, for rays and suns ``node``."""
    together = azimuths_together(azimuths)
    values = row(buffer, node * (azimuths // together) + group, together * width, once=True)
    return [values[i * width : (i + 1) * width] for i in range(together)]


def _suns(grid: Grid) -> Any:
    """Cosine and sine of the suns of order 1, [suns, 2], the last repeated to fill the room."""
    theta = np.pad(grid.first_theta, (0, room(len(grid.first_theta)) - len(grid.first_theta)), mode="edge")
    return grid.kept("first suns", lambda: floats(np.column_stack([np.cos(theta), np.sin(theta)])))


def _times_phase(optics: Optics, scattered: Any, ground: Any, grid: Grid, directions: Directions, r: Resolution) -> Any:
    """Azimuthal harmonics of what the scatterers and the ground send, given at ``beam_azimuths``."""
    t = types()
    kinds, channels = len(optics.scatterers), optics.channel_count
    suns, azimuths, few, degree = room(len(grid.first_theta)), r.first_azimuths, r.beam_azimuths, r.first_degree
    lane = dr.arange(t.UInt, directions.mu.size * suns)
    sun, ray = lane % suns, lane // suns
    mu = dr.gather(t.Float, grid.kept(("mu", directions), lambda: floats(directions.mu)), ray)
    mu_s, sin_s = packet(_suns(grid), sun, 2)
    along, across = mu * mu_s, safe_sine(mu) * sin_s

    def rule() -> Any:
        phi = half_circle(azimuths)
        return table(np.column_stack([np.cos(phi), cosine_interpolation(few, phi)]))

    steps = grid.kept(("azimuths", azimuths, few), rule)
    width = kinds * channels

    def by_azimuth(buffer: Any, size: int) -> list[list[Any]]:
        groups = (azimuth_rows(buffer, lane, i, few, size) for i in range(few // azimuths_together(few)))
        return [list(v) for v in zip(*(values for group in groups for values in group), strict=True)]

    held, lit = by_azimuth(scattered, width) if kinds else [], by_azimuth(ground, channels)
    phases = optics.phase_table(r.phase_degree)

    def add(j: Any, sums: list[Any], glows: list[Any]) -> tuple[Any, list[Any]]:
        held, lit = glows
        cos_phi, *taps = row(steps, j, 1 + few)
        nu = dr.clip(dr.fma(across, cos_phi, along), -1.0, 1.0)
        values = [not_negative(_dot(taps, part)) for part in lit]
        if kinds:
            x = phase_node(nu)
            cell = dr.minimum(t.UInt(x), PHASE_NODES - 2)
            f = x - t.Float(cell)
            low, high = (row(phases, cell + i, width, alone=True) for i in (0, 1))
            for i, part in enumerate(held):
                glow = not_negative(_dot(taps, part))
                values[i % channels] = dr.fma(glow, dr.fma(f, high[i] - low[i], low[i]), values[i % channels])
        return j + 1, add_harmonics(sums, values, cos_phi)

    zero = [dr.zeros(t.Float, dr.width(lane)) for _ in range((degree + 1) * channels)]
    end = dr.opaque(t.UInt, azimuths, 1)
    _, sums = sum_loop((t.UInt(0), zero), lambda j, _: j < end, add, [held, lit], "phases")
    return stored_harmonics(sums, channels, azimuths)


def _dot(a: list[Any], b: list[Any]) -> Any:
    total = a[0] * b[0]
    for x, y in zip(a[1:], b[1:], strict=True):
        total = dr.fma(x, y, total)
    return total


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
    optics = optics.spread(dr.width(mu_s))
    return [
        dr.select(rays.ground, albedo * dr.inv_pi * (sun + sky), 0.0)
        for albedo, sun, sky in zip(optics.albedo, *light, strict=True)
    ]


def sun_irradiance(optics: Optics, columns: SunColumns, h: Any, mu_s: Any) -> list[Any]:
    """Irradiance of direct sunlight on a horizontal surface facing up at altitude ``h``, per channel."""
    optics = optics.spread(dr.width(h, mu_s))
    cosine = disc_cosine(mu_s, optics.sun_radius)
    depths = [0.0] * optics.channel_count
    if optics.constituents:
        depths = optics.optical_depths(columns.toward(h, mu_s, optics=optics))
    return [solar * cosine * dr.exp(-depth) for solar, depth in zip(optics.solar, depths, strict=True)]


def exact_sun_irradiance(optics: Optics, columns: SunColumns, h: Any, mu_s: Any) -> list[Any]:
    """The same by a march in double precision, for Optics.exact and Float64 ``h`` and ``mu_s``: beside a step of
    density, the table of columns is too coarse."""
    t, r = types(), optics.radius + h
    mu = dr.maximum(mu_s, -dr.safe_sqrt(h * (2.0 * optics.radius + h)) / r)
    stop = distance_up(optics.radius, h, mu, optics.thickness)
    rays = Rays(h, mu, mu, dr.zeros(t.Float64, 1) + 1.0, stop, t.Bool(False))
    through = march(optics, columns, rays, single=False).transmittance
    cosine = disc_cosine(t.Float(mu_s), optics.sun_radius)
    return [solar * cosine * value for solar, value in zip(optics.solar, through, strict=True)]


def disc_cosine(mu_s: Any, radius: Any) -> Any:
    """Mean of max(mu, 0) over a disc of angular ``radius`` about mu_s: how much of a setting sun falls on a surface.

    It is mu_s while the whole disc is up, 0 when it is all down; between, with x = mu_s / radius, the integral of
    (x + t) 2 sqrt(1 - t^2) / pi over t from -x to 1, times the radius.
    """
    x = dr.clip(mu_s / dr.maximum(radius, 1e-7), -1.0, 1.0)
    half = dr.safe_sqrt(1.0 - x * x)
    part = x * (0.5 + (dr.safe_asin(x) + x * half) * dr.inv_pi) + (2.0 / 3.0 * dr.inv_pi) * half * half * half
    return dr.select(dr.abs(x) < 1.0, radius * dr.maximum(part, 0.0), dr.maximum(mu_s, 0.0))
