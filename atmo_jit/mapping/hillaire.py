"""Hillaire's maps: transmittance, multiple scattering, the sky of one observer, slices of depth."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from .._arrays import module_of
from .axes import horizon
from .bruneton import Bruneton
from .either import acos, clip, square_root, where


@dataclass(frozen=True)
class Hillaire:
    """Maps of Hillaire's tables, H20 sections 4 and 5 and SkyAtmosphereCommon.hlsl; lengths in metres."""

    bottom: float
    top: float

    def transmittance(self, h: Any, mu: Any) -> tuple[Any, Any]:
        """(x_r, x_mu) as in B17; texels(n, ends=False). UvToLutTransmittanceParams."""
        return Bruneton(self.bottom, self.top).transmittance(h, mu)

    def transmittance_inverse(self, x_r: Any, x_mu: Any) -> tuple[Any, Any]:
        """(h, mu)."""
        return Bruneton(self.bottom, self.top).transmittance_inverse(x_r, x_mu)

    def multiple_scattering(self, h: Any, mu_s: Any) -> tuple[Any, Any]:
        """(x_r, x_mu_s), both linear. GetMultipleScattering."""
        return h / (self.top - self.bottom), 0.5 * mu_s + 0.5

    def multiple_scattering_inverse(self, x_r: Any, x_mu_s: Any) -> tuple[Any, Any]:
        """(h, mu_s)."""
        return x_r * (self.top - self.bottom), 2.0 * x_mu_s - 1.0

    def sky_view(self, h: Any, mu: Any, cos_phi: Any, ground: Any) -> tuple[Any, Any]:
        """(v, u) of the sky around one observer: latitude split at the horizon, square root of the angle to it; sine of
        half the azimuth from the sun.

        v: 0 zenith, 1/2 horizon, 1 nadir. SkyViewLutParamsToUv.
        """
        edge = acos(horizon(self.bottom, h))
        theta = acos(clip(mu, -1.0, 1.0))
        up = 0.5 - 0.5 * square_root(1.0 - theta / edge)
        down = 0.5 + 0.5 * square_root((theta - edge) / (math.pi - edge))
        return where(ground, down, up), square_root(0.5 - 0.5 * cos_phi)

    def sky_view_inverse(self, h: Any, v: Any, u: Any) -> tuple[Any, Any, Any]:
        """(mu, cos phi, ground). UvToSkyViewLutParams."""
        ground = v > 0.5
        edge = acos(horizon(self.bottom, h))
        from_edge = 2.0 * v - 1.0
        square = from_edge * from_edge
        theta = where(ground, edge + (math.pi - edge) * square, edge * (1.0 - square))
        return module_of(theta).cos(theta), 1.0 - 2.0 * u * u, ground

    @staticmethod
    def slice(distance: Any, reach: float) -> Any:
        """Depth coordinate w of an aerial-perspective froxel: sqrt(d / reach); reach = slices x length per slice."""
        return square_root(distance / reach)

    @staticmethod
    def slice_inverse(w: Any, reach: float) -> Any:
        """Distance (m) of w: squared."""
        return w * w * reach
