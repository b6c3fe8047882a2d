"""An atmosphere as kernels see it: at most four wavelengths ("channels") with every value a Dr.Jit parameter.

Kernels never see NumPy or JSON: they ask an :class:`Optics` for densities, phase functions and coefficients. Values
are opaque to the compiler, so that another atmosphere of the same make-up reuses the compiled kernels.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from copy import copy
from dataclasses import fields, replace
from functools import cached_property, lru_cache
from typing import Any

import drjit as dr
import numpy as np

from ._trees import flat, like
from .atmosphere import Atmosphere
from .backend import doubles, floats, parameter, spread, table, types
from .phase import CornetteShanks, HenyeyGreenstein, RayleighPhase
from .profile import Exponential, Tabulated, Tent
from .resolution import moments_of

FEW_CORNERS = 8
PHASE_NODES = 513
MAX_CHANNELS = 4  # one 128-bit packet: wavelengths share every gather of geometry and sun angle
# Scale heights at which rays are cut: the field is asked once between two cuts.
LEVELS = (0.5, 1.0, 1.75, 2.5, 3.75, 5.0, 9.0, 13.0, 17.0)
# In fog, more: as long as a horizontal ray there has this optical depth.
FURTHER, THIN = 4.0, 0.05
RAMP, THICK = 0.25, 4.0
STEEPER = 4.0
# Altitudes in single precision are rounded by ROUNDING of themselves; an error of UNSEEN of an optical depth is small.
ROUNDING, UNSEEN, SELDOM = 6e-8, 1e-5, 0.01
FINEST = 3e-5  # of an altitude: shells, which are divided on, are no thinner in single precision
_VALUES = (
    "radius",
    "thickness",
    "sun_radius",
    "solar",
    "albedo",
    "scattering",
    "extinction",
    "profiles",
    "asymmetry",
)


class Optics:
    """Dr.Jit view of ``atmosphere`` at the wavelengths ``indices`` (at most MAX_CHANNELS of them).

    Attributes: ``radius``, ``thickness`` (m); ``solar``, ``albedo`` (lists of C Floats); ``scattering[k]``,
    ``extinction[k]`` (1/m) for constituent k; ``scatterers`` (indices of the constituents that scatter);
    ``sun_radius`` (angular, radians); ``profiles[k]``, ``asymmetry[k]``: numbers of its profile, and g of its phase
    functions. ``scattering_too``: names of constituents that count as scatterers although none of their coefficients
    is above 0.
    """

    radius: Any
    thickness: Any
    sun_radius: Any
    solar: list[Any]
    albedo: list[Any]
    scattering: list[list[Any]]
    extinction: list[list[Any]]
    profiles: list[list[Any]]
    asymmetry: list[list[Any]]
    _is_exact = False

    def __init__(
        self, atmosphere: Atmosphere, indices: np.ndarray, scattering_too: Collection[str] = ()
    ) -> None:
        self.atmosphere, self.indices = atmosphere, indices
        self.channel_count = len(indices)
        self.constituents = atmosphere.constituents
        self.scatterers = [
            k
            for k, c in enumerate(self.constituents)
            if c.phase is not None and (np.any(c.scattering_per_m > 0) or c.name in scattering_too)
        ]
        self.phase_tables: dict[int, Any] = {}
        self.moment_tables: dict[int, Any] = {}
        vars(self).update(on_device(self.numbers(atmosphere)))

    @cached_property
    def make_up(self) -> tuple[Any, ...]:
        """What kernels depend on beside values: how many channels and which constituents scatter."""
        return self.channel_count, tuple(self.scatterers), len(self.constituents)

    @property
    def phase_kinds(self) -> tuple[Any, ...] | None:
        """What kernels compile of the phase functions; None where they compile numbers, or tables of them."""
        kinds = []
        for c in self.constituents:
            if c.phase is not None and not isinstance(c.phase, (HenyeyGreenstein, CornetteShanks, RayleighPhase)):
                return None
            kinds.append((type(c.phase), np.ndim(getattr(c.phase, "g", 0.0))))
        return tuple(kinds)

    def numbers(
        self, atmosphere: Atmosphere, degrees: tuple[int, ...] = (), phase_degree: int | None = None
    ) -> dict[str, Any]:
        """The values (see ``values``) of an atmosphere of the same make-up, in double precision: numbers, arrays
        [points] of tabulated profiles and [rows, columns] of phase tables."""
        i = self.indices
        parts = atmosphere.constituents
        phases = [_distinct([c.phase.at(int(j)) for j in i] if c.phase else [])[0] for c in parts]
        made: dict[str, Any] = {
            "radius": atmosphere.bottom_radius_m,
            "thickness": atmosphere.thickness_m,
            "sun_radius": float(np.deg2rad(atmosphere.sun_angular_radius_deg)),
            "solar": atmosphere.solar_irradiance[i].tolist(),
            "albedo": atmosphere.ground_albedo[i].tolist(),
            "scattering": [c.scattering_per_m[i].tolist() for c in parts],
            "extinction": [c.extinction_per_m[i].tolist() for c in parts],
            "profiles": [_numbers_of(c.profile) for c in parts],
            "asymmetry": [[p.g for p in of_part if hasattr(p, "g")] for of_part in phases],
        }
        if phase_degree is not None:
            made["phase_tables"] = {phase_degree: self._phase_series(atmosphere, phase_degree)}
            made["moment_tables"] = {degree: self.scatterers_moments(degree, atmosphere) for degree in degrees}
        return made

    def channels(self, numbers: dict[str, Any]) -> list[int | None]:
        """Which channel each leaf of ``numbers`` belongs to; None: to none, or to all, as a table does."""

        def of(part: Any) -> list[int | None]:
            if isinstance(part, dict):
                return [channel for inner in part.values() for channel in of(inner)]
            if not isinstance(part, list):
                return [None]
            if part and isinstance(part[0], list):
                return [channel for inner in part for channel in of(inner)]
            return list(range(len(part))) if len(part) == self.channel_count else [None] * len(part)

        return of(numbers)

    def values(self, degrees: tuple[int, ...], phase_degree: int) -> dict[str, Any]:
        """Everything that kernels read of an atmosphere, with phase moments up to ``degrees``."""
        return {
            **self.used,
            "phase_tables": {phase_degree: self.phase_table(phase_degree)},
            "moment_tables": {degree: self.phase_moments(degree) for degree in degrees},
        }

    def with_values(self, values: dict[str, Any]) -> Optics:
        """These optics with other ``values``."""
        other = copy(self)
        vars(other).update(values, exact=None)
        return other

    @cached_property
    def exact(self) -> Optics | None:
        """These optics with altitudes in double precision, for rays that are too (a tenth slower); None where the
        rounding of altitudes in single precision is not seen."""
        if max((self._rounded(c) for c in self.constituents), default=0.0) < UNSEEN:
            return None
        t, air = types().Float64, self.atmosphere
        other = self.with_values({})
        other._is_exact = True
        other.radius, other.thickness = (dr.opaque(t, v, 1) for v in (air.bottom_radius_m, air.thickness_m))
        other.profiles = [
            [doubles(v) if isinstance(v, np.ndarray) else dr.opaque(t, v, 1) for v in _numbers_of(c.profile)]
            for c in self.constituents
        ]
        return other

    def _rounded(self, c: Any) -> float:
        """What rounding of altitudes does to optical depths of one constituent: the error of a vertical ray's from
        beside a corner, and a part of that of a horizontal ray's from beside a step, which few see; the relative error
        where it is exponential."""
        top, radius = self.atmosphere.thickness_m, self.atmosphere.bottom_radius_m
        corners = np.clip([*c.profile.kinks_m, top], 0.0, top)
        below, above = (c.profile.density(corners * (1.0 + side)) for side in (-1e-9, 1e-9))
        above = np.where(corners < top, above, 0.0)
        moved = ROUNDING * corners
        depths = moved * np.maximum(below, above)
        depths += SELDOM * np.abs(above - below) * np.sqrt(8.0 * (radius + corners) * moved)
        relative = ROUNDING * top / c.profile.scale_height_m if isinstance(c.profile, Exponential) else 0.0
        return max(relative, float(np.max(c.extinction_per_m) * np.max(depths)))

    def altitudes(self, values: np.ndarray) -> Any:
        """Altitudes (m) on the device, in the precision of these optics."""
        return doubles(values) if self._is_exact else floats(values)

    def spread(self, width: int) -> Optics:
        """These optics for a kernel of ``width`` lanes: derivatives by all values are summed over the lanes together
        (backend.spread)."""
        leaves = flat(self.used)
        places = [i for i, leaf in enumerate(leaves) if dr.grad_enabled(leaf) and len(leaf) == 1]
        if not places or width == 1:
            return self
        for i, leaf in zip(places, spread([leaves[i] for i in places], width), strict=True):
            leaves[i] = leaf
        return self.with_values(like(self.used, leaves))

    @property
    def used(self) -> dict[str, Any]:
        """Every value that is no table."""
        return {name: getattr(self, name) for name in _VALUES}

    def densities(self, h: Any) -> list[Any]:
        """Relative density of every constituent at altitude ``h`` (m)."""
        found = [
            type(c.profile)(*numbers).density(h) for c, numbers in zip(self.constituents, self.profiles, strict=True)
        ]
        return [types().Float(density) for density in found] if self._is_exact else found

    def extinctions(self, densities: list[Any]) -> list[Any]:
        """Extinction coefficient (1/m) per channel."""
        return self.optical_depths(densities)

    def largest_extinction(self, densities: list[Any]) -> Any:
        """Extinction coefficient (1/m) of the most opaque channel."""
        return _maximum(self.extinctions(densities))

    def optical_depths(self, columns: list[Any]) -> list[Any]:
        """Optical depth per channel of the column densities (m) of all constituents."""
        return [self._sum(channel, columns) for channel in range(self.channel_count)]

    def scattering_depths(self, columns: list[Any]) -> list[Any]:
        """Scattering optical depth per channel of the column densities (m) of all constituents."""
        depths = []
        for channel in range(self.channel_count):
            total = 0.0 * columns[0] if columns else 0.0
            for k in self.scatterers:
                total = dr.fma(self.scattering[k][channel], columns[k], total)
            depths.append(total)
        return depths

    def _sum(self, channel: int, amounts: list[Any]) -> Any:
        total = 0.0
        for extinction, amount in zip(self.extinction, amounts, strict=True):
            total = dr.fma(extinction[channel], amount, total)
        return total

    def phase_values(self, constituent: int, nu: Any) -> list[Any]:
        """Phase function (1/sr) of a constituent per channel at the cosine ``nu`` of the scattering angle."""
        phases, place = self._phases(constituent)
        values = [p.value(nu) for p in phases]
        return [values[i] for i in place]

    def phase_function(self, constituent: int) -> Callable[[Any], list[Any]]:
        """``phase_values`` as a function of nu for many look-ups: what does not depend on nu is computed here."""
        phases, place = self._phases(constituent)
        parts = [p.prepared() if hasattr(p, "prepared") else p.value for p in phases]

        def values(nu: Any) -> list[Any]:
            found = [part(nu) for part in parts]
            return [found[i] for i in place]

        return values

    def _phases(self, constituent: int) -> tuple[list[Any], list[int]]:
        """The phase functions that differ, and which of them is that of each channel."""
        phase = self.constituents[constituent].phase
        phases, place = _distinct([phase.at(int(i)) for i in self.indices])
        if self.asymmetry[constituent]:
            phases = [replace(p, g=g) for p, g in zip(phases, self.asymmetry[constituent], strict=True)]
        return phases, place

    def phase_table(self, degree: int) -> Any:
        """Legendre series of the phase functions up to ``degree`` at the cosines of ``phase_node``: table [node,
        scatterer x channel], between which the light of order 1 interpolates linearly."""
        if degree in self.phase_tables:
            return self.phase_tables[degree]
        return table(self._phase_series(self.atmosphere, degree))

    def _phase_series(self, atmosphere: Atmosphere, degree: int) -> np.ndarray:
        return _phase_series(self._phases_of(atmosphere), degree)

    def phase_moments(self, degree: int) -> Any:
        """Legendre moments chi_l of the scatterers: table [l, scatterer x channel]."""
        if degree in self.moment_tables:
            return self.moment_tables[degree]
        return table(self.scatterers_moments(degree))

    def scatterers_moments(self, degree: int, atmosphere: Atmosphere | None = None) -> np.ndarray:
        """Legendre moments chi_l of the scatterers, or of those of an ``atmosphere`` like this: [l, scatterer x
        channel]."""
        return _phase_moments(self._phases_of(atmosphere or self.atmosphere), degree)

    def _phases_of(self, atmosphere: Atmosphere) -> tuple[Any, ...]:
        """The scatterers' phase functions in every channel."""
        phases = [atmosphere.constituents[k].phase for k in self.scatterers]
        alone = [phase.at(int(i)) for phase in phases for i in self.indices]
        return tuple(_of_asymmetry(type(p), float(p.g)) if hasattr(p, "g") else p for p in alone)

    @property
    def profiles_differentiable(self) -> bool:
        """Whether a density profile, or the sun's size, carries derivatives: then nothing that depends on it can be
        kept."""
        return dr.grad_enabled(self.profiles, self.sun_radius)

    @cached_property
    def breaks_m(self) -> np.ndarray:
        """Altitudes (m), ascending from 0 to the top, between which every profile is smooth and changes by a few
        e-folds at most."""
        top = self.atmosphere.thickness_m
        levels = [0.0, top]
        radius = self.atmosphere.bottom_radius_m
        kinks = {k for c in self.constituents for k in c.profile.kinks_m}
        for c in self.constituents:
            extinction = float(np.max(c.extinction_per_m))
            if isinstance(c.profile, Exponential):
                levels += _scale_height_levels(c.profile.scale_height_m, extinction, radius, top)
            else:
                kinks.update(_ramp_levels(c.profile, extinction, radius))
                kinks.update(self._under_steps(c))
        levels += kinks
        # Not np.unique: in its first call it imports all of numpy.ma.
        levels = np.array(sorted(set(np.clip(levels, 0.0, top).tolist())))
        # A scale-height level beside another break only costs time; kinks stay. How near is near depends on the level
        # alone: under a top a hundred thousand scale heights up the air at the ground is as steep as under a low one.
        kept = [0.0]
        for level in levels[1:]:
            if level in kinks or level > 1.25 * kept[-1]:
                kept.append(float(level))
        if kept[-1] != top:
            kept.append(top)
        return np.array(kept)

    def _under_steps(self, c: Any) -> list[float]:
        return _levels_under_steps(c.profile, float(np.max(c.extinction_per_m)), self.atmosphere.bottom_radius_m)

    @property
    def thinnest_m(self) -> float:
        """Scale (m) of the altitudes over which the steepest profile changes."""
        scales = [self.atmosphere.thickness_m]
        for c in self.constituents:
            if isinstance(c.profile, Exponential):
                scales.append(c.profile.scale_height_m)
            elif isinstance(c.profile, Tent):
                scales.append(c.profile.half_width_m)
            else:
                under = self._under_steps(c)
                scales += [float(c.profile.altitude_m[np.searchsorted(c.profile.altitude_m, h)]) - h for h in under]
        return min(scales)

    @cached_property
    def edge_levels_m(self) -> list[float]:
        """Altitudes (m) at which a grazing sunbeam's column is not smooth: the ground, the top, corners of tents,
        steps of tables.

        The other corners of a tabulated profile count where they are few; where they are many they are slight, and
        are left to the quadrature.
        """
        top = self.atmosphere.thickness_m
        kinks: set[float] = set()
        for profile in (c.profile for c in self.constituents):
            if isinstance(profile, Tent):
                kinks.update(profile.kinks_m)
            if isinstance(profile, Tabulated):
                kinks.update(profile.kinks_m if len(profile.kinks_m) <= FEW_CORNERS else profile.steps_m)
        return [0.0, *sorted(k for k in kinks if 0.0 < k < top), top]


