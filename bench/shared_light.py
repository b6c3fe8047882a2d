"""What every method of multiple scattering shares: single scattering, transmittance and the sun on the ground, exact
and from this package; a method adds its orders >= 2 and the sky's light on the ground."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any

import drjit as dr
import numpy as np

from atmo_jit.atmosphere import Atmosphere
from atmo_jit.backend import floats

from .methods import columns_of


class SharedLight:
    """Radiance of views; subclasses say what is ``scattered`` more than once and what the ``sky_on_ground`` is.

    Up to four wavelengths.
    """

    def __init__(self, atmosphere: Any) -> None:
        self.atmosphere = Atmosphere.load(atmosphere)

    @cached_property
    def once(self) -> Any:
        """The sky of one event: made when it is first asked for, so that no method's solve pays for it."""
        from atmo_jit.solved import Sky

        return Sky(self.atmosphere, orders=1)

    def scattered(self, inside: Mapping[str, Any]) -> list[Any]:
        """Radiance of orders >= 2, per channel, of rays from inside the air: Floats h (m), mu, mu_s, nu, and whether
        they meet the ground."""
        raise NotImplementedError

    def sky_on_ground(self, mu_s: Any) -> list[Any]:
        """Irradiance of horizontal ground by scattered light, per channel."""
        raise NotImplementedError

    def radiance(self, views: Mapping[str, np.ndarray]) -> np.ndarray:
        """Radiance [N, W] of views, ground included."""
        air = self.atmosphere
        light = self.once.rays(*columns_of(views), ground=False)
        geometry = entered(views, air.bottom_radius_m, air.top_radius_m)
        inside = {k: floats(geometry[k]) for k in ("h", "mu", "mu_s", "nu")}
        inside["ground"] = floats(geometry["ground"].astype(float)) > 0.5
        more = self.scattered(inside)
        mu_s = floats(geometry["ground_mu_s"])
        sun, _ = self.once.irradiance(floats(0.0 * geometry["h"]), dr.acos(mu_s))
        sky = self.sky_on_ground(mu_s)
        dr.eval(light.radiance, light.transmittance, more, sun, sky)
        shape = geometry["h"].shape
        single, through, more, sun, sky = (
            np.stack([np.broadcast_to(v.numpy(), shape) for v in part], axis=-1).astype(np.float64)
            for part in (light.radiance, light.transmittance, more, sun, sky)
        )
        glow = np.where(geometry["ground"][:, None], air.ground_albedo / np.pi * (sun + sky) * through, 0.0)
        return single + np.where(geometry["meets_air"][:, None], more, 0.0) + glow


def entered(views: Mapping[str, np.ndarray], low: float, top: float) -> dict[str, np.ndarray]:
    """Rays moved to where they enter the air, in double precision: h, mu, mu_s, nu there, whether they meet air and
    the ground, and the sun's cosine where they meet the ground."""
    h = np.asarray(views["altitude_m"], float)
    s, v, a = (np.radians(views[k]) for k in ("sun_zenith_deg", "view_zenith_deg", "azimuth_deg"))
    mu, mu_s = np.cos(v) + 0.0 * h, np.cos(s) + 0.0 * h
    nu = mu * mu_s + np.sin(v) * np.sin(s) * np.cos(a)
    r, thickness = low + h, top - low
    outside = h > thickness
    excess = (h - thickness) * (r + top)
    square = (r * mu) ** 2 - excess
    meets = ~outside | ((mu < 0) & (square > 0))
    gap = np.where(outside & meets, -r * mu - np.sqrt(np.maximum(square, 0.0)), 0.0)
    r_in = np.where(outside, top, r)
    h = np.minimum(h, thickness)
    mu = np.where(outside, (r * mu + gap) / r_in, mu)
    mu_s = np.where(outside, (r * mu_s + gap * nu) / r_in, mu_s)
    below = (r_in * mu) ** 2 - h * (2.0 * low + h)
    ground = meets & (mu < 0) & (below >= 0)
    distance = -r_in * mu - np.sqrt(np.maximum(below, 0.0))
    ground_mu_s = np.where(ground, (r_in * mu_s + distance * nu) / low, mu_s)
    result = {"h": h, "mu": mu, "mu_s": mu_s, "nu": nu, "ground_mu_s": ground_mu_s}
    clipped = {name: np.clip(x, -1.0, 1.0) if name != "h" else x for name, x in result.items()}
    return {**clipped, "meets_air": meets, "ground": ground}
