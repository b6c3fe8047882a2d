"""Sampling of the emitter ``atmosphere``: density, its integral, agreement of samples and density, noise."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from emitters import LUMINANCE, columns, plane, sampled, seen, sun

from atmo_jit.plugins.lookup import SunLookup
from atmo_jit.plugins.panorama import Disc

# Significance of one chi-squared test; with a dozen of them a false alarm is still rarer than one in 800 runs, and the
# random numbers are the same in every run.
SIGNIFICANCE = 1e-4
SAMPLES = 1 << 20


def density(emitter, directions: np.ndarray) -> np.ndarray:
    """pdf_direction of directions [N, 3] in float32."""
    ds = dr.zeros(mi.DirectionSample3f, len(directions))
    ds.d = mi.Vector3f(*(mi.Float(np.ascontiguousarray(d, dtype=np.float32)) for d in directions.T))
    return np.array(emitter.pdf_direction(dr.zeros(mi.Interaction3f, len(directions)), ds), dtype=np.float64)


def chi_squared(counts: np.ndarray, expected: np.ndarray) -> float:
    """p-value of Pearson's test; cells of fewer than 10 expected samples are pooled."""
    from scipy.stats import chi2

    rare = expected < 10.0
    counts = np.append(counts[~rare], counts[rare].sum())
    expected = np.append(expected[~rare], expected[rare].sum())
    use = expected > 0.0
    assert counts[~use].sum() == 0.0
    return float(chi2.sf(((counts - expected) ** 2 / np.where(use, expected, 1.0))[use].sum(), use.sum() - 1))


def cell_test(emitter) -> tuple[float, float]:
    """p-value of samples against densities in the table's own cells, split again 2 x 2; sum of the probabilities.

    A regular grid cannot integrate the thin cells at the horizon; in half a cell the density is constant.
    """
    view = emitter._light.view
    sines, azimuths = view.cells()
    heights = np.unique(sines)  # the horizon stands twice
    halves = [np.sort(np.concatenate([x, 0.5 * (x[1:] + x[:-1])])) for x in (heights, azimuths)]
    middle = [0.5 * (x[1:] + x[:-1]) for x in halves]
    z, phi = np.meshgrid(*middle, indexing="ij")
    across = np.sqrt(1.0 - z**2)
    d = np.stack([across * np.cos(phi), across * np.sin(phi), z], axis=-1).reshape(-1, 3)
    solid = 2.0 * np.diff(halves[0])[:, None] * np.diff(halves[1])[None, :]
    probability = density(emitter, d).reshape(solid.shape) * solid

    found = columns(sampled(emitter, SAMPLES)[0].d)
    angle = np.abs(np.arctan2(found[:, 1], found[:, 0]))
    edges = [np.concatenate([[-2.0 * abs(x[0]) - 1.0], x[1:-1], [10.0]]) for x in halves]
    counts, _, _ = np.histogram2d(found[:, 2], angle, edges)
    return chi_squared(counts.ravel(), (probability * SAMPLES).ravel()), float(probability.sum())


@pytest.mark.parametrize(
    ("elevation_deg", "altitude_m"),
    [
        (45.0, 1.0),
        (0.0, 1.0),
        (20.0, 1e4),
        *(pytest.param(e, 1.0, marks=pytest.mark.slow) for e in (90.0, 5.0, -4.0, -40.0)),
        pytest.param(20.0, 4e5, marks=pytest.mark.slow),
    ],
)
def test_sky_samples_follow_their_density(emitter, elevation_deg: float, altitude_m: float) -> None:
    sky = emitter(elevation_deg, altitude=altitude_m, sun_scale=0.0)
    p, total = cell_test(sky)
    assert total == pytest.approx(1.0, abs=1e-4)
    assert p > SIGNIFICANCE


