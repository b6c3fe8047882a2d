"""Hillaire's four tables: transmittance, multiple scattering, sky view, aerial perspective.

Clients (Unreal, Bevy, WebGPU) compute theirs by themselves: these are for comparison, with the parameters to compute
them from. Every texel holds the solution at its centre. H20: Hillaire 2020 and its code.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import drjit as dr
import numpy as np

from .. import mapping
from ..atmosphere import Atmosphere
from ..backend import doubles, floats, types
from ..bake.client import transmittance_up
from ..bake.error import compare
from ..errors import InputError
from ..mapping import Hillaire, texels
from ..quadrature import gauss_legendre
from ..solved import Sky
from .colour import Channels, channels, described
from .containers import File, exr, halved, npy
from .exporter import Clock, Made, Options, only, refuse
from .lookup import linear
from .parameters import aerosol, client_parameters

TRANSMITTANCE, MULTIPLE, SKY_VIEW, AERIAL = (64, 256), (32, 32), (108, 192), (32, 32, 32)
SLICE_M = 4000.0
CAMERA = {"horizontalDeg": 90.0, "verticalDeg": 60.0}  # a level view toward the sun's azimuth
DIRECTIONS = (10, 12)  # zenith angles and azimuths of the mean over directions
ROLES = {
    "transmittance": "to the top; [x_r][x_mu], texel i of n at (i + 1/2) / n",
    "multi_scattering": "mean over all directions of light of all orders, per unit of solar irradiance (1/sr); "
    "[altitude][sun cosine], texel i of n at i / (n - 1)",
    "sky_view": "radiance of the air alone; [v][u], texel i of n at i / (n - 1): zenith to horizon to nadir, azimuth "
    "of the sun to the opposite",
    "aerial_perspective": "radiance of the air up to the slice and mean transmittance to it (alpha); "
    "[slice][row][column], slice k at ((k + 1/2) / n)^2 of the reach",
}


def make(layout: str, air: Atmosphere, options: Options, clock: Clock, progress: Callable[[float], None]) -> Made:
    """Files of the layout."""
    refuse(layout, options, ("mu_s_min", "size", "texels"))
    precision = only(layout, "precision", options.precision, ("half", "float"), "of the EXR files")
    colours = channels(air, options.colour or "samples")
    altitude = 2.0 if options.altitude_m is None else options.altitude_m
    sun = 60.0 if options.sun_zenith_deg is None else options.sun_zenith_deg
    if not 0.0 <= altitude < air.thickness_m:
        allowed = f"from 0 to below {air.thickness_m:g} m, the top of the air"
        raise InputError(f"altitude: is {altitude:g}; allowed: {allowed}")
    if not 0.0 <= sun <= 180.0:
        raise InputError(f"sun: is {sun:g}; allowed: a zenith angle from 0 to 180 degrees")
    one, warnings = aerosol(air), []
    warnings += one.warnings
    sky = Sky(air, options.orders, options.tolerance)
    clock.stage("solve")
    to = Hillaire(air.bottom_radius_m, air.top_radius_m)
    tables = {
        "transmittance": colours.transmittance(transmittance(sky, to), air.solar_irradiance),
        "multi_scattering": colours.transmittance(multiple_scattering(sky, to), air.solar_irradiance),
        "sky_view": colours.radiance(sky_view(sky, to, altitude, sun)),
    }
    progress(0.5)
    light, through = aerial_perspective(sky, altitude, sun)
    alpha = colours.transmittance(through, air.solar_irradiance).mean(axis=-1, keepdims=True)
    tables["aerial_perspective"] = np.concatenate([colours.radiance(light), alpha], axis=-1)
    clock.stage("bake")
    error = {"skyView": asdict(sky_view_error(tables["sky_view"], sky, colours, to, altitude, sun))}
    clock.stage("estimate the error")
    about = {
        "mapping": "Hillaire 2020",
        "holds": ROLES,
        "units": "W m^-2 nm^-1 sr^-1; multi_scattering 1/sr",
        **described(colours, air),
        "skyViewAltitudeM": altitude,
        "skyViewSunZenithDeg": sun,
        "aerialPerspective": {"sliceM": SLICE_M, "reachM": SLICE_M * AERIAL[0], **CAMERA},
        "tolerance": options.tolerance,
        "orders": options.orders or "all",
    }
    return Made(
        table_files(tables, precision, warnings, ROLES),
        client_parameters(air, colours, -1.0, one.g),
        about,
        error,
        warnings,
    )


def table_files(
    tables: dict[str, np.ndarray], precision: str, warnings: list[str], roles: dict[str, str]
) -> list[File]:
    """.npy in float32 and .exr in either precision of every table."""
    found = []
    for name, table in tables.items():
        stored = halved(name, table, warnings) if precision == "half" else table.astype(np.float32)
        found += [npy(f"{name}.npy", table.astype(np.float32)), exr(f"{name}.exr", stored, {"holds": roles[name]})]
    return found


def transmittance(sky: Sky, to: Hillaire) -> np.ndarray:
    """[x_r, x_mu, W]."""
    places = np.meshgrid(*(texels(n, ends=False) for n in TRANSMITTANCE), indexing="ij")
    h, mu = to.transmittance_inverse(*places)
    through = [v for band in sky.bands for v in transmittance_up(band.optics, h.ravel(), mu.ravel())]
    return np.stack(through, axis=-1).reshape(*TRANSMITTANCE, -1)


def multiple_scattering(sky: Sky, to: Hillaire) -> np.ndarray:
    """Mean radiance over all directions per unit of solar irradiance [altitude, sun, W], 1/sr: H20's Psi_ms, from the
    solved field in place of a geometric series.

    The mean of what is scattered toward all directions is the mean of what arrives, whatever the phase function.
    """
    x_h, x_s = np.meshgrid(*map(texels, MULTIPLE), indexing="ij")
    h, mu_s = (v.ravel() for v in to.multiple_scattering_inverse(x_h, x_s))
    x, w = gauss_legendre(DIRECTIONS[0])
    phi = np.pi * (np.arange(DIRECTIONS[1]) + 0.5) / DIRECTIONS[1]
    t, count = types(), DIRECTIONS[0] * DIRECTIONS[1]
    lane = dr.arange(t.UInt, h.size * count)
    node, view = lane // count, lane % count
    cosines = dr.gather(t.Float, floats(2.0 * x - 1.0), view // DIRECTIONS[1])
    azimuths = dr.gather(t.Float, floats(np.cos(phi)), view % DIRECTIONS[1])
    found = []
    for band in sky.bands:
        if band.source is None:
            found.append(np.zeros((h.size, band.optics.channel_count)))
            continue
        place = (dr.gather(t.Float, floats(v), node) for v in (h, mu_s))
        toward = band.source.scattered(*place, cosines, azimuths, True)[0]
        dr.eval(toward)
        values = np.stack([v.numpy() for v in toward], axis=-1).reshape(h.size, *DIRECTIONS, -1)
        found.append(np.einsum("nvac,v->nc", values, w) / DIRECTIONS[1])
    sun = sky.atmosphere.solar_irradiance
    values = np.concatenate(found, axis=-1) / np.where(sun > 0.0, sun, 1.0)
    return values.reshape(*MULTIPLE, -1).astype(np.float32)


def sky_view(sky: Sky, to: Hillaire, altitude: float, sun_deg: float) -> np.ndarray:
    """Radiance without the ground's own [v, u, W]."""
    v, u = np.meshgrid(*map(texels, SKY_VIEW), indexing="ij")
    mu, cos_phi, _ = to.sky_view_inverse(np.full(v.shape, altitude), v, u)
    zenith, azimuth = (np.arccos(np.clip(c, -1.0, 1.0)).ravel() for c in (mu, cos_phi))
    return _radiance(sky, altitude, sun_deg, zenith, azimuth).reshape(*SKY_VIEW, -1)


