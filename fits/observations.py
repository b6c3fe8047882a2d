"""Measured sky radiance: what a fit is given, from NPZ and CSV files (pictures: :mod:`atmo_jit.fits.pictures`).

=====================  ===================  =================================================================
array                  shape                meaning
=====================  ===================  =================================================================
``radiance``           [N, W], or [N]       W m^-2 sr^-1 nm^-1 (1/sr for a solar irradiance of 1); NaN: no sample
``sigma``              [N, W]               its standard deviation, in the same unit, or
``relative_sigma``     a number or [N, W]   the same over the radiance
``wavelengths_nm``     [W]
``altitude_m``         [N] or a number      of the observer
``sun_zenith_deg``     [N] or a number
``view_zenith_deg``    [N]
``azimuth_deg``        [N]                  of the view minus that of the sun, or
``sun_azimuth_deg``,   [N]                  clockwise from north
``view_azimuth_deg``
``scan``               [N], optional        whole numbers: samples of one scan share its nuisance parameters
``mask``               [N] or [N, W],       true: use
                       optional
=====================  ===================  =================================================================

CSV: the same names as columns (``wavelength_nm`` or ``wavelengths_nm``), one row for each sample and wavelength; an
empty cell or ``nan`` is no sample. Lines that begin with # are skipped.
"""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from atmo_jit.errors import InputError, shown
from atmo_jit.files import read_npz
from atmo_jit.views import check_views

PLACES = ("altitude_m", "sun_zenith_deg", "view_zenith_deg")
AZIMUTHS = ("azimuth_deg", "sun_azimuth_deg", "view_azimuth_deg")
NAMES = ("radiance", "sigma", "relative_sigma", "wavelengths_nm", *PLACES, *AZIMUTHS, "scan", "mask")
DEFAULT_RELATIVE_SIGMA = 0.01
CSV_LIMIT = 2**28
CELLS_LIMIT = 2**26  # samples times wavelengths of a CSV, which may name a wavelength of its own in every row
WAVELENGTHS_NM = (100.0, 1e5)  # below, they are in micrometres


@dataclass(frozen=True)
class Observations:
    """Checked observations: ``radiance``, ``sigma`` [N, C], float64, NaN where there is no sample; ``mask`` [N, C],
    true where it is to be used; ``sun_zenith``, ``view_zenith``, ``azimuth`` (of the view minus that of the sun),
    radians [N]; ``altitude_m`` [N]; ``scan`` [N], 0 to scans - 1; ``wavelengths_nm`` [W].

    ``mixing`` [C, W]: channels of a picture as sums over wavelengths; None: channels are wavelengths. ``sun_azimuth``
    [N]: radians clockwise from north where it is known, else None. ``rows`` [N]: which of the samples given they are.
    """

    radiance: np.ndarray
    sigma: np.ndarray
    wavelengths_nm: np.ndarray
    altitude_m: np.ndarray
    sun_zenith: np.ndarray
    view_zenith: np.ndarray
    azimuth: np.ndarray
    scan: np.ndarray
    mask: np.ndarray
    mixing: np.ndarray | None = None
    sun_azimuth: np.ndarray | None = None
    rows: np.ndarray | None = None
    unused: tuple[str, ...] = ()

    @property
    def used(self) -> np.ndarray:
        """Which samples take part: bool [N, C]."""
        return self.mask & np.isfinite(self.radiance)

    @property
    def scans(self) -> int:
        """Number of scans."""
        return int(self.scan.max()) + 1

    def part(self, rows: np.ndarray) -> Observations:
        """Some of the samples; all scans are kept."""
        arrays = ("radiance", "sigma", "altitude_m", "sun_zenith", "view_zenith", "azimuth", "scan", "mask")
        changed = {name: getattr(self, name)[rows] for name in arrays}
        changed["rows"] = self.rows[rows]
        changed["sun_azimuth"] = None if self.sun_azimuth is None else self.sun_azimuth[rows]
        return replace(self, **changed)

    def channels(self, which: np.ndarray) -> Observations:
        """Some of the wavelengths."""
        arrays = {name: getattr(self, name)[:, which] for name in ("radiance", "sigma", "mask")}
        return replace(self, **arrays, wavelengths_nm=self.wavelengths_nm[which])


