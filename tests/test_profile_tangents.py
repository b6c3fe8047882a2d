"""How tables of columns change with the numbers of the profiles, against differences."""

from __future__ import annotations

import drjit as dr
import numpy as np
import pytest

from atmo_jit import Atmosphere
from atmo_jit.backend import traversing
from atmo_jit.column import sun_columns
from atmo_jit.grid import Grid
from atmo_jit.optics import Optics
from atmo_jit.path_weights import columns_along
from atmo_jit.paths import Paths
from atmo_jit.resolution import Resolution

STEP = 1e-2  # relative: in single precision rounding of a column is 1e-5 of the difference


def tables(kind, optics, grid, points):
    if kind == "paths":
        return list(vars(columns_along(optics, points)).values())
    return [sun_columns(optics, grid).table]


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
        found = tables(kind, optics, grid, points)
        dr.set_grad(leaf, value)
        dr.enqueue(dr.ADMode.Forward, leaf)
        dr.traverse(dr.ADMode.Forward)
        found = [np.array(dr.grad(table)) for table in found]
    ends = []
    for sign in (1.0, -1.0):
        moved, _, own = world(name, 1.0 + sign * STEP)
        columns = sun_columns(optics, grid) if kind == "sun" else None
        ends.append([columns.of(moved).table] if columns else tables(kind, moved, grid, own))
    for table, up, down in zip(found, *ends, strict=True):
        want = (np.array(up, dtype=float) - np.array(down, dtype=float)) / (2.0 * STEP)
        assert np.abs(want).max() > 0.0
        # A tent has corners, which differences round off.
        assert np.mean(np.abs(table - want)) < 0.02 * np.mean(np.abs(want))
        if not name.startswith("ozone"):
            assert np.abs(table - want).max() < 2e-3 * np.abs(want).max()
