"""Plans: every rule with its reason, and planned results against those with everything built."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from atmo_jit.atmosphere import Atmosphere
from atmo_jit.costs import Cost
from atmo_jit.errors import AtmosphereError, InputError
from atmo_jit.harmonics import pair_count
from atmo_jit.needs import TABLE_NODES, Needs
from atmo_jit.plan import OFF, compared, error_found, plan
from atmo_jit.resolution import Stage
from atmo_jit.sky import Sky, sky
from atmo_jit.views import check_views
from bench.methods import columns_of
from bench.worlds import WORLDS, views_of, world

EARTH = Atmosphere.load("earth")
VIEW = {"altitude_m": 2.0, "sun_zenith_deg": 60.0, "view_zenith_deg": [30.0, 60.0], "azimuth_deg": 40.0}


def made(atmosphere=EARTH, views=None, tolerance=0.03, free=(), sun_disc=False, **options):
    needs = Needs.of_views(atmosphere, {**VIEW, **(views or {})}, sun_disc=sun_disc, free=free)
    return plan(atmosphere, needs, tolerance=tolerance, **options)


def item(plan, name):
    (found,) = [i for i in plan.items if i.name == name]
    return found


def skipped(plan, name):
    found = item(plan, name)
    assert found.reason
    return not found.built


# --- constituents ---


def test_what_the_atmosphere_lacks_is_skipped():
    bare = made(EARTH.replace({"mie": None, "ozone": None}))
    assert skipped(bare, "aerosol") and skipped(bare, "ozone") and not skipped(bare, "rayleigh")
    assert item(bare, "ozone").reason == "the atmosphere has none"
    assert not any(skipped(made(), name) for name in ("aerosol", "ozone", "rayleigh"))


def test_constituents_of_zeros_are_left_out():
    zeros = EARTH.replace({"mie.scattering_per_m": 0.0, "ozone.absorption_per_m": 0.0})
    planned = made(zeros)
    assert skipped(planned, "aerosol") and "all 0" in item(planned, "aerosol").reason
    assert [c.name for c in planned.atmosphere.constituents] == ["rayleigh"]
    # ... unless a derivative by one of their values is asked
    assert [c.name for c in made(zeros, free=["mie.scattering_per_m"]).atmosphere.constituents] == ["rayleigh", "mie"]


def test_species_keep_their_names_where_one_is_free():
    two = WORLDS["two aerosols, five wavelengths"]
    zero = Atmosphere(two).replace({"mie.0.scattering_per_m": 0.0})
    assert [c.name for c in made(zero).atmosphere.mie] == ["mie.0"]
    assert [c.name for c in made(zero, free=["mie.1.scattering_per_m"]).atmosphere.mie] == ["mie.0", "mie.1"]


def test_gas_alone_needs_four_moments():
    planned = made(EARTH.replace({"mie": None}))
    assert planned.resolution.stages[-1].degree == 2 and "four moments" in item(planned, "moments of order 1").reason
    assert f"({pair_count(2)} moments)" in item(planned, "moments of later orders").size
    assert "four moments" not in item(made(), "moments of order 1").reason


def test_each_wavelength_says_what_it_needs():
    per_wavelength = [0.0, 0.0, 9e-5]
    planned = made(EARTH.replace({"mie.scattering_per_m": per_wavelength}))
    clear, hazy = item(planned, "needed at 680 nm").size, item(planned, "needed at 440 nm").size
    assert clear.startswith("l <= 2,") and hazy.startswith(f"l <= {planned.resolution.first_degree},")
    assert clear != hazy


def test_nothing_that_scatters():
    dark = EARTH.replace({"rayleigh": None, "mie": None})
    assert skipped(made(dark), "multiple scattering")
    assert skipped(made(orders=1), "multiple scattering")
    assert item(made(orders=3), "orders").size == "3"


def test_one_wavelength():
    one = made(Atmosphere(WORLDS["one gas, one wavelength"]))
    assert item(one, "wavelengths").size == "1 in 1 bands of at most 1"
    assert item(made(Atmosphere(WORLDS["two aerosols, five wavelengths"])), "wavelengths").size.startswith("5 in 2")


# --- ground, observers, suns ---


def test_black_ground():
    black = made(EARTH.replace({"ground_albedo": 0.0}), {"view_zenith_deg": [120.0, 30.0]})
    assert skipped(black, "light from the ground") and skipped(black, "ground's own radiance")
    assert not skipped(made(views={"view_zenith_deg": [120.0, 30.0]}), "ground's own radiance")
    assert skipped(made(), "ground's own radiance")  # no view meets it
    assert skipped(made(views={"view_zenith_deg": 120.0}, ground=False), "ground's own radiance")
    assert skipped(made(orders=1), "light from the ground")


def test_observers_in_space():
    assert skipped(made(), "entry from space")
    assert not skipped(made(views={"altitude_m": 1e6, "view_zenith_deg": 170.0}), "entry from space")


def test_fixed_sun_and_altitude_are_said():
    assert "one sun, 60 deg" in item(made(), "sun angles").reason and "2 m only" in item(made(), "altitudes").reason
    several = made(views={"sun_zenith_deg": [10.0, 60.0], "altitude_m": [0.0, 5e3]})
    assert "suns 10 to 60 deg" in item(several, "sun angles").reason
    assert "0 to 5000 m" in item(several, "altitudes").reason


@settings(max_examples=60, deadline=None)
@given(st.floats(0, 2e6), st.floats(0, 180), st.floats(0, 180), st.floats(0, 360), st.sampled_from([np.inf, 1e3, 3e5]))
def test_suns_along_the_rays_are_inside_the_range(h, s, v, a, stop):
    """The range holds the sun's zenith angle at every point of the ray in the air (by a fine walk along it)."""
    views = {"altitude_m": h, "sun_zenith_deg": s, "view_zenith_deg": v, "azimuth_deg": a, "distance_m": stop}
    low, high = Needs.of_views(EARTH, views).air_suns_deg
    t, r = np.linspace(0.0, min(stop, 6e6), 200_001), EARTH.bottom_radius_m + h
    mu, mu_s = np.cos(np.radians(v)), np.cos(np.radians(s))
    nu = mu * mu_s + np.sin(np.radians(v)) * np.sin(np.radians(s)) * np.cos(np.radians(a))
    there = np.sqrt(r * r + t * (2 * r * mu + t))
    under = np.flatnonzero(there < EARTH.bottom_radius_m)
    t, there = (x[: under[0]] if len(under) else x for x in (t, there))
    zenith = np.degrees(np.arccos(np.clip((r * mu_s + t * nu) / there, -1, 1)))[there <= EARTH.top_radius_m]
    if len(zenith):
        assert low - 0.01 <= zenith.min() and zenith.max() <= high + 0.01