def _scale_height_levels(height: float, extinction: float, radius: float, top: float) -> list[float]:
    """Altitudes (m) at which an exponential profile is cut."""
    levels = [height * f for f in LEVELS]
    horizontal = extinction * np.sqrt(2.0 * np.pi * (radius + top) * height)
    while levels[-1] < top and horizontal * np.exp(-levels[-1] / height) > THIN:
        levels.append(levels[-1] + FURTHER * height)
    return levels


def _ramp_levels(profile: Tent | Tabulated, extinction: float, radius: float) -> list[float]:
    """Altitudes (m) between the corners of a profile at which it has fallen by a factor RAMP, again and again, as long
    as a ray through what is below that may be thick: one that grazes the thin end meets as little as it is."""
    if isinstance(profile, Tent):
        altitude, density = np.array(profile.kinks_m), np.array([0.0, 1.0, 0.0])
    else:
        altitude, density = profile.altitude_m, profile.values
    low, high = altitude[:-1], altitude[1:]
    dense, thin = np.maximum(density[:-1], density[1:]), np.minimum(density[:-1], density[1:])
    depth = 2.0 * extinction * dense * np.sqrt(np.maximum((high - low) * (2.0 * radius + low + high), 0.0))
    levels = []
    for i in np.flatnonzero((high > low) & (thin < RAMP * dense) & (RAMP * depth > THICK)):
        count = np.arange(1, 1 + int(np.log(depth[i] / THICK) / -np.log(RAMP)))
        parts = RAMP**count * dense[i]
        parts = parts[parts > thin[i]]
        at = (parts - density[i]) / (density[i + 1] - density[i])
        levels += (low[i] + at * (high[i] - low[i])).tolist()
    return levels


