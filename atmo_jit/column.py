"""Column densities (m) of every constituent from any point to the sun: one small table per planet profile.

Columns, not transmittance, are stored: exp(-sum beta_k N_k) neither underflows nor divides 0 by 0 in haze, and coefficients,
wavelengths and ozone amount drop out of the table.

Only rays that rise (mu >= 0) are tabulated. A ray that descends passes its perigee at altitude h_p and rises again, so that
N(h, -mu) = 2 N(h_p, 0) - N(h, mu). What is stored is the mean density along the path to the top, N / d_top: finite and smooth
up to the top, where both vanish, and constant in mu for a flat layer. Exponential profiles are stored as its logarithm, linear in h.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from .backend import packet, parameter, types
from .geometry import altitude_along, distance_up, perigee_altitude
from .optics import Optics
from .profile import Exponential
from .quadrature import gauss_legendre

NODES_PER_LAYER = 4


class SunColumns:
    """Table of mean densities over altitude (uniform) and mu in [0, 1] (logarithmic from the horizontal); bilinear.

    ``size`` = (altitudes, cosines). The cosine nodes are mu = c (e^{s x} - 1), fine where the thinnest layer's path length
    turns from 1/mu to horizontal, mu about sqrt(2 H / R).
    """

    def __init__(self, optics: Optics, size: tuple[int, int] = (96, 128)) -> None:
        self.optics = optics
        self.size = size
        self._logarithmic = [isinstance(c.profile, Exponential) for c in optics.constituents]
        atmosphere = optics.atmosphere
        heights = [c.profile.scale_height_m for c in optics.constituents if isinstance(c.profile, Exponential)]
        thinnest = min([atmosphere.thickness_m, *heights])
        knee = 0.7 * np.sqrt(2.0 * thinnest / atmosphere.bottom_radius_m)
        self._knee = parameter(knee)
        self._log_range = parameter(np.log1p(1.0 / knee))
        self._count = len(optics.constituents)
        if self._count:
            self._table = self._build()

    def _build(self) -> Any:
        t = types()
        n_h, n_mu = self.size
        lane = dr.arange(t.UInt, n_h * n_mu)
        row, column = lane // n_mu, lane % n_mu
        top = self.optics.thickness
        # The last row would be 0 / 0: a hair below the top the mean density is the density there.
        h = dr.minimum(t.Float(row) / (n_h - 1), 1.0 - 1e-4) * top
        x = t.Float(column) / (n_mu - 1)
        mu = self._knee * (dr.exp(x * self._log_range) - 1.0)
        totals = column_up(self.optics, h, dr.minimum(mu, 1.0))
        path = distance_up(self.optics.radius, h, dr.minimum(mu, 1.0), top)
        table = dr.zeros(t.Float, n_h * n_mu * self._count)
        for k, total in enumerate(totals):
            mean = total / path
            if self._logarithmic[k]:
                mean = dr.log(dr.maximum(mean, 1e-37))
            dr.scatter(table, mean, lane * self._count + k)
        return table

    def toward(self, h: Any, mu: Any, active: Any = True) -> list[Any]:
        """Column density (m) of every constituent from altitude ``h`` to the top in direction ``mu`` of either sign.

        A ray that would pass below the ground is lifted to its horizon, the ray that grazes the ground: while the sun's centre is
        below the horizon, the part of the disc still seen is there.
        """
        radius = self.optics.radius
        mu = dr.maximum(mu, -dr.sqrt(h * (2.0 * radius + h)) / (radius + h))
        up = self._rising(h, dr.abs(mu), active)
        sinks = active & (mu < 0.0)
        lowest = dr.maximum(perigee_altitude(self.optics.radius, h, mu), 0.0)
        whole = self._rising(lowest, types().Float(0.0), sinks)
        return [dr.select(mu < 0.0, dr.maximum(2.0 * w - u, u), u) for u, w in zip(up, whole, strict=True)]

    def _rising(self, h: Any, mu: Any, active: Any) -> list[Any]:
        t = types()
        n_h, n_mu = self.size
        top = self.optics.thickness
        y = dr.clip(h / top, 0.0, 1.0) * (n_h - 1)
        x = dr.log(1.0 + mu / self._knee) / self._log_range * (n_mu - 1)
        row = dr.minimum(t.UInt(y), n_h - 2)
        column = dr.minimum(t.UInt(x), n_mu - 2)
        fy, fx = y - t.Float(row), x - t.Float(column)
        corner = row * n_mu + column
        n = self._count
        a, b, c, d = (packet(self._table, corner + offset, n, active) for offset in (0, 1, n_mu, n_mu + 1))
        path = distance_up(self.optics.radius, h, mu, top)
        result = []
        for k in range(n):
            mean = dr.lerp(dr.lerp(a[k], b[k], fx), dr.lerp(c[k], d[k], fx), fy)
            result.append((dr.exp(mean) if self._logarithmic[k] else mean) * path)
        return result


def column_up(optics: Optics, h: Any, mu: Any) -> list[Any]:
    """Column density (m) of every constituent from ``h`` to the top along mu >= 0, by Gauss-Legendre between the profile's breaks."""
    t = types()
    breaks = dr.opaque(t.Float, 0) if len(optics.breaks_m) == 0 else t.Float(optics.breaks_m.astype(np.float32))
    x, w = gauss_legendre(NODES_PER_LAYER)

    def layer(index: Any, totals: list[Any]) -> tuple[Any, list[Any]]:
        low = dr.maximum(dr.gather(t.Float, breaks, index), h)
        high = dr.maximum(dr.gather(t.Float, breaks, index + 1), h)
        start = distance_up(optics.radius, h, mu, low)
        length = distance_up(optics.radius, h, mu, high) - start
        for node, weight in zip(x, w, strict=True):
            there, _ = altitude_along(optics.radius, h, mu, dr.fma(length, float(node), start))
            for k, density in enumerate(optics.densities(there)):
                totals[k] = dr.fma(length * float(weight), density, totals[k])
        return index + 1, totals

    last = dr.opaque(t.UInt, len(optics.breaks_m) - 1, 1)
    zero = [dr.zeros(t.Float, dr.width(h)) for _ in optics.constituents]
    _, totals = dr.while_loop((t.UInt(0), zero), lambda i, _: i < last, layer, max_iterations=-1, label="column_up")
    return totals
