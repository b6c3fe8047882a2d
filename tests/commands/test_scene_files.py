"""Scene files: the JSON form gives the scene that the same XML gives, and every mistake in one is one line."""

from __future__ import annotations

import json

import numpy as np
import pytest
from descriptions import changed

from atmo_jit import scenes
from atmo_jit.errors import InputError

mi = pytest.importorskip("mitsuba")

XML = """<!-- A lit ball. And more. -->
<scene version="3.9.0">
    <default name="fov" value="40"/>
    <default name="light" value="1, 2, 3"/>
    <integrator type="path"><integer name="max_depth" value="3"/></integrator>
    <sensor type="perspective">
        <float name="fov" value="$fov"/>
        <transform name="to_world"><lookat origin="0, -5, 1" target="0, 0, 0.5" up="0, 0, 1"/></transform>
        <film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="8"/></film>
        <sampler type="independent"><integer name="sample_count" value="4"/></sampler>
    </sensor>
    <emitter type="constant"><rgb name="radiance" value="$light"/></emitter>
    <shape type="sphere">
        <transform name="to_world">
            <scale x="1" y="2" z="0.5"/><rotate z="1" angle="30"/><translate x="0.2" z="0.5"/>
        </transform>
        <bsdf type="twosided"><bsdf type="diffuse"/></bsdf>
    </shape>
</scene>
"""

DICT = {
    "comment": "A lit ball. And more.",
    "parameters": {"fov": 40, "light": [1, 2, 3], "kind": "diffuse"},
    "type": "scene",
    "integrator": {"type": "path", "max_depth": 3},
    "sensor": {
        "type": "perspective",
        "fov": "$fov",
        "to_world": {"look_at": {"origin": [0, -5, 1], "target": [0, 0, 0.5], "up": [0, 0, 1]}},
        "film": {"type": "hdrfilm", "width": 16, "height": 8},
        "sampler": {"type": "independent", "sample_count": 4},
    },
    "light": {"type": "constant", "radiance": {"type": "rgb", "value": "$light"}},
    "ball": {
        "type": "sphere",
        "to_world": [
            {"scale": [1, 2, 0.5]},
            {"rotate": {"axis": [0, 0, 1], "angle": 30}},
            {"translate": [0.2, 0, 0.5]},
        ],
        "bsdf": {"type": "twosided", "material": {"type": "$kind"}},
    },
}


