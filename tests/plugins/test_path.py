"""The integrator ``atmosphere_path``: against ``path`` where there is hardly air, against path-traced air where there
is, and against ``atmo_jit.sky`` where there is nothing else."""

from __future__ import annotations

import json

import drjit as dr
import numpy as np
import pytest
from towers import HAZE, SUN, camera, passes, shaded, tiles
from ztests import assert_agree, of_passes

import atmo_jit
from atmo_jit.errors import AtmosphereError, InputError
from atmo_jit.spectrum import SpectralBasis

mi = pytest.importorskip("mitsuba")

def things():
    """Small things on a floor: a glossy ball, a rough one, a lamp and a mirror."""
    at = mi.ScalarTransform4f()
    plastic = {"type": "plastic", "diffuse_reflectance": {"type": "rgb", "value": [0.6, 0.3, 0.1]}}
    rough = {"type": "roughconductor", "alpha": 0.2}
    return {
        "floor": {"type": "disk", "to_world": at.scale(100), "bsdf": {"type": "diffuse"}},
        "ball": {"type": "sphere", "center": [1.5, 8, 2], "radius": 2, "bsdf": plastic},
        "metal": {"type": "sphere", "center": [-4, 8, 2], "radius": 2, "bsdf": rough},
        "lamp": {
            "type": "sphere",
            "center": [-1, 6, 0.6],
            "radius": 0.5,
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [0.5, 0.3, 0.1]}},
        },
    }


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", pytest.param("llvm_ad_spectral", marks=pytest.mark.slow)])
def test_near_things_look_as_in_a_scene_without_air(plugins, variant):
    mi.set_variant(variant)
    found = []
    for integrator in ("path", "atmosphere_path"):
        scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": integrator, "max_depth": 4},
                "sky": {"type": "atmosphere", "sun_direction": [0.3, -0.7, 0.4], "altitude": 2.0},
                "sensor": camera(32, 16, [0, 0, 2], [0, 10, 2]),
                **things(),
            }
        )
        found.append(of_passes(tiles(passes(scene, 24, 32), 4)))
    # 10 m of air are not much, but not nothing; and the emitter's table is not exact.
    for estimate in found:
        estimate.variance[:] += (0.002 * found[0].mean) ** 2
    assert_agree(*found)


def test_shadows_in_the_air_are_those_of_path_traced_air(plugins):
    mi.set_variant("llvm_ad_mono")
    own = tiles(passes(shaded("atmosphere_path", 1), 8, 8), 8)
    truth = tiles(passes(shaded("atmosphere_volpath", 1), 16, 64), 8)
    without = tiles(passes(shaded("atmosphere_path", 1, shaft_samples=0), 1, 8), 8)[0]
    estimates = [of_passes(v) for v in (own, truth)]
    assert_agree(*estimates)
    # The shadows are there, and what is known of them is known well.
    assert np.max(without / estimates[1].mean) > 1.5
    assert np.median(np.sqrt(estimates[1].variance) / estimates[1].mean) < 0.01


def test_instances_are_the_shapes_that_they_stand_for(plugins):
    """Two towers of a group, in place of two cubes: the same shafts and surfaces."""
    mi.set_variant("llvm_ad_mono")
    at = mi.ScalarTransform4f()
    places = [
        at.translate([-1200, 6000, 1300]).scale([900, 400, 1500]),
        at.translate([2000, 5000, 1000]).scale([900, 400, 1200]),
    ]
    sky = {"type": "atmosphere", "atmosphere": json.dumps(HAZE), "sun_direction": SUN.tolist(), "sun_scale": 0.0}
    common = {
        "type": "scene",
        "integrator": {"type": "atmosphere_path", "max_depth": 2},
        "sky": {**sky, "altitude": 0.0},
        "sensor": camera(24, 16, [0, 0, 100], [0, 1000, 260], far_clip=1e8),
    }
    cubes = {f"cube{i}": {"type": "cube", "to_world": place} for i, place in enumerate(places)}
    group = {"type": "shapegroup", "cube": {"type": "cube"}}
    instances = {
        f"instance{i}": {"type": "instance", "group": {"type": "ref", "id": "group"}, "to_world": place}
        for i, place in enumerate(places)
    }
    scenes = [mi.load_dict({**common, **cubes}), mi.load_dict({**common, "group": group, **instances})]
    assert_agree(*(of_passes(tiles(passes(scene, 6, 8), 8)) for scene in scenes))


