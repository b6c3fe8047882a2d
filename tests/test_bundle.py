"""Tables filled path by path against the same rays marched one by one."""

import numpy as np
import pytest

import atmo_jit
from atmo_jit.backend import doubles
from atmo_jit.solved import Sky

AZIMUTH = np.radians([0.0, 20.0, 75.0, 130.0, 180.0])
VIEW = np.radians([0.0, 35.0, 70.0, 85.0, 88.0, 92.0, 100.0, 140.0, 180.0])
HAZE = {"mie.scattering_per_m": 5e-5, "mie.phase.g": 0.7, "ground_albedo": 0.4}


@pytest.fixture(scope="module")
def sky():
    return Sky(atmo_jit.Atmosphere.load("earth").replace(HAZE))


def marched(sky, height, view, sun, azimuth, **options):
    mesh = np.meshgrid(view, sun, azimuth, indexing="ij")
    zenith, sun, turn = (doubles(v) for v in mesh)
    light = sky.rays(doubles(np.full(mesh[0].size, height)), sun, zenith, turn, **options)
    return (np.stack([v.numpy() for v in part], axis=-1) for part in (light.radiance, light.transmittance))


@pytest.mark.parametrize("height", [0.0, 3500.0, 30000.0])
@pytest.mark.parametrize("ground", [True, False])
def test_a_table_by_day_is_the_march(sky, height, ground):
    """Both share the field; what differs is the quadrature, converged to 1e-3 in each."""
    suns = np.radians([10.0, 55.0, 80.0])
    want, through = marched(sky, height, VIEW, suns, AZIMUTH, ground=ground)
    table = sky.table(np.full(len(VIEW), height), VIEW, suns, AZIMUTH, ground=ground)
    got = np.stack([v.numpy() for v in table.radiance], axis=-1)
    seen = want > 0.0  # on the ground, looking down, there is no air
    assert np.all(got[~seen] == 0.0)
    error = np.abs(got[seen] / want[seen] - 1.0)
    assert np.percentile(error, 95) < 2e-3 and error.max() < 1e-2
    clear = np.stack([v.numpy() for v in table.transmittance], axis=-1)
    assert clear == pytest.approx(through.reshape(len(VIEW), -1, clear.shape[-1])[:, 0], abs=2e-4)


def test_a_table_at_twilight_is_nearly_the_march(sky):
    """The planet's shadow cuts across the paths: its edge is met at levels, not exactly."""
    suns = np.radians([89.0, 94.0])
    want, _ = marched(sky, 0.0, VIEW, suns, AZIMUTH)
    table = sky.table(np.zeros(len(VIEW)), VIEW, suns, AZIMUTH)
    got = np.stack([v.numpy() for v in table.radiance], axis=-1)
    error = np.abs(got / want - 1.0)[want > 1e-3 * want.max(axis=0)]
    assert np.percentile(error, 90) < 1e-2 and np.median(error) < 1e-3


def test_azimuths_may_differ_between_paths_and_suns(sky):
    suns = np.radians([30.0, 60.0])
    whole = sky.table(0.0, VIEW[:4], suns, AZIMUTH)
    each = np.broadcast_to(AZIMUTH, (4, 2, len(AZIMUTH))).copy()
    each[2, 1] = AZIMUTH[::-1]
    part = sky.table(0.0, VIEW[:4], suns, each)
    a, b = (np.reshape(light.radiance[0].numpy(), (4, 2, -1)) for light in (whole, part))
    assert b[2, 1] == pytest.approx(a[2, 1, ::-1], rel=1e-6)
    assert b[1] == pytest.approx(a[1], rel=1e-6)


def test_what_lies_above_the_air_is_refused(sky):
    with pytest.raises(atmo_jit.InputError, match="altitude_m"):
        sky.table(1e6, VIEW, [0.5], AZIMUTH)
    with pytest.raises(atmo_jit.InputError, match="azimuth"):
        sky.table(0.0, VIEW, [0.5], np.zeros((3, 1, 4)))
