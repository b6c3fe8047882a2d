"""Which views of a list are worth a table, and their light from it.

A table costs as much as marching some thousands of rays and then next to nothing per view. Views that share observer
and sun get a :class:`SkyView`; many observers and suns get :class:`Tables4D`. Always marched are rays that stop early,
rays close to the horizon or to the edge of the air, where tables err most, and rays that may meet a sun's disc that is
asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from .. import mapping
from ..backend import doubles, floats
from ..solved import Sky
from .sky_view import SkyView
from .tables import Tables4D

Arrays = list[np.ndarray]

# What a table costs in marched rays: `python -m bench.tables` prints both.
SKY_VIEW_RAYS, TABLES_RAYS = 4_000, 100_000
# Errors of tables that "auto" allows for: it takes them at tolerances from these on, the 4-D ones for suns by day only.
SKY_VIEW_TOLERANCE, TABLES_TOLERANCE, TABLES_LOWEST_SUN_DEG = 0.005, 0.02, 80.0
HORIZON_DEG = 1.0
CHECKED = 64  # views compared with the march


@dataclass
class Plan:
    """Indices of views: ``march``; those of each sky view with its altitude (m) and sun zenith (deg); ``tables``."""

    march: np.ndarray
    sky_views: list[tuple[float, float, np.ndarray]]
    tables: np.ndarray


def plan(sky: Sky, views: Mapping[str, np.ndarray], method: str, tolerance: float, sun_disc: bool) -> Plan:
    """What to do with ``views`` (as from check_views): "tables" wherever they serve, "auto" where they pay and the
    tolerance allows."""
    altitude, sun, zenith = (views[name] for name in ("altitude_m", "sun_zenith_deg", "view_zenith_deg"))
    air = sky.atmosphere
    fit = np.full(zenith.shape, bool(sky.bands[0].optics.scatterers))  # without them there is nothing to interpolate
    edges = [mapping.horizon(air.bottom_radius_m, altitude)]
    edges.append(mapping.horizon(air.top_radius_m, np.maximum(altitude - air.thickness_m, 0.0)))
    for edge, seen in zip(edges, (True, altitude > air.thickness_m), strict=True):
        fit &= ~(seen & (np.abs(zenith - np.degrees(np.arccos(edge))) <= HORIZON_DEG))
    if "distance_m" in views:
        fit &= np.isinf(views["distance_m"])
    if sun_disc:
        fit &= np.abs(zenith - sun) > 2.0 * air.sun_angular_radius_deg
    pairs, which, counts = np.unique(np.stack([altitude, sun]), axis=1, return_inverse=True, return_counts=True)
    which = which.ravel()
    counts = np.bincount(which[fit], minlength=len(counts))
    pays = counts >= SKY_VIEW_RAYS
    if method == "auto" and tolerance < SKY_VIEW_TOLERANCE:
        pays[:] = False
    left = fit & ~pays[which]
    inside = altitude <= air.thickness_m
    if method == "tables":
        few = len(np.unique(which[left])) * SKY_VIEW_RAYS <= TABLES_RAYS
        pays |= (counts > 0) if few else (pairs[0] > air.thickness_m) & (counts > 0)
        in_tables = fit & ~pays[which]
    else:
        in_tables = left & inside & (sun <= TABLES_LOWEST_SUN_DEG) & (tolerance >= TABLES_TOLERANCE)
        in_tables &= np.count_nonzero(in_tables) > TABLES_RAYS
    seen = fit & pays[which]
    sky_views = [(*pairs[:, i].tolist(), np.flatnonzero(seen & (which == i))) for i in np.flatnonzero(pays)]
    return Plan(np.flatnonzero(~(seen | in_tables)), sky_views, np.flatnonzero(in_tables))


def evaluate(
    sky: Sky,
    views: Mapping[str, np.ndarray],
    *,
    method: str,
    tolerance: float,
    ground: bool,
    sun_disc: bool,
    march: Callable[[Mapping[str, np.ndarray]], Arrays],
) -> tuple[Arrays, dict[str, Any]]:
    """Radiance, transmittance, sun and sky irradiance of ``views``, float32 [N, W], and what was done (for meta).

    ``march`` does the same for views by marching. "auto" goes back to it where a sample of the views misses the
    tolerance.
    """
    chosen = plan(sky, views, method, tolerance, sun_disc)
    by_table = np.concatenate([*(rows for *_, rows in chosen.sky_views), chosen.tables]).astype(int)
    if not len(by_table):
        return march(views), {"method": "march"}
    shape = (len(views["altitude_m"]), len(sky.atmosphere.wavelengths_nm))
    radiance, transmittance = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    zenith, azimuth = (np.radians(views[name]) for name in ("view_zenith_deg", "azimuth_deg"))
    for altitude, sun, rows in chosen.sky_views:
        table = SkyView(sky, altitude, np.radians(sun), ground=ground)
        angle = floats(zenith[rows])
        _store(radiance, rows, table.radiance(angle, floats(azimuth[rows])))
        _store(transmittance, rows, table.transmittance(angle))
    if len(chosen.tables):
        rows = chosen.tables
        place = (views["altitude_m"], np.radians(views["sun_zenith_deg"]), zenith, azimuth)
        light = Tables4D(sky).rays(*(doubles(v[rows]) for v in place), ground=ground)
        _store(radiance, rows, light.radiance)
        _store(transmittance, rows, light.transmittance)
    sample = np.random.default_rng(0).permutation(by_table)[:CHECKED]
    exact = march({name: v[sample] for name, v in views.items()})[0]
    scale = np.maximum(exact, 1e-3 * exact.max(axis=0, initial=0.0))
    difference = np.abs(radiance[sample] - exact)
    error = float(np.percentile(difference / np.where(scale > 0.0, scale, 1.0), 95))
    if method == "auto" and error > tolerance:
        return march(views), {"method": "march", "tables_missed_by": error}
    sun, scattered = _irradiance(sky, views)
    if len(chosen.march):
        rows = chosen.march
        radiance[rows], transmittance[rows], *_ = march({name: v[rows] for name, v in views.items()})
    done = {
        "method": "tables",
        "sky_views": len(chosen.sky_views),
        "tables_4d": int(bool(len(chosen.tables))),
        "views_by_tables": len(by_table),
        "error_of_a_sample": error,
    }
    return [radiance, transmittance, sun, scattered], done


def _store(target: np.ndarray, rows: np.ndarray, values: list[Any]) -> None:
    dr.eval(values)
    for c, value in enumerate(values):
        target[rows, c] = value.numpy()


def _irradiance(sky: Sky, views: Mapping[str, np.ndarray]) -> list[np.ndarray]:
    """Sun and sky irradiance [N, W], once for every observer and sun."""
    pairs, which = np.unique(np.stack([views["altitude_m"], views["sun_zenith_deg"]]), axis=1, return_inverse=True)
    both = sky.irradiance(doubles(pairs[0]), doubles(np.radians(pairs[1])))
    arrays = [np.stack([np.broadcast_to(v.numpy(), pairs.shape[1]) for v in values], axis=-1) for values in both]
    return [np.ascontiguousarray(a[which.ravel()], dtype=np.float32) for a in arrays]
