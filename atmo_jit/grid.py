"""The nodes on which the radiance field is solved: altitudes and sun zenith angles, placed where a given atmosphere
needs them.

Altitude nodes are uniform in a coordinate u(h) that grows with the scattering matter passed, flattened so that the
thin upper air gets its share. Sun nodes are uniform in x(theta), dense around the twilight.
"""

from __future__ import annotations

from functools import cached_property
from types import SimpleNamespace
from typing import Any, ClassVar

import drjit as dr
import numpy as np

from .atmosphere import Atmosphere, Constituent
from .backend import floats, parameter, types
from .kept import Keeper, Remembered
from .levels import corners
from .profile import Tabulated
from .resolution import Resolution, column_of

_FINE = 2048
NEAREST = 50.0  # m: what is nearer to the ground is as near
_PLANET = ("bottom_radius_m", "top_radius_m", "sun_angular_radius_deg")
NEAR = 1  # powers of two between optical depths that may share a grid
REACH = 1.0  # dips of the horizon beyond the wanted suns that are solved
REMEMBERED = 8  # grids kept with all that was built on them,
REMEMBERED_BYTES = 2**28  # which may be hundreds of megabytes for one
_DEEP_SHARES = 0.5, 2.0  # of bottom and top in deep air, whose light all comes through its top


