"""What all clients of Bruneton's tables have in common: tables of three channels from a solved sky, and their error."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from typing import Any

import numpy as np

from .. import mapping
from ..atmosphere import Atmosphere
from ..backend import doubles
from ..bake.client import SCATTERING, WHOLE, Block, bruneton_tables, scattering_nodes
from ..bake.error import compare
from ..errors import InputError
from ..mapping import Bruneton
from ..phase import RayleighPhase
from ..solved import Sky
from . import bruneton, cosmoscout, takram
from .colour import Channels, channels, described
from .containers import File, source
from .exporter import Clock, Made, Options, only
from .fitting import fitted
from .lookup import ClientTables
from .parameters import Aerosol, aerosol, check_client, client_parameters, phase_ratio
from .shaders import glsl, hlsl

# Views of the error estimate, by zenith angles of the sun (deg); none closer to the horizon than half a degree, where
# the clients' own arithmetic decides what is seen.
SUNS_DEG = {"day": (0.0, 85.0), "sunset": (85.0, 95.0), "twilight": (95.0, 102.0)}
VIEWS, OFF_HORIZON_DEG = 700, 0.5
FEW_WAVELENGTHS = 8


LARGEST_TABLE = 64 << 20  # texels


def make(
    layout: str, air: Atmosphere, options: Options, clock: Clock, progress: Callable[[float], None]
) -> Made:
    """Files of the layouts takram, bruneton and cosmoscout."""
    client = {"takram": takram, "bruneton": bruneton, "cosmoscout": cosmoscout}[layout]
    size = _size(layout, options.size)
    if layout == "takram":
        only(layout, "precision", options.precision, ("half",), "the client reads nothing else, and would not say so")
    else:
        only(layout, "precision", options.precision, ("float",), "its files are 32-bit")
    kind = options.colour or ("spectral" if layout == "cosmoscout" else "samples")
    if layout == "cosmoscout":
        only(layout, "colour", kind, ("spectral",), "it takes luminance")
    colours = channels(air, kind)
    mu_s_min = client.MU_S_MIN if options.mu_s_min is None else float(options.mu_s_min)
    warnings = check_client(air, mu_s_min)
    one = aerosol(air)
    warnings += one.warnings
    if kind == "spectral" and len(air.wavelengths_nm) < FEW_WAVELENGTHS:
        warnings.append(
            f"wavelengths_nm: {len(air.wavelengths_nm)} wavelengths are few for colours; ten between 380 and 720 nm "
            "are right within 2 %"
        )
    if mu_s_min != client.MU_S_MIN:
        warnings.append(
            f"mu-s-min: {mu_s_min:g} is not the client's default; without the muSMin of params.json twilight is wrong"
        )
    if layout == "bruneton" and air.mie and _red_alone_fails(air):
        warnings.append(
            "mie: the demo restores green and blue of single Mie scattering from its red by the ratios of the "
            "scattering coefficients; single_mie_scattering.dat has all three"
        )
    clock.stage("check")
    sky = Sky(air, options.orders, options.tolerance)
    clock.stage("solve")
    progress(0.2)
    if options.texels == "exact":
        tables = client_tables(sky, colours, one, mu_s_min, size)
    else:
        to = Bruneton(air.bottom_radius_m, air.top_radius_m, mu_s_min)
        tables = fitted(partial(client_tables, sky, colours, one, mu_s_min), to, size)
    clock.stage("bake")
    progress(0.6)
    parameters = client_parameters(air, colours, mu_s_min, one.g)
    if layout == "cosmoscout":
        texels, held = cosmoscout.as_stored(tables, colours, warnings)
    else:
        texels, held = client.as_stored(tables, warnings)
    stored = rounded(tables, held)
    error = table_error(stored, sky, colours)
    clock.stage("estimate the error")
    progress(0.8)
    about = _metadata(layout, air, colours, mu_s_min, size, client.ROLES, options)
    header = {f"atmo_jit.{k}": _text(v) for k, v in about.items()} | {"atmo_jit.errorEstimate": json.dumps(error)}
    if layout == "takram":
        files = takram.files(texels, header)
    elif layout == "bruneton":
        files = bruneton.files(texels, parameters, size)
    else:
        files = cosmoscout.files(texels, air, colours, one.g, size, mu_s_min)
    return Made([*files, *_snippets(stored, size)], parameters, about, error, warnings)


def _size(layout: str, size: tuple[int, ...] | None) -> tuple[int, int, int, int]:
    if layout == "takram":
        return only(layout, "size", size, (SCATTERING,), "fixed in the client, where others load silently wrong")
    size = size or SCATTERING
    allowed = "four whole numbers: altitudes >= 2, view cosines (even, >= 4), angles >= 2, suns >= 2"
    if len(size) != 4 or min(size) < 2 or size[1] < 4 or size[1] % 2 or np.prod(size) > LARGEST_TABLE:
        raise InputError(
            f"size: is {'x'.join(map(str, size))}; allowed: {allowed}; at most {LARGEST_TABLE} texels in all"
        )
    return size


def _red_alone_fails(air: Atmosphere) -> bool:
    """Whether aerosols scatter otherwise in other colours than a single coefficient's ratio tells: more than one
    species, or none of the air that the ratio is taken from."""
    return len(air.mie) > 1 or air.rayleigh is None


def _metadata(
    layout: str,
    air: Atmosphere,
    colours: Channels,
    mu_s_min: float,
    size: tuple[int, ...],
    roles: dict[str, str],
    options: Options,
) -> dict[str, Any]:
    return {
        "mapping": "Bruneton 2017: rho and distance to the top or the ground, split at the horizon; sun cosine crowded "
        "at the horizon; see atmosphere_lookup.glsl",
        "axes": {
            "transmittance": "[altitude][view cosine]",
            "irradiance": "[altitude][sun cosine]",
            "scattering": "[altitude][view cosine][angle to the sun x suns + sun]",
        },
        "scatteringSize": list(size),
        "units": "cd m^-2 and lux" if layout == "cosmoscout" else "W m^-2 nm^-1, per sr where it is radiance",
        **described(colours, air),
        "muSMin": mu_s_min,
        "texels": options.texels or "fitted",
        "holds": roles,
        "tolerance": options.tolerance,
        "orders": options.orders or "all",
    }


def _text(value: Any) -> str | float:
    return value if isinstance(value, (str, float)) else json.dumps(value)


def _snippets(tables: ClientTables, size: tuple[int, int, int, int]) -> list[File]:
    return [
        source("atmosphere_lookup.glsl", glsl(tables.mapping, tables.g, size)),
        source("atmosphere_lookup.hlsl", hlsl(tables.mapping, tables.g, size)),
    ]


def client_tables(
    sky: Sky,
    colours: Channels,
    aerosol: Aerosol,
    mu_s_min: float,
    size: tuple[int, int, int, int],
    block: Block = WHOLE,
) -> ClientTables:
    """Tables of three channels, or a ``block`` of those of scattering. An aerosol that is not the client's keeps its
    radiance at the texels."""
    air = sky.atmosphere

    def weight(species: int, nu: np.ndarray) -> np.ndarray:
        return phase_ratio(air, species, aerosol.g, nu)

    baked = bruneton_tables(sky, mu_s_min, size, None if aerosol.exact else weight, block)
    _, _, _, nu = scattering_nodes(baked.mapping, size, block)
    higher = colours.radiance(baked.higher) / RayleighPhase().value(nu)[..., None].astype(np.float32)
    return ClientTables(
        baked.mapping,
        aerosol.g,
        colours.transmittance(baked.transmittance, air.solar_irradiance),
        colours.radiance(baked.irradiance),
        colours.radiance(baked.rayleigh) + higher,
        colours.radiance(baked.mie),
        higher,
    )


def rounded(tables: ClientTables, arrays: dict[str, np.ndarray]) -> ClientTables:
    """The tables with ``arrays`` in place of theirs: what a file holds."""
    return replace(tables, **{name: v.astype(np.float32) for name, v in arrays.items()})


def table_error(tables: ClientTables, sky: Sky, colours: Channels, seed: int = 0) -> dict[str, Any]:
    """Relative errors of radiance read from ``tables`` against ``sky``, by height of the sun: random observers (a
    quarter of them 2 m above the ground, fewer the higher) and views (a quarter within five degrees of the horizon)."""
    rng = np.random.default_rng(seed)
    thickness = tables.mapping.top - tables.mapping.bottom
    lowest = np.degrees(np.arccos(tables.mapping.mu_s_min))
    groups = {k: (low, min(high, lowest)) for k, (low, high) in SUNS_DEG.items() if low < lowest}
    count = VIEWS * len(groups)
    altitude = 2.0 + (0.98 * thickness - 2.0) * rng.random(count) ** 3
    altitude[::4] = 2.0
    sun = np.radians(np.concatenate([rng.uniform(*span, VIEWS) for span in groups.values()]))
    edge = np.arccos(mapping.horizon(tables.mapping.bottom, altitude))
    view, azimuth = np.arccos(rng.uniform(-1.0, 1.0, count)), rng.uniform(0.0, np.pi, count)
    view[1::4] = edge[1::4] + np.radians(rng.uniform(-5.0, 5.0, view[1::4].size))
    group = np.repeat(np.arange(len(groups)), VIEWS)
    kept = (np.abs(view - edge) > np.radians(OFF_HORIZON_DEG)) & (view < np.pi)
    altitude, sun, view, azimuth, group = (v[kept] for v in (altitude, sun, view, azimuth, group))
    light = sky.rays(*map(doubles, (altitude, sun, view, azimuth)), ground=False).radiance
    exact = colours.radiance(np.stack([v.numpy() for v in light], axis=-1)).T
    found = tables.rays(altitude, sun, view, azimuth).T
    where = {"altitudeM": altitude, "sunZenithDeg": sun, "viewZenithDeg": view, "azimuthDeg": azimuth}
    where = {n: np.degrees(v) if n.endswith("Deg") else v for n, v in where.items()}
    errors = {}
    for i, (name, span) in enumerate(groups.items()):
        some = group == i
        error = compare(found[:, some], exact[:, some], {n: v[some] for n, v in where.items()})
        errors[name] = {"sunZenithDeg": list(span), **asdict(error)}
    return errors

