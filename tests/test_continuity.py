"""From the ground to space without a seam: along a climbing path radiance has no jump.

Between two altitudes where it differs by more than half a per cent the path is halved again and again. Light that
changes, however steeply, comes below that; a seam between two ways to compute it would not.
"""

from __future__ import annotations

import numpy as np
import pytest

from atmo_jit import Sky

STEP = 0.005  # of the radiance, or of FLOOR times the path's largest
FLOOR = 0.01  # where air ends at a finite density, light goes to zero as a square root of the altitude left
SUNS = np.array([0.0, 60.0, 88.0, 92.0, 97.0])
# Zenith, nadir, and degrees above the horizon, which sinks while the camera climbs.
VIEWS = ("zenith", "nadir", 40.0, 5.0, 0.5, -0.5, -5.0, -40.0)


def view_zenith(kind: np.ndarray, altitude: np.ndarray, radius: float) -> np.ndarray:
    dip = np.arctan2(np.sqrt(altitude * (2.0 * radius + altitude)), radius)
    fixed = np.array([0.0, np.pi] + [0.0] * (len(VIEWS) - 2))
    above = np.radians([0.0, 0.0, *VIEWS[2:]])
    return np.where(kind < 2, fixed[kind], np.clip(np.pi / 2 + dip - above[kind], 0.0, np.pi))


@pytest.mark.parametrize("preset", ["earth", "hillaire2020"])
def test_climb_from_ground_to_space(preset: str) -> None:
    sky = Sky(preset)
    radius, top = sky.atmosphere.bottom_radius_m, sky.atmosphere.thickness_m

    def radiance(path: np.ndarray, altitude: np.ndarray) -> np.ndarray:
        sun, kind = np.radians(SUNS[path // len(VIEWS)]), path % len(VIEWS)
        light = sky.rays(altitude, sun, view_zenith(kind, altitude, radius), np.full(len(path), 0.5))
        return np.stack([np.broadcast_to(v.numpy(), path.shape) for v in light.radiance], axis=-1).astype(float)

    heights = np.concatenate([[0.0], np.geomspace(1.0, top, 160), top * np.geomspace(1.0 + 1e-6, 1e6 / top, 80)])
    paths = np.arange(len(SUNS) * len(VIEWS))
    path, altitude = (v.ravel() for v in np.meshgrid(paths, heights, indexing="ij"))
    light = radiance(path, altitude).reshape(len(paths), len(heights), -1)
    least = FLOOR * light.max(axis=1)
    path = np.repeat(paths, len(heights) - 1)
    low, high = np.tile(heights[:-1], len(paths)), np.tile(heights[1:], len(paths))
    below, above = light[:, :-1].reshape(len(path), -1), light[:, 1:].reshape(len(path), -1)
    for _ in range(40):
        steps = np.abs(above - below) / np.maximum(np.maximum(above, below), least[path])
        left = (steps.max(axis=1) > STEP) & (high - low > 1e-4)
        if not left.any():
            break
        path, low, high, below, above = (v[left] for v in (path, low, high, below, above))
        middle = 0.5 * (low + high)
        between = radiance(path, middle)
        path, low, high = np.tile(path, 2), np.concatenate([low, middle]), np.concatenate([middle, high])
        below, above = np.concatenate([below, between]), np.concatenate([between, above])
    worst = int(np.argmax(steps.max(axis=1)))
    sun, kind = SUNS[path[worst] // len(VIEWS)], VIEWS[path[worst] % len(VIEWS)]
    assert steps.max() <= STEP, f"sun {sun}, view {kind}: {100 * steps.max():.2f} % at {low[worst]:.4f} m"
