"""Four-dimensional tables against the solution, and what is sliced from them."""

from __future__ import annotations

import numpy as np
import pytest

from atmo_jit.backend import doubles, floats
from atmo_jit.bake.error import sky_view_error, tables_error
from atmo_jit.bake.sky_view import SkyView
from atmo_jit.bake.tables import Size, Tables4D
from atmo_jit.solved import Sky
from bench.worlds import WORLDS


@pytest.fixture(scope="module")
def earth_tables(earth_sky) -> Tables4D:
    return Tables4D(earth_sky)


@pytest.mark.parametrize("suns", [(0.0, 45.0), (45.0, 80.0)])
def test_error_by_day(earth_tables, suns):
    error = tables_error(earth_tables, suns, seed=1)
    assert error.p95 < 5e-3 and error.median < 1e-3 and error.worst < 0.1, str(error)


def test_error_at_twilight(earth_tables):
    error = tables_error(earth_tables, (88.0, 93.0), seed=2)
    assert error.median < 2e-3 and error.p95 < 5e-2, str(error)


def test_error_of_another_planet(small_sky):
    error = tables_error(Tables4D(small_sky), (0.0, 70.0), seed=3)
    assert error.p95 < 1e-2, str(error)


def test_finer_tables_err_less(earth_sky, earth_tables):
    coarse = Tables4D(earth_sky, Size(altitudes=8, up=10, down=6, suns=20, azimuths=4, scattering=(24, 32, 20)))
    rough, fine = (tables_error(t, (0.0, 80.0), seed=4) for t in (coarse, earth_tables))
    assert fine.p95 < 0.5 * rough.p95
    assert coarse.nbytes < 0.2 * earth_tables.nbytes


def test_a_slice_is_a_sky_view(earth_sky, earth_tables):
    view = SkyView(earth_tables, 1.0, np.radians(55.0))
    error = sky_view_error(view, earth_sky, seed=5)
    assert error.p95 < 8e-3, str(error)


def test_whole_rays_with_ground_and_from_space(earth_sky, earth_tables):
    altitude = np.array([1.0, 1.0, 2e3, 4e5, 4e5, 4e5])
    zenith = np.radians(np.array([30.0, 130.0, 95.0, 180.0, 150.0, 90.0]))
    place = [doubles(v) for v in (altitude, np.full(6, 0.8), zenith, np.linspace(0.0, 3.0, 6))]
    found, exact = earth_tables.rays(*place), earth_sky.rays(*place)
    for a, b in zip(found.radiance + found.transmittance, exact.radiance + exact.transmittance, strict=True):
        np.testing.assert_allclose(a.numpy(), b.numpy(), rtol=2e-2, atol=1e-6)


def test_several_wavelengths_in_bands():
    """Five wavelengths, whose aerosol has a g of its own at each: two bands."""
    spec = WORLDS["two aerosols, five wavelengths"]
    sky = Sky({**spec, "mie": spec["mie"][0]})
    place = [doubles(v) for v in ([3.0, 3.0], [0.5, 0.9], [0.2, 1.2], [0.0, 2.0])]
    found, exact = Tables4D(sky).rays(*place).radiance, sky.rays(*place).radiance
    assert len(found) == 5
    for a, b in zip(found, exact, strict=True):
        np.testing.assert_allclose(a.numpy(), b.numpy(), rtol=1e-2)


def test_night_is_finite(earth_tables):
    deep = [floats(v) for v in ([1.0, 5e4], [3.0, 2.5], [0.3, 1.8], [0.0, 1.0])]
    assert all(np.all(np.isfinite(v.numpy())) for v in earth_tables.rays(*deep).radiance)
