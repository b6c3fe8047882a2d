"""Texels that err least between them, in place of texels that are right where they stand.

Clients read linearly between 32 suns. At twilight light falls by a factor of three from one to the next, and the
straight line lies above what happens between; about noon the suns are far apart. Fitted texels minimise the squared
relative error over the suns between the nodes; at the nodes themselves the light is then wrong, by up to two thirds of
what it was between them. Only the table of all light but single Mie scattering is fitted, and what that changes counts
as light of orders >= 2: single scattering is exact in files of either kind.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np

from ..mapping import Bruneton, texels
from .lookup import ClientTables

STRAIGHT = (0.05, 0.4)  # cosines of suns between which a line between texels errs by less than 0.1 %
FAINTEST = 1e-6  # of a column's brightest: relative errors of less light do not count


def fitted(
    make: Callable[[tuple[int, int, int, int], Any], ClientTables], to: Bruneton, size: tuple[int, int, int, int]
) -> ClientTables:
    """The tables of ``size`` that err least; ``make(size, block)`` computes a block of those of a size."""
    cosine = to.sun_inverse(0.5 * (texels(size[3])[1:] + texels(size[3])[:-1]))
    curved = np.flatnonzero((cosine < STRAIGHT[0]) | (cosine > STRAIGHT[1]))  # intervals
    suns = np.sort(np.concatenate([2 * np.arange(size[3]), 2 * curved + 1]))
    found = make((*size[:3], 2 * size[3] - 1), (slice(None), suns))
    node = suns % 2 == 0
    light = found.scattering[..., node, :]
    for run in np.split(curved, np.flatnonzero(np.diff(curved) > 1) + 1):
        if len(run):
            some = (suns >= 2 * run[0]) & (suns <= 2 * run[-1] + 2)
            light[..., run[0] : run[-1] + 2, :] = fitted_suns(found.scattering[..., some, :])
    single = found.scattering[..., node, :] - found.higher[..., node, :]
    higher = np.maximum(light - single, 0.0)
    return replace(found, scattering=single + higher, single_mie=found.single_mie[..., node, :], higher=higher)


def fitted_suns(values: np.ndarray) -> np.ndarray:
    """Nodes [A, ..., n, C] of the piecewise linear function of the last axis but one that has the least sum of squared
    relative errors; none is negative. ``values`` [A, ..., 2 n - 1, C]: the light at the nodes and half-way between."""
    with ThreadPoolExecutor() as pool:  # NumPy leaves Python's lock to others
        return np.stack(list(pool.map(lambda part: _fitted(_finer(part), 4), values)))


def _finer(values: np.ndarray) -> np.ndarray:
    """Light at twice as many suns [..., 4 n - 3, C]: on cubics of its logarithm."""
    most = np.maximum(values.max(axis=-2, keepdims=True), 1e-30)
    half = np.log(np.maximum(values, FAINTEST**2 * most))
    out = np.empty((*values.shape[:-2], 2 * values.shape[-2] - 1, values.shape[-1]), dtype=values.dtype)
    out[..., ::2, :] = half
    middle = out[..., 1::2, :]
    middle[...] = 0.5 * (half[..., 1:, :] + half[..., :-1, :])
    middle[..., 1:-1, :] += 0.0625 * (
        half[..., 1:-2, :] + half[..., 2:-1, :] - half[..., :-3, :] - half[..., 3:, :]
    )
    light = np.exp(out)
    return np.where(light > 2.0 * FAINTEST**2 * most, light, 0.0)


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
