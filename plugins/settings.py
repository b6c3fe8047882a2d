"""Reading the emitter's Mitsuba properties: names, defaults and checks, nothing that depends on a variant.

All errors are :class:`~atmo_jit.errors.InputError`: one line that names the parameter, what was found and what is
allowed. Properties that nobody asked for stay unqueried, and Mitsuba reports them as it does for every plugin.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from atmo_jit.atmosphere import Atmosphere
from atmo_jit.errors import AtmosphereError, InputError, shown
from atmo_jit.files import is_file
from atmo_jit.refraction import flattening, lift
from atmo_jit.wavelengths import at_wavelengths, chosen

from .sun_position import Moment, sun_direction

DEFAULT_ALTITUDE_M = 1.0
SMALLEST_SUN_DEG = 0.01  # of the aperture: single precision cannot resolve a smaller disc, and a point has no radiance
BOTH_SUNS = (
    "Both the 'sun_direction' and parameters for time/location were provided, "
    "both information cannot be given at the same time!"
)
AEROSOL = "the aerosol itself, mie.scattering_per_m (1/m), mie.scale_height_m and mie.phase.g, in place of turbidity"
# Keys that may replace those of a description, so that they are found although the description does not have them.
LEAVES = (
    "scattering_per_m",
    "single_scattering_albedo",
    "absorption_per_m",
    "scale_height_m",
    "center_m",
    "half_width_m",
    "phase.type",
    "phase.g",
)


@dataclass
class Settings:
    """What the properties say. ``direction`` is in world space as given, or in the local frame if ``moment`` is set."""

    atmosphere: Atmosphere
    direction: tuple[float, float, float]
    moment: Moment | None
    altitude_m: float
    sun_scale: float
    sky_scale: float
    limb_darkening: bool
    refraction: bool


def read(props: Any, find_file: Any, albedo: Any = None) -> Settings:
    """The settings in a ``mi.Properties`` object.

    ``find_file`` resolves a path as Mitsuba does; ``albedo`` maps wavelengths (nm) to the values of the parameter
    ``albedo`` and is None where that was not given.
    """
    if "turbidity" in props:
        raise AtmosphereError("turbidity", shown(props["turbidity"]), _instead_of(props["turbidity"]))
    atmosphere = atmosphere_of(props, find_file)
    changes = dict(overrides(props, atmosphere))
    if albedo is not None and "ground_albedo" in changes:
        raise InputError("albedo: found together with ground_albedo; allowed: one of the two")
    if "sun_aperture" in props:
        aperture = number(props, "sun_aperture", 0.0)
        if not 0.0 < aperture < 180.0:
            raise AtmosphereError("sun_aperture", shown(aperture), "a number of degrees in (0, 180)")
        changes["sun_angular_radius_deg"] = aperture / 2.0
    atmosphere = at_given_wavelengths(props, atmosphere.replace(changes))
    if albedo is not None:
        atmosphere = with_albedo(atmosphere, albedo(atmosphere.wavelengths_nm))
    direction, moment = _sun(props)
    return Settings(
        atmosphere=atmosphere,
        direction=direction,
        moment=moment,
        altitude_m=not_negative("altitude", number(props, "altitude", DEFAULT_ALTITUDE_M)),
        sun_scale=not_negative("sun_scale", number(props, "sun_scale", 1.0)),
        sky_scale=not_negative("sky_scale", number(props, "sky_scale", 1.0)),
        limb_darkening=bool(props.get("complex_sun", False)),
        refraction=bool(props.get("refraction", False)),
    )


def as_seen(atmosphere: Atmosphere, altitude_m: float, local: Any, plain: np.ndarray) -> list[Any]:
    """Components of the direction to the sun where refraction shows it, given the true one in the local frame:
    ``local``, numbers or Dr.Jit arrays, and the same as a plain array; the angle between has no derivative."""
    across = float(np.hypot(plain[0], plain[1]))
    angle = float(lift(atmosphere, np.arctan2(across, plain[2]), altitude_m)) if across > 0.0 else 0.0
    if angle == 0.0:
        return list(local)
    x, y, z = local
    across = (x * x + y * y) ** 0.5
    sin, cos = float(np.sin(angle)), float(np.cos(angle))
    horizontal = cos - z / across * sin
    return [x * horizontal, y * horizontal, z * cos + across * sin]


def squeeze(atmosphere: Atmosphere, altitude_m: float, seen: np.ndarray) -> float:
    """Vertical over horizontal diameter of the sun's disc where refraction shows it in the local direction ``seen``:
    1 for observers above the air."""
    if altitude_m >= atmosphere.thickness_m:
        return 1.0
    radius = np.radians(max(atmosphere.sun_angular_radius_deg, 0.5 * SMALLEST_SUN_DEG))
    return float(flattening(atmosphere, np.arctan2(np.hypot(seen[0], seen[1]), seen[2]), radius, altitude_m))


def with_albedo(atmosphere: Atmosphere, values: np.ndarray) -> Atmosphere:
    """``atmosphere`` over a ground of the given albedo [W]; the error names the parameter ``albedo``."""
    if not (np.all(np.isfinite(values)) and np.all((values >= 0.0) & (values <= 1.0))):
        raise AtmosphereError("albedo", shown([round(float(v), 6) for v in values]), "values in [0, 1]")
    return atmosphere.replace({"ground_albedo": [float(v) for v in values]})


def number(props: Any, name: str, default: float) -> float:
    """A finite number among the properties."""
    value = props.get(name, default)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise AtmosphereError(name, shown(value), "a finite number")
    return float(value)


def not_negative(name: str, value: float) -> float:
    """``value``, which must be 0 or more."""
    if not value >= 0.0 or math.isinf(value):
        raise AtmosphereError(name, shown(value), "a finite number >= 0")
    return value


def unit_vector(name: str, value: Iterable[float]) -> tuple[float, float, float]:
    """``value`` divided by its length, in double precision."""
    found = tuple(float(v) for v in value)
    length = math.hypot(*found)
    if len(found) != 3 or not math.isfinite(length) or length == 0.0:
        raise AtmosphereError(name, shown(found), "a vector of three finite numbers, not all 0")
    return found[0] / length, found[1] / length, found[2] / length


def turning(matrix: np.ndarray) -> None:
    """Refuse a transformation [4, 4] that changes the angles between directions: densities would be wrong."""
    m = np.asarray(matrix, dtype=np.float64).reshape(4, 4)[:3, :3]
    square = m.T @ m
    size = np.trace(square) / 3.0
    if not (np.isfinite(size) and size > 0.0 and np.allclose(square, size * np.eye(3), atol=1e-4 * size)):
        raise AtmosphereError("to_world", "a transformation that distorts angles", "rotations, also mirrored or scaled")


def values(raw: Any) -> Any:
    """A property's value as Atmosphere takes it: a number, a list of numbers or a word.

    Strings may hold several numbers, separated by commas or spaces; vectors, colours and Dr.Jit arrays become lists.
    """
    if isinstance(raw, str):
        words = raw.replace(",", " ").split()
        try:
            found = [float(w) for w in words]
        except ValueError:
            return raw
        return found[0] if len(found) == 1 else found
    if isinstance(raw, (bool, int, float)):
        return raw
    try:
        found = [float(v) for v in np.array(raw, dtype=np.float64).ravel()]
    except (TypeError, ValueError):
        return raw
    return found[0] if len(found) == 1 else found


def _instead_of(turbidity: Any) -> str:
    """What to give in place of a turbidity: Preetham, Shirley and Smits (1999), appendix A, for 1200 m of aerosol."""
    if isinstance(turbidity, bool) or not isinstance(turbidity, (int, float)) or not 1.0 <= turbidity <= 10.0:
        return AEROSOL
    depth = max(0.04608365822050 * turbidity - 0.04586025928522, 0.0) * 0.55**-1.3
    return f"{AEROSOL}; about mie.scattering_per_m = {0.9 * depth / 1200.0:.1e} at this one"


def atmosphere_of(props: Any, find_file: Any) -> Atmosphere:
    source = props.get("atmosphere", "earth")
    if not isinstance(source, str):
        return Atmosphere.load(source)  # its message says what is allowed
    if source.lstrip().startswith("{"):
        try:
            return Atmosphere.load(json.loads(source))
        except json.JSONDecodeError as error:
            raise AtmosphereError("atmosphere", f"invalid JSON ({error})", "a JSON object") from None
    found = Path(find_file(source))
    return Atmosphere.load(found if is_file(found) else source)


def at_given_wavelengths(props: Any, atmosphere: Atmosphere) -> Atmosphere:
    """``atmosphere`` described at the wavelengths that the parameter ``wavelengths`` names, if it is there."""
    if "wavelengths" not in props:
        return atmosphere
    given = props["wavelengths"]
    if not isinstance(given, str):
        found = values(given)
        given = ",".join(f"{v:g}" for v in found) if isinstance(found, list) else str(found)
    return at_wavelengths(atmosphere, chosen(given, "wavelengths"))


def described(props: Any, find_file: Any) -> Atmosphere:
    """The atmosphere of the properties: parameter ``atmosphere``, other values in it, ``wavelengths``."""
    atmosphere = atmosphere_of(props, find_file)
    return at_given_wavelengths(props, atmosphere.replace(dict(overrides(props, atmosphere))))


def overrides(props: Any, atmosphere: Atmosphere) -> Iterable[tuple[str, Any]]:
    """Atmosphere values among the properties, under their dotted names.

    Mitsuba's dict loader refuses dots in keys, so ``mie_phase_g`` stands for ``mie.phase.g`` there.
    """
    names = set(atmosphere.names())
    for constituent in atmosphere.constituents:
        names |= {f"{constituent.name}.{leaf}" for leaf in LEAVES}
    spelled = {name.replace(".", "_"): name for name in sorted(names)}
    for key in props.keys():
        name = key if "." in key else spelled.get(key)
        if name is None:
            continue
        raw = props[key]
        if type(raw).__name__ == "Spectrum":
            yield name, _spectrum(raw, atmosphere)
        else:
            yield name, values(raw)


def _spectrum(spectrum: Any, atmosphere: Atmosphere) -> Any:
    if spectrum.is_uniform():
        return float(spectrum.values[0])
    return [float(v) for v in np.interp(atmosphere.wavelengths_nm, spectrum.wavelengths, spectrum.values)]


def _sun(props: Any) -> tuple[tuple[float, float, float], Moment | None]:
    given = [name for name in Moment.names() if name in props]
    if "sun_direction" in props:
        if given:
            raise InputError(BOTH_SUNS)
        raw = values(props["sun_direction"])
        if not isinstance(raw, list) or not all(isinstance(v, float) for v in raw):
            raise AtmosphereError("sun_direction", shown(raw), "a vector of three finite numbers, not all 0")
        return unit_vector("sun_direction", raw), None
    defaults = Moment()
    found = {name: number(props, name, getattr(defaults, name)) for name in Moment.names()}
    return moment_direction(found)


def moment_direction(found: dict[str, float]) -> tuple[tuple[float, float, float], Moment]:
    """The sun's direction in the local frame at a place and time given by name; the date in whole numbers."""
    whole = {name: int(round(found[name])) for name in ("year", "month", "day")}
    if not 1 <= whole["month"] <= 12:
        raise AtmosphereError("month", shown(whole["month"]), "a whole number in [1, 12]")
    if not 1 <= whole["day"] <= 31:
        raise AtmosphereError("day", shown(whole["day"]), "a whole number in [1, 31]")
    moment = Moment(**(found | whole))
    return sun_direction(moment), moment
