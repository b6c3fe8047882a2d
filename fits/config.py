"""What to fit and how: the TOML file of ``atmo-jit fit``.

    atmosphere = "earth"                # preset, JSON file, or a table with an atmosphere's keys
    residual = "log"                    # or "linear"
    robust = true
    tolerance = 0.01                    # relative error aimed at in the sky
    [fixed]                             # dotted names that get other values than in `atmosphere`
    "mie.scale_height_m" = 1500
    [free]                              # see atmo_jit.fits.parameters
    "mie.scattering_per_m" = { mode = "angstrom", start = 1e-5 }
    [nuisance]                          # of every scan; no sigma: no prior
    calibration = { sigma = 0.05 }      # factor by which the data are too bright
    spectral_calibration = { sigma = 0.03 }   # the same at every wavelength
    sun_azimuth = { sigma = 20 }        # degrees to add to that of the sun
    sun_zenith = { sigma = 3 }
    [picture]                           # see atmo_jit.fits.pictures
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from atmo_jit.atmosphere import Atmosphere
from atmo_jit.errors import InputError, shown
from atmo_jit.files import is_file

KEYS = ("atmosphere", "residual", "robust", "tolerance", "optimiser", "fixed", "free", "nuisance", "picture")
FREE_KEYS = ("mode", "start", "min", "max", "prior", "prior_sigma", "exponent")
NUISANCES = ("calibration", "spectral_calibration", "sun_azimuth", "sun_zenith")
NUISANCE_KEYS = ("sigma", "start", "min", "max")
OPTIMISERS = ("levenberg_marquardt", "lbfgsb")
SIZE_LIMIT = 2**20


@dataclass(frozen=True)
class FitConfig:
    """A checked configuration; ``free`` and ``nuisance`` as in the file."""

    atmosphere: Atmosphere
    free: Mapping[str, dict[str, Any]]
    nuisance: Mapping[str, dict[str, Any]] = field(default_factory=dict)
    residual: str = "log"
    robust: bool = True
    tolerance: float = 0.01
    optimiser: str = "levenberg_marquardt"
    picture: Mapping[str, Any] | None = None

    @classmethod
    def of(cls, document: Mapping[str, Any], where: str = "config", folder: Path | None = None) -> FitConfig:
        """The configuration of a parsed file. Raises InputError naming the key, the value and what is allowed."""
        _known(document, KEYS, where)
        source = document.get("atmosphere", "earth")
        if isinstance(source, str) and folder is not None and is_file(folder / source):
            source = folder / source
        atmosphere = Atmosphere.load(source)
        fixed = _table(document, "fixed", where)
        if fixed:
            atmosphere = atmosphere.replace(fixed)
        residual = document.get("residual", "log")
        if residual not in ("log", "linear"):
            raise InputError(f"{where}: residual is {shown(residual)}; must be log or linear")
        robust = document.get("robust", True)
        if not isinstance(robust, bool):
            raise InputError(f"{where}: robust is {shown(robust)}; must be true or false")
        tolerance = document.get("tolerance", 0.01)
        if isinstance(tolerance, bool) or not isinstance(tolerance, (int, float)) or not 0.0 < tolerance < 1.0:
            raise InputError(f"{where}: tolerance is {shown(tolerance)}; must be a number between 0 and 1")
        optimiser = document.get("optimiser", OPTIMISERS[0])
        if optimiser not in OPTIMISERS:
            raise InputError(f"{where}: optimiser is {shown(optimiser)}; must be one of {', '.join(OPTIMISERS)}")
        entries = _flat(_table(document, "free", where))
        free = {name: _entry(spec, FREE_KEYS, f"{where}: free.{name}") for name, spec in entries.items()}
        if not free:
            raise InputError(f"{where}: free is missing or empty; must name at least one value of the atmosphere")
        for name in free:
            if name.rpartition(".")[2] in ("wavelengths_nm", "bottom_radius_m", "top_radius_m"):
                raise InputError(f"{where}: free.{name}: cannot be fitted; coefficients, g, albedos and heights can")
        nuisance = _table(document, "nuisance", where)
        _known(nuisance, NUISANCES, f"{where}: nuisance")
        nuisance = {name: _entry(spec, NUISANCE_KEYS, f"{where}: nuisance.{name}") for name, spec in nuisance.items()}
        for name, spec in nuisance.items():
            for key, value in spec.items():
                number = isinstance(value, (int, float)) and not isinstance(value, bool)
                if not number or (key == "sigma" and not value > 0.0):
                    allowed = "a number > 0" if key == "sigma" else "a number"
                    raise InputError(f"{where}: nuisance.{name}: {key} is {shown(value)}; must be {allowed}")
        picture = document.get("picture")
        if picture is not None and not isinstance(picture, Mapping):
            raise InputError(f"{where}: picture is {shown(picture)}; must be a table")
        return cls(atmosphere, free, nuisance, residual, robust, float(tolerance), optimiser, picture)

    @classmethod
    def load(cls, path: str | Path) -> FitConfig:
        """The configuration of a TOML file; an atmosphere's JSON file is looked for beside it too."""
        path = Path(path)
        name = shown(str(path), 200)
        try:
            with open(path, "rb") as stream:
                raw = stream.read(SIZE_LIMIT + 1)
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
            raise InputError(f"config {name}: cannot be read ({reason})") from None
        if len(raw) > SIZE_LIMIT:
            raise InputError(f"config {name}: is larger than {SIZE_LIMIT} bytes")
        try:
            document = tomllib.loads(raw.decode("utf-8"))
        except (ValueError, RecursionError) as error:
            raise InputError(f"config {name}: is not TOML ({shown(str(error), 200)})") from None
        return cls.of(document, str(path), path.parent)


def _table(document: Mapping[str, Any], key: str, where: str) -> Mapping[str, Any]:
    table = document.get(key, {})
    if not isinstance(table, Mapping):
        raise InputError(f"{where}: {key} is {shown(table)}; must be a table")
    return table


def _flat(table: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Entries by dotted name, also where the names were not quoted and came as tables within tables."""
    found: dict[str, Any] = {}
    for key, value in table.items():
        if isinstance(value, Mapping) and value and not set(value) & set(FREE_KEYS):
            found |= _flat(value, f"{prefix}{key}.")
        else:
            found[f"{prefix}{key}"] = value
    return found


def _entry(spec: Any, keys: tuple[str, ...], where: str) -> dict[str, Any]:
    if not isinstance(spec, Mapping):
        raise InputError(f"{where} is {shown(spec)}; must be a table with some of the keys {', '.join(keys)}")
    _known(spec, keys, where)
    return dict(spec)


def _known(table: Mapping[str, Any], keys: tuple[str, ...], where: str) -> None:
    unknown = next((key for key in table if key not in keys), None)
    if unknown is not None:
        raise InputError(f"{where}: unknown key {shown(unknown)}; allowed are {', '.join(keys)}")