# --- views ---


def test_a_table_where_it_pays():
    one = {"view_zenith_deg": np.full(TABLE_NODES + 1, 50.0)}
    assert made(views=one).method == "tables" and not skipped(made(views=one), "sky-view table")
    assert item(made(views=one), "march").size == f"{TABLE_NODES} rays"
    assert made().method == "march" and "fewer" in item(made(), "sky-view table").reason
    moving = {**one, "sun_zenith_deg": np.linspace(0, 90, TABLE_NODES + 1)}
    assert made(views=moving).method == "march" and "differ" in item(made(views=moving), "sky-view table").reason
    stopped = {**one, "distance_m": 1e3}
    assert made(views=stopped).method == "march" and "distances" in item(made(views=stopped), "sky-view table").reason


def test_aerial_perspective():
    assert skipped(made(), "aerial perspective")
    assert skipped(made(views={"distance_m": np.inf}), "aerial perspective")
    assert skipped(made(views={"distance_m": 1e9}), "aerial perspective")  # beyond the air
    assert not skipped(made(views={"distance_m": [1e3, np.inf]}), "aerial perspective")


def test_the_suns_disc():
    at_sun = {"view_zenith_deg": [60.1, 20.0], "azimuth_deg": 0.0}
    assert skipped(made(views=at_sun), "sun's disc")
    assert not skipped(made(views=at_sun, sun_disc=True), "sun's disc")
    assert skipped(made(sun_disc=True), "sun's disc")  # no view meets it
    opaque = made(views={**at_sun, "distance_m": 5e3}, sun_disc=True)
    assert skipped(opaque, "sun's disc") and "opaque" in item(opaque, "sun's disc").reason


