"""The sky of an atmosphere for a list of samples, and how it changes with the atmosphere's values.

Wavelengths do not know of each other: the radiance at one depends on the coefficients at that one only. So

    d radiance[n, w] / d parameter  =  d radiance[n, w] / d leaf[w]  *  d leaf[w] / d parameter

and one derivative by each leaf (``mie.scattering_per_m``), at all wavelengths at once, serves any number of
parameters. Here it is a difference between two skies on the same nodes; both stand side by side as wavelengths of one
atmosphere, so that they share all geometry.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from atmo_jit.atmosphere import Atmosphere
from atmo_jit.backend import doubles
from atmo_jit.optics import MAX_CHANNELS
from atmo_jit.resolution import AIR_MASS, Resolution, column_of
from atmo_jit.solved import Sky

from .light import RayLight
from .observations import Observations

# Steps of differences, relative to the value: long enough for single precision, short enough for curvature (5e-3 of a
# derivative at most, and a fit's minimum does not depend on it).
STEP = 0.005
SMALLEST = {"ground_albedo": 0.5, "g": 0.5, "single_scattering_albedo": 0.5}  # values below are stepped as these
SUNS_DEG = 5.0  # suns are solved from and to multiples of this, so that small turns keep the nodes
ROUGH = 0.2  # tolerance of the skies that derivatives and first steps are taken from: 0.2 % off, in fact
FOREIGN = 2.0  # factor of optical depth from which on an atmosphere's nodes are placed anew

Values = Mapping[str, Any]


class SkyModel:
    """Radiance of samples (``altitude_m``, ``view_zenith`` [N], radians) for changed values of ``atmosphere``.

    ``spectral``: dotted names of values per wavelength that will change; ``others``: of plain numbers (scale heights).
    ``tolerance``: of the sky. ``air_mass``: of the longest view and of the lowest sun, see :func:`air_mass`.
    """

    def __init__(
        self,
        atmosphere: Atmosphere,
        altitude_m: np.ndarray,
        view_zenith: np.ndarray,
        tolerance: float,
        spectral: tuple[str, ...],
        others: tuple[str, ...] = (),
        air_mass: float = AIR_MASS,
    ) -> None:
        self.atmosphere, self.tolerance, self.air_mass = atmosphere, tolerance, air_mass
        self.altitude_m, self.view_zenith = altitude_m, view_zenith
        self.spectral, self.others = spectral, others
        self._layout: Atmosphere | None = None
        self.layout_number = 0
        self._resolution, self._rough = Resolution(), Resolution()
        self._lights: dict[Any, RayLight] = {}
        self._skies: dict[Any, Sky] = {}

    def at(
        self, data: Observations, atmosphere: Atmosphere | None = None, tolerance: float | None = None
    ) -> SkyModel:
        """The model for other samples, other wavelengths, another tolerance; with the same nodes if neither is given.
        """
        air, tolerance = atmosphere or self.atmosphere, tolerance or self.tolerance
        kinds = self.spectral, self.others
        other = SkyModel(air, data.altitude_m, data.view_zenith, tolerance, *kinds, air_mass(data))
        if air is self.atmosphere and tolerance == self.tolerance:
            other._resolution, other._rough, other._layout = self._resolution, self._rough, self._layout
        return other

    def place(self, values: Values) -> None:
        """Choose resolution and nodes for these values; they stay, so that skies differ by their values only."""
        self._layout = self.atmosphere.replace(values)
        self._resolution = self._suited(values, self.tolerance)
        self._rough = self._suited(values, max(self.tolerance, ROUGH))
        self.layout_number += 1
        self._lights.clear()
        self._skies.clear()

    def too_coarse(self, values: Values) -> bool:
        """Whether the resolution in use was chosen for an atmosphere that asks for less than this."""
        needed, used = self._suited(values, self.tolerance), self._resolution
        return needed.first_degree > used.first_degree or needed.altitudes > used.altitudes

    def _suited(self, values: Values, tolerance: float) -> Resolution:
        return Resolution.suited(self.atmosphere.replace(values), tolerance, air_mass=self.air_mass)

    def strays(self, values: Values) -> bool:
        """Whether the nodes in use were placed for much thinner or thicker air."""
        if self._layout is None:
            return True
        here, there = (_depths(air) for air in (self.atmosphere.replace(values), self._layout))
        return bool(np.any(np.abs(np.log2(np.maximum(here, 0.02) / np.maximum(there, 0.02))) > np.log2(FOREIGN)))

    def radiance(
        self, values: Values, sun_zenith: np.ndarray, azimuth: np.ndarray, *, rough: bool = False
    ) -> np.ndarray:
        """Radiance [N, W] with the values under the dotted names of ``values`` replaced; angles in radians [N].
        ``rough``: at the resolution of derivatives."""
        return self._evaluate([values], values, sun_zenith, azimuth, rough)

    def derivatives(self, values: Values, sun_zenith: np.ndarray, azimuth: np.ndarray) -> dict[str, np.ndarray]:
        """d radiance[n, w] / d value[w] for every name of ``values``, [N, W]."""
        count = len(self.atmosphere.wavelengths_nm)
        spectral = [name for name in self.spectral if name in values]
        found = {}
        if spectral:
            steps = [self._step(name, values[name]) for name in spectral]
            stepped = [
                {**values, name: np.asarray(values[name]) + step} for name, step in zip(spectral, steps, strict=True)
            ]
            light = self._evaluate([values, *stepped], values, sun_zenith, azimuth, rough=True)
            for i, (name, step) in enumerate(zip(spectral, steps, strict=True), 1):
                found[name] = (light[:, i * count : (i + 1) * count] - light[:, :count]) / step
        for name in self.others:
            step = 4.0 * STEP * float(values[name])  # nodes move along, so both sides and farther
            ends = [
                self.radiance({**values, name: float(values[name]) + sign * step}, sun_zenith, azimuth, rough=True)
                for sign in (1.0, -1.0)
            ]
            found[name] = (ends[0] - ends[1]) / (2.0 * step)
        return found

    def turned(
        self, values: Values, turns: list[tuple[np.ndarray, np.ndarray]]
    ) -> list[np.ndarray]:
        """Radiance [N, W] at the resolution of derivatives under other suns: pairs of zenith angle and azimuth [N]."""
        zenith, azimuth = (np.concatenate(v) for v in zip(*turns, strict=True))
        return np.split(self._evaluate([values], values, zenith, azimuth, True, len(turns)), len(turns))

    @staticmethod
    def _step(name: str, value: Any) -> np.ndarray:
        """Step [W] or a number: toward the inside of the range for fractions."""
        last = name.rpartition(".")[2]
        size = np.maximum(np.abs(value), SMALLEST.get(last, 1e-9)) * STEP
        return np.where(np.asarray(value) > 0.5, -size, size) if last in SMALLEST else size

    def _channels(self, sets: int) -> np.ndarray:
        """Which of the wavelengths of several atmospheres stand side by side."""
        total = sets * len(self.atmosphere.wavelengths_nm)
        return np.minimum(np.arange(-(-total // MAX_CHANNELS) * MAX_CHANNELS), total - 1)

    def _spread(self, several: list[Values]) -> Atmosphere:
        """One atmosphere with the wavelengths of several, one after the other, and as many of the last again as fill
        the bands, so that all bands run the same kernels."""
        base = self.atmosphere
        airs = [base.replace(values) for values in several]
        index = self._channels(len(airs))
        document = airs[0].to_dict()

        def gathered(read: Any) -> list[float]:
            columns = [np.broadcast_to(read(air), base.wavelengths_nm.shape) for air in airs]
            return np.concatenate(columns)[index].tolist()

        for name in ("wavelengths_nm", "solar_irradiance", "ground_albedo"):
            document[name] = gathered(lambda air, name=name: getattr(air, name))
        for i, constituent in enumerate(base.constituents):
            part: Any = document
            for key in constituent.name.split("."):
                part = part[int(key)] if isinstance(part, list) else part[key]
            for key in ("scattering_per_m", "absorption_per_m", "single_scattering_albedo"):
                if key in part:
                    part[key] = gathered(lambda air, i=i, key=key: getattr(air.constituents[i], key))
            if "g" in part.get("phase", {}):
                part["phase"]["g"] = gathered(lambda air, i=i: air.constituents[i].phase.g)
        return Atmosphere(document)

    def _evaluate(
        self,
        several: list[Values],
        values: Values,
        sun_zenith: np.ndarray,
        azimuth: np.ndarray,
        rough: bool,
        copies: int = 1,
    ) -> np.ndarray:
        """Radiance for several sets of values side by side: [N, sets x W]; of ``copies`` of the rays one after the
        other."""
        if self._layout is None:
            self.place(values)
        resolution = self._rough if rough else self._resolution
        air = self._spread(several)
        views = [np.tile(v, copies) for v in (self.altitude_m, self.view_zenith)]
        count = len(several) * len(self.atmosphere.wavelengths_nm)
        if self.others:  # other profiles, other geometry: nothing of which could be recorded
            layout = self._layout.replace({name: values[name] for name in self.others})
            sky = self._solved(air, layout, resolution, sun_zenith)
            rays = sky.rays(*(doubles(v) for v in (views[0], sun_zenith, views[1], azimuth)))
            light = np.stack([np.broadcast_to(v.numpy(), len(azimuth)) for v in rays.radiance], axis=-1).astype(float)
        else:
            key = len(several), resolution, copies, _suns(sun_zenith)
            if key not in self._lights:
                sky = self._sky(resolution, sun_zenith)
                channels = self._channels(len(several)) % len(self.atmosphere.wavelengths_nm)
                self._lights[key] = RayLight(sky, air, channels, *views, sun_zenith, azimuth)
            light = self._lights[key](air, sun_zenith, azimuth)
        return light[:, :count]

    def _sky(self, resolution: Resolution, sun_zenith: np.ndarray) -> Sky:
        """The sky of the atmosphere that the nodes were placed for."""
        key = resolution, _suns(sun_zenith)
        if key not in self._skies:
            base = self._spread([{name: self._layout.get(name) for name in self.spectral}])
            self._skies[key] = self._solved(base, self._layout, resolution, sun_zenith)
        return self._skies[key]

    def _solved(self, air: Atmosphere, layout: Atmosphere, resolution: Resolution, sun_zenith: np.ndarray) -> Sky:
        tolerance = self.tolerance if resolution == self._resolution else ROUGH
        return Sky(air, tolerance=tolerance, resolution=resolution, suns=_suns(sun_zenith), layout=layout)


def air_mass(data: Observations) -> float:
    """That of the longest view and of the lowest sun (plane layers), as far as that tells resolutions apart."""
    lowest = min(float(np.cos(data.view_zenith).min()), float(np.cos(data.sun_zenith).min()))
    return 1.0 / max(lowest, 1.0 / AIR_MASS)


def _suns(sun_zenith: np.ndarray) -> tuple[float, float]:
    """The range of suns that is solved for."""
    ends = np.floor(np.degrees(sun_zenith.min()) / SUNS_DEG), np.ceil(np.degrees(sun_zenith.max()) / SUNS_DEG)
    return tuple(np.radians(SUNS_DEG) * v for v in ends)


def _depths(air: Atmosphere) -> np.ndarray:
    """Largest vertical optical depth of every constituent."""
    return np.array([float(np.max(c.extinction_per_m)) * column_of(air, c) for c in air.constituents])