def observations(arrays: Mapping[str, Any], where: str = "observations", *, mixing: Any = None) -> Observations:
    """Observations from the arrays of the table above; rows without a sample are dropped.

    ``mixing`` [C, W]: channels of the radiance as sums over wavelengths. Raises InputError, naming the array, for one
    that is missing, of the wrong shape or kind, or has values that are not allowed, and when no sample is left.
    """
    for name in ("radiance", "wavelengths_nm", *PLACES):
        if name not in arrays:
            raise InputError(f"{where}: {name} is missing; needed are radiance, wavelengths_nm, {', '.join(PLACES)}")
    nm = _numbers(arrays["wavelengths_nm"], "wavelengths_nm", where)
    nm = np.atleast_1d(nm)
    if nm.ndim != 1 or not len(nm) or not np.all((nm >= WAVELENGTHS_NM[0]) & (nm <= WAVELENGTHS_NM[1])):
        allowed = f"a list of numbers from {WAVELENGTHS_NM[0]:g} to {WAVELENGTHS_NM[1]:g}, nanometres"
        raise InputError(f"{where}: wavelengths_nm is {shown(nm.tolist())}; must be {allowed}")
    channels = len(nm) if mixing is None else len(mixing)
    radiance = _numbers(arrays["radiance"], "radiance", where)
    if radiance.ndim == 1 and channels == 1:
        radiance = radiance[:, None]
    if radiance.ndim != 2 or radiance.shape[1] != channels:
        raise InputError(
            f"{where}: radiance has shape {radiance.shape}; must be [N, {channels}] for {channels} "
            + ("wavelengths" if mixing is None else "channels")
        )
    count = len(radiance)
    mask = _mask(arrays.get("mask"), radiance.shape, where)
    if not np.isfinite(radiance[mask]).any():
        raise InputError(f"{where}: radiance holds no number that is not masked; at least one sample is needed")
    if np.isinf(radiance).any():
        raise InputError(f"{where}: radiance is infinite at {shown(_first(np.isinf(radiance)))}; NaN means no sample")
    if not np.any(radiance > 0.0):
        raise InputError(f"{where}: radiance is nowhere > 0; must be in W m^-2 sr^-1 nm^-1")
    sigma = _sigma(arrays, radiance, mask, where)
    places = {name: _column(arrays[name], name, count, where) for name in PLACES}
    sun_azimuth = None
    if "azimuth_deg" in arrays:
        azimuth = _column(arrays["azimuth_deg"], "azimuth_deg", count, where)
    elif "sun_azimuth_deg" in arrays and "view_azimuth_deg" in arrays:
        sun_azimuth = _column(arrays["sun_azimuth_deg"], "sun_azimuth_deg", count, where)
        azimuth = _column(arrays["view_azimuth_deg"], "view_azimuth_deg", count, where) - sun_azimuth
    else:
        raise InputError(f"{where}: azimuth_deg is missing; needed is it, or sun_azimuth_deg with view_azimuth_deg")
    keep = np.isfinite(radiance).any(axis=1)
    views = check_views({name: v[keep] for name, v in places.items()} | {"azimuth_deg": azimuth[keep]}, where=where)
    return Observations(
        radiance[keep],
        sigma[keep],
        nm,
        views["altitude_m"],
        *(np.radians(views[name]) for name in ("sun_zenith_deg", "view_zenith_deg", "azimuth_deg")),
        _scan(arrays.get("scan"), count, where)[keep],
        mask[keep],
        None if mixing is None else np.asarray(mixing, float),
        None if sun_azimuth is None else np.radians(sun_azimuth[keep]),
        np.flatnonzero(keep),
        tuple(sorted(set(arrays) - set(NAMES))),
    )