def test_an_observers_table():
    needs = Needs.of_observer(EARTH, 2.0, 60.0, seen=False)
    planned = plan(EARTH, needs)
    assert planned.method == "tables" and needs.to_ground and needs.to_space
    assert "only its light" in item(planned, "sun's disc").reason
    night = plan(EARTH, Needs.of_observer(EARTH, 2.0, 95.0))
    assert skipped(night, "sun's disc") and "set" in item(night, "sun's disc").reason
    # from 10 km the horizon lies 3.2 degrees lower
    assert Needs.of_observer(EARTH, 10_000.0, 93.0).disc and not Needs.of_observer(EARTH, 10_000.0, 94.0).disc


# --- derivatives ---


def test_derivatives():
    assert skipped(made(), "derivatives") and made().derivatives == ()
    assert made(free=["solar_irradiance"]).derivatives == ()
    assert made(free=["ground_albedo"]).derivatives == ("order 1", "later orders", "ground")
    assert "columns" in made(free=["rayleigh.scale_height_m"]).derivatives
    assert "columns" not in made(free=["mie.phase.g", "ozone.absorption_per_m"]).derivatives
    with pytest.raises(InputError, match="--free mie.size: no value of that name; names are: .*mie.phase.g"):
        made(free=["mie.size"])


# --- what comes out ---


def test_bad_input():
    with pytest.raises(InputError, match="tolerance: is 2"):
        made(tolerance=2)
    with pytest.raises(InputError, match="orders: is 0"):
        made(orders=0)
    with pytest.raises(AtmosphereError, match="bottom_radius_m"):
        plan({**EARTH.to_dict(), "bottom_radius_m": -1}, Needs.of_views(EARTH, VIEW))


def test_json_holds_everything():
    planned = made(free=["mie.phase.g"])
    found = json.loads(json.dumps(planned.to_dict()))
    assert found["method"] == planned.method and len(found["items"]) == len(planned.items)
    assert found["predicted"]["cpu_s"] == pytest.approx(planned.predicted.cpu_s)
    assert found["needs"]["free"] == ["mie.phase.g"] and found["resolution"]["altitudes"] > 0
    assert isinstance(planned.predicted, Cost)


def test_predictions_that_are_off_are_said():
    assert compared(1.0, 1.9, "solve", "s") is None and compared(1.0, 0.51, "solve", "s") is None
    assert compared(1.0, 2.1, "solve", "s") == "solve: predicted 1 s, found 2.1 s, off by more than 2x"
    assert compared(2.2, 1.0, "memory", "MiB") is not None
    assert compared(0.0, 1.0, "views", "s") is None


def everything(atmosphere, views, **options):
    """The same radiance from an atmosphere that has every kind of constituent, be it with coefficients of 0.

    Their profiles have no kinks of their own: rays are cut at the same altitudes.
    """
    full = Atmosphere(atmosphere).to_dict()
    gas = full["rayleigh"]
    height = {name: gas[name] for name in ("scale_height_m", "profile") if name in gas}
    none = {"scattering_per_m": 0.0, "single_scattering_albedo": 1.0, **height}
    full["mie"] = full["mie"] or {**none, "phase": {"type": "isotropic"}}
    top = full["top_radius_m"] - full["bottom_radius_m"]
    flat = {"absorption_per_m": 0.0, "profile": {"altitude_m": [0, top], "density": [1, 1]}}
    full["ozone"] = full["ozone"] or flat
    return sky(Atmosphere(full), views, **options).radiance


