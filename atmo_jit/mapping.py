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

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ._arrays import module_of


def texels(count: int, *, ends: bool = True) -> np.ndarray:
    """Unit coordinates of ``count`` texels' centres: i / (n - 1), or (i + 1/2) / n without ``ends``."""
    return np.linspace(0.0, 1.0, count) if ends else (np.arange(count) + 0.5) / count


def texture_coordinate(x: Any, count: int) -> Any:
    """Unit coordinate to texture coordinate of a table with texels on both ends: 0.5 / n + x (1 - 1 / n). B17."""
    return 0.5 / count + x * (1.0 - 1.0 / count)


def unit_coordinate(u: Any, count: int) -> Any:
    """Inverse of :func:`texture_coordinate`."""
    return (u - 0.5 / count) / (1.0 - 1.0 / count)


def horizon(radius: float, h: Any) -> Any:
    """Cosine of the horizon's zenith angle, -sqrt(1 - (R / (R + h))^2), without cancellation at small h."""
    return -_root(h * (2.0 * radius + h)) / (radius + h)


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
        x_down = _where(at_ground, (down - h) / _where(at_ground, longest_down, 1.0), 0.0)
        nearest = self.top - self.bottom - h
        x_up = (self._to_top(h, mu) - nearest) / (rho + self.reach - nearest)
        return xp.clip(_where(ground, x_down, x_up), 0.0, 1.0)

    def view_inverse(self, h: Any, x_mu: Any, ground: Any) -> Any:
        """mu of x_mu in the half ``ground``."""
        rho = self._rho(h)
        nearest = self.top - self.bottom - h
        up = self._mu_up(h, nearest + x_mu * (rho + self.reach - nearest))
        d = h + x_mu * (rho - h)
        r = self.bottom + h
        below = d > 0.0
        fall = -(rho * rho + d * d) / _where(below, 2.0 * r * d, 1.0)
        return _where(ground, _clip(_where(below, fall, -1.0), -1.0, 1.0), up)

    @staticmethod
    def view_row(x_mu: Any, ground: Any, count: int) -> Any:
        """Texture coordinate u_mu of a table with ``count`` rows: straight down, horizon | zenith, horizon are its rows
        count/2 - 1, 0 | count/2, count - 1."""
        inner = texture_coordinate(x_mu, count // 2)
        return _where(ground, 0.5 - 0.5 * inner, 0.5 + 0.5 * inner)

    def sun(self, mu_s: Any) -> Any:
        """x_mu_s = max(1 - a / A, 0) / (1 + a). B17 GetScatteringTextureUvwzFromRMuMuSNu."""
        a, lowest = self._sun_distance(mu_s), self._sun_distance(np.float64(self.mu_s_min))
        return _maximum(1.0 - a / float(lowest), 0.0) / (1.0 + a)

    def sun_inverse(self, x_mu_s: Any) -> Any:
        """mu_s at or above mu_s_min."""
        lowest = float(self._sun_distance(np.float64(self.mu_s_min)))
        a = lowest * (1.0 - x_mu_s) / (1.0 + lowest * x_mu_s)
        nearest = self.top - self.bottom
        d = nearest + _minimum(a, lowest) * (self.reach - nearest)
        there = d > 0.0
        rise = (self.reach - d) * (self.reach + d) / _where(there, 2.0 * self.bottom * d, 1.0)
        return _clip(_where(there, rise, 1.0), -1.0, 1.0)

    @staticmethod
    def angle(nu: Any) -> Any:
        """x_nu = (nu + 1) / 2."""
        return 0.5 * nu + 0.5

    @staticmethod
    def angle_inverse(x_nu: Any, mu: Any, mu_s: Any) -> Any:
        """nu, held to the range that ``mu`` and ``mu_s`` leave: mu mu_s -/+ sqrt((1 - mu^2)(1 - mu_s^2))."""
        sines = _root((1.0 - mu) * (1.0 + mu)) * _root((1.0 - mu_s) * (1.0 + mu_s))
        return _minimum(_maximum(2.0 * x_nu - 1.0, mu * mu_s - sines), mu * mu_s + sines)

    def _rho(self, h: Any) -> Any:
        return _root(h * (2.0 * self.bottom + h))

    def _altitude(self, x_r: Any) -> Any:
        """h from rho = x_r H: rho^2 / (R + r)."""
        square = (x_r * self.reach) * (x_r * self.reach)
        return square / (self.bottom + _root(square + self.bottom * self.bottom))

    def _to_top(self, h: Any, mu: Any) -> Any:
        along, rise = (self.bottom + h) * mu, (self.top - self.bottom - h) * (self.top + self.bottom + h)
        root = _root(along * along + rise)
        up = along > 0.0
        return _where(up, rise / _where(up, root + along, 1.0), root - along)

    def _to_ground(self, h: Any, mu: Any) -> Any:
        along, square = (self.bottom + h) * mu, h * (2.0 * self.bottom + h)
        falling = mu < 0.0
        return _where(falling, square / _where(falling, _root(along * along - square) - along, 1.0), 0.0)

    def _mu_up(self, h: Any, d: Any) -> Any:
        """mu of a ray that reaches the top at distance ``d``: (H^2 - rho^2 - d^2) / (2 r d)."""
        rise = (self.top - self.bottom - h) * (self.top + self.bottom + h)
        there = d > 0.0
        mu = (rise - d * d) / _where(there, 2.0 * (self.bottom + h) * d, 1.0)
        return _clip(_where(there, mu, 1.0), -1.0, 1.0)

    def _sun_distance(self, mu_s: Any) -> Any:
        """a: distance to the top from the ground, from its least (0) to that of a horizontal ray (1)."""
        along, rise = self.bottom * mu_s, self.reach * self.reach
        root = _root(along * along + rise)
        up = along > 0.0
        d = _where(up, rise / _where(up, root + along, 1.0), root - along)
        nearest = self.top - self.bottom
        return (d - nearest) / (self.reach - nearest)


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
        edge = _acos(horizon(self.bottom, h))
        theta = _acos(_clip(mu, -1.0, 1.0))
        up = 0.5 - 0.5 * _root(1.0 - theta / edge)
        down = 0.5 + 0.5 * _root((theta - edge) / (math.pi - edge))
        return _where(ground, down, up), _root(0.5 - 0.5 * cos_phi)

    def sky_view_inverse(self, h: Any, v: Any, u: Any) -> tuple[Any, Any, Any]:
        """(mu, cos phi, ground). UvToSkyViewLutParams."""
        ground = v > 0.5
        edge = _acos(horizon(self.bottom, h))
        from_edge = 2.0 * v - 1.0
        square = from_edge * from_edge
        theta = _where(ground, edge + (math.pi - edge) * square, edge * (1.0 - square))
        return module_of(theta).cos(theta), 1.0 - 2.0 * u * u, ground

    @staticmethod
    def slice(distance: Any, reach: float) -> Any:
        """Depth coordinate w of an aerial-perspective froxel: sqrt(d / reach); reach = slices x length per slice."""
        return _root(distance / reach)

    @staticmethod
    def slice_inverse(w: Any, reach: float) -> Any:
        """Distance (m) of w: squared."""
        return w * w * reach


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


def half_elevation(mu: Any) -> Any:
    """q = sin(e / 2) for the elevation e above the horizontal, mu / sqrt(2 (1 + sqrt(1 - mu^2))).

    As evenly spread over the sky as e itself, at the cost of two square roots. From -sqrt(1/2) to sqrt(1/2).
    """
    return mu / _root(2.0 + 2.0 * _root((1.0 - mu) * (1.0 + mu)))


def half_elevation_inverse(q: Any) -> Any:
    """mu = sin e = 2 q sqrt(1 - q^2)."""
    return 2.0 * q * _root((1.0 - q) * (1.0 + q))


STEEPEST = math.sqrt(0.5)  # half_elevation(1)


def from_horizon(q: Any, edge: Any, end: Any) -> Any:
    """x = sqrt((q - edge) / (end - edge)): 0 on the horizon, 1 at ``end``; H20's square root, of half_elevation."""
    return _root((q - edge) / (end - edge))


def from_horizon_inverse(x: Any, edge: Any, end: Any) -> Any:
    """q of :func:`from_horizon`."""
    return edge + (end - edge) * x * x


def crowded(x: Any, place: float, knee: float) -> Any:
    """y, linear from 0 to ``knee`` at x = ``place`` and on to 1 at 1: more room about 0 where place < knee."""
    return _minimum(x * (knee / place), 1.0 - (1.0 - x) * ((1.0 - knee) / (1.0 - place)))


def crowded_inverse(y: Any, place: float, knee: float) -> Any:
    """x of :func:`crowded`."""
    return _maximum(y * (place / knee), 1.0 - (1.0 - y) * ((1.0 - place) / (1.0 - knee)))


def half_azimuth(cos_phi: Any) -> Any:
    """x = sin(phi / 2) = sqrt((1 - cos phi) / 2): 0 toward the sun, 1 opposite. H20."""
    return _root(0.5 - 0.5 * cos_phi)


def half_azimuth_inverse(x: Any) -> Any:
    """cos phi."""
    return 1.0 - 2.0 * x * x


def twilight_sun(mu_s: Any, lowest: float, steepness: float) -> Any:
    """x = (atan(k mu_s) - atan(k lowest)) / (atan(k) - atan(k lowest)): from ``lowest`` (0) to the zenith (1), crowded
    about the horizontal.

    The form of B08's map for mu_s; the steepness k is a parameter here.
    """
    start = math.atan(steepness * lowest)
    return (_atan(steepness * mu_s) - start) / (math.atan(steepness) - start)


def twilight_sun_inverse(x: Any, lowest: float, steepness: float) -> Any:
    """mu_s."""
    start = math.atan(steepness * lowest)
    return _clip(module_of(x).tan(start + x * (math.atan(steepness) - start)) / steepness, -1.0, 1.0)


def _split_power(mu: Any, edge: Any, power: float) -> Any:
    above = mu >= edge
    reach = _where(above, 1.0 - edge, 1.0 + edge)
    part = _power(abs(mu - edge) / reach, power)
    return _where(above, 0.5 + 0.5 * part, 0.5 - 0.5 * part)


def _join_power(x: Any, edge: Any, power: float) -> Any:
    above = x >= 0.5
    part = _power(abs(2.0 * x - 1.0), 1.0 / power)
    return _where(above, edge + (1.0 - edge) * part, edge - (1.0 + edge) * part)


def _power(x: Any, p: float) -> Any:
    return _maximum(x, 0.0) ** p


def _where(condition: Any, a: Any, b: Any) -> Any:
    xp = module_of(condition, a, b)
    return np.where(condition, a, b) if xp is np else xp.select(condition, a, b)


def _root(x: Any) -> Any:
    """Square root, 0 of what rounding made negative."""
    return module_of(x).sqrt(_maximum(x, 0.0))


def _maximum(a: Any, b: Any) -> Any:
    return module_of(a, b).maximum(a, b)


def _minimum(a: Any, b: Any) -> Any:
    return module_of(a, b).minimum(a, b)


def _clip(x: Any, low: float, high: float) -> Any:
    return module_of(x).clip(x, low, high)


def _acos(x: Any) -> Any:
    xp = module_of(x)
    return np.arccos(x) if xp is np else xp.acos(x)


def _atan(x: Any) -> Any:
    xp = module_of(x)
    return np.arctan(x) if xp is np else xp.atan(x)