def sky_view_error(
    table: np.ndarray, sky: Sky, colours: Channels, to: Hillaire, altitude: float, sun_deg: float
) -> Any:
    """Of the table, read linearly, at random views half a degree or more from the horizon."""
    rng = np.random.default_rng(0)
    zenith, azimuth = np.arccos(rng.uniform(-1.0, 1.0, 2000)), rng.uniform(0.0, np.pi, 2000)
    edge = np.arccos(mapping.horizon(to.bottom, np.float64(altitude)))
    kept = np.abs(zenith - edge) > np.radians(0.5)
    zenith, azimuth = zenith[kept], azimuth[kept]
    where = to.sky_view(np.full(zenith.shape, altitude), np.cos(zenith), np.cos(azimuth), zenith > edge)
    exact = colours.radiance(_radiance(sky, altitude, sun_deg, zenith, azimuth))
    places = {"viewZenithDeg": np.degrees(zenith), "azimuthDeg": np.degrees(azimuth)}
    return compare(linear(table, *where).T, exact.T, places)


def aerial_perspective(sky: Sky, altitude: float, sun_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Radiance of the air and transmittance to the slices' distances [slice, row, column, W]."""
    slices, rows, columns = AERIAL
    w, v, u = np.meshgrid(*(texels(n, ends=False) for n in AERIAL), indexing="ij")
    distance = Hillaire.slice_inverse(w, SLICE_M * slices).ravel()
    across, up = (np.tan(np.radians(0.5 * CAMERA[k])) for k in ("horizontalDeg", "verticalDeg"))
    y, z = ((2.0 * u - 1.0) * across).ravel(), ((1.0 - 2.0 * v) * up).ravel()
    zenith, azimuth = np.arctan2(np.hypot(1.0, y), z), np.arctan2(y, 1.0)
    constant = [np.full(zenith.shape, c) for c in (altitude, np.radians(sun_deg))]
    light = sky.rays(*map(doubles, (*constant, zenith, azimuth, distance)), ground=False)
    return tuple(
        np.stack([c.numpy() for c in part], axis=-1).reshape(*AERIAL, -1)
        for part in (light.radiance, light.transmittance)
    )


def _radiance(sky: Sky, altitude: float, sun_deg: float, zenith: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    constant = [np.full(zenith.shape, c) for c in (altitude, np.radians(sun_deg))]
    light = sky.rays(*map(doubles, (*constant, zenith, azimuth)), ground=False).radiance
    return np.stack([v.numpy() for v in light], axis=-1)
