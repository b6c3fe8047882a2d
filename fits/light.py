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
from atmo_jit.backend import doubles, floats
from atmo_jit.march import NODES, Shells
from atmo_jit.optics import MAX_CHANNELS, on_device
from atmo_jit.recording import Recordings
from atmo_jit.sky import Sky


class RayLight:
    """Radiance of rays for several atmospheres side by side that are close to that of ``sky``: same wavelengths,
    profiles and kinds of particles, optical depths within a factor of two.

    ``side_by_side``: an atmosphere with wavelength ``channels`` [C] of that of ``sky`` at its C wavelengths.
    ``altitude_m``, ``view_zenith`` [N], radians.
    """

    def __init__(
        self,
        sky: Sky,
        side_by_side: Atmosphere,
        channels: np.ndarray,
        altitude_m: np.ndarray,
        view_zenith: np.ndarray,
    ) -> None:
        self._place, self._resolution = (doubles(altitude_m), doubles(view_zenith)), sky.resolution
        self._shares = _shares(sky, channels)
        kinds = [band.optics.phase_kinds for band in sky.solutions]
        make_up = sky.solutions[0].optics.make_up
        self._recorded = None not in kinds
        grid, key = sky.grid, (len(channels), len(altitude_m), len(self._shares[0]), make_up, kinds[0])
        grid.kept("shells of fits", lambda: _shells(sky))

        def made() -> Any:
            same = len(channels) == len(sky.atmosphere.wavelengths_nm)
            several = sky if same else Sky(side_by_side, None, sky.tolerance, sky.resolution, sky.suns, sky.layout)
            return Recordings(grid), _light_of(several), [band.optics for band in several.solutions]

        self._recordings, self._light, self._optics = grid.kept(("rays of fits", *key), made)

    def __call__(self, air: Atmosphere, sun_zenith: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
        """Radiance [N, C] for an atmosphere like ``side_by_side``, and angles [N] (radians) of the sun and of the view
        from it."""
        degrees = self._resolution.degrees, self._resolution.phase_degree
        values = [on_device(optics.numbers(air, *degrees)) for optics in self._optics]
        arguments = values, self._shares, [self._place[0], doubles(sun_zenith), self._place[1], doubles(azimuth)]
        light = self._recordings.run("light", self._light, *arguments) if self._recorded else self._light(*arguments)
        return np.stack([v.numpy() for v in light], axis=-1).astype(float)


def _shares(sky: Sky, channels: np.ndarray) -> list[Any]:
    """Shares of the orders (Field.shares) of a sky, of some of its wavelengths in bands; 0 for orders that were not
    solved at all wavelengths."""
    most = max(len(band.field.shares) for band in sky.solutions)
    table = np.zeros((most, 2, sky.grid.shape[1], len(sky.atmosphere.wavelengths_nm)), np.float32)
    for band in sky.solutions:
        for n, both in enumerate(band.field.shares):
            for i, share in enumerate(both):
                table[n, i][:, band.optics.indices] = share.numpy().reshape(-1, len(band.optics.indices))
    bands = [table[..., channels[i : i + MAX_CHANNELS]] for i in range(0, len(channels), MAX_CHANNELS)]
    return [[[floats(share) for share in both] for both in band] for band in bands]


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
