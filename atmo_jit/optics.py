"""An atmosphere as kernels see it: at most four wavelengths ("channels") with every value a Dr.Jit parameter.

Kernels never see NumPy or JSON: they ask an :class:`Optics` for densities, phase functions and coefficients. Values are opaque to the
compiler, so that another atmosphere of the same make-up reuses the compiled kernels.
"""

from __future__ import annotations

from dataclasses import fields, replace
from functools import cached_property
from typing import Any

import drjit as dr
import numpy as np

from .atmosphere import Atmosphere, Constituent
from .backend import channels, floats, parameter, types
from .profile import Exponential, Tabulated, Tent

MAX_CHANNELS = 4  # one 128-bit packet: wavelengths share every gather of geometry and sun angle


class Optics:
    """Dr.Jit view of ``atmosphere`` at the wavelengths ``indices`` (at most MAX_CHANNELS of them).

    Attributes: ``radius``, ``thickness`` (m); ``solar``, ``albedo`` (lists of C Floats); ``scattering[k]``, ``extinction[k]`` (1/m) for
    constituent k; ``scatterers`` (indices of the constituents that scatter); ``sun_radius`` (angular, radians).
    """

    def __init__(self, atmosphere: Atmosphere, indices: np.ndarray) -> None:
        self.atmosphere = atmosphere
        self.channel_count = len(indices)
        self.constituents = atmosphere.constituents
        self.radius = parameter(atmosphere.bottom_radius_m)
        self.thickness = parameter(atmosphere.thickness_m)
        self.sun_radius = parameter(np.deg2rad(atmosphere.sun_angular_radius_deg))
        self.solar = channels(atmosphere.solar_irradiance[indices])
        self.albedo = channels(atmosphere.ground_albedo[indices])
        self.scattering = [channels(c.scattering_per_m[indices]) for c in self.constituents]
        self.extinction = [channels(c.extinction_per_m[indices]) for c in self.constituents]
        self.scatterers = [k for k, c in enumerate(self.constituents) if c.phase is not None and np.any(c.scattering_per_m > 0)]
        self._profiles = [_with_parameters(c.profile) for c in self.constituents]
        self._phases = [_phases(c, indices) for c in self.constituents]
        self._has_ground_light = bool(np.any(atmosphere.ground_albedo > 0))

    def densities(self, h: Any) -> list[Any]:
        """Relative density of every constituent at altitude ``h`` (m)."""
        return [profile.density(h) for profile in self._profiles]

    def largest_extinction(self, densities: list[Any]) -> Any:
        """Extinction coefficient (1/m) of the most opaque channel."""
        return _maximum([self._sum(channel, densities) for channel in range(self.channel_count)])

    def optical_depths(self, columns: list[Any]) -> list[Any]:
        """Optical depth per channel of the column densities (m) of all constituents."""
        return [self._sum(channel, columns) for channel in range(self.channel_count)]

    def _sum(self, channel: int, amounts: list[Any]) -> Any:
        total = 0.0
        for extinction, amount in zip(self.extinction, amounts, strict=True):
            total = dr.fma(extinction[channel], amount, total)
        return total

    def phase_values(self, constituent: int, nu: Any) -> list[Any]:
        """Phase function (1/sr) of a constituent per channel at the cosine ``nu`` of the scattering angle."""
        phases = self._phases[constituent]
        values = {id(p): p.value(nu) for p in phases}
        return [values[id(p)] for p in phases]

    def phase_moments(self, constituent: int, degree: int) -> list[Any]:
        """Legendre moments chi_0..chi_degree per channel: a list of C Float buffers of length degree + 1."""
        return [_as_buffer(p.moments(degree)) for p in self._phases[constituent]]

    @cached_property
    def breaks_m(self) -> np.ndarray:
        """Altitudes (m), ascending from 0 to the top, between which every profile is smooth and changes by a few e-folds at most."""
        top = self.atmosphere.thickness_m
        levels = [0.0, top]
        for c in self.constituents:
            levels += [k for k in c.profile.kinks_m]
            if isinstance(c.profile, Exponential):
                levels += [c.profile.scale_height_m * f for f in (1.0, 2.5, 5.0, 9.0)]
        levels = np.unique(np.clip(levels, 0.0, top))
        kinks = {k for c in self.constituents for k in c.profile.kinks_m}
        # A scale-height level beside another break only costs time; kinks stay.
        kept = [0.0]
        for level in levels[1:]:
            if level in kinks or level - kept[-1] > 0.25 * kept[-1] + 1e-4 * top:
                kept.append(float(level))
        if kept[-1] != top:
            kept.append(top)
        return np.array(kept)

    @cached_property
    def edge_levels_m(self) -> list[float]:
        """Altitudes (m) at which a grazing sunbeam's column is not smooth: the ground, the top and the corners of tents.

        A tabulated profile's corners are many and slight; they are left to the quadrature.
        """
        top = self.atmosphere.thickness_m
        kinks = {k for c in self.constituents if isinstance(c.profile, Tent) for k in c.profile.kinks_m}
        return [0.0, *sorted(k for k in kinks if 0.0 < k < top), top]


def _maximum(values: list[Any]) -> Any:
    largest = values[0]
    for value in values[1:]:
        largest = dr.maximum(largest, value)
    return largest


def _with_parameters(value: Any) -> Any:
    """A profile or phase function with its plain numbers made kernel parameters."""
    if isinstance(value, Tabulated):
        return value
    changes = {f.name: parameter(getattr(value, f.name)) for f in fields(value) if np.ndim(getattr(value, f.name)) == 0}
    return replace(value, **changes)


def _phases(constituent: Constituent, indices: np.ndarray) -> list[Any]:
    """One phase function per channel; the same object where channels share it."""
    if constituent.phase is None:
        return []
    phases = [constituent.phase.at(int(i)) for i in indices]
    made = {id(p): _with_parameters(p) if hasattr(p, "g") else p for p in phases}
    return [made[id(p)] for p in phases]


def _as_buffer(moments: Any) -> Any:
    """Moments, a NumPy array or a list of width-1 Floats, as one buffer."""
    if isinstance(moments, np.ndarray):
        return floats(moments)
    t = types()
    buffer = dr.zeros(t.Float, len(moments))
    for index, moment in enumerate(moments):
        dr.scatter(buffer, moment, t.UInt(index))
    return buffer
