"""Observers anywhere, in the air or in space, and where their rays enter the air."""

from __future__ import annotations

from typing import Any

import drjit as dr

from .backend import types
from .march import Rays, rays_to_boundary
from .optics import Optics


def enter(
    optics: Optics,
    altitude_m: Any,
    sun_zenith: Any,
    view_zenith: Any,
    azimuth: Any,
    distance_m: Any = None,
    *,
    exact: bool,
    recorded: bool,
) -> tuple[Rays, Any, Any]:
    """Rays moved, in double precision, to where they enter the atmosphere of ``optics``, and left in it if ``exact``;
    whether they meet air at all; whether they leave for space.

    Altitude and distance in m, angles in radians; see Sky.rays. The planet's radius is in double precision too, unless
    the rays are ``recorded`` (evaluation.py) with what kernels take from ``optics``: seen from far out, half a step of
    a radius in single precision, some tenths of a metre, is as much of the altitude at which a ray passes.
    """
    t = types()
    wide = t.Float64
    altitude, theta_s, theta, phi = (wide(v) for v in (altitude_m, sun_zenith, view_zenith, azimuth))
    radius, top = (wide(optics.radius), wide(optics.thickness)) if recorded else optics.planet
    mu, mu_s = dr.cos(theta), dr.cos(theta_s)
    nu = mu * mu_s + dr.sin(theta) * dr.sin(theta_s) * dr.cos(phi)
    r = radius + altitude
    outside = altitude > top
    # Distance to the top from outside: the nearer root of d^2 + 2 r mu d + (altitude - top)(2R + altitude + top)
    # = 0.
    excess = (altitude - top) * (2.0 * radius + altitude + top)
    square = (r * mu) ** 2 - excess
    meets = ~outside | ((mu < 0.0) & (square > 0.0))
    entering = outside & meets
    gap = dr.select(entering, excess / dr.select(entering, dr.safe_sqrt(square) - r * mu, 1.0), 0.0)
    r_in = dr.select(outside, radius + top, r)
    cosines = (
        dr.select(outside, (r * mu + gap) / r_in, mu),
        dr.select(outside, (r * mu_s + gap * nu) / r_in, mu_s),
        nu,
    )
    cosines = [dr.clip(v, -1.0, 1.0) for v in cosines]
    rays = rays_to_boundary(optics, dr.minimum(altitude, top), *cosines, planet=(radius, top))
    rays = rays if exact else rays.single()
    meets_air = t.Bool(meets)
    rays.stop = dr.select(meets_air, rays.stop, 0.0)
    rays.ground &= meets_air
    if distance_m is None:
        return rays, meets_air, ~rays.ground
    left = type(rays.stop)(dr.maximum(wide(distance_m) - gap, 0.0))
    ends = left >= rays.stop
    passes = ends & ~rays.ground & (meets_air | t.Bool(dr.isinf(wide(distance_m))))
    rays.ground &= ends
    rays.stop = dr.minimum(rays.stop, left)
    return rays, meets_air, passes
