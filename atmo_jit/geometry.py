"""Altitude-first arithmetic on a sphere: the only place where single precision could go wrong.

A point is given by its altitude ``h`` above a planet of radius ``R``, never by its radius ``r = R + h`` alone: in
float32 a radius of 6.4e6 m has steps of 0.5 m, an altitude of 1 m has steps of 1e-7 m. Every difference of squares of
radii is written as a product of altitudes, ``r'^2 - r^2 = (h' - h)(2R + h + h')``. ``mu`` is the cosine of the angle
from the zenith.
"""

from __future__ import annotations

from typing import Any

import drjit as dr

# The largest cosine below 1 in single precision, 3.5e-4 radians from the vertical. Nearer directions count as so far
# from it: sin * cos(azimuth), which light is linear in there, follows from other angles, and at 1 it would be lost.
UPRIGHT = 1.0 - 2.0**-24


def altitude_along(radius: Any, h: Any, mu: Any, distance: Any) -> tuple[Any, Any]:
    """Altitude and radius (m) of the point ``distance`` along the ray (h, mu): h' = h + d (2 r mu + d) / (r + r').

    ``radius`` is the planet's. The altitude is clipped at the ground, where rounding could put it some micrometres
    below.
    """
    r = radius + h
    step = distance * dr.fma(2.0 * r, mu, distance)
    r_there = dr.sqrt(dr.maximum(dr.fma(r, r, step), radius * radius))
    return dr.maximum(h + step / (r + r_there), 0.0), r_there


def safe_sine(cosine: Any) -> Any:
    """sin of the angle whose cosine is given, >= 0, as sqrt((1 - c)(1 + c)): exact at both ends."""
    return dr.safe_sqrt((1.0 - cosine) * (1.0 + cosine))


def perigee_altitude(radius: Any, h: Any, mu: Any) -> Any:
    """Altitude (m) of the point of the whole line (h, mu) nearest to the planet's centre; negative where it is below
    ground.

    h_p = h - r mu^2 / (1 + sin): no difference of two large numbers.
    """
    return h - (radius + h) * mu * mu / (1.0 + safe_sine(mu))


def crossing_discriminant(radius: Any, h: Any, mu: Any, altitude: Any) -> Any:
    """(r mu)^2 - (h - altitude)(2R + h + altitude), m^2: the squared distance from perigee to the crossing of
    ``altitude``."""
    r_mu = (radius + h) * mu
    return dr.fma(r_mu, r_mu, (altitude - h) * (2.0 * radius + h + altitude))


def distance_up(radius: Any, h: Any, mu: Any, altitude: Any) -> Any:
    """Distance (m) at which the ray (h, mu) leaves through the sphere at ``altitude`` (the farther crossing)."""
    r_mu = (radius + h) * mu
    root = dr.safe_sqrt(crossing_discriminant(radius, h, mu, altitude))
    rise = (altitude - h) * (2.0 * radius + h + altitude)
    above = rise / dr.maximum(r_mu + root, 1e-30)
    return dr.maximum(dr.select(r_mu > 0.0, above, root - r_mu), 0.0)


def distance_down(radius: Any, h: Any, mu: Any, altitude: Any) -> Any:
    """Distance (m) at which the descending ray (h, mu < 0) first meets the sphere at ``altitude`` <= h."""
    r_mu = (radius + h) * mu
    root = dr.safe_sqrt(crossing_discriminant(radius, h, mu, altitude))
    fall = (h - altitude) * (2.0 * radius + h + altitude)
    return fall / dr.maximum(root - r_mu, 1e-30)


def hits_ground(radius: Any, h: Any, mu: Any) -> Any:
    """True where the ray (h, mu) meets the ground: descending, with (r mu)^2 >= h (2R + h)."""
    return (mu < 0.0) & (crossing_discriminant(radius, h, mu, 0.0) >= 0.0)
