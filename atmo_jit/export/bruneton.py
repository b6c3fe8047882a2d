"""Tables of Bruneton's own WebGL demo: raw float32, and the constants of its shader.

The demo reads ``scattering.dat`` with single Mie scattering packed into alpha, red alone; the other two are restored
from the ratios of the scattering coefficients. ``single_mie_scattering.dat`` has all three for programs that can read
it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..bake.client import IRRADIANCE, TRANSMITTANCE
from ..mapping import Bruneton
from .containers import File, raw, read_raw, source
from .lookup import ClientTables, packed, unpacked

MU_S_MIN = float(np.cos(np.radians(102.0)))
LENGTH_UNIT_M = 1000.0  # the demo's lengths are kilometres
SOURCE = "atmosphere_shader.txt"
ROLES = {
    "transmittance": "transmittance to the top; alpha: 1",
    "irradiance": "irradiance of the sky on a horizontal surface; alpha: 1",
    "scattering": "single Rayleigh scattering without its phase function + orders >= 2 over Rayleigh's; alpha: red of "
    "single Mie scattering without its own",
    "single_mie_scattering": "single scattering by aerosols without their phase function; alpha: 1",
}
TABLE = {"single_mie_scattering": "single_mie"}


def as_stored(tables: ClientTables, warnings: list[str]) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Texels by file name, and the tables that they hold."""
    alpha = {"scattering": tables.single_mie[..., 0]}
    return {name: packed(getattr(tables, TABLE.get(name, name)), alpha.get(name)) for name in ROLES}, {}


def files(texels: dict[str, np.ndarray], parameters: dict[str, Any], size: tuple[int, int, int, int]) -> list[File]:
    """The .dat files and the shader's constants."""
    return [*(raw(f"{n}.dat", v) for n, v in texels.items()), source(SOURCE, constants(parameters, size))]


def constants(parameters: dict[str, Any], size: tuple[int, int, int, int]) -> str:
    """The constants as Bruneton's Model writes them at the head of its GLSL."""
    r, mu, nu, mu_s = size
    sizes = {
        "TRANSMITTANCE_TEXTURE_WIDTH": TRANSMITTANCE[1],
        "TRANSMITTANCE_TEXTURE_HEIGHT": TRANSMITTANCE[0],
        "SCATTERING_TEXTURE_R_SIZE": r,
        "SCATTERING_TEXTURE_MU_SIZE": mu,
        "SCATTERING_TEXTURE_MU_S_SIZE": mu_s,
        "SCATTERING_TEXTURE_NU_SIZE": nu,
        "IRRADIANCE_TEXTURE_WIDTH": IRRADIANCE[1],
        "IRRADIANCE_TEXTURE_HEIGHT": IRRADIANCE[0],
    }
    p = parameters
    fields = [
        _vec3(p["solarIrradiance"]),
        _float(p["sunAngularRadius"]),
        *(_float(p[k] / LENGTH_UNIT_M) for k in ("bottomRadius", "topRadius")),
        _profile(p.get("rayleighDensity")),
        _vec3(p["rayleighScattering"]),
        _profile(p.get("mieDensity")),
        _vec3(p["mieScattering"]),
        _vec3(p["mieExtinction"]),
        _float(p["miePhaseFunctionG"]),
        _profile(p.get("absorptionDensity")),
        _vec3(p["absorptionExtinction"]),
        _vec3(p["groundAlbedo"]),
        _float(p["muSMin"]),
    ]
    return "\n".join(
        [
            *(f"const int {name} = {value};" for name, value in sizes.items()),
            "#define COMBINED_SCATTERING_TEXTURES",
            "const AtmosphereParameters ATMOSPHERE = AtmosphereParameters(",
            ",\n".join(f"    {field}" for field in fields) + ");",
            f"const vec3 SKY_SPECTRAL_RADIANCE_TO_LUMINANCE = {_vec3(p['skyRadianceToLuminance'])};",
            f"const vec3 SUN_SPECTRAL_RADIANCE_TO_LUMINANCE = {_vec3(p['sunRadianceToLuminance'])};",
            "",
        ]
    )


def read(folder: Path, parameters: dict[str, Any]) -> ClientTables:
    """The tables of a folder with their params.json."""
    to = Bruneton(parameters["bottomRadius"], parameters["topRadius"], parameters["muSMin"])
    size = tuple(parameters["metadata"]["scatteringSize"])
    sizes = {"transmittance": TRANSMITTANCE, "irradiance": IRRADIANCE}
    arrays = {}
    for name in ROLES:
        own = sizes.get(name, size)
        arrays[TABLE.get(name, name)] = unpacked(read_raw(folder / f"{name}.dat", np.float32, (*own, 4)), own)
    return ClientTables(to, parameters["miePhaseFunctionG"], **arrays)


def _profile(layers: list[dict[str, float]] | None) -> str:
    """A DensityProfile; of a profile that does not fit nothing is left."""
    keys = ("width", "expTerm", "expScale", "linearTerm", "constantTerm")
    both = layers or [dict.fromkeys(keys, 0.0)] * 2
    rows = [f"DensityProfileLayer({', '.join(_float(layer[k]) for k in keys)})" for layer in both]
    return f"DensityProfile(DensityProfileLayer[2]({', '.join(rows)}))"


def _vec3(values: Any) -> str:
    return f"vec3({', '.join(_float(v) for v in values)})"


def _float(value: float) -> str:
    digits = f"{float(value):.9g}"
    return digits if any(c in digits for c in ".e") else f"{digits}.0"