class Grid(Keeper):
    """Altitude nodes ``h`` [K] (m) and sun nodes ``theta`` [S] (radians) of an atmosphere, and the maps onto them.

    Orders >= 2 are solved at ``theta``; order 1, which knows the edge of the shadow, at ``first_theta``, several times
    as many suns. Between nodes light is interpolated cubically; ``sources`` and ``level_count`` are refined suns and
    altitudes on which the result is tabulated, so that it can be looked up linearly. ``suns``: the range of sun zenith
    angles (radians, at the observer) that is wanted; the nodes then are those of the full grid that can matter for it.
    """

    _known: ClassVar[Remembered] = Remembered(REMEMBERED, REMEMBERED_BYTES)

    @classmethod
    def of(
        cls,
        atmosphere: Atmosphere,
        resolution: Resolution,
        suns: tuple[float, float] | None = None,
        profiles: Atmosphere | None = None,
    ) -> Grid:
        """The grid for an atmosphere; the same object for atmospheres with the same profiles and roughly the same
        optical depths, so that what is built on it is kept. ``profiles``: the atmosphere whose profiles are met on
        these nodes, where they may be others."""
        own, met = (_not_nodes(air) for air in (atmosphere, profiles or atmosphere))
        key = (
            None if met == own else met,
            types().__name__,
            resolution,
            suns,
            atmosphere.bottom_radius_m,
            atmosphere.thickness_m,
            atmosphere.sun_angular_radius_deg,
            *((profile_key(c.profile), *_matter(atmosphere, c)) for c in atmosphere.constituents),
        )
        return cls._known.of(key, lambda: cls(atmosphere, resolution, suns, profiles))

    @staticmethod
    def suits(nodes: Atmosphere, atmosphere: Atmosphere) -> bool:
        """Whether the grid for ``nodes`` serves another atmosphere too: one with the same profiles and planet, whose
        optical depths are not far from its own."""
        own, others = nodes.constituents, atmosphere.constituents
        same = all(getattr(nodes, name) == getattr(atmosphere, name) for name in _PLANET) and len(own) == len(others)
        return same and all(
            profile_key(a.profile) == profile_key(b.profile)
            and abs(_matter(nodes, a)[1] - _matter(atmosphere, b)[1]) <= NEAR
            for a, b in zip(own, others, strict=True)
        )

    def __init__(
        self,
        atmosphere: Atmosphere,
        resolution: Resolution,
        suns: tuple[float, float] | None = None,
        profiles: Atmosphere | None = None,
    ) -> None:
        self.resolution = resolution
        self.radius_m = atmosphere.bottom_radius_m
        self.thickness_m = atmosphere.thickness_m
        self.kinks_m = corners(profiles or atmosphere)[1:-1]
        self._kept: dict[Any, Any] = {}
        self._place_altitudes(atmosphere, resolution)
        self._place_suns(resolution, suns)

    def _place_altitudes(self, atmosphere: Atmosphere, resolution: Resolution) -> None:
        count, refine = resolution.altitudes, resolution.refine
        # Samples dense near the ground, so that a thin layer there is resolved too.
        h = atmosphere.thickness_m * (np.arange(_FINE + 1) / _FINE) ** 2
        middle, step = 0.5 * (h[1:] + h[:-1]), np.diff(h)
        rise = 0.3 * step / atmosphere.thickness_m
        depth = 0.0 * step
        self._bounds = []
        for c in atmosphere.constituents:
            density = np.maximum(np.asarray(c.profile.density(middle)), 0.0)
            scatters, rounded = _matter(atmosphere, c)
            column = density @ step
            # A small change of the coefficients moves no node. A depth that rounds to 2^n is at most 2^(n + 1/2).
            if column > 0.0:
                depth = depth + (2.0**rounded / column * density * step if rounded > -2 else 0.0)
                self._bounds.append((c.profile, 2.0 ** (rounded + 0.5) / column))
            share = density ** (1.0 / 3.0) * step
            if share.sum() > 0:
                rise = rise + (1.0 if scatters else resolution.absorbers) * share / share.sum()
        # On a plane light near a level bottom changes as h ln h: nearly level rays there see the ground or do not.
        near = np.diff(np.log1p(h / NEAREST))
        rise = rise + resolution.near_ground * near / near.sum()
        # Light in a thick layer changes within a free path of its top and bottom, slowly between.
        below = np.cumsum(depth) - 0.5 * depth
        above = depth.sum() - below
        low, high = _DEEP_SHARES if resolution.deep else (1.0, 1.0)
        rise = rise + low * depth / (1.0 + below) + high * depth / (1.0 + above)
        u = np.concatenate([[0.0], np.cumsum(rise)])
        self._u, self._h_of_u = u * ((count - 1) / u[-1]), h
        self.h = self.levels_at(1)
        self.refine, self.level_count = refine, refine * (count - 1) + 1

    def extinction_bound(self, h: np.ndarray) -> np.ndarray:
        """Extinction coefficient (1/m) at altitudes ``h`` of the most opaque atmosphere that shares this grid; at most
        twice that of the others where they are not thin."""
        total = np.zeros(np.shape(h))
        for profile, per_density in self._bounds:
            total = total + per_density * np.maximum(np.asarray(profile.density(h)), 0.0)
        return total

    def levels_at(self, refine: int) -> np.ndarray:
        """Altitudes (m) at ``refine`` equal steps of u per interval of the solved ones, ascending from 0 to the top."""
        count = round(self._u[-1])
        levels = np.interp(np.arange(refine * count + 1) / refine, self._u, self._h_of_u)
        levels[0], levels[-1] = 0.0, self.thickness_m
        return levels

    def _place_suns(self, resolution: Resolution, suns: tuple[float, float] | None) -> None:
        count, refine, first = resolution.suns, resolution.sun_refine, resolution.first_suns
        # The light fades over the dip of the horizon seen from the top, once for single scattering and once more for
        # multiple.
        dip = np.arccos(self.radius_m / (self.radius_m + self.thickness_m))
        end = min(0.5 * np.pi + 2.2 * dip, np.pi)
        self._center, self._width = 0.5 * np.pi + 0.3 * dip, 0.8 * dip
        theta = np.linspace(0.0, end, 4 * _FINE)
        self._bend, self._scale = resolution.twilight * self._width, 1.0
        self._scale = (count - 1) / self._sun_coordinate(end)
        position = self._sun_coordinate(theta)
        low, high = 0, count - 1
        if suns is not None:
            # Light comes from where the sun stands higher or lower by the turn along a path, once per order.
            reach = np.clip([suns[0] - REACH * dip, suns[1] + REACH * dip], 0.0, end)
            low, high = np.interp(reach, theta, position)
            low = max(0, min(int(np.floor(low)), count - 4))
            high = min(count - 1, max(int(np.ceil(high)), low + 3))
        self.sun_offset, nodes = float(low), high - low
        self.whole_suns = low == 0
        self.theta, self.first_theta = (
            np.interp(low + np.arange(n * nodes + 1) / n, position, theta) for n in (1, first)
        )
        self.first, self.sun_refine, self.sources = first, refine, refine * nodes + 1

    def _sun_coordinate(self, theta: np.ndarray | float) -> np.ndarray:
        bend = np.arctan((theta - self._center) / self._width) + np.arctan(self._center / self._width)
        return self._scale * (theta + self._bend * bend)

    @property
    def shape(self) -> tuple[int, int]:
        """(K, S): numbers of altitude and sun nodes solved for."""
        return len(self.h), len(self.theta)

    def u_of(self, h: np.ndarray) -> np.ndarray:
        """Altitude coordinate, k at solved altitude k (float64)."""
        return np.interp(np.asarray(h), self._h_of_u, self._u)

    def prepare(self) -> None:
        """Make the tables for look-ups, which cannot be made while a kernel is traced."""
        dr.eval(self._u_buffer, self._u_slopes, self._sun_map, self.counts)

    @cached_property
    def _u_buffer(self) -> Any:
        return floats(self._u)

    @cached_property
    def _u_slopes(self) -> Any:
        """Slopes of u by altitude at the samples: those between two of them jump, near the ground by 2 per cent."""
        return floats(np.gradient(self._u, self._h_of_u))

    @cached_property
    def counts(self) -> tuple[Any, Any]:
        """Of levels and of refined suns, which kernels read from memory: they serve grids of other sizes too."""
        return dr.opaque(types().UInt, self.level_count, 1), dr.opaque(types().UInt, self.sources, 1)

    def locate_altitude(self, h: Any) -> tuple[Any, Any]:
        """Index of the level below altitude ``h`` and the fraction of the way to the next."""
        t = types()
        share = dr.clip(h * parameter(1.0 / self.thickness_m), 0.0, 1.0)
        # Samples lie at squares, and u is linear in h between two of them: linear in the root it would have slopes by
        # altitude that jump by half a per cent at each sample near the ground, and none on it.
        cell = dr.minimum(t.UInt(dr.sqrt(dr.detach(share)) * _FINE), _FINE - 1)
        start = t.Float(cell)
        fraction = dr.fma(share, float(_FINE**2), -start * start) / dr.fma(2.0, start, 1.0)
        u0, u1 = dr.gather(t.Float, self._u_buffer, cell), dr.gather(t.Float, self._u_buffer, cell + 1)
        u = dr.lerp(u0, u1, dr.detach(fraction))
        if dr.grad_enabled(h):
            slopes = (dr.gather(t.Float, self._u_slopes, cell + i) for i in (0, 1))
            u = dr.fma(h - dr.detach(h), dr.lerp(*slopes, dr.detach(fraction)), u)
        return split(u * float(self.refine), self.counts[0])

    @cached_property
    def _sun_map(self) -> list[Any]:
        places = self._center, self._width, self._bend, self._scale, self.sun_offset, self.shape[1] - 1.0
        return [parameter(v) for v in places]

    def sun_position(self, mu_s: Any) -> Any:
        """Sun coordinate of cos(sun zenith) ``mu_s``: s at node s, clipped to the first and the last."""
        center, width, bend, scale, offset, last = self._sun_map
        theta = dr.safe_acos(mu_s)
        turned = dr.atan((theta - center) / width) + dr.atan(center / width)
        return dr.clip(scale * dr.fma(bend, turned, theta) - offset, 0.0, last)

    def locate_sun(self, mu_s: Any) -> tuple[Any, Any]:
        """Index of the refined sun before ``mu_s`` and the fraction of the way to the next."""
        return self.locate_source(self.sun_position(mu_s))

    def locate_source(self, x: Any) -> tuple[Any, Any]:
        """The same by the sun coordinate ``x``."""
        return split(x * float(self.sun_refine), self.counts[1])

    def node(self, level: Any, source: Any) -> Any:
        """Index of a level's node under a refined sun."""
        return level * self.counts[1] + source


