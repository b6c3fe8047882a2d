"""This package's own maps of elevation, azimuth and the sun's height."""

from __future__ import annotations

import math
from typing import Any

from .._arrays import module_of
from .either import atan, clip, maximum, minimum, square_root


def half_elevation(mu: Any) -> Any:
    """q = sin(e / 2) for the elevation e above the horizontal, mu / sqrt(2 (1 + sqrt(1 - mu^2))).

    As evenly spread over the sky as e itself, at the cost of two square roots. From -sqrt(1/2) to sqrt(1/2).
    """
    return mu / square_root(2.0 + 2.0 * square_root((1.0 - mu) * (1.0 + mu)))


def half_elevation_inverse(q: Any) -> Any:
    """mu = sin e = 2 q sqrt(1 - q^2)."""
    return 2.0 * q * square_root((1.0 - q) * (1.0 + q))


STEEPEST = math.sqrt(0.5)  # half_elevation(1)


def from_horizon(q: Any, edge: Any, end: Any) -> Any:
    """x = sqrt((q - edge) / (end - edge)): 0 on the horizon, 1 at ``end``; H20's square root, of half_elevation."""
    return square_root((q - edge) / (end - edge))


def from_horizon_inverse(x: Any, edge: Any, end: Any) -> Any:
    """q of :func:`from_horizon`."""
    return edge + (end - edge) * x * x


def crowded(x: Any, place: float, knee: float) -> Any:
    """y, linear from 0 to ``knee`` at x = ``place`` and on to 1 at 1: more room about 0 where place < knee."""
    return minimum(x * (knee / place), 1.0 - (1.0 - x) * ((1.0 - knee) / (1.0 - place)))


def crowded_inverse(y: Any, place: float, knee: float) -> Any:
    """x of :func:`crowded`."""
    return maximum(y * (place / knee), 1.0 - (1.0 - y) * ((1.0 - place) / (1.0 - knee)))


def half_azimuth(cos_phi: Any) -> Any:
    """x = sin(phi / 2) = sqrt((1 - cos phi) / 2): 0 toward the sun, 1 opposite. H20."""
    return square_root(0.5 - 0.5 * cos_phi)


def half_azimuth_inverse(x: Any) -> Any:
    """cos phi."""
    return 1.0 - 2.0 * x * x


def twilight_sun(mu_s: Any, lowest: float, steepness: float) -> Any:
    """x = (atan(k mu_s) - atan(k lowest)) / (atan(k) - atan(k lowest)): from ``lowest`` (0) to the zenith (1), crowded
    about the horizontal.

    The form of B08's map for mu_s; the steepness k is a parameter here.
    """
    start = math.atan(steepness * lowest)
    return (atan(steepness * mu_s) - start) / (math.atan(steepness) - start)


def twilight_sun_inverse(x: Any, lowest: float, steepness: float) -> Any:
    """mu_s."""
    start = math.atan(steepness * lowest)
    return clip(module_of(x).tan(start + x * (math.atan(steepness) - start)) / steepness, -1.0, 1.0)
