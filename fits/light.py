"""Radiance of a list of rays as one recorded function of the atmosphere's values.

A fit asks for the same rays again and again, of skies that differ by numbers only. Here everything else is settled
once: nodes, resolution, and the shares in which the orders of scattering count (``Sky.again``). Solve and march
then are one recording (recording.py), which takes a tenth of the time that tracing its kernels takes.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from atmo_jit.atmosphere import Atmosphere
from atmo_jit.backend import doubles
from atmo_jit.march import NODES, Shells
from atmo_jit.optics import on_device
from atmo_jit.recording import Recordings
from atmo_jit.sky import Sky


class RayLight:
    """Radiance of rays in the sky of atmospheres close to ``sky``'s: same wavelengths, profiles and kinds of particles,
    optical depths within a factor of two.

    ``altitude_m``, ``view_zenith`` [N], radians.
    """

    def __init__(self, sky: Sky, altitude_m: np.ndarray, view_zenith: np.ndarray) -> None:
        self._sky, self._shares = sky, [band.field.shares for band in sky.solutions]
        self._place = doubles(altitude_m), doubles(view_zenith)
        kinds = [(band.optics.make_up, band.optics.phase_kinds) for band in sky.solutions]
        self._recorded = all(kind is not None for _, kind in kinds)
        key = ("rays of a fit", len(altitude_m), *map(len, self._shares), *kinds)
        grid = sky.grid
        grid.kept("shells of fits", lambda: _shells(sky))
        self._recordings, self._light = grid.kept(key, lambda: (Recordings(grid), _light_of(sky)))

    def __call__(self, air: Atmosphere, sun_zenith: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
        """Radiance [N, W] for an atmosphere, and angles [N] (radians) of the sun and of the view from it."""
        resolution = self._sky.resolution
        values = [
            on_device(band.optics.numbers(air, resolution.degrees, resolution.phase_degree))
            for band in self._sky.solutions
        ]
        arguments = values, self._shares, [self._place[0], doubles(sun_zenith), self._place[1], doubles(azimuth)]
        light = self._recordings.run("light", self._light, *arguments) if self._recorded else self._light(*arguments)
        return np.stack([v.numpy() for v in light], axis=-1).astype(float)


def _light_of(sky: Sky) -> Any:
    """Radiance, Floats [N], of optics' values, shares of the orders, and the arguments of Sky.rays."""

    def light(values: list[Any], shares: list[Any], views: list[Any]) -> list[Any]:
        rays = sky.again(values, shares).rays(*views, shells=sky.grid.kept("shells of fits", lambda: _shells(sky)))
        radiance = [v + 0.0 for v in rays.radiance]
        dr.eval(radiance)
        return radiance

    return light


def _shells(sky: Sky) -> Shells:
    shells = Shells(sky.solutions[0].optics)
    shells.rule(NODES)
    dr.make_opaque(shells.breaks, shells.densest)
    return shells
