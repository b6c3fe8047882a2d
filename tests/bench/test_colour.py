"""Colour from few wavelengths on skies that no fit has seen, and the CIE's clear sky."""

from __future__ import annotations

import numpy as np
import pytest

from atmo_jit.spectrum import FAST_NM, SpectralBasis, solar_irradiance
from bench import colour, luminance


def test_few_wavelengths_give_the_colour_of_forty() -> None:
    data = colour.skies(seed=7, atmospheres=2, views=80)
    found = colour.rows(data, colour.package_ways())
    for row in found:
        if row["light"] == "skylight, all" and "fitted" in row["way"]:
            assert row["median"] <= 1.0 and row["max"] <= 3.0, row


def test_fitted_matrices_follow_order_and_brightness_of_the_sun() -> None:
    nm = np.array(FAST_NM[4])
    light = np.array([1.0, 0.8, 0.7, 0.6])
    ascending = SpectralBasis(nm, solar_irradiance(nm))
    far = SpectralBasis(nm[::-1], 0.25 * solar_irradiance(nm)[::-1])
    assert ascending.fitted is not None
    # Radiance is what it is, whichever sun it came from.
    np.testing.assert_allclose(far.xyz_matrix @ light[::-1], ascending.xyz_matrix @ light, rtol=1e-12)
    assert SpectralBasis(nm, np.ones(4)).fitted is None  # a white sun has no Fraunhofer lines to know


def test_the_metric_is_that_of_small_differences() -> None:
    truth = np.array([[0.3, 0.4, 0.6], [0.5, 0.5, 0.2]])
    small = 1e-3 * truth * [1.0, -0.5, 0.7]
    shown = colour.shown(small, truth)
    predicted = np.sqrt(np.einsum("ni,nij,nj->n", shown, colour.metric(truth), shown))
    np.testing.assert_allclose(colour.difference(truth + small, truth), predicted, rtol=0.02)


def test_cie_sky_is_the_table(reference) -> None:
    table = np.genfromtxt(reference / "cie_type12_table.csv", delimiter=",", names=True)
    table = table[table["view_zenith_deg"] < 90.0]
    angles = (table[name] for name in ("sun_zenith_deg", "view_zenith_deg", "relative_azimuth_deg"))
    assert luminance.cie_type12(*angles) == pytest.approx(table["L_over_Lz"], rel=1e-5)


def test_luminance_is_near_the_cies() -> None:
    own = luminance.relative_luminance("bruneton2008", [40.0], np.arange(0.0, 76.0, 15.0), [0.0, 90.0, 180.0])
    view, azimuth = np.meshgrid(np.arange(0.0, 76.0, 15.0), [0.0, 90.0, 180.0])
    off = np.log(own[0] / luminance.cie_type12(40.0, view, azimuth))
    assert np.sqrt(np.mean(off**2)) < 0.35
