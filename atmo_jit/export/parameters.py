"""An atmosphere in the terms of Bruneton's clients: one aerosol, one asymmetry, density layers; what does not fit.

Look-ups use radii, mu_s_min, solar irradiance, the sun's radius and g. Densities and coefficients matter only where a
client computes tables by itself.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..atmosphere import Atmosphere
from ..errors import InputError
from ..phase import CornetteShanks
from ..profile import Exponential, Tent
from .colour import Channels

PER_KM = 1e3
NOTHING = {"width": 0, "expTerm": 0, "expScale": 0, "linearTerm": 0, "constantTerm": 0}
LARGEST_SUN_RAD = 0.1  # the clients' small-angle formulas


@dataclass
class Aerosol:
    """The one aerosol of a client that stands for all: asymmetry ``g`` of its Cornette-Shanks phase function; whether
    the phase function is ``exact``; ``warnings`` about what is not."""

    g: float
    exact: bool
    warnings: list[str] = field(default_factory=list)


def aerosol(air: Atmosphere) -> Aerosol:
    """The client's aerosol. With several species, or another phase function, its asymmetry is their mean, weighted by
    scattering at the ground and in all wavelengths."""
    if not air.mie:
        return Aerosol(0.0, True)
    phases = [species.phase for species in air.mie]
    values = [np.unique(p.g) for p in phases if isinstance(p, CornetteShanks)]
    if len(values) == len(phases) and all(len(v) == 1 and v[0] == values[0][0] for v in values):
        warnings = []
        if len(air.mie) > 1:
            warnings.append(f"mie: {len(air.mie)} species are one in the client; its tables hold their sum")
        return Aerosol(float(values[0][0]), True, warnings)
    weights = [species.scattering_per_m * species.profile.density(np.array([0.0])) for species in air.mie]
    first = np.array(
        [[np.ravel(p.at(c).moments(1))[1] for c in range(len(air.wavelengths_nm))] for p in phases], dtype=float
    )
    total = np.sum(weights)
    mean = float(np.sum(np.array(weights) * first) / total) if total > 0.0 else float(first.mean())
    g = _asymmetry_to_g(mean)
    names = ", ".join(sorted({p.to_dict()["type"] for p in phases}))
    return Aerosol(
        g,
        False,
        [
            f"mie: {len(air.mie)} species with the phase function {names} become one with cornette_shanks, g {g:.4g}; "
            "radiance is kept at the texels' scattering angles and interpolated between"
        ],
    )


def _asymmetry_to_g(mean: float) -> float:
    """g of the Cornette-Shanks phase function with the mean cosine ``mean``: the inverse of 3 g (4 + g^2) / (5 (2 +
    g^2))."""
    grid = np.linspace(-0.99, 0.99, 3961)
    return float(np.interp(mean, 3.0 * grid * (4.0 + grid**2) / (5.0 * (2.0 + grid**2)), grid))


def phase_ratio(air: Atmosphere, species: int, g: float, nu: np.ndarray) -> np.ndarray:
    """Phase function of a species over that of the client's aerosol [..., W]."""
    phase, client = air.mie[species].phase, CornetteShanks(g).value(nu)
    return np.stack([phase.at(c).value(nu) / client for c in range(len(air.wavelengths_nm))], axis=-1)


