"""Sightlines against the march of ``Sky.rays``, which integrates the same light ray by ray."""

from __future__ import annotations

import numpy as np
import pytest

from atmo_jit.backend import doubles, floats, uints
from atmo_jit.bake.sightlines import Sightlines
from atmo_jit.bake.sunlight import Sunlight
from atmo_jit.solved import Sky


def views(altitude: float, sun_deg: float) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(4)
    zenith, azimuth = np.arccos(rng.uniform(-1, 1, 200)), rng.uniform(0, np.pi, 200)
    return np.full(200, float(altitude)), np.full(200, np.radians(sun_deg)), zenith, azimuth


def both(sky: Sky, altitude: float, sun_deg: float, nodes: int = 3) -> tuple[np.ndarray, np.ndarray, float]:
    """Radiance by sightlines and by the march [W, N], and the largest difference of transmittance."""
    h, sun, zenith, azimuth = views(altitude, sun_deg)
    found, through = [], []
    for band in sky.bands:
        lines = Sightlines(band.optics, h, np.cos(zenith), nodes=nodes)
        ray, mu_s, across = uints(np.arange(len(h))), floats(np.cos(sun)), floats(np.sin(sun) * np.cos(azimuth))
        nu = lines.nu(ray, mu_s, across)
        total = lines.ground_light(band.columns, band.field, ray, mu_s, across)
        for k, light in zip(
            band.optics.scatterers,
            lines.single(Sunlight(band.optics, band.columns), ray, mu_s, across, nu),
            strict=True,
        ):
            phase = band.optics.phase_values(k, nu)
            total = [t + p * v for t, p, v in zip(total, phase, light, strict=True)]
        for light in lines.multiple(band.source, ray, mu_s, across, nu):
            total = [t + v for t, v in zip(total, light, strict=True)]
        found += [v.numpy() for v in total]
        through += list(lines.transmittance.T)
    light = sky.rays(*map(doubles, (h, sun, zenith, azimuth)))
    exact = np.stack([v.numpy() for v in light.radiance])
    clear = np.abs(np.stack(through) - np.stack([v.numpy() for v in light.transmittance])).max()
    return np.stack(found), exact, float(clear)


@pytest.mark.parametrize("fixture", ["earth_sky", "small_sky", "hazy_sky", "odd_sky"])
@pytest.mark.parametrize(("altitude", "sun_deg"), [(0.0, 20.0), (1.0, 75.0), (8e3, 60.0), (4e5, 50.0)])
def test_light_by_day(fixture, altitude, sun_deg, request):
    found, exact, clear = both(request.getfixturevalue(fixture), altitude, sun_deg)
    error = np.abs(found - exact) / np.maximum(exact, 1e-3 * exact.max(axis=1, keepdims=True))
    # A quadrature of its own and sunlight from a table, which is smooth in exponential air and not at layers' steps.
    assert np.percentile(error, 95) < (2e-3 if fixture == "odd_sky" else 3e-4)
    assert error.max() < (2e-2 if fixture == "odd_sky" else 2e-3)
    assert clear < 2e-5


def twilight_error(sky: Sky, sun_deg: float, nodes: int) -> float:
    found, exact, _ = both(sky, 1.0, sun_deg, nodes=nodes)
    return float(np.percentile(np.abs(found - exact) / np.maximum(exact, 1e-3 * exact.max(axis=1, keepdims=True)), 95))


@pytest.mark.parametrize("sun_deg", [89.0, 93.0, 97.0])
def test_more_nodes_carry_through_twilight(earth_sky, sun_deg):
    assert twilight_error(earth_sky, sun_deg, nodes=10) < 2e-3


def test_few_nodes_do_not(earth_sky):
    assert twilight_error(earth_sky, 97.0, nodes=2) > 5 * twilight_error(earth_sky, 97.0, nodes=10)


def test_segments_add_up(small_sky):
    """Scattering and transmittance of a ray in two parts are those of the whole."""
    optics = small_sky.bands[0].optics
    h, mu = np.array([100.0, 100.0, 20e3]), np.array([0.3, -0.001, -0.2])
    whole = Sightlines(optics, h, mu, stop=np.full(3, 60e3), ground=False)
    near = Sightlines(optics, h, mu, stop=np.full(3, 15e3), ground=False)
    far = Sightlines(optics, h, mu, start=np.full(3, 15e3), stop=np.full(3, 60e3), ground=False)
    np.testing.assert_allclose(near.transmittance * far.transmittance, whole.transmittance, rtol=1e-5)
    joined = near.scattering + near.transmittance[:, None] * far.scattering
    np.testing.assert_allclose(joined, whole.scattering, rtol=1e-4)


def test_rays_that_meet_no_air_scatter_nothing(small_sky):
    lines = Sightlines(small_sky.bands[0].optics, np.array([4e5, 4e5]), np.array([0.5, -0.1]))
    assert np.all(lines.transmittance == 1.0) and np.all(lines.scattering == 0.0)
    assert not lines.ground.any()
