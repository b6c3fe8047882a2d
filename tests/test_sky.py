"""What must hold for any sky: orders add up, light is linear in the sun, mirror symmetry, segments, space, the disc."""

from __future__ import annotations

import numpy as np
import pytest
from tolerances import DOUBLE
from twins import Twin

import atmo_jit
from atmo_jit.backend import double_precision, doubles
from atmo_jit.solved import Sky
from bench.worlds import WORLDS, views_of, world

SPEC = WORLDS["small planet"]


@pytest.fixture(scope="module")
def views():
    return views_of(SPEC, 30, seed=5)


@pytest.fixture(scope="module")
def full(views):
    return atmo_jit.sky(SPEC, views)


def at(**columns):
    """Views from columns of one length or single numbers."""
    names = ("altitude_m", "sun_zenith_deg", "view_zenith_deg", "azimuth_deg", "distance_m")
    shape = np.broadcast_shapes(*(np.shape(value) for value in columns.values()))
    given = {"altitude_m": 0.0, "sun_zenith_deg": 40.0, "view_zenith_deg": 50.0, "azimuth_deg": 60.0, **columns}
    return {name: np.array(np.broadcast_to(given[name], shape or (1,)), float) for name in names if name in given}


def test_result_has_the_contract_s_arrays(full, views):
    count = views["altitude_m"].size
    for name in ("radiance", "transmittance", "sun_irradiance", "sky_irradiance"):
        array = getattr(full, name)
        assert array.dtype == np.float32
        assert array.shape == (count, 3)
        assert np.all(np.isfinite(array))
        assert np.all(array >= 0)
    assert np.all(full.transmittance <= 1)
    assert isinstance(full.meta, dict)


def test_orders_add_up(full, views):
    """Each order adds light, ever less; all orders are the limit."""
    sums = [atmo_jit.sky(SPEC, views, orders=n).radiance.astype(float) for n in (1, 2, 3, 6)]
    sums.append(full.radiance.astype(float))
    scale = full.radiance.max(axis=0)
    for fewer, more in zip(sums[:-1], sums[1:], strict=True):
        assert np.all(more >= fewer * (1 - 1e-4) - 1e-7 * scale)
    lit = full.radiance > 1e-3 * scale
    assert np.mean((sums[4] - sums[3])[lit] / sums[4][lit]) < 0.05
    assert np.mean((sums[1] - sums[0])[lit]) > np.mean((sums[2] - sums[1])[lit])


def test_order_one_and_all_orders_share_transmittance_and_sun(full, views):
    one = atmo_jit.sky(SPEC, views, orders=1)
    assert one.transmittance == pytest.approx(full.transmittance, abs=1e-6)
    assert one.sun_irradiance == pytest.approx(full.sun_irradiance, rel=1e-6)
    assert np.all(one.sky_irradiance <= full.sky_irradiance * 1.001)


def test_linear_in_solar_irradiance(full, views):
    """Twice the sun in one channel is twice the light there, and nothing else changes."""
    brighter = atmo_jit.sky({**SPEC, "solar_irradiance": [3.0, 1.9, 2.0]}, views)
    for name in ("radiance", "sun_irradiance", "sky_irradiance"):
        assert getattr(brighter, name) == pytest.approx(getattr(full, name) * np.array([2, 1, 1]), rel=2e-4, abs=1e-12)
    assert brighter.transmittance == pytest.approx(full.transmittance, abs=1e-7)


def test_mirror_symmetry(full, views):
    """Left and right of the sun's vertical plane are alike, and a turn is a turn."""
    left = atmo_jit.sky(SPEC, {**views, "azimuth_deg": -views["azimuth_deg"]})
    turned = atmo_jit.sky(SPEC, {**views, "azimuth_deg": views["azimuth_deg"] + 720})
    scale = full.radiance.max(axis=0)
    assert np.abs(left.radiance - full.radiance).max() <= (1e-4 * scale).max()
    assert np.abs(turned.radiance - full.radiance).max() <= (1e-4 * scale).max()


