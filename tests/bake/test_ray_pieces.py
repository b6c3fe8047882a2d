"""Rays cut into pieces: sums along them, and what is kept for the next atmosphere."""

from __future__ import annotations

import numpy as np

from atmo_jit.atmosphere import Atmosphere
from atmo_jit.bake.ray_pieces import Rays, sums
from atmo_jit.bake.sightlines import Sightlines
from atmo_jit.optics import Optics

EARTH = Atmosphere.load("earth")
MU = np.array([1.0, 0.3, 0.0, -0.001, -0.5])


def optics_of(**changes) -> Optics:
    return Optics(EARTH.replace(changes), np.arange(3))


def test_sums_are_exact_beside_large_ones():
    """A ray through the last metres of air next to one along the ground, and one without pieces."""
    values = np.array([[1e6], [2e6], [1e-14], [3e-14]])
    np.testing.assert_array_equal(sums(values, np.array([0, 2, 2, 4]))[:, 0], [3e6, 0.0, 4e-14])
    assert sums(values[:0], np.zeros(3, int)).tolist() == [[0.0], [0.0]]


def test_rays_are_kept_for_the_same_profiles_only():
    h = np.full(5, 20.0)
    rays = Rays.of(optics_of(), h, MU)
    assert Rays.of(optics_of(**{"mie.scattering_per_m": 9e-6, "ground_albedo": 0.8}), h, MU) is rays
    assert Rays.of(optics_of(**{"mie.scale_height_m": 1300}), h, MU) is not rays
    assert Rays.of(optics_of(), h + 1.0, MU) is not rays and Rays.of(optics_of(), h, -MU) is not rays
    assert Rays.of(optics_of(), h, MU, None, None, False) is not rays


def test_what_is_kept_gives_what_is_made_anew():
    """Thicker and thinner air between, so that pieces are cut in several ways."""
    h, found = np.full(5, 20.0), {}
    for scattering in (4e-6, 4e-3, 4e-6, 4e-4):
        lines = Sightlines(optics_of(**{"mie.scattering_per_m": scattering}), h, MU)
        Rays._known.clear()
        anew = Sightlines(optics_of(**{"mie.scattering_per_m": scattering}), h, MU)
        np.testing.assert_array_equal(lines.scattering, anew.scattering)
        np.testing.assert_array_equal(lines.transmittance, anew.transmittance)
        found[scattering] = lines.transmittance
    assert np.all(found[4e-3] < found[4e-6])
