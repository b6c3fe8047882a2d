"""``atmo-jit render``: what it writes, how it fails, and that it leaves nothing half-written."""

from __future__ import annotations

import os
import pty
import subprocess
import sys

import numpy as np
import OpenEXR
import pytest

from atmo_jit import scenes
from atmo_jit.cli import main
from atmo_jit.commands import render
from atmo_jit.passes import Passes

mi = pytest.importorskip("mitsuba")

SCENE = """<scene version="3.9.0">
    <default name="light" value="1, 2, 3"/>
    <default name="spp" value="8"/>
    <default name="format" value="rgb"/>
    <integrator type="path"><integer name="max_depth" value="3"/></integrator>
    <sensor type="perspective">
        <transform name="to_world"><lookat origin="0, -5, 1" target="0, 0, 0.5" up="0, 0, 1"/></transform>
        <film type="hdrfilm">
            <integer name="width" value="16"/><integer name="height" value="8"/>
            <string name="pixel_format" value="$format"/>
        </film>
        <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
    </sensor>
    <emitter type="constant"><rgb name="radiance" value="$light"/></emitter>
    <shape type="sphere"><bsdf type="diffuse"/></shape>
</scene>
"""


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text(SCENE)
    return path


@pytest.fixture
def run(capsys):
    def run(*arguments):
        status = main([str(argument) for argument in ("render", *arguments)])
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return run


def read_exr(path):
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {name: channel.pixels.copy() for name, channel in file.channels().items()}, dict(file.header())


def read_png(path):
    return np.array(mi.Bitmap(str(path)))


def test_writes_exr_and_png(run, scene, tmp_path):
    out = tmp_path / "x.exr"
    status, text, err = run(scene, "--out", out, "-D", "light=0.5, 1, 0.25")
    assert (status, err) == (0, "")
    assert text.startswith(f"{out} and x.png: 16x8, 8 samples per pixel, ")
    channels, header = read_exr(out)
    assert sorted(channels) == ["B", "G", "R"]
    assert all(plane.dtype == np.float32 and plane.shape == (8, 16) for plane in channels.values())
    assert [channels[name][0, 0] for name in "RGB"] == pytest.approx([0.5, 1, 0.25])
    assert header["scene"] == "scene.xml" and header["parameters"] == "light=0.5, 1, 0.25"
    assert header["samplesPerPixel"] == 8 and header["variant"] == "llvm_ad_rgb" and header["renderSeconds"] > 0
    assert header["software"].startswith("atmo-jit ")
    assert read_png(tmp_path / "x.png").shape == (8, 16, 3)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["scene.xml", "x.exr", "x.png"]


def test_quiet_and_sizes_and_samples(run, scene, tmp_path):
    assert run(scene, "--out", tmp_path / "x.exr", "--quiet", "--width", 8, "--spp", 3) == (0, "", "")
    channels, header = read_exr(tmp_path / "x.exr")
    assert channels["R"].shape == (4, 8) and header["samplesPerPixel"] == 3
    assert run(scene, "--out", tmp_path / "x.exr", "--quiet", "--width", 5, "--height", 7)[0] == 0
    assert read_exr(tmp_path / "x.exr")[0]["R"].shape == (7, 5)


def test_exposure_in_stops(run, scene, tmp_path):
    levels = []
    for stops in (-3, 0, 3):
        assert run(scene, "--out", tmp_path / "x.exr", "--spp", 4, "--exposure", stops)[0] == 0
        levels.append(read_png(tmp_path / "x.png").mean())
    assert levels[0] < 0.6 * levels[1] < levels[1] < levels[2]


