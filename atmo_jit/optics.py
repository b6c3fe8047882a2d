"""An atmosphere as kernels see it: at most four wavelengths ("channels") with every value a Dr.Jit parameter.

Kernels never see NumPy or JSON: they ask an :class:`Optics` for densities, phase functions and coefficients. Values
are opaque to the compiler, so that another atmosphere of the same make-up reuses the compiled kernels.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from copy import copy
from dataclasses import fields, replace
from functools import cached_property
from typing import Any

import drjit as dr
import numpy as np

from . import levels
from ._trees import flat, like
from .atmosphere import Atmosphere
from .backend import doubles, floats, parameter, spread, table, types
from .phase import CornetteShanks, HenyeyGreenstein, RayleighPhase
from .phase_series import distinct, of_asymmetry, phase_moments, phase_series
from .profile import Exponential, Tabulated

MAX_CHANNELS = 4  # one 128-bit packet: wavelengths share every gather of geometry and sun angle
# Altitudes in single precision are rounded by ROUNDING of themselves; an error of UNSEEN of an optical depth is small.
ROUNDING, UNSEEN, SELDOM = 6e-8, 1e-5, 0.01
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
        phases = [distinct([c.phase.at(int(j)) for j in i] if c.phase else [])[0] for c in parts]
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
            scatterers = self._phases_of(atmosphere)
            made["phase_tables"] = {phase_degree: phase_series(scatterers, phase_degree)}
            made["moment_tables"] = {degree: phase_moments(scatterers, degree) for degree in degrees}
        return made

    def channels(self, numbers: dict[str, Any]) -> list[int | None]:
        """Which channel each leaf of ``numbers`` belongs to; None: to none, or to all, as a table does."""
        return _channels(numbers, self.channel_count)

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
    def planet(self) -> tuple[Any, Any]:
        """Radius and thickness (m) in double precision, whatever that of these optics."""
        t, air = types().Float64, self.atmosphere
        return dr.opaque(t, air.bottom_radius_m, 1), dr.opaque(t, air.thickness_m, 1)

    @cached_property
    def exact(self) -> Optics | None:
        """These optics with altitudes in double precision, for rays that are too (a tenth slower); None where the
        rounding of altitudes in single precision is not seen."""
        if max((self._rounded(c) for c in self.constituents), default=0.0) < UNSEEN:
            return None
        t = types().Float64
        other = self.with_values({})
        other._is_exact = True
        other.radius, other.thickness = self.planet
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
        """Phase function (1/sr) of a constituent per channel at the cosine ``nu`` of the scattering angle; peaks in the
        precision of that: rounded to 6e-8, it moves that of g = 0.99 by 1e-3."""
        t = types()
        phases, place = self._phases(constituent)
        values = [t.Float(p.value(nu if hasattr(p, "g") else t.Float(nu))) for p in phases]
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
        phases, place = distinct([phase.at(int(i)) for i in self.indices])
        if self.asymmetry[constituent]:
            phases = [replace(p, g=g) for p, g in zip(phases, self.asymmetry[constituent], strict=True)]
        return phases, place

    def phase_table(self, degree: int) -> Any:
        """Legendre series of the phase functions up to ``degree`` at the cosines of ``phase_node``: table [node,
        scatterer x channel], between which the light of order 1 interpolates linearly."""
        if degree in self.phase_tables:
            return self.phase_tables[degree]
        return table(phase_series(self._phases_of(self.atmosphere), degree))

    def phase_moments(self, degree: int) -> Any:
        """Legendre moments chi_l of the scatterers: table [l, scatterer x channel]."""
        if degree in self.moment_tables:
            return self.moment_tables[degree]
        return table(self.scatterers_moments(degree))

    def scatterers_moments(self, degree: int) -> np.ndarray:
        """Legendre moments chi_l of the scatterers: [l, scatterer x channel]."""
        return phase_moments(self._phases_of(self.atmosphere), degree)

    def _phases_of(self, atmosphere: Atmosphere) -> tuple[Any, ...]:
        """The scatterers' phase functions in every channel."""
        phases = [atmosphere.constituents[k].phase for k in self.scatterers]
        alone = [phase.at(int(i)) for phase in phases for i in self.indices]
        return tuple(of_asymmetry(type(p), float(p.g)) if hasattr(p, "g") else p for p in alone)

    @property
    def profiles_differentiable(self) -> bool:
        """Whether a density profile, or the sun's size, carries derivatives: then nothing that depends on it can be
        kept."""
        return dr.grad_enabled(self.profiles, self.sun_radius)

    @cached_property
    def breaks_m(self) -> np.ndarray:
        """Altitudes (m) at which rays are cut (levels.breaks)."""
        return levels.breaks(self.atmosphere)


def _channels(part: Any, count: int) -> list[int | None]:
    if isinstance(part, dict):
        return [channel for inner in part.values() for channel in _channels(inner, count)]
    if not isinstance(part, list):
        return [None]
    if part and isinstance(part[0], list):
        return [channel for inner in part for channel in _channels(inner, count)]
    return list(range(len(part))) if len(part) == count else [None] * len(part)


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
