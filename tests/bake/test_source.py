"""The table of the light that a point scatters, against the harmonics that it stands for."""

from __future__ import annotations

import numpy as np
import pytest

from atmo_jit import Atmosphere, Sky
from atmo_jit.backend import floats
from atmo_jit.bake.source import SourceTable

# 99.5th percentile and median of the difference that an interpolation in directions may make, over
# the stronger scatterer's light.
ALLOWED = {"earth": (0.03, 0.0005), "haze": (0.03, 0.001)}


@pytest.mark.parametrize("name", ALLOWED)
def test_scattered_light_is_that_of_the_field(name):
    changes = {"mie.scattering_per_m": 1e-4, "mie.phase.g": 0.8} if name == "haze" else {}
    sky = Sky(Atmosphere.load("earth").replace(changes))
    (band,) = sky.bands
    rng, count = np.random.default_rng(3), 4000
    h = sky.atmosphere.thickness_m * rng.random(count) ** 3
    mu_s, mu, cos_phi = (np.cos(rng.uniform(0.0, limit, count)) for limit in (1.7, np.pi, np.pi))
    mu[:2], cos_phi[:2] = [1.0, -1.0], [1.0, -1.0]
    at = [floats(v) for v in (h, mu_s, mu, cos_phi)]
    own, truth = (np.array([[*kind] for kind in s.scattered(*at, True)]) for s in (SourceTable(band.field), band.field))
    error = np.abs(own - truth) / truth.max(axis=0)  # a scatterer may send nothing somewhere
    largest, median = ALLOWED[name]
    assert np.percentile(error, 99.5) < largest
    assert np.median(error) < median
    assert np.all(own >= 0.0)
    assert SourceTable(band.field).nbytes < 100e6
