"""The medium ``atmosphere_medium``: coefficients, majorants, wavelengths, parameters, and radiance."""

from __future__ import annotations

import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")
dr = pytest.importorskip("drjit")

RADIUS, THICKNESS = 6360e3, 60e3
LAYERED = {
    "wavelengths_nm": [680, 550, 440],
    "bottom_radius_m": RADIUS,
    "top_radius_m": RADIUS + THICKNESS,
    "mie": {
        "scattering_per_m": [1e-5, 2e-5, 4e-5],
        "single_scattering_albedo": [0.8, 0.9, 1.0],
        "profile": {"altitude_m": [0, 1500, 1500, 4000], "density": [0.2, 0.3, 1, 0.5]},
        "phase": {"type": "henyey_greenstein", "g": [0.5, 0.6, 0.7]},
    },
    "ozone": {"absorption_per_m": [6.5e-7, 1.881e-6, 8.5e-8], "center_m": 25e3, "half_width_m": 15e3},
}


def medium(atmosphere="earth", **options):
    import json

    text = atmosphere if isinstance(atmosphere, str) else json.dumps(atmosphere)
    return mi.load_dict({"type": "atmosphere_medium", "atmosphere": text, **options})


def interaction(p):
    """A medium interaction at points [N, 3]."""
    mei = dr.zeros(mi.MediumInteraction3f, len(p))
    mei.p = mi.Point3f(*np.asarray(p, dtype=np.float32).T)
    return mei


def coefficients(medium, altitude_m):
    """Scattering and extinction (1/m) [N, 3] above the scene's origin."""
    p = np.zeros((len(altitude_m), 3))
    p[:, 2] = altitude_m
    scattering, _, extinction = medium.get_scattering_coefficients(interaction(p))
    return np.array(scattering).T, np.array(extinction).T


@pytest.mark.parametrize("atmosphere", ["earth", LAYERED])
def test_coefficients_are_those_of_the_atmosphere(rgb, atmosphere):
    from atmo_jit import Atmosphere

    truth = Atmosphere.load(atmosphere)
    h = np.array([0.5, 10.0, 1499.0, 1501.0, 3999.0, 4001.0, 12e3, 25e3, 39e3, 59.9e3])
    density = [c.profile.density(h)[:, None] for c in truth.constituents]
    scattering, extinction = coefficients(medium(atmosphere), h)
    expected = sum(d * c.scattering_per_m for d, c in zip(density, truth.constituents, strict=True))
    np.testing.assert_allclose(scattering, expected, rtol=1e-4, atol=1e-13)
    expected = sum(d * c.extinction_per_m for d, c in zip(density, truth.constituents, strict=True))
    np.testing.assert_allclose(extinction, expected, rtol=1e-4, atol=1e-13)


def test_nothing_below_the_ground_and_above_the_top(rgb):
    _, extinction = coefficients(medium(), np.array([-100.0, THICKNESS + 100.0]))
    assert not extinction.any()


def test_altitude_holds_in_single_precision(rgb):
    """Within 1 cm at up to 100 km from the scene's origin, where coordinates are known to 4 mm."""
    air = medium().air
    rng = np.random.default_rng(3)
    p = np.float32(np.stack([*(rng.uniform(-7e4, 7e4, (2, 1000))), rng.uniform(0.0, 2e4, 1000)], axis=-1))
    truth = np.hypot(np.hypot(*p[:, :2].astype(np.float64).T), p[:, 2].astype(np.float64) + RADIUS) - RADIUS
    found = np.array(air.altitude(mi.Point3f(*p.T)))
    assert np.abs(found - truth).max() < 1e-2


@pytest.mark.parametrize("atmosphere", ["earth", LAYERED])
def test_majorant_bounds_the_extinction_along_every_ray(rgb, atmosphere):
    rng = np.random.default_rng(5)
    count, steps = 400, 500
    origin = np.zeros((count, 3))
    origin[:, 2] = rng.choice([1.0, 1400.0, 3e3, 20e3, 59e3, 200e3], count)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    ray = mi.Ray3f(mi.Point3f(*np.float32(origin).T), mi.Vector3f(*np.float32(direction).T))
    air = medium(atmosphere)
    hits, near, far = air.intersect_aabb(ray)
    bound = np.array(air.get_majorant(dr.zeros(mi.MediumInteraction3f, count)))[0]
    t = np.array(near) + (np.array(far) - np.array(near)) * np.linspace(0.0, 1.0, steps)[:, None]
    for row in t:
        p = origin + row[:, None] * direction
        _, _, extinction = air.get_scattering_coefficients(interaction(p))
        above = np.hypot(np.hypot(p[:, 0], p[:, 1]), p[:, 2] + RADIUS) > RADIUS
        keep = np.array(hits) & above
        assert np.all(np.array(extinction).max(axis=0)[keep] <= bound[keep])


