"""A planet with its air and sun as a Mitsuba scene, placed so that single precision holds.

    import mitsuba as mi
    mi.set_variant("llvm_ad_rgb")
    from atmo_jit.plugins import register
    from atmo_jit.plugins.planet import planet
    register()
    earth = planet("earth", sun_direction=[0, 0.9, 0.4])
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "volpath", "max_depth": -1}, **earth,
                          "sensor": {"type": "fisheye", "medium": earth["air"]}})

The scene's origin lies ``altitude_m`` above the ground, and z is up there. The medium knows where it ends, so no
shape encloses it: the camera is in it, be it in the air or in space. What single precision does to a scene of this
size, and what is done about it:

- Mitsuba starts a ray that leaves a surface 9e-5 of the largest coordinate above it: 0.1 mm beside the origin, 90 m at
  a distance of 1000 km. In haze those 90 m are 1 % of what the ground reflects. Therefore the ground lies as much lower
  as rays start higher, with nothing in between: the air begins at altitude 0 whatever the ground's own altitude is.
- A shape that encloses the air would shift rays in the same way where they enter it; rays that pass the limb of the
  planet would pass it 100 m lower.
- Points of a sphere of the earth's size are known to 0.5 m, which is more than that offset at up to 16 km from the
  origin: the ground would shadow itself. Therefore it is a mesh, whose points near the origin are exact; its facets
  grow with the distance and lie up to 2 km below the true ground at the other side of the planet. (It is also faster.)
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from functools import cache
from typing import Any

import mitsuba as mi
import numpy as np

from atmo_jit.atmosphere import Atmosphere
from atmo_jit.errors import AtmosphereError, shown
from atmo_jit.spectrum import SpectralBasis, interpolation_weights

from . import plugin_class
from .variants import bound
from .wavelengths import Wavelengths

SUNS = ("unit", "solar", "colour", "each")
SECTORS = 256
STEP = 1.03  # ratio of the radii of neighbouring rings of vertices
GOLDEN = 0.6180339887  # the irrational number that is hardest to approximate


def ground_mesh(radius_m: float, altitude_m: float, scale: float, up: np.ndarray, bsdf: Any) -> Any:
    """The ground: rings of vertices around the scene's origin, below the planet's sphere, with its normals."""
    reach = math.pi * radius_m
    rings = np.concatenate([[0.0], np.geomspace(1.0, reach, math.ceil(math.log(reach) / math.log(STEP)) + 1)])
    angle = rings / radius_m
    # Facets sink further below the sphere than their vertices; that does no harm.
    depth = 1.01 * mi.math.RayEpsilon * (1.0 / scale + altitude_m + np.minimum(rings, 2.0 * radius_m))
    # Embree lets rays through that meet an edge exactly: no edge or vertex lies in a plane or on a line that views are
    # likely to be in, and no two rings have edges in line.
    turn = 2.0 * math.pi * (np.arange(SECTORS) + GOLDEN * np.arange(len(rings))[:, None]) / SECTORS
    axes = frame(up)
    axes = frame(up + (0.43 * axes[0] + 0.61 * axes[1]) / radius_m)
    sine, cosine = np.sin(angle)[:, None], np.cos(angle)[:, None]
    normals = np.stack([sine * np.cos(turn), sine * np.sin(turn), np.broadcast_to(cosine, turn.shape)], -1) @ axes
    # In double precision the sum is exact to a nanometre.
    vertices = normals * (radius_m - depth)[:, None, None] - (radius_m + altitude_m) * up
    i, j = np.meshgrid(np.arange(len(rings) - 1), np.arange(SECTORS), indexing="ij")
    k = (j + 1) % SECTORS
    a, b, c, d = (row * SECTORS + column for row, column in ((i, j), (i + 1, j), (i + 1, k), (i, k)))
    outer, inner = np.stack([a, b, c], -1), np.stack([a, c, d], -1)[1:]  # the innermost ring is a point
    faces = np.concatenate([outer.reshape(-1, 3), inner.reshape(-1, 3)])
    props = mi.Properties()
    props["bsdf"] = bsdf
    mesh = mi.Mesh("ground", turn.size, len(faces), props=props, has_vertex_normals=True)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = (scale * vertices).ravel().astype(np.float32)
    parameters["vertex_normals"] = normals.ravel().astype(np.float32)
    parameters["faces"] = faces.ravel().astype(np.uint32)
    parameters.update()
    return mesh


def frame(up: np.ndarray) -> np.ndarray:
    """Rows x, y, z of a right-handed frame with z along ``up``."""
    up = up / np.linalg.norm(up)
    across = np.eye(3)[int(np.argmin(np.abs(up)))]
    x = np.cross(np.cross(up, across), up)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])


def light_of(
    atmosphere: Atmosphere, sun: str, channels: Sequence[int] | None
) -> tuple[list[int], np.ndarray, np.ndarray]:
    """The wavelengths in use, sunlight [C, U] that gives each of them its part of the picture, and the nm of C in
    spectral variants.
    """
    irradiance = np.ones_like(atmosphere.solar_irradiance) if sun in ("unit", "each") else atmosphere.solar_irradiance
    basis = SpectralBasis.of(atmosphere)
    if sun == "each":
        count = len(basis.grid_nm) if mi.is_spectral else len(mi.UnpolarizedSpectrum(0.0))
        return list(range(len(irradiance))), np.ones((count, len(irradiance))), basis.grid_nm
    if mi.is_spectral:
        matrix = basis.matrix(basis.grid_nm)
        if sun == "unit":
            matrix = interpolation_weights(atmosphere.wavelengths_nm, basis.grid_nm)
        used = list(range(len(irradiance)))
    elif sun == "colour":
        matrix = basis.srgb_matrix if mi.is_rgb else basis.xyz_matrix[1:2]
        used = list(range(len(irradiance)))
    else:
        of_channel = Wavelengths(atmosphere.wavelengths_nm, "channels", channels and list(channels)).channels
        used = sorted(set(of_channel))
        matrix = np.zeros((len(of_channel), len(irradiance)))
        matrix[np.arange(len(of_channel)), of_channel] = 1.0
    return used, (matrix * irradiance)[:, used] * len(used), basis.grid_nm


def planet(
    atmosphere: Any,
    *,
    sun_direction: Any,
    altitude_m: float = 0.0,
    up: Any = (0.0, 0.0, 1.0),
    scale: float = 1.0,
    sun: str = "unit",
    sun_radius_deg: float = 0.0,
    channels: Sequence[int] | None = None,
    wavelength_rule: str = "time",
) -> dict[str, Any]:
    """The air (``air``), the ground (``ground``) and the sun (``sun``) for ``mi.load_dict``.

    atmosphere: anything that ``Atmosphere.load`` takes. sun_direction: towards the sun, in the scene; any length.
    altitude_m: of the scene's origin above the ground. up: direction away from the planet's centre at the origin.
    scale: scene units per metre. sun: what light the sun gives. ``"unit"``: irradiance 1 in every channel, so that a
    picture is radiance in 1/sr, each channel at its own wavelength (see ``channels`` of ``atmosphere_medium``).
    ``"solar"``: the same with the atmosphere's irradiance at that wavelength. ``"colour"``: the colours of the
    emitter ``atmosphere``; then every path has one of the wavelengths, according to its time. ``"each"``: irradiance
    1 whatever the path's wavelength is, for those who choose the time of every ray themselves. Except with ``"unit"``
    and ``"solar"`` in mono variants, which have but one wavelength, the sensor needs ``shutter_open`` 0 and
    ``shutter_close`` 1. sun_radius_deg: angular radius of the sun's disc, 0 for parallel light. channels: as for
    ``atmosphere_medium``. wavelength_rule: ``"time"``, or ``"channels"`` with the suns ``"unit"`` and ``"solar"`` in
    rgb and mono variants: then the channels share their paths, for ``atmosphere_volpath``, which needs no boundary for
    that."""
    atmosphere = Atmosphere.load(atmosphere)
    if sun not in SUNS:
        raise AtmosphereError("sun", shown(sun), f"one of {', '.join(SUNS)}")
    shared = wavelength_rule == "channels"
    if shared and (mi.is_spectral or sun not in ("unit", "solar")):
        raise AtmosphereError("wavelength_rule", "'channels'", "'time' here: only suns unit and solar in rgb and mono")
    up_, to_sun = (np.array(v, dtype=np.float64) for v in (up, sun_direction))
    up_, to_sun = up_ / np.linalg.norm(up_), to_sun / np.linalg.norm(to_sun)
    radius = atmosphere.bottom_radius_m
    center = -(radius + altitude_m) * scale * up_
    props = mi.Properties("atmosphere_medium")
    props["atmosphere"] = json.dumps(atmosphere.to_dict())
    props["center"], props["scale"] = mi.ScalarPoint3f(center), scale
    props["wavelength_rule"] = wavelength_rule
    selected, colours, nm = light_of(atmosphere, sun, channels)
    if shared:
        selected = Wavelengths(atmosphere.wavelengths_nm, "channels", channels and list(channels)).channels
        # One row for all paths, each channel its own part.
        colours = colours.sum(axis=1, keepdims=True) / len(set(selected))
    props["channels"] = ", ".join(map(str, selected))
    air = plugin_class("atmosphere_medium")(props)
    wavelengths = air.air.wavelengths

    reflectance = class_of("PerWavelength", "Texture")(mi.Properties())
    reflectance.use(atmosphere.ground_albedo, wavelengths)
    bsdf = mi.load_dict({"type": "diffuse", "reflectance": reflectance})
    light = class_of("Sun", "Emitter")(mi.Properties())
    light.shine(to_sun, sun_radius_deg, colours, wavelengths, nm)
    return {
        "air": air,
        "ground": ground_mesh(radius, altitude_m, scale, up_, bsdf),
        "sun": light,
    }


@cache
def _class_of(name: str, base: str, variant: str) -> type:
    from . import sun

    return bound(getattr(sun, name), base)


def class_of(name: str, base: str) -> type:
    """A class of :mod:`.sun` in the current variant."""
    return _class_of(name, base, mi.variant())