def test_textures_and_height_fields(rgb):
    """They look as in a scene without air. The field is one of distances, Mitsuba's own kind of a landscape."""
    at = mi.ScalarTransform4f()
    checks = {"type": "checkerboard", "to_uv": at.scale([4, 4, 1])}
    floor = {"type": "rectangle", "to_world": at.scale(20), "bsdf": {"type": "diffuse", "reflectance": checks}}
    z, y, x = np.meshgrid(*[np.linspace(0.0, 1.0, 9)] * 3, indexing="ij")
    above = z - 0.5 - 0.25 * np.sin(6.0 * x) * np.sin(6.0 * y)
    grid = mi.TensorXf(0.5 * above[..., None].astype(np.float32))
    field = {"type": "sdfgrid", "grid": grid, "to_world": at.translate([-4, -4, 0]).scale([8, 8, 4])}
    found = []
    for integrator in ("path", "atmosphere_path"):
        scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": integrator, "max_depth": 3},
                "sky": {"type": "atmosphere", "sun_direction": [0.3, -0.7, 0.4], "altitude": 2.0},
                "sensor": camera(16, 8, [0, -12, 8], [0, 0, 0]),
                "floor": floor,
                "field": field,
            }
        )
        found.append(of_passes(tiles(passes(scene, 8, 32), 4)))
    for estimate in found:
        estimate.variance[:] += (0.003 * found[0].mean) ** 2
    assert_agree(*found)


@pytest.mark.parametrize("target", [[1.0, 0.0, 0.006], [-1.0, 0.0, 0.1]])
def test_a_flattened_sun_shines_as_the_emitter_does(rgb, target):
    """Seen from an origin that looks at the sun, and on a wall behind it that faces the sun."""
    wall = mi.ScalarTransform4f().look_at([-1, 0, 0], [1, 0, 0], [0, 0, 1])
    seen = []
    for integrator in ("path", "atmosphere_path"):
        scene = {
            "type": "scene",
            "integrator": {"type": integrator},
            "sky": {"type": "atmosphere", "sun_direction": [1.0, 0.0, -0.0035], "refraction": True, "sky_scale": 1e-6},
            "sensor": camera(16, 16, [0, 0, 0], target, fov=1.0),
            "wall": {"type": "rectangle", "to_world": wall, "bsdf": {"type": "diffuse"}},
        }
        seen.append(np.array(mi.render(mi.load_dict(scene), spp=256))[..., :3].mean(axis=(0, 1)))
    assert seen[1].max() > 1e-3
    np.testing.assert_allclose(*seen, rtol=0.01)


@pytest.mark.parametrize("altitude", [2.0, 50e3, 400e3])
def test_without_shapes_the_picture_is_the_sky(rgb, altitude):
    size, parts = 16, 8
    sun = np.array([0.9, 0.2, 0.15]) / np.linalg.norm([0.9, 0.2, 0.15])
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "atmosphere_path"},
            "sky": {"type": "atmosphere", "sun_direction": sun.tolist(), "altitude": altitude, "sun_scale": 0.0},
            "sensor": camera(size, size, [0, 0, 0], [1, 0.1, 0.2 if altitude < 1e3 else -0.6]),
        }
    )
    picture = passes(scene, 8, 32)
    at = (np.arange(size * parts) + 0.5) / (size * parts)
    x, y = np.meshgrid(at, at)
    position = mi.Point2f(x.ravel().astype(np.float32), y.ravel().astype(np.float32))
    ray, _ = scene.sensors()[0].sample_ray(0.0, 0.5, position, mi.Point2f(0.5))
    d = np.array(ray.d, dtype=np.float64)
    views = {
        "altitude_m": altitude,
        "sun_zenith_deg": np.degrees(np.arccos(sun[2])),
        "view_zenith_deg": np.degrees(np.arctan2(np.hypot(d[0], d[1]), d[2])),
        "azimuth_deg": np.degrees(np.arctan2(d[1], d[0]) - np.arctan2(sun[1], sun[0])),
    }
    radiance = atmo_jit.sky("earth", views, method="march").radiance
    expected = SpectralBasis.of("earth").to_srgb(radiance).reshape(size, parts, size, parts, 3).mean(axis=(1, 3))
    estimate = of_passes(picture)
    error = np.abs(estimate.mean - expected)
    # Pixels at an edge depend on where in them the samples fall.
    assert np.median(error / expected.clip(1e-3)) < 0.003
    assert np.mean(error <= 4.0 * np.sqrt(estimate.variance) + 0.003 * expected + 1e-4) > 0.98
    assert np.all(picture >= 0.0)