def load_observations(path: str | Path) -> Observations:
    """The observations of an NPZ or CSV file. Raises InputError for a file that cannot be used."""
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".npz":
        return observations(read_npz(path, kinds="biufU"), str(path))
    if suffix == ".csv":
        return observations(_read_csv(path), str(path))
    raise InputError(f"observations {shown(str(path), 200)}: the name must end in .npz, .csv or .exr")


def _sigma(arrays: Mapping[str, Any], radiance: np.ndarray, mask: np.ndarray, where: str) -> np.ndarray:
    if "sigma" in arrays and "relative_sigma" in arrays:
        raise InputError(f"{where}: sigma and relative_sigma are both there; must be one of them")
    name = "sigma" if "sigma" in arrays else "relative_sigma"
    given = _numbers(arrays.get(name, DEFAULT_RELATIVE_SIGMA), name, where)
    if given.ndim == 1 and len(given) == len(radiance) != radiance.shape[1]:
        given = given[:, None]
    try:
        given = np.broadcast_to(given, radiance.shape)
    except ValueError:
        allowed = f"{list(radiance.shape)} or a number"
        raise InputError(f"{where}: {name} has shape {given.shape}; must be {allowed}") from None
    bad = mask & np.isfinite(radiance) & ~((given > 0.0) & np.isfinite(given))
    if bad.any():
        raise InputError(f"{where}: {name}{list(_first(bad))} is {given[bad][0]:g}; must be a finite number > 0")
    if name == "sigma":
        return np.array(given)
    # Dark samples are not known without limit, and of one that is not above 0 a relative error says nothing.
    median = np.nanmedian(radiance[radiance > 0.0])
    return given * np.where(radiance > 0.0, np.maximum(radiance, 1e-3 * median), median)


def _mask(mask: Any, shape: tuple[int, ...], where: str) -> np.ndarray:
    if mask is None:
        return np.ones(shape, bool)
    mask = _numbers(mask, "mask", where) != 0.0
    if mask.ndim == 1 and len(mask) == shape[0]:
        mask = mask[:, None]
    if mask.ndim != 2 or mask.shape[0] != shape[0] or mask.shape[1] not in (1, shape[1]):
        raise InputError(f"{where}: mask has shape {mask.shape}; must be [{shape[0]}] or {list(shape)}")
    return np.broadcast_to(mask, shape)


def _scan(scan: Any, count: int, where: str) -> np.ndarray:
    if scan is None:
        return np.zeros(count, int)
    scan = _column(scan, "scan", count, where)
    whole = np.isfinite(scan) & (scan == np.round(scan))
    if not whole.all():
        raise InputError(f"{where}: scan holds {scan[~whole][0]:g}; must be whole numbers")
    return np.unique(scan, return_inverse=True)[1].ravel()


def _column(values: Any, name: str, count: int, where: str) -> np.ndarray:
    array = _numbers(values, name, where)
    if array.ndim == 0 or array.shape == (1,):
        return np.full(count, float(array.reshape(-1)[0]))
    if array.shape != (count,):
        raise InputError(f"{where}: {name} has shape {array.shape} but radiance has {count} rows; must have [{count}]")
    return array


def _numbers(values: Any, name: str, where: str) -> np.ndarray:
    array = np.asarray(values)
    if array.dtype.kind not in "biuf":
        raise InputError(f"{where}: {name} is not an array of numbers")
    return array.astype(float)


def _first(found: np.ndarray) -> tuple[int, ...]:
    return tuple(int(i) for i in np.argwhere(found)[0])