def phase_node(nu: Any) -> Any:
    """Where a cosine ``nu`` lies among the PHASE_NODES of Optics.phase_table, from 0 at -1 to PHASE_NODES - 1 at 1.

    Nodes are uniform in sqrt(1 - abs(nu)) on both sides, nearly in the angle: uniform in the cosine a peak of g = 0.85
    has so few that linear interpolation makes it up to a third too bright.
    """
    middle = 0.5 * (PHASE_NODES - 1)
    step = middle * dr.safe_sqrt(1.0 - dr.abs(nu))
    return dr.select(nu > 0.0, 2.0 * middle - step, step)


def _levels_under_steps(profile: Tent | Tabulated, extinction: float, radius: float) -> list[float]:
    """Altitudes (m) under the steps at which a layer ends: a low sun shines into its top alone.

    From a depth under the step at which a horizontal ray comes upon an optical depth of 1, by factors STEEPER, to that
    at which a vertical ray does: from there on the view's own optical depth cuts it.
    """
    if isinstance(profile, Tent):
        return []
    altitude, density = profile.altitude_m, np.asarray(profile.values)
    beyond = np.append(density[1:], 0.0)
    ends = np.append(np.diff(altitude) == 0.0, True) & (density > beyond)
    levels: list[float] = []
    for i in np.flatnonzero(ends & (density * extinction > 0.0)):
        top, rate = altitude[i], extinction * (density[i] - beyond[i])
        floor = altitude[i - 1] if i else 0.0
        below = 1.0 / (2.0 * (radius + top) * rate**2)
        while below * rate < 1.0 and below < 0.5 * (top - floor):
            if below > FINEST * top:
                levels.append(float(top - below))
            below *= STEEPER
    return levels


