"""What ``method`` does with a list of views, and that the result is the march's within the tolerance."""

from __future__ import annotations

import numpy as np
import pytest

import atmo_jit
from atmo_jit.backend import floats
from atmo_jit.bake import method as methods
from atmo_jit.bake.method import plan
from atmo_jit.bake.sky_view import SkyView
from atmo_jit.solved import Sky
from atmo_jit.views import check_views
from bench.worlds import WORLDS, world


def many(count: int = 6000, seed: int = 0, **fixed) -> dict:
    rng = np.random.default_rng(seed)
    views = {
        "altitude_m": 2.0,
        "sun_zenith_deg": 40.0,
        "view_zenith_deg": np.degrees(np.arccos(rng.uniform(-1, 1, count))),
        "azimuth_deg": rng.uniform(0, 360, count),
    }
    return {**views, **{k: v(rng, count) if callable(v) else v for k, v in fixed.items()}}


def any_sun(rng, count):
    return 80 * rng.random(count)


def any_altitude(rng, count):
    return 5e4 * rng.random(count) ** 3


def error(found, exact) -> np.ndarray:
    return np.abs(found - exact) / np.maximum(exact, 1e-3 * exact.max(axis=0))


@pytest.mark.parametrize("sun_disc", [False, True])
@pytest.mark.parametrize("ground", [False, True])
def test_one_observer_and_sun_get_a_sky_view(ground, sun_disc):
    exact = atmo_jit.sky("earth", many(), method="march", ground=ground, sun_disc=sun_disc)
    found = atmo_jit.sky("earth", many(), ground=ground, sun_disc=sun_disc)
    assert exact.meta["method"] == "march"
    assert found.meta["method"] == "tables" and found.meta["sky_views"] == 1 and not found.meta["tables_4d"]
    assert found.meta["views_by_tables"] > 5000 and found.meta["error_of_a_sample"] < found.meta["tolerance"]
    assert np.percentile(error(found.radiance, exact.radiance), 99) < 0.5 * found.meta["tolerance"]
    assert error(found.radiance, exact.radiance).max() < found.meta["tolerance"]
    np.testing.assert_allclose(found.transmittance, exact.transmittance, atol=2e-3)
    np.testing.assert_allclose(found.sky_irradiance, exact.sky_irradiance, rtol=1e-5)
    np.testing.assert_allclose(found.sun_irradiance, exact.sun_irradiance, rtol=1e-5)


@pytest.mark.parametrize("name", WORLDS)
def test_every_world_keeps_the_tolerance(name):
    """Any make-up of air, seen from the ground and from space; auto may take either way."""
    for altitude, sun in ((3.0, 50.0), (4e5, 30.0)):
        views = many(5000, altitude_m=altitude, sun_zenith_deg=sun)
        exact, found = (atmo_jit.sky(WORLDS[name], views, method=method) for method in ("march", "auto"))
        difference = error(found.radiance, exact.radiance)
        assert np.percentile(difference, 99) < 2e-3 and difference.max() < 5e-2, (altitude, sun)


@pytest.mark.parametrize("ozone", [None, {"absorption_per_m": 1e-6, "center_m": 22000, "half_width_m": 9000}])
def test_air_that_does_not_scatter(ozone):
    """Nothing to interpolate: the lit ground alone, behind clear or absorbing air."""
    spec = world(rayleigh=None, mie=None, ozone=ozone)
    exact, found = (atmo_jit.sky(spec, many(5000), method=method) for method in ("march", "tables"))
    assert found.meta["method"] == "march" and np.array_equal(found.radiance, exact.radiance)
    view = SkyView(Sky(spec), 2.0, 0.7)
    light, through = view.radiance(floats([0.5, 2.6]), floats([0.0, 1.0])), view.transmittance(floats([0.5, 2.6]))
    assert all(v.numpy()[0] == 0.0 and v.numpy()[1] > 0.0 for v in light)
    assert all(np.all(v.numpy() > 0.9) for v in through)


def test_few_views_are_marched():
    assert atmo_jit.sky("earth", many(20)).meta["method"] == "march"


def test_tables_on_request():
    views = many(400, altitude_m=any_altitude, sun_zenith_deg=any_sun)
    exact = atmo_jit.sky("earth", views, method="march")
    found = atmo_jit.sky("earth", views, method="tables")
    assert found.meta["method"] == "tables" and found.meta["tables_4d"] == 1
    assert np.percentile(error(found.radiance, exact.radiance), 95) < 1e-2
    few = atmo_jit.sky("earth", {**many(30), "sun_zenith_deg": np.repeat([10.0, 50.0, 85.0], 10)}, method="tables")
    assert few.meta["sky_views"] == 3 and few.meta["tables_4d"] == 0


def test_what_tables_cannot_do_is_marched(earth_sky):
    """Segments, rays beside the horizon, and rays that may meet a disc that is asked for."""
    views = check_views({**many(5000), "distance_m": np.where(np.arange(5000) % 2, 1e4, np.inf)})
    chosen = plan(earth_sky, views, "tables", 0.01, False)
    assert np.all(np.isinf(views["distance_m"][chosen.sky_views[0][2]])) and len(chosen.march) >= 2500
    level = check_views({**many(5000), "view_zenith_deg": np.linspace(85.0, 95.0, 5000)})
    chosen = plan(earth_sky, level, "auto", 0.01, False)
    assert np.abs(level["view_zenith_deg"][chosen.march] - 90.045).max() < methods.HORIZON_DEG + 0.01
    sun = check_views({**many(5000), "view_zenith_deg": np.linspace(38.0, 42.0, 5000)})
    assert len(plan(earth_sky, sun, "auto", 0.01, True).march) > 500
    assert len(plan(earth_sky, sun, "auto", 0.01, False).march) == 0


def test_a_tight_tolerance_is_marched(earth_sky):
    assert not plan(earth_sky, check_views(many()), "auto", 1e-3, False).sky_views


def test_every_view_is_taken_once(earth_sky):
    views = check_views(many(9000, altitude_m=lambda r, n: r.choice([1.0, 5e3, 4e5], n), sun_zenith_deg=any_sun))
    for name in ("auto", "tables"):
        for tolerance in (0.01, 0.05):
            chosen = plan(earth_sky, views, name, tolerance, False)
            taken = np.concatenate([chosen.march, chosen.tables, *(rows for *_, rows in chosen.sky_views)])
            assert sorted(taken.tolist()) == list(range(9000))


def test_tables_that_miss_the_tolerance_are_not_used(monkeypatch):
    """A wrong table is a wrong picture: auto compares a sample and goes back to the march."""
    right = methods.SkyView.radiance
    monkeypatch.setattr(methods.SkyView, "radiance", lambda *a: [1.05 * v for v in right(*a)])
    found = atmo_jit.sky("earth", many())
    assert found.meta["method"] == "march" and found.meta["tables_missed_by"] == pytest.approx(0.05, rel=0.1)
    assert np.array_equal(found.radiance, atmo_jit.sky("earth", many(), method="march").radiance)
