"""Pictures as data: every camera looks where Mitsuba's does, and a rendered sky gives its aerosol back."""

from __future__ import annotations

import numpy as np
import pytest

import atmo_jit
from atmo_jit.fits import FitConfig, fit, result
from atmo_jit.fits.camera import angles_deg, of_scene, perspective, rotation
from atmo_jit.fits.pictures import directions, picture

mi = pytest.importorskip("mitsuba")

TRUTH = {"mie.scattering_per_m": 2e-5, "mie.phase.g": 0.7}
FREE = {
    "mie.scattering_per_m": {"mode": "scale", "start": 1e-5, "min": 1e-8, "max": 1e-2},
    "mie.phase.g": {"start": 0.6, "min": -0.5, "max": 0.97},
}
LOOK_AT = {"origin": [0.0, 0.0, 2.0], "target": [-1.0, 0.6, 2.7], "up": [0.0, 0.0, 1.0]}
SCENE = """<scene version="3.9.0">
    <integrator type="path"/>
    <sensor type="perspective"><float name="fov" value="70"/>
        <transform name="to_world"><lookat origin="0, 0, 2" target="-1, 0.6, 2.7" up="0, 0, 1"/></transform>
        <film type="hdrfilm"><rfilter type="box"/></film>
    </sensor>
    <emitter type="atmosphere"><vector name="sun_direction" value="-0.6, 0.5, 0.5"/>
        <float name="altitude" value="30"/></emitter>
    <shape type="sphere"><point name="center" x="-3" y="1.8" z="4.1"/><float name="radius" value="0.5"/></shape>
</scene>"""


def radiance(settings, height, width, azimuth_of_sun=0.0):
    """Radiance [height, width, wavelengths] of the sky with TRUTH, at the pixels' centres."""
    zenith, azimuth, _ = directions(settings, height, width)
    views = {"altitude_m": settings.get("altitude_m", 0.0), "sun_zenith_deg": 55.0}
    views |= {"view_zenith_deg": zenith.ravel(), "azimuth_deg": azimuth.ravel() - azimuth_of_sun}
    air = atmo_jit.Atmosphere.load("earth").replace(TRUTH)
    return atmo_jit.sky(air, views).radiance.reshape(height, width, -1)


def config(**more):
    return FitConfig.of({"atmosphere": "earth", "free": FREE, **more})


def test_a_latlong_picture_gives_back_the_aerosol():
    settings = {"projection": "latlong", "sun_zenith_deg": 55.0, "sun_azimuth_deg": 30.0, "colour": "wavelengths"}
    pixels = radiance({"projection": "latlong", "up_deg": 0.0}, 12, 24, azimuth_of_sun=30.0)
    data = picture(pixels, settings, config())
    assert data.view_zenith.max() < np.radians(88.1) and len(data.radiance) == 6 * 24
    report = result(fit(data, config(robust=False)))
    for name, value in TRUTH.items():
        assert report["parameters"][name]["value"] == pytest.approx(value, rel=0.002)


def test_a_perspective_looks_where_mitsubas_does():
    mi.set_variant("llvm_ad_rgb")
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "fov": 70.0,
            "to_world": mi.ScalarTransform4f().look_at(**LOOK_AT),
            "film": {"type": "hdrfilm", "width": 10, "height": 6},
        }
    )
    v, u = np.meshgrid((np.arange(6) + 0.5) / 6, (np.arange(10) + 0.5) / 10, indexing="ij")
    place = mi.Point2f(u.ravel().astype(np.float32), v.ravel().astype(np.float32))
    rays, _ = sensor.sample_ray(0.0, 0.5, place, mi.Point2f(0.5))
    assert perspective(rotation(LOOK_AT), 70.0, 6, 10).reshape(-1, 3) == pytest.approx(np.array(rays.d).T, abs=1e-5)


def test_the_camera_of_a_scene_brings_its_sun_and_leaves_out_shapes(tmp_path):
    mi.set_variant("llvm_ad_rgb")
    (tmp_path / "sky.xml").write_text(SCENE, encoding="utf-8")
    camera = of_scene(tmp_path / "sky.xml", 24, 36)
    assert camera.direction == pytest.approx(perspective(rotation(LOOK_AT), 70.0, 24, 36), abs=1e-5)
    toward = np.array([-3.0, 1.8, 2.1]) / np.linalg.norm([-3.0, 1.8, 2.1])
    hidden = camera.direction @ toward > np.cos(np.arcsin(0.5 / np.linalg.norm([-3.0, 1.8, 2.1])))
    assert hidden.any() and not camera.free[hidden].any() and camera.free.mean() > 0.8
    assert camera.altitude_m == 30.0
    assert angles_deg(camera.sun)[0] == pytest.approx(np.degrees(np.arccos(0.5 / np.sqrt(0.86))), abs=1e-4)
    # South is +X: what looks along -X and a little to +Y, which is west, looks a little west of north.
    assert -45.0 < angles_deg(camera.direction[12, 18])[1] < 0.0


def test_a_rendered_perspective_gives_back_the_aerosol(tmp_path):
    mi.set_variant("llvm_ad_rgb")
    from atmo_jit.plugins import register
    from atmo_jit.scenes.reader import load_scene

    register()
    aerosol = "".join(
        f'<float name="{name}" value="{value}"/>' for name, value in zip(("mie.scattering_per_m", "mie.phase.g"),
                                                                         TRUTH.values(), strict=True)
    )
    (tmp_path / "sky.xml").write_text(SCENE, encoding="utf-8")
    hazy = tmp_path / "hazy.xml"
    hazy.write_text(SCENE.replace('name="altitude" value="30"/>', f'name="altitude" value="30"/>{aerosol}'))
    pixels = np.array(mi.render(load_scene(hazy, width=36, height=24), spp=16))[..., :3]
    data = picture(pixels, {"projection": "scene", "scene": "sky.xml"}, config(), folder=tmp_path)
    report = result(fit(data, config()))
    for name, value in TRUTH.items():
        assert report["parameters"][name]["value"] == pytest.approx(value, rel=0.02)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"projection": "perspective"}, "look_at"),
        ({"projection": "perspective", "look_at": {**LOOK_AT, "up": [-1.0, 0.6, 0.7]}}, "along up"),
        ({"projection": "perspective", "look_at": {**LOOK_AT, "target": [1.0]}}, "look_at.target"),
        ({"projection": "perspective", "look_at": LOOK_AT, "fov_deg": 180}, "between 0 and 180"),
        ({"projection": "scene"}, "must be the name of a scene file"),
        ({"projection": "scene", "scene": "absent.xml"}, "no such file"),
        ({"projection": "cylinder"}, "fisheye, latlong, perspective, scene"),
        ({"sun_zenith_deg": None}, "sun_zenith_deg"),
    ],
)
def test_a_picture_that_is_not_described_is_refused(change, text):
    settings = {"sun_zenith_deg": 50.0, "fov_deg": 60.0, **change}
    with pytest.raises(atmo_jit.InputError, match=text):
        picture(np.ones((4, 6, 3)), settings, config())
