"""Tables of CosmoScout VR: float32 TIFF, luminance-weighted linear sRGB, phase functions as a table.

Written from the description of its files; not tried in the program itself.
"""

from __future__ import annotations

import numpy as np

from ..atmosphere import Atmosphere
from ..phase import CornetteShanks, RayleighPhase
from .colour import Channels
from .containers import File, document, tiff
from .lookup import ClientTables, packed

MU_S_MIN = float(np.cos(np.radians(102.0)))
ANGLES = 512  # columns of phase.tif, from 0 to 180 degrees
NAMES = {
    "transmittance": "transmittance",
    "multiple_scattering": "scattering",
    "single_aerosols_scattering": "single_mie",
    "indirect_illuminance": "irradiance",
}
ROLES = {
    "transmittance": "transmittance of sunlight to the top",
    "multiple_scattering": "single scattering by molecules without their phase function + orders >= 2 over it",
    "single_aerosols_scattering": "single scattering by aerosols without their phase function",
    "indirect_illuminance": "illuminance by the sky on a horizontal surface",
    "phase": "phase functions (1/sr): row 0 molecules, row 1 aerosols; columns: angle, 0 to 180 degrees",
}


def as_stored(
    tables: ClientTables, colours: Channels, warnings: list[str]
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Texels by file name, in luminance (cd/m^2, lux); and the tables without that factor."""
    texels = {}
    for name, table in NAMES.items():
        factor = 1.0 if name == "transmittance" else colours.sky_to_luminance.astype(np.float32)
        texels[name] = packed(getattr(tables, table) * factor)[..., :3].astype(np.float32)
    return texels, {}


def files(
    texels: dict[str, np.ndarray], air: Atmosphere, colours: Channels, g: float, size: tuple[int, ...], mu_s_min: float
) -> list[File]:
    """The TIFF files and metadata.json."""
    nu = np.cos(np.linspace(0.0, np.pi, ANGLES))
    phase = np.stack([RayleighPhase().value(nu), CornetteShanks(g).value(nu)])[..., None]
    texels = texels | {"phase": np.repeat(phase, 3, axis=-1).astype(np.float32)}
    metadata = {
        "sunAngularRadius": float(np.radians(air.sun_angular_radius_deg)),
        "sunIlluminance": (colours.solar * colours.sun_to_luminance).tolist(),
        "scatteringTextureNuSize": size[2],
        "maxSunZenithAngle": float(np.arccos(mu_s_min)),
        "refraction": False,
    }
    return [*(tiff(f"{n}.tif", v, {"holds": ROLES[n]}) for n, v in texels.items()), document("metadata.json", metadata)]

