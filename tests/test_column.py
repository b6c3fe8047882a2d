"""Columns and transmittance: against the reference grid, the brute-force twin and worlds whose answer is geometry."""

from __future__ import annotations

import numpy as np
import pytest
from twins import Twin, cosines

import atmo_jit
from bench.worlds import WORLDS, views_of, world

TRANSMITTANCE = 1e-4  # absolute; the figure, and what 8-bit pictures could never show


def test_transmittance_of_the_reference_grid(reference):
    """The 2017 Earth, 1 m to 400 km; the reference is to the top of the air, and 0 where the ray ends on the ground."""
    from bench.accuracy import single_scattering

    result = single_scattering(path=reference)["transmittance"]
    assert result["rays"] == 24720
    assert result["max_abs"] < TRANSMITTANCE


def test_twin_agrees_with_the_reference_transmittance(reference):
    """The twin is fit to judge: its transmittance is the reference's to float32."""
    from bench.accuracy import earth
    from bench.reference import load

    data = load("single_scattering_earth", reference)
    twin = Twin(earth().to_dict())
    h, zenith = (v.ravel() for v in np.meshgrid(data["altitude_m"], data["view_zenith_deg"], indexing="ij"))
    truth = data["transmittance_brute"][:, 0, :, 0].reshape(h.size, -1)
    seen = truth[:, 1] > 0
    assert np.array_equal(seen, ~twin.hits_ground(h, np.cos(np.radians(zenith))))
    assert np.abs(twin.transmittance(h, np.cos(np.radians(zenith))) - truth)[seen].max() < 1e-7


@pytest.mark.parametrize("name", WORLDS)
def test_transmittance_of_other_worlds(name):
    spec = WORLDS[name]
    views = views_of(spec, seed=1)
    mu, _, _ = cosines(*(views[f"{k}_deg"] for k in ("sun_zenith", "view_zenith", "azimuth")))
    got = atmo_jit.sky(spec, views, orders=1, ground=False).transmittance
    want = Twin(spec).transmittance(views["altitude_m"], mu)
    assert got.shape == want.shape
    assert np.abs(got - want).max() < TRANSMITTANCE


def test_uniform_density_is_geometry():
    """In air of constant density the column is the distance: tangents, chords and verticals of a 1000 km planet."""
    radius, top, beta = 1.0e6, 5.0e4, 4e-6
    spec = world(rayleigh={"scattering_per_m": beta, "profile": {"altitude_m": [0, top], "density": [1, 1]}}, mie=None)
    h = np.array([0.0, 0.0, 1000.0, 20000.0, 49000.0, 49000.0, 200000.0])
    horizon = 180 - np.degrees(np.arcsin((radius + 1e4) / (radius + 49000.0)))  # perigee at 10 km
    zenith = np.array([0.0, 90.0, 30.0, 180.0, horizon, 0.0, 180.0])

    def chord(perigee: float, end: float) -> float:
        """From the point nearest to the centre, at radius ``perigee``, to radius ``end``."""
        return np.sqrt(end**2 - perigee**2)

    r = radius + 1000.0
    distance = [
        top,
        chord(radius, radius + top),
        chord(r / 2, radius + top) - chord(r / 2, r),
        20000.0,
        chord(radius + 1e4, radius + top) + chord(radius + 1e4, radius + 49000.0),
        1000.0,
        top,
    ]
    views = {"altitude_m": h, "sun_zenith_deg": 30.0 + 0 * h, "view_zenith_deg": zenith, "azimuth_deg": 0 * h}
    got = atmo_jit.sky(spec, views, orders=1).transmittance
    assert np.abs(got - np.exp(-beta * np.array(distance))[:, None]).max() < 2e-6


def columns_off(spec: dict, h: np.ndarray, mu: np.ndarray) -> np.ndarray:
    """Relative errors of the columns toward the sun that the table tells."""
    from atmo_jit.backend import floats
    from atmo_jit.column import SunColumns
    from atmo_jit.optics import Optics
    from atmo_jit.resolution import Resolution

    air = atmo_jit.Atmosphere.from_dict(spec)
    columns = SunColumns(Optics(air, np.arange(1)), Resolution.suited(air, 0.01).columns)
    return np.array(columns.toward(floats(h), floats(mu))[0]) / Twin(spec).columns(h, mu)[:, 0] - 1.0


def test_columns_bend_where_density_falls_linearly():
    """Between rows of the table a line lacks what the slope of density adds, 5e-4 of the column near the top."""
    profile = {"altitude_m": [0, 2e4, 4e4], "density": [0, 1, 0]}
    spec = world(rayleigh={"scattering_per_m": 1e-5, "profile": profile}, mie=None)
    h = np.linspace(2.1e4, 3.9e4, 40)
    assert np.abs(columns_off(spec, h, 0.0 * h + 1.0)).max() < 2e-5


def test_columns_under_a_step_where_shells_are_thin():
    """Several shells begin inside one cell of the look-up from altitude to shell."""
    profile = {"altitude_m": [0, 20000], "density": [1, 1]}
    spec = world(rayleigh={"scattering_per_m": 3e-3, "profile": profile}, mie=None)
    spec["bottom_radius_m"] += 6e7
    spec["top_radius_m"] += 6e7
    depth = np.array([0.05, 0.5, 1.0, 3.0, 10.0, 30.0])
    h = np.float64(np.float32(20000.0 - depth))
    assert np.abs(columns_off(spec, h, 0.0 * h)).max() < 1e-2


def test_sun_irradiance_of_the_reference_grid(reference):
    """Direct irradiance of a horizontal surface, 5 altitudes, sun to 88 degrees."""
    from bench.accuracy import irradiance

    rows = [row for row in irradiance(path=reference) if row["irradiance"] == "sun"]
    assert len(rows) == 5
    for row in rows:
        assert row["max"] < 0.05, row  # per cent


def test_sun_irradiance_sets_with_its_disc():
    """A wide sun fades over its diameter: half is left on the geometric horizon, none a radius below it."""
    wide = world(sun_angular_radius_deg=2.0, rayleigh=None, mie=None)
    height = 2000.0
    dip = np.degrees(np.arccos(1e6 / (1e6 + height)))
    sun = np.array([80.0, 89.0, 90.0, 90.0 + dip])
    views = {"altitude_m": 0 * sun + height, "sun_zenith_deg": sun, "view_zenith_deg": 0 * sun, "azimuth_deg": 0 * sun}
    got = atmo_jit.sky(wide, views, orders=1).sun_irradiance[:, 0]
    want = Twin(wide).sun_irradiance(views["altitude_m"], np.cos(np.radians(sun)))[:, 0]
    assert got == pytest.approx(want, rel=1e-4, abs=1e-7)
    assert got[-1] == 0  # a surface that faces up sees nothing of a sun below its plane


def test_aerial_transmittance_of_the_reference_grid(reference):
    from bench.accuracy import aerial_perspective

    for row in aerial_perspective(path=reference):
        assert row["transmittance_max_abs"] < TRANSMITTANCE, row
