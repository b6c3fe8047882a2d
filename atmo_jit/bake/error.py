"""How far a table is from the solution it was baked from, at random views that are none of its nodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from .. import mapping
from ..backend import doubles, floats
from ..solved import Sky
from .froxels import Froxels
from .sky_view import SkyView
from .tables import Tables4D

DARKEST = 1e-3  # errors are relative to the radiance, or to this part of the brightest in its channel


@dataclass(frozen=True)
class Error:
    """Relative errors of radiance over views and wavelengths; ``where``: the worst view, with its place."""

    median: float
    p95: float
    p99: float
    worst: float
    where: dict[str, float]

    def __str__(self) -> str:
        place = ", ".join(f"{name} {value:.5g}" for name, value in self.where.items())
        figures = (100.0 * v for v in (self.median, self.p95, self.p99, self.worst))
        return "median {:.3f} p95 {:.3f} p99 {:.3f} worst {:.2f} %".format(*figures) + f" ({place})"


def compare(found: Sequence[Any], exact: Sequence[Any], where: dict[str, np.ndarray]) -> Error:
    """Error of radiances, lists of W Floats or arrays [W, N]; ``where``: arrays [N] that tell the views."""
    dr.eval([v for v in (found, exact) if not isinstance(v, np.ndarray)])
    got, true = (np.stack([np.asarray(v) for v in values]).astype(float) for values in (found, exact))
    scale = np.maximum(true, DARKEST * true.max(axis=1, keepdims=True, initial=0.0))
    error = np.abs(got - true) / np.where(scale > 0.0, scale, 1.0)
    worst = int(error.max(axis=0).argmax())
    place = {name: float(np.broadcast_to(v, error.shape[1])[worst]) for name, v in where.items()}
    return Error(*(float(np.percentile(error, p)) for p in (50, 95, 99)), float(error.max()), place)


def sky_view_error(
    view: SkyView, sky: Sky, count: int = 2000, seed: int = 0, off_horizon_deg: float = 0.5, ground: bool = True
) -> Error:
    """Of a SkyView against ``Sky.rays``: half of the views anywhere, a quarter within ten degrees of the sun, a quarter
    within ten of the horizon; none closer to it than ``off_horizon_deg``."""
    rng = np.random.default_rng(seed)
    edge = float(np.arccos(mapping.horizon(sky.atmosphere.bottom_radius_m, np.float64(view.altitude_m))))
    zenith, azimuth = np.arccos(rng.uniform(-1.0, 1.0, count)), rng.uniform(0.0, np.pi, count)
    quarter, sun = count // 4, view.sun_zenith
    off, turn = np.radians(10.0) * rng.random(quarter), rng.uniform(0.0, 2.0 * np.pi, quarter)
    mu = np.cos(sun) * np.cos(off) + np.sin(sun) * np.sin(off) * np.cos(turn)
    zenith[:quarter] = np.arccos(np.clip(mu, -1.0, 1.0))
    beside = np.cos(off) - mu * np.cos(sun)
    azimuth[:quarter] = np.abs(np.arctan2(np.sin(off) * np.sin(turn) * np.sin(sun), beside))
    zenith[quarter : 2 * quarter] = edge + np.radians(rng.uniform(-10.0, 10.0, quarter))
    kept = (np.abs(zenith - edge) > np.radians(off_horizon_deg)) & (zenith < np.pi)
    zenith, azimuth = zenith[kept], azimuth[kept]
    constant = [np.full(zenith.size, v) for v in (view.altitude_m, sun)]
    exact = sky.rays(*map(doubles, (*constant, zenith, azimuth)), ground=ground)
    found = view.radiance(floats(zenith), floats(azimuth))
    where = {"view_zenith_deg": np.degrees(zenith), "azimuth_deg": np.degrees(azimuth)}
    return compare(found, exact.radiance, where)


def tables_error(
    tables: Tables4D,
    suns_deg: tuple[float, float] = (0.0, 85.0),
    count: int = 4000,
    seed: int = 0,
    off_horizon_deg: float = 0.5,
) -> Error:
    """Of Tables4D against ``Sky.rays`` for suns between ``suns_deg``, without the ground's own light: a quarter of the
    observers a metre above the ground, the others up to the top, fewer the higher; a quarter of the views within five
    degrees of the horizontal."""
    rng = np.random.default_rng(seed)
    altitude = 0.98 * tables.thickness * rng.random(count) ** 3
    altitude[: count // 4] = 1.0
    sun = np.radians(rng.uniform(*suns_deg, count))
    zenith, azimuth = np.arccos(rng.uniform(-1.0, 1.0, count)), rng.uniform(0.0, np.pi, count)
    level = slice(count // 4, count // 2)
    zenith[level] = np.radians(rng.uniform(85.0, 95.0, level.stop - level.start))
    edge = np.arccos(mapping.horizon(tables.radius, altitude))
    kept = np.abs(zenith - edge) > np.radians(off_horizon_deg)
    place = [v[kept] for v in (altitude, sun, zenith, azimuth)]
    exact = tables.sky.rays(*map(doubles, place), ground=False)
    found = tables.rays(*map(doubles, place), ground=False)
    names = ("sun_zenith_deg", "view_zenith_deg", "azimuth_deg")
    where = {"altitude_m": place[0]} | {n: np.degrees(v) for n, v in zip(names, place[1:], strict=True)}
    return compare(found.radiance, exact.radiance, where)


def froxels_error(froxels: Froxels, sky: Sky, count: int = 2000, seed: int = 0) -> Error:
    """Of Froxels against ``Sky.rays`` with distances: points anywhere in the table, above the ground, more of them
    near."""
    rng = np.random.default_rng(seed)
    v, u, distance = rng.random(count), rng.random(count), froxels.reach_m * rng.random(count) ** 2
    x, y, z = (c.numpy().astype(float) for c in froxels.direction(floats(v), floats(u)))
    zenith, azimuth = np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)
    radius, h = sky.atmosphere.bottom_radius_m, froxels.altitude_m
    along, square = (radius + h) * np.cos(zenith), h * (2.0 * radius + h)
    hits = (along < 0.0) & (along**2 > square)
    kept = ~hits | (distance < -along - np.sqrt(np.maximum(along**2 - square, 0.0)))
    v, u, distance, zenith, azimuth = (a[kept] for a in (v, u, distance, zenith, azimuth))
    constant = [np.full(v.size, a) for a in (froxels.altitude_m, froxels.sun_zenith)]
    exact = sky.rays(*map(doubles, (*constant, zenith, azimuth, distance)), ground=False)
    found = froxels.at(floats(v), floats(u), floats(distance))
    where = {"view_zenith_deg": np.degrees(zenith), "azimuth_deg": np.degrees(azimuth), "distance_m": distance}
    return compare(found.radiance, exact.radiance, where)
