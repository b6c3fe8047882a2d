"""Fixtures for the Mitsuba plugins: the variant, and emitters that are loaded once."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parent))  # emitters.py, beside the tests

mi = pytest.importorskip("mitsuba")


@pytest.fixture(scope="session")
def plugins() -> Any:
    """The registered package of plugins."""
    import atmo_jit.plugins

    atmo_jit.plugins.register()
    return atmo_jit.plugins


@pytest.fixture
def rgb(plugins: Any) -> None:
    """The variant in which most tests run."""
    mi.set_variant("llvm_ad_rgb")


@cache
def _load(variant: str, elevation_deg: float, options: tuple[tuple[str, Any], ...]) -> Any:
    from emitters import sun

    return mi.load_dict({"type": "atmosphere", "sun_direction": sun(elevation_deg), **dict(options)})


@pytest.fixture
def emitter(rgb: None) -> Callable[..., Any]:
    """``emitter(elevation_deg, **parameters)``: loaded once in a session, so tests must not change it."""

    def load(elevation_deg: float, **options: Any) -> Any:
        return _load(mi.variant(), elevation_deg, tuple(sorted(options.items())))

    return load
