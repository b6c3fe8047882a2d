"""SASKTRAN2 (optional extra ``peers``) on this package's atmospheres and views: discrete ordinates with a spherical
correction, single scattering exact along the true rays."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from atmo_jit.atmosphere import Atmosphere

LEVELS = 101
MOMENTS = 200  # of the phase functions in single scattering


class DiscreteOrdinates:
    """The peer at a number of ``streams`` and of sun angles, ``suns``, at which its source is solved."""

    def __init__(self, atmosphere: Any, streams: int = 16, suns: int = 1) -> None:
        self.atmosphere = Atmosphere.load(atmosphere)
        self.streams, self.suns = streams, suns

    def radiance(self, views: Mapping[str, np.ndarray]) -> np.ndarray:
        """Radiance [N, W]; one run of the peer per sun."""
        view = {name: np.asarray(values, float) for name, values in views.items()}
        result = np.empty((len(view["altitude_m"]), len(self.atmosphere.wavelengths_nm)))
        for sun in np.unique(view["sun_zenith_deg"]):
            rows = view["sun_zenith_deg"] == sun
            result[rows] = self._one_sun(float(sun), {name: values[rows] for name, values in view.items()})
        return result

    def _one_sun(self, sun: float, view: dict[str, np.ndarray]) -> np.ndarray:
        import sasktran2 as sk

        air = self.atmosphere
        config = sk.Config()
        config.multiple_scatter_source = sk.MultipleScatterSource.DiscreteOrdinates
        config.single_scatter_source = sk.SingleScatterSource.Exact
        config.num_streams, config.num_sza, config.num_threads = self.streams, self.suns, 1
        config.num_singlescatter_moments, config.delta_m_scaling = MOMENTS, True
        grid = air.thickness_m * np.linspace(0.0, 1.0, LEVELS) ** 1.5
        mu_s = np.cos(np.radians(sun))
        geometry = sk.Geometry1D(mu_s, 0.0, air.bottom_radius_m, grid)
        rays = sk.ViewingGeometry()
        for zenith, azimuth, h in zip(view["view_zenith_deg"], view["azimuth_deg"], view["altitude_m"], strict=True):
            zenith, azimuth = np.radians(zenith), np.radians(azimuth)
            rays.add_ray(sk.SolarAnglesObserverLocation(mu_s, azimuth, np.cos(zenith), h))
        order = np.argsort(air.wavelengths_nm)
        medium = sk.Atmosphere(geometry, config, wavelengths_nm=air.wavelengths_nm[order], calculate_derivatives=False)
        extinction, albedo, moments = self._matter(grid)
        medium.storage.total_extinction[:] = extinction[:, order]
        medium.storage.ssa[:] = albedo[:, order]
        medium.leg_coeff.a1[:] = moments[:, :, order]
        medium.surface.albedo[:] = air.ground_albedo[order]
        medium.mark_changed()
        found = sk.Engine(config, geometry, rays).calculate_radiance(medium)["radiance"].values[:, :, 0]
        return found.T[:, np.argsort(order)]  # the peer's first axis is the wavelength

    def _matter(self, grid: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Extinction (1/m), single-scattering albedo [levels, W] and (2 l + 1) chi_l [MOMENTS, levels, W]."""
        air, count = self.atmosphere, len(self.atmosphere.wavelengths_nm)
        extinction, scattering = np.zeros((len(grid), count)), np.zeros((len(grid), count))
        moments = np.zeros((MOMENTS, len(grid), count))
        factor = 2.0 * np.arange(MOMENTS) + 1.0
        for constituent in air.constituents:
            density = np.asarray(constituent.profile.density(grid))[:, None]
            extinction += density * constituent.extinction_per_m
            here = density * constituent.scattering_per_m
            scattering += here
            if constituent.phase is not None:
                for w in range(count):
                    chi = factor * constituent.phase.at(w).moments(MOMENTS - 1)
                    moments[:, :, w] += chi[:, None] * here[:, w]
        there = scattering > 0.0
        share = np.divide(1.0, scattering, out=np.zeros_like(scattering), where=there)
        moments *= share
        moments[0][~there] = 1.0
        albedo = np.divide(scattering, extinction, out=np.zeros_like(scattering), where=extinction > 0.0)
        return extinction, albedo, moments
