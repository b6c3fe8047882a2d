"""Texels that err least between them, in place of texels that are right where they stand.

Clients read linearly between 32 suns. At twilight light falls by a factor of three from one to the next, and the
straight line lies above what happens between. Fitted texels minimise the squared relative error over the suns between
the nodes; at the nodes themselves the light is then wrong, by up to two thirds of what it was between them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .lookup import ClientTables

BETWEEN = 4  # parts of an interval at which the light is known
FAINTEST = 1e-6  # of a column's brightest: relative errors of less light do not count


def dense_size(size: tuple[int, int, int, int]) -> tuple[int, int, int, int]:
    """``size`` with the suns that a fit needs."""
    return (*size[:3], (size[3] - 1) * BETWEEN + 1)


def fitted(dense: ClientTables) -> ClientTables:
    """The tables of the clients' suns from tables with BETWEEN times as many."""
    names = ("scattering", "single_mie", "higher")
    return replace(dense, **{name: fitted_suns(getattr(dense, name)) for name in names})


def fitted_suns(values: np.ndarray, between: int = BETWEEN) -> np.ndarray:
    """Nodes [A, ..., n, C] of the piecewise linear function of the last axis but one that has the least sum of squared
    relative errors at ``values`` [A, ..., (n - 1) between + 1, C]; none is negative."""
    return np.stack([_fitted(part, between) for part in values])


def _fitted(values: np.ndarray, between: int) -> np.ndarray:
    f = np.moveaxis(values, -2, 0)
    most = np.maximum(f.max(axis=0), 1e-30)
    f = f / most
    weight = 1.0 / np.maximum(f, FAINTEST) ** 2
    # Normal equations of hat functions: tridiagonal. Points at a share of the way through every interval, then the end.
    count = (len(f) - 1) // between + 1
    diagonal, right = np.zeros((2, count, *f.shape[1:]), dtype=f.dtype)
    beside = np.zeros((count - 1, *f.shape[1:]), dtype=f.dtype)
    for i in range(between):
        share = f.dtype.type(i / between)
        w = weight[i:-1:between]
        y = w * f[i:-1:between]
        diagonal[:-1] += w * (1 - share) ** 2
        diagonal[1:] += w * share**2
        beside += w * (share * (1 - share))
        right[:-1] += y * (1 - share)
        right[1:] += y * share
    diagonal[-1] += weight[-1]
    right[-1] += weight[-1] * f[-1]
    for k in range(1, count):  # elimination without pivots: the matrix is positive definite
        factor = beside[k - 1] / diagonal[k - 1]
        diagonal[k] -= factor * beside[k - 1]
        right[k] -= factor * right[k - 1]
    right[-1] /= diagonal[-1]
    for k in range(count - 2, -1, -1):
        right[k] = (right[k] - beside[k] * right[k + 1]) / diagonal[k]
    return np.moveaxis(np.maximum(right, 0.0) * most, 0, -2)
