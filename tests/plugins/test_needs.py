"""What a scene asks of its emitter, read without solving: the same sun and settings that the emitter itself finds."""

from __future__ import annotations

import math

import mitsuba as mi
import numpy as np
import pytest

from atmo_jit.errors import InputError

SKIES = {
    "direction": {"sun_direction": [0.2, -0.5, 0.4]},
    "turned": {"sun_direction": [0.2, 0.9, 0.1], "turn": 90.0},
    "place and time": {"latitude": 45.0, "hour": 10.0, "month": 3.0},
    "place and time, turned": {"latitude": 45.0, "hour": 10.0, "turn": 30.0},
    "values": {"altitude": 3000.0, "mie_phase_g": 0.6, "albedo": 0.4, "sun_direction": [0.0, 0.0, 1.0]},
}


def description(sky, kind="atmosphere"):
    found = {"type": kind, **{k: v for k, v in sky.items() if k != "turn"}}
    if "turn" in sky:
        found["to_world"] = mi.ScalarTransform4f().rotate([1, 0, 0], sky["turn"])
    return found


@pytest.fixture(params=["llvm_ad_rgb", "scalar_rgb"])
def registered(request):
    mi.set_variant(request.param)
    from atmo_jit.plugins import register

    register()


@pytest.mark.parametrize("name", SKIES)
def test_settings_are_the_emitters(registered, name):
    needs = mi.load_dict(description(SKIES[name], "atmosphere_needs"))
    emitter = mi.load_dict(description(SKIES[name]))
    parameters = mi.traverse(emitter)
    assert needs.found.altitude_m == pytest.approx(float(np.ravel(parameters["altitude"])[0]))
    sun = np.ravel(np.array(parameters["sun_direction"], dtype=np.float64))
    assert np.allclose(needs.sun / np.linalg.norm(needs.sun), sun / np.linalg.norm(sun), atol=1e-6)
    assert math.radians(needs.sun_zenith_deg) == pytest.approx(emitter._light.view.sun_zenith, abs=1e-6)
    assert needs.found.atmosphere == emitter._atmosphere


def test_wrong_parameters_are_refused_as_by_the_emitter(registered):
    with pytest.raises(Exception, match="turbidity"):
        mi.load_dict({"type": "atmosphere_needs", "turbidity": 3.0, "sun_direction": [0, 0, 1]})


def scene_with(sensor, shapes=None, camera=None):
    from atmo_jit.plugins.needs import needs_of_scene

    film = {"type": "hdrfilm", "width": 32, "height": 16}
    found = {
        "type": "scene",
        "integrator": {"type": "path"},
        "sky": {"type": "atmosphere", "sun_direction": [0.0, 1.0, 0.5]},
        "camera": {"type": sensor, "film": film, **(camera or {})},
        **(shapes or {}),
    }

    def load(edit):
        config = mi.parser.ParserConfig(mi.variant())
        state = mi.parser.parse_dict(config, found)
        edit(state)
        mi.parser.transform_all(config, state)
        return mi.parser.instantiate(config, state)

    return needs_of_scene(load)


@pytest.mark.parametrize("sensor", ["latlong", "fisheye"])
def test_pictures_of_the_whole_sky_see_the_sun(registered, sensor):
    found = scene_with(sensor)
    assert found.sees_sky and found.sees_sun and found.pixels == 32 * 16


def test_a_fisheye_that_looks_down_does_not_see_the_sun(registered):
    down = {"to_world": mi.ScalarTransform4f().look_at(origin=[0, 0, 5], target=[0, 0, 0], up=[0, 1, 0])}
    found = scene_with("fisheye", camera=down)
    assert found.sees_sky and not found.sees_sun


def test_a_camera_in_a_box_sees_no_sky(registered):
    found = scene_with("latlong", {"box": {"type": "sphere", "radius": 10.0, "flip_normals": True}})
    assert not found.sees_sky and not found.sees_sun


def test_scenes_without_the_emitter_are_refused(registered):
    from atmo_jit.plugins.needs import edit

    config = mi.parser.ParserConfig(mi.variant())
    with pytest.raises(InputError, match="has 0 emitters of type atmosphere"):
        edit(mi.parser.parse_dict(config, {"type": "scene"}))