def test_channels_do_not_mix(full, views):
    """Each wavelength alone gives what it gives in company."""
    for channel in (0, 2):
        alone = {
            **SPEC,
            "wavelengths_nm": [SPEC["wavelengths_nm"][channel]],
            "solar_irradiance": [SPEC["solar_irradiance"][channel]],
            "rayleigh": {**SPEC["rayleigh"], "scattering_per_m": SPEC["rayleigh"]["scattering_per_m"][channel]},
            "mie": {**SPEC["mie"], "single_scattering_albedo": SPEC["mie"]["single_scattering_albedo"][channel]},
            "ground_albedo": SPEC["ground_albedo"][channel],
        }
        got = atmo_jit.sky(alone, views).radiance[:, 0]
        assert got == pytest.approx(full.radiance[:, channel], rel=5e-3, abs=1e-7)


def test_ground_s_own_radiance_is_what_no_ground_leaves_out(full, views):
    """The difference is the lit ground seen through the air; rays that miss the ground do not change."""
    without = atmo_jit.sky(SPEC, views, ground=False)
    mu = np.cos(np.radians(views["view_zenith_deg"]))
    hits = Twin(SPEC).hits_ground(views["altitude_m"], mu)
    assert full.radiance[~hits] == pytest.approx(without.radiance[~hits], rel=1e-5, abs=1e-9)
    assert np.all(full.radiance[hits] >= without.radiance[hits] * (1 - 1e-5))
    # Straight down from 1 m: the ground's radiance is albedo / pi times both irradiances there.
    down = at(altitude_m=1.0, view_zenith_deg=180.0, sun_zenith_deg=[20.0, 70.0, 88.0])
    seen = atmo_jit.sky(SPEC, down)
    glow = np.array(SPEC["ground_albedo"]) / np.pi * (seen.sun_irradiance + seen.sky_irradiance)
    assert seen.radiance == pytest.approx(glow, rel=3e-3)


@pytest.mark.parametrize("planet", ["small", "earth"])
def test_irradiance_is_the_integral_of_radiance(planet):
    """The sky's irradiance against a quadrature over 32 x 12 directions of its own radiance.

    On the ground to 0.5 %, the issue's figure for a plane lit by the emitter (sun elevations 90, 45, 5, 0, -4); aloft
    to 1 %.
    """
    x, w = np.polynomial.legendre.leggauss(32)
    root, azimuth = (x + 1) / 2, np.pi * (np.arange(12) + 0.5) / 12
    mu, weight = root**2, w / 2 * 2 * root**3 * 2 * np.pi
    zenith, turn = (np.degrees(v).ravel() for v in np.meshgrid(np.arccos(mu), azimuth, indexing="ij"))
    sun = np.array([0.0, 45.0, 85.0, 90.0, 94.0, 60.0, 45.0])
    height = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 8000.0, 20000.0])
    views = at(
        altitude_m=np.repeat(height, zenith.size),
        sun_zenith_deg=np.repeat(sun, zenith.size),
        view_zenith_deg=np.tile(zenith, sun.size),
        azimuth_deg=np.tile(turn, sun.size),
    )
    result = atmo_jit.sky(SPEC if planet == "small" else "earth", views)
    radiance = result.radiance.astype(float).reshape(sun.size, 32, 12, 3).mean(axis=2)
    summed = np.einsum("z,szw->sw", weight, radiance)
    error = np.abs(result.sky_irradiance[:: zenith.size] / summed - 1).max(axis=1)
    assert np.all(error < np.where(height > 0, 0.01, 0.005)), dict(
        zip(zip(sun, height, strict=True), error, strict=True)
    )


# --- segments ---


def test_segment_beyond_the_end_is_the_whole_ray(full, views):
    for distance in (np.inf, 1e8):
        far = atmo_jit.sky(SPEC, {**views, "distance_m": np.full(views["altitude_m"].size, distance)})
        assert far.radiance == pytest.approx(full.radiance, rel=1e-5, abs=1e-9)
        assert far.transmittance == pytest.approx(full.transmittance, abs=1e-6)


