"""Tables of @takram/three-atmosphere: half precision, fixed sizes, as .bin and as .exr.

Load them with ``new PrecomputedTexturesLoader({ combinedScattering: false })``; the packed alpha of scattering, which
its default reads, has no more than the red of single Mie scattering.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..bake.client import IRRADIANCE, SCATTERING, TRANSMITTANCE
from ..mapping import Bruneton
from .containers import File, exr, halved, raw, read_raw
from .lookup import ClientTables, packed, unpacked

MU_S_MIN = float(np.cos(np.radians(120.0)))
FLIPPED = True  # the client reads EXR pictures upside down
ROLES = {
    "transmittance": "transmittance to the top; alpha: 1",
    "irradiance": "irradiance of the sky on a horizontal surface; alpha: 1",
    "scattering": "single Rayleigh scattering without its phase function + orders >= 2 over Rayleigh's; alpha: red of "
    "single_mie_scattering",
    "single_mie_scattering": "single scattering by aerosols without their phase function; alpha: 1",
    "higher_order_scattering": "orders >= 2 over Rayleigh's phase function; alpha: 1",
}
TABLE = {"single_mie_scattering": "single_mie", "higher_order_scattering": "higher"}  # other names are ClientTables'


def textures(tables: ClientTables, warnings: list[str]) -> dict[str, np.ndarray]:
    """The five tables as half RGBA texels."""
    half = {name: halved(name, getattr(tables, TABLE.get(name, name)), warnings) for name in ROLES}
    red = half["single_mie_scattering"][..., 0]
    return {name: packed(v, red if name == "scattering" else None, np.float16) for name, v in half.items()}


def as_stored(tables: ClientTables, warnings: list[str]) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Texels by file name, and the tables that they hold."""
    texels = textures(tables, warnings)
    return texels, {TABLE.get(n, n): unpacked(v, _size(n)) for n, v in texels.items()}


def files(texels: dict[str, np.ndarray], header: dict[str, Any]) -> list[File]:
    """.bin and .exr of every table."""
    stored = []
    for name, values in texels.items():
        stored.append(raw(f"{name}.bin", values))
        stored.append(exr(f"{name}.exr", values, header | {"atmo_jit.holds": ROLES[name]}, flipped=FLIPPED))
    return stored


def read(folder: Path, parameters: dict[str, Any]) -> ClientTables:
    """The tables of a folder with their params.json."""
    to = Bruneton(parameters["bottomRadius"], parameters["topRadius"], parameters["muSMin"])
    arrays = {}
    for name in ROLES:
        size = _size(name)
        shape = (*size[:2], *((size[2] * size[3],) if len(size) == 4 else ()), 4)
        texels = read_raw(folder / f"{name}.bin", np.float16, shape)
        arrays[TABLE.get(name, name)] = unpacked(texels, size)
    return ClientTables(to, parameters["miePhaseFunctionG"], **arrays)


def _size(name: str) -> tuple[int, ...]:
    return {"transmittance": TRANSMITTANCE, "irradiance": IRRADIANCE}.get(name, SCATTERING)
