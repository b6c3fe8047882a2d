"""Atmospheres unlike the Earth's, as contract JSON, and views of them: what tests and benchmarks share."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np


def world(**changes: object) -> dict:
    """A planet of 1000 km under a point sun, so that no number of the Earth can hide; ``changes`` replace entries."""
    spec = {
        "wavelengths_nm": [640, 530, 450],
        "solar_irradiance": [1.5, 1.9, 2.0],
        "bottom_radius_m": 1.0e6,
        "top_radius_m": 1.05e6,
        "rayleigh": {"scattering_per_m": [7e-6, 1.5e-5, 3.2e-5], "scale_height_m": 5000},
        "mie": {
            "scattering_per_m": 2e-5,
            "single_scattering_albedo": [0.92, 0.9, 0.85],
            "scale_height_m": 1700,
            "phase": {"type": "henyey_greenstein", "g": 0.6},
        },
        "ozone": None,
        "ground_albedo": [0.3, 0.2, 0.1],
        "sun_angular_radius_deg": 0.0,
    }
    return {**spec, **changes}


_DUST = {
    "scattering_per_m": [1e-5, 1.5e-5, 2e-5, 2.5e-5, 3e-5],
    "single_scattering_albedo": 0.95,
    "scale_height_m": 2500,
    "phase": {"type": "cornette_shanks", "g": [0.6, 0.65, 0.7, 0.72, 0.75]},
}
_LAYER = {
    "scattering_per_m": 4e-5,
    "single_scattering_albedo": 0.99,
    "profile": {"altitude_m": [9000, 10000, 14000, 14000, 16000], "density": [0, 1, 0.8, 0.1, 0.1]},
    "phase": {"type": "tabulated", "cos_theta": [-1, -0.4, 0.2, 0.8, 0.95, 1], "values": [0.3, 0.1, 0.12, 0.5, 1.5, 4]},
}
_FLAT = {"profile": {"altitude_m": [0, 50000], "density": [1, 1]}}

WORLDS = {
    "small planet": world(),
    "small planet, wide sun": world(sun_angular_radius_deg=2.0),
    "one gas, one wavelength": world(
        wavelengths_nm=[550],
        solar_irradiance=1,
        rayleigh={"scattering_per_m": 2e-5, "scale_height_m": 9000},
        mie=None,
        ground_albedo=0.5,
    ),
    "uniform density": world(rayleigh={"scattering_per_m": [2e-7, 5e-7, 1e-6], **_FLAT}, mie=None),
    "two aerosols, five wavelengths": world(
        wavelengths_nm=[680, 600, 550, 500, 440],
        solar_irradiance=[1.4, 1.7, 1.85, 1.9, 1.9],
        rayleigh={"scattering_per_m": [6e-6, 9e-6, 1.3e-5, 2e-5, 3.3e-5], "scale_height_m": 7000},
        mie=[_DUST, _LAYER],
        ozone={"absorption_per_m": [1e-6, 2e-6, 1.8e-6, 8e-7, 1e-7], "center_m": 22000, "half_width_m": 9000},
        ground_albedo=0.2,
    ),
    "tabulated aerosol alone": world(rayleigh=None, mie=_LAYER),
    "phase by moments": world(
        mie={
            "scattering_per_m": 3e-5,
            "single_scattering_albedo": 0.97,
            "scale_height_m": 1500,
            "phase": {"type": "legendre", "moments": [1, 0.4, 0.2, 0.05]},
        },
    ),
}
"""Atmospheres unlike the Earth's, as contract JSON: profiles, phase functions, numbers of wavelengths and species."""


def views_of(spec: Mapping, count: int = 40, seed: int = 0) -> dict[str, np.ndarray]:
    """Views of a world in six groups of ``count``: three suns, observers on the ground, aloft and in space."""
    rng = np.random.default_rng(seed)
    top = spec["top_radius_m"] - spec["bottom_radius_m"]
    suns, heights = np.repeat([25.0, 70.0, 93.0], 2), np.array([2.0, 0.1 * top, 1.0, 1.5 * top, 0.0, 0.3 * top])
    return {
        "altitude_m": np.repeat(heights, count),
        "sun_zenith_deg": np.repeat(suns, count),
        "view_zenith_deg": np.degrees(np.arccos(rng.uniform(-1, 1, 6 * count))),
        "azimuth_deg": rng.uniform(0, 360, 6 * count),
    }