def check_client(air: Atmosphere, mu_s_min: float) -> list[str]:
    """Warnings about what a client cannot hold. Raises InputError where its pictures would be silently wrong."""
    if not -1.0 <= mu_s_min <= -0.05:
        raise InputError(
            f"mu-s-min: found {mu_s_min:g}; allowed: a cosine from -1 to -0.05 (the tables must reach below the "
            "horizon, or twilight is cut off)"
        )
    sun = np.radians(air.sun_angular_radius_deg)
    if sun >= LARGEST_SUN_RAD:
        raise InputError(
            f"sun_angular_radius_deg: found {air.sun_angular_radius_deg:g}; allowed: below "
            f"{np.degrees(LARGEST_SUN_RAD):.3g} (the client's formulas hold for small suns only)"
        )
    if not np.any(air.solar_irradiance > 0.0):
        raise InputError("solar_irradiance: found 0 everywhere; allowed: some light, or the tables are empty")
    warnings = []
    for name, constituent in (("rayleigh", air.rayleigh), ("ozone", air.ozone), *((m.name, m) for m in air.mie[:1])):
        if constituent is not None and layers(constituent.profile) is None:
            warnings.append(
                f"{name}.profile: a tabulated profile does not fit into the client's density layers and is left out of "
                "params.json; the tables hold it"
            )
    return warnings


def layers(profile: Any) -> list[dict[str, float]] | None:
    """A profile as two density layers over altitude in km, None where they cannot hold it."""
    if isinstance(profile, Exponential):
        return [NOTHING, {**NOTHING, "expTerm": 1, "expScale": -PER_KM / profile.scale_height_m}]
    if isinstance(profile, Tent):
        centre, half = profile.center_m / PER_KM, profile.half_width_m / PER_KM
        rise = {**NOTHING, "width": centre, "linearTerm": 1 / half, "constantTerm": 1 - centre / half}
        return [rise, {**NOTHING, "linearTerm": -1 / half, "constantTerm": 1 + centre / half}]
    return None


def client_parameters(air: Atmosphere, colours: Channels, mu_s_min: float, g: float) -> dict[str, Any]:
    """The keys of @takram/three-atmosphere's AtmosphereParameters: radii in metres, coefficients per km. Densities that
    do not fit are left out."""
    nothing = np.zeros(len(air.wavelengths_nm))
    scattering = np.sum([m.scattering_per_m * _peak(m) for m in air.mie], axis=0) if air.mie else nothing
    extinction = np.sum([m.extinction_per_m * _peak(m) for m in air.mie], axis=0) if air.mie else nothing

    def coefficient(values: np.ndarray) -> list[float]:
        weighted = values * air.solar_irradiance
        mean = colours.matrix @ weighted / np.where(colours.solar > 0.0, colours.solar, 1.0)
        return (PER_KM * (values if colours.kind == "samples" else np.maximum(mean, 0.0))).tolist()

    albedo = air.ground_albedo
    if colours.kind == "spectral":
        albedo = np.clip(
            colours.matrix @ (albedo * air.solar_irradiance) / np.where(colours.solar > 0, colours.solar, 1), 0, 1
        )
    found = {
        "solarIrradiance": colours.solar.tolist(),
        "sunAngularRadius": float(np.radians(air.sun_angular_radius_deg)),
        "bottomRadius": air.bottom_radius_m,
        "topRadius": air.top_radius_m,
        "rayleighDensity": layers(air.rayleigh.profile) if air.rayleigh else [NOTHING, NOTHING],
        "rayleighScattering": coefficient(air.rayleigh.scattering_per_m if air.rayleigh else nothing),
        "mieDensity": layers(air.mie[0].profile) if air.mie else [NOTHING, NOTHING],
        "mieScattering": coefficient(scattering),
        "mieExtinction": coefficient(extinction),
        "miePhaseFunctionG": g,
        "absorptionDensity": layers(air.ozone.profile) if air.ozone else [NOTHING, NOTHING],
        "absorptionExtinction": coefficient(air.ozone.absorption_per_m if air.ozone else nothing),
        "groundAlbedo": np.asarray(albedo).tolist(),
        "muSMin": float(mu_s_min),
        "sunRadianceToLuminance": colours.sun_to_luminance.tolist(),
        "skyRadianceToLuminance": colours.sky_to_luminance.tolist(),
    }
    return {key: value for key, value in found.items() if value is not None}


def _peak(constituent: Any) -> float:
    return 1.0 if layers(constituent.profile) is not None else float(constituent.profile.density(np.array([0.0]))[0])