def arrays_in(*things: Any) -> list[Any]:
    """Every Dr.Jit array within containers and objects of this package, once."""
    found: dict[int, Any] = {}
    _collect(things, found, set())
    return list(found.values())


def _collect(value: Any, found: dict[int, Any], seen: set[int]) -> None:
    """Put the Dr.Jit arrays within containers and objects of this package into ``found``."""
    if dr.is_array_v(value):
        found.setdefault(value.index, value)
    elif id(value) not in seen:
        seen.add(id(value))
        if isinstance(value, dict):
            parts = list(value.values())
        elif isinstance(value, (list, tuple)):
            parts = value
        else:
            ours = isinstance(value, SimpleNamespace) or type(value).__module__.startswith(__package__)
            parts = list(vars(value).values()) if ours and hasattr(value, "__dict__") else []
        for part in parts:
            _collect(part, found, seen)


def _matter(atmosphere: Atmosphere, constituent: Constituent) -> tuple[bool, int]:
    """Whether a constituent scatters, and its optical depth as a power of two, at least -2: differences that move
    nodes."""
    depth = float(np.max(constituent.extinction_per_m)) * column_of(atmosphere, constituent)
    return bool(np.any(constituent.scattering_per_m > 0)), max(-2, round(np.log2(max(depth, 1e-9))))


def _not_nodes(atmosphere: Atmosphere) -> Any:
    """What tables are made of that are kept with a grid."""
    return atmosphere.sun_angular_radius_deg, *(profile_key(c.profile) for c in atmosphere.constituents)


def profile_key(profile: Any) -> Any:
    if isinstance(profile, Tabulated):
        return profile.altitude_m.tobytes(), profile.values.tobytes()
    return profile


def split(position: Any, count: Any) -> tuple[Any, Any]:
    """Index of the node before a position, of ``count`` (a UInt), and the fraction of the way to the next."""
    t = types()
    index = dr.minimum(t.UInt(dr.maximum(position, 0.0)), count - 2)
    return index, position - t.Float(index)


def cubic(f: Any) -> list[Any]:
    """Catmull-Rom weights of the four nodes about a fraction ``f`` of the middle interval."""
    g = 1.0 - f
    return [
        -0.5 * f * g * g,
        dr.fma(f * f, dr.fma(1.5, f, -2.5), 1.0),
        dr.fma(g * g, dr.fma(1.5, g, -2.5), 1.0),
        -0.5 * g * f * f,
    ]