def test_majorant_of_an_upward_ray_is_that_of_its_own_altitude(rgb):
    air = medium()
    for altitude in (1.0, 8e3, 30e3):
        air.intersect_aabb(mi.Ray3f(mi.Point3f(0, 0, altitude), mi.Vector3f(0.6, 0, 0.8)))
        bound = air.get_majorant(dr.zeros(mi.MediumInteraction3f, 1))[0][0]
        _, extinction = coefficients(air, np.array([altitude]))
        assert extinction.max() <= bound < 1.03 * extinction.max()


def test_where_rays_meet_the_air(rgb):
    air = medium()
    hits, near, far = air.intersect_aabb(mi.Ray3f(mi.Point3f(0, 0, 2), mi.Vector3f(0, 0, 1)))
    assert hits[0] and near[0] == 0.0 and far[0] == pytest.approx(THICKNESS - 2.0, abs=0.1)
    hits, near, far = air.intersect_aabb(mi.Ray3f(mi.Point3f(0, 0, 400e3), mi.Vector3f(0, 0, -1)))
    assert hits[0] and near[0] == pytest.approx(340e3, abs=1.0)
    for direction in ((0, 0, 1), (1, 0, 0)):
        assert not air.intersect_aabb(mi.Ray3f(mi.Point3f(0, 0, 400e3), mi.Vector3f(*direction)))[0][0]


def test_rays_of_two_threads_keep_their_own_bounds(rgb):
    """Scalar variants render with several threads, whose calls interleave."""
    import threading

    air = medium()
    high, low = (mi.Ray3f(mi.Point3f(0, 0, h), mi.Vector3f(0, 0, 1)) for h in (20e3, 2.0))
    mei = interaction([[0.0, 0.0, 2.0]])
    air.intersect_aabb(low)
    expected = air.get_majorant(mei)[0][0]
    air.intersect_aabb(low)
    other = threading.Thread(target=air.intersect_aabb, args=(high,))
    other.start()
    other.join()
    assert air.get_majorant(mei)[0][0] == expected


def test_phase_function_depolarizes(plugins):
    """The air's scattering is that of intensities: unpolarized light comes out with the same four values."""

    def found(variant):
        mi.set_variant(variant)
        plugins.register()
        mei = dr.zeros(mi.MediumInteraction3f)
        mei.p, mei.wi = mi.Point3f(0, 0, 100), mi.Vector3f(0, 0, -1)
        mei.sh_frame, mei.wavelengths = mi.Frame3f(mei.wi), [400.0, 500.0, 600.0, 700.0]
        phase, ctx = medium().phase_function(), mi.PhaseFunctionContext()
        value, pdf = phase.eval_pdf(ctx, mei, mi.Vector3f(0.6, 0.0, 0.8))
        _, weight, drawn = phase.sample(ctx, mei, 0.3, mi.Point2f(0.2, 0.7))
        return np.array(value, dtype=float), np.array(weight, dtype=float), pdf, drawn

    *plain, pdf, drawn = found("scalar_spectral")
    *matrices, other_pdf, other_drawn = found("scalar_spectral_polarized")
    assert (pdf, drawn) == (other_pdf, other_drawn)
    for spectrum, matrix in zip(plain, matrices, strict=True):
        expected = np.zeros((4, 4, 4))
        expected[0, 0] = spectrum
        np.testing.assert_array_equal(matrix, expected)


def test_phase_function_where_nothing_scatters(plugins):
    """Scalar variants raise an exception for a division by zero."""
    mi.set_variant("scalar_rgb")
    plugins.register()
    mei = dr.zeros(mi.MediumInteraction3f)
    mei.p, mei.wi = mi.Point3f(0, 0, 90e3), mi.Vector3f(0, 0, -1)
    mei.sh_frame = mi.Frame3f(mei.wi)
    value, pdf = medium().phase_function().eval_pdf(mi.PhaseFunctionContext(), mei, mi.Vector3f(0.6, 0.0, 0.8))
    assert np.all(np.array(value) == 0.0) and pdf == 0.0


