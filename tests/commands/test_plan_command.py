"""``atmo-jit plan``: for views and for scenes, as text and as JSON, checked; every wrong input refused in one line."""

from __future__ import annotations

import json

import numpy as np
import pytest

from atmo_jit.cli import main
from atmo_jit.scenes import shipped

VIEWS = {
    "altitude_m": [0.0, 1000.0, 2.0],
    "sun_zenith_deg": [30.0, 85.0, 60.0],
    "view_zenith_deg": [45.0, 89.0, 120.0],
    "azimuth_deg": [0.0, 90.0, 10.0],
}


@pytest.fixture
def views(tmp_path):
    np.savez(tmp_path / "views.npz", **VIEWS)
    return tmp_path / "views.npz"


@pytest.fixture
def run(capsys):
    def run(*arguments):
        status = main([str(argument) for argument in ("plan", *arguments)])
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return run


def found(run, *arguments):
    status, text, err = run(*arguments, "--json")
    assert (status, err) == (0, ""), err
    return json.loads(text)


def items(result):
    return {item["name"]: item for item in result["items"]}


def test_says_what_is_built_and_what_is_not(run, views):
    status, text, err = run("--atmosphere", "earth", "--views", views, "--free", "mie.phase.g, ground_albedo")
    assert (status, err) == (0, "")
    lines = text.splitlines()
    assert any(line.startswith("moments of order 1") for line in lines)
    assert any(line.startswith("sun's disc") and "skipped" in line for line in lines)
    assert any(line.startswith("derivatives") and "by mie.phase.g, ground_albedo" in line for line in lines)
    assert lines[-1].startswith("predicted") and "MiB" in lines[-1] and "error" in lines[-1]


def test_json_says_the_same(run, views):
    options = ("--atmosphere", "earth", "--views", views, "--orders", 1, "--no-ground", "--tolerance", 0.03)
    result = found(run, *options)
    assert result["tolerance"] == 0.03 and result["orders"] == 1 and result["method"] == "march"
    assert not items(result)["multiple scattering"]["built"] and not items(result)["ground's own radiance"]["built"]
    assert result["predicted"]["solve_cpu_s"] > 0 and "check" not in result


def test_check_runs_it(run, views):
    result = found(run, "--atmosphere", "earth", "--views", views, "--tolerance", 0.1, "--check")["check"]
    assert result["solve_cpu_s"] > 0 and result["views_cpu_s"] > 0 and result["mib"] >= 0
    assert 0 < result["error_percent"] < 5
    assert all("off by more than 2x" in note for note in result["notes"])
    _, text, _ = run("--atmosphere", "earth", "--views", views, "--tolerance", 0.1, "--check")
    assert any(line.startswith("found ") for line in text.splitlines())


def test_a_wrong_prediction_is_said(run, views, monkeypatch):
    from atmo_jit import costs

    monkeypatch.setattr(costs, "machine_factor", lambda: 1e4)
    notes = found(run, "--atmosphere", "earth", "--views", views, "--tolerance", 0.1, "--check")["check"]["notes"]
    assert any(note.startswith("solve: predicted") for note in notes)


def test_an_error_that_is_larger_than_predicted_is_said(run, views, monkeypatch):
    from atmo_jit import costs

    monkeypatch.setattr(costs, "ERRORS", {0.1: (1e-4, 1e-4)})
    notes = found(run, "--atmosphere", "earth", "--views", views, "--tolerance", 0.1, "--check")["check"]["notes"]
    assert any(note.startswith("error: predicted 0.0001 %") for note in notes)


@pytest.mark.parametrize("name", shipped())
def test_every_shipped_scene(run, name):
    result = found(run, name)
    assert result["method"] == "tables" and result["needs"]["table"]
    assert items(result)["sky-view table"]["built"] and not items(result)["aerial perspective"]["built"]


def test_scene_parameters_count(run):
    up, down = (found(run, "noon", "-D", f"sun={sun}") for sun in ("0.3, 0.2, 0.9", "0.3, 0.2, -0.9"))
    assert items(up)["sun's disc"]["built"] and not items(down)["sun's disc"]["built"]
    assert up["needs"]["suns_deg"][0] == pytest.approx(np.degrees(np.arctan2(np.hypot(0.3, 0.2), 0.9)), abs=1e-3)
    clear = found(run, "noon", "-D", "atmosphere=mars")
    assert not items(clear)["ozone"]["built"]


def test_the_sun_in_the_picture(run, tmp_path):
    xml = """<scene version="3.9.0"><integrator type="path"/>
    <emitter type="atmosphere"><vector name="sun_direction" value="0, 1, 0.5"/></emitter>
    <sensor type="perspective"><float name="fov" value="40"/>
    <transform name="to_world"><lookat origin="0,0,1" target="{target}" up="0,0,1"/></transform>
    <film type="hdrfilm"><integer name="width" value="64"/><integer name="height" value="36"/></film></sensor>
    {shape}</scene>"""
    wall = '<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="90"/><scale value="500"/>' + (
        '<translate y="20"/></transform></shape>'
    )
    reasons = []
    for target, shape in (("0,2,2", ""), ("0,-2,2", ""), ("0,2,2", wall)):
        file = tmp_path / "scene.xml"
        file.write_text(xml.format(target=target, shape=shape))
        reasons.append(items(found(run, file))["sun's disc"]["reason"])
    assert reasons[0] == "in the picture"
    assert reasons[1] == reasons[2] == "not in the picture: only its light on things"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "give either SCENE, or --atmosphere and --views"),
        (("noon", "--atmosphere", "earth"), "give either SCENE"),
        (("--atmosphere", "earth"), "--views is missing"),
        (("--views", "x.npz"), "--atmosphere is missing"),
        (("nowhere",), "neither an .xml or .json file nor a shipped scene"),
        (("noon", "-D", "x"), "-D x: must be NAME=VALUE"),
        (("noon", "--variant", "magic"), "--variant is 'magic'"),
        (("noon", "--free", "mie.size"), "--free mie.size: no value of that name"),
        (("noon", "--tolerance", "2"), "tolerance: is 2.0"),
        (("--atmosphere", "venus", "--views", "VIEWS"), "venus"),
        (("--atmosphere", "earth", "--views", "nowhere.npz"), "nowhere.npz"),
        (("--atmosphere", "earth", "--views", "VIEWS", "-D", "a=b"), "only a scene has parameters"),
    ],
)
def test_wrong_input_is_one_line(run, views, arguments, message):
    status, text, err = run(*(str(views) if word == "VIEWS" else word for word in arguments))
    assert (status, text) == (2, "") and err.count("\n") == 1 and message in err


def test_a_scene_without_the_emitter(run, tmp_path):
    file = tmp_path / "dark.xml"
    file.write_text('<scene version="3.9.0"><integrator type="path"/><sensor type="perspective"/></scene>')
    status, _, err = run(file)
    assert status == 2 and "has 0 emitters of type atmosphere" in err
