"""Real spherical harmonics that are even in azimuth, orthonormal over the sphere: P_lm(mu) cos(m phi).

Radiance under one sun is mirror-symmetric about the plane of sun and zenith, so only cosines occur. Pairs (l, m) are
stored with m outside and l inside: all l >= m for m = 0, then for m = 1, ... The first pair is (0, 0): the mean.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import drjit as dr
import numpy as np

from .backend import types


def pair_count(degree: int, most: int | None = None) -> int:
    """Number of pairs (l, m) with 0 <= m <= l <= degree, and m <= ``most``: they come first."""
    most = degree if most is None else most
    return (most + 1) * (2 * degree + 2 - most) // 2


def pair_index(degree: int, l_: int, m: int) -> int:
    """Place of the pair (l, m) among those up to ``degree``."""
    return m * (2 * degree + 3 - m) // 2 + l_ - m


@lru_cache(maxsize=64)
def pairs(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Arrays l and m [pair_count(degree)] of the stored order."""
    order = [(l_, m) for m in range(degree + 1) for l_ in range(m, degree + 1)]
    l_, m = np.array(order).T
    return l_, m


@lru_cache(maxsize=64)
def recurrence(degree: int) -> np.ndarray:
    """Coefficients (a, b, s) [pair_count(degree), 3] of the recurrences.

    P_lm = a (mu P_{l-1,m} - b P_{l-2,m}), starting from P_mm = s sin(theta) P_{m-1,m-1}.
    P_00 = 1 / sqrt(4 pi). For m >= 1 the norm holds sqrt(2): the integral of (P_lm cos m phi)^2 over the sphere is 1.
    """
    table = np.zeros((pair_count(degree), 3))
    for index, (l_, m) in enumerate(zip(*pairs(degree), strict=True)):
        if l_ > m:
            table[index, 0] = np.sqrt((4.0 * l_ * l_ - 1.0) / (l_ * l_ - m * m))
            table[index, 1] = np.sqrt(((l_ - 1.0) ** 2 - m * m) / (4.0 * (l_ - 1.0) ** 2 - 1.0))
        elif m > 0:
            table[index, 2] = np.sqrt((2.0 * m + 1.0) / (2.0 * m)) * (np.sqrt(2.0) if m == 1 else 1.0)
    return table


def legendre(degree: int, mu: np.ndarray) -> np.ndarray:
    """P_lm(mu) for every pair: [..., pair_count(degree)], float64."""
    mu = np.asarray(mu, dtype=np.float64)
    sine = np.sqrt(np.maximum((1.0 - mu) * (1.0 + mu), 0.0))
    out = np.empty((*mu.shape, pair_count(degree)))
    diagonal = np.full(mu.shape, 1.0 / np.sqrt(4.0 * np.pi))
    table = recurrence(degree)
    for index, (l_, m) in enumerate(zip(*pairs(degree), strict=True)):
        if l_ == m:
            if m > 0:
                diagonal = diagonal * sine * table[index, 2]
            out[..., index] = diagonal
        else:
            before = out[..., index - 2] if l_ > m + 1 else 0.0
            out[..., index] = table[index, 0] * (mu * out[..., index - 1] - table[index, 1] * before)
    return out


class Harmonics:
    """Real spherical harmonics cos(m phi) P_lm(mu) by recurrence over the pairs (l, m), and their slopes.

    As polynomials in mu and x = sin(theta) cos(phi), which are smooth at the zenith as well: P_lm has the factor
    sin^m(theta), and sin^m cos(m phi) follows from q_(m+1) = 2 x q_m - sin^2 q_(m-1).
    """

    def __init__(self, mu: Any, x: Any, *, slopes: bool) -> None:
        self.mu, self.x, self.slopes = mu, x, slopes
        self.count = 3 if slopes else 1
        self._square = (1.0 - mu) * (1.0 + mu)

    def start(self, width: int) -> list[Any]:
        """m of the pair before the first; P over sin^m at it, its last two in l; q_m and q_(m-1); then all slopes: of P
        by mu, of q by x and by mu."""
        t = types()
        zero, one = dr.zeros(t.Float, width), dr.full(t.Float, 1.0, width)
        state = [t.Float(0.0) + zero, one * 0.28209479, zero + 0.0, zero + 0.0, one + 0.0, zero + 0.0]
        return state + [zero + 0.0 for _ in range(6 if self.slopes else 0)]

    def next(self, recurrence: list[Any], state: list[Any]) -> tuple[list[Any], list[Any]]:
        """Values at the next pair (the harmonic, its slopes by mu and x), and the state there."""
        a, b, start, is_diagonal = recurrence
        m, diagonal, last, before, q, q_before, *slopes = state
        new_m, first = start > 0.0, is_diagonal > 0.0
        twice = dr.select(m > 0.0, 2.0, 1.0)
        diagonal = dr.select(new_m, diagonal * start, diagonal)
        p = dr.select(first, diagonal, a * (self.mu * last - b * before))
        q_next = dr.select(new_m, twice * self.x * q - self._square * q_before, q)
        values, new = [p * q_next], []
        if self.slopes:
            p_last, p_before, x_q, x_before, mu_q, mu_before = slopes
            p_mu = dr.select(first, 0.0, a * (last + self.mu * p_last - b * p_before))
            x_next = dr.select(new_m, twice * (q + self.x * x_q) - self._square * x_before, x_q)
            mu_next = dr.select(
                new_m, twice * self.x * mu_q - self._square * mu_before + 2.0 * self.mu * q_before, mu_q
            )
            values += [p_mu * q_next + p * mu_next, p * x_next]
            new = [
                p_mu,
                dr.select(first, 0.0, p_last),
                x_next,
                dr.select(new_m, x_q, x_before),
                mu_next,
                dr.select(new_m, mu_q, mu_before),
            ]
        old = [dr.select(first, 0.0, last), q_next, dr.select(new_m, q, q_before)]
        return values, [dr.select(new_m, m + 1.0, m), diagonal, p, *old, *new]
