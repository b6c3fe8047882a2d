"""The atmosphere: what a planet's air is made of, validated.

An :class:`Atmosphere` is built from a description: the JSON object of the manual, as a file, a preset's name or a
dict. It keeps that description and offers its numbers as float64 arrays; it never changes after construction
(:meth:`Atmosphere.replace` makes a new one).

>>> from atmo_jit.atmosphere import Atmosphere
>>> earth = Atmosphere.load("earth")
>>> hazy = earth.replace({"mie.scattering_per_m": 4e-5, "mie.phase.g": 0.76})
>>> hazy.get("mie.phase.g"), hazy.constituents[1].name
(0.76, 'mie')

Keys. Required: ``wavelengths_nm`` (W numbers > 0), ``bottom_radius_m``, ``top_radius_m``. Optional: ``rayleigh``,
``mie`` (one object or a list of species), ``ozone`` (absent or null: none of it), ``solar_irradiance`` (W m^-2 nm^-1
at the top of the atmosphere; 1 if absent, so that radiance comes in 1/sr), ``ground_albedo`` (0 if absent: black
ground), ``sun_angular_radius_deg`` (0.2678 if absent, the sun from the earth; 0 = a point). Every value per
wavelength is a list of W numbers or one number for all.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from . import presets
from ._fields import FRACTION, NOT_NEGATIVE, POSITIVE, Range, mapping, number, numbers, one_of, per_wavelength
from ._json import plain, read_json
from .errors import AtmosphereError, shown, within
from .phase import Phase, RayleighPhase, phase_from_dict
from .profile import Profile, Tabulated, profile_from_dict

__all__ = ["Atmosphere", "AtmosphereError", "Constituent"]

DEFAULTS: dict[str, Any] = {
    "solar_irradiance": 1,
    "rayleigh": None,
    "mie": None,
    "ozone": None,
    "ground_albedo": 0,
    "sun_angular_radius_deg": 0.2678,
}
REQUIRED = ("wavelengths_nm", "bottom_radius_m", "top_radius_m")
# Of the largest air that is solved in any time: at 1e11 light is a third off, and 1e15 takes no end.
RADIUS = Range(0, 1e10, low_open=True)
# Radii of the planet: a ray from the ground of a smaller one takes no end, nor does one where single precision is 0.
FARTHEST_TOP, SMALLEST = 10000.0, 1e-3
# Every species makes the kernels larger: with this many the first solve takes half a minute, with thousands no end.
MOST_SPECIES = 64
# Rays are cut at every altitude of a table, and every table is looked up there: with as many a solve takes half a
# minute, with 200,000 hours.
MOST_ALTITUDES, MOST_LOOK_UPS = 2000, 20_000
SCATTERED_FRACTION = Range(1e-12, 1)  # what scatters less has absorption_per_m
# Columns through denser air, and light of brighter suns, are too much for single precision.
DENSEST, BRIGHTEST = 1e6, 1e30  # 1/m; W m^-2 nm^-1
# Keys of which an object holds one or the other: replacing one of them by its dotted name drops the others.
ALTERNATIVES = (
    ({"single_scattering_albedo"}, {"absorption_per_m"}),
    ({"scale_height_m", "center_m", "half_width_m"}, {"profile"}),
)


@dataclass(frozen=True, eq=False)
class Constituent:
    """One kind of particle: coefficients per wavelength, times a density profile.

    ``name`` is its dotted name (``rayleigh``, ``mie``, ``mie.0``, ``ozone``); the coefficients (1/m, float64 [W])
    hold where the profile's density is 1; ``phase`` is None for a pure absorber.
    """

    name: str
    scattering_per_m: np.ndarray
    absorption_per_m: np.ndarray
    profile: Profile
    phase: Phase | None

    @property
    def extinction_per_m(self) -> np.ndarray:
        """Scattering + absorption (1/m), [W]."""
        return self.scattering_per_m + self.absorption_per_m

    @property
    def single_scattering_albedo(self) -> np.ndarray:
        """Scattering / extinction, [W]; 1 where there is neither."""
        extinction = self.extinction_per_m
        return np.divide(self.scattering_per_m, extinction, out=np.ones_like(extinction), where=extinction > 0)


@dataclass(frozen=True, init=False, eq=False)
class Atmosphere:
    """A validated description.

    ``Atmosphere(description)`` raises :class:`AtmosphereError`: one line naming the field, the value and what is
    allowed.
    """

    wavelengths_nm: np.ndarray
    solar_irradiance: np.ndarray
    ground_albedo: np.ndarray
    bottom_radius_m: float
    top_radius_m: float
    sun_angular_radius_deg: float
    rayleigh: Constituent | None
    mie: tuple[Constituent, ...]
    ozone: Constituent | None

    def __init__(self, description: Mapping[str, Any]) -> None:
        self._read(plain(description), {}, {})

    def _read(self, document: dict[str, Any], before: dict[str, Any], read: dict[str, Any]) -> None:
        """Take what a ``document`` of dicts, lists and Python numbers describes. ``read``: constituents by name, of a
        document ``before``, which serve where it has the very same object."""
        mapping(document, "", REQUIRED, tuple(DEFAULTS))
        d = DEFAULTS | document
        wavelengths = numbers(d["wavelengths_nm"], "wavelengths_nm", POSITIVE)
        count = len(wavelengths)
        bottom = number(d["bottom_radius_m"], "bottom_radius_m", RADIUS)
        top = number(d["top_radius_m"], "top_radius_m", RADIUS)
        if top <= bottom:
            raise AtmosphereError(
                "top_radius_m", shown(d["top_radius_m"]), f"a number above bottom_radius_m ({bottom:g})"
            )
        if top > FARTHEST_TOP * bottom:
            allowed = f"a number up to {FARTHEST_TOP:g} times bottom_radius_m ({bottom:g})"
            raise AtmosphereError("top_radius_m", shown(d["top_radius_m"]), allowed)
        if bottom < SMALLEST:
            raise AtmosphereError("bottom_radius_m", shown(d["bottom_radius_m"]), f"a finite number >= {SMALLEST:g}")
        sun = number(d["sun_angular_radius_deg"], "sun_angular_radius_deg", Range(0, 90, high_open=True))
        self._set(
            _document=document,
            wavelengths_nm=wavelengths,
            solar_irradiance=per_wavelength(d["solar_irradiance"], "solar_irradiance", count, Range(0, BRIGHTEST)),
            ground_albedo=per_wavelength(d["ground_albedo"], "ground_albedo", count, FRACTION),
            bottom_radius_m=bottom,
            top_radius_m=top,
            sun_angular_radius_deg=sun,
            **{
                name: read[name] if name in read and d[name] is before[name] else new(d[name], count)
                for name, new in (("rayleigh", _rayleigh), ("mie", _mie), ("ozone", _ozone))
            },
        )
        _few_altitudes(self.constituents)

    def _set(self, **fields: Any) -> None:
        for name, value in fields.items():
            if isinstance(value, np.ndarray):
                value.flags.writeable = False
            object.__setattr__(self, name, value)

    @classmethod
    def from_dict(cls, description: Mapping[str, Any]) -> Atmosphere:
        """The atmosphere of a dict with the JSON's keys (NumPy arrays and numbers are accepted in it too)."""
        return cls(description)

    @classmethod
    def load(cls, source: str | Path | Mapping[str, Any] | Atmosphere) -> Atmosphere:
        """The atmosphere of a preset's name, the path of a JSON file, a dict, or an atmosphere (returned as it is)."""
        if isinstance(source, Atmosphere):
            return source
        if isinstance(source, Mapping):
            return cls(source)
        if not isinstance(source, (str, Path)):
            allowed = f"a preset ({', '.join(presets.NAMES)}), a JSON file or a dict"
            raise AtmosphereError("atmosphere", shown(source), allowed)
        if source in presets.NAMES:
            return cls(presets.read(source))
        allowed = f"a JSON file or a preset ({', '.join(presets.NAMES)})"
        description = read_json(Path(source), "atmosphere", allowed)
        try:
            return cls(description)
        except AtmosphereError as error:
            raise AtmosphereError(error.field, error.found, error.allowed, source=str(source)) from None

    @property
    def constituents(self) -> tuple[Constituent, ...]:
        """The constituents that are there: rayleigh, the aerosol species in order, ozone."""
        return tuple(c for c in (self.rayleigh, *self.mie, self.ozone) if c is not None)

    @property
    def thickness_m(self) -> float:
        """Height of the top of the atmosphere above the ground (m)."""
        return self.top_radius_m - self.bottom_radius_m

    def to_dict(self) -> dict[str, Any]:
        """The description as it was given, with the defaults filled in; ``Atmosphere(a.to_dict())`` equals ``a``."""
        return plain(self._document | {key: value for key, value in DEFAULTS.items() if key not in self._document})

    def names(self) -> tuple[str, ...]:
        """The dotted names of all numbers, as :meth:`get` and :meth:`replace` take them."""
        return tuple(_leaves(self.to_dict()))

    def given(self, dotted: str) -> Any:
        """The value under a dotted name as the description has it: one number that stands for all wavelengths stays
        one number. Raises KeyError where there is none."""
        node: Any = self._document
        for key in dotted.split("."):
            if node is self._document and key not in node:
                node = DEFAULTS[key]
            else:
                node = node[int(key)] if isinstance(node, list) else node[key]
        return node

    def get(self, dotted: str) -> float | np.ndarray:
        """The value under a dotted name (``bottom_radius_m``, ``mie.phase.g``, ``mie.1.scattering_per_m``).

        Values per wavelength come as float64 [W], also where the description has one number for all; ``g`` and all
        others come as given: a float or a float64 array. Of ``single_scattering_albedo``, ``absorption_per_m`` and
        ``extinction_per_m`` the one that is not in the description is computed.
        """
        parent, _, key = dotted.rpartition(".")
        if not parent and isinstance(getattr(self, dotted, None), (float, np.ndarray)):
            return getattr(self, dotted)
        for constituent in self.constituents:
            if constituent.name == parent and isinstance(getattr(constituent, key, None), np.ndarray):
                return getattr(constituent, key)
        if dotted not in self.names():
            raise AtmosphereError(dotted, "no value of that name", f"the names {', '.join(self.names())}")
        value: Any = self.to_dict()
        for key in dotted.split("."):
            value = _child(value, key)
        return np.array(value, dtype=np.float64) if isinstance(value, list) else float(value)

    def replace(self, changes: Mapping[str, Any]) -> Atmosphere:
        """A new atmosphere with the values under the dotted names of ``changes`` replaced, validated again.

        A key that excludes another (``profile`` and ``scale_height_m``, ``absorption_per_m`` and
        ``single_scattering_albedo``) takes its place.
        """
        before = DEFAULTS | self._document
        document = dict(before)
        for dotted, value in changes.items():
            *parents, key = dotted.split(".")
            top = (parents or [key])[0]
            if parents and document.get(top) is before.get(top, dotted):
                document[top] = plain(before[top], top)
            node: Any = document
            for step in parents:
                node = _child(node, step)
            if isinstance(node, dict):
                for one, other in ALTERNATIVES:
                    excluded = other if key in one else one if key in other else set()
                    for name in excluded - {c.rpartition(".")[2] for c in changes if c.split(".")[:-1] == parents}:
                        node.pop(name, None)
                node[key] = plain(value, dotted)
            elif isinstance(_child(node, key), dict):
                node[int(key)] = plain(value, dotted)
            else:
                raise AtmosphereError(dotted, "no value of that name", f"the names {', '.join(self.names())}")
        read = {name: getattr(self, name) for name in ("rayleigh", "mie", "ozone")}
        new = object.__new__(Atmosphere)
        # Lists of another length belong to other wavelengths.
        new._read(document, before, read if document["wavelengths_nm"] is before["wavelengths_nm"] else {})
        return new

    def __eq__(self, other: object) -> bool:
        return self.to_dict() == other.to_dict() if isinstance(other, Atmosphere) else NotImplemented

    def __hash__(self) -> int:
        return hash(json.dumps(self.to_dict(), sort_keys=True))


