"""Random atmospheres and views at the ends of what is allowed, and in between.

Everything is drawn from a ``random.Random``: ``Random(seed)`` makes a repeatable sweep, hypothesis' ``randoms()`` a
search that shrinks. Half of the draws of a number are its ends.

    rng = random.Random(7)
    air = extreme_world(rng)                # contract JSON
    views = extreme_views(rng, air, 100)    # arrays for atmo_jit.sky
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from random import Random
from typing import Any

import numpy as np

RADIUS_M = (1e5, 7e7)
SCALE_HEIGHT_M = (10.0, 1e5)
THICKNESS = (2.0, 1e4)  # scale heights
SCATTERING_PER_M = (1e-9, 1e-1)
G = 0.99
ALTITUDE_M = (1e-3, 1e9)
HORIZON_RAD = 1e-7
WIDTHS = (1, 1, 1, 1, 1, 2, 2, 3, 3, 3, 3, 3, 3, 4, 4, 5, 5, 8, 16, 64)
PHASES = ("cornette_shanks", "henyey_greenstein", "rayleigh", "isotropic", "tabulated", "legendre")


def extreme_world(
    rng: Random, *, conservative: bool = False, widths: Sequence[int] = WIDTHS
) -> dict[str, Any]:
    """An atmosphere as contract JSON. ``conservative``: nothing absorbs, and the ground is white; ``widths``: numbers
    of wavelengths to choose from."""
    width = rng.choice(widths)
    radius, height = _log(rng, *RADIUS_M), _log(rng, *SCALE_HEIGHT_M)
    # Beyond ten radii of air the curvature of the planet has no part in anything.
    thickness = min(height * _log(rng, *THICKNESS), 10.0 * radius)
    species = [_aerosol(rng, width, height, thickness, conservative) for _ in range(rng.choice((0, 1, 1, 2, 3)))]
    absorber = None if conservative or rng.random() < 0.5 else _absorber(rng, width, thickness)
    gas = {"scattering_per_m": _coefficient(rng, width, height), **_profile(rng, height, thickness)}
    return {
        "wavelengths_nm": [400.0 + 300.0 * i / width for i in range(width)],
        "solar_irradiance": _per_wavelength(rng, width, lambda: rng.choice((1.0, 2e-3, 1e3))),
        "bottom_radius_m": radius,
        "top_radius_m": radius + thickness,
        "rayleigh": gas if not species or rng.random() < 0.7 else None,
        "mie": species or None,
        "ozone": absorber,
        "ground_albedo": 1.0 if conservative else _per_wavelength(rng, width, lambda: _part(rng)),
        "sun_angular_radius_deg": rng.choice((0.0, 0.2678, 3.0)),
    }


def extreme_views(rng: Random, world: Mapping[str, Any], count: int) -> dict[str, np.ndarray]:
    """``count`` views of a world: observers at, just under and just over every boundary, rays at zenith, nadir, horizon
    and sun."""
    radius, top = world["bottom_radius_m"], world["top_radius_m"] - world["bottom_radius_m"]
    boundaries = [0.0, top, *(b for block in _blocks(world) for b in _kinks(block))]
    columns = []
    for _ in range(count):
        h = _altitude(rng, boundaries, top)
        # Seen from h the ground's edge is at this zenith angle: pi / 2 + dip.
        horizon = math.pi / 2 + math.atan2(math.sqrt(h * (2.0 * radius + h)), radius)
        sun = _zenith(rng, (0.0, 90.0, 180.0), horizon)
        view, azimuth = _zenith(rng, (0.0, 90.0, 180.0), horizon), rng.choice((0.0, 180.0, rng.uniform(0.0, 360.0)))
        if rng.random() < 0.15:  # at the sun, or beside it
            view, azimuth = min(sun + rng.choice((0.0, 1e-5, 0.2)), 180.0), 0.0
        distance = rng.choice((math.inf, math.inf, 0.0, _log(rng, 1e-3, 1e9)))
        columns.append((h, sun, view, azimuth, distance))
    names = ("altitude_m", "sun_zenith_deg", "view_zenith_deg", "azimuth_deg", "distance_m")
    return dict(zip(names, np.array(columns).T, strict=True))


def _altitude(rng: Random, boundaries: Sequence[float], top: float) -> float:
    kind = rng.randrange(4)
    if kind == 0:
        return max(0.0, rng.choice(boundaries) * (1.0 + rng.choice((-1e-6, -1e-12, 0.0, 1e-12, 1e-6))))
    if kind == 1:
        return _log(rng, *ALTITUDE_M)
    return top * rng.random() ** (1 if kind == 2 else 6)


def _zenith(rng: Random, ends: Sequence[float], horizon: float) -> float:
    """Zenith angle in degrees: an end, the horizon, just above or below it, or anything."""
    kind = rng.randrange(4)
    if kind == 0:
        return rng.choice(ends)
    if kind == 1:
        return math.degrees(horizon + rng.choice((-1.0, 0.0, 1.0)) * rng.choice((HORIZON_RAD, 1e-4, 1e-2))) % 180.0
    return math.degrees(math.acos(rng.uniform(-1.0, 1.0)))


def _log(rng: Random, low: float, high: float) -> float:
    if rng.random() < 0.2:
        return rng.choice((low, high))
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def _part(rng: Random) -> float:
    """A number from 0 to 1, both included and frequent."""
    return rng.choice((0.0, 1.0, rng.random(), rng.random()))


def _per_wavelength(rng: Random, width: int, draw: Any) -> Any:
    return draw() if rng.random() < 0.5 else [draw() for _ in range(width)]


def _coefficient(rng: Random, width: int, height: float) -> Any:
    """Nothing, thin air, or fog; half of the time scaled to an optical depth of order 1, where most happens."""
    if rng.random() < 0.5:
        depth = _log(rng, 1e-3, 10.0)
        return _per_wavelength(rng, width, lambda: min(depth * rng.uniform(0.2, 1.0) / height, SCATTERING_PER_M[1]))
    return _per_wavelength(rng, width, lambda: rng.choice((0.0, _log(rng, *SCATTERING_PER_M))))


def _profile(rng: Random, height: float, thickness: float) -> dict[str, Any]:
    if rng.random() < 0.6:
        return {"scale_height_m": height}
    count = rng.randrange(2, 9)
    nodes = sorted(thickness * rng.random() ** 2 for _ in range(count))
    for i in range(1, count):
        if rng.random() < 0.25:  # a step: two values at one altitude
            nodes[i] = nodes[i - 1] if i < 2 or nodes[i - 1] > nodes[i - 2] else nodes[i]
    density = [rng.choice((0.0, 1.0, rng.random())) for _ in nodes]
    if not any(density):
        density[0] = 1.0
    return {"profile": {"altitude_m": nodes, "density": density}}


def _aerosol(rng: Random, width: int, height: float, thickness: float, conservative: bool) -> dict[str, Any]:
    height = min(height, _log(rng, *SCALE_HEIGHT_M))
    block: dict[str, Any] = {"scattering_per_m": _coefficient(rng, width, height)}
    if conservative:
        block["single_scattering_albedo"] = 1.0
    elif rng.random() < 0.3:  # soot: an albedo of exactly 0 is scattering of exactly 0
        block |= {"scattering_per_m": 0.0, "absorption_per_m": _coefficient(rng, width, height)}
    else:
        albedo = rng.choice((1.0, 1e-3, 1.0 - rng.random()))
        scattering = np.array(block["scattering_per_m"]) * albedo  # what was drawn is extinction
        block |= {"scattering_per_m": scattering.tolist(), "single_scattering_albedo": albedo}
    return {**block, **_profile(rng, height, thickness), "phase": _phase(rng, width)}


def _absorber(rng: Random, width: int, thickness: float) -> dict[str, Any]:
    center = thickness * rng.random()
    half = _log(rng, min(10.0, 0.1 * thickness), thickness)
    return {"absorption_per_m": _coefficient(rng, width, half), "center_m": center, "half_width_m": half}


def _phase(rng: Random, width: int) -> dict[str, Any]:
    kind = rng.choice(PHASES)
    if kind in PHASES[:2]:
        return {"type": kind, "g": _per_wavelength(rng, width, lambda: rng.choice((-G, 0.0, G, rng.uniform(-G, G))))}
    if kind == "tabulated":
        nodes = [-1.0, *sorted(rng.uniform(-1.0, 1.0) for _ in range(rng.randrange(1, 8))), 1.0]
        nodes = sorted(set(nodes))
        values = [rng.choice((0.0, rng.random(), 5.0)) for _ in nodes[:-1]]
        return {"type": kind, "cos_theta": nodes, "values": [*values, 1.0]}
    if kind == "legendre":  # moments so small that it is nowhere negative
        return {"type": kind, "moments": [1.0, rng.uniform(-0.3, 0.3), rng.uniform(-0.01, 0.01)]}
    return {"type": kind}


def _blocks(world: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    return [block for block in (world["rayleigh"], *(world["mie"] or ()), world["ozone"]) if block]


def _kinks(block: Mapping[str, Any]) -> list[float]:
    if "profile" in block:
        return block["profile"]["altitude_m"]
    if "center_m" in block:
        ends = (block["center_m"] - block["half_width_m"], block["center_m"], block["center_m"] + block["half_width_m"])
        return [end for end in ends if end >= 0.0]
    return []
