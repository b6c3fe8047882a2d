"""A planet's place in a scene: altitudes and zenith angles of points and rays there.

Altitudes follow the package's rule of altitude first: positions are taken relative to the point of the ground below
(or above) the scene's origin, where single precision resolves millimetres.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from atmo_jit.atmosphere import Atmosphere

# Of an altitude far from the planet, in float32: relative to (r^2 - R^2) / R.
ROUNDING = 3e-7


class Globe:
    """The planet of ``atmosphere`` with its centre at ``center`` (scene units, float64 [3]), ``scale`` scene units per
    metre. Points, directions and distances are in scene units; altitudes in metres."""

    def __init__(self, atmosphere: Atmosphere, center: np.ndarray, scale: float) -> None:
        self.scale = scale
        self.radius, self.thickness = atmosphere.bottom_radius_m, atmosphere.thickness_m
        distance = float(np.linalg.norm(center))
        up = -center / distance if distance > 0.0 else np.array([0.0, 0.0, 1.0])
        self.up = [float(v) for v in up]
        self.anchor = [float(v) for v in center + up * self.radius * scale]

    def relative(self, p: Any) -> tuple[Any, Any]:
        """A point in metres from the anchor, and its component along the anchor's vertical."""
        q = mi.Vector3f(*((p[i] - self.anchor[i]) * (1.0 / self.scale) for i in range(3)))
        return q, q[0] * self.up[0] + q[1] * self.up[1] + q[2] * self.up[2]

    def altitude(self, p: Any) -> Any:
        """Altitude (m) of a point."""
        return self._altitude(*self.relative(p))

    def _altitude(self, q: Any, z: Any) -> Any:
        """h = (r^2 - R^2) / (r + R), with R^2 cancelled before anything is rounded."""
        excess = dr.dot(q, q) + 2.0 * self.radius * z
        return excess / (dr.sqrt(excess + self.radius * self.radius) + self.radius)

    def along(self, ray: Any) -> tuple[Any, Any, Any, Any]:
        """Of a ray: whether it meets the atmosphere, where (two distances >= 0), and its lowest altitude from there
        on (m, >= 0).
        """
        q, z = self.relative(ray.o)
        h = self._altitude(q, z)
        d = ray.d
        cosine = d[0] * self.up[0] + d[1] * self.up[1] + d[2] * self.up[2]
        b = dr.fma(self.radius, cosine, dr.dot(q, d))  # r mu
        b2 = b * b
        room = (self.thickness - h) * (2.0 * self.radius + self.thickness + h)  # top^2 - r^2
        discriminant = dr.fma(b, b, room)
        hits = discriminant > 0.0
        root = dr.safe_sqrt(discriminant)
        # The two ends -b -+ root, each without cancellation.
        far = dr.select(b > 0.0, room / (b + root), root - b)
        near = dr.select(h > self.thickness, -b - root, 0.0)
        hits &= far > 0.0
        hits &= (h <= self.thickness) | (b < 0.0)
        excess = h * (2.0 * self.radius + h) - b2
        perigee = excess / (dr.safe_sqrt(excess + self.radius * self.radius) + self.radius)
        # Below what rounding may have made of it: a majorant that is too small is worse than one that is too large.
        lowest = dr.select(b < 0.0, perigee, h) - ROUNDING * (1.0 + dr.abs(h) * (2.0 + dr.abs(h) * (1.0 / self.radius)))
        return hits, dr.maximum(near, 0.0) * self.scale, far * self.scale, dr.clip(lowest, 0.0, self.thickness)

    def cosines(self, p: Any, d: Any, sun: Any) -> tuple[Any, Any, Any, Any]:
        """Of a point: its altitude (m, not below the ground) and the cosines of the zenith angles of the directions
        ``d`` and ``sun`` there; and that of the angle between the two."""
        q, z = self.relative(p)
        h = self._altitude(q, z)
        up = mi.Vector3f(*self.up)
        inverse = 1.0 / (self.radius + h)
        mu, mu_s = (dr.fma(self.radius, dr.dot(v, up), dr.dot(q, v)) * inverse for v in (d, sun))
        return dr.maximum(h, 0.0), *(dr.clip(v, -1.0, 1.0) for v in (mu, mu_s, dr.dot(d, sun)))
