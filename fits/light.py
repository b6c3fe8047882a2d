"""Radiance of a list of rays as one recorded function of the atmosphere's values.

A fit asks for the same rays again and again, of skies that differ by numbers only. Here everything else is settled
once: nodes, resolution, and the shares in which the orders of scattering count (``Sky.again``). Solve and march
then are one recording (recording.py), which takes a tenth of the time that tracing its kernels takes.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from atmo_jit.atmosphere import Atmosphere
from atmo_jit.backend import doubles, floats
from atmo_jit.march import NODES, Shells
from atmo_jit.optics import MAX_CHANNELS, on_device
from atmo_jit.recording import Recordings
from atmo_jit.remainder import joined, parted
from atmo_jit.solved import Sky


class RayLight:
    """Radiance of rays for several atmospheres side by side that are close to that of ``sky``: same wavelengths,
    profiles and kinds of particles, optical depths within a factor of two.

    ``side_by_side``: an atmosphere with wavelength ``channels`` [C] of that of ``sky`` at its C wavelengths.
    ``altitude_m``, ``view_zenith`` [N], radians; ``sun_zenith`` and ``azimuth`` [N]: where the sun is first looked for.
    """

    def __init__(
        self,
        sky: Sky,
        side_by_side: Atmosphere,
        channels: np.ndarray,
        altitude_m: np.ndarray,
        view_zenith: np.ndarray,
        sun_zenith: np.ndarray,
        azimuth: np.ndarray,
    ) -> None:
        self._resolution, self._rays = sky.resolution, (altitude_m, sun_zenith, view_zenith, azimuth)
        self._one_of, self._which = _distinct(*self._rays)
        self._shares = _shares(sky, channels)
        kinds = [band.optics.phase_kinds for band in sky.solutions]
        make_up = sky.solutions[0].optics.make_up
        self._recorded = None not in kinds
        grid, key = sky.grid, (len(channels), *map(_sizes, self._shares), make_up, kinds[0])
        grid.kept("shells of fits", lambda: _shells(sky))

        def made() -> Any:
            same = len(channels) == len(sky.atmosphere.wavelengths_nm)
            several = sky if same else Sky(side_by_side, None, sky.tolerance, sky.resolution, sky.suns, sky.layout)
            return Recordings(grid), several.unlit(), [band.optics for band in several.solutions]

        self._recordings, self._sky, self._optics = grid.kept(("rays of fits", *key), made)

    def __call__(self, air: Atmosphere, sun_zenith: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
        """Radiance [N, C] for an atmosphere like ``side_by_side``, and angles [N] (radians) of the sun and of the view
        from it."""
        degrees = self._resolution.degrees, self._resolution.phase_degree
        values = [on_device(optics.numbers(air, *degrees)) for optics in self._optics]
        altitude_m, first_sun, view_zenith, first_azimuth = self._rays
        views, which = (altitude_m, sun_zenith, view_zenith, azimuth), slice(None)
        if np.array_equal(sun_zenith, first_sun) and np.array_equal(azimuth, first_azimuth):
            views, which = [v[self._one_of] for v in views], self._which
        arguments = values, self._shares, [doubles(v) for v in views]
        if self._recorded:  # of other numbers of rays there are other recordings
            light = self._recordings.run(len(views[0]), self._light, *arguments, prepare=self._solved)
        else:
            light = self._light(*arguments)
        return np.stack([v.numpy() for v in light], axis=-1).astype(float)[which]

    def _light(self, values: list[Any], shares: list[Any], views: list[Any]) -> list[Any]:
        """Radiance, Floats [N], of optics' values, shares of the orders, and the arguments of Sky.rays."""
        sky = self._solved(values, shares)
        shells = sky.grid.kept("shells of fits", lambda: _shells(sky))
        return [v + 0.0 for v in sky.rays(*views, shells=shells).radiance]

    def _solved(self, values: list[Any], shares: list[Any], *_: Any) -> Sky:
        sky = self._sky.again(values, shares)
        for band in sky.solutions:
            band.field.prepare()
        return sky


def _distinct(
    altitude_m: np.ndarray, sun_zenith: np.ndarray, view_zenith: np.ndarray, azimuth: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rays that see different skies, and which of them is every ray: the sky is the same on both sides of the sun."""
    turn = np.abs((azimuth + np.pi) % (2.0 * np.pi) - np.pi)
    rays = np.column_stack([altitude_m, np.round(np.column_stack([sun_zenith, view_zenith, turn]), 9)])
    order = np.lexsort(rays.T)
    new = np.append(True, np.any(np.diff(rays[order], axis=0) != 0.0, axis=1))
    which = np.empty(len(rays), int)
    which[order] = np.cumsum(new) - 1
    return order[new], which


def _shares(sky: Sky, channels: np.ndarray) -> list[Any]:
    """Shares of the orders (Field.shares) of a sky, of some of its wavelengths in bands; 0 for orders that were not
    solved at all wavelengths."""
    bands = [(band.optics.indices, *parted(band.field.shares)) for band in sky.solutions]
    most = max(len(counts) - (tail is not None) for _, counts, tail in bands)
    table = np.zeros((most + 1, 2, sky.grid.shape[1], len(sky.atmosphere.wavelengths_nm)), np.float32)
    tails: list[Any] = [None] * table.shape[-1]
    for indices, counts, tail in bands:
        for n, both in enumerate(counts):
            at = most if tail is not None and n == len(counts) - 1 else n
            for i, share in enumerate(both):
                table[at, i][:, indices] = share.numpy().reshape(-1, len(indices))
        for place, index in enumerate(indices):
            tails[index] = tail, place, len(indices)
    made = []
    for i in range(0, len(channels), MAX_CHANNELS):
        some = channels[i : i + MAX_CHANNELS]
        shares: list[Any] = [[floats(share) for share in both] for both in table[..., some]]
        parts = [tails[c] for c in some]
        last = shares.pop()
        if any(tail for tail, _, _ in parts):
            shares.append({**joined(parts), "shares": last})
        made.append(shares)
    return made


def _sizes(shares: list[Any]) -> tuple[int, int]:
    """How many orders are counted, and how many turns the remainder takes."""
    tail = parted(shares)[1]
    return len(shares), len(tail["turns"]) if tail else 0


def _shells(sky: Sky) -> Shells:
    """Those of the most opaque atmosphere on the nodes."""
    optics = sky.solutions[0].optics
    at, under = (sky.grid.extinction_bound(optics.breaks_m * share) for share in (1.0, 1.0 - 1e-6))
    shells = Shells(optics, np.maximum(at[:-1], under[1:]))
    shells.rule(NODES)
    return shells
