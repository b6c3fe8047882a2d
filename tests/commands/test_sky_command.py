"""``atmo-jit sky``: what it writes, every wrong input refused with status 2 and one line, nothing half-written."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest
from descriptions import changed

import atmo_jit
from atmo_jit import presets
from atmo_jit.cli import main
from atmo_jit.commands import sky as module

VIEWS = {
    "altitude_m": [0.0, 1000.0, 2.0],
    "sun_zenith_deg": [30.0, 85.0, 60.0],
    "view_zenith_deg": [45.0, 89.0, 120.0],
    "azimuth_deg": [0.0, 90.0, 10.0],
}
EARTH = json.loads(presets.text("earth"))


@pytest.fixture
def views(tmp_path):
    np.savez(tmp_path / "views.npz", **VIEWS)
    return tmp_path / "views.npz"


@pytest.fixture
def run(capsys):
    def run(*arguments):
        status = main([str(argument) for argument in ("sky", *arguments)])
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return run


@pytest.fixture
def refused(run, tmp_path):
    """Run ``sky`` on good options changed by keywords; check that it fails as it must and return its one line."""

    def refused(*more, **options):
        out = tmp_path / "old.npz"
        out.write_bytes(b"precious")
        options = {"atmosphere": "earth", "out": out, **options}
        status, text, err = run(*(part for name, value in options.items() for part in (f"--{name}", value)), *more)
        assert (status, text) == (2, ""), err
        assert err.startswith("atmo-jit: ") and err.count("\n") == 1 and "Traceback" not in err
        assert out.read_bytes() == b"precious"
        assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]
        return err

    return refused


def read(path):
    with np.load(path) as file:
        return {name: file[name] for name in file.files}


@pytest.mark.parametrize("method", ["tables", "march", "auto"])
def test_method_is_taken_and_told(run, views, tmp_path, method):
    out = tmp_path / "out.npz"
    status, *_ = run("--atmosphere", "earth", "--views", views, "--out", out, "--method", method, "--quiet")
    arrays = read(out)
    assert status == 0
    # Three observers: three rays cost less than a table that nobody asked for.
    assert json.loads(str(arrays["meta"]))["method"] == ("tables" if method == "tables" else "march")
    exact = atmo_jit.sky("earth", VIEWS, method="march").radiance
    np.testing.assert_allclose(arrays["radiance"], exact, rtol=1e-2)


def test_writes_what_the_contract_says(run, views, tmp_path):
    out = tmp_path / "out.npz"
    status, text, err = run("--atmosphere", "earth", "--views", views, "--out", out)
    assert (status, err) == (0, "")
    assert text.startswith(f"{out}: 3 views, 3 wavelengths, ")
    arrays = read(out)
    assert list(arrays) == ["radiance", "transmittance", "sun_irradiance", "sky_irradiance", "meta"]
    for name in ("radiance", "transmittance", "sun_irradiance", "sky_irradiance"):
        assert arrays[name].dtype == np.float32 and arrays[name].shape == (3, 3)
        assert np.isfinite(arrays[name]).all() and (arrays[name] >= 0).all()
    meta = json.loads(str(arrays["meta"]))
    assert meta["atmo_jit"] == atmo_jit.__version__ and meta["seconds"] > 0 and meta["tolerance"] == 0.01
    assert "plan" in meta


def test_is_the_python_function(run, views, tmp_path):
    out = tmp_path / "out.npz"
    options = ("--orders", 2, "--no-ground", "--sun-disc", "--tolerance", 0.02, "--quiet")
    assert run("--atmosphere", "earth", "--views", views, "--out", out, *options) == (0, "", "")
    result = atmo_jit.sky("earth", VIEWS, orders=2, ground=False, sun_disc=True, tolerance=0.02)
    for name in ("radiance", "transmittance", "sun_irradiance", "sky_irradiance"):
        assert np.allclose(read(out)[name], getattr(result, name), rtol=1e-5)


def test_options_do_what_they_say(run, views, tmp_path):
    def radiance(*options):
        out = tmp_path / "out.npz"
        assert run("--atmosphere", "earth", "--views", views, "--out", out, "--quiet", *options)[0] == 0
        return read(out)["radiance"]

    everything = radiance()
    assert (radiance("--orders", 1) < everything).all()
    without = radiance("--no-ground")
    assert np.allclose(without[:2], everything[:2], rtol=1e-5) and (without[2] < everything[2]).all()


def test_atmosphere_file_of_another_length(run, views, tmp_path):
    file = tmp_path / "one.json"
    one = {**EARTH, "wavelengths_nm": [550], "solar_irradiance": 1, "mie": None, "ozone": None, "ground_albedo": 0.1}
    one["rayleigh"] = {"scattering_per_m": 1e-5, "scale_height_m": 8000}
    file.write_text(json.dumps(one))
    assert run("--atmosphere", file, "--views", views, "--out", tmp_path / "out.npz", "--orders", 1)[0] == 0
    assert read(tmp_path / "out.npz")["radiance"].shape == (3, 1)


def test_distance_stops_the_ray(run, tmp_path):
    np.savez(tmp_path / "v.npz", **{**VIEWS, "distance_m": [0.0, 1e3, np.inf]})
    assert (
        run("--atmosphere", "earth", "--views", tmp_path / "v.npz", "--out", tmp_path / "o.npz", "--orders", 1)[0] == 0
    )
    arrays = read(tmp_path / "o.npz")
    assert (arrays["radiance"][0] == 0).all() and (arrays["transmittance"][0] == 1).all()
    assert ((arrays["transmittance"][1] > 0.8) & (arrays["transmittance"][1] < 1)).all()


# place in the file, wrong value, the field as the message must name it
FIELDS = [
    *(
        (("wavelengths_nm",), value, "wavelengths_nm")
        for value in (..., [], "x", None, [680, -550, 440], [680, "x", 440])
    ),
    *((("solar_irradiance",), value, "solar_irradiance") for value in (-1, [1, 2], [1, -1, 1], "x", True)),
    *((("bottom_radius_m",), value, "bottom_radius_m") for value in (..., 0, -1, "x", None, [1], 7e6)),
    *((("top_radius_m",), value, "top_radius_m") for value in (..., -1, "x", 6e6)),
    *((("ground_albedo",), value, "ground_albedo") for value in (-0.1, 1.1, [0.1], "x", [0.1, 2, 0.1])),
    *((("sun_angular_radius_deg",), value, "sun_angular_radius_deg") for value in (-1, "x", [1], 100)),
    (("rayleigh",), 3, "rayleigh"),
    (("rayleigh", "scattering_per_m"), ..., "rayleigh.scattering_per_m"),
    (("rayleigh", "scattering_per_m"), [1e-6, -1e-6, 1e-6], "rayleigh.scattering_per_m"),
    (("rayleigh", "scattering_per_m"), [1e-6], "rayleigh.scattering_per_m"),
    (("rayleigh", "scale_height_m"), 0, "rayleigh.scale_height_m"),
    (("rayleigh", "colour"), 1, "rayleigh.colour"),
    (("mie", "single_scattering_albedo"), [0.9, 1.5, 0.9], "mie.single_scattering_albedo"),
    (("mie", "scale_height_m"), -1200, "mie.scale_height_m"),
    (("mie", "phase"), None, "mie.phase"),
    (("mie", "phase", "type"), "mie", "mie.phase.type"),
    (("mie", "phase", "g"), 1, "mie.phase.g"),
    (("mie", "phase", "g"), [0.8, 0.8], "mie.phase.g"),
    (("mie", "phase", "moments"), [1], "mie.phase.moments"),
    (("ozone", "absorption_per_m"), -1, "ozone.absorption_per_m"),
    (("ozone", "center_m"), "x", "ozone.center_m"),
    (("ozone", "half_width_m"), 0, "ozone.half_width_m"),
    (("clouds",), {}, "clouds"),
]


@pytest.mark.parametrize(("place", "value", "field"), FIELDS, ids=[f"{'.'.join(p)}={v}"[:50] for p, v, _ in FIELDS])
def test_every_field_of_the_atmosphere(refused, views, tmp_path, place, value, field):
    file = tmp_path / "wrong.json"
    file.write_text(json.dumps(changed(EARTH, place, value)))
    message = refused(atmosphere=file, views=views)
    assert field in message and "wrong.json" in message


def test_not_numbers_in_the_atmosphere(refused, views, tmp_path):
    for field in ("bottom_radius_m", "ground_albedo", "solar_irradiance"):
        for value in (float("nan"), float("inf")):
            (tmp_path / "wrong.json").write_text(json.dumps(changed(EARTH, field, value)))
            assert "wrong.json" in refused(atmosphere=tmp_path / "wrong.json", views=views)


def test_atmosphere_files_that_are_none(refused, views, tmp_path):
    assert "nowhere.json" in refused(atmosphere="nowhere.json", views=views)
    assert "venus" in refused(atmosphere="venus", views=views)
    for text in ("", "{", "[1]", '{"a": 1, "a": 2}', "\x00"):
        (tmp_path / "broken.json").write_text(text)
        assert "broken.json" in refused(atmosphere=tmp_path / "broken.json", views=views)
    (tmp_path / "binary.json").write_bytes(b"\xff\xfe\x00")
    assert "binary.json" in refused(atmosphere=tmp_path / "binary.json", views=views)
    refused(atmosphere=tmp_path, views=views)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("altitude_m", [0, -5, 0], "altitude_m[1] is -5.0; allowed are numbers from 0 to 1e+30"),
        ("sun_zenith_deg", [0, 0, 181], "sun_zenith_deg[2] is 181.0; allowed are numbers from 0 to 180"),
        ("view_zenith_deg", [np.nan, 0, 0], "view_zenith_deg[0] is nan; allowed are numbers from 0 to 180"),
        ("azimuth_deg", [0, np.inf, 0], "azimuth_deg[1] is inf; allowed are finite numbers"),
        ("azimuth_deg", [0, 0], "azimuth_deg has 2 values but altitude_m has 3; all must have the same length"),
        ("azimuth_deg", [[0, 0, 0]], "azimuth_deg has shape (1, 3)"),
        ("azimuth_deg", 0, "azimuth_deg has shape ()"),
        ("azimuth_deg", ["a", "b", "c"], "azimuth_deg"),
        ("distance_m", [0, -1, 0], "distance_m[1] is -1.0; allowed are numbers >= 0 (inf: no stop)"),
        ("colour", [0, 0, 0], "unknown array 'colour'; allowed are altitude_m,"),
        ("altitude_m", None, "array altitude_m is missing"),
    ],
)
def test_every_array_of_the_views(refused, tmp_path, name, value, message):
    arrays = {key: array for key, array in {**VIEWS, name: value}.items() if array is not None}
    np.savez(tmp_path / "wrong.npz", **arrays)
    line = refused(views=tmp_path / "wrong.npz")
    assert message in line and "wrong.npz" in line


def test_views_files_that_are_none(refused, tmp_path):
    assert "nowhere.npz" in refused(views="nowhere.npz")
    (tmp_path / "text.npz").write_text("altitude_m,sun_zenith_deg")
    assert "text.npz" in refused(views=tmp_path / "text.npz")
    np.savez(tmp_path / "pickled.npz", **{**VIEWS, "azimuth_deg": np.array([None, 1, 2])}, allow_pickle=True)
    assert "pickled.npz" in refused(views=tmp_path / "pickled.npz")
    np.savez(tmp_path / "empty.npz", **{name: np.zeros(0) for name in VIEWS})
    assert "at least one view" in refused(views=tmp_path / "empty.npz")


OPTIONS = {
    "orders": (["--orders", "0"], "Invalid value for '--orders'"),
    "tolerance": (["--tolerance", "0"], "--tolerance is 0.0; must be a number between 0 and 1"),
    "tolerance nan": (["--tolerance", "nan"], "--tolerance is nan; must be a number between 0 and 1"),
    "tolerance text": (["--tolerance", "x"], "Invalid value for '--tolerance'"),
    "method": (["--method", "magic"], "'magic' is not one of 'auto', 'tables', 'march'"),
    "unknown": (["--fast"], "No such option"),
    "extra": (["more"], "Got unexpected extra argument"),
    "suffix": (["--out", "out.npy"], "output 'out.npy': the name must end in .npz"),
    "folder": (["--out", "/nowhere/out.npz"], "output '/nowhere/out.npz': there is no folder '/nowhere'"),
}


@pytest.mark.parametrize(("options", "message"), OPTIONS.values(), ids=OPTIONS.keys())
def test_every_option(refused, views, options, message):
    assert message in refused(*options, views=views)


def test_missing_options(run, views):
    for options in ((), ("--views", views), ("--atmosphere", "earth", "--views", views)):
        status, _, err = run(*options)
        assert status == 2 and "Missing option" in err and err.count("\n") == 1


@pytest.mark.parametrize("error", [KeyboardInterrupt(), RuntimeError("full")])
def test_an_interrupted_run_leaves_everything_as_it_was(run, views, tmp_path, monkeypatch, error):
    out = tmp_path / "out.npz"
    out.write_bytes(b"precious")

    def half(path, arrays):
        path.write_bytes(b"half")
        raise error

    monkeypatch.setattr(module, "write_npz", half)
    status, _, err = run("--atmosphere", "earth", "--views", views, "--out", out, "--orders", 1)
    assert status not in (0, 2) and err.strip().count("\n") == 0
    assert out.read_bytes() == b"precious"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out.npz", "views.npz"]


def test_imports_nothing_slow_and_shows_no_bar_in_a_pipe(views, tmp_path):
    slow = {"mitsuba", "colour", "matplotlib", "scipy", "OpenEXR", "rich", "pandas", "jax"}
    code = f"import sys; from atmo_jit.cli import main; s = main(sys.argv[1:]); print(s, {slow} & set(sys.modules))"
    arguments = [
        "sky",
        "--atmosphere",
        "earth",
        "--views",
        views,
        "--out",
        tmp_path / "out.npz",
        "--orders",
        "1",
        "--quiet",
    ]
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("0 set()\n", "")


def test_derivatives_are_written_under_their_names(run, views, tmp_path):
    out = tmp_path / "out.npz"
    status, _, err = run(
        *("--atmosphere", "earth", "--views", views, "--out", out, "--tolerance", 0.03, "--quiet"),
        *("--gradient", "mie.phase.g,ground_albedo"),
    )
    assert status == 0, err
    found = np.load(out)
    for name in ("d_radiance/mie.phase.g", "dlog_radiance/ground_albedo"):
        assert found[name].shape == (3, 3) and np.isfinite(found[name]).all()
    assert np.all(found["dlog_radiance/ground_albedo"] > 0.0)


def test_an_unknown_derivative_is_refused(refused, views):
    line = refused("--gradient", "mie.phase.g,mie.beta", views=views)
    assert "gradient: 'mie.beta' is no parameter; allowed are solar_irradiance, bottom_radius_m," in line
    assert "distance_m" not in line and line.rstrip().endswith("azimuth_deg")
