"""Real spherical harmonics that are even in azimuth, orthonormal over the sphere: P_lm(mu) cos(m phi).

Radiance under one sun is mirror-symmetric about the plane of sun and zenith, so only cosines occur. Pairs (l, m) are
stored with m outside and l inside: all l >= m for m = 0, then for m = 1, ... The first pair is (0, 0): the mean.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np


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
