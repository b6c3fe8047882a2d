"""The twin of isotropic multiple scattering: its two integrals, its geometric sum, its limits."""

from __future__ import annotations

import drjit as dr
import numpy as np
import pytest
from numpy.testing import assert_allclose

import atmo_jit
from atmo_jit.backend import floats
from atmo_jit.column import SunColumns
from atmo_jit.optics import Optics
from bench.hillaire import GeometricSky, MultipleScattering, Sizes
from bench.worlds import world

SIZES = Sizes()


def table(description, sizes=SIZES):
    air = atmo_jit.Atmosphere(description)
    optics = Optics(air, np.arange(len(air.wavelengths_nm)))
    return MultipleScattering(optics, SunColumns(optics), sizes)


def uniform(scattering, albedo, **changes):
    """A planet whose air is one isotropic aerosol of constant density."""
    aerosol = {
        "scattering_per_m": scattering,
        "single_scattering_albedo": albedo,
        "profile": {"altitude_m": [0, 50_000], "density": [1, 1]},
        "phase": {"type": "isotropic"},
    }
    return world(rayleigh=None, mie=aerosol, ground_albedo=0.0, **changes)


@pytest.mark.parametrize("albedo", [0.3, 0.9])
def test_deep_inside_uniform_air_the_transfer_is_the_albedo(albedo):
    """f_ms = integral of sigma_s exp(-sigma_t t) dt = sigma_s / sigma_t where the air goes on for ever."""
    found = table(uniform(2e-3, albedo), Sizes(steps=400)).gathered(floats([25_000.0]), floats([0.5]))[1]
    assert_allclose([v.numpy()[0] for v in found], albedo, rtol=1e-3)


def test_thin_air_transfers_its_mean_depth():
    """In the limit of thin air f_ms is the mean over directions of sigma_s times the length of the ray."""
    description = uniform(1e-12, 1.0)
    h = 20_000.0
    (found, *_) = table(description).gathered(floats([h]), floats([1.0]))[1]
    radius, top = description["bottom_radius_m"], description["top_radius_m"]
    mu = 1.0 - 2.0 * (np.arange(8) + 0.5) / 8.0
    r = radius + h
    up = -r * mu + np.sqrt((r * mu) ** 2 - (r - top) * (r + top))
    square = (r * mu) ** 2 - h * (2 * radius + h)
    length = np.where((mu < 0) & (square > 0), -r * mu - np.sqrt(np.maximum(square, 0)), up)
    assert found.numpy()[0] == pytest.approx(1e-12 * length.mean(), rel=1e-5)


def test_the_table_is_the_geometric_sum():
    """Psi = L + f L + f^2 L + ..., summed one by one in double precision."""
    made = table(world())
    second, transfer = (np.stack([v.numpy() for v in part], -1).astype(float) for part in (made.second, made.transfer))
    assert (transfer > 0).all() and 0.05 < transfer.max() < 0.9 and (second >= 0).all()
    term, total = second.copy(), np.zeros_like(second)
    for _ in range(2000):
        total += term
        term *= transfer
    psi = made.table.numpy().reshape(len(second), -1)[:, : second.shape[1]]
    assert_allclose(psi, total, rtol=1e-5, atol=1e-12)


def test_light_of_the_ground_alone():
    """Without air L_2nd is sunlit ground seen under the lower directions: albedo / pi times the sun's cosine."""
    description = world(rayleigh=None, mie=None, solar_irradiance=2.0, ground_albedo=0.5)
    description["rayleigh"] = {"scattering_per_m": 1e-14, "scale_height_m": 5000}
    found = table(description).gathered(floats([0.0]), floats([1.0]))[0]
    # From the ground itself the 32 directions below the horizontal meet it at once, under the same sun.
    assert_allclose([v.numpy()[0] for v in found], 0.5 * 2.0 * 0.5 / np.pi, rtol=1e-4)


def test_a_view_through_constant_psi():
    """Along a ray of constant source Psi sigma_s the radiance is Psi omega (1 - exp(-tau))."""
    made = table(uniform(1e-5, 0.8))
    made.table = floats(np.ones(dr.width(made.table)))
    h, mu = floats([0.0]), floats([1.0])
    found = made.along_view(h, mu, floats([0.3]), floats([0.3]), h > 1.0)
    tau = 1e-5 / 0.8 * 50_000
    assert_allclose([v.numpy()[0] for v in found], 0.8 * (1.0 - np.exp(-tau)), rtol=1e-4)


def test_radiance_by_day_is_near_the_solver():
    """By day and in clear air the approximation is some per cent off."""
    views = {
        "altitude_m": np.full(4, 500.0),
        "sun_zenith_deg": np.full(4, 50.0),
        "view_zenith_deg": np.array([0.0, 40.0, 75.0, 130.0]),
        "azimuth_deg": np.array([0.0, 90.0, 150.0, 60.0]),
    }
    own = atmo_jit.sky("earth", views).radiance
    once = atmo_jit.sky("earth", views, orders=1).radiance
    found = GeometricSky("earth", SIZES).radiance(views)
    assert np.abs(found / own - 1.0).max() < 0.1
    # ... and much closer than single scattering alone
    assert np.abs(found / own - 1.0).max() < 0.4 * np.abs(once / own - 1.0).max()