@pytest.mark.parametrize(("pixel_format", "names"), [("luminance", "Y"), ("rgba", "ABGR"), ("luminance_alpha", "AY")])
def test_pixel_formats(run, scene, tmp_path, pixel_format, names):
    assert run(scene, "--out", tmp_path / "x.exr", "-D", f"format={pixel_format}", "-D", "light=1, 1, 1")[0] == 0
    channels, _ = read_exr(tmp_path / "x.exr")
    assert sorted(channels) == list(names)
    assert channels[names[-1]][0, 0] == pytest.approx(1)
    assert np.ptp(read_png(tmp_path / "x.png")[0, 0]) <= 1


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_mono", "llvm_ad_spectral"])
def test_variants(run, scene, tmp_path, variant):
    status, _, err = run(scene, "--out", tmp_path / "x.exr", "--variant", variant, "--spp", 8, "--quiet")
    assert status == 0
    channels, header = read_exr(tmp_path / "x.exr")
    assert header["variant"] == variant and all(np.isfinite(plane).all() for plane in channels.values())
    assert sorted(channels) == (["Y"] if "mono" in variant else ["B", "G", "R"])
    if "mono" in variant:  # Mitsuba warns, and the command passes it on as one line
        assert err.startswith("atmo-jit: warning: [HDRFilm] Monochrome mode enabled") and err.count("\n") == 1
    else:
        assert err == ""


def test_extra_channels_of_the_integrator_are_kept(run, scene, tmp_path):
    path = "<integrator type='path'/>"
    aov = f"<integrator type='aov'><string name='aovs' value='dd:depth,nn:sh_normal'/>{path}</integrator>"
    scene.write_text(SCENE.replace('<integrator type="path"><integer name="max_depth" value="3"/></integrator>', aov))
    assert run(scene, "--out", tmp_path / "x.exr")[0] == 0
    channels, _ = read_exr(tmp_path / "x.exr")
    assert {"R", "G", "B"} < set(channels)
    depth = next(plane for name, plane in channels.items() if name.startswith("dd"))
    assert 3.5 < depth[4, 8] < 5
    assert read_png(tmp_path / "x.png").shape == (8, 16, 3)


def test_invalid_pixels_are_reported_and_painted(run, scene, tmp_path, monkeypatch):
    developed = Passes.picture

    def spoiled(passes):
        picture = developed(passes)
        picture.pixels[2, 3, 1], picture.pixels[2, 4, 0] = np.nan, np.inf
        return picture

    monkeypatch.setattr(Passes, "picture", spoiled)
    status, _, err = run(scene, "--out", tmp_path / "x.exr", "--quiet")
    assert status == 0
    assert err == "atmo-jit: warning: 2 of 128 pixels are NaN or infinite: kept in x.exr, magenta in x.png\n"
    assert np.array_equal(read_png(tmp_path / "x.png")[2, 3:5], [[255, 0, 255]] * 2)
    assert np.isnan(read_exr(tmp_path / "x.exr")[0]["G"][2, 3])


@pytest.mark.parametrize("name", scenes.shipped())
def test_every_shipped_scene_renders(run, tmp_path, name):
    status, _, err = run(name, "--out", tmp_path / "x.exr", "--width", 48, "--spp", 16, "--quiet")
    assert (status, err) == (0, "")
    rgb = np.stack([read_exr(tmp_path / "x.exr")[0][channel] for channel in "RGB"], axis=-1)
    assert rgb.shape == (27, 48, 3) and np.isfinite(rgb).all()
    assert rgb.mean() > 0 and np.quantile(rgb, 0.01) >= 0
    shown = read_png(tmp_path / "x.png")
    assert 60 < shown.mean() < 200 and shown.std() > 20


def test_what_the_emitter_says_is_one_line(run, tmp_path):
    for name in ("noon", "ball"):
        status, _, err = run(name, "--out", tmp_path / "x.exr", "-D", "atmosphere=venus")
        assert status == 2 and err.count("\n") == 1
        assert "atmosphere: found 'venus'" in err and "Traceback" not in err and str(scenes.find(name)) in err