def test_flat_rays_in_shallow_haze_have_the_light_of_a_field_of_many_altitudes(plugins):
    """From a roof over dark ground, as in the shipped city: their light begins within metres of it."""
    from dataclasses import replace

    from atmo_jit.backend import doubles
    from atmo_jit.resolution import Resolution
    from atmo_jit.sky import Sky

    mi.set_variant("llvm_ad_mono")
    shallow = {**HAZE, "mie": {**HAZE["mie"], "scattering_per_m": [5e-4], "scale_height_m": 400}}
    air = atmo_jit.Atmosphere.load(shallow)
    sky = {"type": "atmosphere", "atmosphere": json.dumps(shallow), "sun_direction": [0.0, 1.0, 0.4], "altitude": 42.0}
    views = np.array([[0.2, 1.0, 0.005], [0.2, 1.0, -0.05], [0.2, 1.0, -0.2]])
    found = []
    for view in views:
        sensor = camera(1, 1, [0, 0, 0], view.tolist(), fov=1e-3, far_clip=1e8)
        scene = {"type": "scene", "integrator": {"type": "atmosphere_path"}, "sky": sky, "sensor": sensor}
        found.append(float(np.array(mi.render(mi.load_dict(scene), spp=1)).ravel()[0]))
    fine = Sky(air, resolution=replace(Resolution.suited(air, 0.01), altitudes=96))
    angles = np.arctan2(1.0, 0.4), np.arccos(views[:, 2] / np.linalg.norm(views, axis=1)), np.arctan2(0.2, 1.0)
    rays = [doubles(np.broadcast_to(v, len(views))) for v in (42.0, *angles)]
    expected = np.array(fine.rays(*rays).radiance[0]) * SpectralBasis.of(air).xyz_matrix[1, 0]
    # The tolerance to which fields are solved.
    np.testing.assert_allclose(found, expected, rtol=0.01)


