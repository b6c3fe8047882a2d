"""What a planet without shapes sends to the points among shapes, as a table: light that a shape in the way hides."""

from __future__ import annotations

import itertools
import math
from copy import copy
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from atmo_jit import mapping
from atmo_jit.backend import doubles, row, table
from atmo_jit.bake.mean_source import view_cosines
from atmo_jit.solved import Sky

from .globe import Globe

ALTITUDES, UP, DOWN, COLUMNS = 8, 32, 16, 24  # nodes; rows above and below the horizon, columns from the sun's azimuth
OFF_EDGE = 1e-4  # of the unit latitude: the first rows stand this far off the horizon
SAME_SUN, SUN_STEP, SUNS = math.radians(0.05), math.radians(0.25), 16


class OpenSky:
    """Radiance (W) from all directions at the points of a ``box`` in the air of ``globe``, the planet's ground
    included, the sun's disc not.

    Latitude goes with the square root of the distance to the horizon, azimuth with the sine of its half, as in
    atmo_jit.bake.SkyView. ``skies``: solved for the orders that light may have had after 0, 1, ... more scatterings;
    after more than there are skies the last serves. ``sun``: unit vector towards it in the scene."""

    def __init__(self, skies: list[Sky], globe: Globe, box: Any, sun: np.ndarray) -> None:
        low, high = (np.array(v, dtype=np.float64) for v in (box.min, box.max))
        corners = np.array([np.where(which, high, low) for which in itertools.product((False, True), repeat=3)])
        center = np.array(globe.anchor) - globe.radius * globe.scale * np.array(globe.up)
        out = (corners - center) / globe.scale
        distance = np.linalg.norm(out, axis=1)
        top = float(np.clip(distance.max() - globe.radius, 1.0, globe.thickness))
        sun_zenith = np.arccos(np.clip(out @ sun / distance, -1.0, 1.0))
        spread = float(np.ptp(sun_zenith))
        suns = 1 if spread < SAME_SUN else min(math.ceil(spread / SUN_STEP) + 1, SUNS)
        ends = [float(sun_zenith.mean())] if suns == 1 else [float(sun_zenith.min()), float(sun_zenith.max())]
        self._suns, self._first, self._per_sun = suns, ends[0], (suns - 1) / max(spread, SAME_SUN)
        self._radius, self._per_top = globe.radius, 1.0 / top
        h = top * (np.arange(ALTITUDES) / (ALTITUDES - 1.0)) ** 2
        x = np.maximum(np.concatenate([mapping.texels(UP), mapping.texels(DOWN)]), OFF_EDGE)
        mu = view_cosines(globe.radius, globe.thickness, h[:, None], x, np.arange(len(x)) < UP)
        azimuth = np.arccos(mapping.half_azimuth_inverse(mapping.texels(COLUMNS)))
        parts = np.arange(suns), np.arange(ALTITUDES), np.arange(len(x)), azimuth
        i, j, k, azimuth = (v.ravel() for v in np.meshgrid(*parts, indexing="ij"))
        self._nodes = h[j], np.linspace(ends[0], ends[-1], suns)[i], np.arccos(mu[j, k]), azimuth
        self._take(skies)

    def _take(self, skies: list[Sky]) -> None:
        nodes = [doubles(v) for v in self._nodes]
        light = [sky.rays(*nodes).radiance for sky in skies]
        self._levels, self._count = len(skies), len(light[0])
        self._table = table(np.stack([np.stack([np.array(v) for v in of_sky], axis=-1) for of_sky in light]))

    def moved(self, skies: list[Sky]) -> OpenSky:
        """The same for other skies."""
        other = copy(self)
        other._take(skies)
        return other

    def radiance(
        self, depth: Any, h: Any, mu_s: Any, mu: Any, cos_phi: Any, pick: Any, pick_sun: Any, active: Any
    ) -> list[Any]:
        """Of all wavelengths, at the altitude ``h`` (m), after ``depth`` scatterings.

        Interpolated in direction; of the two altitudes, and suns, about ``h`` and ``mu_s`` random numbers in [0, 1)
        take one, the nearer one more often."""
        altitude = dr.sqrt(dr.clip(h * self._per_top, 0.0, 1.0)) * (ALTITUDES - 1)
        below = dr.floor(altitude)
        # Of two nodes h0 < h < h1 that go with the square, (h - h0) / (h1 - h0).
        share = (altitude * altitude - below * below) / dr.fma(2.0, below, 1.0)
        place = mi.UInt32(below + dr.select(pick < share, 1.0, 0.0))
        if self._suns > 1:
            sun = (dr.acos(mu_s) - self._first) * self._per_sun + pick_sun
            place = dr.fma(mi.UInt32(dr.clip(sun, 0.0, self._suns - 1.0)), ALTITUDES, place)
        if self._levels > 1:
            place = dr.fma(dr.minimum(depth, self._levels - 1), self._suns * ALTITUDES, place)
        edge = mapping.half_elevation(-dr.sqrt(h * dr.fma(2.0, self._radius, h)) / (self._radius + h))
        q = mapping.half_elevation(mu)
        up = q >= edge
        end = dr.select(up, mapping.STEEPEST, -mapping.STEEPEST)
        y = dr.clip(mapping.from_horizon(q, edge, end), 0.0, 1.0) * dr.select(up, UP - 1.0, DOWN - 1.0)
        x = dr.clip(mapping.half_azimuth(cos_phi), 0.0, 1.0) * (COLUMNS - 1)
        j, i = dr.minimum(mi.UInt32(y), dr.select(up, UP - 2, DOWN - 2)), dr.minimum(mi.UInt32(x), COLUMNS - 2)
        fy, fx = y - mi.Float(j), x - mi.Float(i)
        first = dr.fma(dr.fma(place, UP + DOWN, j + dr.select(up, 0, UP)), COLUMNS, i)
        found = [mi.Float(0.0)] * self._count
        steps, gx, gy = (0, 1, COLUMNS, COLUMNS + 1), 1.0 - fx, 1.0 - fy
        for step, weight in zip(steps, (gy * gx, gy * fx, fy * gx, fy * fx), strict=True):
            values = row(self._table, first + step, self._count, active=active)
            found = [dr.fma(weight, v, s) for v, s in zip(values, found, strict=True)]
        return found
