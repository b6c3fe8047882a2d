"""A fit as numbers: what RESULT.json holds."""

from __future__ import annotations

from typing import Any

import numpy as np

from atmo_jit import __version__
from atmo_jit.atmosphere import Atmosphere

from .fit import Fit
from .parameters import Scalar
from .uncertainty import reduced_chi_square

DERIVED_NM = (440.0, 550.0)
KEYS = ("value", "standard_error", "interval_95", "interval_95_model_error", "at_bound", "averaging_kernel")


def result(fit: Fit) -> dict[str, Any]:
    """What a fit found, as JSON has it: see the manual's "Fits"."""
    problem, errors, found = fit.problem, fit.errors, fit.found
    values = problem.values(fit.u)
    entries = {
        s.name: _entry(s, *numbers)
        for s, *numbers in zip(
            problem.scalars, values, errors.standard_error, errors.model_error, errors.averaging_kernel, strict=True
        )
    }
    parameters: dict[str, Any] = {}
    for leaf in problem.leaves:
        if leaf.mode == "per_wavelength":
            rows = [entries[s.name] for s in leaf.scalars]
            parameters[leaf.name] = {key: [row[key] for row in rows] for key in KEYS}
        else:
            parameters |= {s.name: entries[s.name] for s in leaf.scalars}
    used = problem.data.used
    measured, predicted = problem.data.radiance[used], found.predicted[used]
    relative = predicted / np.where(measured == 0.0, np.nan, measured) - 1.0
    apart = np.log(predicted / measured) if problem.logarithmic else predicted - measured
    samples = int(used.sum())
    return {
        "parameters": parameters,
        "nuisance": {s.name: entries[s.name] for s in problem.scalars if s.nuisance},
        "names": [s.name for s in problem.scalars],
        "covariance": errors.covariance.tolist(),
        "correlation": errors.correlation.tolist(),
        "residual": problem.config.residual,
        "residual_rms": _rms(apart),
        "residual_robust": 1.4826 * float(np.median(np.abs(apart))),
        "rmse": _rms(predicted - measured),
        "relative_rms": _rms(relative[np.isfinite(relative)]),
        **_with_masked(fit),
        "reduced_chi_square": reduced_chi_square(problem, found),
        "degrees_of_freedom": samples - len(problem.scalars),
        "degrees_of_freedom_for_signal": float(np.sum(errors.averaging_kernel)),
        "samples": samples,
        "samples_not_positive": fit.dropped,
        "derived": derived(problem.model.atmosphere.replace(problem.atmosphere_values(fit.u)), problem.data.altitude_m),
        "not_identifiable": list(errors.sentences),
        "converged": fit.solution.converged,
        "reason": fit.solution.reason,
        "iterations": fit.solution.iterations,
        "starts": fit.starts,
        "seconds": fit.seconds,
        "by_wavelength": _by_channel(fit),
        "by_scattering_angle": _by_angle(fit),
        "atmo_jit": __version__,
    }


def _entry(scalar: Scalar, value: float, error: float, model_error: float, kernel: float) -> dict[str, Any]:
    return {
        "value": float(value),
        "standard_error": float(error),
        "interval_95": list(scalar.interval(value, error)),
        "interval_95_model_error": list(scalar.interval(value, model_error)),
        "at_bound": scalar.at_bound(value) is not None,
        "averaging_kernel": float(kernel),
    }


