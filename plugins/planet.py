"""A planet with its air and sun as a Mitsuba scene, placed so that single precision holds.

    import mitsuba as mi
    mi.set_variant("llvm_ad_rgb")
    from atmo_jit.plugins import register
    from atmo_jit.plugins.planet import planet
    register()
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "volpath", "max_depth": -1},
                          **planet("earth", sun_direction=[0, 0.9, 0.4]), "sensor": {...}})

The scene's origin lies ``altitude_m`` above the ground, z is up there. What single precision does to a sphere of the size of the
earth, and what is done about it:

- Points on it are known to 0.5 m, and Mitsuba starts a reflected ray 9e-5 of the largest coordinate above them. Nearer than some
  16 km to the scene's origin that is less than their error, and the ground shadows itself. There the ground is a mesh, whose
  points near the origin are exact (``CAP_RADIUS_M``), and the sphere lies ``CAP_GAP_M`` below it.
- Far away the same offset is large: 9 m at 100 km, 90 m at 1000 km. It raises the start of light reflected there, which
  matters to 0.1 % of what the ground reflects at 100 km.
- The top of the atmosphere is a sphere with a ``null`` BSDF; its error of 0.5 m does not matter, since the medium ends
  where the atmosphere does whatever the sphere's rounding.
"""

from __future__ import annotations

import math
from typing import Any

import mitsuba as mi
import numpy as np

from atmo_jit.atmosphere import Atmosphere

from . import plugin_class

CAP_RADIUS_M = 25e3
CAP_GAP_M = 4.0
CAP_SECTORS = 96
CAP_STEP = 1.08  # ratio of the radii of neighbouring rings: facets sink less than 0.1 m below the sphere


def cap_mesh(radius_m: float, altitude_m: float, scale: float, bsdf: Any) -> Any:
    """The ground around the scene's origin: rings of vertices on the planet's sphere, with its normals."""
    reach = min(CAP_RADIUS_M, 0.2 * radius_m)
    rings = np.concatenate([[0.0], np.geomspace(1.0, reach, math.ceil(math.log(reach) / math.log(CAP_STEP)) + 1)])
    angle = rings / radius_m
    turn = 2.0 * math.pi * np.arange(CAP_SECTORS) / CAP_SECTORS
    across = radius_m * np.sin(angle)
    down = 2.0 * radius_m * np.sin(0.5 * angle) ** 2
    x, y = np.outer(across, np.cos(turn)), np.outer(across, np.sin(turn))
    z = np.repeat(-altitude_m - down[:, None], CAP_SECTORS, axis=1)
    vertices = scale * np.stack([x, y, z], axis=-1).reshape(-1, 3)
    sine = np.sin(angle)[:, None]
    normals = np.stack([sine * np.cos(turn), sine * np.sin(turn), np.repeat(np.cos(angle)[:, None], CAP_SECTORS, 1)], -1)
    i, j = np.meshgrid(np.arange(len(rings) - 1), np.arange(CAP_SECTORS), indexing="ij")
    k = (j + 1) % CAP_SECTORS
    a, b, c, d = (row * CAP_SECTORS + column for row, column in ((i, j), (i + 1, j), (i + 1, k), (i, k)))
    faces = np.concatenate([np.stack([a, b, c], -1)[:].reshape(-1, 3), np.stack([a, c, d], -1)[1:].reshape(-1, 3)])
    props = mi.Properties()
    props["bsdf"] = bsdf
    mesh = mi.Mesh("cap", len(vertices), len(faces), props=props, has_vertex_normals=True)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = vertices.ravel().astype(np.float32)
    parameters["vertex_normals"] = normals.ravel().astype(np.float32)
    parameters["faces"] = faces.ravel().astype(np.uint32)
    parameters.update()
    return mesh


def planet(
    atmosphere: Any,
    *,
    sun_direction: Any,
    altitude_m: float = 0.0,
    scale: float = 1.0,
    irradiance: float = 1.0,
    wavelength_mode: str = "channels",
    channels: list[int] | None = None,
) -> dict[str, Any]:
    """Medium, ground, top and sun for ``mi.load_dict``.

    sun_direction: towards the sun; irradiance: of the sun in every channel.
    """
    atmosphere = Atmosphere.load(atmosphere)
    radius = atmosphere.bottom_radius_m
    center = [0.0, 0.0, -(radius + altitude_m) * scale]
    props = mi.Properties("atmosphere_medium")
    props["atmosphere"] = __import__("json").dumps(atmosphere.to_dict())
    props["center"] = mi.ScalarPoint3f(center)
    props["scale"] = scale
    props["wavelength_mode"] = wavelength_mode
    if channels is not None:
        props["channels"] = ",".join(map(str, channels))
    air = plugin_class("atmosphere_medium")(props)
    albedo = float(atmosphere.ground_albedo[0])
    bsdf = mi.load_dict({"type": "diffuse", "reflectance": {"type": "uniform", "value": albedo}})
    return {
        "air": air,
        "ground": {"type": "sphere", "center": center, "radius": (radius - CAP_GAP_M) * scale, "bsdf": bsdf},
        "near_ground": cap_mesh(radius, altitude_m, scale, bsdf),
        "top": {
            "type": "sphere", "center": center, "radius": atmosphere.top_radius_m * scale,
            "bsdf": {"type": "null"}, "interior": air,
        },
        "sun": {
            "type": "directional", "direction": [-float(v) for v in sun_direction],
            "irradiance": {"type": "uniform", "value": irradiance},
        },
    }
