"""What a sky depends on, by name, and how the values that kernels read follow from it.

Everything between an atmosphere's description and the kernels (extinction from scattering and single-scattering
albedo, phase moments from g, ...) is a few hundred numbers in double precision: their derivatives are differences of
those numbers, exact far beyond the single precision of the kernels.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from ._trees import flat
from .atmosphere import Atmosphere
from .errors import AtmosphereError, InputError
from .optics import Optics

VIEWS = ("altitude_m", "sun_zenith_deg", "view_zenith_deg", "azimuth_deg", "distance_m")
RADII = ("bottom_radius_m", "top_radius_m")
_FIXED = ("wavelengths_nm", "cos_theta", "values", "moments")
STEP = 1e-5  # relative


def parameter_names(atmosphere: Atmosphere, views: Collection[str] = VIEWS) -> tuple[str, ...]:
    """The names of everything continuous that a sky depends on: of the atmosphere first, then of the ``views`` that are
    given."""
    own = (name for name in atmosphere.names() if name.rpartition(".")[2] not in _FIXED)
    return (*own, *(name for name in VIEWS if name in views))


def check_names(atmosphere: Atmosphere, names: Sequence[str], views: Collection[str] = VIEWS) -> tuple[str, ...]:
    """The names, each once. Raises InputError for one that is unknown."""
    allowed = parameter_names(atmosphere, views)
    if isinstance(names, str):
        names = [names]
    for name in names:
        if name not in allowed:
            raise InputError(f"gradient: {name!r} is no parameter; allowed are {', '.join(allowed)}")
    return tuple(dict.fromkeys(names))


def described(atmosphere: Atmosphere, name: str) -> float | np.ndarray:
    """The value of a name as the description has it: one number that stands for all wavelengths stays one number."""
    value = atmosphere.given(name)
    return np.array(value, dtype=np.float64) if isinstance(value, list) else float(value)


def per_wavelength(atmosphere: Atmosphere, name: str) -> bool:
    """Whether a name stands for a list with one number per wavelength."""
    return name not in VIEWS and ".profile." not in name and isinstance(described(atmosphere, name), np.ndarray)


def directions(atmosphere: Atmosphere, name: str) -> list[np.ndarray | float]:
    """Steps of a parameter that give all there is to know: one for a number, one for a list per wavelength (no
    wavelength knows of another), one per node of a profile."""
    value = described(atmosphere, name)
    if isinstance(value, float):
        return [1.0]
    return list(np.eye(len(value))) if ".profile." in name else [np.ones_like(value)]


def moved(atmosphere: Atmosphere, name: str, direction: float | np.ndarray) -> tuple[Atmosphere, Atmosphere, float]:
    """The atmosphere a little before and after, along ``direction``, and how far apart they are; on one side where
    the parameter is at the end of its range."""
    value = described(atmosphere, name)
    largest = float(np.max(np.abs(value)))
    step = STEP * (largest if largest > 0.0 else 1e-5 if name.endswith("_per_m") else 1.0)
    step /= float(np.max(np.abs(direction))) or 1.0
    ends = []
    for sign in (-1.0, 1.0):
        try:
            new = value + sign * step * np.asarray(direction)
            ends.append((sign * step, atmosphere.replace({name: new.tolist()})))
        except AtmosphereError:
            ends.append((0.0, atmosphere))
    (low, before), (high, after) = ends
    return before, after, high - low


def tangent(
    optics: Optics, name: str, direction: float | np.ndarray, degrees: tuple[int, ...], phase_degree: int
) -> list[np.ndarray]:
    """Derivative of Optics.numbers along ``direction`` of a parameter, as a list of leaves, numbers and arrays.

    Where the list cannot be moved as a whole, one of its numbers being at the lower end of its range and another at the
    upper, each is moved by itself; one that can be moved neither way, a corner of a step on the ground, has none.
    """
    before, after, apart = moved(optics.atmosphere, name, direction)
    if apart == 0.0:
        along = np.broadcast_to(np.asarray(direction, float), np.shape(described(optics.atmosphere, name)))
        singles = [part for part in np.diag(along.ravel()) if np.any(part)] if along.ndim and along.size > 1 else []
        if len(singles) > 1:
            parts = [tangent(optics, name, part, degrees, phase_degree) for part in singles]
            return [sum(leaves) for leaves in zip(*parts, strict=True)]
        apart = 1.0  # between two atmospheres that are the same
    low, high = (flat(optics.numbers(air, degrees, phase_degree)) for air in (before, after))
    return [(b - a) / apart for a, b in zip(low, high, strict=True)]


def replaced(
    air: Atmosphere, views: Mapping[str, Any], parameters: Mapping[str, Any]
) -> tuple[Atmosphere, dict[str, Any]]:
    """Atmosphere and views with other values of parameters."""
    views = dict(views)
    changes = {}
    for name in check_names(air, tuple(parameters)):
        value = np.array(parameters[name], dtype=np.float64).ravel()
        if name in VIEWS:
            views[name] = value if len(value) > 1 else float(value[0])
        elif np.ndim(described(air, name)):
            changes[name] = value.tolist() if len(value) > 1 else np.full(np.shape(described(air, name)), value[0])
        else:
            changes[name] = value.tolist() if len(value) > 1 else float(value[0])
    return air.replace(changes) if changes else air, views
