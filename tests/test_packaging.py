"""pyproject.toml agrees with the tree, and the README with the package."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

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


def test_the_oldest_versions_are_those_of_the_project():
    text = (ROOT / ".ci" / "oldest.txt").read_text(encoding="utf-8")
    pinned = dict(re.findall(r"^([\w-]+)==([\d.]+)$", text, re.M))
    project = PROJECT["project"]
    wanted = project["dependencies"] + project["optional-dependencies"]["test"]
    bounds = dict(re.match(r"([\w-]+)>=([\d.]+)", requirement).groups() for requirement in wanted)
    assert pinned.keys() - bounds.keys() == {"jaxlib"} and bounds.keys() <= pinned.keys()
    for name, bound in bounds.items():
        assert pinned[name] == bound or pinned[name].startswith(f"{bound}."), name


def test_every_data_file_is_installed():
    settings = PROJECT["tool"]["setuptools"]
    for package in settings["packages"]:
        folder = folder_of(package)
        kept = {file for pattern in settings["package-data"].get(package, ()) for file in folder.glob(pattern)}
        assert {file for file in files_below(folder) if file.parent == folder and file.suffix != ".py"} == kept


IMPORT = """
import importlib, sys
import atmo_jit
if sys.argv[1:]:
    import mitsuba as mi
    mi.set_variant("llvm_ad_rgb")
for name in sys.argv[1:]:
    importlib.import_module(name)
"""


@pytest.mark.parametrize("everything", [False, True])
def test_imports_warn_of_nothing(everything):
    """The package alone, as its users import it, and every module."""
    packages = PROJECT["tool"]["setuptools"]["packages"] if everything else []
    modules = [f"{name}.{file.stem}" for name in packages for file in sorted(folder_of(name).glob("*.py"))]
    modules = [name.removesuffix(".__init__") for name in modules if not name.endswith("__main__")]
    assert not everything or len(modules) > 100
    done = subprocess.run([sys.executable, "-W", "error", "-c", IMPORT, *modules], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


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
