"""What the viewer's sliders change of an atmosphere.

>>> from atmo_jit.atmosphere import Atmosphere
>>> from atmo_jit.viewer.controls import changed
>>> changed(Atmosphere.load("earth"), {"mie.phase.g": 0.7}).get("mie.phase.g")
0.7

Every control has one number; what it has not touched stays as the atmosphere's file says.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .._fields import FRACTION, NOT_NEGATIVE, POSITIVE, mapping, number
from ..atmosphere import Atmosphere
from ..errors import InputError
from ..export.parameters import aerosol, check_client

MU_S_MIN = -0.5  # cosine of the lowest sun of the tables
AEROSOL, ASYMMETRY, OZONE, ALBEDO = "mie.scattering_per_m", "mie.phase.g", "ozone.absorption_per_m", "ground_albedo"
NAMES = (AEROSOL, ASYMMETRY, OZONE, ALBEDO)


def check(air: Atmosphere) -> list[str]:
    """Warnings about what the tables cannot hold. Raises InputError where their picture would be wrong."""
    if not air.constituents:
        raise InputError("atmosphere: has no constituents; an empty sky needs no tables")
    return check_client(air, MU_S_MIN) + aerosol(air).warnings


def controls(air: Atmosphere) -> dict[str, float]:
    """Controls that ``air`` has, with their values: aerosol scattering (1/m) of all species together where their
    density is 1, and peak ozone absorption (1/m), both at the wavelength nearest to 550 nm; asymmetry g of the first
    species; mean ground albedo."""
    middle, found = _middle(air), {}
    total = sum(species.scattering_per_m[middle] for species in air.mie)
    if total > 0.0:
        found[AEROSOL] = float(total)
    first = _asymmetries(air)
    if first:
        found[ASYMMETRY] = float(np.mean(air.get(first[0])))
    if air.ozone is not None and air.ozone.absorption_per_m[middle] > 0.0:
        found[OZONE] = float(air.ozone.absorption_per_m[middle])
    found[ALBEDO] = float(air.ground_albedo.mean())
    return found


def changed(air: Atmosphere, values: Any) -> Atmosphere:
    """``air`` with the controls of ``values`` at these numbers: coefficients keep their ratios between wavelengths and
    species, g and the albedo become the same for all.

    Raises AtmosphereError for controls that the atmosphere does not have and for numbers that it cannot have.
    """
    there = controls(air)
    values, changes = mapping(values, "parameters", (), tuple(there)), {}
    if AEROSOL in values:
        factor = number(values[AEROSOL], AEROSOL, POSITIVE) / there[AEROSOL]
        for species in air.mie:
            changes[f"{species.name}.scattering_per_m"] = species.scattering_per_m * factor
            if f"{species.name}.absorption_per_m" in air.names():  # the single-scattering albedo stays
                changes[f"{species.name}.absorption_per_m"] = species.absorption_per_m * factor
    if ASYMMETRY in values:
        changes |= dict.fromkeys(_asymmetries(air), number(values[ASYMMETRY], ASYMMETRY))
    if OZONE in values:
        factor = number(values[OZONE], OZONE, NOT_NEGATIVE) / there[OZONE]
        changes[OZONE] = air.ozone.absorption_per_m * factor
    if ALBEDO in values:
        changes[ALBEDO] = number(values[ALBEDO], ALBEDO, FRACTION)
    return air.replace(changes)


def _middle(air: Atmosphere) -> int:
    return int(np.abs(air.wavelengths_nm - 550.0).argmin())


def _asymmetries(air: Atmosphere) -> list[str]:
    names = air.names()
    return [f"{s.name}.phase.g" for s in air.mie if f"{s.name}.phase.g" in names]