PLANNED = {
    "gas alone": world(mie=None),
    "gas and zeros": world(mie={**world()["mie"], "scattering_per_m": 0.0, "scale_height_m": 5000}),
    "no ozone, black ground": world(ground_albedo=0.0),
    "uniform density": WORLDS["uniform density"],
    "one wavelength": WORLDS["one gas, one wavelength"],
}


@pytest.mark.parametrize("name", PLANNED)
def test_planned_results_are_those_of_everything_built(name):
    description = PLANNED[name]
    views = views_of(description, 6)
    planned = plan(description, Needs.of_views(description, views), tolerance=0.03)
    found = radiance(planned.solve(), views)
    truth = everything(description, views, tolerance=0.03)
    # Nothing times anything is nothing; what may differ is the rounding (6e-8 each) of sums of some hundred terms.
    assert largest_difference(found, truth) < 2e-5


@pytest.mark.parametrize(("altitude", "sun"), [(0.0, 50.0), (12_000.0, 85.0), (4e5, 30.0)])
def test_suns_that_are_not_looked_at_are_not_solved(altitude, sun):
    """... and what is left is the light of everything built: farther suns shine on no path of these views."""
    zenith, azimuth = np.linspace(3.0, 177.0, 30), np.linspace(0.0, 180.0, 30)
    views = {"altitude_m": altitude, "sun_zenith_deg": sun, "view_zenith_deg": zenith, "azimuth_deg": azimuth}
    planned = made(views=views)
    low, high = planned.solved_suns_deg
    assert low <= sun <= high and " of " in item(planned, "sun angles").size
    assert planned.predicted.solve_cpu_s < made(views={"sun_zenith_deg": [0.0, 95.0]}).predicted.solve_cpu_s
    changed = EARTH.replace({"mie.scattering_per_m": 8e-6})
    for air, found in ((EARTH, planned.solve()), (changed, planned.solve(changed))):
        truth = Sky(air, None, 0.03, planned.resolution)
        assert largest_difference(radiance(found, check_views(views)), radiance(truth, check_views(views))) < 2e-4


def test_all_suns_are_solved_where_views_have_them():
    views = {"view_zenith_deg": 40.0, "sun_zenith_deg": np.linspace(0.0, 105.0, 9)}
    assert made(views=views).solved_suns_deg is None and " of " not in item(made(views=views), "sun angles").size


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hillaire2020", "mars", "small planet"])
def test_errors_are_as_predicted_for_atmospheres_that_were_not_measured(name):
    air = Atmosphere.load(WORLDS.get(name, name))
    views = check_views(views_of(air.to_dict(), 40))
    planned = plan(air, Needs.of_views(air, views), tolerance=0.01)
    assert 0.0 < error_found(planned, views) < OFF * planned.predicted.error_percent


@pytest.mark.parametrize("tolerance", [0.1, 0.01])
def test_four_moments_are_exact_for_gas_alone(tolerance):
    """The resolution planned for air without aerosol gives what one with many moments gives."""
    air = Atmosphere(world(mie=None))
    views = views_of(air.to_dict(), 4)
    planned = plan(air, Needs.of_views(air, views), tolerance=tolerance)
    assert planned.resolution.first_degree == 2
    many = {"first_degree": 8, "first_azimuths": 12, "stages": (Stage(6, 4, 8, 6, 6),)}
    most = replace(planned.resolution, **many)
    found, truth = (radiance(s, views) for s in (planned.solve(), Sky(air, None, tolerance, most)))
    # What differs is the number of directions that later orders are gathered from.
    assert largest_difference(found, truth) < 0.01


def radiance(solved, views):
    """Radiance [N, W] of a Sky."""
    light = solved.rays(*columns_of(views))
    return np.stack([np.broadcast_to(v.numpy(), views["altitude_m"].shape) for v in light.radiance], -1)


def largest_difference(found, truth):
    """Relative, where there is light."""
    bright = truth > 1e-3 * truth.max()
    return np.abs(found[bright] / truth[bright] - 1.0).max()