def _rayleigh(d: Any, count: int) -> Constituent | None:
    if d is None:
        return None
    mapping(d, "rayleigh", ("scattering_per_m",), ("scale_height_m", "profile"))
    with within("rayleigh"):
        scattering = per_wavelength(d["scattering_per_m"], "scattering_per_m", count, NOT_NEGATIVE)
        profile = profile_from_dict(d, "scale_height_m")
    return _constituent("rayleigh", scattering, np.zeros(count), profile, RayleighPhase())


def _mie(d: Any, count: int) -> tuple[Constituent, ...]:
    if d is None:
        return ()
    if not isinstance(d, list):
        return (_species(d, "mie", count),)
    if not d:
        raise AtmosphereError("mie", "an empty list", "null, an object, or a list of at least one object")
    if len(d) > MOST_SPECIES:
        allowed = f"null, an object, or a list of 1 to {MOST_SPECIES} objects"
        raise AtmosphereError("mie", f"a list of {len(d)}", allowed)
    return tuple(_species(species, f"mie.{i}", count) for i, species in enumerate(d))


def _species(d: Any, name: str, count: int) -> Constituent:
    either = ("single_scattering_albedo", "absorption_per_m", "scale_height_m", "profile")
    mapping(d, name, ("scattering_per_m", "phase"), either)
    with within(name):
        scattering = per_wavelength(d["scattering_per_m"], "scattering_per_m", count, NOT_NEGATIVE)
        (key,) = one_of(d, ("single_scattering_albedo",), ("absorption_per_m",))
        if key == "absorption_per_m":
            absorption = per_wavelength(d[key], key, count, NOT_NEGATIVE)
        else:
            albedo = per_wavelength(d[key], key, count, SCATTERED_FRACTION)
            absorption = scattering * ((1.0 - albedo) / albedo)
        profile = profile_from_dict(d, "scale_height_m")
        phase = phase_from_dict(d["phase"], count)
    return _constituent(name, scattering, absorption, profile, phase)