def test_segment_of_no_length_is_clear(views):
    near = atmo_jit.sky(SPEC, {**views, "distance_m": np.zeros(views["altitude_m"].size)})
    on_ground = (views["altitude_m"] == 0) & (views["view_zenith_deg"] > 90)
    assert np.all(near.radiance[~on_ground] == 0)
    assert np.all(near.transmittance == 1)


def test_segments_join(views):
    """L(0, d) = L(0, a) + T(0, a) L(a, d): a long segment is two short ones, one behind the other."""
    radius, h, zenith, sun, turn = SPEC["bottom_radius_m"], 500.0, 65.0, 50.0, 40.0
    first, whole = 8000.0, 30000.0
    mu, mu_s = np.cos(np.radians([zenith, sun]))
    nu = mu * mu_s + np.sin(np.radians(zenith)) * np.sin(np.radians(sun)) * np.cos(np.radians(turn))
    r = radius + h
    r_end = np.sqrt(r**2 + 2 * r * mu * first + first**2)
    mu_end, mu_s_end = (r * mu + first) / r_end, (r * mu_s + first * nu) / r_end
    sines = np.sqrt((1 - mu_end**2) * (1 - mu_s_end**2))
    turn_end = np.degrees(np.arccos((nu - mu_end * mu_s_end) / sines))
    parts = atmo_jit.sky(
        SPEC,
        at(
            altitude_m=[h, h, r_end - radius],
            sun_zenith_deg=[sun, sun, np.degrees(np.arccos(mu_s_end))],
            view_zenith_deg=[zenith, zenith, np.degrees(np.arccos(mu_end))],
            azimuth_deg=[turn, turn, turn_end],
            distance_m=[whole, first, whole - first],
        ),
    )
    light, clear = parts.radiance.astype(float), parts.transmittance.astype(float)
    assert light[0] == pytest.approx(light[1] + clear[1] * light[2], rel=2e-3)
    assert clear[0] == pytest.approx(clear[1] * clear[2], rel=1e-5)


def test_segments_grow(views):
    """Longer segments are brighter and dimmer to see through, at any scale from a centimetre on."""
    distance = np.geomspace(0.01, 1e6, 60)
    for zenith in (30.0, 89.9, 91.0):
        result = atmo_jit.sky(SPEC, at(altitude_m=100.0, view_zenith_deg=zenith, distance_m=distance), ground=False)
        assert np.all(np.diff(result.radiance, axis=0) >= -1e-5 * result.radiance[1:])
        assert np.all(np.diff(result.transmittance, axis=0) <= 1e-6)
        assert np.all(result.radiance[0] > 0)


# --- outside ---


def test_views_past_the_planet_see_nothing():
    """From space: a ray that misses the air is black and clear; one that enters it is not."""
    height = 3e5
    edge = 180 - np.degrees(np.arcsin(SPEC["top_radius_m"] / (SPEC["bottom_radius_m"] + height)))
    views = at(altitude_m=height, view_zenith_deg=[0.0, 90.0, edge - 0.01, edge + 1.0], sun_zenith_deg=30.0)
    result = atmo_jit.sky(SPEC, views)
    assert np.all(result.radiance[:3] == 0)
    assert np.all(result.transmittance[:3] == 1)
    assert np.all(result.radiance[3] > 0)


def test_leaving_the_top_is_continuous():
    """A metre below and a metre above the top see the same."""
    top = SPEC["top_radius_m"] - SPEC["bottom_radius_m"]
    zenith = np.array([100.0, 105.0, 120.0, 180.0])
    low, high = (atmo_jit.sky(SPEC, at(altitude_m=top + step, view_zenith_deg=zenith)) for step in (-1.0, 1.0))
    assert high.radiance == pytest.approx(low.radiance, rel=2e-3)
    assert high.transmittance == pytest.approx(low.transmittance, abs=1e-4)
    assert high.sun_irradiance == pytest.approx(low.sun_irradiance, rel=1e-3)


