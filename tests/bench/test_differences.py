"""Fine derivatives on a random atmosphere against those on more nodes: a sample of what bench.differences measures."""

from __future__ import annotations

import numpy as np
import pytest

from atmo_jit import Atmosphere, Linearization
from bench.differences import COARSER, LIMITS, SMALL, drawn, finer, table

HAZY = 1  # the seed of an atmosphere whose light along the horizon asks for nodes near the ground
NAMES = ["mie.scattering_per_m", "ground_albedo", "view_zenith_deg"]


@pytest.mark.slow
def test_fine_derivatives_are_those_of_more_nodes():
    description, views = drawn(np.random.default_rng(HAZY))
    air = Atmosphere.load(description)
    at = Linearization(air, views, fine=True)
    ours = at.jacobian(NAMES)
    truth = Linearization(air, views, fine=True, resolution=finer(at.sky.resolution, *COARSER)).jacobian(NAMES)
    near = views["view_zenith_deg"] >= 89.0
    for name in NAMES:
        errors = np.abs(ours[name] - truth[name]) / np.maximum(
            np.abs(truth[name]), SMALL * np.abs(truth[name]).max(axis=0)
        )
        for there, (_, limit) in zip((errors[~near], errors[near]), LIMITS, strict=True):
            assert np.quantile(there, 0.9) < limit, name


def test_the_table_has_both_parts():
    errors = np.array([[1e-4, 2e-3, 5e-3, 2e-2], [1e-5, 1e-5, 1e-5, 1e-5], [0.0, 0.0, 1.0, 1.0], [1.0, 0.0, 1.0, 1.0]])
    rows = [line for line in table({"ground_albedo": errors}).splitlines() if "ground_albedo" in line]
    assert len(rows) == 2
    assert ["50% | 100% |" in row for row in rows] == [True, False]
    assert "50% | 50% |" in rows[1]
