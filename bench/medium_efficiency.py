"""Efficiency of the path-traced air beside Mitsuba's ``heterogeneous`` on the same scenes: 1 / (relative variance x
CPU seconds), kernels compiled.

``heterogeneous`` has one majorant for the whole planet: the extinction at the ground. It gets the same analytic
densities through volumes that evaluate them (no grid of voxels resolves a planet), the same phase function, ground,
sun and rays, so that only the sampling differs, and shows three wavelengths that share their paths inside a null
sphere at the top of the air. Beside it:

- ``medium``: ``atmosphere_medium`` in that sphere, by ``volpath`` too;
- ``planet``: the scene of ``plugins.planet`` by ``volpath``, without a sphere and with one wavelength for each path;
- ``integrator``: that scene, with shared wavelengths, by ``atmosphere_volpath``;
- ``guided``: the same with the solved tables as a guide, whose making is timed apart.
"""

from __future__ import annotations

import json
import time
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from atmo_jit import Atmosphere
from atmo_jit.plugins.planet import planet
from atmo_jit.plugins.rays import trace, tracer_of
from atmo_jit.plugins.variants import bound

SAMPLES = 2**17
# Scene: altitude of the camera (m), zenith angles of the views, zenith angle of the sun.
SCENES = {
    "ground, sun 30": (2.0, (0, 30, 60, 80, 88), 30.0),
    "ground, sun 75": (2.0, (0, 30, 60, 80, 88), 75.0),
    "10 km, sun 60": (10e3, (0, 60, 85, 95, 130, 180), 60.0),
    "ground, sun 94": (2.0, (0, 30, 60, 80, 88), 94.0),
    "space, sun 60": (400e3, (180, 150, 120, 109.6, 109.2), 60.0),
}
KINDS = ("medium", "planet", "integrator", "guided")
HAZE = {"mie.scattering_per_m": 1e-4, "mie.phase.g": 0.8}


class Extinction:
    """A volume that evaluates the extinction (1/m) of ``air``."""

    def __init__(self, props: Any) -> None:
        mi.Volume.__init__(self, props)

    def eval(self, it: Any, active: Any = True) -> Any:
        return sums(self.air, it)[1]

    def max(self) -> float:
        return float(np.max(np.array(self.air.majorants)))

    def eval_1(self, it: Any, active: Any = True) -> Any:
        return self.eval(it)[0]

    def to_string(self) -> str:
        return "Extinction"


class Albedo(Extinction):
    """A volume that evaluates the single-scattering albedo of ``air``."""

    def eval(self, it: Any, active: Any = True) -> Any:
        scattering, extinction = sums(self.air, it)
        return dr.select(extinction > 0.0, scattering / extinction, 0.0)

    def max(self) -> float:
        return 1.0


def sums(air: Any, it: Any) -> tuple[Any, Any]:
    """Scattering and extinction (1/m) of all constituents."""
    value = air.pick(it)
    scattering = extinction = mi.UnpolarizedSpectrum(0.0)
    for c, density in zip(air.atmosphere.constituents, air.densities(air.altitude(it.p)), strict=True):
        if c.phase is not None:
            scattering = scattering + air.scattering(c, value) * density
        extinction = extinction + air.extinction(c, value) * density
    return scattering, extinction


def stock(medium: Any, center: list[float], radius: float) -> Any:
    """Mitsuba's ``heterogeneous`` with the coefficients of an ``atmosphere_medium``."""
    box = mi.ScalarTransform4f().translate(center).scale(2.0 * radius).translate([-0.5, -0.5, -0.5])
    parts = {"type": "heterogeneous", "phase": medium.phase_function()}
    for name, description in (("sigma_t", Extinction), ("albedo", Albedo)):
        props = mi.Properties()
        props["to_world"] = box
        parts[name] = bound(description, "Volume")(props)
        parts[name].air = medium.air
    return mi.load_dict(parts)


def measure(name: str, atmosphere: Atmosphere) -> dict[str, float]:
    """Efficiencies of one scene; also the largest z between the media's means, which must be that of chance."""
    altitude, zeniths, sun = SCENES[name]
    s, v = np.radians(sun), np.radians(zeniths)
    direction = np.stack([np.sin(v) * np.cos(1.0), np.sin(v) * np.sin(1.0), np.cos(v)], axis=-1)
    origin = np.zeros_like(direction)
    origin[:, 2] = altitude
    to_sun = [float(np.sin(s)), 0.0, float(np.cos(s))]
    each = planet(atmosphere, sun_direction=to_sun)
    together = planet(atmosphere, sun_direction=to_sun, wavelength_rule="channels")
    center, radius = [0.0, 0.0, -atmosphere.bottom_radius_m], atmosphere.top_radius_m
    shared = mi.load_dict({"type": "atmosphere_medium", "atmosphere": json.dumps(atmosphere.to_dict())})
    light = {"type": "directional", "direction": [-x for x in to_sun], "irradiance": 1.0}
    start = altitude < atmosphere.thickness_m

    def inside(medium: Any) -> tuple[dict[str, Any], Any]:
        top = {"type": "sphere", "center": center, "radius": radius, "bsdf": {"type": "null"}, "interior": medium}
        return {"ground": each["ground"], "sun": light, "top": top}, medium if start else None

    def alone(parts: dict[str, Any]) -> tuple[dict[str, Any], Any]:
        return {"ground": parts["ground"], "sun": parts["sun"]}, parts["air"]

    kinds = {
        "heterogeneous": (*inside(stock(shared, center, radius)), tracer_of("volpath")),
        "medium": (*inside(shared), tracer_of("volpath")),
        "planet": (*alone(each), tracer_of("volpath")),
        "integrator": (*alone(together), tracer_of("atmosphere_volpath")),
        "guided": (*alone(together), tracer_of("atmosphere_volpath", guided=True)),
    }
    result: dict[str, Any] = {}
    means = {}
    for kind, (content, medium, tracer) in kinds.items():
        scene = mi.load_dict({"type": "scene", **content})
        arguments = (scene, medium, origin, direction, None, SAMPLES)
        started = time.process_time()
        trace(*arguments, seed=99, integrator=tracer)  # compiles
        first = time.process_time() - started
        started = time.process_time()
        mean, error, _ = trace(*arguments, seed=1, integrator=tracer)
        seconds = time.process_time() - started
        result[kind] = float(1.0 / (np.mean((error / mean) ** 2) * seconds))
        result[f"{kind}, first call s"], result[f"{kind}, CPU s"] = first, seconds
        means[kind] = mean, error
    # Each against `volpath` in the same geometry: a null sphere moves rays that pass the limb by some 100 m.
    for kind, peer in {"medium": "heterogeneous", "integrator": "planet", "guided": "planet"}.items():
        (a, da), (b, db) = means[peer], means[kind]
        result[f"largest z, {kind}"] = float(np.max(np.abs(a - b) / np.hypot(da, db)))
    return result


def main(as_json: bool) -> int:
    """Print a table (or JSON) of all scenes, for a clear and a hazy atmosphere."""
    rows = {}
    for label, changes in (("earth", {}), ("haze", HAZE)):
        for name in SCENES:
            row = measure(name, Atmosphere.load("earth").replace(changes))
            rows[f"{label}, {name}"] = row
            if not as_json:
                gains = "  ".join(f"{kind} {row[kind] / row['heterogeneous']:6.2f}" for kind in KINDS)
                z = max(value for key, value in row.items() if key.startswith("largest"))
                print(f"{label:6s} {name:15s} {gains}   largest z {z:.1f}", flush=True)
    if as_json:
        print(json.dumps(rows))
    return 0
