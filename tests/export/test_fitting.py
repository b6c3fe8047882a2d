"""Fitted texels: the least relative error between the nodes."""

from __future__ import annotations

import numpy as np
import pytest

from atmo_jit.export.fitting import fitted_suns

N = 9


def values(function):
    x = np.linspace(0.0, 1.0, 2 * N - 1)
    return x, np.broadcast_to(function(x)[:, None], (2, 3, 4, len(x), 3))


def between(nodes, x):
    return np.interp(x, np.linspace(0.0, 1.0, N), nodes[0, 0, 0, :, 0])


def test_what_is_linear_stays():
    x, f = values(lambda x: 1.0 + 2.0 * x)
    np.testing.assert_allclose(fitted_suns(f), f[..., ::2, :], rtol=1e-3)


def test_twilight_gets_closer():
    """Light that falls by three per node, against texels that are right where they stand, and a general solver."""
    _, f = values(lambda x: 3.0 ** (8.0 * x))
    x = np.linspace(0.0, 1.0, 4 * (N - 1) + 1)
    errors = [np.abs(between(nodes, x) / 3.0 ** (8.0 * x) - 1.0) for nodes in (fitted_suns(f), f[..., ::2, :])]
    assert errors[0].max() < 0.7 * errors[1].max() and errors[0].mean() < 0.6 * errors[1].mean()
    hats = np.array([np.interp(x, np.linspace(0.0, 1.0, N), row) for row in np.eye(N)]).T
    exact, *_ = np.linalg.lstsq(hats / 3.0 ** (8.0 * x[:, None]), np.ones(len(x)), rcond=None)
    assert fitted_suns(f)[0, 0, 0, :, 0] == pytest.approx(exact, rel=1e-6)


def test_shadow_stays_dark():
    _, f = values(lambda x: np.maximum(x - 0.5, 0.0) ** 3)
    nodes = fitted_suns(f.astype(np.float32))
    assert np.all(np.isfinite(nodes)) and np.all(nodes >= 0.0) and nodes[0, 0, 0, 0, 0] == 0.0
    assert not fitted_suns(np.zeros_like(f)).any()
