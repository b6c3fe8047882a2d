"""The page and the picture of a measured frontier."""

from __future__ import annotations

import json

import pytest

from bench import figure, frontier_page
from bench.truth import GROUPS

SECONDS = {"wall_s": 0.25, "cpu_s": 0.5}


def groups(error, rays=10):
    names = ("median", "p95", "max", "beyond_median", "beyond_p95", "beyond_max")
    found = [{"group": group, "rays": rays, **dict.fromkeys(names, error), "cpu_s": 0.5} for group in GROUPS]
    found[-1] |= {"rays": 0, **dict.fromkeys(names), "cpu_s": None}
    return found


@pytest.fixture
def result():
    cost = {"cold": SECONDS, "cached": SECONDS, "warm": SECONDS, "peak_mib": 12.5, "solution_bytes": 1_500_000}
    own = {"method": "atmo-jit", "setting": "tolerance 0.01", "what": "", "cases": "all", "cost": cost}
    other = {**own, "method": "bruneton2017", "setting": "size 1", "cases": ["clear", "hazy"]}
    stage = {"stage": "a > b", "launches": 2, "wall_s": 0.1, "passes": {"a": 10, "b": 20}, "ratio": 1.25}
    return {
        "schema": 2,
        "atmo_jit": "0.0",
        "machine": {
            "processor": "one", "cores": 2, "threads": 2, "march_steps_per_s": 5e8, "gathers_per_s": 6e8
        },
        "truth": "made up",
        "atmosphere": "earth",
        "frontier": [{**own, "groups": groups(0.123)}, {**other, "groups": groups(4.56)}],
        "own_on_few": groups(0.321),
        "stages": {"solve": [{**stage, "gathers_per_s": 1e8, "instructions_per_s": 1e9}, {**stage, "wall_s": 1e-6}]},
        "tables": [{"what": "sky view baked", "wall_ms": 1.5, "cpu_ms": 2.5}],
        "peers": [{"method": "sasktran2", "setting": "8 streams", "note": "version 1", "groups": groups(2.5)}],
        "skipped": [{"what": "GPU", "reason": "none"}],
        "seconds": 3.0,
    }  # fmt: skip


def test_page(result):
    text = frontier_page.page(result, "images/x.png")
    assert "](images/x.png)" in text and "- GPU: none" in text
    rows = [line for line in text.splitlines() if line.startswith("| atmo-jit | tolerance 0.01 |")]
    assert rows[0] == "| atmo-jit | tolerance 0.01 | 0.5 | 0.25 | 0.25 | 0.25 | 12.5 | 1.5 |"
    assert rows[1] == "| atmo-jit | tolerance 0.01 | all | 0.123 | 0.123 | 0.123 | 0.123 | 0.123 | - |"
    assert rows[2].endswith("| 0.123 / 0.123 | 0.123 / 0.123 | - |")
    assert "| bruneton2017 | size 1 | 2 | 4.56 |" in text and "`clear`, `hazy`" in text and "0.321" in text
    assert text.count("| a > b |") == 1 and "1.25" in text
    assert "| sasktran2 | 8 streams | version 1 |" in text and "| sky view baked | 1.5 | 2.5 |" in text
    assert "](" not in frontier_page.page(result)


def test_summary(result):
    text = frontier_page.summary(result)
    assert "errors against: made up" in text and "bruneton2017, size 1" in text and "skipped: GPU: none" in text


def test_picture(result, tmp_path):
    figure.draw(result, tmp_path / "x.png")
    assert (tmp_path / "x.png").read_bytes().startswith(b"\x89PNG")
    assert figure._points(result, "day") == {
        "atmo-jit": [(0.5, 0.123, "tolerance 0.01")],
        "bruneton2017": [(0.5, 4.56, "size 1")],
        "sasktran2": [(0.5, 2.5, "8 streams")],
    }
    assert figure._points(result, GROUPS[-1]) == {}


def test_the_page_of_the_documentation(result, tmp_path):
    (tmp_path / "bench.json").write_text(json.dumps(result))
    assert frontier_page.main([str(tmp_path / "bench.json"), str(tmp_path / "frontier.md")]) == 0
    assert "](images/frontier.png)" in (tmp_path / "frontier.md").read_text()
    assert (tmp_path / "images" / "frontier.png").is_file()
    assert frontier_page.main([]) == 2
    (tmp_path / "more.json").write_text(json.dumps({"peers": [], "machine": {}, "truth": "other"}))
    names = ("bench.json", "more.json", "frontier.md")
    assert frontier_page.main([str(tmp_path / name) for name in names]) == 0
    text = (tmp_path / "frontier.md").read_text()
    assert "sasktran2" not in text and "made up" in text and "| a > b |" in text