@pytest.fixture(autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


def load(path, parameters=None, **size):
    from atmo_jit.scenes.reader import load_scene

    return load_scene(path, parameters, **size)


def written(tmp_path, content, name="scene.json"):
    path = tmp_path / name
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def rendered(scene):
    return np.array(scene.integrator().render(scene, scene.sensors()[0], seed=1, spp=4))


def test_json_is_the_same_scene_as_xml(tmp_path):
    xml, dictionary = load(written(tmp_path, XML, "scene.xml")), load(written(tmp_path, DICT))
    assert np.allclose(rendered(xml), rendered(dictionary))
    assert rendered(xml).shape == (8, 16, 3)


@pytest.mark.parametrize(("name", "content"), [("scene.xml", XML), ("scene.json", DICT)])
def test_parameters_and_size(tmp_path, name, content):
    path = written(tmp_path, content, name)
    scene = load(path, {"fov": "20", "light": "0, 1, 0"})
    assert mi.traverse(scene.sensors()[0])["x_fov"][0] == pytest.approx(20)
    assert (rendered(scene)[..., 1] > 0.1).all() and not rendered(scene)[..., [0, 2]].any()
    for size, expected in (({"width": 32}, [32, 16]), ({"height": 2}, [4, 2]), ({"width": 3, "height": 5}, [3, 5])):
        assert list(load(path, **size).sensors()[0].film().size()) == expected
    with pytest.raises(InputError, match=rf"{name}: has no parameter 'fow'; parameters are: fov, light") as error:
        load(path, {"fow": "20"})
    assert "\n" not in str(error.value)


def test_matrix_is_row_major(tmp_path):
    matrix = [[1, 0, 0, 5], [0, 1, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]]
    for transform in (matrix, {"matrix": matrix}, [{"matrix": matrix}]):
        scene = load(written(tmp_path, changed(DICT, ("ball", "to_world"), transform)))
        assert np.allclose(scene.shapes()[0].bbox().center(), [5, 6, 7])


def test_files_are_looked_for_beside_the_scene(tmp_path, monkeypatch):
    mi.load_dict({"type": "cube"}).write_ply(str(tmp_path / "box.ply"))
    monkeypatch.chdir("/")
    assert load(written(tmp_path, changed(DICT, ("ball",), {"type": "ply", "filename": "box.ply"}))).shapes()
    assert load(
        written(
            tmp_path,
            XML.replace("</scene>", '<shape type="ply"><string name="filename" value="box.ply"/></shape></scene>'),
            "s.xml",
        )
    )


MISTAKES = {
    "null": (
        ("ball", "radius"),
        None,
        "ball.radius is None; must be a number, true or false, text, 3 numbers, or an object",
    ),
    "list": (("ball", "center"), [1, 2], "ball.center is [1, 2]; must be 3 numbers"),
    "no type": (("ball", "bsdf"), {}, "ball.bsdf.type is None; must be the name of a plugin"),
    "wrong type": (("ball", "bsdf", "type"), 5, "ball.bsdf.type is 5; must be the name of a plugin"),
    "huge": (
        ("sensor", "film", "width"),
        10**30,
        "sensor.film.width is 1000000000000000000000000000000; must be an integer",
    ),
    "transform": (("ball", "to_world"), {"scale": 1, "translate": [0, 0, 0]}, "ball.to_world is {'scale': 1,"),
    "operation": (("ball", "to_world"), [{"shear": 1}], "ball.to_world.shear is 1; must be one of translate, scale,"),
    "rotate": (
        ("ball", "to_world"),
        {"rotate": {"axis": [0, 0, 1]}},
        "ball.to_world.rotate is {'axis': [0, 0, 1]}; must be an",
    ),
    "angle": (
        ("ball", "to_world"),
        {"rotate": {"axis": [0, 0, 1], "angle": "x"}},
        "ball.to_world.rotate.angle is 'x'; must",
    ),
    "parameter": (
        ("ball", "radius"),
        "$radius",
        "ball.radius: unknown parameter $radius; parameters are: fov, light, kind",
    ),
    "parameters": (("parameters",), 3, "parameters is 3; must be an object"),
    "plugin": (("ball", "type"), "bal", 'Plugin "bal" not found'),
    "property": (("ball", "bsdf", "foo"), 1.5, 'Found 1 unreferenced property in bsdf plugin of type "twosided":'),
    "no sensor": (("sensor",), ..., "the scene has no sensor"),
    "dotted object": (("ball", "a.b"), {"type": "diffuse"}, "ball.a.b is {'type': 'diffuse'}; must be a number,"),
    "dotted value": (("ball", "a.b"), 2.5, '"a.b"'),
}


@pytest.mark.parametrize(("place", "value", "message"), MISTAKES.values(), ids=MISTAKES.keys())
def test_mistakes_in_json(tmp_path, place, value, message):
    with pytest.raises(InputError) as error:
        load(written(tmp_path, changed(DICT, place, value)))
    assert message in str(error.value)
    assert str(error.value).startswith(f"{tmp_path / 'scene.json'}: ")
    assert "\n" not in str(error.value)


BROKEN = {
    "truncated": ('{"type": "scene"', "is not JSON: Expecting ',' delimiter: line 1 column 17"),
    "NaN": ('{"a": NaN}', "is not JSON: NaN is not a number that a scene can hold"),
    "overflow": ('{"a": 1e999}', "a is inf; must be finite"),
    "twice": ('{"a": 1, "a": 2}', "is not JSON: the key 'a' appears twice in one object"),
    "large": (" " * 2**24 + "{}", "is larger than 16777216 bytes"),
    "many keys": ("{" + ",".join(f'"k{i}": 1' for i in range(200_000)) + ',"k0": 1}', "the key 'k0' appears twice"),
    "list": ("[1]", "is not a JSON object"),
    "deep": ('{"a":' * 100_000 + "1" + "}" * 100_000, "nested too deeply"),
    "deep but valid": ('{"type":"scene","a":' * 900 + "1" + "}" * 900, ""),
    "empty": ("", "is not JSON: Expecting value"),
}


@pytest.mark.parametrize(("text", "message"), BROKEN.values(), ids=BROKEN.keys())
def test_broken_json(tmp_path, text, message):
    with pytest.raises(InputError) as error:
        load(written(tmp_path, text))
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_parameter_text_is_read_as_its_default(tmp_path):
    path = written(tmp_path, changed(DICT, ("parameters",), {"n": 1, "x": 1.5, "yes": True, "v": [1, 2, 3], "s": "a"}))
    for name, text, allowed in (("n", "x", "a number"), ("x", "1 2", "a number"), ("yes", "1", "true or false")):
        with pytest.raises(InputError, match=f"parameter {name} is '{text}'; must be {allowed}"):
            load(path, {name: text})
    with pytest.raises(InputError, match="parameter v is 'a b'; must be numbers"):
        load(path, {"v": "a b"})


MISTAKES_XML = {
    "syntax": (("</scene>", ""), "failed: Start-end tags mismatch"),
    "plugin": (('"sphere"', '"spher"'), 'Plugin "spher" not found!'),
    "parameter": (("$fov", "$fof"), "undefined parameter: $fof"),
    "property": (('name="fov" value="$', 'name="fow" value="$'), '- float "fow": 40'),
    "value": (('name="fov" value="40"', 'name="fov" value="wide"'), 'could not parse floating point value "wide"'),
    "no integrator": (("integrator", "bsdf"), ""),
    "not a scene": ((XML, '<bsdf version="3.0.0" type="diffuse"/>'), "holds BSDF, must be a scene"),
}


@pytest.mark.parametrize(("change", "message"), MISTAKES_XML.values(), ids=MISTAKES_XML.keys())
def test_mistakes_in_xml(tmp_path, change, message):
    with pytest.raises(InputError) as error:
        load(written(tmp_path, XML.replace(*change), "scene.xml"))
    assert message in str(error.value)
    assert str(error.value).startswith(f"{tmp_path / 'scene.xml'}: ")
    assert "\n" not in str(error.value)


def test_what_a_plugin_says_is_shown_without_its_traceback():
    from atmo_jit.scenes.reader import what_mitsuba_says

    trace = 'Traceback (most recent call last):\n  File "b.py", line 5, in __init__\nValueError: g is 2'
    assert what_mitsuba_says(f"[parser.cpp:1718] At line 8: failed: {trace}") == "At line 8: failed: g is 2"


def test_finding_scenes(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert scenes.find("noon") == scenes.shipped()["noon"]
    path = written(tmp_path, XML, "noon.xml")
    assert scenes.find("noon.xml") == path.relative_to(tmp_path)
    with pytest.raises(InputError, match="scene 'none.xml': no such file; shipped scenes: .*noon"):
        scenes.find("none.xml")
    with pytest.raises(InputError, match="scene 'none': neither an .xml or .json file nor a shipped scene"):
        scenes.find("none")


def test_every_shipped_scene_states_its_purpose_and_command(tmp_path):
    assert {"noon", "sunset", "object", "twilight"} <= set(scenes.shipped())
    for name, path in scenes.shipped().items():
        assert 20 < len(scenes.purpose(path)) < 120
        assert f"atmo-jit render {name} --out {name}.exr" in path.read_text()
    assert scenes.purpose(written(tmp_path, XML, "x.xml")) == scenes.purpose(written(tmp_path, DICT)) == "A lit ball."
    assert scenes.purpose(written(tmp_path, "{}")) == ""
