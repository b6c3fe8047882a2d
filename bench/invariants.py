"""What holds in every atmosphere, whatever its numbers: each function returns by how much it fails.

Views and worlds are as elsewhere (contract JSON, arrays for atmo_jit.sky); results are float64.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.polynomial import legendre

import atmo_jit


def returned_light(
    world: Mapping[str, Any], twin: Any, azimuths: int = 24, nodes: int = 10, **options: Any
) -> np.ndarray:
    """Part [W] of the light falling on a planet that returns to space; 1 where air and ground only scatter.

    Outgoing flux through the top, integrated over the planet's sun zeniths, over what the disc of the planet and its
    air takes from the sunbeam: E pi r_top^2 less what passes straight through the limb. ``twin``: the world's
    ``twins.Twin``; ``azimuths``, ``nodes``: of the quadrature over directions, per interval; ``options``: for
    atmo_jit.sky.
    """
    radius, top = world["bottom_radius_m"], world["top_radius_m"]
    disc = np.deg2rad(world["sun_angular_radius_deg"])
    dip = np.sin(min(np.arccos(radius / top) + disc, 0.5 * np.pi))
    # Suns from where the top is dark to overhead, dense at twilight; views dense at the planet's edge.
    low = max(-1.0, -2.0 * dip)
    mu_s, weight_s = rule([low, -dip, -0.5 * dip, -0.1 * dip, 0.0, 0.1 * dip, min(0.5, dip), 1.0], nodes)
    edge = -np.sqrt(1.0 - (radius / top) ** 2)
    mu, weight = rule([-1.0, 0.5 * (edge - 1.0), edge, 0.8 * edge, 0.4 * edge, 0.1 * edge, 0.0], nodes)
    azimuth = np.pi * (np.arange(azimuths) + 0.5) / azimuths
    mesh = np.meshgrid(np.arccos(mu_s), np.arccos(mu), azimuth, indexing="ij")
    sun, view, turn = (np.degrees(part).ravel() for part in mesh)
    views = {"altitude_m": 0 * sun + top - radius, "sun_zenith_deg": sun, "view_zenith_deg": view, "azimuth_deg": turn}
    radiance = atmo_jit.sky(world, views, method="march", **options).radiance.astype(float)
    flux = radiance.reshape(*mesh[0].shape, -1).mean(axis=2) * 2.0 * np.pi
    outgoing = 2.0 * np.pi * top**2 * (weight_s @ np.einsum("svw,v->sw", flux, -mu * weight))
    levels = np.unique(np.r_[radius, radius + twin.ladder])
    perigee, ring = rule(levels, 8)
    mu = -np.sqrt((1.0 - perigee / top) * (1.0 + perigee / top))
    through = np.exp(-twin.optical_depth(twin.columns(np.full(mu.size, top - radius), mu)))
    passed = (2.0 * np.pi * perigee * ring) @ through
    return outgoing / (twin.solar * (np.pi * top**2 - passed))


def rule(edges: Any, nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre nodes and weights on each interval between ascending ``edges``, joined."""
    x, w = legendre.leggauss(nodes)
    low, high = np.array(edges[:-1])[:, None], np.array(edges[1:])[:, None]
    return (low + (high - low) * (x + 1.0) / 2.0).ravel(), ((high - low) * w / 2.0).ravel()
