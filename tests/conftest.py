"""Fixtures that all tests share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

import atmo_jit  # noqa: F401 - first of all: it chooses the LLVM library before anything imports Dr.Jit


@pytest.fixture(scope="session")
def reference() -> Path:
    """The folder of reference data: ATMO_JIT_REFERENCE, else ../shared/reference beside the repository."""
    named = os.environ.get("ATMO_JIT_REFERENCE")
    folder = Path(named) if named else Path(__file__).parents[2] / "shared" / "reference"
    if not folder.is_dir():
        pytest.skip(f"no reference data: {folder} is not a folder (set ATMO_JIT_REFERENCE to where they are)")
    return folder


@pytest.fixture
def earth() -> dict:
    """The description of the preset ``earth``, free to be changed."""
    return atmo_jit.presets.read("earth")
