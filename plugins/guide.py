"""What the solved tables know of the light in the air, as a guide for :mod:`.volpath`: where to scatter, and in which
direction to go on.

A guide only says what is drawn more often; what is drawn is weighted for it, so the mean stays what it is whatever
the guide says (and a bad guide shows as noise). It therefore may be coarse: sunlight and mean radiance at a few
altitudes and sun angles, and radiance in a few directions there.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from atmo_jit.backend import doubles
from atmo_jit.solved import Sky

from .air import Air
from .flight import Airway, Flight, flight

ALTITUDES, SUNS, ZENITHS, AZIMUTHS = 10, 64, 16, 6
POWER = 3.0  # altitudes are spaced as this power of the index
TOLERANCE = 0.03  # of the solve
# Of the mean radiance, that every direction and place is credited with: bounds the weights where the tables see none.
FLOOR = 0.05
DARKEST = 1e-12  # of sunlight


def signed_root(x: Any) -> Any:
    """From [-1, 1] to [0, 1], dense about 0: sun and view cosines change what is seen most at the horizon."""
    return 0.5 + dr.mulsign(0.5 * dr.sqrt(dr.abs(x)), x)


def signed_square(y: np.ndarray) -> np.ndarray:
    """The inverse of :func:`signed_root`."""
    x = 2.0 * y - 1.0
    return x * np.abs(x)


class Guide:
    """Tables of one atmosphere's light, lit by a sun in ``sun`` (unit vector towards it, scene coordinates).

    Solves the atmosphere, which takes the time of ``Sky`` and of some 60,000 rays. Radiance is per irradiance 1.
    """

    def __init__(self, air: Air, sun: np.ndarray) -> None:
        self.air = air
        self._sun = mi.Vector3f(*(float(v) for v in sun))
        self._cosine = mi.Float(float(np.dot(sun, air.up)))  # at the anchor
        dr.make_opaque(self._sun, self._cosine)
        atmosphere = air.atmosphere
        h = air.thickness * (np.arange(ALTITUDES) / (ALTITUDES - 1.0)) ** POWER
        mu_s = signed_square(np.arange(SUNS) / (SUNS - 1.0))
        mu = signed_square((np.arange(ZENITHS) + 0.5) / ZENITHS)
        cos_phi = 1.0 - 2.0 * (np.arange(AZIMUTHS) + 0.5) / AZIMUTHS
        shape = (ALTITUDES, SUNS, ZENITHS, AZIMUTHS)
        grid = np.meshgrid(h, *(np.arccos(v) for v in (mu_s, mu, cos_phi)), indexing="ij")
        sky = Sky(atmosphere.replace({"solar_irradiance": 1.0}), tolerance=TOLERANCE)
        light = sky.rays(*(doubles(v) for v in grid))
        dr.eval(light.radiance)
        radiance = np.stack([np.array(c).reshape(shape) for c in light.radiance])  # [W, ...]
        solid_angle = np.gradient(mu)
        solid_angle /= solid_angle.sum()
        turn = np.diff(np.arccos(np.clip(1.0 - 2.0 * np.arange(AZIMUTHS + 1) / AZIMUTHS, -1, 1))) / np.pi
        mean = np.einsum("whsmp,m,p->whs", radiance, solid_angle, turn)
        radiance = radiance + FLOOR * mean[..., None, None] + 1e-30
        rows = air.wavelengths.rows
        picked = np.stack([radiance[list(row)].mean(axis=0) for row in rows])
        self._radiance = mi.Float(picked.ravel().astype(np.float32))
        sunlight = self._sunlight(h, mu_s)
        # [row, altitude, sun, (sunlight, mean radiance)], the mean over the wavelengths of a path.
        both = np.stack([np.stack([sunlight[list(r)].mean(axis=0), mean[list(r)].mean(axis=0)], -1) for r in rows])
        self._source = mi.Float(np.log(np.maximum(both, DARKEST)).ravel().astype(np.float32))
        dr.make_opaque(self._radiance, self._source)

    def _sunlight(self, h: np.ndarray, mu_s: np.ndarray) -> np.ndarray:
        """Transmittance from altitudes to the sun [W, altitude, sun], 0 in the planet's shadow."""
        air, (up, altitude) = self.air, np.meshgrid(mu_s, h)
        vertical = np.array(air.up)
        across = np.cross(vertical, np.eye(3)[int(np.argmin(np.abs(vertical)))])
        across /= np.linalg.norm(across)
        total = np.zeros((air.wavelengths.total, *up.shape))
        origin = np.array(air.anchor)[:, None] + air.scale * vertical[:, None] * altitude.ravel()
        direction = vertical[:, None] * up.ravel() + across[:, None] * np.sqrt(1.0 - up.ravel() ** 2)
        radius = air.radius
        horizon = -np.sqrt(altitude * (2.0 * radius + altitude)) / (radius + altitude)
        for w in range(air.wavelengths.total):
            depth = np.zeros(up.size)
            ray = dr.zeros(mi.Ray3f, up.size)
            ray.o, ray.d = (mi.Point3f(*v.astype(np.float32)) for v in (origin, direction))
            amounts = Airway(air, ray).amounts(flight(air, ray, dr.inf))
            for c, amount in zip(air.atmosphere.constituents, amounts, strict=True):
                depth += c.extinction_per_m[w] * np.array(amount)
            total[w] = np.where(up > horizon, np.exp(-depth).reshape(up.shape), 0.0)
        return total

    def _place(self, row: Any, h: Any, mu_s: Any) -> tuple[Any, Any, Any]:
        """Index of the (altitude, sun) node below, and the fractions from there."""
        x = dr.power(dr.clip(h * (1.0 / self.air.thickness), 0.0, 1.0), 1.0 / POWER) * (ALTITUDES - 1)
        y = signed_root(dr.clip(mu_s, -1.0, 1.0)) * (SUNS - 1)
        i = dr.minimum(mi.UInt32(x), ALTITUDES - 2)
        j = dr.minimum(mi.UInt32(y), SUNS - 2)
        return (row * ALTITUDES + i) * SUNS + j, x - mi.Float(i), y - mi.Float(j)

    def light(self, row: Any, h: Any, mu_s: Any) -> tuple[Any, Any]:
        """Sunlight (transmittance) and mean radiance (1/sr) at a place."""
        node, fx, fy = self._place(row, h, mu_s)

        def corner(offset: int) -> Any:
            return dr.gather(mi.Vector2f, self._source, node + offset)

        low = dr.lerp(corner(0), corner(1), fy)
        both = dr.exp(dr.lerp(low, dr.lerp(corner(SUNS), corner(SUNS + 1), fy), fx))
        return both[0], both[1]

    def along(self, way: Airway, f: Flight, ray: Any) -> Any:
        """The function of (distance, altitude, radius) that gives what scattered light is worth on a flight:
        [constituent]."""
        sun, row = self._sun, self.air.wavelengths.row(ray)
        q, _ = self.air.relative(ray(f.start * self.air.scale))
        nu = dr.dot(ray.d, sun)
        axial = dr.fma(self.air.radius, self._cosine, dr.dot(q, sun))  # r mu_s where the flight begins
        phases = way.phase_values(nu)

        def worth(distance: Any, h: Any, r: Any) -> list[Any]:
            sunlight, mean = self.light(row, h, dr.fma(distance, nu, axial) / r)
            return [None if p is None else dr.fma(sunlight, p, mean) for p in phases]

        return worth

    def here(self, p: Any) -> tuple[Any, Any, Any]:
        """Altitude (m), vertical and sun cosine of a point."""
        q, z = self.air.relative(p)
        up = dr.normalize(q + self.air.radius * mi.Vector3f(*self.air.up))
        return self.air._altitude(q, z), up, dr.dot(up, self._sun)

    def radiance(self, row: Any, h: Any, up: Any, mu_s: Any, d: Any) -> Any:
        """Radiance (1/sr) that arrives from direction ``d`` at a place, roughly; > 0."""
        node, fx, fy = self._place(row, h, mu_s)
        node += dr.select(fx > 0.5, SUNS, 0) + dr.select(fy > 0.5, 1, 0)
        mu = dr.clip(dr.dot(d, up), -1.0, 1.0)
        sines = dr.safe_sqrt((1.0 - mu * mu) * (1.0 - mu_s * mu_s))
        cos_phi = dr.select(sines > 0.0, (dr.dot(d, self._sun) - mu * mu_s) / sines, 1.0)
        m = dr.minimum(mi.UInt32(signed_root(mu) * ZENITHS), ZENITHS - 1)
        a = dr.minimum(mi.UInt32(dr.clip(0.5 - 0.5 * cos_phi, 0.0, 1.0) * AZIMUTHS), AZIMUTHS - 1)
        return dr.gather(mi.Float, self._radiance, (node * ZENITHS + m) * AZIMUTHS + a)

    def irradiance(self, ray: Any, p: Any) -> Any:
        """Irradiance on horizontal ground at a point, for a path."""
        h, _, mu_s = self.here(p)
        sunlight, mean = self.light(self.air.wavelengths.row(ray), h, mu_s)
        return sunlight * dr.maximum(mu_s, 0.0) + dr.pi * mean
