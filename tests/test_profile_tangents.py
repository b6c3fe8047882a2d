"""How columns change with the numbers of the profiles, against differences."""

from __future__ import annotations

import drjit as dr
import numpy as np
import pytest

from atmo_jit import Atmosphere
from atmo_jit.backend import floats, traversing
from atmo_jit.column import sun_columns
from atmo_jit.grid import Grid
from atmo_jit.optics import Optics
from atmo_jit.path_weights import columns_along
from atmo_jit.paths import Paths
from atmo_jit.resolution import Resolution

STEP = 1e-2  # relative: in single precision rounding of a column is 1e-5 of the difference


def columns(kind, optics, grid, points):
    """Tables of columns along paths; or columns toward suns above and below the horizon, by constituent."""
    if kind == "paths":
        return list(vars(columns_along(optics, points)).values())
    h, mu = (floats(v) for v in (np.repeat([0.0, 3e3, 2e4], 3), np.tile([-0.01, 0.02, 0.8], 3)))
    toward_sun = sun_columns(optics, grid)
    if not optics.profiles_differentiable:
        toward_sun = toward_sun.of(optics)  # on the same nodes
    return [*toward_sun.toward(h, mu), *toward_sun.upward(h)]


def world(name="rayleigh.scale_height_m", factor=1.0):
    air = Atmosphere.load("earth")
    air = air.replace({name: air.given(name) * factor})
    grid = Grid.of(Atmosphere.load("earth"), Resolution.suited(air, 0.03))
    paths = Paths.trace(grid, np.array([0.0, 30000.0, 20000.0]), np.array([1.0, -0.05, -1.0]), 2)
    return Optics(air, np.arange(3)), grid, paths.points(4)


@pytest.mark.parametrize("kind", ["paths", "sun"])
@pytest.mark.parametrize(
    ("name", "constituent", "number"),
    [("rayleigh.scale_height_m", 0, 0), ("mie.scale_height_m", 1, 0), ("ozone.half_width_m", 2, 1)],
)
def test_tangents_are_those_of_differences(kind, name, constituent, number):
    optics, grid, points = world()
    value = Atmosphere.load("earth").given(name)
    with traversing():
        leaf = optics.profiles[constituent][number]
        dr.enable_grad(leaf)
        found = columns(kind, optics, grid, points)
        dr.set_grad(leaf, value)
        dr.enqueue(dr.ADMode.Forward, leaf)
        dr.traverse(dr.ADMode.Forward)
        found = [np.array(dr.grad(values)) for values in found]
    ends = [columns(kind, *world(name, 1.0 + sign * STEP)) for sign in (1.0, -1.0)]
    assert any(np.any(derivative) for derivative in found)
    for derivative, up, down in zip(found, *ends, strict=True):
        want = (np.array(up, dtype=float) - np.array(down, dtype=float)) / (2.0 * STEP)
        rounding = 1e-5 * np.abs(up).max()
        if name.startswith("ozone") and len(want) == len(points.h) * 4:
            # A tent has corners, which differences round off: not at points that a corner passes.
            corners = np.array(optics.constituents[constituent].profile.kinks_m)
            beside = np.any(np.abs(points.h[:, None] - corners) < 2.0 * STEP * value, axis=1)
            derivative, want = (np.where(np.repeat(beside, 4), 0.0, v) for v in (derivative, want))
        assert np.mean(np.abs(derivative - want)) <= 0.02 * np.mean(np.abs(want)) + rounding
        if not name.startswith("ozone"):
            assert np.abs(derivative - want).max() <= 2e-3 * np.abs(want).max() + rounding
