"""Solves that are played back from a recording: right for other atmospheres, and out of the way of derivatives."""

import drjit as dr
import numpy as np
import pytest

import atmo_jit
from atmo_jit.backend import traversing, types
from atmo_jit.column import sun_columns
from atmo_jit.grid import Grid
from atmo_jit.multiple_scattering import solve
from atmo_jit.optics import Optics
from atmo_jit.resolution import Resolution

EARTH = atmo_jit.Atmosphere.load("earth")
CHANGES = {
    "as it is": {},
    "more haze": {"mie.scattering_per_m": 4.4e-6},
    "sharper haze": {"mie.phase.g": 0.79},
    "brighter ground, other gas": {"ground_albedo": 0.5, "rayleigh.scattering_per_m": [5e-6, 1.2e-5, 3e-5]},
}


def solved(air, change=None, orders=None):
    """The field for an atmosphere on the grid of EARTH; ``change`` acts on its optics."""
    optics = Optics(air, np.arange(3))
    if change is not None:
        change(optics)
    grid = Grid.of(EARTH, Resolution())
    return solve(optics, sun_columns(optics, grid), grid, Resolution(), orders, 0.01)


def parts(field):
    return [np.array(v.numpy()) for v in (field.moments, field.sky, field.reflected, field.reference.log)]


@pytest.mark.parametrize("orders", [None, 3])
def test_a_recording_gives_what_was_recorded(orders):
    """The first solve on a grid is plain, the second is recorded, later ones are played back."""
    Grid._known.clear()
    plain = {}
    for name, changes in CHANGES.items():
        plain[name] = parts(solved(EARTH.replace(changes), orders=orders))
        Grid._known.clear()
    for _ in range(3):
        for name, changes in CHANGES.items():
            for got, want in zip(parts(solved(EARTH.replace(changes), orders=orders)), plain[name], strict=True):
                assert got == pytest.approx(want, rel=1e-5, abs=float(1e-6 * np.abs(want).max())), name


def test_derivatives_pass_through_a_solve_on_a_recorded_grid():
    """d/d log(gas, green) of the light at the ground, forward and reverse, against central differences."""
    for _ in range(3):
        solved(EARTH, orders=2)

    def light(field):
        field.prepare()
        return field.irradiance(types().Float(0.0), types().Float(0.7))[1]

    def scaled(factor):
        def change(optics):
            optics.scattering[0][1] = optics.scattering[0][1] * factor
            optics.extinction[0][1] = optics.extinction[0][1] * factor

        return change

    factor = types().Float(1.0)
    dr.enable_grad(factor)
    irradiance = light(solved(EARTH, scaled(factor), orders=2))
    dr.forward(factor)
    dr.enable_grad(factor)
    again = light(solved(EARTH, scaled(factor), orders=2))
    with traversing():
        dr.backward(again)
    assert dr.grad(factor).numpy()[0] == pytest.approx(dr.grad(irradiance).numpy()[0], rel=1e-5)
    step = 0.02
    ends = [light(solved(EARTH, scaled(1.0 + sign * step), orders=2)).numpy()[0] for sign in (1, -1)]
    assert dr.grad(irradiance).numpy()[0] == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=0.02)