def test_phase_function_mixes_per_wavelength(rgb):
    """Rayleigh and aerosol, each in proportion to what it scatters at that altitude and wavelength."""
    from atmo_jit import Atmosphere

    truth, air = Atmosphere.load("earth"), medium()
    for altitude in (100.0, 5e3):
        mei = interaction([[0.0, 0.0, altitude]])
        mei.wi = mi.Vector3f(0, 0, -1)
        mei.sh_frame = mi.Frame3f(mei.wi)
        for nu in (-0.9, 0.1, 0.95):
            wo = mi.Vector3f(float(np.sqrt(1 - nu * nu)), 0, nu)
            found = np.array(air.phase_function().eval_pdf(mi.PhaseFunctionContext(), mei, wo)[0]).ravel()
            parts = [(c.scattering_per_m * c.profile.density(altitude), c.phase) for c in truth.constituents if c.phase]
            total = sum(s for s, _ in parts)
            np.testing.assert_allclose(found, sum(s * p.value(nu) for s, p in parts) / total, rtol=1e-4)


@pytest.mark.parametrize("atmosphere", ["earth", LAYERED])
def test_directions_follow_the_density(rgb, atmosphere):
    from mitsuba.chi2 import ChiSquareTest, SphericalDomain

    phase, context = medium(atmosphere).phase_function(), mi.PhaseFunctionContext()

    def state(count):
        mei = interaction(np.tile([[0.0, 0.0, 800.0]], (count, 1)))
        mei.wi = mi.Vector3f(0, 0, 1)
        mei.sh_frame = mi.Frame3f(mei.wi)
        return mei

    def sample(u):
        wo, _, _ = phase.sample(context, state(dr.width(u)), u[0], mi.Point2f(u[1], u[2]))
        return wo, dr.ones(mi.Float, dr.width(u))

    def density(wo):
        return phase.eval_pdf(context, state(dr.width(wo)), wo)[1]

    test = ChiSquareTest(SphericalDomain(), sample, density, sample_dim=3, sample_count=200_000, res=51, ires=16)
    assert test.run(), test.messages


def test_dotted_values_and_parameters(rgb):
    air = medium(mie_phase_g=0.5, mie_scattering_per_m="1e-5, 2e-5, 3e-5")
    parameters = mi.traverse(air)
    assert parameters["mie.phase.g"][0] == 0.5
    np.testing.assert_allclose(np.array(parameters["mie.scattering_per_m"]), [1e-5, 2e-5, 3e-5])
    before = coefficients(air, np.array([10.0]))[1]
    parameters["mie.scattering_per_m"] = mi.Float(2e-5, 4e-5, 6e-5)
    parameters.update()
    after = coefficients(air, np.array([10.0]))[1]
    np.testing.assert_allclose(after - before, [[1.11e-5, 2.22e-5, 3.33e-5]], rtol=0.02)
    air.intersect_aabb(mi.Ray3f(mi.Point3f(0, 0, 10), mi.Vector3f(1, 0, 0)))
    assert air.get_majorant(dr.zeros(mi.MediumInteraction3f, 1))[0][0] >= after.max()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"atmosphere": "venus"}, "atmosphere"),
        ({"scale": 0.0}, "scale"),
        ({"channels": "0, 1"}, "channels"),
        ({"channels": "0, 1, 3"}, "channels"),
        ({"wavelength_rule": "dice"}, "wavelength_rule"),
        ({"mie_phase_g": 1.5}, "mie.phase.g"),
        ({"own": {"type": "hg"}}, "phase"),
    ],
)
def test_errors_name_the_parameter(rgb, options, words):
    with pytest.raises(RuntimeError, match=words):
        mi.load_dict({"type": "atmosphere_medium", **options})


def test_mono_shows_the_wavelength_nearest_to_555_nm(plugins):
    mi.set_variant("llvm_ad_mono")
    air = mi.load_dict({"type": "atmosphere_medium", "atmosphere": "earth"})
    assert air.air.wavelengths.channels == [1]


