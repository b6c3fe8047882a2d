"""The sky: everything that users, plugins, exporters and fits call.

>>> import atmo_jit
>>> result = atmo_jit.sky("earth", {"altitude_m": 2.0, "sun_zenith_deg": 60.0, "view_zenith_deg": [0.0, 45.0], "azimuth_deg": 90.0})
>>> result.radiance.shape  # views, wavelengths
(2, 3)
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from .atmosphere import Atmosphere
from .backend import doubles, types
from .column import SunColumns
from .field import Field
from .geometry import hits_ground
from .grid import Grid
from .march import Rays, march, rays_to_boundary
from .multiple_scattering import solve
from .single_scattering import ground_light, sun_irradiance
from .optics import MAX_CHANNELS, Optics
from .plan import Resolution


@dataclass
class RayLight:
    """Radiance toward the observer and transmittance along each ray: lists of W Dr.Jit Floats."""

    radiance: list[Any]
    transmittance: list[Any]


class _Band:
    """The solution at up to four wavelengths."""

    def __init__(self, atmosphere: Atmosphere, indices: np.ndarray, resolution: Resolution, orders: int | None, tolerance: float) -> None:
        self.optics = Optics(atmosphere, indices)
        self.columns = SunColumns(self.optics, resolution.columns)
        self.field: Field = solve(self.optics, self.columns, Grid(atmosphere, resolution), resolution, orders, tolerance)
        self.source = self.field if self.field.light is not None and self.optics.scatterers else None


class Sky:
    """The solved sky of an atmosphere: all sun angles, altitudes, directions. Solve once, evaluate many times.

    ``orders``: scattering and reflection events counted (1: single scattering and directly lit ground only; None: all).
    ``tolerance``: relative error aimed at.
    """

    def __init__(self, atmosphere: Any, orders: int | None = None, tolerance: float = 0.01, resolution: Resolution | None = None) -> None:
        self.atmosphere = Atmosphere.load(atmosphere)
        self.orders = orders
        self.tolerance = tolerance
        self.resolution = resolution or Resolution.suited(self.atmosphere, tolerance)
        count = len(self.atmosphere.wavelengths_nm)
        starts = range(0, count, MAX_CHANNELS)
        bands = [np.arange(i, min(i + MAX_CHANNELS, count)) for i in starts]
        self._bands = [_Band(self.atmosphere, b, self.resolution, orders, tolerance) for b in bands]

    def rays(
        self,
        altitude_m: Any,
        sun_zenith: Any,
        view_zenith: Any,
        azimuth: Any,
        distance_m: Any = None,
        *,
        ground: bool = True,
    ) -> RayLight:
        """Radiance and transmittance of rays.

        Angles in radians, arrays of one width (Float64 keeps views from far out in space exact; Float works too). ``azimuth`` is the
        view's minus the sun's. ``distance_m``: stop there (aerial perspective). ``ground=False`` leaves the ground's own radiance out.
        """
        rays, hit, inside = self._enter(altitude_m, sun_zenith, view_zenith, azimuth, distance_m)
        radiance, transmittance = [], []
        for band in self._bands:
            optics = band.optics
            light = march(optics, band.columns, rays, source=band.source)
            for c in range(optics.channel_count):
                light.single[c] = light.single[c] + light.multiple[c]
            if ground:
                ended = Rays(rays.h, rays.mu, rays.mu_s, rays.nu, rays.stop, hit)
                for c, glow in enumerate(ground_light(optics, band.columns, ended, band.field)):
                    light.single[c] = dr.fma(light.transmittance[c], glow, light.single[c])
            radiance += [dr.select(inside, value, 0.0) for value in light.single]
            transmittance += [dr.select(inside, value, 1.0) for value in light.transmittance]
        return RayLight(radiance, transmittance)

    def irradiance(self, altitude_m: Any, sun_zenith: Any) -> tuple[list[Any], list[Any]]:
        """Irradiance of the sun and of the sky (scattered light) on a horizontal surface facing up at ``altitude_m``."""
        t = types()
        h = t.Float(altitude_m)
        mu_s = t.Float(dr.cos(t.Float64(sun_zenith)))
        sun, sky = [], []
        for band in self._bands:
            optics = band.optics
            inside = h < optics.thickness
            level = dr.minimum(h, optics.thickness)
            sun += sun_irradiance(optics, band.columns, level, optics.radius + h, mu_s)
            sky += [dr.select(inside, value, 0.0) for value in band.field.irradiance(level, mu_s)]
        return sun, sky

    def _enter(self, altitude_m: Any, sun_zenith: Any, view_zenith: Any, azimuth: Any, distance_m: Any) -> tuple[Rays, Any, Any]:
        """Rays moved, in double precision, to where they enter the atmosphere; whether they end on the ground; whether they meet air at all."""
        t = types()
        wide = t.Float64
        altitude, theta_s, theta, phi = (wide(v) for v in (altitude_m, sun_zenith, view_zenith, azimuth))
        radius = wide(self.atmosphere.bottom_radius_m)
        top = wide(self.atmosphere.thickness_m)
        mu, mu_s = dr.cos(theta), dr.cos(theta_s)
        sin, sin_s = dr.sin(theta), dr.sin(theta_s)
        nu = mu * mu_s + sin * sin_s * dr.cos(phi)
        r = radius + altitude
        outside = altitude > top
        # Distance to the top from outside: the nearer root of d^2 + 2 r mu d + (altitude - top)(2R + altitude + top) = 0.
        excess = (altitude - top) * (2.0 * radius + altitude + top)
        square = (r * mu) ** 2 - excess
        meets = ~outside | ((mu < 0.0) & (square > 0.0))
        gap = dr.select(outside & meets, excess / (dr.safe_sqrt(square) - r * mu), 0.0)
        r_in = dr.select(outside, radius + top, r)
        rays_mu = dr.select(outside, (r * mu + gap) / r_in, mu)
        rays_mu_s = dr.select(outside, (r * mu_s + gap * nu) / r_in, mu_s)
        h = t.Float(dr.minimum(altitude, top))
        mu_f, mu_s_f, nu_f = (t.Float(dr.clip(v, -1.0, 1.0)) for v in (rays_mu, rays_mu_s, nu))
        optics = self._bands[0].optics
        rays = rays_to_boundary(optics, h, mu_f, mu_s_f, nu_f)
        hit = rays.ground
        if distance_m is not None:
            left = t.Float(dr.maximum(wide(distance_m) - gap, 0.0))
            hit = hit & (left >= rays.stop)
            rays.stop = dr.minimum(rays.stop, left)
        inside = t.Bool(meets)
        rays.stop = dr.select(inside, rays.stop, 0.0)
        return rays, hit & inside, inside


@dataclass
class SkyResult:
    """float32 arrays [N, W] and what was done: ``radiance``, ``transmittance``, ``sun_irradiance``, ``sky_irradiance``, ``meta``."""

    radiance: np.ndarray
    transmittance: np.ndarray
    sun_irradiance: np.ndarray
    sky_irradiance: np.ndarray
    meta: dict[str, Any]


def sky(
    atmosphere: Any,
    views: Mapping[str, Any],
    *,
    tolerance: float = 0.01,
    orders: int | None = None,
    ground: bool = True,
    sun_disc: bool = False,
    method: str = "auto",
    progress: Any = None,
) -> SkyResult:
    t = types()
    arrays = np.broadcast_arrays(*(np.atleast_1d(np.asarray(views[n], dtype=np.float64)) for n in ("altitude_m", "sun_zenith_deg", "view_zenith_deg", "azimuth_deg")))
    start = time.perf_counter()
    solved = Sky(atmosphere, orders, tolerance)
    altitude = doubles(arrays[0])
    angles = [doubles(np.deg2rad(a)) for a in arrays[1:]]
    distance = None if views.get("distance_m") is None else doubles(np.broadcast_to(views["distance_m"], arrays[0].shape))
    light = solved.rays(altitude, *angles, distance, ground=ground)
    sun, scattered = solved.irradiance(altitude, angles[0])
    dr.eval(light.radiance, light.transmittance, sun, scattered)
    stack = lambda values: np.stack([np.broadcast_to(np.array(v), arrays[0].shape) for v in values], axis=-1).astype(np.float32)
    out = [stack(v) for v in (light.radiance, light.transmittance, sun, scattered)]
    return SkyResult(*out, {"seconds": time.perf_counter() - start})
