"""Gauss-Legendre rules on [0, 1] and what marching along a ray needs of them: running integrals between their nodes."""

from __future__ import annotations

from functools import lru_cache

import numpy as np


@lru_cache(maxsize=64)
def gauss_legendre(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes x [count] and weights w [count] with sum(w f(x)) = integral of f over [0, 1], exact to degree 2 count - 1."""
    x, w = np.polynomial.legendre.leggauss(count)
    return 0.5 * (x + 1.0), 0.5 * w


@lru_cache(maxsize=64)
def running_integral(count: int, at: tuple[float, ...]) -> np.ndarray:
    """Matrix A [len(at), count]: (A f)_g is the integral from 0 to at[g] of the polynomial through f at the ``count`` Gauss nodes.

    It gives the column density anywhere inside a piece from the densities at a few nodes of it.
    """
    x, _ = gauss_legendre(count)
    powers = np.arange(count)
    vandermonde = x[:, None] ** powers
    antiderivative = np.asarray(at)[:, None] ** (powers + 1) / (powers + 1)
    return antiderivative @ np.linalg.inv(vandermonde)


def split_directions(horizon_mu: float, count_up: int, count_down: int) -> tuple[np.ndarray, np.ndarray]:
    """Cosines mu [count_up + count_down] and weights over [-1, 1], split at ``horizon_mu`` and clustered to it (x^2 on both sides).

    Radiance jumps at the horizon: a rule that straddles it loses up to 15 % of the source at low sun. Weights sum to 2.
    """
    x_up, w_up = gauss_legendre(count_up)
    x_down, w_down = gauss_legendre(count_down)
    up, down = 1.0 - horizon_mu, horizon_mu + 1.0
    mu = np.concatenate([horizon_mu + up * x_up**2, horizon_mu - down * x_down**2])
    weight = np.concatenate([up * 2.0 * x_up * w_up, down * 2.0 * x_down * w_down])
    return mu, weight


def half_circle(count: int) -> np.ndarray:
    """Azimuths at the midpoints of ``count`` equal parts of [0, pi]: exact for cos(m phi), 0 < m < 2 count."""
    return (np.arange(count) + 0.5) * np.pi / count
