"""How well a fit knows what it found: from the derivatives of the residuals at the minimum.

All of it in the scalars' z (value or its logarithm; see :mod:`atmo_jit.fits.parameters`), J by z, rows of samples (over
sigma, as much as the loss lets them count) and of priors apart; kappa is the excess of :mod:`atmo_jit.fits.problem`, 1
where the model follows the data:

    covariance          S   = (J_d' J_d + J_p' J_p)^-1            Gauss-Newton; Rodgers 2000, eq. 5.8
    with model error    S_m = (J_d' J_d / kappa + J_p' J_p)^-1
    averaging kernel    A   = (J_d' J_d / kappa + B)^-1 J_d' J_d / kappa     Rodgers 2000, eq. 2.78; B: the priors,
                                                                  and for scalars without one half their range as sigma

S holds if nothing but the stated noise keeps model and data apart, which measured skies never grant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .parameters import Scalar
from .problem import Evaluation, Problem

NARROWED = 0.5  # averaging kernel below which the prior knows more than the data
WIDE = 0.25  # part of the range between the bounds that an interval spans if little is known
ALIKE = 0.9  # correlation, by the data alone, from which on two parameters cannot be told apart


@dataclass(frozen=True)
class Uncertainty:
    """Of P scalars: ``covariance`` and ``correlation`` [P, P] of the values, ``standard_error`` and
    ``model_error`` [P] (1 sigma, of the values), ``averaging_kernel`` [P] (its diagonal), ``sentences``."""

    covariance: np.ndarray
    correlation: np.ndarray
    standard_error: np.ndarray
    model_error: np.ndarray
    averaging_kernel: np.ndarray
    sentences: tuple[str, ...]


def uncertainty(problem: Problem, u: np.ndarray, found: Evaluation) -> Uncertainty:
    """The uncertainty at ``u``, where ``found`` holds the derivatives of the residuals."""
    scalars = problem.scalars
    slopes = np.array([s.slopes(x) for s, x in zip(scalars, u, strict=True)])
    dz = np.maximum(np.abs(slopes[:, 1]), 1e-300)  # nothing is left of it at a bound itself
    by_z = np.array([v if s.logarithmic else 1.0 for s, v in zip(scalars, problem.values(u), strict=True)])
    samples = int(np.count_nonzero(problem.data.used))
    # A sample counts as much as its loss does beside its square: nine tenths of Gaussian noise, little of outliers.
    residuals = problem.residuals(u)
    loss, _, curvature = problem.loss(residuals)
    worth = np.divide(2.0 * loss, residuals**2, out=curvature, where=residuals != 0.0)
    jacobian = found.jacobian / dz * np.sqrt(worth)[:, None]
    data, priors = jacobian[:samples], jacobian[samples:]
    weighed, told = data.T @ data, priors.T @ priors
    inverse = _inverse(problem.excess * weighed + told)
    with_model_error = _inverse(weighed + told)
    wide = np.array([_range(s) for s in scalars])
    bounds = np.diag(np.where(np.isfinite([s.prior_sigma for s in scalars]), 0.0, wide**-2.0))
    kernel = np.diag(_inverse(weighed + told + bounds) @ weighed).clip(0.0, 1.0)
    errors, model_error = (np.sqrt(np.diag(m)) for m in (inverse, with_model_error))
    values = problem.values(u)
    # What the data tell by themselves; factors of single wavelengths stay small by their priors.
    kept = np.diag([np.sum(priors[:, i] ** 2) * (s.wavelength_nm is not None) for i, s in enumerate(scalars)])
    alone = _correlation(_inverse(weighed + kept))
    sentences = _sentences(scalars, values, kernel, alone, model_error * np.abs(by_z))
    return Uncertainty(
        inverse * by_z * by_z[:, None],
        _correlation(inverse),
        errors * np.abs(by_z),
        model_error * np.abs(by_z),
        kernel,
        sentences,
    )


def reduced_chi_square(problem: Problem, found: Evaluation) -> float:
    """Sum of squared residuals over sigma, without the loss, over the degrees of freedom."""
    raw = found.raw[problem.data.used]
    return float(raw @ raw) / max(len(raw) - len(problem.scalars), 1)


def _range(scalar: Scalar) -> float:
    """Half the range of z that bounds allow; for factors and turns without bounds, their scale."""
    if not scalar.bounded:
        return scalar.scale
    low, high = (np.log(v) if scalar.logarithmic else v for v in (scalar.low, scalar.high))
    return 0.5 * (high - low)


def _inverse(matrix: np.ndarray) -> np.ndarray:
    """Inverse of a positive matrix; directions that it does not know get a large variance, not an infinite one."""
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix / size / size[:, None])
    return (vectors / np.maximum(values, 1e-13)) @ vectors.T / size / size[:, None]


def _correlation(covariance: np.ndarray) -> np.ndarray:
    size = np.sqrt(np.diag(covariance))
    return np.clip(covariance / size / size[:, None], -1.0, 1.0)


def _sentences(
    scalars: tuple[Scalar, ...], values: np.ndarray, kernel: np.ndarray, alone: np.ndarray, model_error: np.ndarray
) -> tuple[str, ...]:
    """What the data cannot tell, in words; values per wavelength in one sentence."""
    found, unknown = [], {}
    for i, scalar in enumerate(scalars):
        if scalar.nuisance:
            continue
        if kernel[i] < NARROWED and scalar.wavelength_nm is not None:
            unknown.setdefault(scalar.family, []).append(scalar.wavelength_nm)
            continue
        if kernel[i] < NARROWED:
            by = "its prior" if np.isfinite(scalar.prior_sigma) else "its bounds"
            part = 100.0 * (1.0 - np.sqrt(1.0 - kernel[i]))
            found.append(f"{scalar.name} is not identifiable: the data narrow {by} down by {part:.0f} % only.")
            continue
        low, high = scalar.interval(values[i], model_error[i])
        ends = [np.log(v) if scalar.logarithmic else v for v in (low, high, scalar.low, scalar.high)]
        if scalar.bounded and ends[1] - ends[0] > WIDE * (ends[3] - ends[2]):
            found.append(
                f"{scalar.name} is not identifiable: with the model's errors anything from {low:.3g} to {high:.3g} is "
                "possible."
            )
        others = [
            j for j in range(len(scalars)) if j != i and abs(alone[i, j]) >= ALIKE and (scalars[j].nuisance or j > i)
        ]
        if others:
            j = max(others, key=lambda j: abs(alone[i, j]))
            found.append(
                f"{scalar.name} is not identifiable while {scalars[j].name} is free: the data change in the same way "
                f"with both (correlation {alone[i, j]:.2f})."
            )
    for family, wavelengths in unknown.items():
        at = ", ".join(f"{nm:g}" for nm in wavelengths)
        found.append(f"{family} is not identifiable at {at} nm: its prior or bounds say more than the data.")
    return tuple(found)
