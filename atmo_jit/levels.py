"""Altitudes at which rays and tables are cut: where profiles have corners, and between them often enough that all is
smooth there."""

from __future__ import annotations

from typing import Any

import numpy as np

from .atmosphere import Atmosphere, Constituent
from .profile import Exponential, Tabulated, Tent

FEW_CORNERS = 8
MOST_LEVELS = 2000  # beyond which rays are cut at the corners of profiles alone
# Scale heights at which rays are cut: the field is asked once between two cuts.
LEVELS = (0.5, 1.0, 1.75, 2.5, 3.75, 5.0, 9.0, 13.0, 17.0)
# In fog, more: as long as a horizontal ray there has this optical depth.
FURTHER, THIN = 4.0, 0.05
# And where nothing else scatters, as long as anything does: this horizontal optical depth, and share of what scatters.
NOTHING, ALONE = 1e-9, 0.1
RAMP, THICK = 0.25, 4.0
# The sun rises out of fog while a beam that grazes it has these optical depths: sudden where fog is so thin, of radii.
DUSK, SUDDEN = (20.0, 5.0, 1.25, 0.3, 0.07, 0.015), 1.5e-4
# While the sun's centre is down its light grazes the ground, and near that changes as the root of the altitude.
NEAR_GROUND = (0.004, 0.02, 0.1)  # scale heights
STEEPER = 4.0
FINEST = 3e-6  # of an altitude: shells, which are divided on, are no thinner in single precision


def breaks(atmosphere: Atmosphere) -> np.ndarray:
    """Altitudes (m), ascending from 0 to the top, between which every profile is smooth and changes by a few e-folds at
    most."""
    top = atmosphere.thickness_m
    levels = [0.0, top]
    radius = atmosphere.bottom_radius_m
    kinks = {k for c in atmosphere.constituents for k in c.profile.kinks_m}
    finer: set[float] = set()
    for c in atmosphere.constituents:
        extinction = float(np.max(c.extinction_per_m))
        if isinstance(c.profile, Exponential):
            levels += _scale_height_levels(c.profile.scale_height_m, extinction, radius, top)
            levels += _levels_above(atmosphere, c, levels[-1])
            if atmosphere.sun_angular_radius_deg > 0.0 and _grazing(atmosphere, c) > DUSK[2]:
                levels += [part * c.profile.scale_height_m for part in NEAR_GROUND]
        else:
            finer.update(_ramp_levels(c.profile, extinction, radius))
            finer.update(_under_steps(c, radius))
    if len(kinks) + len(finer) <= MOST_LEVELS:
        kinks |= finer
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


def thinnest(atmosphere: Atmosphere) -> float:
    """Scale (m) of the altitudes over which the steepest profile changes."""
    scales = [atmosphere.thickness_m]
    for c in atmosphere.constituents:
        if isinstance(c.profile, Exponential):
            scales.append(c.profile.scale_height_m)
        elif isinstance(c.profile, Tent):
            scales.append(c.profile.half_width_m)
        else:
            under = _under_steps(c, atmosphere.bottom_radius_m)
            scales += [float(c.profile.altitude_m[np.searchsorted(c.profile.altitude_m, h)]) - h for h in under]
    return min(scales)


def corners(atmosphere: Atmosphere) -> list[float]:
    """Altitudes (m) at which a grazing sunbeam's column is not smooth: the ground, the top, corners of tents, steps of
    tables.

    The other corners of a tabulated profile count where they are few; where they are many they are slight, and are left
    to the quadrature.
    """
    top = atmosphere.thickness_m
    kinks: set[float] = set()
    for profile in (c.profile for c in atmosphere.constituents):
        if isinstance(profile, Tent):
            kinks.update(profile.kinks_m)
        if isinstance(profile, Tabulated):
            kinks.update(profile.kinks_m if len(profile.kinks_m) <= FEW_CORNERS else profile.steps_m)
    return [0.0, *sorted(k for k in kinks if 0.0 < k < top), top]


def dusk(atmosphere: Atmosphere) -> list[float]:
    """Altitudes (m) of the perigees of sunbeams between which their light changes smoothly, where fog that is thin
    beside the planet hides the sun before the ground does."""
    levels: set[float] = set()
    for c in atmosphere.constituents:
        grazing = _grazing(atmosphere, c)
        levels.update(c.profile.scale_height_m * float(np.log(grazing / depth)) for depth in DUSK if grazing > depth)
    return sorted(level for level in levels if level < atmosphere.thickness_m)


def _grazing(atmosphere: Atmosphere, c: Constituent) -> float:
    """Optical depth of a beam that grazes the ground through fog that is thin beside the planet; 0 of anything else."""
    radius = atmosphere.bottom_radius_m
    if not isinstance(c.profile, Exponential) or c.profile.scale_height_m > SUDDEN * radius:
        return 0.0
    return float(np.max(c.extinction_per_m) * np.sqrt(2.0 * np.pi * radius * c.profile.scale_height_m))


def has_steps(atmosphere: Atmosphere) -> bool:
    """Whether a density jumps anywhere in the air."""
    tables = (c.profile for c in atmosphere.constituents if isinstance(c.profile, Tabulated))
    return any(step < atmosphere.thickness_m for profile in tables for step in profile.steps_m)


def _scale_height_levels(height: float, extinction: float, radius: float, top: float) -> list[float]:
    """Altitudes (m) at which an exponential profile is cut."""
    levels = [height * f for f in LEVELS]
    horizontal = extinction * np.sqrt(2.0 * np.pi * (radius + top) * height)
    while levels[-1] < top and horizontal * np.exp(-levels[-1] / height) > THIN:
        levels.append(levels[-1] + FURTHER * height)
    return levels


def _levels_above(atmosphere: Atmosphere, c: Constituent, level: float) -> list[float]:
    """Altitudes (m) beyond the ``level`` up to which an exponential profile is cut, for views of what is left there."""
    scattering, height = float(np.max(c.scattering_per_m)), c.profile.scale_height_m
    horizontal = np.sqrt(2.0 * np.pi * (atmosphere.bottom_radius_m + atmosphere.thickness_m) * height)
    levels: list[float] = []
    while level < atmosphere.thickness_m:
        own = scattering * np.exp(-level / height)
        everything = sum(float(np.max(o.scattering_per_m) * o.profile.density(level)) for o in atmosphere.constituents)
        if horizontal * own < NOTHING or own < ALONE * everything:
            break
        level += FURTHER * height
        levels.append(level)
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


def _under_steps(c: Any, radius: float) -> list[float]:
    return _levels_under_steps(c.profile, float(np.max(c.extinction_per_m)), radius)


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
