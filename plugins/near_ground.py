"""How finely the field is solved for pictures of a scene, which are of the lowest air."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from atmo_jit.atmosphere import Atmosphere
from atmo_jit.grid import Grid
from atmo_jit.resolution import CLOUD, Resolution, column_of

TOLERANCE = 0.01
FIRST_DEPTH = 0.03  # at most, of the air below the second altitude: that of the clear air of a planet like the earth
MOST_ALTITUDES = 64
NEAR_GROUND = 2.0  # see Resolution.near_ground; twice that of other solves


def near_ground(atmosphere: Atmosphere) -> Resolution:
    """The resolution for an atmosphere in which light near the ground is known as well as in clear air.

    Rays that rise flat from dark ground find all of their light within a part of a free path. Where the lowest interval
    of altitudes is as thick as in haze, cubic interpolation takes up to 3 % of the light below the horizon for lost.
    Clouds have their own rule."""
    resolution = Resolution.suited(atmosphere, TOLERANCE)
    if sum(float(np.max(c.extinction_per_m)) * column_of(atmosphere, c) for c in atmosphere.constituents) > CLOUD:
        return resolution
    resolution = replace(resolution, near_ground=NEAR_GROUND)
    h = np.linspace(0.0, float(Grid.of(atmosphere, resolution).h[1]), 65)
    extinction = sum(c.extinction_per_m[:, None] * np.asarray(c.profile.density(h)) for c in atmosphere.constituents)
    depth = float(np.max(np.trapezoid(extinction, h), initial=0.0)) if atmosphere.constituents else 0.0
    intervals = (resolution.altitudes - 1) * max(depth / FIRST_DEPTH, 1.0)
    # In steps of four, so that kernels are shared.
    more = 4 * math.ceil((intervals + 1 - resolution.altitudes) / 4.0)
    return replace(resolution, altitudes=max(min(resolution.altitudes + more, MOST_ALTITUDES), resolution.altitudes))