def test_aovs_split_the_picture(rgb):
    """In front of black shapes there is the air's light and nothing else; its transmittance is that of ``sky``."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "atmosphere_path", "aovs": "inscatter, transmittance", "shaft_samples": 0},
            "sky": {"type": "atmosphere", "sun_direction": [0.9, 0.2, 0.4], "altitude": 1000.0},
            "sensor": camera(4, 4, [0, 0, 0], [0, 1, 0], fov=0.2, far_clip=1e8),
            "wall": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().look_at([0, 2e4, 0], [0, 0, 0], [0, 0, 1]).scale(3e3),
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}},
            },
        }
    )
    assert scene.integrator().aov_names() == [f"{n}.{c}" for n in ("inscatter", "transmittance") for c in "RGB"]
    picture = passes(scene, 1, 16)[0].mean(axis=(0, 1))
    colour, inscatter, transmittance = picture[-9:-6], picture[-6:-3], picture[-3:]
    np.testing.assert_allclose(colour, inscatter, rtol=1e-4)
    views = {"altitude_m": 1000.0, "sun_zenith_deg": 66.5, "view_zenith_deg": 90.0, "azimuth_deg": 0.0}
    truth = atmo_jit.sky("earth", {**views, "distance_m": 2e4}).transmittance[0]
    basis = SpectralBasis.of("earth")
    white = basis.srgb_matrix * basis.solar_irradiance
    np.testing.assert_allclose(transmittance, white @ truth / white.sum(axis=1), rtol=5e-3)


def test_interval_in_shadow_holds_every_shaded_point(rgb):
    from atmo_jit.plugins.shadow_volume import shadowed_interval

    rng = np.random.default_rng(5)
    count = 400
    low, high = np.array([-3.0, 0.0, -2.5]), np.array([1.5, 3.0, 4.0])
    sun = rng.normal(size=(3, count))
    sun /= np.linalg.norm(sun, axis=0)
    sun[:, :20] = np.eye(3)[:, [0, 2] * 10]  # along an axis
    o, d = rng.uniform(-6, 6, (3, count)), rng.normal(size=(3, count))
    d /= np.linalg.norm(d, axis=0)
    box = mi.ScalarBoundingBox3f(mi.ScalarPoint3f(*low), mi.ScalarPoint3f(*high))
    start, end = shadowed_interval(box, mi.Vector3f(*sun), mi.Ray3f(mi.Point3f(*o), mi.Vector3f(*d)), mi.Float(10.0))
    start, end = (np.broadcast_to(np.array(v), count) for v in (start, end))
    t = np.linspace(0.0, 10.0, 501)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        sides = [((b[:, None, None] - o[:, None] - d[:, None] * t) / sun[:, None]) for b in (low, high)]
    near, far = np.minimum(*sides).max(axis=0), np.maximum(*sides).min(axis=0)
    meets = far >= np.maximum(near, 0.0)
    inside = (t >= start - 1e-3) & (t <= end + 1e-3)
    assert np.all(inside | ~meets)
    assert meets.any(axis=0).mean() > 0.2
    # And hardly more than they are.
    assert np.mean((t > start + 0.05) & (t < end - 0.05) & ~meets) < 0.01


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"max_depth": -2}, "max_depth"),
        ({"shaft_samples": -1}, "shaft_samples"),
        ({"scale": 0.0}, "scale"),
        ({"aovs": "depth"}, "aovs"),
    ],
)
def test_what_is_not_allowed_is_named(rgb, options, text):
    with pytest.raises((AtmosphereError, RuntimeError), match=text):
        mi.load_dict({"type": "atmosphere_path", **options})


def test_one_emitter_is_needed(rgb):
    sensor = camera(4, 4, [0, 0, 0], [1, 0, 0])
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "atmosphere_path"}, "sensor": sensor})
    with pytest.raises((InputError, RuntimeError), match="0 emitters of type atmosphere"):
        scene.integrator().render(scene, spp=1)


def followed(scene, key, *, reverse=True, **options):
    """The derivative of a picture by a parameter, forward, and that of its sum in reverse."""
    params = mi.traverse(scene)
    dr.enable_grad(params[key])
    params.set_dirty(key)
    params.update()
    picture = mi.render(scene, params, **options)
    dr.forward(params[key])
    forward, found = np.array(dr.grad(picture), dtype=np.float64), None
    if reverse:
        dr.set_grad(params[key], 0.0)
        dr.backward(dr.sum(mi.render(scene, params, **options).array))
        found = np.array(dr.grad(params[key]), dtype=np.float64)
    dr.disable_grad(params[key])
    params.set_dirty(key)
    params.update()
    return forward, found


@pytest.mark.parametrize("names", [["mie.phase.g"], pytest.param(["mie.scale_height_m"], marks=pytest.mark.slow)])
def test_derivatives_of_the_sky_are_those_of_the_solver(rgb, names):
    sun, view = np.array([0.25, 1.0, 0.5]), np.array([0.3, 1.0, 0.1])
    origin = np.array([0.0, 0.0, 100.0])
    sensor = camera(1, 1, origin.tolist(), (origin + view).tolist(), fov=1e-3, far_clip=1e8)
    sky = {"type": "atmosphere", "sun_direction": sun.tolist(), "altitude": 0.0, "mie_scattering_per_m": 3e-5}
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "atmosphere_path"}, "sky": sky, "sensor": sensor})
    zeniths = [np.degrees(np.arccos(d[2] / np.linalg.norm(d))) for d in (sun, view)]
    azimuths = [np.degrees(np.arctan2(d[1], d[0])) for d in (sun, view)]
    views = dict(zip(("sun_zenith_deg", "view_zenith_deg"), zeniths, strict=True))
    views |= {"altitude_m": 100.0, "azimuth_deg": azimuths[1] - azimuths[0]}
    air = atmo_jit.Atmosphere.load("earth").replace({"mie.scattering_per_m": 3e-5})
    matrix = SpectralBasis.of(air).srgb_matrix
    expected = atmo_jit.linearize(air, views).jacobian(names)
    for name in names:
        forward = followed(scene, f"sky.{name}", reverse=False, spp=1)[0]
        by = matrix @ expected[name][0]
        # Two nodes a piece and a table of the field cost as much here as in the picture itself.
        np.testing.assert_allclose(forward[0, 0], by, atol=0.015 * np.abs(by).max())


@pytest.mark.parametrize("where", ["sky", pytest.param("integrator", marks=pytest.mark.slow)])
def test_derivatives_behind_shapes_are_differences_of_pictures(plugins, where):
    """Shafts, sunlit and skylit surfaces in haze; the atmosphere is exposed where it was given."""
    mi.set_variant("llvm_ad_mono")
    air = json.dumps(HAZE)
    options = {"atmosphere": air} if where == "integrator" else {}
    scene = shaded("atmosphere_path", grey=0.5, **options)
    key = f"{where}.mie.scattering_per_m"
    forward, reverse = followed(scene, key, spp=32)
    step, pictures = 0.1 * HAZE["mie"]["scattering_per_m"][0], []
    for sign in (-1.0, 1.0):
        params = mi.traverse(scene)
        params[key] = HAZE["mie"]["scattering_per_m"][0] + sign * step
        params.update()
        pictures.append(passes(scene, 1, 128)[0])
    difference = (pictures[1] - pictures[0]) / (2.0 * step)
    forward, difference = (tiles(v[None], 16)[0] for v in (forward, difference))
    scale = np.abs(difference).mean()
    assert np.isfinite(forward).all()
    assert np.ptp(difference) > scale  # some of it brightens, some darkens
    np.testing.assert_allclose(forward, difference, atol=0.1 * scale)
    np.testing.assert_allclose(reverse[0], forward.sum() * 16**2, rtol=1e-3, atol=0.01 * scale)


@pytest.mark.parametrize(("key", "text"), [("ball.bsdf.reflectance.value", "ball.bsdf"), ("sky.bottom_radius_m",) * 2])
def test_what_has_no_derivative_is_named(rgb, key, text):
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "atmosphere_path"},
            "sky": {"type": "atmosphere", "sun_direction": [0.2, 1.0, 0.3]},
            "ball": {"type": "sphere", "bsdf": {"type": "diffuse"}},
        }
    )
    params = mi.traverse(scene)
    dr.enable_grad(params[key])
    with pytest.raises(InputError, match=text.rpartition(".")[2]):
        scene.integrator().render_forward(scene, params, spp=1)


def test_the_unit_of_length_does_not_matter(rgb):
    """The same scene in metres and in kilometres, with the planet's centre given and not."""
    pictures = []
    for scale, center in ((1.0, None), (1e-3, None), (1e-3, [0.0, 0.0, -6361.0])):
        at = mi.ScalarTransform4f()
        options = {} if center is None else {"center": mi.ScalarPoint3f(center)}
        scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "atmosphere_path", "max_depth": 3, "scale": scale, **options},
                "sky": {"type": "atmosphere", "sun_direction": [0.2, 1.0, 0.3], "altitude": 1000.0, "sun_scale": 0.0},
                "sensor": camera(8, 8, [0, 0, 0], [0, 1, 0.1], near_clip=1e-2 * scale, far_clip=1e8),
                "hill": {"type": "sphere", "center": [0, 9e3 * scale, -1e3 * scale], "radius": 2.5e3 * scale},
                "wall": {"type": "cube", "to_world": at.scale(scale).translate([3e3, 6e3, 0]).scale([400, 100, 2e3])},
            }
        )
        pictures.append(passes(scene, 1, 64)[0])
    np.testing.assert_allclose(pictures[1].mean(axis=(0, 1)), pictures[0].mean(axis=(0, 1)), rtol=2e-3)
    np.testing.assert_allclose(pictures[2].mean(axis=(0, 1)), pictures[0].mean(axis=(0, 1)), rtol=2e-3)
    assert np.median(np.abs(pictures[1] / pictures[0] - 1.0)) < 5e-3
