"""Any scene with the emitter ``atmosphere``, with the path-traced air in its place.

``edit`` changes what the parser read: the emitter becomes its own sun (plugin ``atmosphere_sun``), the integrator
becomes ``atmosphere_volpath`` without limit of depth (``volpath`` in scalar and polarised variants, and for scenes with
``null`` surfaces or media of their own), cameras see as far as there is air. ``planet_of`` gives what has to be added
to the scene: air and ground, placed so that the scene's origin is at the emitter's ``altitude``. Everything else in the
scene stays.

What the picture then shows is what the emitter shows, except that air is also between the camera and the things in
the scene, that light goes back and forth between those and the planet's own ground, and that the medium scatters the
light of a sun with a disc.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from atmo_jit.errors import AtmosphereError, InputError

from . import albedo, settings
from .planet import light_of, planet
from .rays import LOW_SUN_DEG
from .sun import Sun
from .wavelengths import Wavelengths

REPLACED = ("path", "direct", "volpath", "volpathmis", "atmosphere_path")
# Farther than any air that a ray passes (the default of 10 km would end the sky there).
FAR_CLIP = 1e8
# Paths of this depth are ended by chance: a bounce in the air loses little, so earlier would only add noise.
ROULETTE_DEPTH = 32


class AtmosphereSun(Sun):
    """The sun of the emitter ``atmosphere``, from the same parameters: what is left of it where the air is path-
    traced.
    """

    def __init__(self, props: Any) -> None:
        Sun.__init__(self, props)
        given = props.get_texture("albedo") if "albedo" in props else None
        read = None if given is None else lambda nm: albedo.values(given, nm)
        found = settings.read(props, lambda name: str(mi.file_resolver().resolve(name)), read)
        if found.sun_scale != found.sky_scale:
            text = f"found {found.sun_scale:g}, and sky_scale {found.sky_scale:g}"
            raise InputError(f"sun_scale: {text}; must be equal where the air is path-traced: one sun lights both")
        if found.limb_darkening:
            raise AtmosphereError("complex_sun", "true", "false where the air is path-traced")
        turn = np.array(props["to_world"].matrix, dtype=np.float64)[:3, :3] if "to_world" in props else np.eye(3)
        turn = turn / np.cbrt(abs(np.linalg.det(turn)))
        direction = np.array(found.direction, dtype=np.float64)
        local = direction if found.moment is not None else turn.T @ direction
        if found.refraction:
            local = np.array(settings.as_seen(found.atmosphere, found.altitude_m, local, local))
        self.sun_direction = turn @ local
        self.up = turn[:, 2] / np.linalg.norm(turn[:, 2])
        self.found = found
        used, colours, nm = light_of(found.atmosphere, "colour", None)
        wavelengths = Wavelengths(found.atmosphere.wavelengths_nm, "time", used)
        unit = self.sun_direction / np.linalg.norm(self.sun_direction)
        radius = max(found.atmosphere.sun_angular_radius_deg, 0.5 * settings.SMALLEST_SUN_DEG)
        self.shine(unit, radius, found.sun_scale * colours, wavelengths, nm)


def _shortcut(state: Any) -> bool:
    """Whether ``atmosphere_volpath`` can render the scene."""
    foreign = any(
        node.type == mi.ObjectType.Medium or _is(node, mi.ObjectType.BSDF, ("null", "mask")) for node in state.nodes
    )
    return dr.is_jit_v(mi.Float) and not mi.is_polarized and not foreign


def edit(state: Any, low: bool = False) -> None:
    """Change the parsed scene; ``low``: the sun is near the horizon or below it. Raises InputError where the scene has
    no, or more than one, emitter ``atmosphere``."""
    lights = [node.props for node in state.nodes if _is(node, mi.ObjectType.Emitter, ("atmosphere",))]
    if len(lights) != 1:
        raise InputError(f"--reference: the scene has {len(lights)} emitters of type atmosphere; must be one")
    lights[0].set_plugin_name("atmosphere_sun")
    for node in state.nodes:
        props = node.props
        if node.type == mi.ObjectType.Integrator:
            if props.plugin_name() not in REPLACED:
                allowed = f"one of {', '.join(REPLACED)}, which a volumetric one replaces"
                raise InputError(f"--reference: the scene's integrator is {props.plugin_name()}; must be {allowed}")
            for name in list(props.keys()):
                if name != "hide_emitters":
                    del props[name]
            if _shortcut(state):
                props.set_plugin_name("atmosphere_volpath")
                # While the sun is low few paths find the light by themselves.
                props["guided"] = low
            else:
                props.set_plugin_name("volpath")
                props["max_depth"], props["rr_depth"] = -1, ROULETTE_DEPTH
        elif node.type == mi.ObjectType.Sensor:
            props["shutter_open"], props["shutter_close"] = 0.0, 1.0
            if props.plugin_name() in ("perspective", "thinlens", "orthographic"):
                props["far_clip"] = max(FAR_CLIP, float(props.get("far_clip", 0.0)))


def _is(node: Any, kind: Any, names: tuple[str, ...]) -> bool:
    return node.type == kind and node.props.plugin_name() in names


def planet_of(scene: Any) -> dict[str, Any]:
    """Air and ground (objects by name) for a scene that was loaded after :func:`edit`."""
    (light,) = (e for e in scene.emitters() if hasattr(e, "found"))
    found = light.found
    parts = planet(
        found.atmosphere,
        sun_direction=light.sun_direction,
        altitude_m=found.altitude_m,
        up=light.up,
        sun="colour",
    )
    del parts["sun"]
    return parts


def add(state: Any, parts: dict[str, Any]) -> None:
    """Add objects to a parsed scene (one that :func:`edit` has changed too)."""
    for name, value in parts.items():
        state.root.props[f"reference_{name}"] = value


def load_reference(load: Callable[[Callable[[Any], None]], Any]) -> Any:
    """The scene with the path-traced air; ``load(edit)`` has to read and make it, calling ``edit`` with the parser's
    state.

    It is called twice: what the air needs to know is known only after the emitter's parameters have been read.
    """
    scene = load(edit)
    parts = planet_of(scene)
    (sun,) = (e for e in scene.emitters() if hasattr(e, "found"))
    low = float(np.dot(sun.sun_vector, sun.up)) < math.cos(math.radians(LOW_SUN_DEG))

    def edit_and_add(state: Any) -> None:
        edit(state, low)
        add(state, parts)

    scene = load(edit_and_add)
    for sensor in scene.sensors():
        sensor.set_medium(parts["air"])
    return scene
