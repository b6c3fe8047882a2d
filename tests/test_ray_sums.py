"""Sums over the pieces of rays against NumPy, and each backwards against its other."""

from __future__ import annotations

import drjit as dr
import numpy as np
import pytest

from atmo_jit.backend import floats, uints
from atmo_jit.ray_sums import RaySums

COUNTS = np.array([3, 0, 1, 4])  # pieces of each ray; two more pieces belong to none
FIRST = np.concatenate([[0], np.cumsum(COUNTS)])
RAY = np.concatenate([np.repeat(np.arange(4), COUNTS), [0, 0]])
BEGIN = np.concatenate([np.repeat(FIRST[:-1], COUNTS), [8, 9]])
OWN = np.arange(10) < 8


def matrix(name):
    """What the sum does, as a matrix."""
    at = np.zeros((10, 4))
    at[np.arange(10), RAY] = 1.0
    if name == "at_pieces":
        return at
    if name == "totals":
        return (at * OWN[:, None]).T
    before = (RAY[:, None] == RAY[None, :]) & (np.arange(10)[None, :] < np.arange(10)[:, None])
    return np.where(before & OWN[:, None] & OWN[None, :], 1.0, 0.0)


@pytest.mark.parametrize("name", ["at_pieces", "totals", "before"])
def test_sums_and_their_derivatives(name):
    rng, wanted = np.random.default_rng(0), matrix(name)
    sums = RaySums(uints(FIRST), uints(RAY), uints(BEGIN))
    values = rng.uniform(size=(2, wanted.shape[1])).astype(np.float32)
    given = [floats(v) for v in values]
    dr.enable_grad(given)
    found = getattr(sums, name)(given)
    assert np.allclose([v.numpy() for v in dr.detach(found)], values @ wanted.T, atol=1e-6)
    weights = rng.uniform(size=(2, wanted.shape[0])).astype(np.float32)
    if name == "at_pieces":
        weights[:, ~OWN] = 0.0  # what belongs to no ray is in no sum
    for value, weight in zip(found, weights, strict=True):
        dr.set_grad(value, floats(weight))
    dr.enqueue(dr.ADMode.Backward, *found)
    dr.traverse(dr.ADMode.Backward)
    assert np.allclose([v.numpy() for v in dr.grad(given)], weights @ wanted, atol=1e-6)
