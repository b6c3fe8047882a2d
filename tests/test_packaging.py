"""pyproject.toml agrees with the tree, and the README with the package."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def folder_of(package):
    """Where setuptools takes a package from: the longest prefix in package-dir, then the rest of the name."""
    mapping = PROJECT["tool"]["setuptools"]["package-dir"]
    prefix = max((p for p in mapping if package == p or package.startswith(f"{p}.")), key=len)
    return ROOT / mapping[prefix] / package[len(prefix) :].strip(".").replace(".", "/")


def files_below(folder):
    return [file for file in folder.rglob("*") if file.is_file() and "__pycache__" not in file.parts]


def test_every_package_is_installed_and_nothing_else():
    listed = {folder_of(package) for package in PROJECT["tool"]["setuptools"]["packages"]}
    tops = [ROOT / name for name in ("atmo_jit", "bench", "fits", "plugins", "scenes")]
    assert listed == {file.parent for top in tops for file in files_below(top)}
    assert all(name.partition(".")[0] == "atmo_jit" for name in PROJECT["tool"]["setuptools"]["packages"])


def test_every_data_file_is_installed():
    settings = PROJECT["tool"]["setuptools"]
    for package in settings["packages"]:
        folder = folder_of(package)
        kept = {file for pattern in settings["package-data"].get(package, ()) for file in folder.glob(pattern)}
        assert {file for file in files_below(folder) if file.parent == folder and file.suffix != ".py"} == kept


def test_the_readme_starts_with_two_complete_commands():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    commands = re.findall(r"^ +(python3 -m venv .*)$", readme, re.MULTILINE)
    assert len(commands) == 2
    assert "atmo-jit render" in commands[0] and "--out" in commands[0] and commands[1].endswith("pytest")
    assert readme.index(commands[1]) < 600


def test_the_readmes_accuracy_is_what_was_measured():
    tables = [
        [
            line
            for line in (ROOT / name).read_text(encoding="utf-8").splitlines()
            if line.startswith(("| single", "| all"))
        ]
        for name in ("README.md", "docs/accuracy.md")
    ]
    assert len(tables[0]) == 5 and tables[0] == tables[1][:5]
