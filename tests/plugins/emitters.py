"""What the tests of emitters share: directions, evaluation, renders of a plane. Not a test module."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

LUMINANCE = np.array([0.212671, 0.715160, 0.072169])  # of linear sRGB, mi.luminance's weights


def sun(elevation_deg: float, azimuth_deg: float = 0.0) -> list[float]:
    """Unit vector at an elevation, Z up."""
    e, a = math.radians(elevation_deg), math.radians(azimuth_deg)
    return [math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)]


def columns(value: Any) -> np.ndarray:
    """A Dr.Jit array of vectors or colours as [N, components]."""
    parts = [np.atleast_1d(np.array(value[i], dtype=np.float64)) for i in range(len(value))]
    return np.stack(np.broadcast_arrays(*parts), axis=-1)


def looking(directions: np.ndarray) -> Any:
    """Surface interactions of rays that left the scene in ``directions`` [N, 3]."""
    si = dr.zeros(mi.SurfaceInteraction3f, len(directions))
    si.wi = -mi.Vector3f(*(mi.Float(np.ascontiguousarray(d, dtype=np.float32)) for d in directions.T))
    return si


def seen(emitter: Any, directions: np.ndarray) -> np.ndarray:
    """Radiance [N, channels] of directions [N, 3], in variants without polarisation."""
    return columns(emitter.eval(looking(np.atleast_2d(np.asarray(directions, dtype=np.float64)))))


def sampled(emitter: Any, count: int, seed: int = 0) -> tuple[Any, Any]:
    """``count`` samples of directions (an array of records) and their weights."""
    rng = mi.PCG32(size=count, initstate=seed + 1)
    point = mi.Point2f(rng.next_float32(), rng.next_float32())
    return emitter.sample_direction(dr.zeros(mi.Interaction3f, count), point)


def plane(emitter: dict[str, Any], samples: int, size: int = 32, integrator: dict | None = None) -> np.ndarray:
    """Picture [size, size, 3] of the irradiance on a white diffuse plane that faces up, with ``samples`` a pixel.

    All pixels have the same expectation: their scatter is the noise of the estimate.
    """
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": integrator or {"type": "path", "max_depth": 2, "hide_emitters": True},
            "emitter": emitter,
            "plane": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().scale(1e3),
                "bsdf": {"type": "diffuse", "reflectance": {"type": "uniform", "value": 1.0}},
            },
            "sensor": {
                "type": "perspective",
                "fov": 10.0,
                "to_world": mi.ScalarTransform4f().look_at([0, 0, 10], [0, 0, 0], [0, 1, 0]),
                "film": {
                    "type": "hdrfilm",
                    "width": size,
                    "height": size,
                    "pixel_format": "rgb",
                    "rfilter": {"type": "box"},
                },
                "sampler": {"type": "independent", "sample_count": samples},
            },
        }
    )
    return np.pi * np.array(mi.render(scene), dtype=np.float64)
