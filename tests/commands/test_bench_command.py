"""``atmo-jit bench``: what it writes, what it says where references are absent, what it refuses."""

from __future__ import annotations

import json

import pytest

from atmo_jit.bench import frontier, reference
from atmo_jit.cli import main

GROUPS = ["day", "horizon", "twilight", "limb", "haze", "haze horizon"]


@pytest.fixture
def run(capsys):
    def run(*arguments):
        status = main([str(argument) for argument in ("bench", *arguments)])
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return run


@pytest.fixture
def no_reference(monkeypatch, tmp_path):
    monkeypatch.setattr(reference, "FOLDER", tmp_path / "nowhere")


@pytest.mark.slow
def test_frontier_without_reference(run, tmp_path, no_reference):
    out = tmp_path / "bench"
    status, text, err = run("--out", out, "--quick", "--part", "frontier", "--method", "hillaire2020")
    assert (status, err) == (0, "")
    assert sorted(path.name for path in out.iterdir()) == ["bench.json", "bench.md", "bench.png"]
    result = json.loads((out / "bench.json").read_text())
    assert result["schema"] == frontier.SCHEMA and result["truth"] == "this package at its highest resolution"
    assert any("no reference data" in entry["reason"] for entry in result["skipped"])
    (row,) = result["frontier"]
    assert (row["method"], row["setting"], row["cases"]) == ("hillaire2020", "size 1", "all")
    assert [part["group"] for part in row["groups"]] == GROUPS
    for part in row["groups"]:
        assert part["rays"] > 0 and 0 < part["median"] <= part["p95"] <= part["max"]
        assert part["beyond_max"] == part["max"] and part["cpu_s"] > 0
    price = row["cost"]
    assert price["cold"]["cpu_s"] > price["warm"]["cpu_s"] > 0 and price["peak_mib"] > 0 and price["solution_bytes"] > 0
    assert (out / "bench.png").read_bytes().startswith(b"\x89PNG")
    page = (out / "bench.md").read_text()
    assert "![" in page and "hillaire2020" in page and "no reference data" in page
    assert "this package at its highest resolution" in text


def test_stages_alone(run, tmp_path):
    status, _, err = run("--out", tmp_path, "--quick", "--part", "stages", "--quiet")
    assert (status, err) == (0, "")
    result = json.loads((tmp_path / "bench.json").read_text())
    assert "frontier" not in result and result["truth"] is None
    assert result["machine"]["march_steps_per_s"] > 0 and result["machine"]["gathers_per_s"] > 0
    for rows in result["stages"].values():
        assert rows == sorted(rows, key=lambda row: -row["wall_s"])
        known = [row for row in rows if "ratio" in row]
        # most of the time is in kernels whose work is known
        assert sum(row["wall_s"] for row in known) > 0.5 * sum(row["wall_s"] for row in rows)


@pytest.mark.slow
def test_reference_of_the_folder_named(reference, run, tmp_path):
    options = ("--quick", "--part", "frontier", "--method", "atmo-jit", "--reference", reference)
    assert run("--out", tmp_path, *options)[0] == 0
    result = json.loads((tmp_path / "bench.json").read_text())
    assert result["truth"].startswith("reference data") and len(result["frontier"][0]["cases"]) == 4
    day = result["frontier"][0]["groups"][0]
    assert day["rays"] > 50 and day["median"] < 1.0 and day["beyond_p95"] < day["p95"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "Missing option '--out'"),
        (("--method", "magic"), "--method: is 'magic'; must be one of atmo-jit"),
        (("--part", "magic"), "'magic' is not one of"),
        (("--atmosphere", "venus"), "venus"),
        (("--reference", "nowhere", "--part", "frontier"), "--reference: no reference data in nowhere"),
        (("--views", "1"), "Invalid value for '--views'"),
    ],
)
def test_wrong_input_is_one_line(run, tmp_path, arguments, message):
    out = () if not arguments else ("--out", tmp_path / "new")
    status, text, err = run(*out, *arguments)
    assert (status, text) == (2, "") and err.count("\n") == 1 and message in err
    assert not (tmp_path / "new").exists()


def test_outputs_that_cannot_be(run, tmp_path):
    (tmp_path / "file").write_text("")
    assert "is not a folder" in run("--out", tmp_path / "file")[2]
    assert "there is no folder" in run("--out", tmp_path / "no" / "where")[2]


def test_a_failed_run_leaves_what_was_there(run, tmp_path, monkeypatch):
    (tmp_path / "bench.json").write_text("precious")

    def fail(**options):
        raise RuntimeError("full")

    monkeypatch.setattr(frontier, "measure", fail)
    assert run("--out", tmp_path)[0] == 1
    assert (tmp_path / "bench.json").read_text() == "precious" and len(list(tmp_path.iterdir())) == 1


def test_without_matplotlib_the_rest_is_written(run, tmp_path, monkeypatch):
    from atmo_jit.commands import bench

    monkeypatch.setattr(bench, "find_spec", lambda name: None)
    made = {"schema": 2, "atmo_jit": "1", "truth": None, "atmosphere": "earth", "skipped": [], "seconds": 1.0}
    machine = {"processor": "x", "cores": 1, "threads": 1, "march_steps_per_s": 1e6, "gathers_per_s": 1e6}
    monkeypatch.setattr(frontier, "measure", lambda **options: {**made, "machine": machine})
    status, text, _ = run("--out", tmp_path)
    assert status == 0 and "atmo-jit[bench]" in text
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bench.json", "bench.md"]


@pytest.mark.slow
def test_everything_quickly(run, tmp_path):
    status, text, _ = run("--out", tmp_path, "--quick")
    assert status == 0
    result = json.loads((tmp_path / "bench.json").read_text())
    assert result["seconds"] < 240 and {"frontier", "stages", "peers", "curves"} <= set(result)
    assert result["curves"]["resolution"]["order"] > 0.5
    assert "order of convergence" in text
    assert any(row["method"] == "sunsky" for row in result["peers"])
