"""Efficiency of ``atmosphere_medium`` beside Mitsuba's ``heterogeneous`` on the same scenes: 1 / (relative variance x
CPU seconds).

``heterogeneous`` has one majorant for the whole planet: the extinction at the ground. It gets the same analytic
densities through volumes that evaluate them (no grid of voxels resolves a planet), the same phase function, ground,
sun and rays, so that only the medium's own sampling differs. Both are inside a null sphere at the top of the air and
show three wavelengths that share their paths; the last column is the scene of ``plugins.planet``, without a sphere
and with one wavelength for each path.
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
from atmo_jit.plugins.rays import trace
from atmo_jit.plugins.variants import bound

SAMPLES = 2**15
# Scene: altitude of the camera (m), zenith angles of the views, zenith angle of the sun.
SCENES = {
    "ground, sun 30": (2.0, (0, 30, 60, 80, 88), 30.0),
    "ground, sun 75": (2.0, (0, 30, 60, 80, 88), 75.0),
    "10 km, sun 60": (10e3, (0, 60, 85, 95, 130, 180), 60.0),
    "space, sun 60": (400e3, (180, 150, 120, 109.6, 109.2), 60.0),
}
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
    parts = planet(atmosphere, sun_direction=[np.sin(s), 0.0, np.cos(s)])
    each = parts.pop("air")
    center, radius = [0.0, 0.0, -atmosphere.bottom_radius_m], atmosphere.top_radius_m
    shared = mi.load_dict({"type": "atmosphere_medium", "atmosphere": json.dumps(atmosphere.to_dict())})
    light = {"type": "directional", "direction": [-np.sin(s), 0.0, -np.cos(s)], "irradiance": 1.0}
    result: dict[str, Any] = {}
    means = {}
    for kind, medium in (("heterogeneous", stock(shared, center, radius)), ("same scene", shared), ("planet", each)):
        content = {"type": "scene", **parts}
        if medium is not each:
            top = {"type": "sphere", "center": center, "radius": radius, "bsdf": {"type": "null"}, "interior": medium}
            content |= {"sun": light, "top": top}
        scene = mi.load_dict(content)
        start = medium if altitude < atmosphere.thickness_m or medium is each else None
        arguments = (scene, start, origin, direction, None, SAMPLES)
        trace(*arguments, seed=99)  # compiles
        started = time.process_time()
        mean, error, _ = trace(*arguments, seed=1)
        result[kind] = float(1.0 / (np.mean((error / mean) ** 2) * (time.process_time() - started)))
        means[kind] = mean, error
    for kind in ("same scene", "planet"):
        (a, da), (b, db) = means["heterogeneous"], means[kind]
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
                gain, best = (row[kind] / row["heterogeneous"] for kind in ("same scene", "planet"))
                z = max(value for key, value in row.items() if key.startswith("largest"))
                print(
                    f"{label:6s} {name:16s} gain {gain:5.2f}   scene of planet() {best:5.2f}   largest z {z:.1f}",
                    flush=True,
                )
    if as_json:
        print(json.dumps(rows))
    return 0