def _read_csv(path: Path) -> dict[str, Any]:
    """The columns of a CSV as arrays, radiance and what belongs to it as [N, W]."""
    name = shown(str(path), 200)
    try:
        with open(path, "rb") as stream:
            raw = stream.read(CSV_LIMIT + 1)
        if len(raw) > CSV_LIMIT:
            raise InputError(f"{name}: the file is larger than {CSV_LIMIT} bytes")
        text = raw.decode("utf-8-sig")
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8"
        raise InputError(f"{name}: cannot be read ({reason})") from None
    lines = [(i, line) for i, line in enumerate(text.splitlines(), 1) if line.strip() and not line.startswith("#")]
    try:
        rows = list(csv.reader(line for _, line in lines))
    except csv.Error as error:
        raise InputError(f"{name}: is not CSV ({shown(str(error), 100)})") from None
    if len(rows) != len(lines):
        raise InputError(f"{name}: has a quote without an end in its line")
    if len(rows) < 2:
        raise InputError(f"{name}: holds no samples; must have a line of names and a line for each sample")
    header = [column.strip() for column in rows[0]]
    header = ["wavelengths_nm" if column == "wavelength_nm" else column for column in header]
    repeated = next((column for column, count in Counter(header).items() if count > 1), None)
    if repeated is not None:
        raise InputError(f"{name}: column {shown(repeated)} is there twice")
    table = {}
    for (number, _), row in zip(lines[1:], rows[1:], strict=True):
        if len(row) != len(header):
            raise InputError(f"{name}: line {number} has {len(row)} values but there are {len(header)} columns")
    numbers = [number for number, _ in lines[1:]]
    for j, column in enumerate(header):
        if column in NAMES:
            cells = [_cell(row[j], column, number, name) for number, row in zip(numbers, rows[1:], strict=True)]
            table[column] = np.array(cells)
    return _wide(table, name) | {column: 0 for column in header if column not in NAMES}


def _cell(text: str, column: str, line: int, name: str) -> float:
    text = text.strip()
    if column == "mask" and text.lower() in ("true", "false"):
        return float(text.lower() == "true")
    try:
        return float(text) if text else np.nan
    except ValueError:
        raise InputError(f"{name}: {column} in line {line} is {shown(text)}; must be a number") from None


def _wide(table: dict[str, np.ndarray], name: str) -> dict[str, Any]:
    """Rows of a sample and wavelength as rows of a sample."""
    if "wavelengths_nm" not in table or "radiance" not in table:
        missing = "radiance" if "wavelengths_nm" in table else "wavelength_nm"
        raise InputError(f"{name}: column {missing} is missing")
    nm, channel = np.unique(table["wavelengths_nm"], return_inverse=True)
    keys = [column for column in (*PLACES, *AZIMUTHS, "scan") if column in table]
    if not keys:
        raise InputError(f"{name}: column view_zenith_deg is missing; needed are {', '.join(PLACES)}")
    samples, first, row = np.unique(
        np.stack([table[key] for key in keys], axis=1), axis=0, return_index=True, return_inverse=True, equal_nan=True
    )
    arrays: dict[str, Any] = {key: samples[:, i] for i, key in enumerate(keys)} | {"wavelengths_nm": nm}
    row = row.ravel()
    pairs = row * len(nm) + channel
    repeat = _repeats(pairs)
    if repeat.any():  # repeated measurements are samples of their own
        row = np.unique(row * (repeat.max() + 1) + repeat, return_inverse=True)[1].ravel()
        first = np.unique(row, return_index=True)[1]
        arrays |= {key: table[key][first] for key in keys}
    if len(first) * len(nm) > CELLS_LIMIT:
        raise InputError(
            f"{name}: has {len(first)} samples and {len(nm)} wavelengths; must be at most {CELLS_LIMIT} pairs of them"
        )
    for column in ("radiance", "sigma", "relative_sigma", "mask"):
        if column in table:
            arrays[column] = np.full((len(first), len(nm)), 0.0 if column == "mask" else np.nan)
            arrays[column][row, channel] = table[column]
    return arrays


def _repeats(values: np.ndarray) -> np.ndarray:
    """How often the same value was there before, for each."""
    order = np.argsort(values, kind="stable")
    ordered, places = values[order], np.arange(len(values))
    starts = np.r_[True, ordered[1:] != ordered[:-1]]
    found = np.empty(len(values), int)
    found[order] = places - np.maximum.accumulate(np.where(starts, places, 0))
    return found
