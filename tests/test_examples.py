"""Every block of code in README.md and docs/ runs, or at least is understood by the program that it is for.

docs/plugins.md, which is made from docstrings, has a test of its own: tests/plugins/test_page.py.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from importlib import import_module
from pathlib import Path

import click
import numpy as np
import pytest

import atmo_jit
from atmo_jit import scenes
from atmo_jit.cli import group, main
from bench.hostile_targets import CONFIG

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted(ROOT.glob("docs/*.md"))]
TEXTS = {page.relative_to(ROOT).as_posix(): page.read_text(encoding="utf-8") for page in PAGES}
FENCED = re.compile(r"^```(\w+)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
# Command lines that are only parsed, and why.
PARSED = {
    "atmo-jit bench --out bench": "takes minutes; tests/commands/test_bench_command.py runs it with --quick",
    "atmo-jit view": "serves until it is stopped; tests/viewer asks it",
    "atmo-jit view --atmosphere earth": "the same",
}
# Those that take more than a few seconds.
SLOW = {
    "atmo-jit render sunset --out sunset.exr --spp 256",
    "atmo-jit plan sunset --check",
    "atmo-jit export --atmosphere earth --layout takram --out tables",
}


def blocks(kind):
    """(page, text) of the fenced blocks of a kind; "indented": of the others."""
    for name, text in TEXTS.items():
        if kind == "indented":
            for block in re.findall(r"^\n((?:    .*\n)+)", FENCED.sub("", text), re.MULTILINE):
                yield name, block
        elif name != "docs/plugins.md":
            yield from ((name, block) for language, block in FENCED.findall(text) if language == kind)


def command_lines():
    """Those of the indented blocks, without their comments; docs/method.md indents its equations."""
    rows = [row for name, block in blocks("indented") if name != "docs/method.md" for row in block.splitlines()]
    return list(dict.fromkeys(re.sub(r"\s+#.*", "", row).strip() for row in rows))


def in_sentences():
    """Commands with arguments that sentences name."""
    found = (re.findall(r"`((?:atmo-jit|python -m) [^`]+)`", FENCED.sub("", text)) for text in TEXTS.values())
    return sorted({re.sub(r" > \S+", "", " ".join(text.split())) for texts in found for text in texts})


def of(program):
    return [line for line in command_lines() if re.match(program, line)]


class Understood(Exception):
    """Raised where a program would begin to work."""


def parse(line):
    """Have the program's own parser read a line. Raises click.ClickException or SystemExit where it does not."""
    words = shlex.split(line)
    if words[0] == "atmo-jit":
        command = group.get_command(click.Context(group), words[1])
        assert command is not None, line
        command.make_context(words[1], words[2:])
        return
    module = import_module(words[2])
    begins = getattr(module, "main", None)
    if begins is None or "argparse" not in begins.__globals__:  # takes files, or nothing
        assert "__main__" in Path(module.__file__).read_text(encoding="utf-8")
        assert all(re.fullmatch(r"\S+\.(json|md)", word) for word in words[3:])
        return
    with pytest.MonkeyPatch.context() as patch:
        parsed = argparse.ArgumentParser.parse_args

        def stop(*arguments, **named):
            parsed(*arguments, **named)
            raise Understood

        patch.setattr(argparse.ArgumentParser, "parse_args", stop)
        patch.setattr(sys, "argv", words[2:])
        with pytest.raises(Understood):
            module.main()


