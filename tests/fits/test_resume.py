"""A fit that ended early goes on from what it kept."""

from __future__ import annotations

import json
import signal

import numpy as np
import pytest

import atmo_jit
from atmo_jit.cli import main
from atmo_jit.fits import FitConfig, fit, load_observations, result
from atmo_jit.fits.kept import Point

CONFIG = """
atmosphere = "earth"
tolerance = 0.002
[free]
"mie.scattering_per_m" = { mode = "scale", start = 1e-8, min = 1e-8, max = 1e-2 }
"mie.phase.g" = { start = 0.6, min = -0.5, max = 0.97 }
[nuisance]
calibration = { sigma = 0.05 }
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A scan of 300 directions, more than are looked at first, and a start so far off that another is tried."""
    rng = np.random.default_rng(4)
    zenith, azimuth = rng.uniform(0.0, 80.0, 300), rng.uniform(15.0, 345.0, 300)
    views = {"altitude_m": 0.0 * zenith, "sun_zenith_deg": 0.0 * zenith + 50.0}
    views |= {"view_zenith_deg": zenith, "azimuth_deg": azimuth}
    air = atmo_jit.Atmosphere.load("earth").replace({"mie.scattering_per_m": 1.3e-5, "mie.phase.g": 0.72})
    radiance = atmo_jit.sky(air, views).radiance * rng.normal(1.0, 0.02, (300, 3))
    here = tmp_path_factory.mktemp("scan")
    np.savez(here / "scan.npz", **views, radiance=radiance, relative_sigma=0.02, wavelengths_nm=air.wavelengths_nm)
    (here / "fit.toml").write_text(CONFIG, encoding="utf-8")
    return here


@pytest.fixture(scope="module")
def whole(folder):
    """The points of an uninterrupted fit, and its result."""
    points = []
    found = fit(load_observations(folder / "scan.npz"), FitConfig.load(folder / "fit.toml"), keep=points.append)
    return points, result(found)


def test_a_fit_goes_on_from_every_kind_of_point(folder, whole):
    """The first, the last of every step, and one in the midst of each, by way of JSON."""
    points, want = whole
    assert {point.step for point in points} >= {0, 1} and {len(point.ends) for point in points} == {0, 1, 2}
    chosen = [points[0]]
    for step in {point.step for point in points}:
        there = [point for point in points if point.step == step]
        chosen += [there[len(there) // 2], there[-1]]
    data, config = load_observations(folder / "scan.npz"), FitConfig.load(folder / "fit.toml")
    for point in chosen:
        begun = Point.of(json.loads(json.dumps(vars(point))))
        assert begun == point
        got = result(fit(data, config, begun=begun))
        assert got["converged"] and got["starts"] == want["starts"] and got["iterations"] >= point.iterations
        for name, entry in (want["parameters"] | want["nuisance"]).items():
            one = (got["parameters"] | got["nuisance"])[name]
            assert one["value"] == pytest.approx(entry["value"], abs=0.1 * entry["standard_error"])
            assert one["standard_error"] == pytest.approx(entry["standard_error"], rel=0.05)


def arguments(folder, out, *more):
    inputs = ["--observations", str(folder / "scan.npz"), "--config", str(folder / "fit.toml")]
    return ["fit", *inputs, "--out", str(out), "--quiet", *more]


@pytest.fixture
def interrupted(folder, tmp_path, monkeypatch, capsys):
    """The file that a fit left which was asked to stop at its fifth iteration."""
    from atmo_jit.fits.kept import Report

    count = Report.__call__

    def stopped(report, iteration, cost, u):
        count(report, iteration, cost, u)
        if report.iterations == 5:
            signal.raise_signal(signal.SIGTERM)

    with monkeypatch.context() as patched:
        patched.setattr(Report, "__call__", stopped)
        assert main(arguments(folder, tmp_path / "a.json")) == 130
    assert "a.partial.json holds the fit after 5 iterations; --resume goes on" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["a.partial.json"]
    return tmp_path / "a.partial.json"


def test_the_command_goes_on(folder, whole, interrupted, capsys):
    out = interrupted.with_name("a.json")
    assert main(arguments(folder, out, "--resume")) == 0
    assert not interrupted.exists() and capsys.readouterr().err == ""
    got, want = json.loads(out.read_text(encoding="utf-8")), whole[1]
    for name, entry in want["parameters"].items():
        assert got["parameters"][name]["value"] == pytest.approx(entry["value"], abs=0.1 * entry["standard_error"])
    assert got["iterations"] > 5


def test_only_the_same_fit_goes_on(folder, interrupted, capsys):
    kept, out = interrupted.read_bytes(), interrupted.with_name("a.json")
    others = interrupted.parent / "others"
    others.mkdir()
    arrays = dict(np.load(folder / "scan.npz"))
    for name, config, radiance in (
        ("--config", CONFIG.replace("start = 0.6", "start = 0.61"), arrays["radiance"]),
        ("--observations", CONFIG, arrays["radiance"] * (1.0 + 1e-7)),
    ):
        (others / "fit.toml").write_text(config, encoding="utf-8")
        np.savez(others / "scan.npz", **arrays | {"radiance": radiance})
        assert main(arguments(others, out, "--resume")) == 2
        error = capsys.readouterr().err
        assert error.startswith(f"atmo-jit: --resume: {name} is ") and error.count("\n") == 1
    document = json.loads(kept)
    for content in (
        b"",
        b"[" * 100_000,
        b"[1]",
        b"{}",
        json.dumps(document | {"point": document["point"] | {"u": [float("nan")] * 3}}).encode(),
        json.dumps(document | {"point": document["point"] | {"step": 10**400}}).encode(),
        json.dumps(document | {"point": document["point"] | {"nodes": ["x"]}}).encode(),
    ):
        interrupted.write_bytes(content)
        for more in ([], ["--resume"]):
            assert main(arguments(folder, out, *more)) == 2
            assert "a.partial.json': is not what an interrupted run keeps" in capsys.readouterr().err
            assert interrupted.read_bytes() == content
    short = json.dumps(document | {"point": document["point"] | {"u": [0.0]}}).encode()
    interrupted.write_bytes(short)
    assert main(arguments(folder, out, "--resume")) == 2
    assert "begun: is a point of another fit" in capsys.readouterr().err and interrupted.read_bytes() == short
    interrupted.write_bytes(kept)
    assert main(arguments(folder, out)) == 0
    assert "fitting anew" in capsys.readouterr().err and not interrupted.exists() and out.exists()
