"""Density profiles: how much of a constituent there is at altitude h, relative to its coefficients.

``density(h)`` is dimensionless and multiplies the per-metre coefficients of a
:class:`~atmo_jit.atmosphere.Constituent`. ``h`` is the altitude above the ground in metres: a float, a NumPy array of
any shape or a Dr.Jit array; the result has its shape and type. ``kinks_m`` are the altitudes where the profile is not
smooth: quadratures must be split there.

>>> from atmo_jit.profile import Exponential
>>> float(Exponential(8000.0).density(0.0))
1.0
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ._arrays import asarray, is_drjit, module_of, piecewise_linear
from ._fields import LENGTH, Range, mapping, number, numbers, one_of
from .errors import AtmosphereError, within

ALTITUDE = Range(0, LENGTH.high)
LOWEST_M = 1e-9  # above 0: slopes of a density between 0 and 1e-300 m are infinite
# Relative, or molecules per cubic metre beside cross sections.
DENSITY = Range(0, 1e30)

@dataclass(frozen=True)
class Exponential:
    """``exp(-h / scale_height_m)``. A Dr.Jit ``scale_height_m`` is taken as it is (it may carry a gradient)."""

    scale_height_m: float
    kinks_m: ClassVar[tuple[float, ...]] = ()

    def __post_init__(self) -> None:
        _check(self, "scale_height_m", LENGTH)

    def density(self, h: Any) -> Any:
        """Relative density at altitude ``h`` (m)."""
        return module_of(h, self.scale_height_m).exp(-asarray(h) / self.scale_height_m)

    def to_dict(self) -> dict[str, Any]:
        """The keys of this profile in a constituent's JSON object."""
        return {"scale_height_m": self.scale_height_m}


@dataclass(frozen=True)
class Tent:
    """``max(0, 1 - |h - center_m| / half_width_m)``: the ozone layer of Bruneton 2017.

    Dr.Jit parameters are taken as they are.
    """

    center_m: float
    half_width_m: float

    def __post_init__(self) -> None:
        _check(self, "center_m", ALTITUDE)
        _check(self, "half_width_m", LENGTH)

    @property
    def kinks_m(self) -> tuple[float, ...]:
        """The foot, the top and the other foot of the tent (m)."""
        return (self.center_m - self.half_width_m, self.center_m, self.center_m + self.half_width_m)

    def density(self, h: Any) -> Any:
        """Relative density at altitude ``h`` (m)."""
        xp = module_of(h, self.center_m, self.half_width_m)
        return xp.maximum(0.0, 1.0 - xp.abs(asarray(h) - self.center_m) / self.half_width_m)

    def to_dict(self) -> dict[str, Any]:
        """The keys of this profile in a constituent's JSON object."""
        return {"center_m": self.center_m, "half_width_m": self.half_width_m}


class Tabulated:
    """Linear between samples, held below the first altitude, 0 above the last.

    An altitude given twice is a step, and the second of its values holds at that altitude.

    ``altitude_m`` (m, ascending, >= 0) and ``density`` (dimensionless, >= 0) are lists of one length; they are kept
    as read-only float64 arrays in ``altitude_m`` and ``values``. Dr.Jit arrays are taken as they are.
    """

    def __init__(self, altitude_m: Any, density: Any) -> None:
        if is_drjit(altitude_m):
            self.altitude_m, self.values = altitude_m, density
            return
        altitude = numbers(altitude_m, "altitude_m", ALTITUDE)
        values = numbers(density, "density", DENSITY)
        if len(altitude) != len(values):
            allowed = f"as many numbers as altitude_m has ({len(altitude)})"
            raise AtmosphereError("density", f"a list of {len(values)}", allowed)
        for i in np.flatnonzero((altitude > 0.0) & (altitude < LOWEST_M)):
            raise AtmosphereError(f"altitude_m[{i}]", f"{altitude[i]:g}", f"0 or a number from {LOWEST_M:g} on")
        for i in range(1, len(altitude)):
            thrice = i > 1 and altitude[i] == altitude[i - 2]
            if altitude[i] < altitude[i - 1] or thrice:
                found = f"{altitude[i]:g} after {altitude[i - 1]:g}" + (" for the third time" if thrice else "")
                allowed = "ascending altitudes, each at most twice (a step)"
                raise AtmosphereError(f"altitude_m[{i}]", found, allowed)
        altitude.flags.writeable = values.flags.writeable = False
        self.altitude_m, self.values = altitude, values

    @property
    def kinks_m(self) -> tuple[float, ...]:
        """Every altitude of the table, once (m)."""
        return tuple(float(h) for h in np.unique(self.altitude_m))

    @property
    def steps_m(self) -> tuple[float, ...]:
        """The altitudes at which the density jumps (m): those given twice, and the last unless density is 0 there."""
        twice = self.altitude_m[1:][np.diff(self.altitude_m) == 0.0].tolist()
        return (*twice, *([float(self.altitude_m[-1])] if self.values[-1] > 0.0 else []))

    def density(self, h: Any) -> Any:
        """Relative density at altitude ``h`` (m)."""
        inside = piecewise_linear(h, self.altitude_m, self.values)
        if is_drjit(h):
            dr, altitude = module_of(h), self.altitude_m
            top = dr.gather(type(h), altitude, len(altitude) - 1) if is_drjit(altitude) else float(altitude[-1])
            return dr.select(h > top, 0, inside)
        return np.where(np.asarray(h) > float(self.altitude_m[-1]), 0.0, inside)

    def to_dict(self) -> dict[str, Any]:
        """The keys of this profile in a constituent's JSON object."""
        return {"profile": {"altitude_m": self.altitude_m.tolist(), "density": self.values.tolist()}}


Profile = Exponential | Tent | Tabulated


def profile_from_dict(constituent: Mapping[str, Any], *analytic: str) -> Profile:
    """The profile of a constituent's JSON object, given by ``profile`` or by its ``analytic`` keys.

    Those are ``scale_height_m``, or ``center_m`` with ``half_width_m``.

    Raises :class:`~atmo_jit.errors.AtmosphereError` naming the field below the constituent.
    """
    keys = one_of(constituent, analytic, ("profile",))
    if "scale_height_m" in keys:
        return Exponential(constituent["scale_height_m"])
    if "center_m" in keys:
        return Tent(constituent["center_m"], constituent["half_width_m"])
    table = mapping(constituent["profile"], "profile", ("altitude_m", "density"))
    with within("profile"):
        return Tabulated(table["altitude_m"], table["density"])


def _check(profile: Any, name: str, allowed: Any) -> None:
    value = getattr(profile, name)
    if not is_drjit(value):
        object.__setattr__(profile, name, number(value, name, allowed))
