"""Peers: the same rays in the same order, and a reason where one is missing."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError

import numpy as np
import pytest

import atmo_jit
from bench import peers
from bench.reference import Case
from bench.truth import Truth

VIEWS = {
    "altitude_m": np.array([0.0, 2000.0, 0.0, 4e5]),
    "sun_zenith_deg": np.array([30.0, 30.0, 60.0, 30.0]),
    "view_zenith_deg": np.array([20.0, 60.0, 50.0, 175.0]),
    "azimuth_deg": np.array([0.0, 120.0, 40.0, 90.0]),
}


def test_discrete_ordinates_on_the_same_rays():
    pytest.importorskip("sasktran2")
    from bench.discrete_ordinates import DiscreteOrdinates

    air = atmo_jit.Atmosphere.load("earth").replace({"solar_irradiance": 1.0, "sun_angular_radius_deg": 0.0})
    found = DiscreteOrdinates(air).radiance(VIEWS)
    truth = atmo_jit.sky(air, VIEWS).radiance
    # It is 0.6 to 1.3 % too bright; wavelengths or rays in another order would differ by tens of per cent.
    assert found.shape == truth.shape and np.abs(found / truth - 1.0).max() < 0.03


def test_what_is_not_installed_is_said(monkeypatch):
    def missing(name):
        raise PackageNotFoundError(name)

    def none(truth, quick):
        return []

    monkeypatch.setattr(peers, "version", missing)
    monkeypatch.setattr(peers, "path_tracer", none)
    monkeypatch.setattr(peers, "emitters", none)
    skipped = []
    assert peers.rows(None, True, skipped) == []
    (entry,) = skipped
    assert entry["what"] == "sasktran2" and "atmo-jit[peers]" in entry["reason"]


@pytest.mark.parametrize("by_channel", [False, True])
def test_every_ray_is_asked_once_and_at_its_wavelength(by_channel):
    views = {"altitude_m": np.zeros(3)}
    cases = tuple(
        Case(name, {"value": value}, np.arange(3) + 3 * value, np.array([0, 1, 0]), views)
        for value, name in enumerate(("one", "two"))
    )
    zeros = np.zeros(6)
    truth = Truth("made up", cases, zeros + 1.0, zeros, zeros.astype(int), zeros)

    def solve(air):
        if by_channel:
            return lambda views, channel: air["value"] + 10.0 * channel
        return lambda views: air["value"] + 10.0 * np.arange(2) + np.zeros((3, 1))

    value, seconds = peers.asked(truth, solve, ("two",), by_channel=by_channel)
    assert np.isnan(value[:3]).all() and value[3:].tolist() == [1, 11, 1] and (seconds[3:] >= 0).all()
    # names that nobody has stand for all
    assert np.isfinite(peers.asked(truth, solve, ("three",), by_channel=by_channel)[0]).all()
