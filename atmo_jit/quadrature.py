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


def facing_up(horizon_mu: float, count_up: int) -> np.ndarray:
    """Weights [count_up] on the directions above the horizon of split_directions: integral of mu f(mu) over mu in [0, 1].

    Aloft the horizon lies below mu = 0, where a horizontal surface stops seeing: the weights integrate the polynomial through the nodes from
    there on. At the ground they are mu times the usual ones.
    """
    x, _ = gauss_legendre(count_up)
    span = 1.0 - horizon_mu
    start = np.sqrt(-horizon_mu / span)
    at, weight = gauss_legendre(count_up + 2)
    at, weight = start + (1.0 - start) * at, (1.0 - start) * weight
    basis = np.array([np.prod([(at - x[j]) / (x[i] - x[j]) for j in range(count_up) if j != i], axis=0) for i in range(count_up)])
    return basis @ (weight * (horizon_mu + span * at**2) * span * 2.0 * at)


def half_circle(count: int) -> np.ndarray:
    """Azimuths at the midpoints of ``count`` equal parts of [0, pi]: exact for cos(m phi), 0 < m < 2 count."""
    return (np.arange(count) + 0.5) * np.pi / count