def derived(air: Atmosphere, altitude_m: np.ndarray) -> dict[str, Any]:
    """Vertical optical depths above the (mean) observer and the aerosol's asymmetry and single-scattering albedo, at
    the atmosphere's wavelengths and at 440 and 550 nm."""
    h = np.linspace(min(float(np.mean(altitude_m)), air.thickness_m), air.thickness_m, 4097)
    nm = air.wavelengths_nm
    count = len(nm)

    def depth(constituent: Any, coefficient: np.ndarray) -> np.ndarray:
        return coefficient * float(np.trapezoid(constituent.profile.density(h), h))

    depths = {c.name: depth(c, c.extinction_per_m) for c in air.constituents}
    aerosol = sum((depths[c.name] for c in air.mie), start=np.zeros(count))
    scattered = [depth(c, c.scattering_per_m) for c in air.mie]
    total = sum(scattered, start=np.zeros(count))
    mean_cosine = np.zeros(count)
    for part, c in zip(scattered, air.mie, strict=True):
        cosine = np.broadcast_to(np.array([np.asarray(c.phase.at(w).moments(1))[1] for w in range(count)]), count)
        mean_cosine = mean_cosine + part * cosine / np.where(total > 0.0, total, 1.0)
    order = np.argsort(nm)
    x = np.log(nm[order])

    def at(values: np.ndarray, wavelength: float) -> float | None:
        """Between wavelengths, logarithmic where all are > 0; None outside of them."""
        if not nm.min() <= wavelength <= nm.max():
            return None
        y = values[order]
        if np.all(y > 0.0):
            return float(np.exp(np.interp(np.log(wavelength), x, np.log(y))))
        return float(np.interp(np.log(wavelength), x, y))

    albedo = np.divide(total, aerosol, out=np.ones(count), where=aerosol > 0.0)
    found: dict[str, Any] = {
        "wavelengths_nm": nm.tolist(),
        "optical_depth": {name: values.tolist() for name, values in depths.items()},
        "aerosol_optical_depth": aerosol.tolist(),
        "asymmetry": mean_cosine.tolist(),
        "single_scattering_albedo": albedo.tolist(),
    }
    for wavelength in DERIVED_NM:
        found[f"tau_{wavelength:.0f}"] = at(aerosol, wavelength)
        found[f"asymmetry_{wavelength:.0f}"] = at(mean_cosine, wavelength)
    return found


def _with_masked(fit: Fit) -> dict[str, float]:
    """Errors over all samples that there are, the masked ones too."""
    parts = [(fit.problem.data, fit.found.predicted), *([fit.unseen] if fit.unseen else [])]
    measured, predicted = (np.concatenate(v) for v in zip(*((d.radiance, p) for d, p in parts), strict=True))
    there = np.isfinite(measured)
    row = _row(predicted[there], measured[there])
    return {"rmse_with_masked": row["rmse"], "relative_rms_with_masked": row["relative_rms"]}


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")


def _row(predicted: np.ndarray, measured: np.ndarray) -> dict[str, float]:
    keep = measured > 0.0
    difference = predicted[keep] / measured[keep] - 1.0
    return {
        "samples": len(difference),
        "bias": float(np.mean(difference)) if len(difference) else float("nan"),
        "relative_rms": _rms(difference),
        "rmse": _rms(predicted - measured),
    }


def _by_channel(fit: Fit) -> list[dict[str, Any]]:
    """Residuals of every wavelength (or channel of a picture)."""
    data, predicted = fit.problem.data, fit.found.predicted
    names = [{"wavelength_nm": nm} for nm in data.wavelengths_nm.tolist()]
    if data.mixing is not None:
        names = [{"channel": c} for c in range(len(data.mixing))]
    return [
        name | _row(predicted[use, c], data.radiance[use, c])
        for c, (name, use) in enumerate(zip(names, data.used.T, strict=True))
        if np.any(data.radiance[use, c] > 0.0)
    ]


def _by_angle(fit: Fit) -> list[dict[str, Any]]:
    """Residuals by scattering angle (the sun where the data say it is), in steps of 15 degrees."""
    data, predicted = fit.problem.data, fit.found.predicted
    angle = np.degrees(scattering_angle(fit))
    rows = []
    for low in range(0, 180, 15):
        here = data.used & ((angle >= low) & (angle < low + 15))[:, None]
        if np.any(data.radiance[here] > 0.0):
            rows.append({"from_deg": low, "to_deg": low + 15} | _row(predicted[here], data.radiance[here]))
    return rows


def scattering_angle(fit: Fit) -> np.ndarray:
    """Angle between view and sun [N], radians, with the nuisances in it."""
    _, sun, azimuth = fit.problem.geometry(fit.u)
    view = fit.problem.data.view_zenith
    cosine = np.cos(sun) * np.cos(view) + np.sin(sun) * np.sin(view) * np.cos(azimuth)
    return np.arccos(np.clip(cosine, -1.0, 1.0))
