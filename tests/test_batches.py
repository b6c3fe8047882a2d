"""Derivatives of many views, in batches: those of all views at once."""

import numpy as np
import pytest

import atmo_jit
from atmo_jit import batches

VIEWS = 101
NAMES = ("mie.phase.g", "ground_albedo", "rayleigh.scale_height_m", "ozone.absorption_per_m")
OF_VIEWS = ("altitude_m", "sun_zenith_deg", "view_zenith_deg", "azimuth_deg")


@pytest.mark.parametrize("orders", [None, 1])
def test_views_in_batches(monkeypatch, orders):
    """Of 26 views each, the last filled up; played back as well."""
    rng = np.random.default_rng(0)
    ends = (0.0, 7e4), (0.0, 100.0), (0.0, 180.0), (0.0, 180.0)  # beyond the top of the air and to the ground too
    views = {name: rng.uniform(*both, VIEWS) for name, both in zip(OF_VIEWS, ends, strict=True)}
    weights = {"radiance": rng.normal(size=(VIEWS, 3)), "sky_irradiance": rng.normal(size=(VIEWS, 3))}
    at = atmo_jit.Linearization("earth", views, orders=orders)
    wanted = at.vjp(weights, (*NAMES, *OF_VIEWS))
    monkeypatch.setattr(batches, "MOST", 30)
    for _ in range(3):
        found = at.vjp(weights, (*NAMES, *OF_VIEWS))
        for name, value in found.items():
            assert value == pytest.approx(wanted[name], rel=1e-5, abs=float(1e-6 * np.abs(wanted[name]).max())), name


def test_batches_are_of_one_size():
    assert batches.Batches.of(batches.MOST, [None]) is None
    many = batches.Batches.of(3 * batches.MOST + 1, [None])
    begins = [int(begin[0]) for begin in many.begins()]
    assert len(begins) == 4 and begins[-1] < many.rays <= begins[-1] + many.size <= len(begins) * many.size
