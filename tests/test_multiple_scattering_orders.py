"""Extrapolation of the orders of scattering."""

import numpy as np
import pytest

from atmo_jit.multiple_scattering import _extrapolated


def orders_of(matrix, first, count):
    """Orders u, Tu, T^2 u ... as [N, K, S = 1, pairs = 1, size = 1]."""
    orders = [first]
    for _ in range(count - 1):
        orders.append(matrix @ orders[-1])
    return np.array(orders)[:, :, None, None, None]


def test_two_orders_give_the_geometric_tail():
    weights, _ = _extrapolated(orders_of(np.array([[0.4]]), np.array([1.0]), 2))
    assert weights[:, 0, 0] == pytest.approx([1.0, 1.0 / 0.6], rel=1e-6)


def test_a_conservative_cloud_converges_long_before_its_orders_do():
    """A slab of ten free paths that absorbs nothing: after 12 orders the plain sum lacks a third of the light."""
    depth = np.linspace(0.0, 10.0, 60)
    matrix = 0.5 * np.exp(-np.abs(depth[:, None] - depth)) * (depth[1] - depth[0])
    first = np.exp(-depth)
    exact = np.linalg.solve(np.eye(len(depth)) - matrix, first)
    orders = orders_of(matrix, first, 12)
    weights, error = _extrapolated(orders)
    best = np.einsum("n,nk->k", weights[:, 0, 0], orders[:, :, 0, 0, 0])
    plain = orders.sum(axis=0)[:, 0, 0, 0]
    off = [np.linalg.norm(x - exact) / np.linalg.norm(exact) for x in (plain, best)]
    assert off[0] > 0.2 and off[1] < 0.01
    assert off[1] < error < 0.1


def test_a_sum_that_lacks_most_of_its_light_is_known_to():
    """A slab of forty free paths: what an order adds is little long before what all that follow add is."""
    depth = np.linspace(0.0, 40.0, 160)
    matrix = 0.5 * np.exp(-np.abs(depth[:, None] - depth)) * (depth[1] - depth[0])
    first = np.exp(-depth)
    exact = np.linalg.solve(np.eye(len(depth)) - matrix, first)
    for count in (4, 12, 30):
        orders = orders_of(matrix, first, count)
        weights, error = _extrapolated(orders)
        best = np.einsum("n,nk->k", weights[:, 0, 0], orders[:, :, 0, 0, 0])
        assert np.linalg.norm(best - exact) > 0.5 * np.linalg.norm(exact) and error > 0.1


def test_darkness_stays_dark():
    weights, error = _extrapolated(np.zeros((3, 4, 2, 3, 1)))
    assert np.all(np.isfinite(weights)) and error == 0.0