# Each pair compiles kernels of its own for seconds.
@pytest.mark.parametrize(
    ("variant", "integrator"),
    [
        ("llvm_ad_rgb", "volpath"),
        ("llvm_ad_rgb", "prbvolpath"),
        ("llvm_ad_spectral", "volpathmis"),
        pytest.param("llvm_ad_spectral", "volpath", marks=pytest.mark.slow),
        pytest.param("llvm_ad_spectral", "prbvolpath", marks=pytest.mark.slow),
        pytest.param("llvm_ad_rgb", "volpathmis", marks=pytest.mark.slow),
    ],
)
def test_scene_of_ones_own_with_a_null_sphere(plugins, variant, integrator):
    """The medium as any other, inside a sphere with a null BSDF, seen from space, against the scene of ``planet``."""
    mi.set_variant(variant)
    from atmo_jit.plugins.planet import planet

    parts = planet("earth", sun_direction=[0.5, 0.0, 0.8])
    air = mi.load_dict({"type": "atmosphere_medium", "atmosphere": "earth"})
    target = [1.0, 2.0, 0.0]
    sensor = {
        "type": "perspective",
        "fov": 20,
        "far_clip": 1e8,
        "to_world": mi.ScalarTransform4f().look_at([0, 0, 200e3], target, [1, 0, 0]),
        "film": {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}},
        "shutter_open": 0.0,
        "shutter_close": 1.0,
    }
    ground = {
        "type": "sphere",
        "center": [0, 0, -RADIUS],
        "radius": RADIUS - 100.0,
        "bsdf": {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.1}},
    }
    own = {
        "type": "scene",
        "integrator": {"type": integrator, "max_depth": 1000, "rr_depth": 1000},
        "top": {
            "type": "sphere",
            "center": [0, 0, -RADIUS],
            "radius": RADIUS + THICKNESS,
            "bsdf": {"type": "null"},
            "interior": air,
        },
        "ground": ground,
        "sun": {"type": "directional", "direction": [-0.5, 0, -0.8], "irradiance": {"type": "uniform", "value": 1.0}},
        "sensor": sensor,
    }
    found = np.mean([np.array(mi.render(mi.load_dict(own), spp=4096, seed=i)) for i in range(2)], axis=(0, 1, 2))
    volpath = {"type": "volpath", "max_depth": -1, "rr_depth": 1000}
    scene = mi.load_dict(
        {"type": "scene", "integrator": volpath, **parts, "sensor": {**sensor, "medium": parts["air"]}}
    )
    truth = np.mean([np.array(mi.render(scene, spp=4096, seed=i)) for i in range(2)], axis=(0, 1, 2))
    np.testing.assert_allclose(found, truth, rtol=0.03)


def test_radiance_agrees_with_the_reference_data(plugins, reference):
    """A part of ``python -m bench.reference_medium sky``, which takes minutes to compare all rays closely."""
    from bench.reference_medium import compare

    mi.set_variant("llvm_ad_mono")
    rows = list(compare(4000, [0, 3, 8, 12, 15], every=3))
    z = np.concatenate([row.z for row in rows])
    assert len(z) > 60
    assert 0.8 < np.sqrt(np.mean(z**2)) < 1.25
    for row in rows:
        assert abs(row.bias) < 0.003 + 3 * row.bias_error, row.name


@pytest.mark.slow
def test_all_rays_agree_with_the_reference_data(plugins, reference):
    from bench.reference_medium import compare

    mi.set_variant("llvm_ad_mono")
    rows = list(compare(100_000))
    z = np.concatenate([row.z for row in rows])
    assert len(rows) == 17 and len(z) > 650
    assert 0.9 < np.sqrt(np.mean(z**2)) < 1.1
    for row in rows:
        assert abs(row.bias) < 0.003 + 2 * row.bias_error, row.name


@pytest.mark.slow
def test_single_scattering_agrees_with_quadrature(plugins, reference):
    from bench.reference_medium import compare

    mi.set_variant("llvm_ad_mono")
    for row in compare(50_000, single=True):
        assert abs(row.bias) < 0.001 + 3 * row.bias_error, row.name


def test_derivatives_by_path_replay(plugins, reference):
    """Two rays with large derivatives; all of them: ``python -m bench.medium_derivatives``."""
    from bench.medium_derivatives import compare

    mi.set_variant("llvm_ad_mono")
    for _, difference, sigma in compare(2**18, [0, 14]):
        assert np.all(np.abs(difference) < 0.02 + 3 * sigma)
        assert np.all(sigma < 0.3)


@pytest.mark.slow
def test_more_derivatives_by_path_replay(plugins, reference):
    """Rays whose derivatives are known well from half a million paths."""
    from bench.medium_derivatives import compare

    mi.set_variant("llvm_ad_mono")
    for row, difference, sigma in compare(2**19, [2, 3, 6, 7, 10, 11, 14, 15]):
        assert np.all(np.abs(difference) < 0.02 + 3 * sigma), row
