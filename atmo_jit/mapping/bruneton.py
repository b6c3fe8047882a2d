"""Bruneton's maps: transmittance, irradiance, scattering."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from .._arrays import module_of
from .axes import texture_coordinate
from .either import clip, maximum, minimum, square_root, where


@dataclass(frozen=True)
class Bruneton:
    """Maps of Bruneton's tables, in all clients that read them. B08 section 4, B17 functions.glsl.

    ``bottom``, ``top`` (m): radii of ground and top; ``mu_s_min``: the lowest sun of the scattering table.
    """

    bottom: float
    top: float
    mu_s_min: float = -0.5

    @property
    def reach(self) -> float:
        """H = sqrt(top^2 - bottom^2): the longest distance to the top of a horizontal ray from the ground."""
        return math.sqrt((self.top - self.bottom) * (self.top + self.bottom))

    def transmittance(self, h: Any, mu: Any) -> tuple[Any, Any]:
        """(x_r, x_mu), rays that miss the ground. B17 GetTransmittanceTextureUvFromRMu."""
        rho = self._rho(h)
        nearest = self.top - self.bottom - h
        return rho / self.reach, (self._to_top(h, mu) - nearest) / (rho + self.reach - nearest)

    def transmittance_inverse(self, x_r: Any, x_mu: Any) -> tuple[Any, Any]:
        """(h, mu). B17 GetRMuFromTransmittanceTextureUv."""
        h = self._altitude(x_r)
        nearest = self.top - self.bottom - h
        return h, self._mu_up(h, nearest + x_mu * (x_r * self.reach + self.reach - nearest))

    def irradiance(self, h: Any, mu_s: Any) -> tuple[Any, Any]:
        """(x_r, x_mu_s). B17 GetIrradianceTextureUvFromRMuS."""
        return h / (self.top - self.bottom), 0.5 * mu_s + 0.5

    def irradiance_inverse(self, x_r: Any, x_mu_s: Any) -> tuple[Any, Any]:
        """(h, mu_s)."""
        return x_r * (self.top - self.bottom), 2.0 * x_mu_s - 1.0

    def view(self, h: Any, mu: Any, ground: Any) -> Any:
        """x_mu in [0, 1] of either half of the scattering table: 0 where the ray is shortest (straight down or up), 1
        at the horizon.

        B17 GetScatteringTextureUvwzFromRMuMuSNu, before both halves are put side by side (:meth:`view_row`).
        """
        xp, rho = module_of(h, mu), self._rho(h)
        down, longest_down = self._to_ground(h, mu), rho - h
        at_ground = longest_down > 0.0
        x_down = where(at_ground, (down - h) / where(at_ground, longest_down, 1.0), 0.0)
        nearest = self.top - self.bottom - h
        x_up = (self._to_top(h, mu) - nearest) / (rho + self.reach - nearest)
        return xp.clip(where(ground, x_down, x_up), 0.0, 1.0)

    def view_inverse(self, h: Any, x_mu: Any, ground: Any) -> Any:
        """mu of x_mu in the half ``ground``."""
        rho = self._rho(h)
        nearest = self.top - self.bottom - h
        up = self._mu_up(h, nearest + x_mu * (rho + self.reach - nearest))
        d = h + x_mu * (rho - h)
        r = self.bottom + h
        below = d > 0.0
        fall = -(rho * rho + d * d) / where(below, 2.0 * r * d, 1.0)
        return where(ground, clip(where(below, fall, -1.0), -1.0, 1.0), up)

    @staticmethod
    def view_row(x_mu: Any, ground: Any, count: int) -> Any:
        """Texture coordinate u_mu of a table with ``count`` rows: straight down, horizon | zenith, horizon are its rows
        count/2 - 1, 0 | count/2, count - 1."""
        inner = texture_coordinate(x_mu, count // 2)
        return where(ground, 0.5 - 0.5 * inner, 0.5 + 0.5 * inner)

    def sun(self, mu_s: Any) -> Any:
        """x_mu_s = max(1 - a / A, 0) / (1 + a). B17 GetScatteringTextureUvwzFromRMuMuSNu."""
        a, lowest = self._sun_distance(mu_s), self._sun_distance(np.float64(self.mu_s_min))
        return maximum(1.0 - a / float(lowest), 0.0) / (1.0 + a)

    def sun_inverse(self, x_mu_s: Any) -> Any:
        """mu_s at or above mu_s_min."""
        lowest = float(self._sun_distance(np.float64(self.mu_s_min)))
        a = lowest * (1.0 - x_mu_s) / (1.0 + lowest * x_mu_s)
        nearest = self.top - self.bottom
        d = nearest + minimum(a, lowest) * (self.reach - nearest)
        there = d > 0.0
        rise = (self.reach - d) * (self.reach + d) / where(there, 2.0 * self.bottom * d, 1.0)
        return clip(where(there, rise, 1.0), -1.0, 1.0)

    @staticmethod
    def angle(nu: Any) -> Any:
        """x_nu = (nu + 1) / 2."""
        return 0.5 * nu + 0.5

    @staticmethod
    def angle_inverse(x_nu: Any, mu: Any, mu_s: Any) -> Any:
        """nu, held to the range that ``mu`` and ``mu_s`` leave: mu mu_s -/+ sqrt((1 - mu^2)(1 - mu_s^2))."""
        sines = square_root((1.0 - mu) * (1.0 + mu)) * square_root((1.0 - mu_s) * (1.0 + mu_s))
        return minimum(maximum(2.0 * x_nu - 1.0, mu * mu_s - sines), mu * mu_s + sines)

    def _rho(self, h: Any) -> Any:
        return square_root(h * (2.0 * self.bottom + h))

    def _altitude(self, x_r: Any) -> Any:
        """h from rho = x_r H: rho^2 / (R + r)."""
        square = (x_r * self.reach) * (x_r * self.reach)
        return square / (self.bottom + square_root(square + self.bottom * self.bottom))

    def _to_top(self, h: Any, mu: Any) -> Any:
        along, rise = (self.bottom + h) * mu, (self.top - self.bottom - h) * (self.top + self.bottom + h)
        root = square_root(along * along + rise)
        up = along > 0.0
        return where(up, rise / where(up, root + along, 1.0), root - along)

    def _to_ground(self, h: Any, mu: Any) -> Any:
        along, square = (self.bottom + h) * mu, h * (2.0 * self.bottom + h)
        falling = mu < 0.0
        return where(falling, square / where(falling, square_root(along * along - square) - along, 1.0), 0.0)

    def _mu_up(self, h: Any, d: Any) -> Any:
        """mu of a ray that reaches the top at distance ``d``: (H^2 - rho^2 - d^2) / (2 r d)."""
        rise = (self.top - self.bottom - h) * (self.top + self.bottom + h)
        there = d > 0.0
        mu = (rise - d * d) / where(there, 2.0 * (self.bottom + h) * d, 1.0)
        return clip(where(there, mu, 1.0), -1.0, 1.0)

    def _sun_distance(self, mu_s: Any) -> Any:
        """a: distance to the top from the ground, from its least (0) to that of a horizontal ray (1)."""
        along, rise = self.bottom * mu_s, self.reach * self.reach
        root = square_root(along * along + rise)
        up = along > 0.0
        d = where(up, rise / where(up, root + along, 1.0), root - along)
        nearest = self.top - self.bottom
        return (d - nearest) / (self.reach - nearest)
