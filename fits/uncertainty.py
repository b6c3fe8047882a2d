"""How well a fit knows what it found: from the derivatives of the residuals at the minimum.

All of it in the scalars' z (value or its logarithm; see :mod:`atmo_jit.fits.parameters`), J by z, rows of samples and
of priors apart:

    covariance          S = (J_d' J_d + J_p' J_p)^-1             Gauss-Newton; Rodgers 2000, eq. 5.8
    averaging kernel    A = (J_d' J_d + B)^-1 J_d' J_d           Rodgers 2000, eq. 2.78; B: priors, and for scalars
                                                                 without one their bounds, half their range one sigma
    model error         S_m = S (sum_c g_c g_c' + J_p' J_p) S,   g_c = sum of J' r over a cluster of samples

S holds if nothing but the stated noise keeps model and data apart. Where the model errs its errors are alike at
neighbouring directions and wavelengths, so that many samples count as few: S_m (Liang & Zeger 1986, eq. 11) sums the
residuals over parts of the sky, or over wavelengths, before it squares them. The interval takes the widest of S, S
times the reduced chi-square, and both S_m.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .parameters import Scalar
from .problem import Evaluation, Problem

LEAST_CLUSTERS = 6
NARROWED = 0.5  # averaging kernel below which the prior knows more than the data
ALIKE = 0.9  # correlation, by the data alone, from which on two parameters cannot be told apart
SKY_PARTS = (3, 6)  # parts of the sky, in zenith angle and azimuth, in which the model's errors are taken to be alike


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
    """The uncertainty at ``u``, where ``found`` holds the residuals and their derivatives."""
    scalars = problem.scalars
    slopes = np.array([s.slopes(x) for s, x in zip(scalars, u, strict=True)])
    dv, dz = slopes[:, 0], slopes[:, 1]
    by_z = dv / dz
    jacobian = found.jacobian / dz
    samples = int(np.count_nonzero(problem.data.used))
    data, priors = jacobian[:samples], jacobian[samples:]
    known, told = data.T @ data, priors.T @ priors
    inverse = _inverse(known + told)
    errors = np.sqrt(np.diag(inverse))
    wide = np.array([_range(s) for s in scalars])
    bounds = np.diag(np.where(np.isfinite([s.prior_sigma for s in scalars]), 0.0, wide**-2.0))
    kernel = np.diag(_inverse(known + told + bounds) @ known).clip(0.0, 1.0)
    excess = max(1.0, reduced_chi_square(problem, found))
    variances = [np.diag(inverse), np.diag(_inverse(known / excess + told))]
    weighted = data * found.residual[:samples, None]
    for cluster in _clusters(problem):
        sums = np.zeros((cluster.max() + 1, len(scalars)))
        np.add.at(sums, cluster, weighted)
        count = len(np.unique(cluster))
        if count >= LEAST_CLUSTERS:
            middle = sums.T @ sums * (count / (count - 1.0)) + told
            variances.append(np.diag(inverse @ middle @ inverse))
    model_error = np.sqrt(np.max(variances, axis=0))
    values = problem.values(u)
    alone = _correlation(_inverse(known + 1e-12 * np.diag(np.diag(known))))
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


def _clusters(problem: Problem) -> list[np.ndarray]:
    """For every sample in use the number of its part of the sky and scan, and that of its channel."""
    data = problem.data
    row, channel = np.nonzero(data.used)
    zeniths, azimuths = SKY_PARTS
    up = np.minimum((1.0 - np.cos(data.view_zenith)) * zeniths, zeniths - 1).astype(int).clip(0)
    around = ((data.azimuth % (2.0 * np.pi)) / (2.0 * np.pi) * azimuths).astype(int) % azimuths
    part = (data.scan * zeniths + up) * azimuths + around
    return [part[row], data.scan[row] * data.radiance.shape[1] + channel]


def _sentences(
    scalars: tuple[Scalar, ...], values: np.ndarray, kernel: np.ndarray, alone: np.ndarray, model_error: np.ndarray
) -> tuple[str, ...]:
    """What the data cannot tell, in words."""
    found = []
    for i, scalar in enumerate(scalars):
        if scalar.nuisance:
            continue
        if kernel[i] < NARROWED:
            by = "its prior" if np.isfinite(scalar.prior_sigma) else "its bounds"
            found.append(
                f"{scalar.name} is not identifiable: the data narrow {by} down by {100.0 * (1 - np.sqrt(1 - kernel[i])):.0f} % only."
            )
            continue
        low, high = scalar.interval(values[i], model_error[i])
        ends = [np.log(v) if scalar.logarithmic else v for v in (low, high, scalar.low, scalar.high)]
        if scalar.bounded and ends[1] - ends[0] > 0.5 * (ends[3] - ends[2]):
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
    return tuple(found)
