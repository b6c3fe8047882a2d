"""Light after one event: sunlight on horizontal ground, directly lit ground, and order 1 at the nodes of the solver."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from .backend import floats, padded, stored, types
from .column import SunColumns
from .field import Field
from .geometry import safe_sine
from .grid import Grid
from .march import march, point_along, rays_to_boundary, visible_sun
from .optics import Optics
from .paths import Directions
from .quadrature import half_circle


def first_order(
    optics: Optics, columns: SunColumns, grid: Grid, directions: Directions, azimuths: int, phase_degree: int
) -> Any:
    """Radiance of order 1 at the nodes, [K, D, S, azimuths, channels]: single scattering and directly lit ground.

    Phase functions are smoothed to ``phase_degree``: a peak narrower than the directions would be hit or missed by them.
    """
    t = types()
    altitudes, suns = grid.shape
    count = directions.mu.shape[1]
    lane = dr.arange(t.UInt, altitudes * count * suns * azimuths)
    azimuth, rest = lane % azimuths, lane // azimuths
    sun, ray = rest % suns, rest // suns
    h = dr.gather(t.Float, floats(grid.h), ray // count)
    mu = dr.gather(t.Float, floats(directions.mu), ray)
    mu_s = dr.gather(t.Float, floats(np.cos(grid.theta)), sun)
    cos_phi = dr.gather(t.Float, floats(np.cos(half_circle(azimuths))), azimuth)
    nu = dr.clip(dr.fma(mu, mu_s, safe_sine(mu) * safe_sine(mu_s) * cos_phi), -1.0, 1.0)
    rays = rays_to_boundary(optics, h, mu, mu_s, nu)
    light = march(optics, columns, rays, phase_degree=phase_degree)
    ground = ground_light(optics, columns, rays, None)
    values = [dr.fma(light.transmittance[c], ground[c], light.single[c]) for c in range(optics.channel_count)]
    return stored(values, lane, padded(optics.channel_count))


def ground_light(optics: Optics, columns: SunColumns, rays: Any, field: Field | None) -> list[Any]:
    """Radiance of the Lambertian ground at the end of each ray, albedo E / pi; 0 for rays that do not end there."""
    _, r, mu_s = point_along(optics, rays, rays.stop)
    t = types()
    h = t.Float(0.0)
    direct = sun_irradiance(optics, columns, h, optics.radius + 0.0 * r, mu_s, rays.ground)
    sky = field.irradiance(h + 0.0 * r, mu_s, rays.ground, reflected=True) if field is not None and field.light is not None else [0.0] * optics.channel_count
    return [
        dr.select(rays.ground, optics.albedo[c] * dr.inv_pi * (direct[c] + sky[c]), 0.0) for c in range(optics.channel_count)
    ]


def sun_irradiance(optics: Optics, columns: SunColumns, h: Any, r: Any, mu_s: Any, active: Any = True) -> list[Any]:
    """Irradiance of direct sunlight on a horizontal surface facing up at altitude ``h``, per channel."""
    fraction = visible_sun(optics, h, r, mu_s) * dr.maximum(mu_s, 0.0)
    depths = optics.optical_depths(columns.toward(h, mu_s, active)) if optics.constituents else [0.0] * optics.channel_count
    return [solar * fraction * dr.exp(-depth) for solar, depth in zip(optics.solar, depths, strict=True)]
