"""The nodes on which the radiance field is solved: altitudes and sun zenith angles, placed where a given atmosphere
needs them.

Altitude nodes are uniform in a coordinate u(h) that grows with the scattering matter passed, flattened so that the
thin upper air gets its share; fields are interpolated linearly in u. Sun nodes are uniform in x(theta), dense around
the twilight.
"""

from __future__ import annotations

from collections import OrderedDict
from functools import cached_property
from typing import Any, ClassVar

import drjit as dr
import numpy as np

from .atmosphere import Atmosphere
from .backend import floats, parameter, types
from .resolution import Resolution

_FINE = 2048
REMEMBERED = 8  # grids kept with all that was built on them
_TWILIGHT = 4.0  # sun nodes lie this much closer (plus one) at twilight than by day


class Grid:
    """Altitude nodes ``h`` [K] (m) and sun nodes ``theta`` [S] (radians) of an atmosphere, and the maps onto them.

    The field is solved at K altitudes and S suns, and interpolated, cubically, to the refined ``levels`` and
    ``sources`` suns, on which light is then looked up linearly. Order 1, which knows the sun's disc, is solved at
    ``first_theta``, several times as many suns.
    """

    _known: ClassVar[OrderedDict[str, Grid]] = OrderedDict()

    @classmethod
    def of(cls, atmosphere: Atmosphere, resolution: Resolution) -> Grid:
        """The grid for an atmosphere; the same object for atmospheres of the same shape, so that what is built on it
        is kept."""
        grid = cls(atmosphere, resolution)
        key = f"{resolution} {grid.radius_m} {grid.levels.tobytes().hex()} {grid.theta.tobytes().hex()}"
        known = cls._known.setdefault(key, grid)
        cls._known.move_to_end(key)
        while len(cls._known) > REMEMBERED:
            cls._known.popitem(last=False)
        return known

    def __init__(self, atmosphere: Atmosphere, resolution: Resolution) -> None:
        self.resolution = resolution
        self.radius_m = atmosphere.bottom_radius_m
        self.thickness_m = atmosphere.thickness_m
        self._place_altitudes(atmosphere, resolution.altitudes, resolution.refine[0])
        self._place_suns(resolution.suns, resolution.refine[1], resolution.first_suns)

    def _place_altitudes(self, atmosphere: Atmosphere, count: int, refine: int) -> None:
        # Samples dense near the ground, so that a thin layer there is resolved too.
        h = atmosphere.thickness_m * (np.arange(_FINE + 1) / _FINE) ** 2
        middle, step = 0.5 * (h[1:] + h[:-1]), np.diff(h)
        rise = 0.3 * step / atmosphere.thickness_m
        depth = 0.0 * step
        for c in atmosphere.constituents:
            density = np.maximum(np.asarray(c.profile.density(middle)), 0.0)
            depth = depth + _rounded_depth(np.max(c.extinction_per_m) * density * step)
            share = density ** (1.0 / 3.0) * step
            if np.any(c.scattering_per_m > 0) and share.sum() > 0:
                rise = rise + share / share.sum()
        # Light in a thick layer changes within a free path of its top and bottom, slowly between.
        below = np.cumsum(depth) - 0.5 * depth
        rise = rise + depth / (1.0 + below) + depth / (1.0 + depth.sum() - below)
        u = np.concatenate([[0.0], np.cumsum(rise)])
        self._u, self._h_of_u, self.refine = u * ((count - 1) / u[-1]), h, refine
        self.h, self.levels = self.levels_at(1), self.levels_at(refine)
        self.altitude_refinement = _cubic_refinement(count, refine, mirrored=None)

    def levels_at(self, refine: int) -> np.ndarray:
        """Altitudes (m) at ``refine`` equal steps of u per interval of the solved ones, ascending from 0 to the top."""
        count = round(self._u[-1])
        levels = np.interp(np.arange(refine * count + 1) / refine, self._u, self._h_of_u)
        levels[0], levels[-1] = 0.0, self.thickness_m
        return levels

    def _place_suns(self, count: int, refine: int, first: int) -> None:
        # The light fades over the dip of the horizon seen from the top, once for single scattering and once more for
        # multiple.
        dip = np.arccos(self.radius_m / (self.radius_m + self.thickness_m))
        end = min(0.5 * np.pi + 2.2 * dip, np.pi)
        self._center, self._width = 0.5 * np.pi + 0.3 * dip, 0.8 * dip
        theta = np.linspace(0.0, end, 4 * _FINE)
        self._scale = 1.0
        fine = refine * (count - 1)
        self._scale = fine / self._sun_coordinate(end)
        self.sources = fine + 1  # refined suns
        self.theta, self.first_theta = (
            np.interp(np.linspace(0.0, fine, n), self._sun_coordinate(theta), theta)
            for n in (count, first * (count - 1) + 1)
        )
        self.sun_refine = refine
        self.sun_refinement, self.first_sun_refinement = (
            np.stack(
                [_cubic_refinement(first * (count - 1) + 1, refine // first, mirrored=sign) for sign in (1.0, -1.0)]
            )
            for first in (1, first)
        )

    def _sun_coordinate(self, theta: np.ndarray | float) -> np.ndarray:
        bend = np.arctan((theta - self._center) / self._width) + np.arctan(self._center / self._width)
        return self._scale * (theta + _TWILIGHT * self._width * bend)

    @property
    def shape(self) -> tuple[int, int]:
        """(K, S): numbers of altitude and sun nodes solved for."""
        return len(self.h), len(self.theta)

    def u_of(self, h: np.ndarray) -> np.ndarray:
        """Altitude coordinate, k at solved altitude k (float64)."""
        return np.interp(self._position(np.asarray(h)), np.arange(_FINE + 1), self._u)

    def _position(self, h: np.ndarray) -> np.ndarray:
        return np.sqrt(np.clip(h / self.thickness_m, 0.0, 1.0)) * _FINE

    @cached_property
    def _u_buffer(self) -> Any:
        return floats(self._u)

    def locate_altitude(self, h: Any, refine: int | None = None) -> tuple[Any, Any]:
        """Index of the refined level below altitude ``h`` and the fraction of the way to the next."""
        t = types()
        refine = self.refine if refine is None else refine
        position = dr.sqrt(dr.clip(h * parameter(1.0 / self.thickness_m), 0.0, 1.0)) * _FINE
        cell = dr.minimum(t.UInt(position), _FINE - 1)
        u0, u1 = dr.gather(t.Float, self._u_buffer, cell), dr.gather(t.Float, self._u_buffer, cell + 1)
        return _split(
            parameter(float(refine)) * dr.lerp(u0, u1, position - t.Float(cell)), refine * (self.shape[0] - 1) + 1
        )

    def sun_position(self, mu_s: Any) -> Any:
        """Sun coordinate x of cos(sun zenith) ``mu_s``, in units of the refined nodes, clipped to the last."""
        center, width, scale = (parameter(v) for v in (self._center, self._width, self._scale))
        theta = dr.acos(mu_s)
        bend = dr.atan((theta - center) / width) + dr.atan(center / width)
        return dr.clip(scale * dr.fma(_TWILIGHT * width, bend, theta), 0.0, self.sources - 1.0)

    def locate_sun(self, mu_s: Any) -> tuple[Any, Any]:
        """Index of the refined sun node before ``mu_s`` and the fraction of the way to the next."""
        return _split(self.sun_position(mu_s), self.sources)


def _rounded_depth(steps: np.ndarray) -> np.ndarray:
    """Optical depths of thin layers, scaled to a total that is a power of two, 0 below 1/4: a small change moves no
    node."""
    total = steps.sum()
    return steps * (2.0 ** np.round(np.log2(total)) / total) if total > 0.25 else 0.0 * steps


def _split(position: Any, count: int) -> tuple[Any, Any]:
    t = types()
    index = dr.minimum(t.UInt(dr.maximum(position, 0.0)), dr.opaque(t.UInt, count - 2, 1))
    return index, position - t.Float(index)


def _cubic_refinement(count: int, refine: int, *, mirrored: float | None) -> np.ndarray:
    """Matrix [refine (count - 1) + 1, count]: Catmull-Rom interpolation of equidistant values at ``refine`` points
    per interval.

    ``mirrored``: 1 or -1 for a function even or odd about its first node (a moment cos(m phi) is (-1)^m: the sun
    passes through the zenith); other ends go straight on.
    """
    matrix = np.zeros((refine * (count - 1) + 1, count))
    for row in range(len(matrix)):
        cell = min(row // refine, count - 2)
        f = row / refine - cell
        weights = (
            -0.5 * f + f**2 - 0.5 * f**3,
            1.0 - 2.5 * f**2 + 1.5 * f**3,
            0.5 * f + 2.0 * f**2 - 1.5 * f**3,
            -0.5 * f**2 + 0.5 * f**3,
        )
        for place, weight in enumerate(weights, cell - 1):
            if place < 0 and mirrored is not None:
                matrix[row, -place] += mirrored * weight
            elif place < 0:
                matrix[row, 0] += 2.0 * weight
                matrix[row, 1] -= weight
            elif place >= count:
                matrix[row, count - 1] += 2.0 * weight
                matrix[row, count - 2] -= weight
            else:
                matrix[row, place] += weight
    return matrix
