"""What a scene asks of the air: the parameters of its emitter ``atmosphere`` and what its camera sees, with nothing
solved.

    found = needs_of_scene(lambda edit: load_scene("scenes/noon.xml", edit=edit))
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from atmo_jit.errors import InputError

from . import albedo, settings

# Rays of the picture that are looked along: what lies between two of them counts as seen.
COLUMNS, ROWS = 96, 54


class AtmosphereNeeds:
    """Stands in for the emitter ``atmosphere`` while a scene is read: ``found`` are its settings, ``sun`` is the sun's
    direction in world space and ``sun_zenith_deg`` in the emitter's own frame. It gives no light."""

    def __init__(self, props: Any) -> None:
        mi.Emitter.__init__(self, props)
        self.m_flags = mi.EmitterFlags.Infinite | mi.EmitterFlags.SpatiallyVarying
        given = props.get_texture("albedo") if "albedo" in props else None
        read = None if given is None else lambda nm: albedo.values(given, nm)
        self.found = settings.read(props, lambda name: str(mi.file_resolver().resolve(name)), read)
        matrix = np.array(props["to_world"].matrix, dtype=np.float64) if "to_world" in props else np.eye(4)
        settings.turning(matrix)
        turn = matrix[:3, :3] / np.cbrt(abs(np.linalg.det(matrix[:3, :3])))
        direction = np.array(self.found.direction, dtype=np.float64)
        local = direction if self.found.moment is not None else turn.T @ direction
        if self.found.refraction:
            local = np.array(settings.as_seen(self.found.atmosphere, self.found.altitude_m, local, local))
        self.turn, self.sun = turn, turn @ local
        self.sun_zenith_deg = float(np.degrees(np.arctan2(np.hypot(local[0], local[1]), local[2])))

    def bbox(self) -> Any:
        return mi.ScalarBoundingBox3f()

    def to_string(self) -> str:
        return "AtmosphereNeeds[]"


@dataclass(frozen=True)
class SceneNeeds:
    """``settings`` of the emitter; the sun's zenith angle; ``sees_sky``: some ray of the picture meets no shape;
    ``sees_sun``: some such ray passes near the sun's disc; ``pixels`` of the picture."""

    settings: settings.Settings
    sun_zenith_deg: float
    sees_sky: bool
    sees_sun: bool
    pixels: int


def edit(state: Any) -> None:
    """Put the stand-in into a parsed scene; raises InputError where it has not exactly one emitter ``atmosphere``."""
    lights = [
        node.props
        for node in state.nodes
        if node.type == mi.ObjectType.Emitter and node.props.plugin_name() == "atmosphere"
    ]
    if len(lights) != 1:
        raise InputError(f"the scene has {len(lights)} emitters of type atmosphere; must be one")
    lights[0].set_plugin_name("atmosphere_needs")


def needs_of_scene(load: Callable[[Callable[[Any], None]], Any]) -> SceneNeeds:
    """Read a scene with ``load(edit)`` and look along some rays of its first sensor."""
    scene = load(edit)
    (light,) = (e for e in scene.emitters() if hasattr(e, "sun_zenith_deg"))
    sensor = scene.sensors()[0]
    direction, free = _seen(scene, sensor)
    size = sensor.film().crop_size()
    sees_sky = bool(free.any())
    near = False
    if sees_sky:
        sun = light.sun / np.linalg.norm(light.sun)
        angle = np.degrees(np.arccos(np.clip(direction @ sun, -1.0, 1.0)))
        radius = max(light.found.atmosphere.sun_angular_radius_deg, 0.5 * settings.SMALLEST_SUN_DEG)
        # The sun may be between two rays, or show beside the edge of a shape between them: both count as seen.
        shown = np.any(direction != 0.0, axis=1)
        near = bool((angle <= radius + _spacing_deg(direction))[shown].any())
    return SceneNeeds(light.found, light.sun_zenith_deg, sees_sky, near, int(np.prod(size)))


def camera_of_scene(
    load: Callable[[Callable[[Any], None]], Any], width: int, height: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """What a picture of a scene shows: directions [height, width, 3] of its pixels' centres in the emitter's frame (0
    where it shows nothing), whether they meet no shape, the sun's direction in that frame, and the emitter's altitude
    (m). The scene is read with ``load(edit)``."""
    scene = load(edit)
    (light,) = (e for e in scene.emitters() if hasattr(e, "sun_zenith_deg"))
    direction, free = _seen(scene, scene.sensors()[0], width, height)
    free &= np.any(direction != 0.0, axis=1)
    local = (direction @ light.turn).reshape(height, width, 3)
    return local, free.reshape(height, width), light.turn.T @ light.sun, light.found.altitude_m


def _seen(scene: Any, sensor: Any, columns: int = COLUMNS, rows: int = ROWS) -> tuple[np.ndarray, np.ndarray]:
    """Directions [N, 3] of columns x rows rays of the picture (0 where it shows nothing), and which of them meet no
    shape."""
    x, y = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
    x, y = x.ravel().astype(np.float32), y.ravel().astype(np.float32)
    if dr.is_jit_v(mi.Float):
        ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(mi.Float(x), mi.Float(y)), mi.Point2f(0.5))
        meets = np.array(scene.ray_test(mi.Ray3f(ray.o, dr.normalize(ray.d))))
        direction = np.array(dr.normalize(ray.d), dtype=np.float64).T
    else:
        rays = [sensor.sample_ray(0.0, 0.5, [float(u), float(v)], [0.5, 0.5])[0] for u, v in zip(x, y, strict=True)]
        meets = np.array([scene.ray_test(mi.Ray3f(ray.o, dr.normalize(ray.d))) for ray in rays])
        direction = np.array([np.array(dr.normalize(ray.d), dtype=np.float64) for ray in rays])
    inside = np.isfinite(direction).all(axis=1)  # a fisheye's corners show nothing
    return np.nan_to_num(direction), inside & ~np.broadcast_to(np.array(meets), x.size)


def _spacing_deg(direction: np.ndarray) -> float:
    """Largest angle between neighbouring rays, along either axis, times the diagonal's root of two."""
    table = direction.reshape(ROWS, COLUMNS, 3)
    largest = 0.0
    for one, other in ((table[1:], table[:-1]), (table[:, 1:], table[:, :-1])):
        cosine = np.einsum("ijk,ijk->ij", one, other)[np.any(one != 0.0, axis=-1) & np.any(other != 0.0, axis=-1)]
        largest = max(largest, float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).max(initial=0.0)))
    return float(np.sqrt(2.0)) * largest
