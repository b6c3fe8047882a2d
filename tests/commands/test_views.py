"""Views: what is accepted, what is refused, and that a refusal names the array, the value and its index in one line."""

from __future__ import annotations

import numpy as np
import pytest

from atmo_jit.errors import InputError
from atmo_jit.views import check_views, load_views


def good(**changes):
    views = {
        "altitude_m": [0.0, 10.0, 1e7],
        "sun_zenith_deg": [0.0, 90.0, 180.0],
        "view_zenith_deg": [180.0, 90.0, 0.0],
        "azimuth_deg": [-720.0, 0.0, 359.0],
    }
    return {name: value for name, value in {**views, **changes}.items() if value is not ...}


def test_good_views_come_back_as_fresh_float64_arrays():
    given = good(altitude_m=np.array([0, 10, 20], dtype=np.int16))
    views = check_views(given)
    assert list(views) == ["altitude_m", "sun_zenith_deg", "view_zenith_deg", "azimuth_deg"]
    assert all(values.dtype == np.float64 and values.shape == (3,) for values in views.values())
    assert np.array_equal(views["altitude_m"], [0, 10, 20])
    assert not np.shares_memory(views["altitude_m"], given["altitude_m"])


def test_numbers_broadcast_in_python():
    views = check_views(good(altitude_m=5, azimuth_deg=np.float32(90)))
    assert np.array_equal(views["altitude_m"], [5, 5, 5])
    assert np.array_equal(views["azimuth_deg"], [90, 90, 90])
    one = check_views({"altitude_m": 0, "sun_zenith_deg": 1, "view_zenith_deg": 2, "azimuth_deg": 3})
    assert all(values.shape == (1,) for values in one.values())


def test_distance_is_optional_and_may_be_infinite():
    assert "distance_m" not in check_views(good(distance_m=None))
    assert np.array_equal(check_views(good(distance_m=[0, 1e3, np.inf]))["distance_m"], [0, 1e3, np.inf])


def test_rounding_past_a_limit_is_put_back_on_it():
    pi_in_single_precision = np.degrees(np.float64(np.float32(np.pi)))
    assert pi_in_single_precision > 180
    views = check_views(good(view_zenith_deg=[pi_in_single_precision, -1e-5, 0.0]))
    assert np.array_equal(views["view_zenith_deg"], [180, 0, 0])


REFUSED = {
    "negative altitude": (dict(altitude_m=[0, -1, 2]), "altitude_m[1] is -1.0; allowed are numbers from 0 to 1e+30"),
    "NaN altitude": (dict(altitude_m=[0, np.nan, 2]), "altitude_m[1] is nan;"),
    "altitude beyond single precision": (dict(altitude_m=[0, 1, 1e300]), "altitude_m[2] is 1e+300;"),
    "infinite altitude": (dict(altitude_m=[0, 1, np.inf]), "altitude_m[2] is inf;"),
    "sun zenith": (dict(sun_zenith_deg=[0, 180.001, 0]), "sun_zenith_deg[1] is 180.001; allowed are numbers"),
    "negative view zenith": (dict(view_zenith_deg=[-0.5, 0, 0]), "view_zenith_deg[0] is -0.5;"),
    "NaN view zenith": (dict(view_zenith_deg=[0, 0, np.nan]), "view_zenith_deg[2] is nan;"),
    "infinite azimuth": (dict(azimuth_deg=[0, -np.inf, 0]), "azimuth_deg[1] is -inf; allowed are finite numbers"),
    "negative distance": (dict(distance_m=[1, 2, -3]), "distance_m[2] is -3.0; allowed are numbers >= 0"),
    "minus infinite distance": (dict(distance_m=[1, 2, -np.inf]), "distance_m[2] is -inf;"),
    "NaN distance": (dict(distance_m=[np.nan, 2, 3]), "distance_m[0] is nan;"),
    "missing": (dict(azimuth_deg=...), "array azimuth_deg is missing; needed are altitude_m, sun_zenith_deg,"),
    "unknown": (dict(azimut_deg=[0, 0, 0]), "unknown array 'azimut_deg'; allowed are altitude_m,"),
    "length": (dict(azimuth_deg=[0, 0]), "azimuth_deg has 2 values but altitude_m has 3; all must have"),
    "one is not three": (dict(azimuth_deg=[0]), "azimuth_deg has 1 values but altitude_m has 3;"),
    "two axes": (dict(azimuth_deg=[[0, 1, 2]]), "azimuth_deg has shape (1, 3); must be a 1-D array"),
    "text": (dict(azimuth_deg=["0", "1", "2"]), "azimuth_deg holds text; must be a 1-D array of real numbers"),
    "bool": (dict(azimuth_deg=[True, False, True]), "azimuth_deg holds true/false values;"),
    "complex": (dict(azimuth_deg=[0, 1j, 0]), "azimuth_deg holds complex numbers;"),
    "ragged": (dict(azimuth_deg=[[0, 1], [2]]), "azimuth_deg is not an array of numbers;"),
    "none": (dict(azimuth_deg=None), "azimuth_deg holds Python objects;"),
}


@pytest.mark.parametrize(("changes", "message"), REFUSED.values(), ids=REFUSED.keys())
def test_refused(changes, message):
    with pytest.raises(InputError) as error:
        check_views(good(**changes))
    assert message in str(error.value)
    assert str(error.value).startswith("views: ")
    assert "\n" not in str(error.value)


def test_no_views():
    with pytest.raises(InputError, match="views: the arrays are empty; must hold at least one view"):
        check_views({name: [] for name in good()})


def test_not_a_mapping():
    with pytest.raises(InputError, match="views: is list, must be a mapping"):
        check_views([1, 2, 3])


def test_file_round_trip_and_its_name_in_messages(tmp_path):
    path = tmp_path / "views.npz"
    np.savez(path, **good())
    assert np.array_equal(load_views(path)["view_zenith_deg"], good()["view_zenith_deg"])
    assert np.array_equal(load_views(path)["azimuth_deg"], [0.0, 0.0, 359.0])  # whole turns are left out
    np.savez(path, **good(altitude_m=[0, -1, 2]))
    with pytest.raises(InputError, match=r"views\.npz: altitude_m\[1\] is -1"):
        load_views(path)


def test_numbers_do_not_broadcast_in_a_file(tmp_path):
    path = tmp_path / "views.npz"
    np.savez(path, **good(altitude_m=5.0))
    with pytest.raises(InputError, match=r"altitude_m has shape \(\); must be a 1-D array"):
        load_views(path)


def test_whole_turns_of_azimuth_are_left_out():
    """In single precision 1e300 degrees are infinite, and the cosine of that NaN."""
    turns = [-1e300, 1e20, -450.0, -90.0, 360.0, 3690.0]
    found = check_views({**good(), "altitude_m": 0, "sun_zenith_deg": 0, "view_zenith_deg": 0, "azimuth_deg": turns})
    assert found["azimuth_deg"].tolist() == [np.fmod(-1e300, 360.0), np.fmod(1e20, 360.0), -90.0, -90.0, 360.0, 90.0]