def test_sky_samples_with_mitsubas_own_test(emitter) -> None:
    sky = emitter(45.0, sun_scale=0.0)
    test = mi.chi2.ChiSquareTest(
        domain=mi.chi2.SphericalDomain(),
        sample_func=lambda x: sky.sample_direction(dr.zeros(mi.Interaction3f, dr.width(x)), x)[0].d,
        pdf_func=lambda d: sky.pdf_direction(dr.zeros(mi.Interaction3f), _record(d)),
        sample_dim=2,
    )
    assert test.run(SIGNIFICANCE, quiet=True), test.messages


def test_sun_and_sky_samples_with_mitsubas_own_test(emitter) -> None:
    # As in Mitsuba's tests of sunsky: a wide disc, since a grid cannot integrate the true one.
    both = emitter(50.0, sun_aperture=30.0, sun_scale=0.5)
    test = mi.chi2.ChiSquareTest(
        domain=mi.chi2.SphericalDomain(),
        sample_func=lambda x: both.sample_direction(dr.zeros(mi.Interaction3f, dr.width(x)), x)[0].d,
        pdf_func=lambda d: both.pdf_direction(dr.zeros(mi.Interaction3f), _record(d)),
        sample_dim=2,
        sample_count=200_000,
        res=55,
        ires=32,
    )
    assert test.run(SIGNIFICANCE, quiet=True), test.messages


def _record(d) -> mi.DirectionSample3f:
    ds = dr.zeros(mi.DirectionSample3f, dr.width(d))
    ds.d = d
    return ds


def test_sun_is_sampled_evenly(emitter) -> None:
    both = emitter(30.0)
    ds, _ = sampled(both, SAMPLES)
    d = columns(ds.d)
    centre = np.array(sun(30.0))
    offset = np.linalg.norm(d - centre, axis=1) / (2.0 * np.sin(np.radians(0.2678) / 2.0))
    inside = offset <= 1.0
    share = float(inside.mean())
    assert 0.5 < share < 0.99
    rings = np.histogram(offset[inside] ** 2, 16, (0.0, 1.0))[0]
    assert chi_squared(rings, np.full(16, inside.sum() / 16.0)) > SIGNIFICANCE
    # The density inside is the share of samples over the solid angle of the disc, plus the sky's.
    solid = 4.0 * np.pi * np.sin(np.radians(0.2678) / 2.0) ** 2
    pdf = np.array(ds.pdf)[offset < 0.999]  # at the limb itself rounding decides
    assert np.ptp(pdf) < 1e-3 * pdf.mean()
    assert pdf.mean() == pytest.approx(share / solid, rel=5.0 * np.sqrt((1.0 - share) / (share * SAMPLES)) + 1e-4)


def test_refraction_flattens_the_sun(emitter) -> None:
    # -0.2 degrees: seen at 0.35, whole above the horizon.
    flat = emitter(-0.2, refraction=True, sky_scale=0.0)
    squeeze = flat.sky_light.disc.squeeze
    assert 0.80 < squeeze < 0.83
    centre = flat.sun
    up = np.array([-centre[2], 0.0, centre[0]])
    chord = 2.0 * np.sin(np.radians(0.2678) / 2.0)
    ds, weight = sampled(flat, SAMPLES)
    d = columns(ds.d)
    high, across = (d - centre) @ up / chord, d[:, 1] / chord
    assert np.abs(across).max() == pytest.approx(1.0, abs=2e-3)
    assert np.abs(high).max() == pytest.approx(squeeze, abs=2e-3)
    distance2 = (high / squeeze) ** 2 + across**2
    assert distance2.max() < 1.0 + 1e-3
    assert chi_squared(np.histogram(distance2, 16, (0.0, 1.0 + 1e-9))[0], np.full(16, SAMPLES / 16.0)) > SIGNIFICANCE
    within = distance2 < 0.999
    np.testing.assert_allclose(np.array(ds.pdf)[within], 1.0 / (np.pi * chord**2 * squeeze), rtol=1e-3)
    # Radiance is that of a round sun, here of one with the same centre: the irradiance is less by the squeeze.
    lifted = emitter(float(np.degrees(np.arcsin(centre[2]))), sky_scale=0.0)
    middle = np.array([centre])
    np.testing.assert_allclose(seen(flat, middle), seen(lifted, middle), rtol=1e-3)
    power, of_round = (columns(w).mean(axis=0) @ LUMINANCE for w in (weight, sampled(lifted, SAMPLES)[1]))
    assert power / of_round == pytest.approx(squeeze, rel=0.01)  # blue light of the lower limb counts less: it is dim
    edges = centre + chord * np.array([0.98 * squeeze * up, 1.02 * squeeze * up, [0.0, 0.98, 0.0], [0.0, 1.02, 0.0]])
    np.testing.assert_array_equal(seen(flat, edges)[:, 0] > 0.0, [True, False, True, False])
    np.testing.assert_array_equal(density(flat, edges) > 1.0, [True, False, True, False])


