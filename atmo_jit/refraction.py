"""How far the air lifts the sun, and how flat its disc is: refraction by a spherical atmosphere, as an option for low
suns.

The solver's rays are straight. Where the sun stands on the horizon it is seen half a degree higher than it is; a sky is
closer to what is seen there with :func:`apparent_zenith` of the sun's true zenith angle in its place.

>>> import numpy as np
>>> from atmo_jit.refraction import apparent_zenith
>>> 90.0 - float(np.degrees(apparent_zenith("earth", np.radians(90.0)))) > 0.4
True

Refractivity n - 1 is proportional to the density of the constituent ``rayleigh`` (Gladstone and Dale). Along a ray n r
sin z is constant (Bouguer), and the bending is (Auer and Standish 2000, Astron. J. 119, 2472, eq. 3, in which the
integral over the zenith angle z along the ray has no pole at the horizon):

    R = - integral of (d ln n / d ln r) / (1 + d ln n / d ln r) dz
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ._fields import NOT_NEGATIVE, number
from .atmosphere import Atmosphere
from .errors import AtmosphereError

__all__ = ["REFRACTIVITY", "apparent_zenith", "bending", "flattening", "lift"]

REFRACTIVITY = 2.777e-4  # n - 1 of air at 288.15 K, 1013.25 hPa and 550 nm: Peck and Reeder 1972
NODES = 200
ITERATIONS = 60
STEP_M = 0.5  # for the derivative of the density


def bending(
    atmosphere: Any, apparent_zenith: Any, altitude_m: float = 0.0, refractivity: float = REFRACTIVITY
) -> np.ndarray:
    """Angle (radians) by which a ray from space that arrives at the apparent zenith angles (radians) was bent.

    ``altitude_m``: the observer's. ``refractivity``: n - 1 where the gas has density 1 (at the ground). Raises
    AtmosphereError for an atmosphere without ``rayleigh``, or an observer outside of it.
    """
    air = Atmosphere.load(atmosphere)
    if air.rayleigh is None:
        raise AtmosphereError("rayleigh", "nothing", "a gas, whose density bends rays")
    height = number(altitude_m, "altitude_m", NOT_NEGATIVE)
    if height >= air.thickness_m:
        raise AtmosphereError("altitude_m", f"{height:g}", f"altitudes below the top of the air, {air.thickness_m:g} m")
    index = number(refractivity, "refractivity", NOT_NEGATIVE)
    density, radius = air.rayleigh.profile.density, air.bottom_radius_m

    def n(h: np.ndarray) -> np.ndarray:
        return 1.0 + index * np.asarray(density(np.asarray(h, float)))

    def slope(h: np.ndarray) -> np.ndarray:
        """d ln n / d ln r."""
        low, high = np.maximum(h - STEP_M, 0.0), h + STEP_M
        return (radius + h) * (n(high) - n(low)) / ((high - low) * n(h))

    z = np.atleast_1d(np.asarray(apparent_zenith, float))[..., None]
    constant = n(height) * (radius + height) * np.sin(z)
    top = radius + air.thickness_m
    x, weight = np.polynomial.legendre.leggauss(NODES)
    last = np.arcsin(np.minimum(constant / (n(air.thickness_m) * top), 1.0))
    angle = last + (z - last) * (0.5 + 0.5 * x)
    # The altitude with that zenith angle, by bisection: n r grows with r where rays are not trapped.
    low, high = np.full(angle.shape, height), np.full(angle.shape, air.thickness_m)
    for _ in range(ITERATIONS):
        middle = 0.5 * (low + high)
        below = n(middle) * (radius + middle) * np.sin(angle) < constant
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    gradient = slope(0.5 * (low + high))
    found = -(0.5 * (z - last) * weight * gradient / (1.0 + gradient)).sum(axis=-1)
    return found.reshape(np.shape(apparent_zenith))


def apparent_zenith(
    atmosphere: Any, true_zenith: Any, altitude_m: float = 0.0, refractivity: float = REFRACTIVITY
) -> np.ndarray:
    """Zenith angle (radians) at which something in space is seen whose direction without air would be ``true_zenith``.

    For observers in the air; what lies so low that even bent rays meet the ground is put where its ray would come from
    at the horizon's bending. Raises as :func:`bending`.
    """
    true = np.asarray(true_zenith, float)
    seen = np.minimum(true, np.pi / 2)
    for _ in range(30):  # R changes with z by less than one part in three, even at the horizon
        seen = np.minimum(true - bending(atmosphere, seen, altitude_m, refractivity), np.pi / 2)
    lowest = bending(atmosphere, np.full(true.shape, np.pi / 2), altitude_m, refractivity)
    return np.where(true - lowest > np.pi / 2, true - lowest, seen)


def lift(atmosphere: Any, sun_zenith: Any, altitude_m: Any) -> np.ndarray:
    """Angles (radians) by which observers at ``altitude_m`` see the sun higher than its true zenith angle
    ``sun_zenith`` (radians), arrays of one shape: 0 for those above the air. Raises as :func:`bending`."""
    air = Atmosphere.load(atmosphere)
    true, height = np.broadcast_arrays(np.asarray(sun_zenith, float), np.asarray(altitude_m, float))
    found = np.zeros(true.shape)
    for altitude in np.unique(height[height < air.thickness_m]):
        here = height == altitude
        suns, which = np.unique(true[here], return_inverse=True)
        found[here] = (suns - apparent_zenith(air, suns, float(altitude)))[which]
    return found


def flattening(
    atmosphere: Any,
    apparent_zenith: Any,
    radius: float,
    altitude_m: float = 0.0,
    refractivity: float = REFRACTIVITY,
) -> np.ndarray:
    """Vertical over true diameter of a disc in space of angular ``radius`` (radians) whose centre is seen at the
    apparent zenith angles (radians): the mean of 1 / (1 + dR/dz) over its height, as the true zenith angle is z + R(z).

    What lies below the horizontal does not count; a disc below it, where :func:`apparent_zenith` has the horizon's
    bending, is as flat as on the horizon. Across, a disc keeps its diameter to 3 parts in 10000. Raises as
    :func:`bending`.
    """
    z = np.minimum(np.asarray(apparent_zenith, float), np.pi / 2)
    low, high = np.maximum(z - radius, 0.0), np.minimum(z + radius, np.pi / 2)
    change = np.subtract(*(bending(atmosphere, end, altitude_m, refractivity) for end in (high, low)))
    return 1.0 / (1.0 + change / (high - low))
