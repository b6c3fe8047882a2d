"""Fixtures that all tests share."""

from __future__ import annotations

import os
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import pytest

import atmo_jit  # first of all: it chooses the LLVM library before anything imports Dr.Jit

ROOT = Path(__file__).parents[1]


def _import_bench() -> None:
    """Make the folder bench/ importable, which is not installed.

    The repository's root stays off the path: the `atmo_jit` there is not the one that is installed.
    """
    folder = ROOT / "bench"
    spec = spec_from_file_location("bench", folder / "__init__.py", submodule_search_locations=[str(folder)])
    sys.modules["bench"] = module_from_spec(spec)
    spec.loader.exec_module(sys.modules["bench"])


_import_bench()


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
