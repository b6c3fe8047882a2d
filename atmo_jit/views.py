"""Lists of views: where an observer stands, where it looks, where the sun is.

    views = check_views({"altitude_m": 0, "sun_zenith_deg": 60, "view_zenith_deg": [0, 45, 89], "azimuth_deg": 90})
    views = load_views("views.npz")

Both return a plain dict of float64 arrays [N], in the units that the names carry, every value inside its range:

==================  =======================  ==================================================================
array               allowed                  meaning
==================  =======================  ==================================================================
``altitude_m``      0 to 1e30                height of the observer above the planet's surface
``sun_zenith_deg``  0 to 180                 angle between the zenith and the sun at the observer
``view_zenith_deg`` 0 to 180                 angle between the zenith and the view ray at the observer
``azimuth_deg``     finite                   view azimuth minus sun azimuth, 0 = towards the sun; any turn, any sign
``distance_m``      >= 0 or inf, optional    the ray stops here; inf = it runs on to the ground or out of the air
==================  =======================  ==================================================================

Angles that leave 0 to 180 by less than ``ANGLE_SLACK_DEG`` come from rounding (pi in single precision is 180.000005
degrees) and are put back on the limit; everything else outside the table is an ``InputError`` that names the array, the
value, its index and what is allowed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from atmo_jit.errors import InputError
from atmo_jit.files import read_npz

# Single-precision radians turned into degrees are off by up to 1.5e-5; a real mistake is never this small.
ANGLE_SLACK_DEG = 1e-4
FARTHEST_M = 1e30  # squares of it still fit into double precision, and it into single


@dataclass(frozen=True)
class _Range:
    """What one array may hold: low <= value <= high, infinity only where ``infinite``; ``text`` says so in words."""

    low: float
    high: float
    text: str
    infinite: bool = False
    slack: float = 0.0


_RANGES = {
    "altitude_m": _Range(0.0, FARTHEST_M, f"numbers from 0 to {FARTHEST_M:g}"),
    "sun_zenith_deg": _Range(0.0, 180.0, "numbers from 0 to 180", slack=ANGLE_SLACK_DEG),
    "view_zenith_deg": _Range(0.0, 180.0, "numbers from 0 to 180", slack=ANGLE_SLACK_DEG),
    "azimuth_deg": _Range(-np.inf, np.inf, "finite numbers"),
    "distance_m": _Range(0.0, np.inf, "numbers >= 0 (inf: no stop)", infinite=True),
}
OPTIONAL = ("distance_m",)
REQUIRED = tuple(name for name in _RANGES if name not in OPTIONAL)


def check_views(
    views: Mapping[str, ArrayLike], *, broadcast: bool = True, where: str = "views"
) -> dict[str, np.ndarray]:
    """Views as float64 arrays [N] that keep to the table above.

    views: mapping from the names above to 1-D arrays of one length N; with ``broadcast`` a plain number stands for all
        N values (all numbers: N = 1). N is at least 1.
    where: what to call the mapping in messages.
    Raises InputError for a missing or unknown name, a wrong kind or shape of array, unequal lengths, or a value that is
    not allowed.
    """
    if not isinstance(views, Mapping):
        raise InputError(f"{where}: is {type(views).__name__}, must be a mapping with the arrays {', '.join(REQUIRED)}")
    unknown = sorted(str(name) for name in views if name not in _RANGES)
    if unknown:
        raise InputError(f"{where}: unknown array {unknown[0]!r}; allowed are {', '.join(_RANGES)}")
    missing = [name for name in REQUIRED if name not in views]
    if missing:
        raise InputError(f"{where}: array {missing[0]} is missing; needed are {', '.join(REQUIRED)}")

    arrays = {
        name: _numeric(views[name], name, where, broadcast)
        for name in _RANGES
        if name in views and not (name in OPTIONAL and views[name] is None)
    }
    lengths = {name: len(values) for name, values in arrays.items() if values.ndim == 1}
    count = next(iter(lengths.values()), 1)
    for name, length in lengths.items():
        if length != count:
            first = next(iter(lengths))
            raise InputError(
                f"{where}: {name} has {length} values but {first} has {count}; all must have the same length"
            )
    if count == 0:
        raise InputError(f"{where}: the arrays are empty; must hold at least one view")
    return {name: _in_range(np.broadcast_to(values, (count,)), name, where) for name, values in arrays.items()}


def load_views(path: str | Path) -> dict[str, np.ndarray]:
    """The views in an NPZ file; see ``check_views``, numbers do not broadcast here.

    Raises InputError when the file is missing, is no NPZ, or holds anything that ``check_views`` refuses.
    """
    return check_views(read_npz(path), broadcast=False, where=str(path))


def _numeric(values: ArrayLike, name: str, where: str, broadcast: bool) -> np.ndarray:
    """``values`` as a float64 array with 0 or 1 axes."""
    try:
        array = np.asarray(values)
    except (ValueError, TypeError):  # a ragged list
        raise InputError(f"{where}: {name} is not an array of numbers; must be 1-D, of real numbers") from None
    if array.dtype.kind not in "iuf":
        raise InputError(f"{where}: {name} holds {_kind(array.dtype)}; must be a 1-D array of real numbers")
    if array.ndim > 1 or (array.ndim == 0 and not broadcast):
        raise InputError(f"{where}: {name} has shape {array.shape}; must be a 1-D array of real numbers")
    return array.astype(np.float64)


def _kind(dtype: np.dtype) -> str:
    names = {"b": "true/false values", "c": "complex numbers", "U": "text", "S": "text", "O": "Python objects"}
    return names.get(dtype.kind, f"values of type {dtype}")


def _in_range(values: np.ndarray, name: str, where: str) -> np.ndarray:
    """``values`` [N] if all are allowed, rounding past a limit undone. Raises InputError for the first that is not."""
    allowed = _RANGES[name]
    finite = np.isfinite(values)
    inside = finite & (values >= allowed.low - allowed.slack) & (values <= allowed.high + allowed.slack)
    if allowed.infinite:
        inside |= values == np.inf
    if not inside.all():
        index = int(np.argmin(inside))
        raise InputError(f"{where}: {name}[{index}] is {float(values[index])!r}; allowed are {allowed.text}")
    if name == "azimuth_deg":  # whole turns, exactly, which radians in single precision cannot leave out
        values = np.where(np.abs(values) > 360.0, np.fmod(values, 360.0), values)
    return np.clip(values, allowed.low, allowed.high) + 0.0  # + 0.0: a fresh array, and -0 becomes 0


def side_by_side(radius_m: float, thickness_m: float, altitude_m: np.ndarray, view_zenith: np.ndarray) -> np.ndarray:
    """Order [N] in which rays with paths of a kind are neighbours: those that end on the ground, those that pass their
    perigee, and those that rise, each by its lowest or highest altitude.

    A vector of the processor marches eight rays or more and is done when the last of them is; in random order that
    takes twice as long. ``view_zenith`` in radians.
    """
    r = radius_m + altitude_m
    falls = view_zenith > 0.5 * np.pi
    perigee = r * np.sin(view_zenith) - radius_m
    within = np.clip(altitude_m, 0.0, thickness_m) / thickness_m
    key = np.where(falls, np.where(perigee <= 0.0, within, 2.0 + perigee / thickness_m), -1.0 - within)
    return np.argsort(key, kind="stable")
