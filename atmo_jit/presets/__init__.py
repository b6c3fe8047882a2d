"""The atmospheres that come with the package: one JSON file each in this folder, and where their numbers come from."""

from __future__ import annotations

import json
from importlib.resources import files
from typing import Any

OPAC = (
    "atmo_jit.earth.earth_at with OPAC's aerosol type {} (Hess et al. 1998, Bull. Am. Meteorol. Soc. 79, 831) at the "
    "four wavelengths whose colour is nearest to that of the spectrum"
)
SOURCES = {
    "earth": (
        "Bruneton 2017, Precomputed Atmospheric Scattering: a New Implementation, at 680, 550 and 440 nm "
        "(solar irradiance ASTM G173-03); Cornette-Shanks g 0.8, ground albedo 0.1, top at 60 km"
    ),
    "bruneton2008": (
        "Bruneton and Neyret 2008, Precomputed Atmospheric Scattering, section 2.1 and the clear sky of its code: "
        "no ozone, Mie 2e-5 per metre, g 0.76; solar irradiance as in earth"
    ),
    "hillaire2020": (
        "Hillaire 2020, A Scalable and Production Ready Sky and Atmosphere Rendering Technique, table 1, with Mie "
        "absorption 0.444e-6 where the table prints 4.40e-6 (its code has an extinction of 4.44e-6); top at 100 km, "
        "ground albedo 0.3, solar irradiance as in earth"
    ),
    "mars": (
        "Dust of optical depth 0.5 at 550 nm by Mie theory: effective radius 1.6 um, variance 0.2 (Tomasko et al. "
        "1999, J. Geophys. Res. 104, 8987), index 1.5 with 2 % hematite by volume (after Ehlers et al. 2014, Appl. "
        "Opt. 53, 1808: blue is scattered into the narrower forward peak, hence the blue sunset); CO2 Rayleigh "
        "scattering at 610 Pa and 210 K (Sneep and Ubachs 2005, J. Quant. Spectrosc. Radiat. Transfer 92, 293); "
        "scale height 11 km; "
        "solar irradiance of earth at 1.524 au; ground albedo typical of bright soil"
    ),
    "earth_continental": OPAC.format("continental average"),
    "earth_maritime": OPAC.format("maritime clean"),
    "earth_desert": OPAC.format("desert"),
    "earth_urban": OPAC.format("urban"),
    "boody": (
        "The constants of Boody's notes, corrected: aerosol absorption 0.444e-6 per metre beside scattering 3.996e-6, "
        "aerosol density of scale height 1200 m, Rayleigh's phase function; the rest as in earth"
    ),
    "boody_as_written": (
        "The same as written: aerosol absorption 4.40e-6 per metre, aerosol density of the gas's scale height 8000 m, "
        "and the modified Rayleigh phase function 7/5 + 1/2 cos^2, as Legendre moments of a species (normalised: as "
        "written it scatters 1.25 times the light that it takes)"
    ),
    "haze": (
        "A thick-haze world, much like Titan: nitrogen at 1.47 bar and 94 K (Rayleigh scattering by its density over "
        "the Earth's); haze of optical depth 8.1 at 550 nm, evenly dense up to 80 km and of scale height 65 km above, "
        "falling with wavelength^-2, orange by absorption in the blue (after Tomasko et al. 2008, Planet. Space Sci. "
        "56, 669, rounded); sunlight at 9.58 au"
    ),
}
NAMES = tuple(SOURCES)


def read(name: str) -> dict[str, Any]:
    """The description of the preset ``name`` (one of :data:`NAMES`) as a new dict."""
    return json.loads(text(name))


def text(name: str) -> str:
    """The JSON text of the preset ``name``."""
    return files(__package__).joinpath(f"{name}.json").read_text(encoding="utf-8")
