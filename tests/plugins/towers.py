"""Scenes that the tests of ``atmosphere_path`` share, and their pictures: towers in haze and in dust."""

from __future__ import annotations

import json

import mitsuba as mi
import numpy as np

import atmo_jit

SUN = np.array([0.25, 1.0, 0.5]) / np.linalg.norm([0.25, 1.0, 0.5])
# One wavelength, so that noise is all that a picture and its twin differ by.
HAZE = {
    "wavelengths_nm": [550],
    "solar_irradiance": [1.0],
    "bottom_radius_m": 6360000,
    "top_radius_m": 6420000,
    "rayleigh": {"scattering_per_m": [1.3558e-5], "scale_height_m": 8000},
    "mie": {
        "scattering_per_m": [5e-5],
        "single_scattering_albedo": [0.9],
        "scale_height_m": 1200,
        "phase": {"type": "cornette_shanks", "g": 0.76},
    },
    "ozone": None,
    "ground_albedo": [0.0],
    "sun_angular_radius_deg": 0.26,
}
LOW_SUN = np.array([0.08, 1.0, 0.1]) / np.linalg.norm([0.08, 1.0, 0.1])
DUST = {
    **HAZE,
    "bottom_radius_m": 3389500,
    "top_radius_m": 3489500,
    "rayleigh": {"scattering_per_m": [2.45e-7], "scale_height_m": 11000},
    "mie": {
        "scattering_per_m": [3.909e-5],
        "single_scattering_albedo": [0.86],
        "scale_height_m": 11000,
        "phase": {"type": "henyey_greenstein", "g": 0.775},
    },
}


def passes(scene, count, spp):
    """Pictures [count, height, width, channels] with seeds of their own."""
    return np.stack([np.array(mi.render(scene, spp=spp, seed=i), dtype=np.float64) for i in range(count)])


def tiles(pictures, size):
    """Means over squares of ``size`` pixels."""
    n, height, width, channels = pictures.shape
    return pictures.reshape(n, height // size, size, width // size, size, channels).mean(axis=(2, 4))


def camera(width, height, origin, target, **options):
    film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}}
    to_world = mi.ScalarTransform4f().look_at(origin, target, [0, 0, 1])
    return {"type": "perspective", "fov": 70, "to_world": to_world, "film": film, **options}


def shaded(integrator, orders=None, grey=0.0, air=HAZE, sun=SUN, **options):
    """Two towers, kilometres high, black or grey, between the camera and the sun, in haze."""
    at, atmosphere = mi.ScalarTransform4f(), atmo_jit.Atmosphere.load(air)
    black = {"type": "diffuse", "reflectance": {"type": "uniform", "value": grey}}
    towers = {
        "west": {"type": "cube", "to_world": at.translate([-1200, 6000, 1300]).scale([900, 400, 1500]), "bsdf": black},
        "east": {"type": "cube", "to_world": at.translate([2000, 5000, 1000]).scale([900, 400, 1200]), "bsdf": black},
    }
    sensor = camera(48, 32, [0, 0, 100], [0, 1000, 260], far_clip=1e8)
    if integrator == "atmosphere_path":
        sky = {"type": "atmosphere", "atmosphere": json.dumps(air), "sun_direction": sun.tolist(), "altitude": 0.0}
        sky["sun_scale"] = 0.0  # the disc itself would only add noise
        orders = {} if orders is None else {"orders": orders}
        depth = 1 if grey == 0.0 else 3
        parts = {"integrator": {"type": integrator, "max_depth": depth, **orders, **options}, "sky": sky}
    else:
        from atmo_jit.plugins.planet import planet

        parts = planet(atmosphere, sun_direction=sun, sun_radius_deg=0.26)
        sensor["medium"] = parts.pop("air")
        depth = -1 if orders is None else orders + 1
        parts["integrator"] = {"type": integrator, "max_depth": depth, "hide_emitters": True}
    return mi.load_dict({"type": "scene", "sensor": sensor, **parts, **towers})
