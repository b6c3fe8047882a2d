"""Single scattering at the texels of the client's size against the march, which cuts rays at the planet's shadow."""

from __future__ import annotations

import numpy as np
import pytest

from atmo_jit.backend import doubles, floats
from atmo_jit.bake.client import SCATTERING, bruneton_tables, scattering_nodes, transmittance_up
from atmo_jit.mapping import texels
from atmo_jit.march import march
from atmo_jit.solved import Sky

COUNT = 20000


class _Alone:
    """Optics of which one scatterer's phase function is 1 and the others' 0."""

    def __init__(self, optics, scatterer):
        self._optics, self._scatterer = optics, scatterer

    def __getattr__(self, name):
        return getattr(self._optics, name)

    def phase_values(self, k, nu):
        return [0.0 * nu + float(k == self._scatterer)] * self._optics.channel_count


@pytest.fixture(scope="module")
def tables(earth_sky):
    return bruneton_tables(earth_sky, -0.5)


@pytest.mark.parametrize("name", ["rayleigh", "mie"])
def test_single_scattering(tables, earth_sky, name):
    h, mu, mu_s, nu = scattering_nodes(tables.mapping, SCATTERING)
    rng = np.random.default_rng(1)
    # Inside the table: on the horizon itself rounding decides what the march meets.
    at = rng.integers(1, 31, COUNT), rng.integers(1, 127, COUNT), rng.integers(0, 8, COUNT), rng.integers(0, 32, COUNT)
    place = h[at[0], 0, 0, 0], mu[at[0], at[1], 0, 0], mu_s[at[3]], nu[at]
    sines = np.maximum(np.sqrt((1 - place[1] ** 2) * (1 - place[2] ** 2)), 1e-12)
    azimuth = np.arccos(np.clip((place[3] - place[1] * place[2]) / sines, -1.0, 1.0))
    rays, *_ = earth_sky.enter(*map(doubles, (place[0], np.arccos(place[2]), np.arccos(place[1]), azimuth)))
    rays.nu = floats(place[3])
    (band,) = earth_sky.bands
    light = march(_Alone(band.optics, ["rayleigh", "mie"].index(name)), band.columns, rays, nodes=6).single
    exact = np.stack([v.numpy() for v in light], axis=-1)
    found = getattr(tables, name)[at]
    lit = exact.max(axis=-1) > 1e-6 * exact.max()
    error = np.abs(found - exact)[lit] / exact[lit]
    assert np.count_nonzero(lit) > COUNT // 3
    assert np.percentile(error, 99) < 3e-3 and np.median(error) < 1e-4
    assert found[~lit].max(initial=0.0) < 1e-5 * exact.max()


def test_transmittance_is_that_of_direct_integration(tables):
    """By the trapezoid rule in steps that shrink toward the perigee, in double precision."""
    sky = Sky("earth")
    air, to = sky.atmosphere, tables.mapping
    x_r, x_mu = (v.ravel() for v in np.meshgrid(texels(64)[::7], texels(256)[::15], indexing="ij"))
    h, mu = to.transmittance_inverse(x_r, x_mu)
    r = to.bottom + h
    middle = np.maximum(-r * mu, 0.0)
    end = -r * mu + np.sqrt((r * mu) ** 2 + (to.top - r) * (to.top + r))
    t = np.linspace(0.0, 1.0, 4001)[:, None] ** 2
    depth = np.zeros((len(h), 3))
    for start, stop in ((middle, np.zeros_like(h)), (middle, end)):
        d = start + (stop - start) * t
        height = np.maximum(np.sqrt(r * r + d * d + 2 * r * mu * d) - to.bottom, 0.0)
        for c in air.constituents:
            column = np.abs(np.trapezoid(c.profile.density(height), d, axis=0))
            depth += column[:, None] * c.extinction_per_m
    found = np.stack(transmittance_up(sky.bands[0].optics, h, mu), axis=-1)
    assert np.abs(found - np.exp(-depth)).max() < 5e-5
