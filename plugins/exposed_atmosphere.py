"""The numbers of an atmosphere as parameters of a plugin: what ``mi.traverse`` hands out and takes back."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from atmo_jit.atmosphere import Atmosphere
from atmo_jit.parameters import parameter_names

from .exposed import array, host


class ExposedAtmosphere:
    """``atmosphere``, and ``values``: its numbers as arrays by dotted name, which :meth:`update` takes over."""

    def __init__(self, atmosphere: Atmosphere) -> None:
        self.atmosphere = atmosphere
        self.values = {name: array(atmosphere.given(name)) for name in atmosphere.names()}
        self._seen = {name: host(value) for name, value in self.values.items()}

    def traverse(self, callback: Any) -> None:
        """Hand out all numbers."""
        continuous = self.continuous()
        for name, value in self.values.items():
            free = name in continuous
            callback.put(name, value, mi.ParamFlags.Differentiable if free else mi.ParamFlags.NonDifferentiable)

    def update(self) -> bool:
        """Take over what was written since the last time; whether anything was. Raises AtmosphereError."""
        now = {name: host(value) for name, value in self.values.items()}
        changed = {name: value for name, value in now.items() if not np.array_equal(value, self._seen[name])}
        if changed:
            plain = {name: float(v[0]) if len(v) == 1 else v.tolist() for name, v in changed.items()}
            self.atmosphere = self.atmosphere.replace(plain)
            self._seen = now
        return bool(changed)

    def continuous(self) -> set[str]:
        """Names of the differentiable numbers; the sun's edge is no place for derivatives."""
        return set(parameter_names(self.atmosphere)) - {"sun_angular_radius_deg"}

    def followed(self) -> dict[str, Any]:
        """The arrays by which derivatives are wanted."""
        continuous = self.continuous()
        return {name: v for name, v in self.values.items() if name in continuous and dr.grad_enabled(v)}
