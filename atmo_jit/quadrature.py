"""Gauss-Legendre rules on [0, 1] and what marching along a ray needs of them: running integrals between their nodes."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

LOW_HORIZON = -0.07  # cosine of the horizon from where the air above is thin: 16 km over the earth


@lru_cache(maxsize=64)
def gauss_legendre(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes x [count] and weights w [count] with sum(w f(x)) = integral of f over [0, 1], exact to degree 2 count -
    1."""
    x, w = np.polynomial.legendre.leggauss(count)
    return 0.5 * (x + 1.0), 0.5 * w


@lru_cache(maxsize=64)
def running_integral(count: int, at: tuple[float, ...]) -> np.ndarray:
    """Matrix A [len(at), count]: (A f)_g is the integral from 0 to at[g] of the polynomial through f at the ``count``
    Gauss nodes.

    It gives the column density anywhere inside a piece from the densities at a few nodes of it.
    """
    x, _ = gauss_legendre(count)
    powers = np.arange(count)
    vandermonde = x[:, None] ** powers
    antiderivative = np.asarray(at)[:, None] ** (powers + 1) / (powers + 1)
    return antiderivative @ np.linalg.inv(vandermonde)


def split_directions(horizon_mu: float, count_up: int, count_down: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cosines mu and weights over [-1, 1], split at ``horizon_mu`` and clustered to it (x^2), and weights of mu over
    [0, 1].

    Radiance jumps at the horizon: a rule that straddles it loses up to 15 % of the source at low sun. High up, the
    bright band between the horizon and mu = 0 gets a rule of its own. Lower down a horizontal surface stops seeing in
    the middle of the upper rule, and its weights integrate the polynomial through that rule's nodes from mu = 0 on.
    All three are [count_up + count_down].
    """
    band = max(2, round(0.35 * count_up)) if horizon_mu < LOW_HORIZON else 0
    panels = [(horizon_mu, 0.0, band), (0.0, 1.0, count_up - band)] if band else [(horizon_mu, 1.0, count_up)]
    mu, weight, facing_up = [], [], []
    for start, end, count in [(horizon_mu, -1.0, count_down), *panels]:
        x, w = gauss_legendre(count)
        mu.append(start + (end - start) * x**2)
        weight.append(abs(end - start) * 2.0 * x * w)
        facing_up.append(np.maximum(mu[-1], 0.0) * weight[-1])
    if not band:
        facing_up[1] = _partial_weights(horizon_mu, count_up)
    return np.concatenate(mu), np.concatenate(weight), np.concatenate(facing_up)


def _partial_weights(horizon_mu: float, count: int) -> np.ndarray:
    """Weights on mu = horizon + (1 - horizon) x^2 at the Gauss nodes x: integral of mu f(mu) from mu = 0 to 1."""
    x, _ = gauss_legendre(count)
    span = 1.0 - horizon_mu
    start = np.sqrt(-horizon_mu / span)
    at, weight = gauss_legendre(count + 2)
    at, weight = start + (1.0 - start) * at, (1.0 - start) * weight
    basis = [np.prod([(at - x[j]) / (x[i] - x[j]) for j in range(count) if j != i], axis=0) for i in range(count)]
    return np.array(basis) @ (weight * (horizon_mu + span * at**2) * span * 2.0 * at)


def half_circle(count: int) -> np.ndarray:
    """Azimuths at the midpoints of ``count`` equal parts of [0, pi]: exact for cos(m phi), 0 < m < 2 count."""
    return (np.arange(count) + 0.5) * np.pi / count


def cosine_interpolation(count: int, azimuths: np.ndarray) -> np.ndarray:
    """Matrix [len(azimuths), count]: the cosine series through values at half_circle(count), evaluated at
    ``azimuths``."""
    m = np.arange(count)
    series = np.cos(m[:, None] * half_circle(count)) * np.where(m == 0, 1.0, 2.0)[:, None] / count
    return np.cos(np.asarray(azimuths)[:, None] * m) @ series
