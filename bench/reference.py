"""The reference data sets beside the repository, as the views and atmospheres that they were computed for.

The files lie in ``../shared/reference`` (their README says how each was made); nothing is copied from them.
Everything here is plain NumPy: an atmosphere is the JSON block of the contract, views are the mapping that
``atmo_jit.sky`` takes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

FOLDER = Path(__file__).resolve().parents[1].parent / "shared" / "reference"

FLAGS = {
    "plain": 0,
    "sun at or below 90 deg": 1,
    "limb from space": 2,
    "view 88-95 deg": 4,
    "within 3 deg of sun": 8,
    "noisy reference": 16,
}
"""Groups of rays of ``sky_radiance.npz`` by the bit of ``flag`` that they carry; "plain" rays carry none."""

EARTH_EXACT = {
    "rayleigh.scattering_per_m": [1.24062e-6 * um**-4 for um in (0.68, 0.55, 0.44)],
    "ozone.absorption_per_m": [300 * 2.687e20 / 15000 * section for section in (1.209e-25, 3.5e-25, 1.582e-26)],
    "sun_angular_radius_deg": float(np.degrees(0.00935 / 2)),
}
"""Bruneton 2017's own numbers, of which the contract's ``"earth"`` shows four digits.

``single_scattering_earth.npz`` was made with these. Rounding alone moves radiance by up to 9e-5 (relative) and
transmittance by up to 9.5e-5 (absolute, one ray: 59 km, view 96 deg, 680 nm).
"""


@dataclass(frozen=True)
class Case:
    """One atmosphere of ``sky_radiance.npz``: ``rows`` index the file, ``channel`` is each row's wavelength."""

    name: str
    atmosphere: dict
    rows: np.ndarray
    channel: np.ndarray
    views: dict[str, np.ndarray]


def folder(path: str | Path | None = None) -> Path:
    """The folder of the reference data; raises FileNotFoundError where it is not beside the repository."""
    found = Path(path) if path else FOLDER
    if not (found / "sky_radiance.npz").is_file():
        raise FileNotFoundError(f"no reference data in {found}: sky_radiance.npz is missing")
    return found


def load(name: str, path: str | Path | None = None) -> dict[str, np.ndarray]:
    """All arrays of ``<name>.npz``."""
    with np.load(folder(path) / f"{name}.npz") as file:
        return {key: file[key] for key in file.files}


def grid(**axes: np.ndarray) -> tuple[tuple[int, ...], dict[str, np.ndarray]]:
    """Views on the product of axes given in order: (shape of the grid, flat views)."""
    mesh = np.meshgrid(*axes.values(), indexing="ij")
    return mesh[0].shape, {name: part.ravel() for name, part in zip(axes, mesh, strict=True)}


def single_scattering_views(data: dict[str, np.ndarray]) -> tuple[tuple[int, ...], dict[str, np.ndarray]]:
    """Views of the radiance and transmittance grids of ``single_scattering_earth.npz``."""
    return grid(
        altitude_m=data["altitude_m"],
        sun_zenith_deg=data["sun_zenith_deg"],
        view_zenith_deg=data["view_zenith_deg"],
        azimuth_deg=data["rel_azimuth_deg"],
    )


def aerial_views(data: dict[str, np.ndarray]) -> tuple[tuple[int, ...], dict[str, np.ndarray]]:
    """Views of the aerial-perspective grid of ``single_scattering_earth.npz``."""
    return grid(
        altitude_m=data["ap_altitude_m"],
        sun_zenith_deg=data["sun_zenith_deg"],
        view_zenith_deg=data["ap_view_zenith_deg"],
        azimuth_deg=data["ap_rel_azimuth_deg"],
        distance_m=data["ap_distance_m"],
    )


def irradiance_views(data: dict[str, np.ndarray]) -> tuple[tuple[int, ...], dict[str, np.ndarray]]:
    """Observers of the irradiance grid of ``single_scattering_earth.npz`` (their view does not matter)."""
    shape, views = grid(altitude_m=data["irr_altitude_m"], sun_zenith_deg=data["irr_sun_zenith_deg"])
    still = np.zeros(views["altitude_m"].size)
    return shape, {**views, "view_zenith_deg": still, "azimuth_deg": still}


def atmosphere_of(data: dict[str, np.ndarray], rows: np.ndarray) -> dict:
    """Contract JSON of rows that share an atmosphere, one row per wavelength, for a point sun of irradiance 1."""

    def column(name: str) -> list[float]:
        return [float(v) for v in data[name][rows]]

    first = rows[0]
    kind = ("cornette_shanks", "henyey_greenstein")[int(data["phase_kind"][first])]
    return {
        "wavelengths_nm": column("wavelength_nm"),
        "solar_irradiance": [1.0] * len(rows),
        "bottom_radius_m": float(data["R_g"][first]),
        "top_radius_m": float(data["R_t"][first]),
        "rayleigh": {"scattering_per_m": column("beta_R"), "scale_height_m": float(data["H_R"][first])},
        "mie": {
            "scattering_per_m": column("beta_M_sca"),
            "single_scattering_albedo": column("ssa_M"),
            "scale_height_m": float(data["H_M"][first]),
            "phase": {"type": kind, "g": float(data["g"][first])},
        },
        "ozone": {"absorption_per_m": column("beta_O3"), "center_m": 25000.0, "half_width_m": 15000.0},
        "ground_albedo": column("albedo"),
        "sun_angular_radius_deg": 0.0,
    }


def sky_cases(data: dict[str, np.ndarray]) -> Iterator[Case]:
    """The atmospheres of ``sky_radiance.npz`` with their rays."""
    for index, name in enumerate(data["case_names"]):
        rows = np.flatnonzero(data["case"] == index)
        wavelengths, first, channel = np.unique(-data["wavelength_nm"][rows], return_index=True, return_inverse=True)
        assert len(wavelengths) == 3, f"case {name} has {len(wavelengths)} wavelengths"
        views = {
            "altitude_m": data["obs_height"][rows],
            "sun_zenith_deg": data["sun_zenith_deg"][rows],
            "view_zenith_deg": data["view_zenith_deg"][rows],
            "azimuth_deg": data["rel_azimuth_deg"][rows],
        }
        yield Case(str(name), atmosphere_of(data, rows[first]), rows, channel, views)
