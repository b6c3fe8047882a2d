"""Slopes of look-ups in a solved field (slopes.py)."""

import drjit as dr
import numpy as np
import pytest

from atmo_jit import Sky
from atmo_jit.backend import floats, types
from atmo_jit.slopes import cubic_slopes


def test_slopes_of_cubics_are_exact():
    """At both ends of a table too, where no nodes lie beyond."""
    t, count = types(), 7
    index, fraction = np.array([0, 0, 1, 3, 5, 5]), np.array([0.0, 0.7, 0.3, 0.5, 0.2, 1.0])
    nodes, weights = cubic_slopes(t.UInt(index), floats(fraction), dr.opaque(t.UInt, count, 1))
    values = floats([0.02 * n**3 - 0.1 * n**2 + 0.3 * n + 1.0 for n in range(count)])
    slope = sum(w * dr.gather(t.Float, values, n) for n, w in zip(nodes, weights, strict=True)).numpy()
    at = index + fraction
    assert slope == pytest.approx(0.06 * at**2 - 0.2 * at + 0.3, abs=1e-5)


@pytest.mark.parametrize("moved", ["altitude", "sun"])
def test_what_is_scattered_has_a_smooth_slope(moved):
    """From one cell of a look-up to the next its slope does not jump, as that of a linear one does."""
    sky = Sky("earth", suns=(0.8, 1.0), fine=True)
    field, count = sky.bands[0].field, 201
    h, theta = np.full(count, 700.0), np.full(count, 0.9)
    if moved == "altitude":
        h = np.linspace(600.0, 800.0, count)
    else:
        theta = np.linspace(0.88, 0.92, count)
    at = {"altitude": floats(h), "sun": floats(np.cos(theta))}
    dr.enable_grad(at[moved])
    mu, cos_phi = floats(np.full(count, 0.3)), floats(np.full(count, 0.5))
    light = field.unclipped(at["altitude"], at["sun"], mu, cos_phi, True)[1][0]
    dr.forward(at[moved])
    slope = dr.grad(light).numpy()
    steps = np.abs(np.diff(slope))
    assert steps.max() < 5e-3 * np.abs(slope).mean(), steps.max() / np.abs(slope).mean()
