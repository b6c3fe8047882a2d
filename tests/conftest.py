"""Fixtures that all tests share."""

from __future__ import annotations

import os
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import pytest

import atmo_jit  # first of all: it chooses the LLVM library before anything imports Dr.Jit

ROOT = Path(__file__).parents[1]
WORKERS = 4  # at most: each takes 1 to 2 GiB and compiles or loads the same kernels


def _import_bench() -> None:
    """Make the folder bench/ importable, which is not installed.

    The repository's root stays off the path: the `atmo_jit` there is not the one that is installed.
    """
    folder = ROOT / "bench"
    spec = spec_from_file_location("bench", folder / "__init__.py", submodule_search_locations=[str(folder)])
    sys.modules["bench"] = module_from_spec(spec)
    spec.loader.exec_module(sys.modules["bench"])


_import_bench()


@pytest.hookimpl(tryfirst=True)
def pytest_cmdline_main(config: pytest.Config) -> None:
    """Several tests at once, where `-n` does not say otherwise and pytest-xdist is there: most of what takes long,
    Python and compiling kernels, runs on one processor. Alone run: a few tests (`-k`, `file::test`), for which workers
    would take longer to start; a debugger; and what measures speed.
    """
    option = config.option
    if hasattr(config, "workerinput") or not config.pluginmanager.hasplugin("xdist") or option.numprocesses is not None:
        return
    few = bool(option.keyword) or any("::" in arg for arg in config.args)
    alone = few or option.usepdb or option.collectonly or option.markexpr == "bench"
    workers = 1 if alone else min(WORKERS, _processors())
    if workers > 1:
        option.numprocesses = workers
        if option.dist == "no":
            option.dist = "worksteal"


def pytest_configure(config: pytest.Config) -> None:
    """Each worker's kernels take its share of the processors; Dr.Jit's take all. Not one: see `plugins.register`."""
    if hasattr(config, "workerinput"):
        import drjit as dr

        dr.set_thread_count(max(2, dr.thread_count() // config.workerinput["workercount"]))


def _processors() -> int:
    """Those that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@pytest.fixture(scope="session")
def reference() -> Path:
    """The folder of reference data: ATMO_JIT_REFERENCE, else ../shared/reference beside the repository."""
    named = os.environ.get("ATMO_JIT_REFERENCE")
    folder = Path(named) if named else ROOT.parent / "shared" / "reference"
    if not folder.is_dir():
        pytest.skip(f"no reference data: {folder} is not a folder (set ATMO_JIT_REFERENCE to where they are)")
    return folder


@pytest.fixture
def earth() -> dict:
    """The description of the preset ``earth``, free to be changed."""
    return atmo_jit.presets.read("earth")