def test_every_block_is_looked_at():
    """By a test of this file; what is here neither a block of these kinds nor a known line is new."""
    kinds = {kind for text in TEXTS.values() for kind, _ in FENCED.findall(text)}
    assert kinds == {"python", "xml", "toml", "js", "math"}
    assert all(text.count("\n```") == 2 * len(FENCED.findall(text)) for text in TEXTS.values())
    known = {*of("atmo-jit "), *of("python -m "), *of("make "), *of("python3 -m venv "), ".ci/run"}
    assert set(command_lines()) - known == {".venv/bin/python -m bench.constants"}
    assert {*PARSED, *SLOW} <= known


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder to work in, with the files that the examples read."""
    zenith = np.linspace(0.0, 80.0, 20)
    views = {"altitude_m": 0.0 * zenith, "sun_zenith_deg": 0.0 * zenith + 60.0}
    views |= {"view_zenith_deg": zenith, "azimuth_deg": 0.0 * zenith + 90.0}
    np.savez(tmp_path / "views.npz", **views)
    scan = {"radiance": atmo_jit.sky("earth", views).radiance, "wavelengths_nm": [680.0, 550.0, 440.0]}
    np.savez(tmp_path / "scan.npz", **views, **scan, relative_sigma=0.05)
    (tmp_path / "fit.toml").write_text(CONFIG, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def mi():
    """Mitsuba with the plugins."""
    mitsuba = pytest.importorskip("mitsuba")
    mitsuba.set_variant("llvm_ad_rgb")
    from atmo_jit.plugins import register

    register()
    return mitsuba


@pytest.mark.parametrize("example", [pytest.param(text, id=name) for name, text in blocks("python")])
def test_python(folder, example):
    assert len(example.strip().splitlines()) <= 15
    exec(compile(example, "example", "exec"), names := {})
    if "ball.exr" in example:
        assert (folder / "ball.exr").is_file() and names["image"].shape == (180, 320, 3)


@pytest.mark.parametrize("example", [pytest.param(text, id=name) for name, text in blocks("xml")])
def test_xml(mi, example):
    assert mi.load_string(f'<scene version="3.9.0">{example}</scene>') is not None


def test_the_readmes_xml_is_its_dict(mi):
    """The emitter of both is the same."""
    text = next(text for name, text in blocks("xml") if name == "README.md")
    scene = next(text for name, text in blocks("python") if name == "README.md" and "mi.load_dict" in text)
    sky = eval(re.search(r"^sky = (\{.*\})$", scene, re.MULTILINE)[1])
    emitters = mi.load_string(f'<scene version="3.9.0">{text}</scene>').emitters()[0], mi.load_dict(sky)
    first, second = (np.array(mi.traverse(emitter)["sky_radiance"]) for emitter in emitters)
    assert np.array_equal(first, second)


@pytest.mark.parametrize("example", [text for _, text in blocks("toml")])
def test_toml(tmp_path, example):
    from atmo_jit.fits import FitConfig
    from atmo_jit.fits.pictures import _settings

    shutil.copy(scenes.find("noon"), tmp_path)
    config = FitConfig.of({"free": {"mie.phase.g": {}}} | tomllib.loads(example))
    assert config.picture is None or _settings(config.picture, tmp_path)["sun_zenith_deg"] < 90.0


@pytest.mark.skipif(shutil.which("node") is None, reason="no node to read JavaScript")
@pytest.mark.parametrize("example", [text for _, text in blocks("js")])
def test_javascript(tmp_path, example):
    """Only read: it needs the npm client in a browser, which `make client` draws with."""
    (tmp_path / "example.mjs").write_text(example, encoding="utf-8")
    done = subprocess.run(["node", "--check", tmp_path / "example.mjs"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    "line",
    [pytest.param(line, marks=[pytest.mark.slow] * (line in SLOW)) for line in of("atmo-jit ") if line not in PARSED],
)
def test_commands(folder, line, capsys):
    assert main(shlex.split(line)[1:]) == 0
    captured = capsys.readouterr()
    assert captured.out and all(said.startswith("atmo-jit: warning: ") for said in captured.err.splitlines())


@pytest.mark.parametrize("line", sorted({*PARSED, *SLOW}))
def test_commands_that_take_long(line):
    """Only parsed, for the reasons above (and those that end by themselves run among the slow tests)."""
    parse(line)


@pytest.mark.parametrize("line", [*of("python -m "), *(line.removeprefix(".venv/bin/") for line in of(r"\.venv/bin/"))])
def test_modules(line):
    """Only parsed: they measure, for minutes."""
    parse(line)


@pytest.mark.parametrize("line", in_sentences())
def test_commands_in_sentences(line):
    """Only parsed: some name an option and leave out what is required, some have DIR or NAME in them."""
    try:
        parse(line)
    except click.MissingParameter:
        pass


def test_make_and_the_scripts_of_ci():
    """Only looked for: .ci/run runs the README's first two command lines in new environments, and takes long."""
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    assert {line.split()[1] for line in of("make ")} <= targets
    assert all(os.access(ROOT / line, os.X_OK) for line in of(r"\.ci/")) and len(of("python3 -m venv ")) == 2