def test_segment_ends_before_the_air_begins():
    """From 300 km, a segment that stops above the top crosses no air."""
    views = at(altitude_m=3e5, view_zenith_deg=180.0, distance_m=[2.4e5, 2.6e5])
    result = atmo_jit.sky(SPEC, views)
    assert np.all(result.radiance[0] == 0) and np.all(result.transmittance[0] == 1)
    assert np.all(result.radiance[1] > 0) and np.all(result.transmittance[1] < 1)


def test_night():
    """With the sun deep under the ground there is less than a millionth of the day's light, and nothing is NaN."""
    night = at(sun_zenith_deg=[150.0, 180.0, 170.0], view_zenith_deg=[0.0, 90.0, 180.0], altitude_m=10.0)
    result = atmo_jit.sky(SPEC, night)
    day = atmo_jit.sky(SPEC, {**night, "sun_zenith_deg": np.full(3, 30.0)})
    assert np.all(np.isfinite(result.radiance)) and np.all(result.radiance >= 0)
    assert np.all(result.radiance < 1e-6 * day.radiance)
    assert np.all(result.sun_irradiance == 0)


# --- the sun's disc ---


def test_sun_disc_adds_its_irradiance():
    """Over its solid angle the disc carries E T: the irradiance of the sun through the air."""
    radius_deg = 1.0
    spec = world(sun_angular_radius_deg=radius_deg)
    sun = 35.0
    offset = np.array([0.0, 0.5, 0.9, 1.1, 3.0])
    views = at(sun_zenith_deg=sun, view_zenith_deg=sun + offset, azimuth_deg=0.0)
    without, with_disc = (atmo_jit.sky(spec, views, sun_disc=flag) for flag in (False, True))
    added = with_disc.radiance.astype(float) - without.radiance
    assert np.all(added[3:] == 0)
    solid_angle = 2 * np.pi * (1 - np.cos(np.radians(radius_deg)))
    mean = np.array(spec["solar_irradiance"]) * Twin(spec).transmittance(0.0, np.cos(np.radians(sun)))[0] / solid_angle
    # A uniform disc is the mean everywhere; with a darkened limb the middle is brighter, by 60 % at most.
    assert np.all(added[0] >= 0.99 * mean) and np.all(added[0] < 1.6 * mean)
    assert np.all(np.diff(added[:3], axis=0) <= 1e-3 * mean)


def test_sun_disc_is_hidden_by_the_ground_and_by_segments():
    zenith, stop = [100.0, 40.0], [np.inf, 1000.0]
    views = at(sun_zenith_deg=zenith, view_zenith_deg=zenith, azimuth_deg=0.0, distance_m=stop)
    without, with_disc = (atmo_jit.sky(SPEC, views, sun_disc=flag) for flag in (False, True))
    assert np.array_equal(without.radiance, with_disc.radiance)


# --- the interfaces ---


def test_sky_class_gives_what_the_function_gives(full, views):
    """``Sky`` in Dr.Jit and radians is the function in NumPy and degrees."""
    from drjit.llvm.ad import Float

    angles = (np.radians(views[f"{name}_deg"]).astype(np.float32) for name in ("sun_zenith", "view_zenith", "azimuth"))
    solved = atmo_jit.Sky(SPEC)
    rays = solved.rays(Float(views["altitude_m"].astype(np.float32)), *(Float(a) for a in angles))
    got = np.stack([np.array(channel) for channel in rays.radiance], axis=-1)
    assert got == pytest.approx(full.radiance, rel=5e-3, abs=2e-5)
    sun, sky = solved.irradiance(Float([0.0, 5000.0]), Float([0.5, 1.2]))
    direct = atmo_jit.sky(SPEC, at(altitude_m=[0.0, 5000.0], sun_zenith_deg=np.degrees([0.5, 1.2])))
    assert np.stack(sun, axis=-1) == pytest.approx(direct.sun_irradiance, rel=1e-4)
    assert np.stack(sky, axis=-1) == pytest.approx(direct.sky_irradiance, rel=1e-4)


def test_single_numbers_and_lists_are_views():
    """Views broadcast: one number stands for all, lists do as well as arrays."""
    result = atmo_jit.sky(
        SPEC, {"altitude_m": 2.0, "sun_zenith_deg": 60.0, "view_zenith_deg": [0.0, 45.0], "azimuth_deg": 90.0}, orders=1
    )
    assert result.radiance.shape == (2, 3)


