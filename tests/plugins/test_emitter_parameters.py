"""Parameters of the emitter ``atmosphere``: those of sunsky and of the atmosphere, what is exposed, what is refused."""

from __future__ import annotations

import json

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from emitters import columns, looking, seen, sun

import atmo_jit
from atmo_jit.atmosphere import Atmosphere

UP = np.array([sun(60.0, 100.0)])


def load(**parameters):
    return mi.load_dict({"type": "atmosphere", **parameters})


def from_xml(body: str):
    return mi.load_string(f'<scene version="3.0.0"><emitter type="atmosphere">{body}</emitter></scene>').environment()


@pytest.mark.parametrize(
    "parameters",
    [
        {},
        {"latitude": -33.9, "longitude": 18.4, "timezone": 2.0, "year": 2024, "month": 12, "day": 21, "hour": 9.5},
        {"sun_direction": [0.3, -0.2, 0.7], "to_world": "turned"},
        {"hour": 10.0, "minute": 20.0, "second": 30.0, "to_world": "turned"},
    ],
    ids=["default", "place", "direction", "turned"],
)
def test_sunskys_parameters_mean_the_same(rgb: None, parameters: dict) -> None:
    if "to_world" in parameters:
        parameters = parameters | {"to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90.0)}
    ours = mi.traverse(load(sun_scale=2.0, sky_scale=0.5, sun_aperture=1.0, albedo=0.2, **parameters))
    theirs = mi.traverse(
        mi.load_dict(
            {"type": "sunsky", "sun_scale": 2.0, "sky_scale": 0.5, "sun_aperture": 1.0, "albedo": 0.2, **parameters}
        )
    )
    np.testing.assert_allclose(columns(ours["sun_direction"]), columns(theirs["sun_direction"]), atol=1e-3)
    for name in theirs.keys():
        if name in ("turbidity", "to_world", "sun_direction"):
            continue
        assert name in ours
        np.testing.assert_allclose(float(np.array(ours[name]).ravel()[0]), np.array(theirs[name]).ravel()[0], rtol=1e-6)
    both = "sun_direction" in parameters
    assert bool(ours.flags("sun_direction") & mi.ParamFlags.ReadOnly.value) != both


def test_flags(rgb: None) -> None:
    emitter = load(sun_direction=[0, 0, 1], sampling_weight=0.25)
    assert emitter.is_environment() and emitter.sampling_weight() == 0.25
    assert emitter.flags() == int(mi.EmitterFlags.Infinite) | int(mi.EmitterFlags.SpatiallyVarying)
    assert not emitter.bbox().valid()
    assert "elevation = 90.000 degrees" in str(emitter)


def test_atmosphere_by_name_file_and_text(rgb: None, tmp_path) -> None:
    thin = Atmosphere.load("earth").replace({"mie": None, "ground_albedo": 0.4})
    text = json.dumps(thin.to_dict())
    (tmp_path / "thin.json").write_text(text)
    common = {"sun_direction": sun(30.0)}
    by_text = seen(load(atmosphere=text, **common), UP)
    np.testing.assert_array_equal(seen(load(atmosphere=str(tmp_path / "thin.json"), **common), UP), by_text)
    resolver = mi.file_resolver()
    resolver.append(str(tmp_path))  # Mitsuba looks beside the scene file
    np.testing.assert_array_equal(seen(load(atmosphere="thin.json", **common), UP), by_text)
    assert np.all(seen(load(atmosphere="earth", **common), UP) != by_text)


def test_dotted_names(rgb: None) -> None:
    xml = from_xml(
        '<vector name="sun_direction" value="0.5, 0, 0.5"/><float name="mie.phase.g" value="0.6"/>'
        '<string name="mie.scattering_per_m" value="2e-5 2e-5,3e-5"/>'
    )
    same = load(sun_direction=[0.5, 0, 0.5], mie_phase_g=0.6, mie_scattering_per_m="2e-5, 2e-5, 3e-5")
    np.testing.assert_array_equal(seen(xml, UP), seen(same, UP))
    vector = load(sun_direction=[0.5, 0, 0.5], mie_phase_g=0.6, mie_scattering_per_m=[2e-5, 2e-5, 3e-5])
    np.testing.assert_array_equal(seen(vector, UP), seen(same, UP))
    array = load(sun_direction=[0.5, 0, 0.5], mie_phase_g=0.6, mie_scattering_per_m=mi.Float([2e-5, 2e-5, 3e-5]))
    np.testing.assert_array_equal(seen(array, UP), seen(same, UP))
    exposed = mi.traverse(same)
    for name in atmo_jit.atmosphere.Atmosphere.load("earth").names():
        assert name in exposed
    np.testing.assert_allclose(np.array(exposed["mie.scattering_per_m"]), [2e-5, 2e-5, 3e-5], rtol=1e-6)
    other = load(sun_direction=[0.5, 0, 0.5], mie_phase_type="henyey_greenstein")
    assert np.all(seen(other, UP) != seen(load(sun_direction=[0.5, 0, 0.5]), UP))


def test_albedo_is_a_texture(rgb: None) -> None:
    down = np.array([sun(-60.0)])
    dark, grey = (seen(load(sun_direction=sun(40.0), albedo=a), down)[0] for a in (0.0, 0.5))
    assert np.all(grey > 5.0 * dark)
    green = seen(load(sun_direction=sun(40.0), albedo={"type": "rgb", "value": [0.1, 0.5, 0.1]}), down)[0]
    assert green[1] > 2.0 * green[0] and green[1] > 2.0 * green[2]
    assert green[1] == pytest.approx(grey[1], rel=0.25)


def test_changes_solve_again(rgb: None) -> None:
    scene = mi.load_dict({"type": "scene", "sky": {"type": "atmosphere", "sun_direction": sun(40.0)}})
    emitter = scene.environment()
    parameters = mi.traverse(scene)
    before = seen(emitter, UP)

    def set_and_look(**changes) -> np.ndarray:
        for name, value in changes.items():
            parameters["sky." + name.replace("__", ".")] = value
        parameters.update()
        return seen(emitter, UP)

    # The same value by the way of the loader, to the last bit.
    expected = seen(load(sun_direction=sun(40.0), mie_phase_g=0.5), UP)
    np.testing.assert_array_equal(set_and_look(mie__phase__g=0.5), expected)
    np.testing.assert_array_equal(set_and_look(mie__phase__g=0.8), before)
    np.testing.assert_array_equal(set_and_look(sky_scale=0.5), 0.5 * before)
    set_and_look(sky_scale=1.0)
    x, y, z = sun(10.0)
    low = set_and_look(sun_direction=mi.Vector3f(x, y, z))
    np.testing.assert_allclose(low, seen(load(sun_direction=sun(10.0)), UP), rtol=1e-5)
    high = set_and_look(altitude=8000.0)
    np.testing.assert_allclose(high, seen(load(sun_direction=sun(10.0), altitude=8000.0), UP), rtol=1e-5)
    bright = set_and_look(albedo__value=0.9)
    assert np.all(bright > high)
    np.testing.assert_array_equal(emitter._atmosphere.ground_albedo, np.float64(np.float32(0.9)))
    assert np.all(set_and_look(ground_albedo=0.0) < high)
    # The tables that were handed out are those in use.
    doubled = parameters["sky.sky_radiance"] * 2.0
    now = seen(emitter, UP)
    np.testing.assert_allclose(set_and_look(sky_radiance=doubled), 2.0 * now, rtol=1e-6)
    with pytest.raises(ValueError, match=r"^mie\.phase\.g: found 1\.5; allowed: .*\(-1, 1\)$"):
        set_and_look(mie__phase__g=1.5)


def test_time_moves_the_sun(rgb: None) -> None:
    emitter = load(hour=12.0)
    parameters = mi.traverse(emitter)
    parameters["hour"] = 18.0
    parameters.update()
    np.testing.assert_allclose(
        columns(parameters["sun_direction"]), columns(mi.traverse(load(hour=18.0))["sun_direction"]), atol=1e-6
    )


def test_derivatives(rgb: None) -> None:
    emitter = load(sun_direction=sun(35.0), sun_scale=0.0)
    parameters = mi.traverse(emitter)

    # By the table and by the scale: radiance is linear in both.
    for name in ("sky_radiance", "sky_scale"):
        value = type(parameters[name])(parameters[name])
        dr.enable_grad(value)
        parameters[name] = value
        parameters.update()
        out = dr.sum(emitter.eval(looking(UP)), axis=None)
        dr.backward(out)
        total = float(np.sum(np.array(dr.grad(value)) * np.array(dr.detach(value))))
        assert total == pytest.approx(float(out[0]), rel=1e-5)
        parameters[name] = dr.detach(value)
        parameters.update()

    # By the sun's elevation: against a difference.
    def at(angle) -> mi.Color3f:
        parameters["sun_direction"] = mi.Vector3f(dr.cos(angle), 0.0, dr.sin(angle))
        parameters.update()
        return emitter.eval(looking(UP))

    angle, step = mi.Float(0.6), 0.01
    dr.enable_grad(angle)
    value = at(angle)
    dr.forward(angle)
    slope = columns(dr.grad(value))
    difference = (columns(at(mi.Float(0.6 + step))) - columns(at(mi.Float(0.6 - step)))) / (2.0 * step)
    np.testing.assert_allclose(slope, difference, rtol=0.01)


def weighed(emitter) -> mi.Float:
    """A sum of the sky's colours in a few directions, the ground among them, and not the sun."""
    directions = np.array([sun(80.0), sun(50.0, 90.0), sun(10.0, 30.0), sun(-30.0)])
    return dr.sum(sum(emitter.eval(looking(directions))) * mi.Float([1.0, 2.0, -1.0, 0.5]))


@pytest.mark.parametrize("name", ["mie.phase.g", "rayleigh.scattering_per_m", "altitude"])
def test_derivatives_by_the_atmosphere(name: str, rgb: None) -> None:
    """Against differences of emitters, whose solves have an error of some 1e-3 that changes with the resolution."""
    emitter = load(sun_direction=sun(35.0), mie_scattering_per_m=2e-5, mie_phase_g=0.7, altitude=2000.0)
    parameters = mi.traverse(emitter)
    value = type(parameters[name])(parameters[name])
    dr.enable_grad(value)
    parameters[name] = value
    parameters.update()
    dr.backward(weighed(emitter))
    start = np.array(dr.detach(value), dtype=float)
    slope = float(dr.grad(value).numpy() @ start)
    ends, step = [], 0.01
    for sign in (1, -1):
        parameters[name] = mi.Float((start * (1.0 + sign * step)).tolist())
        parameters.update()
        ends.append(float(weighed(emitter)[0]))
    assert slope == pytest.approx((ends[0] - ends[1]) / (2.0 * step), rel=0.06)


@pytest.mark.slow
def test_an_optimisation_finds_the_haze(rgb: None) -> None:
    """The usual loop: render, compare, step. Two parameters of the aerosol from a picture of 64 x 32 pixels."""

    def scene(**aerosol):
        camera = {"type": "latlong", "film": {"type": "hdrfilm", "width": 64, "height": 32, "rfilter": {"type": "box"}}}
        sky = {"type": "atmosphere", "sun_direction": sun(35.0), "sun_scale": 0.0, **aerosol}
        return mi.load_dict({"type": "scene", "integrator": {"type": "path"}, "sensor": camera, "sky": sky})

    picture = mi.render(scene(mie_scattering_per_m=1.5e-5, mie_phase_g=0.65), spp=16)
    start = scene(mie_scattering_per_m=4e-6, mie_phase_g=0.8)
    parameters = mi.traverse(start)
    names = "sky.mie.phase.g", "sky.logarithm"
    optimiser = mi.ad.Adam(lr=0.03)
    optimiser[names[0]] = mi.Float(0.8)
    optimiser[names[1]] = mi.Float(np.log(4e-6))
    optimiser.set_learning_rate({names[1]: 0.2})
    losses = []
    for _ in range(25):
        parameters[names[0]] = optimiser[names[0]]
        parameters["sky.mie.scattering_per_m"] = dr.exp(optimiser[names[1]])
        parameters.update()
        difference = mi.render(start, parameters, spp=16) - picture
        loss = dr.mean(dr.square(difference / (picture + 1e-3)), axis=None)
        dr.backward(loss)
        optimiser.step()
        losses.append(float(loss.array[0]))
    assert losses[-1] < 0.1 * losses[0]
    assert float(optimiser[names[0]][0]) == pytest.approx(0.65, abs=0.05)
    assert float(np.exp(optimiser[names[1]][0])) == pytest.approx(1.5e-5, rel=0.25)


def test_frozen_functions(rgb: None) -> None:
    scene = mi.load_dict({"type": "scene", "sky": {"type": "atmosphere", "sun_direction": sun(40.0)}})

    @dr.freeze
    def look(scene, x):
        si = dr.zeros(mi.SurfaceInteraction3f, 3)
        si.wi = -dr.normalize(mi.Vector3f(x, 0.1, 1.0))
        return scene.environment().eval(si)

    parameters = mi.traverse(scene)
    for elevation in (40.0, 20.0):
        x, y, z = sun(elevation)
        parameters["sky.sun_direction"] = mi.Vector3f(x, y, z)
        parameters.update()
        for shift in (0.0, 0.5):
            a = np.array([0.1, 0.2, 0.3]) + shift
            d = np.stack([a, np.full(3, 0.1), np.ones(3)], axis=-1)
            d /= np.linalg.norm(d, axis=1)[:, None]
            found = columns(look(scene, mi.Float(a)))
            np.testing.assert_allclose(found, seen(scene.environment(), d), rtol=1e-4)


REFUSED = [
    ({"turbidity": 3.0}, r"turbidity: found 3\.0; allowed: .*mie\.scattering_per_m = 1\.5e-04"),
    ({"sun_direction": [0, 0, 1], "hour": 3.0}, "Both the 'sun_direction' and parameters for time/location were"),
    ({"sun_direction": [0, 0, 0]}, "sun_direction: found .* allowed: a vector"),
    ({"sun_direction": "up"}, "sun_direction: found 'up'; allowed: a vector"),
    ({"altitude": -1.0}, r"altitude: found -1\.0; allowed: a finite number >= 0"),
    ({"altitude": "high"}, "altitude: found 'high'; allowed: a finite number"),
    ({"sun_scale": -1.0}, r"sun_scale: found -1\.0"),
    ({"sky_scale": float("nan")}, "sky_scale: found nan"),
    ({"sun_aperture": 0.0}, r"sun_aperture: found 0\.0; allowed: .*\(0, 180\)"),
    ({"month": 13}, r"month: found 13; allowed: a whole number in \[1, 12\]"),
    ({"albedo": 2.0}, r"albedo: found .* allowed: values in \[0, 1\]"),
    ({"albedo": {"type": "checkerboard"}}, "albedo: found a texture that varies in space"),
    ({"albedo": 0.1, "ground_albedo": 0.2}, "albedo: found together with ground_albedo"),
    ({"atmosphere": "venus"}, "atmosphere: found 'venus' .* allowed: a JSON file or a preset"),
    ({"atmosphere": "{"}, r"atmosphere: found invalid JSON"),
    ({"atmosphere": '{"air": 1}'}, "air: found an unknown key"),
    ({"mie_phase_g": 3.0}, r"mie\.phase\.g: found 3\.0"),
    ({"mie_scattering_per_m": "1e-5 2e-5"}, r"mie\.scattering_per_m: found a list of 2; allowed: a list of 3"),
    ({"wavelengths": "few"}, r"wavelengths: found .few.; allowed: fast, or numbers > 0"),
    ({"to_world": "stretched"}, "to_world: found a transformation that distorts angles"),
]


@pytest.mark.parametrize(("parameters", "message"), REFUSED, ids=[next(iter(p)) for p, _ in REFUSED])
def test_refused(rgb: None, parameters: dict, message: str) -> None:
    if parameters.get("to_world"):
        parameters = {"to_world": mi.ScalarTransform4f().scale([1, 2, 1])}
    with pytest.raises(RuntimeError, match=message) as caught:
        load(**parameters)
    # Mitsuba prefixes the place and Python's own traceback; what the plugin says is one line, the last.
    assert message.split("'")[0].split(":")[0].replace("\\", "") in str(caught.value).splitlines()[-1]


def test_unknown_names_are_errors(rgb: None) -> None:
    with pytest.raises(RuntimeError, match=r'unreferenced property in emitter plugin of type "atmosphere"'):
        load(sun_direktion=1.0)
    with pytest.raises(RuntimeError, match=r"mie\.nope: found an unknown key"):
        from_xml('<float name="mie.nope" value="1"/>')
    with pytest.raises(RuntimeError, match=r"nope\.x: found no value of that name"):
        from_xml('<float name="nope.x" value="1"/>')
