"""Damaged and malicious files: status 2 and one line, in bounded memory, and nothing else touched."""

from __future__ import annotations

import io
import json
import subprocess
import sys
import zipfile
from random import Random

import numpy as np
import pytest

from atmo_jit.cli import main
from atmo_jit.errors import InputError
from atmo_jit.fits import load_observations
from bench.damage import damaged, hostile_npz, npz
from bench.hostile import feed
from bench.hostile_targets import SCENE, targets

LIMITED = """
import resource, sys
resource.setrlimit(resource.RLIMIT_AS, (3 << 30,) * 2)
from atmo_jit.cli import main
sys.exit(main(sys.argv[1:]))
"""


CSV_NAMES = "altitude_m,sun_zenith_deg,view_zenith_deg,azimuth_deg,wavelengths_nm,radiance\n"


def test_some_of_the_files():
    found, wrong = feed(21, seed=1)
    assert wrong == [] and sum(found.values()) == 21


@pytest.mark.slow
def test_many_of_the_files():
    assert feed(500, seed=2)[1] == []


def test_a_good_file_is_damaged(tmp_path):
    """The fuzzer does what it says: few of its files are still good."""
    for target in targets(tmp_path):
        bad = {damaged(Random(i), target.name, target.content, str(tmp_path / "mark")) for i in range(30)}
        assert len(bad - {target.content}) > 15


def test_a_bomb_takes_no_memory(tmp_path):
    """A packed array of 4 GiB, of which half a GiB is there, and another bad file, in a process that may have 3 GiB."""
    good = npz({name: np.zeros(6) for name in ("altitude_m", "sun_zenith_deg", "view_zenith_deg", "azimuth_deg")})
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        with archive.open("altitude_m.npy", "w", force_zip64=True) as member:
            np.lib.format.write_array_header_1_0(
                member, {"descr": "<f8", "fortran_order": False, "shape": (1 << 29,)}
            )
            for _ in range(1 << 5):
                member.write(b"\0" * (1 << 24))
    for i, content in enumerate([stream.getvalue(), hostile_npz(Random(0), good, str(tmp_path / "mark"))]):
        (tmp_path / f"{i}.npz").write_bytes(content)
        done = subprocess.run(
            [sys.executable, "-c", LIMITED, "sky", "--atmosphere", "earth", "--views", f"{i}.npz", "--out", "o.npz"],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=60,
        )
        assert done.returncode in (0, 2), done.stderr
        assert i or (done.returncode == 2 and done.stderr.count("\n") == 1)
    assert not (tmp_path / "mark").exists()


@pytest.mark.parametrize("name", ["9" * 5000, "a\0b", "x" * 300 + ".json"])
def test_names_that_no_file_system_takes(name, tmp_path, capsys):
    """Wherever a file may be named: one line."""
    np.savez(tmp_path / "views.npz", altitude_m=0.0)
    (tmp_path / "fit.toml").write_text(f"atmosphere = {json.dumps(name)}\n[free]\nground_albedo = {{}}\n")
    (tmp_path / "scene.json").write_text(json.dumps(SCENE | {"sky": {"type": "atmosphere", "atmosphere": name}}))
    views, config, scene = (str(tmp_path / file) for file in ("views.npz", "fit.toml", "scene.json"))
    for arguments in (
        ["sky", "--atmosphere", name, "--views", views, "--out", str(tmp_path / "o.npz")],
        ["sky", "--atmosphere", "earth", "--views", name, "--out", str(tmp_path / "o.npz")],
        ["sky", "--atmosphere", "earth", "--views", views, "--out", f"{name}.npz"],
        ["fit", "--observations", views, "--config", config, "--out", str(tmp_path / "o.json")],
        ["render", scene, "--out", str(tmp_path / "o.exr")],
        ["render", f"{name}.xml", "--out", str(tmp_path / "o.exr")],
        ["plan", name],
        ["export", "--atmosphere", "earth", "--layout", "native", "--out", name * 2],
        ["bench", "--out", name * 2, "--quick"],
    ):
        if "\0" in "".join(arguments):  # files can hold what no command line can
            continue
        assert main(arguments) == 2, arguments
        said = capsys.readouterr().err
        assert said.startswith("atmo-jit: ") and said.count("\n") == 1 and len(said) < 2000, said
    assert {path.name for path in tmp_path.iterdir()} == {"views.npz", "fit.toml", "scene.json"}


@pytest.mark.parametrize(
    ("row", "text"),
    [('0,"40', "a quote without an end"), ("0," + "9" * 200_000, "is not CSV"), ("0,4e1,3", "line 2 has 3 values")],
)
def test_rows_that_are_none(row, text, tmp_path):
    (tmp_path / "scan.csv").write_text(f"altitude_m,radiance\n{row}\n0,1\n")
    with pytest.raises(InputError, match=text):
        load_observations(tmp_path / "scan.csv")


def test_rows_without_end_of_wavelengths(tmp_path):
    """Each row of its own sample and wavelength: 20,000 take 600 kB, and would take 3 GB as samples by wavelengths."""
    rows = "".join(f"0,40,{i * 1e-3},90,{400 + i * 1e-3},0.05\n" for i in range(20_000))
    (tmp_path / "scan.csv").write_text(CSV_NAMES + rows)
    with pytest.raises(InputError, match="has 20000 samples and 20000 wavelengths; must be at most"):
        load_observations(tmp_path / "scan.csv")


def test_repeated_rows_are_samples_of_their_own(tmp_path):
    """A hundred thousand of them too, within seconds."""
    count = 100_000
    rows = [f"0,40,{i % 50_000 * 1e-3},90,{w},{0.05 + (i + w) * 1e-6}\n" for w in (440, 550) for i in range(count)]
    (tmp_path / "scan.csv").write_text(CSV_NAMES + "".join(rows))
    found = load_observations(tmp_path / "scan.csv")
    assert found.radiance.shape == (100_000, 2) and np.isfinite(found.radiance).all()
    assert np.unique(found.radiance[:, 0]).size == 100_000
    assert found.radiance[:, 1] - found.radiance[:, 0] == pytest.approx(1.1e-4, rel=1e-6)


def test_thousands_of_columns(tmp_path):
    names = ",".join(f"c{i}" for i in range(200_000))
    (tmp_path / "scan.csv").write_text(f"{names},c0\n1\n")
    with pytest.raises(InputError, match="column 'c0' is there twice"):
        load_observations(tmp_path / "scan.csv")


@pytest.mark.parametrize("scan", [np.inf, np.nan, 0.5])
def test_scans_that_are_no_number(scan, tmp_path):
    arrays = {"altitude_m": 0.0, "sun_zenith_deg": 40.0, "view_zenith_deg": np.zeros(1), "azimuth_deg": 0.0}
    arrays |= {"radiance": np.full((1, 1), 0.05), "wavelengths_nm": np.array([550.0]), "scan": np.array([scan])}
    (tmp_path / "scan.npz").write_bytes(npz(arrays))
    with pytest.raises(InputError, match=f"scan holds {scan:g}; must be whole numbers"):
        load_observations(tmp_path / "scan.npz")
