"""Derivatives of the sky against score-function Monte Carlo: ``python -m bench.sky_derivatives``.

``sky_derivatives.npz`` (bench/reference.py): by the aerosol's scattering, its g and the albedo of the ground, with the
reference's own standard deviation. Prints how many are within 1 % plus three of those, and the others, without and with
``fine`` of atmo_jit.Linearization.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from . import reference

NAMES = {
    "mie.scattering_per_m": ("dL_dbetaM", "beta_M_sca"),
    "mie.phase.g": ("dL_dg", "g"),
    "ground_albedo": ("dL_dalbedo", "albedo"),
}
VIEWS = {
    "altitude_m": "obs_height",
    "sun_zenith_deg": "sun_zenith_deg",
    "view_zenith_deg": "view_zenith_deg",
    "azimuth_deg": "rel_azimuth_deg",
}


def cases(data: Any) -> Iterator[tuple[np.ndarray, dict[str, Any], dict[str, np.ndarray]]]:
    """Rows, atmosphere and views of every case."""
    for case in np.unique(data["case"]):
        rows = np.flatnonzero(data["case"] == case)
        one = {name: data[name][rows[0]] for name in data.files if data[name].shape == data["case"].shape}
        kind = ("cornette_shanks", "henyey_greenstein")[one["phase_kind"]]
        air = {
            "wavelengths_nm": [550.0],
            "bottom_radius_m": one["R_g"],
            "top_radius_m": one["R_t"],
            "rayleigh": {"scattering_per_m": one["beta_R"], "scale_height_m": one["H_R"]},
            "mie": {
                "scattering_per_m": one["beta_M_sca"],
                "single_scattering_albedo": one["ssa_M"],
                "scale_height_m": one["H_M"],
                "phase": {"type": kind, "g": one["g"]},
            },
            "ozone": {"absorption_per_m": one["beta_O3"], "center_m": 25000, "half_width_m": 15000},
            "ground_albedo": one["albedo"],
            "sun_angular_radius_deg": 0,
        }
        yield rows, air, {name: data[own][rows].astype(float) for name, own in VIEWS.items()}


def errors(folder: Path | None = None, **options: Any) -> list[dict[str, Any]]:
    """One row per derivative: what its error has beyond three standard deviations, over the derivative (``relative``),
    and as the change of the logarithm of the radiance per change of the parameter's (``logarithmic``). ``options``: of
    Linearization."""
    from atmo_jit import jacobian

    data = np.load(reference.folder(folder) / "sky_derivatives.npz")
    found = []
    for rows, air, views in cases(data):
        _, by = jacobian(air, views, list(NAMES), **options)
        for name, (key, value) in NAMES.items():
            for i, ours in zip(rows, by[name][:, 0], strict=True):
                truth = data[key][i]
                beyond = max(abs(ours - truth) - 3.0 * data[key + "_sigma"][i], 0.0)
                found.append(
                    {
                        "name": name,
                        "case": int(data["case"][i]),
                        "view_zenith_deg": float(data["view_zenith_deg"][i]),
                        "relative": float(beyond / abs(truth)),
                        "logarithmic": float((beyond - 0.01 * abs(truth)) * data[value][i] / data["L"][i]),
                    }
                )
    return found


def main() -> None:
    """Print what is not within 1 % plus three standard deviations."""
    for fine in (False, True):
        rows = errors(fine=fine)
        worse = [row for row in rows if row["relative"] > 0.01]
        print(f"fine={fine}: {len(rows) - len(worse)} of {len(rows)} within 1 % plus three standard deviations; else")
        for row in sorted(worse, key=lambda row: -row["relative"]):
            print(
                f"    by {row['name']}, case {row['case']}, view at {row['view_zenith_deg']:.0f} deg:"
                f" {100 * row['relative']:.1f} % beyond three, {row['logarithmic']:.4f} of the radiance's logarithm"
            )


if __name__ == "__main__":
    main()
