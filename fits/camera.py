"""Where the pixels of a Mitsuba camera look: cameras of pictures that a fit is given.

World space is that of the emitter ``atmosphere``: Z up, X south and Y west. A camera looks along its local +Z, with +Y
up and +X to the left.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from atmo_jit.errors import InputError, shown

LOOK_AT = ("origin", "target", "up")
ALONG = 1e-6  # sine of an angle that is none


@dataclass(frozen=True)
class SceneCamera:
    """What the first sensor of a scene sees: ``direction`` [height, width, 3] of every pixel's centre, in the frame of
    the emitter ``atmosphere``, whose ``sun`` (a vector) and ``altitude_m`` these are; ``free``: the pixels that show
    the sky, and so do their neighbours."""

    direction: np.ndarray
    free: np.ndarray
    sun: np.ndarray
    altitude_m: float


def of_scene(path: Path, height: int, width: int) -> SceneCamera:
    """The camera of a scene file for a picture of this size. Raises InputError for a file that is no scene with one
    emitter ``atmosphere``, and without Mitsuba."""
    try:
        import mitsuba as mi
    except ImportError:
        raise InputError("picture.scene: cameras of scenes need Mitsuba: pip install mitsuba") from None
    if mi.variant() is None:
        mi.set_variant("llvm_ad_rgb")
    from atmo_jit.plugins import register
    from atmo_jit.plugins.needs import camera_of_scene
    from atmo_jit.scenes.reader import load_scene

    register()
    size = {"width": width, "height": height}
    direction, free, sun, altitude = camera_of_scene(lambda edit: load_scene(path, **size, edit=edit), **size)
    padded = np.pad(free, 1, mode="edge")
    around = [padded[1 + i : 1 + i + height, 1 + j : 1 + j + width] for i in (-1, 0, 1) for j in (-1, 0, 1)]
    return SceneCamera(direction, np.all(around, axis=0), sun, altitude)


def perspective(turn: np.ndarray, fov_deg: float, height: int, width: int) -> np.ndarray:
    """Directions [height, width, 3] of the pixels' centres of the sensor ``perspective``; ``turn``: rotation [3, 3] to
    the world, ``fov_deg`` across the picture's width."""
    v, u = np.meshgrid((np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width, indexing="ij")
    half = np.tan(np.radians(fov_deg) / 2.0)
    local = np.stack([(1.0 - 2.0 * u) * half, (1.0 - 2.0 * v) * half * height / width, np.ones(u.shape)], axis=-1)
    world = local @ turn.T
    return world / np.linalg.norm(world, axis=-1, keepdims=True)


def rotation(look_at: Any) -> np.ndarray:
    """Rotation [3, 3] of a camera at ``origin`` that looks at ``target``, its top toward ``up``: Mitsuba's look_at.
    Raises InputError for what is no such table."""
    if not isinstance(look_at, Mapping) or set(look_at) != set(LOOK_AT):
        raise InputError(f"picture.look_at: is {shown(look_at)}; must be a table of {', '.join(LOOK_AT)}")
    vectors = {}
    for key in LOOK_AT:
        try:
            vectors[key] = np.array(look_at[key], dtype=float)
        except (TypeError, ValueError):
            vectors[key] = np.zeros(0)
        if vectors[key].shape != (3,) or not np.all(np.isfinite(vectors[key])):
            raise InputError(f"picture.look_at.{key}: is {shown(look_at[key])}; must be three numbers")
    forward = vectors["target"] - vectors["origin"]
    left = np.cross(vectors["up"], forward)
    if not np.linalg.norm(left) > ALONG * np.linalg.norm(vectors["up"]) * np.linalg.norm(forward):
        raise InputError("picture.look_at: looks nowhere, or along up; origin, target and up must span a plane")
    forward, left = (v / np.linalg.norm(v) for v in (forward, left))
    return np.stack([left, np.cross(forward, left), forward], axis=1)


def angles_deg(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Zenith angle and azimuth (clockwise from north) of directions [..., 3] in degrees."""
    x, y, z = np.moveaxis(np.asarray(direction, float), -1, 0)
    return np.degrees(np.arctan2(np.hypot(x, y), z)), np.degrees(np.arctan2(-y, -x))
