"""``atmo-jit render --reference``: the path-traced air in place of the emitter."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time

import numpy as np
import OpenEXR
import pytest

from atmo_jit import presets
from atmo_jit.cli import main
from atmo_jit.passes import Passes
from atmo_jit.plugins import register
from atmo_jit.scenes.reader import contents, load_scene

mi = pytest.importorskip("mitsuba")

SMALL = ("--width", "32", "--height", "18")
SAMPLES = 1 << 18  # per pixel: minutes of work


def read(path):
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return np.stack([file.channels()[c].pixels for c in "RGB"], axis=-1), dict(file.header())


def run(*arguments):
    return main([str(argument) for argument in ("render", *arguments)])


def test_same_picture_as_the_emitter(tmp_path):
    """Noon in a few large blocks, in units of the standard error plus 1 %: the air between camera and things is in
    one only.
    """
    paths = {name: tmp_path / f"{name}.exr" for name in ("paths", "tables")}
    assert run("noon", *SMALL, "--out", paths["paths"], "--spp", "1024", "--reference", "--standard-error") == 0
    assert run("noon", *SMALL, "--out", paths["tables"], "--spp", "1024") == 0
    (traced, header), (tables, _) = read(paths["paths"]), read(paths["tables"])
    error, _ = read(tmp_path / "paths.error.exr")
    assert header["reference"] == "true" and int(header["samplesPerPixel"]) == 1024
    assert np.all(error > 0.0)

    def blocks(picture):
        return picture.reshape(3, 6, 4, 8, 3).mean(axis=(1, 3))

    sigma = np.sqrt(blocks(error**2) / 48) * np.sqrt(2.0)
    assert np.all(np.abs(blocks(traced) - blocks(tables)) < 4.0 * sigma + 0.01 * blocks(tables))


def test_scene_without_the_emitter_is_refused(tmp_path, capsys):
    scene = tmp_path / "plain.xml"
    scene.write_text('<scene version="3.9.0"><integrator type="path"/><sensor type="perspective"/></scene>')
    assert run(scene, "--out", tmp_path / "x.exr", "--reference") == 2
    assert "emitters of type atmosphere" in capsys.readouterr().err
    assert not (tmp_path / "x.exr").exists()


def test_unequal_scales_are_refused(tmp_path, capsys):
    scene = tmp_path / "scales.xml"
    scene.write_text(
        '<scene version="3.9.0"><integrator type="path"/><sensor type="perspective"/><emitter type="atmosphere">'
        '<vector name="sun_direction" value="0, 0, 1"/><float name="sky_scale" value="2"/></emitter></scene>'
    )
    assert run(scene, "--out", tmp_path / "x.exr", "--reference") == 2
    assert "sun_scale" in capsys.readouterr().err


def interrupted(monkeypatch, out, *more):
    """A render that is asked to stop within its third pass."""
    ran = Passes._pass

    def stopped(passes, seed, count):
        if seed == 2:
            signal.raise_signal(signal.SIGTERM)
        return ran(passes, seed, count)

    with monkeypatch.context() as patched:
        patched.setattr(Passes, "_pass", stopped)
        return run("sunset", *SMALL, "--out", out, "--spp", "32", "--reference", *more)


def test_an_interrupted_render_goes_on(tmp_path, monkeypatch, capsys):
    """To the picture of an uninterrupted one."""
    out, kept = tmp_path / "x.exr", tmp_path / "x.partial.npz"
    assert interrupted(monkeypatch, out, "--standard-error") == 130
    assert "x.exr holds 12 of 32 samples per pixel; --resume adds the others" in capsys.readouterr().err
    names = ["x.error.exr", "x.exr", "x.partial.npz", "x.png"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names and read(out)[1]["samplesPerPixel"] == 12
    arguments = ("sunset", *SMALL, "--spp", "32", "--reference", "--quiet", "--standard-error")
    assert run(*arguments, "--out", out, "--resume") == 0
    assert not kept.exists() and read(out)[1]["samplesPerPixel"] == 32
    (tmp_path / "other").mkdir()
    assert run(*arguments, "--out", tmp_path / "other" / "x.exr", "--resume") == 0  # nothing to go on from
    assert np.allclose(read(out)[0], read(tmp_path / "other" / "x.exr")[0], rtol=1e-5)


def test_only_what_was_begun_goes_on(tmp_path, monkeypatch, capsys):
    out, kept = tmp_path / "x.exr", tmp_path / "x.partial.npz"
    assert interrupted(monkeypatch, out) == 130
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    same = ("sunset", *SMALL, "--out", out, "--spp", "32", "--reference", "--resume", "--quiet")
    capsys.readouterr()
    for change, name in {
        ("--spp", "64"): "--spp is 64, and was 32",
        ("--width", "31"): "the scene (",
        ("-D", "sun=0, 1, 0.03"): "the scene (",
        ("--variant", "llvm_ad_spectral"): "--variant is 'llvm_ad_spectral'",
        ("--standard-error",): "--standard-error is True, and was False",
    }.items():
        assert run(*same, *change) == 2
        error = capsys.readouterr().err
        assert name in error and error.count("\n") == 1
        assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
    kept.write_bytes(b"something else")
    for more in ([], ["--resume"]):
        assert run("sunset", *SMALL, "--out", out, "--spp", "32", "--reference", *more) == 2
        assert "x.partial.npz': is not what an interrupted run keeps" in capsys.readouterr().err
        assert kept.read_bytes() == b"something else"
    kept.write_bytes(before[kept])
    assert run("sunset", *SMALL, "--out", out, "--spp", "4", "--reference", "--quiet") == 0
    assert "rendering anew" in capsys.readouterr().err and not kept.exists()
    assert run("sunset", *SMALL, "--out", out, "--spp", "4", "--resume") == 2
    assert "--resume: goes with --reference" in capsys.readouterr().err


def test_files_of_the_scene_count(tmp_path):
    """What tells a scene from others sees into the files that it names, and into the last digit."""
    mi.set_variant("llvm_ad_rgb")
    air = tmp_path / "air.json"
    scene = tmp_path / "s.xml"
    found = []
    for height, sun in ((8000.0, "1, 0, 1"), (8000.5, "1, 0, 1"), (8000.0, "1, 0, 1.00000001"), (8000.0, "1, 0, 1")):
        air.write_text(json.dumps(presets.read("earth") | {"rayleigh": {"scattering_per_m": 1e-5,
                                                                        "scale_height_m": height}}))  # fmt: skip
        scene.write_text(
            '<scene version="3.9.0"><integrator type="path"/><sensor type="perspective"/><emitter type="atmosphere">'
            f'<vector name="sun_direction" value="{sun}"/><string name="atmosphere" value="air.json"/>'
            "</emitter></scene>"
        )
        register()
        load_scene(scene, edit=lambda state: found.append(contents(state)))
    assert found[0] == found[3] and len(set(found)) == 3


@pytest.mark.slow
def test_interrupted_render_leaves_the_passes_done(tmp_path):
    # Jobs that a shell starts in the background ignore interrupts, and so would all processes below them.
    code = (
        "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
        "from atmo_jit.cli import main; sys.exit(main())"
    )
    out = tmp_path / "sunset.exr"
    command = [sys.executable, "-c", code, "render", "sunset", "--reference", "--out", str(out), "--spp", str(SAMPLES)]
    with subprocess.Popen([*command, *SMALL], stderr=subprocess.PIPE, text=True) as process:
        try:
            end = time.monotonic() + 120.0
            while not out.exists() and process.poll() is None and time.monotonic() < end:
                time.sleep(0.2)
            process.send_signal(signal.SIGINT)
            _, errors = process.communicate(timeout=60)
        finally:
            process.kill()
    assert process.returncode == 130 and "interrupted" in errors and (tmp_path / "sunset.partial.npz").exists()
    picture, header = read(out)
    assert 0 < int(header["samplesPerPixel"]) < SAMPLES
    assert np.isfinite(picture).all() and picture.max() > 0.0
