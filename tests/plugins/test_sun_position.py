"""The sun's place against Mitsuba's sunsky, and at a solstice, whose declination is known."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

# sunsky counts days in single precision: its steps of a quarter of a day move the sun by up to 0.05 degrees.
SUNSKY_DEG = 0.06

PLACES = [
    {},
    {"hour": 6.5},
    {"latitude": -33.9, "longitude": 18.4, "timezone": 2.0, "year": 2024, "month": 12, "day": 21, "hour": 12.0},
    {"latitude": 64.1, "longitude": -21.9, "timezone": 0.0, "year": 2015, "month": 6, "day": 21, "hour": 23.0},
    {"latitude": 0.0, "longitude": -78.5, "timezone": -5.0, "year": 2003, "month": 2, "day": 28, "minute": 59.0},
    {"latitude": 51.5, "longitude": 0.0, "timezone": 1.0, "year": 2020, "month": 1, "day": 31, "second": 30.0},
]


def angle_deg(a: np.ndarray, b: np.ndarray) -> float:
    """Angle between two unit vectors."""
    return float(np.degrees(2.0 * np.arcsin(min(np.linalg.norm(a - b) / 2.0, 1.0))))


@pytest.mark.parametrize("place", PLACES, ids=str)
def test_agrees_with_sunsky(rgb: None, place: dict) -> None:
    from atmo_jit.plugins.sun_position import Moment, sun_direction

    level = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)  # it warns of suns below the horizon
    theirs = np.array(mi.traverse(mi.load_dict({"type": "sunsky", **place}))["sun_direction"]).ravel()
    mi.set_log_level(level)
    assert angle_deg(np.array(sun_direction(Moment(**place))), theirs) < SUNSKY_DEG


def test_overhead_at_noon_on_the_tropic() -> None:
    # The June solstice of 2012 was on 20 June, 23:09 UTC, with a declination of 23.438 degrees: at that moment the sun
    # stood overhead at one longitude of that latitude.
    from atmo_jit.plugins.sun_position import Moment, sun_angles

    lowest = min(
        sun_angles(Moment(23.438, longitude, 0.0, 2012, 6, 20, 23.0, 9.0))[0]
        for longitude in np.arange(-180.0, 180.0, 0.02)
    )
    assert np.degrees(lowest) < 0.02
