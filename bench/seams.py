"""Jumps of light where one way to compute it ends and another begins: across zenith, nadir and the sun's zenith, up to
the horizon from both sides, through every height of the sun, and from the ground through every boundary to space.

Views move along paths. Between two points of one where radiance differs, the path is halved again and again: what
changes steeply comes to nothing, a seam stays.

    worst = jumps(atmo_jit.Sky(world), rng)      # {path: largest jump}
"""

from __future__ import annotations

import math
from random import Random

import numpy as np

import atmo_jit
from atmo_jit.backend import doubles

FLOOR = 0.01  # of the brightest on a path: changes of fainter light are relative to this
STEP = 1e-3  # smaller changes are not looked into
START, HALVINGS = 48, 40
ANGLE = 3e-7  # radians: single precision knows none between
ALTITUDE = 4e-7  # of itself: the same
THIN = 1e-4  # optical depth of such a step: through thicker ones light jumps
NEAR = 1e-6  # radians beside the horizon, where views end that come from above or below it

# Columns of a view: altitude (m), zenith angles of sun and view, azimuth (radians). Zenith angles below 0 are on the
# other side.
Path = tuple[list[float], list[float]]


def paths(world: dict, rng: Random) -> dict[str, Path]:
    """Straight paths of views of a world, by what they cross."""
    radius, top = world["bottom_radius_m"], world["top_radius_m"] - world["bottom_radius_m"]
    h = rng.choice((0.0, 1.0, top * rng.random() ** 3))
    sun, view, azimuth = rng.uniform(0.1, 1.7), rng.uniform(0.2, 1.4), rng.uniform(0.1, 3.0)
    horizon = 0.5 * math.pi + math.atan2(math.sqrt(h * (2.0 * radius + h)), radius)
    ground = math.pi - 0.5 * math.asin(radius / (radius + 1.2 * top))
    crossing = {
        "zenith": ([h, sun, -0.3, azimuth], [h, sun, 0.2, azimuth]),
        "nadir": ([h, sun, math.pi - 0.3, azimuth], [h, sun, math.pi + 0.2, azimuth]),
        "sun's zenith": ([h, -0.3, view, azimuth], [h, 0.2, view, azimuth]),
        "sun": ([h, 0.0, view, azimuth], [h, math.pi, view, azimuth]),
        "sun, ground": ([h, 0.0, ground, azimuth], [h, math.pi, ground, azimuth]),
        "azimuth": ([h, sun, view, 0.0], [h, sun, view, 2.0 * math.pi]),
        "down to the horizon": ([h, sun, 0.0, azimuth], [h, sun, horizon - NEAR, azimuth]),
        "up to the horizon": ([h, sun, math.pi, azimuth], [h, sun, horizon + NEAR, azimuth]),
    }
    if _densest(world) * ALTITUDE * top < THIN:
        crossing["altitude, up"] = [0.0, sun, view, azimuth], [1.2 * top, sun, view, azimuth]
        crossing["altitude, down"] = [0.0, sun, ground, azimuth], [1.2 * top, sun, ground, azimuth]
    return crossing


def _densest(world: dict) -> float:
    """The sum of the largest extinction coefficients (1/m)."""
    total = 0.0
    for block in [world["rayleigh"], *(world["mie"] or ()), world["ozone"]]:
        if block:
            part = np.max(block.get("scattering_per_m", 0.0)) / np.min(block.get("single_scattering_albedo", 1.0))
            total += part + np.max(block.get("absorption_per_m", 0.0))
    return float(total)


def jumps(sky: atmo_jit.Sky, world: dict, rng: Random) -> dict[str, float]:
    """The largest change of radiance, by path, between two views that single precision cannot tell from one another by
    more than a few bits; relative to the brighter of them."""
    ways = paths(world, rng)
    ends = np.array(list(ways.values()))  # [path, 2, columns]

    def views(path: np.ndarray, s: np.ndarray) -> np.ndarray:
        return ends[path, 0] + (ends[path, 1] - ends[path, 0]) * s[:, None]

    def radiance(path: np.ndarray, s: np.ndarray) -> np.ndarray:
        h, sun, view, azimuth = views(path, s).T
        azimuth = azimuth + np.pi * ((sun < 0.0) ^ (view < 0.0))
        light = sky.rays(*(doubles(v) for v in (h, np.abs(sun), np.abs(view), azimuth)))
        return np.stack([np.broadcast_to(v.numpy(), s.shape) for v in light.radiance], axis=-1).astype(float)

    # Dense at both ends: air is thin or lies at the ground.
    half = np.geomspace(1e-6, 0.5, START)
    at = np.concatenate([[0.0], half, 1.0 - half[-2::-1], [1.0]])
    path, s = (v.ravel() for v in np.meshgrid(np.arange(len(ends)), at, indexing="ij"))
    light = radiance(path, s).reshape(len(ends), len(at), -1)
    least = np.maximum(FLOOR * light.max(axis=1), 1e-9 * np.max(world["solar_irradiance"]))
    path = np.repeat(np.arange(len(ends)), len(at) - 1)
    low, high = np.tile(at[:-1], len(ends)), np.tile(at[1:], len(ends))
    below, above = light[:, :-1].reshape(len(path), -1), light[:, 1:].reshape(len(path), -1)
    found = np.zeros(len(ends))
    for n in range(HALVINGS):
        steps = (np.abs(above - below) / np.maximum(np.maximum(above, below), least[path])).max(axis=1)
        one, other = views(path, low), views(path, high)
        apart = np.abs(other - one)
        split = (apart[:, 1:].max(axis=1) > ANGLE) | (apart[:, 0] > ALTITUDE * other[:, 0])
        done = ~split | (n == HALVINGS - 1)
        np.maximum.at(found, path[done], steps[done])
        left = (steps > STEP) & ~done
        if not left.any():
            break
        path, low, high, below, above = (v[left] for v in (path, low, high, below, above))
        middle = 0.5 * (low + high)
        between = radiance(path, middle)
        np.maximum.at(least, path, FLOOR * between)
        path, low, high = np.tile(path, 2), np.concatenate([low, middle]), np.concatenate([middle, high])
        below, above = np.concatenate([below, between]), np.concatenate([between, above])
    return dict(zip(ways, found.tolist(), strict=True))
