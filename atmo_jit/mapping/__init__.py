"""Where light tables keep their texels: maps between physical quantities and unit coordinates, and back.

Every map takes NumPy float64 or Dr.Jit float32 arrays and returns their kind. Quantities are those of the papers,
altitude first: ``h`` (m) stands for r = R + h, which single precision cannot hold; ``mu``, ``mu_s`` and ``nu`` are the
cosines of view zenith, sun zenith and their angle; ``ground``: whether the ray (h, mu) meets the ground.

>>> import numpy as np
>>> from atmo_jit.mapping import Bruneton, texels
>>> earth = Bruneton(6_360_000.0, 6_420_000.0)
>>> h, mu = earth.transmittance_inverse(*np.meshgrid(texels(64), texels(256), indexing="ij"))

Unit coordinates run from 0 to 1 over the quantity's range. Where a texel lies is a convention of the layout:
``texels(n)`` puts the first and the last texel's centres on 0 and 1 (Bruneton and most of Hillaire's tables: texture
coordinates are remapped by half a texel, :func:`texture_coordinate`), ``texels(n, ends=False)`` puts centres at
(i + 1/2) / n (Hillaire's transmittance).

Sources. B08: Bruneton and Neyret 2008. B17: Bruneton 2017, functions.glsl. H20: Hillaire 2020 and its code. E09: Elek
2009, Rendering Parametrizable Planetary Atmospheres with Multiple Scattering in Real-Time.
"""

from __future__ import annotations

from .angles import (
    STEEPEST,
    crowded,
    crowded_inverse,
    from_horizon,
    from_horizon_inverse,
    half_azimuth,
    half_azimuth_inverse,
    half_elevation,
    half_elevation_inverse,
    twilight_sun,
    twilight_sun_inverse,
)
from .axes import horizon, texels, texture_coordinate, unit_coordinate
from .bruneton import Bruneton
from .hillaire import Hillaire
from .power import Power3D

__all__ = [
    "STEEPEST",
    "Bruneton",
    "Hillaire",
    "Power3D",
    "crowded",
    "crowded_inverse",
    "from_horizon",
    "from_horizon_inverse",
    "half_azimuth",
    "half_azimuth_inverse",
    "half_elevation",
    "half_elevation_inverse",
    "horizon",
    "texels",
    "texture_coordinate",
    "twilight_sun",
    "twilight_sun_inverse",
    "unit_coordinate",
]