def _ozone(d: Any, count: int) -> Constituent | None:
    if d is None:
        return None
    mapping(d, "ozone", ("absorption_per_m",), ("center_m", "half_width_m", "profile"))
    with within("ozone"):
        absorption = per_wavelength(d["absorption_per_m"], "absorption_per_m", count, NOT_NEGATIVE)
        profile = profile_from_dict(d, "center_m", "half_width_m")
    return _constituent("ozone", np.zeros(count), absorption, profile, None)


def _constituent(
    name: str, scattering: np.ndarray, absorption: np.ndarray, profile: Profile, phase: Phase | None
) -> Constituent:
    densest = float(np.max(profile.values)) if isinstance(profile, Tabulated) else 1.0
    for key, coefficients in (("scattering_per_m", scattering), ("absorption_per_m", absorption)):
        most = float(np.max(coefficients))
        if not most * densest <= DENSEST:
            allowed = f"at most {DENSEST:g} per metre, times the largest density of the profile ({densest:g})"
            raise AtmosphereError(f"{name}.{key}", f"up to {most:g}", allowed)
    scattering.flags.writeable = absorption.flags.writeable = False
    return Constituent(name, scattering, absorption, profile, phase)


def _few_altitudes(constituents: tuple[Constituent, ...]) -> None:
    """Refuse more altitudes in the tables of all profiles together than can be solved for."""
    altitudes: set[float] = set()
    tabulated = [c for c in constituents if isinstance(c.profile, Tabulated)]
    most = min(MOST_ALTITUDES, MOST_LOOK_UPS // max(len(tabulated), 1))
    for c in tabulated:
        altitudes.update(c.profile.kinks_m)
        if len(altitudes) > most:
            allowed = f"at most {most} altitudes in all profiles together"
            raise AtmosphereError(f"{c.name}.profile.altitude_m", f"a list of {len(c.profile.altitude_m)}", allowed)


def _child(node: Any, key: str) -> Any:
    """The member of an object or of a list that one step of a dotted name leads to, None if there is none."""
    if isinstance(node, dict):
        return node.get(key)
    if isinstance(node, list) and key in map(str, range(len(node))):
        return node[int(key)]
    return None


def _leaves(node: Any, prefix: str = "") -> list[str]:
    """Dotted names of the numbers and lists of numbers below ``node``."""
    if isinstance(node, dict):
        return [name for key, child in node.items() for name in _leaves(child, f"{prefix}.{key}" if prefix else key)]
    if isinstance(node, list) and node and isinstance(node[0], dict):
        return [name for i, child in enumerate(node) for name in _leaves(child, f"{prefix}.{i}")]
    return [prefix] if isinstance(node, (int, float, list)) else []
