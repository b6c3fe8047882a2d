"""``atmo-jit render --reference``: the path-traced air in place of the emitter."""

from __future__ import annotations

import signal
import subprocess
import sys
import time

import numpy as np
import OpenEXR
import pytest

from atmo_jit.cli import main

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
    assert process.returncode == 130 and "interrupted" in errors
    picture, header = read(out)
    assert 0 < int(header["samplesPerPixel"]) < SAMPLES
    assert np.isfinite(picture).all() and picture.max() > 0.0
