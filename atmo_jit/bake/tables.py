"""Radiance for all observers, suns and views of an atmosphere as one four-dimensional table.

What is interpolated is made smooth first. From the light of a ray are divided out: what it scatters at all (the
integral of scattering coefficient times transmittance along it, from a finer table over altitude and elevation), the
irradiance of the sky under that sun (from one over altitude and sun), and the angle's part of Rayleigh's phase
function, as far as it survives in all orders. Single scattering by peaked scatterers is apart, without their phase
functions.

Axes: square root of altitude; elevation split at the horizon, as in :mod:`.sky_view`; sun cosine, dense at twilight;
cosine of the azimuth from the sun. The ground's own light is computed from the irradiances where a ray ends on it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from .. import mapping
from ..backend import floats, packet, padded, parameter, stored, types
from ..mapping import texels
from ..march import Rays, rays_to_boundary
from ..single_scattering import ground_light
from ..solved import RayLight, Sky
from .mean_source import MeanSource, view_cosines
from .node_light import NodeLight, Nodes, is_peaked
from .sightlines import Sightlines
from .sunlight import Sunlight

OFF_EDGE = 1e-4  # of the unit elevation: rows stand this far off the horizon
OFF_ENDS = 1e-4  # of the unit altitude: where rays have some length
STEEPNESS = 2.5  # of mapping.twilight_sun
SURVIVING = 0.7  # of Rayleigh's nu^2 in light of all orders


@dataclass(frozen=True)
class Size:
    """Numbers of texels: altitudes, elevations above and below the horizon, suns, azimuths; then altitudes and
    elevations of the scattering table, altitudes and suns of the irradiance table."""

    altitudes: int = 16
    up: int = 20
    down: int = 12
    suns: int = 64
    azimuths: int = 8
    scattering: tuple[int, int, int] = (96, 96, 64)
    irradiance: tuple[int, int] = (32, 256)


class Tables4D:
    """Four-dimensional tables of a solved ``sky``; evaluated as ``Sky.rays`` is, without distances."""

    def __init__(self, sky: Sky, size: Size | None = None) -> None:
        self.sky, self.size = sky, size or Size()
        air = sky.atmosphere
        self.radius, self.thickness = air.bottom_radius_m, air.thickness_m
        # As far as the solver's own suns go: sunlight reaches the top's horizon, and scattered light once more.
        dip = np.arccos(self.radius / air.top_radius_m)
        self.lowest = float(np.cos(min(0.5 * np.pi + 2.2 * dip, np.pi)))
        self.atmosphere = air
        self.bands = [_Band4D(self, band) for band in sky.bands]

    def rays(
        self, altitude_m: Any, sun_zenith: Any, view_zenith: Any, azimuth: Any, *, ground: bool = True
    ) -> RayLight:
        """Radiance and transmittance of whole rays, as ``Sky.rays`` gives them."""
        rays, meets_air, _ = self.sky.enter(altitude_m, sun_zenith, view_zenith, azimuth)
        found = self.lookup(rays, ground=ground)
        return RayLight(
            [dr.select(meets_air, v, 0.0) for v in found.radiance],
            [dr.select(meets_air, v, 1.0) for v in found.transmittance],
        )

    def lookup(self, rays: Rays, *, ground: bool = True) -> RayLight:
        """The same for rays inside the atmosphere."""
        place = self._place(rays)
        parts = [band.at(rays, place, ground) for band in self.bands]
        return RayLight([v for p in parts for v in p[0]], [v for p in parts for v in p[1]])

    def _place(self, rays: Rays) -> dict[str, Any]:
        """Unit coordinates of rays."""
        radius = parameter(self.radius)
        q = mapping.half_elevation(rays.mu)
        edge = mapping.half_elevation(-dr.sqrt(rays.h * (2.0 * radius + rays.h)) / (radius + rays.h))
        end = dr.select(rays.ground, -mapping.STEEPEST, mapping.STEEPEST)
        sines = dr.sqrt(dr.maximum((1.0 - rays.mu) * (1.0 + rays.mu) * (1.0 - rays.mu_s) * (1.0 + rays.mu_s), 1e-14))
        return {
            "up": ~rays.ground,
            "h": dr.sqrt(rays.h * parameter(1.0 / self.thickness)),
            "mu": mapping.from_horizon(q, edge, end),
            "mu_s": dr.maximum(mapping.twilight_sun(rays.mu_s, self.lowest, STEEPNESS), 0.0),
            "phi": dr.clip(0.5 - 0.5 * (rays.nu - rays.mu * rays.mu_s) / sines, 0.0, 1.0),
        }

    def light_at(self, band: _Band4D, nodes: Nodes, ground: bool) -> NodeLight:
        """Light at the nodes of a SkyView inside the atmosphere: what it needs to be made from these tables."""
        rows, columns = nodes.shape
        t, optics, nu = types(), band.optics, nodes.nu
        mu = np.broadcast_to(nodes.mu[:, None], nodes.shape)

        def rays_from(first: int) -> Rays:
            """The rays from row ``first`` on."""
            constant = (np.full(mu[first:].shape, v) for v in (nodes.h, nodes.mu_s))
            h, mu_s = map(floats, constant)
            rays = rays_to_boundary(optics, h, floats(mu[first:]), mu_s, floats(nu[first:]))
            rays.ground = t.Bool(np.repeat(~nodes.up[first:], columns))
            return rays

        rays = rays_from(0)
        smooth, peaks, through = band.parts(rays, self._place(rays))
        dr.eval(smooth, peaks, through)
        if ground:
            first = int(np.count_nonzero(nodes.up))  # those below the horizon are the last
            below = dr.arange(t.UInt, first * columns, rows * columns)
            glow = ground_light(optics, band.band.columns, rays_from(first), band.band.field)
            for s, v, g in zip(smooth, through, glow, strict=True):
                dr.scatter(s, dr.fma(dr.gather(t.Float, v, below), g, dr.gather(t.Float, s, below)), below)
            dr.eval(smooth)
        kinds = [optics.scatterers[n] for n in band.peaks]
        row = dr.arange(t.UInt, rows) * columns
        return NodeLight(
            smooth,
            dict(zip(kinds, peaks, strict=True)),
            stored([dr.gather(t.Float, v, row) for v in through], dr.arange(t.UInt, rows), padded(len(through))),
        )

    @property
    def nbytes(self) -> int:
        """Bytes of all tables."""
        return sum(band.nbytes for band in self.bands)


class _Band4D:
    def __init__(self, tables: Tables4D, band: Any) -> None:
        self.tables, self.band, self.optics = tables, band, band.optics
        self.channels = self.optics.channel_count
        self.padded = padded(self.channels)
        constituents = self.optics.constituents
        self.peaks = [n for n, k in enumerate(self.optics.scatterers) if is_peaked(constituents[k])]
        self._bake_irradiance()
        self._bake_scattering()
        self._bake_light()

    def _bake_irradiance(self) -> None:
        """Irradiance of the sky [altitude, sun], below the thinnest air, where it vanishes."""
        size, tables = self.tables.size.irradiance, self.tables
        h = tables.thickness * np.minimum(texels(size[0]), 0.9) ** 2
        mu_s = mapping.twilight_sun_inverse(texels(size[1]), tables.lowest, STEEPNESS)
        where = (np.repeat(h, size[1]), np.tile(mu_s, size[0]))
        sky = self.band.field.irradiance(*map(floats, where))
        dr.eval(sky)
        values = np.stack([np.broadcast_to(v.numpy(), where[0].shape) for v in sky], axis=-1)
        values = values.reshape(*size, -1)
        most = values[:, -1:]  # under the highest sun
        self.irradiance = _Grid(np.maximum(values / np.where(most > 0.0, most, 1.0), 1e-12), self.padded)

    def _bake_scattering(self) -> None:
        """What all scatterers together, and each peaked one, scatter along a ray; transmittance."""
        count, up, down = self.tables.size.scattering
        _, x, _, lines = self._lines(count, up, down)
        per_metre = 1.0 / (lines.stop - lines.start)[:, None]
        whole = [lines.scattering.sum(axis=1) * per_metre, *(lines.scattering[:, n] * per_metre for n in self.peaks)]
        whole.append(lines.transmittance)
        self.along = _Halves([v.reshape(count, len(x), -1) for v in whole], up, self.padded)

    def _lines(self, count: int, up: int, down: int) -> tuple[np.ndarray, ...]:
        tables = self.tables
        x_h = np.clip(texels(count), OFF_ENDS, 1.0 - OFF_ENDS)
        x = np.maximum(np.concatenate([texels(up), texels(down)]), OFF_EDGE)
        is_up = np.arange(len(x)) < up
        h = tables.thickness * x_h**2
        mu = view_cosines(tables.radius, tables.thickness, h[:, None], x, is_up)
        ground = np.tile(~is_up, count)
        return h, x, is_up, Sightlines(self.optics, np.repeat(h, len(x)), mu.ravel(), ground=ground)

    def _bake_light(self) -> None:
        tables, size, t, optics = self.tables, self.tables.size, types(), self.optics
        h, x, is_up, lines = self._lines(size.altitudes, size.up, size.down)
        rows, suns, azimuths = len(x), size.suns, size.azimuths
        mu_s = mapping.twilight_sun_inverse(texels(suns), tables.lowest, STEEPNESS)
        lane = dr.arange(t.UInt, len(h) * rows * suns * azimuths)
        phi, rest = lane % azimuths, lane // azimuths
        sun, ray = rest % suns, rest // suns
        cosine = dr.gather(t.Float, floats(mu_s), sun)
        cos_phi = 1.0 - 2.0 * t.Float(phi) / (azimuths - 1.0)
        across = dr.sqrt((1.0 - cosine) * (1.0 + cosine)) * cos_phi
        nu = lines.nu(ray, cosine, across)
        dr.eval(ray, cosine, across, nu)
        single = lines.single(Sunlight(optics, self.band.columns), ray, cosine, across, nu)
        smooth = [dr.zeros(t.Float, dr.width(lane)) for _ in range(self.channels)]
        if self.band.source is not None:
            places = np.broadcast_to(x, (len(h), rows))
            series = MeanSource(self.band, mu_s).along(h, places, is_up, lines.scattering_table)
            smooth = series.at(ray * suns + sun, cos_phi)
        for n, k in enumerate(optics.scatterers):
            if n not in self.peaks:
                values = zip(optics.phase_values(k, nu), single[n], smooth, strict=True)
                smooth = [dr.fma(p, s, v) for p, s, v in values]
        angular = 1.0 + SURVIVING * nu * nu
        groups = [[v / angular for v in smooth], *(single[n] for n in self.peaks)]
        h_lane = dr.gather(t.Float, floats(np.sqrt(h / tables.thickness)), ray // rows)
        light = self.irradiance.at(h_lane, t.Float(sun) / (suns - 1.0))
        stored_groups = []
        for g, group in enumerate(groups):
            scattered = lines.scattering.sum(axis=1) if g == 0 else lines.scattering[:, self.peaks[g - 1]]
            per_ray = [floats(scattered[:, c]) for c in range(self.channels)]
            quotient = [
                v / dr.maximum(dr.gather(t.Float, a, ray) * e, 1e-30)
                for v, a, e in zip(group, per_ray, light, strict=False)
            ]
            dr.eval(quotient)
            values = np.stack([q.numpy() for q in quotient], axis=-1)
            stored_groups.append(values.reshape(len(h), rows, suns, azimuths, -1))
        values = np.concatenate(
            [np.pad(v, [(0, 0)] * 4 + [(0, self.padded - self.channels)]) for v in stored_groups], -1
        )
        extra = (1 << (values.shape[-1] - 1).bit_length()) - values.shape[-1]
        values = np.pad(values, [(0, 0)] * 4 + [(0, extra)])
        self.count = values.shape[-1]
        self.values = floats(values)

    def parts(self, rays: Rays, place: dict[str, Any]) -> tuple[list[Any], list[list[Any]], list[Any]]:
        """Radiance without the peaked scatterers' single scattering and without the ground's, per channel; that single
        scattering without phase functions [peak][channel]; transmittance."""
        size = self.tables.size
        *along, through = self.along.at(place["h"], place["up"], place["mu"])
        light = [e * rays.stop for e in self.irradiance.at(place["h"], place["mu_s"])]
        i, fh = _split(place["h"], size.altitudes)
        j, fm = _split(place["mu"], dr.select(place["up"], size.up, size.down))
        j += dr.select(place["up"], 0, size.up)
        k, fs = _split(place["mu_s"], size.suns)
        m, fp = _split(place["phi"], size.azimuths)
        rows = size.up + size.down
        base = ((i * rows + j) * size.suns + k) * size.azimuths + m
        steps = (rows * size.suns * size.azimuths, size.suns * size.azimuths, size.azimuths, 1)
        values = self._blend(base, steps, (fh, fm, fs, fp))
        light = [
            [values[g * self.padded + c] * scattered[c] * light[c] for c in range(self.channels)]
            for g, scattered in enumerate(along)
        ]
        angular = 1.0 + SURVIVING * rays.nu * rays.nu
        return [angular * v for v in light[0]], light[1:], through[: self.channels]

    def _blend(self, corner: Any, steps: tuple[Any, ...], fractions: tuple[Any, ...]) -> list[Any]:
        """Values between nodes: linear along the first axis of those that are left, and so on."""
        if not steps:
            return packet(self.values, types().UInt(corner), self.count)
        low, high = (self._blend(at, steps[1:], fractions[1:]) for at in (corner, corner + steps[0]))
        return [dr.lerp(a, b, fractions[0]) for a, b in zip(low, high, strict=True)]

    def at(self, rays: Rays, place: dict[str, Any], ground: bool) -> tuple[list[Any], list[Any]]:
        """Radiance and transmittance per channel."""
        radiance, peaks, through = self.parts(rays, place)
        for n, light in zip(self.peaks, peaks, strict=True):
            phase = self.optics.phase_values(self.optics.scatterers[n], rays.nu)
            radiance = [dr.fma(p, v, r) for p, v, r in zip(phase, light, radiance, strict=True)]
        if ground:
            glow = ground_light(self.optics, self.band.columns, rays, self.band.field)
            radiance = [dr.fma(v, g, r) for v, g, r in zip(through, glow, radiance, strict=True)]
        return radiance, through

    @property
    def nbytes(self) -> int:
        return 4 * dr.width(self.values) + self.along.nbytes + self.irradiance.nbytes


class _Grid:
    """Bilinear table [rows, columns, size]."""

    def __init__(self, values: np.ndarray, size: int) -> None:
        self.rows, self.columns, channels = values.shape
        self.size = size
        self.table = floats(np.pad(values, ((0, 0), (0, 0), (0, size - channels))))
        self.nbytes = 4 * dr.width(self.table)

    def at(self, y: Any, x: Any) -> list[Any]:
        i, fy = _split(y, self.rows)
        j, fx = _split(x, self.columns)
        return _bilinear(self.table, i * self.columns + j, self.columns, fy, fx, self.size)


class _Halves:
    """Groups of channels over altitude and elevation, above and below the horizon side by side, bilinear."""

    def __init__(self, groups: list[np.ndarray], up: int, size: int) -> None:
        self.count, self.rows, _ = groups[0].shape
        self.up, self.down, self.size = up, self.rows - up, size
        self.tables = [floats(np.pad(v, ((0, 0), (0, 0), (0, size - v.shape[-1])))) for v in groups]
        self.nbytes = sum(4 * dr.width(v) for v in self.tables)

    def at(self, y: Any, up: Any, x: Any) -> list[list[Any]]:
        i, fy = _split(y, self.count)
        j, fx = _split(x, dr.select(up, self.up, self.down))
        corner = i * self.rows + j + dr.select(up, 0, self.up)
        return [_bilinear(table, corner, self.rows, fy, fx, self.size) for table in self.tables]


def _bilinear(table: Any, corner: Any, stride: int, fy: Any, fx: Any, size: int) -> list[Any]:
    t = types()
    a, b, c, d = (packet(table, t.UInt(corner + o), size) for o in (0, 1, stride, stride + 1))
    return [dr.lerp(dr.lerp(p, q, fx), dr.lerp(r, s, fx), fy) for p, q, r, s in zip(a, b, c, d, strict=True)]


def _split(x: Any, count: Any) -> tuple[Any, Any]:
    """Cell and fraction of a unit coordinate in ``count`` nodes."""
    t = types()
    x = x * t.Float(count - 1)
    i = dr.clip(t.Int(x), 0, t.Int(count - 2))
    return i, dr.minimum(x - t.Float(i), 1.0)
