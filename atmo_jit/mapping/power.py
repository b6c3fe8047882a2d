"""Powers of altitude and cosines: tables of three dimensions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from .axes import horizon
from .either import maximum, where


@dataclass(frozen=True)
class Power3D:
    """Tables of altitude, view zenith and sun zenith, without azimuth (the phase function of single scattering is
    applied at look-up): powers about the horizontal, or about the horizon.

    x_h = (h / thickness)^``altitude``; x_mu, x_mu_s = 1/2 +- 1/2 |mu|^p with p = ``view`` and ``sun``, as E09 section 4
    has for altitude and others for cosines. ``about_horizon``: x_mu is 1/2 on the horizon of h, and either side is
    stretched over its own range.
    """

    bottom: float
    top: float
    altitude: float = 0.5
    view: float = 0.5
    sun: float = 0.5
    about_horizon: bool = False

    def coordinates(self, h: Any, mu: Any, mu_s: Any) -> tuple[Any, Any, Any]:
        """(x_h, x_mu, x_mu_s)."""
        x_h = _power(h / (self.top - self.bottom), self.altitude)
        edge = horizon(self.bottom, h) if self.about_horizon else 0.0 * h
        return x_h, _split_power(mu, edge, self.view), _split_power(mu_s, 0.0 * mu_s, self.sun)

    def inverse(self, x_h: Any, x_mu: Any, x_mu_s: Any) -> tuple[Any, Any, Any]:
        """(h, mu, mu_s)."""
        h = (self.top - self.bottom) * _power(x_h, 1.0 / self.altitude)
        edge = horizon(self.bottom, h) if self.about_horizon else 0.0 * h
        return h, _join_power(x_mu, edge, self.view), _join_power(x_mu_s, 0.0 * x_mu_s, self.sun)



def _split_power(mu: Any, edge: Any, power: float) -> Any:
    above = mu >= edge
    reach = where(above, 1.0 - edge, 1.0 + edge)
    part = _power(abs(mu - edge) / reach, power)
    return where(above, 0.5 + 0.5 * part, 0.5 - 0.5 * part)


def _join_power(x: Any, edge: Any, power: float) -> Any:
    above = x >= 0.5
    part = _power(abs(2.0 * x - 1.0), 1.0 / power)
    return where(above, edge + (1.0 - edge) * part, edge - (1.0 + edge) * part)


def _power(x: Any, p: float) -> Any:
    return maximum(x, 0.0) ** p