MISTAKES = {
    "no scene": (["--out", "OUT"], "SCENE is missing; give a file or one of the shipped scenes: "),
    "no output": (["SCENE"], "--out is missing; give the .exr file to write"),
    "unknown scene": (
        ["nowhere", "--out", "OUT"],
        "scene 'nowhere': neither an .xml or .json file nor a shipped scene",
    ),
    "missing file": (["nowhere.xml", "--out", "OUT"], "scene 'nowhere.xml': no such file"),
    "suffix": (["SCENE", "--out", "x.png"], "output 'x.png': the name must end in .exr"),
    "no folder": (["SCENE", "--out", "/nowhere/x.exr"], "output '/nowhere/x.exr': there is no folder"),
    "a folder": (["SCENE", "--out", "FOLDER.exr"], "is not a file"),
    "variant": (
        ["SCENE", "--out", "OUT", "--variant", "llvm_rgb"],
        "--variant is 'llvm_rgb'; this Mitsuba has scalar_rgb, ",
    ),
    "definition": (["SCENE", "--out", "OUT", "-D", "light"], "-D light: must be NAME=VALUE"),
    "parameter": (
        ["SCENE", "--out", "OUT", "-D", "dark=1"],
        "has no parameter 'dark'; parameters are: format, light, spp",
    ),
    "spp": (["SCENE", "--out", "OUT", "--spp", "0"], "Invalid value for '--spp': 0 is not in the range x>=1."),
    "width": (["SCENE", "--out", "OUT", "--width", "-5"], "Invalid value for '--width'"),
    "exposure": (["SCENE", "--out", "OUT", "--exposure", "nan"], "--exposure is nan; must be a number of stops"),
    "option": (["SCENE", "--out", "OUT", "--fast"], "No such option"),
}


@pytest.mark.parametrize(("arguments", "message"), MISTAKES.values(), ids=MISTAKES.keys())
def test_mistakes(run, scene, tmp_path, arguments, message):
    out = tmp_path / "x.exr"
    out.write_text("precious")
    (tmp_path / "FOLDER.exr").mkdir()
    names = {"SCENE": scene, "OUT": out, "FOLDER.exr": tmp_path / "FOLDER.exr"}
    status, text, err = run(*(names.get(argument, argument) for argument in arguments))
    assert (status, text) == (2, "")
    assert message in err and err.startswith("atmo-jit: ") and err.count("\n") == 1
    assert out.read_text() == "precious" and not (tmp_path / "x.png").exists()


def test_what_mitsuba_says_is_one_line(run, scene, tmp_path):
    scene.write_text(SCENE.replace('"sphere"', '"spher"'))
    status, _, err = run(scene, "--out", tmp_path / "x.exr")
    assert status == 2 and err.count("\n") == 1
    assert err.startswith(f"atmo-jit: {scene}: ") and 'Plugin "spher" not found!' in err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["scene.xml"]


@pytest.mark.parametrize("error", [KeyboardInterrupt(), RuntimeError("out of memory")])
def test_an_interrupted_run_leaves_everything_as_it_was(run, scene, tmp_path, monkeypatch, error):
    out = tmp_path / "x.exr"
    out.write_text("precious")

    def fail(*args):
        raise error

    monkeypatch.setattr(render, "write_png", fail)
    status, _, err = run(scene, "--out", out)
    assert status not in (0, 2) and err.strip().count("\n") == 0
    assert out.read_text() == "precious"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["scene.xml", "x.exr"]


def test_list_names_every_shipped_scene_without_mitsuba(tmp_path):
    code = "import sys; from atmo_jit.cli import main; sys.exit(main(['render', '--list']) or 'mitsuba' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert [line.split()[0] for line in done.stdout.splitlines()] == list(scenes.shipped())
    assert all(line.rstrip().endswith(".") for line in done.stdout.splitlines())


def test_progress_on_a_terminal_only(scene, tmp_path):
    command = [sys.executable, "-m", "atmo_jit", "render", str(scene), "--out", str(tmp_path / "x.exr")]
    assert "rendering scene" in on_a_terminal(command)
    assert "rendering scene" not in on_a_terminal([*command, "--quiet"])
    piped = subprocess.run(command, capture_output=True, text=True)
    assert (piped.returncode, piped.stderr) == (0, "")


def on_a_terminal(command):
    """What a command writes to stderr when that is a terminal."""
    try:
        terminal, end = pty.openpty()
    except OSError as error:  # a container without /dev/pts
        pytest.skip(f"no terminal to be had: {error}")
    process = subprocess.Popen(command, stderr=end, stdout=subprocess.DEVNULL, env={**os.environ, "TERM": "xterm"})
    os.close(end)
    text = b""
    while True:
        try:
            part = os.read(terminal, 4096)
        except OSError:  # the other end is closed
            break
        if not part:
            break
        text += part
    os.close(terminal)
    assert process.wait() == 0
    return text.decode()