@lru_cache(maxsize=16)
def _legendre_values(degree: int) -> np.ndarray:
    """P_l at the cosines of ``phase_node``, [node, l]."""
    side = np.linspace(0.0, 1.0, PHASE_NODES // 2 + 1)[1:] ** 2
    return np.polynomial.legendre.legvander(np.concatenate([[-1.0], side - 1.0, (1.0 - side)[-2::-1], [1.0]]), degree)


def _maximum(values: list[Any]) -> Any:
    largest = values[0]
    for value in values[1:]:
        largest = dr.maximum(largest, value)
    return largest


def on_device(numbers: Any) -> Any:
    """Optics.numbers as what kernels read from memory."""
    if isinstance(numbers, dict):
        return {key: on_device(part) for key, part in numbers.items()}
    if isinstance(numbers, list):
        return [on_device(part) for part in numbers]
    if isinstance(numbers, np.ndarray):
        return floats(numbers) if numbers.ndim == 1 else table(numbers)
    return parameter(numbers)


def _numbers_of(profile: Any) -> list[Any]:
    """The numbers that a profile is made from."""
    if isinstance(profile, Tabulated):
        return [profile.altitude_m, profile.values]
    return [getattr(profile, f.name) for f in fields(profile)]


@lru_cache(maxsize=64)
def _of_asymmetry(kind: type, g: float) -> Any:
    """One phase function for all that are equal."""
    return kind(g)


# Kept: of the parameters by which derivatives are asked for few move a phase function.
@lru_cache(maxsize=64)
def _phase_moments(phases: tuple[Any, ...], degree: int) -> np.ndarray:
    """Legendre moments of several phase functions, [l, phase function]."""
    columns = [moments_of(phase, degree) for phase in phases]
    return np.column_stack(columns) if columns else np.zeros((degree + 1, 1))


@lru_cache(maxsize=64)
def _phase_series(phases: tuple[Any, ...], degree: int) -> np.ndarray:
    """Their Legendre series at the cosines of phase_node."""
    weights = (2.0 * np.arange(degree + 1) + 1.0) / (4.0 * np.pi)
    return _legendre_values(degree) @ (weights[:, None] * _phase_moments(phases, degree))


def _distinct(phases: list[Any]) -> tuple[list[Any], list[int]]:
    """The phase functions that differ, and which of them is that of each channel."""
    found: list[Any] = []
    for phase in phases:
        if not any(phase is other for other in found):
            found.append(phase)
    return found, [next(i for i, other in enumerate(found) if other is phase) for phase in phases]