def test_a_wide_flat_disc_with_mitsubas_own_test(rgb: None) -> None:
    direction = np.array(sun(40.0, 20.0))
    disc = Disc(np.radians(35.0), 0.0, 1.0, np.zeros((1, 1, 1)), np.zeros(1), squeeze=0.5)
    look, centre = SunLookup(disc, direction), mi.Vector3f(*direction.tolist())
    test = mi.chi2.ChiSquareTest(
        domain=mi.chi2.SphericalDomain(),
        sample_func=lambda x: look.sample(x, centre),
        pdf_func=lambda d: dr.select(look.distance2(d, centre) <= 1.0, look.density, 0.0),
        sample_dim=2,
        sample_count=200_000,
        res=55,
        ires=32,
    )
    assert test.run(SIGNIFICANCE, quiet=True), test.messages


@pytest.mark.parametrize("elevation_deg", [45.0, 0.0, -40.0])
def test_every_bright_direction_can_be_sampled(emitter, elevation_deg: float) -> None:
    both = emitter(elevation_deg)
    rng = np.random.default_rng(2)
    d = rng.normal(size=(100_000, 3))
    d /= np.linalg.norm(d, axis=1)[:, None]
    poles = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0], sun(elevation_deg)])
    assert density(both, np.concatenate([poles, d])).min() > 0.0
    ds, weight = sampled(both, 100_000)
    assert np.array(ds.pdf).min() > 0.0
    assert np.isfinite(columns(weight)).all()
    again = np.array(both.pdf_direction(dr.zeros(mi.Interaction3f), ds))
    np.testing.assert_allclose(again, np.array(ds.pdf), rtol=1e-6)


def test_weights_are_radiance_over_density(emitter) -> None:
    both = emitter(20.0)
    ds, weight = sampled(both, 1000)
    it = dr.zeros(mi.Interaction3f, 1000)
    expected = columns(both.eval_direction(it, ds)) / np.array(ds.pdf)[:, None]
    np.testing.assert_allclose(columns(weight), expected, rtol=1e-4)
    si = dr.zeros(mi.SurfaceInteraction3f, 1000)
    si.wi = -ds.d
    np.testing.assert_array_equal(columns(both.eval(si)), columns(both.eval_direction(it, ds)))


def noise(emitter: dict, samples: int) -> float:
    """Standard deviation of a single sample's luminance, relative to the mean."""
    picture = plane(emitter, samples, size=40) @ LUMINANCE
    return float(picture.std() / picture.mean() * np.sqrt(samples))


@pytest.mark.parametrize(
    ("elevation_deg", "parameters"),
    [
        (20.0, {}),
        *(pytest.param(e, {}, marks=pytest.mark.slow) for e in (90.0, 60.0, 10.0, 5.0, 1.0)),
        *(pytest.param(e, {"sun_scale": 0.0}, marks=pytest.mark.slow) for e in (90.0, 20.0, 5.0, 1.0)),
    ],
)
def test_no_noisier_than_sunsky(rgb: None, elevation_deg: float, parameters: dict) -> None:
    # 128 samples in each of 1600 pixels: the ratio of two such deviations is known within 2 % (one sigma).
    common = {"sun_direction": sun(elevation_deg), "albedo": 0.1, **parameters}
    ours = noise({"type": "atmosphere", **common}, 128)
    theirs = noise({"type": "sunsky", **common}, 128)
    assert ours < 1.06 * theirs
