"""Density profiles: values, kinks and refusals, in NumPy and in Dr.Jit."""

from __future__ import annotations

import numpy as np
import pytest
from tolerances import FLOAT64, PROFILE_FLOAT32

from atmo_jit.errors import AtmosphereError
from atmo_jit.profile import Exponential, Tabulated, Tent, profile_from_dict

STEPS = Tabulated([1000.0, 2000.0, 2000.0, 5000.0], [1.0, 3.0, 0.5, 0.0])
ALTITUDES = np.array([0.0, 500.0, 1000.0, 1500.0, 1999.0, 2000.0, 2001.0, 3500.0, 4999.0, 5000.0, 5001.0, 9e4])


def test_exponential():
    profile = Exponential(8000.0)
    assert np.allclose(profile.density([0.0, 8000.0, 16000.0]), np.exp([0.0, -1.0, -2.0]), rtol=FLOAT64)
    assert profile.kinks_m == ()


def test_tent():
    profile = Tent(25e3, 15e3)
    heights = [0.0, 10e3, 17.5e3, 25e3, 32.5e3, 40e3, 60e3]
    assert np.allclose(profile.density(heights), [0, 0, 0.5, 1, 0.5, 0, 0], atol=FLOAT64)
    assert profile.kinks_m == (10e3, 25e3, 40e3)


def test_tabulated_is_linear_held_below_zero_above_and_steps_up_at_a_repeated_altitude():
    expected = [1, 1, 1, 2, 2.998, 0.5, 0.5 - 0.5 / 3000, 0.25, 0.5 / 3000, 0, 0, 0]
    assert np.allclose(STEPS.density(ALTITUDES), expected, atol=FLOAT64)
    assert STEPS.kinks_m == (1000.0, 2000.0, 5000.0)


def test_a_single_sample_is_a_uniform_layer():
    assert np.array_equal(Tabulated([100.0], [2.0]).density([0.0, 100.0, 100.1]), [2.0, 2.0, 0.0])


def test_a_tent_equals_its_table():
    table = Tabulated([10e3, 25e3, 40e3], [0.0, 1.0, 0.0])
    heights = np.linspace(0.0, 60e3, 121)
    assert np.allclose(table.density(heights), Tent(25e3, 15e3).density(heights), atol=FLOAT64)


@pytest.mark.parametrize(
    "profile", [Exponential(8000.0), Tent(3000.0, 1500.0), STEPS], ids=["exponential", "tent", "table"]
)
def test_shapes_follow_the_altitude(profile):
    assert np.shape(profile.density(10.0)) == ()
    assert profile.density(np.zeros((2, 3))).shape == (2, 3)


@pytest.mark.parametrize(
    "profile", [Exponential(8000.0), Tent(3000.0, 1500.0), STEPS], ids=["exponential", "tent", "table"]
)
def test_drjit_agrees_with_numpy(profile):
    from drjit.llvm.ad import Float

    density = profile.density(Float(ALTITUDES))
    assert type(density) is Float
    assert np.allclose(density.numpy(), profile.density(ALTITUDES), atol=PROFILE_FLOAT32)


def test_a_table_works_inside_a_symbolic_loop():
    import drjit as dr
    from drjit.llvm.ad import Float, UInt

    def step(i, total):
        return i + 1, total + STEPS.density(Float(i) * 500.0)

    _, total = dr.while_loop((UInt(0), Float(0.0)), lambda i, total: i < 12, step)
    assert np.allclose(total.numpy(), STEPS.density(np.arange(12) * 500.0).sum(), rtol=PROFILE_FLOAT32)


def test_derivatives_by_altitude_and_scale_height():
    import drjit as dr
    from drjit.llvm.ad import Float

    height, scale = Float(4000.0), Float(8000.0)
    dr.enable_grad(height, scale)
    dr.backward(Exponential(scale).density(height))
    density = np.exp(-0.5)
    assert np.isclose(dr.grad(height)[0], -density / 8000.0, rtol=PROFILE_FLOAT32)
    assert np.isclose(dr.grad(scale)[0], density * 4000.0 / 8000.0**2, rtol=PROFILE_FLOAT32)

    height = Float(1500.0)
    dr.enable_grad(height)
    dr.backward(STEPS.density(height))
    assert np.isclose(dr.grad(height)[0], 2.0 / 1000.0, rtol=PROFILE_FLOAT32)


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: Exponential(0.0), "scale_height_m"),
        (lambda: Exponential(float("nan")), "scale_height_m"),
        (lambda: Tent(-1.0, 5.0), "center_m"),
        (lambda: Tent(1.0, 0.0), "half_width_m"),
        (lambda: Tabulated([], []), "altitude_m"),
        (lambda: Tabulated([0.0, 1.0], [1.0]), "density"),
        (lambda: Tabulated([0.0, 2.0, 1.0], [1.0, 1.0, 1.0]), "altitude_m[2]"),
        (lambda: Tabulated([0.0, 1.0, 1.0, 1.0], [1.0, 1.0, 1.0, 1.0]), "altitude_m[3]"),
        (lambda: Tabulated([-1.0, 1.0], [1.0, 1.0]), "altitude_m[0]"),
        (lambda: Tabulated([0.0, 1.0], [1.0, -1.0]), "density[1]"),
        (lambda: profile_from_dict({}, "scale_height_m"), "scale_height_m"),
        (lambda: profile_from_dict({"center_m": 1.0}, "center_m", "half_width_m"), "half_width_m"),
        (lambda: profile_from_dict({"profile": 3}, "scale_height_m"), "profile"),
        (
            lambda: profile_from_dict({"profile": {"altitude_m": [0], "density": ["1"]}}, "scale_height_m"),
            "profile.density[0]",
        ),
    ],
)
def test_refusals_name_the_field(make, field):
    with pytest.raises(AtmosphereError) as caught:
        make()
    assert caught.value.field == field


def test_to_dict_round_trip():
    for profile, keys in ((Exponential(8000.0), ("scale_height_m",)), (Tent(2.0, 1.0), ("center_m", "half_width_m"))):
        assert profile_from_dict(profile.to_dict(), *keys) == profile
    again = profile_from_dict(STEPS.to_dict(), "scale_height_m")
    assert np.array_equal(again.altitude_m, STEPS.altitude_m) and np.array_equal(again.values, STEPS.values)
