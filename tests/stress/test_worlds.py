"""Atmospheres of bench.stress in which light was wrong, and what was: each against the twin, in double precision."""

from __future__ import annotations

from random import Random

import numpy as np
import pytest
from twins import Twin

from bench.extremes import extreme_views, extreme_world
from bench.stress import PER_WORLD, Solved, check_derivatives, of_twin

# Quantity, and the worst that single precision is allowed there.
LIMITS = {"transmittance, twin": 1e-3, "sun irradiance, twin": 5e-4, "single scattering, twin": 1e-2}


# 38: air 205 m deep under a top 35,000 km up, which no ray was cut for.
@pytest.mark.parametrize("number", [38])
def test_light_is_that_of_the_twin(number):
    rng = Random(number)
    air = extreme_world(rng)
    views = extreme_views(rng, air, PER_WORLD)
    solved = Solved(air)
    errors = of_twin(air, views, [*solved.rays(views), *solved.irradiances(views)], Twin(air))
    worst = {name: float(np.max(values, initial=0.0)) for name, values in errors.items()}
    assert {name: worst[name] for name, limit in LIMITS.items() if worst.get(name, 0.0) > limit} == {}


# 0: rays without end, whose end was moved by infinity. 1: 92 scale heights of air, of which the topmost scatter 1e-40.
@pytest.mark.parametrize("number", [0, 1])
def test_derivatives_are_finite(number):
    rng = Random(number)
    air = extreme_world(rng, widths=(1, 1, 3))
    errors = check_derivatives(rng, air, extreme_views(rng, air, 50), 4)
    assert errors["derivatives not finite"].sum() == 0.0 and errors["adjoint identity"] < 1e-5
