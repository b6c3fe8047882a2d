"""Path-traced pictures against stored ones (``python tests/pictures.py`` makes them again)."""

from __future__ import annotations

import pytest
from pictures import PICTURES, assert_as_stored

mi = pytest.importorskip("mitsuba")


@pytest.mark.parametrize("name", PICTURES)
def test_picture_is_as_stored(rgb, name):
    assert_as_stored(name)


def test_both_integrators_agree(rgb):
    assert_as_stored("earth_ground_sun30", "volpathmis")


@pytest.mark.slow
def test_scalar_variant_agrees(plugins):
    mi.set_variant("scalar_rgb")
    # One pass of 64 samples has tails that a normal distribution lacks; the mean of six has lost them.
    assert_as_stored("earth_ground_sun30", passes=6)