@pytest.mark.parametrize("sun_deg", [0.0, 50.0, 91.0])
def test_a_range_of_suns_gives_what_all_suns_give(sun_deg):
    """Nodes farther away than light comes from cannot matter: 2e-4 is ten times what they do."""
    views = {
        "altitude_m": np.array([0.0, 0.0, 4000.0, 30000.0, 2e5]),
        "view_zenith": np.radians([20.0, 88.0, 110.0, 60.0, 160.0]),
        "azimuth": np.radians([0.0, 60.0, 120.0, 180.0, 30.0]),
    }
    sun = np.radians(sun_deg)
    whole, part = (
        np.stack(
            [
                v.numpy()
                for v in Sky("earth", suns=suns)
                .rays(
                    doubles(views["altitude_m"]),
                    doubles(np.full(5, sun)),
                    doubles(views["view_zenith"]),
                    doubles(views["azimuth"]),
                )
                .radiance
            ]
        )
        for suns in (None, (sun, sun))
    )
    assert part == pytest.approx(whole, rel=2e-4)


def test_rays_come_in_the_order_in_which_they_were_asked():
    """NumPy arrays are reordered for speed and put back; Dr.Jit's are not."""
    solved, rng = Sky(SPEC, tolerance=0.1), np.random.default_rng(5)
    columns = [4e5 * rng.random(60) ** 4, *(top * rng.random(60) for top in (1.8, np.pi, np.pi))]
    found, exact = solved.rays(*columns), solved.rays(*map(doubles, columns))
    for a, b in zip(found.radiance + found.transmittance, exact.radiance + exact.transmittance, strict=True):
        assert np.allclose(a.numpy(), b.numpy(), rtol=1e-5)


def test_later_orders_at_the_terminator_seen_from_space(monkeypatch):
    """Long pieces of limb rays see many suns: uncut they are 27 % off; cut eight times finer they change by 8 %."""
    solved = Sky("earth", tolerance=0.03)
    tangent = np.linspace(2e3, 3.4e4, 33)
    view = np.pi - np.arcsin((6.36e6 + tangent) / 6.76e6)
    columns = [np.full(33, 4e5), np.full(33, np.radians(84.0)), view, np.full(33, 3.1)]
    found = solved.rays(*columns).radiance
    monkeypatch.setattr("atmo_jit.march.MAX_TURN", 0.004)
    exact = solved.rays(*columns).radiance
    assert max(np.abs(a.numpy() / b.numpy() - 1.0).max() for a, b in zip(found, exact, strict=True)) < 0.12


def test_nodes_of_another_profile_serve():
    """On the nodes of ``layout``, whose own columns are kept with them, light is that of the atmosphere's own."""
    air = atmo_jit.Atmosphere.load("earth").replace({"mie.scattering_per_m": 1e-4})
    thin = air.replace({"mie.scale_height_m": 600.0})
    views = [doubles(v) for v in (np.zeros(3), np.full(3, 1.0), np.radians([20.0, 60.0, 85.0]), np.full(3, 2.0))]
    solved = Sky(air)  # leaves its columns with its nodes
    own, elsewhere = (
        Sky(thin, resolution=solved.resolution, layout=layout).rays(*views).radiance for layout in (None, air)
    )
    for a, b in zip(own, elsewhere, strict=True):
        assert b.numpy() == pytest.approx(a.numpy(), rel=5e-3)


def test_single_precision_is_as_good_as_double():
    rays = [doubles(v) for v in ([0.0, 200.0, 200.0], [1.4, 1.4, 0.3], [0.2, 1.56, 1.2], [0.5, 2.0, 1.0])]
    found = [v.numpy() for v in Sky("earth").rays(*rays).radiance]
    with double_precision():
        exact = [v.numpy() for v in Sky("earth").rays(*rays).radiance]
    assert all(v.dtype == np.float64 for v in exact)
    np.testing.assert_allclose(found, exact, rtol=DOUBLE)
