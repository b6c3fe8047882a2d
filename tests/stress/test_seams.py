"""Light does not jump where one way to compute it ends and another begins, in random atmospheres (bench.seams)."""

from __future__ import annotations

from random import Random

import pytest

import atmo_jit
from bench.extremes import extreme_world
from bench.seams import jumps

JUMP = 0.005  # relative, between views 3e-7 rad apart: 0.003 where the sun's cosine next to the zenith comes in steps
AT_HORIZON = 0.05  # up to it from the ground's side distances end as a square root: as steep as that in thin air


# 27: columns toward the sun, through layers some metres thick on a planet of 53,000 km, came in steps.
# 31: beside the sun's zenith, where 0 and 2.4e-4 radians have the same cosine, light jumped by 1.5 %.
@pytest.mark.parametrize(
    "number",
    [
        *(1, 2, 8, 27, 31),
        *(pytest.param(n, marks=pytest.mark.slow) for n in (0, 7, 9, 14, 16, 18, 20, 29, 35)),
    ],
)
def test_light_has_no_seams(number):
    rng = Random(number)
    air = extreme_world(rng, widths=(1, 3))
    found = jumps(atmo_jit.Sky(air), air, rng)
    assert {way: jump for way, jump in found.items() if jump > (AT_HORIZON if "horizon" in way else JUMP)} == {}
