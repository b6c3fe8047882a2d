"""Error rows: percentiles of known errors, groups by their rays, and views that were left out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from atmo_jit.errors import InputError
from atmo_jit.resolution import Resolution
from bench.accuracy import all_orders_row
from bench.methods import METHODS, OwnSky, method_of, number_in, scaled
from bench.reference import Case
from bench.truth import HAZE, LIMB, TWILIGHT, Truth, flags

FLAG = np.array([0, 0, 4, 1, 2, 0, 4])
BETA = np.array([0.0, 0.0, 0.0, 0.0, 0.0, HAZE, HAZE])


@pytest.fixture
def truth():
    views = {"altitude_m": np.zeros(7)}
    cases = (
        Case("one", {"which": 1}, np.arange(4), np.zeros(4, int), {"altitude_m": views["altitude_m"][:4]}),
        Case("two", {"which": 2}, np.arange(4, 7), np.array([1, 0, 1]), {"altitude_m": views["altitude_m"][4:]}),
    )
    return Truth("made up", cases, np.full(7, 2.0), np.full(7, 0.01), FLAG, BETA)


def test_rows_by_group(truth):
    error = np.array([0.01, -0.03, 0.1, 0.2, 0.3, 0.02, 0.4])
    rows = {row["group"]: row for row in truth.rows(truth.L * (1 + error), np.arange(7.0))}
    assert {name: row["rays"] for name, row in rows.items()} == {
        "day": 3, "horizon": 2, "twilight": 1, "limb": 1, "haze": 1, "haze horizon": 1,
    }  # fmt: skip
    assert rows["day"]["max"] == pytest.approx(3.0) and rows["day"]["median"] == pytest.approx(2.0)
    # three sigma are 1.5 % of the truth
    assert rows["day"]["beyond_max"] == pytest.approx(1.5) and rows["day"]["beyond_median"] == pytest.approx(0.5)
    assert rows["haze horizon"]["p95"] == pytest.approx(40.0)
    assert rows["horizon"]["cpu_s"] == 4.0


def test_accuracy_and_the_groups_have_one_definition_of_the_95th_percentile(truth):
    value = truth.L * (1 + np.linspace(-0.1, 0.2, 7))
    day = np.flatnonzero(FLAG == 0)
    row = all_orders_row(value, {"L": truth.L, "L_sigma": truth.sigma}, day)
    expected = {key: truth.rows(value)[0][f"beyond_{key}"] for key in ("p95", "max")}
    assert {key: row[key] for key in expected} == pytest.approx(expected)


def test_rays_that_were_left_out_do_not_count(truth):
    value = np.where(np.arange(7) < 4, truth.L, np.nan)
    rows = {row["group"]: row for row in truth.rows(value)}
    assert rows["day"]["rays"] == 2 and rows["day"]["max"] == 0.0
    assert rows["haze"]["rays"] == 0 and rows["haze"]["p95"] is None and "cpu_s" not in rows["haze"]


def test_every_ray_gets_its_own_wavelength(truth):
    class Solved:
        def __init__(self, atmosphere):
            self.which = atmosphere["which"]

        def radiance(self, views):
            count = len(views["altitude_m"])
            return self.which * 10.0 + np.arange(2.0) + np.zeros((count, 1))

    value, seconds = truth.radiance(Solved)
    assert value.tolist() == [10, 10, 10, 10, 21, 20, 21]
    assert (seconds >= 0).all()
    value, _ = truth.radiance(Solved, ("two",))
    assert np.isnan(value[:4]).all() and np.isfinite(value[4:]).all()


def test_flags():
    views = {
        "altitude_m": np.array([0.0, 0.0, 0.0, 4e5, 4e5]),
        "sun_zenith_deg": np.array([10.0, 90.0, 95.0, 20.0, 91.0]),
        "view_zenith_deg": np.array([20.0, 89.0, 96.0, 110.0, 111.0]),
    }
    assert flags(views, 6e4).tolist() == [0, 4 + TWILIGHT, TWILIGHT, LIMB, LIMB + TWILIGHT]


def test_own_truth_is_what_it_says():
    truth = Truth.of_package(3, 0.03, 1.0)
    assert "this package" in truth.name and len(truth.L) == 3 * 12 and (truth.L > 0).all()
    assert all(row["rays"] for row in truth.rows(truth.L))
    value, _ = truth.radiance(lambda air: OwnSky(air, 0.03), once=True)
    # the same resolution, its orders summed to a tenth of that tolerance
    assert np.abs(value / truth.L - 1.0).max() < 3e-3


def test_scaled_resolutions():
    base = Resolution()
    half, twice = scaled(base, 0.5), scaled(base, 2.0)
    assert scaled(base, 1.0) == base
    assert (half.altitudes, twice.altitudes) == (base.altitudes // 2, 2 * base.altitudes)
    assert twice.orders == base.orders and twice.first_suns == base.first_suns
    assert scaled(base, 1e-3).suns == 4


def test_scaled_resolutions_inside_others():
    @dataclass(frozen=True)
    class Inner:
        degree: int = 6
        exact: bool = True

    @dataclass(frozen=True)
    class Outer:
        orders: int = 40
        stages: tuple = (Inner(), Inner(8, False))
        power: float = 2.5

    assert scaled(Outer(), 2.0) == Outer(40, (Inner(12), Inner(16, False)), 2.5)


@pytest.mark.parametrize("setting", ["", "tolerance", "tolerance x", "tolerance -1", "times 1", "tolerance 0"])
def test_settings_that_are_none(setting):
    with pytest.raises(InputError, match="setting"):
        number_in(setting, "tolerance")


def test_methods_by_name():
    assert method_of("hillaire2020") is METHODS["hillaire2020"]
    with pytest.raises(InputError, match="'magic'; must be one of atmo-jit"):
        method_of("magic")
