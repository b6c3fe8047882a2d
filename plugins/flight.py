"""Straight flights of light through the air of :mod:`.air`: optical depth by quadrature, and where on the way to
scatter.

Null collisions, with which Mitsuba's integrators pass through media, need a majorant for the whole ray and leave a
clear sky mostly without scattering. The densities of an atmosphere are smooth between known altitudes, so here a
flight is cut at these and its optical depth integrated: four Gauss-Legendre nodes for each piece leave an error below
1e-5. The same nodes say how much of the light is scattered in each piece; one random number picks a piece on the way
(reservoir sampling, Chao 1982), a second one the point in it. Any distribution would leave the mean as it is; this
one makes nearly all weights equal.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from atmo_jit.atmosphere import Atmosphere
from atmo_jit.geometry import altitude_along, distance_down, distance_up, hits_ground, perigee_altitude
from atmo_jit.profile import Exponential
from atmo_jit.quadrature import gauss_legendre, running_integral

from .air import Air, largest

NODES = 4
# Scale heights at which flights are cut: of thin air, and of air with a vertical optical depth above THICK, of which
# smaller parts count.
LEVELS, THICK_LEVELS = (2.0, 5.0, 9.0), (1.0, 2.5, 4.5, 7.0, 10.0, 14.0, 19.0)
THICK = 1.0
MAX_DEPTH = 1.0  # optical depth of a piece in the most opaque channel: bounds the weights within a piece
SPENT_DEPTH = 20.0  # what lies behind 2e-9 of transmittance is not seen
STEEPEST = 20.0  # of the exponential within a piece from which a point is drawn


def levels(atmosphere: Atmosphere) -> np.ndarray:
    """Altitudes (m) from 0 to the top between which every density is smooth and changes by two e-folds at most."""
    top = atmosphere.thickness_m
    kinks = {float(k) for c in atmosphere.constituents for k in c.profile.kinks_m if 0.0 < k < top}
    found = set(kinks)
    for c in atmosphere.constituents:
        if isinstance(c.profile, Exponential):
            height = float(c.profile.scale_height_m)
            thick = float(np.max(c.extinction_per_m)) * height > THICK
            found |= {height * f for f in (THICK_LEVELS if thick else LEVELS) if height * f < top}
    kept = [0.0]
    for level in sorted(found):
        # A cut for smoothness close to another one only costs time.
        if level in kinks or level - kept[-1] > 0.2 * kept[-1]:
            kept.append(level)
    return np.array([*kept, top])


@dataclass
class Flight:
    """A straight way through the air: altitude ``h`` (m) and zenith cosine ``mu`` where it begins, ``start`` (m from
    the ray's origin) and ``length`` (m, 0 where there is no air on the ray); ``shadowed``: the planet is between the
    two ends, for a ray that is to reach beyond it."""

    h: Any
    mu: Any
    start: Any
    length: Any
    shadowed: Any


@dataclass
class Scattering:
    """What :func:`fly` found. ``transmittance`` of the whole flight; ``total``: weighted scattering on all of it;
    ``distance`` (m from the beginning of the flight) of the point drawn; ``weight``: transmittance up to there times
    scattering coefficient over the density of the draw, an unpolarised spectrum."""

    transmittance: Any
    total: Any
    distance: Any
    weight: Any


def flight(air: Air, ray: Any, reach: Any) -> Flight:
    """The part of a ray that is in the air, up to ``reach`` (scene units; infinite: as far as there is air)."""
    radius, top = air.radius, air.thickness
    hits, near, far, _ = air.along(ray)
    q, z = air.relative(ray.o)
    h = air._altitude(q, z)
    r_mu = dr.fma(radius, dr.dot(ray.d, mi.Vector3f(*air.up)), dr.dot(q, ray.d))
    near, far = near * (1.0 / air.scale), far * (1.0 / air.scale)
    # Below the ground there is nothing: a flight that starts there begins where it comes up, if it does.
    under = h < 0.0
    near = dr.select(under, distance_up(radius, h, r_mu / (radius + h), 0.0), near)
    outside = h > top
    h_in = dr.select(under, 0.0, dr.select(outside, top, h))
    mu = dr.clip((r_mu + near) / (radius + h_in), -1.0, 1.0)
    mu = dr.select(under, dr.maximum(mu, 0.0), mu)
    exists = hits & ~(under & (r_mu <= 0.0))
    down = ~under & hits_ground(radius, h_in, mu)
    end = dr.select(down, distance_down(radius, h_in, mu, 0.0), far - near)
    length = dr.minimum(end, reach * (1.0 / air.scale) - near)
    # Shapes that stand for the ground lie a little below altitude 0 (:mod:`.planet`): a beam of the sun that grazes the
    # ground would pass between.
    shadowed = hits & (down | (under & (r_mu <= 0.0))) & (reach * (1.0 / air.scale) > 2.0 * radius)
    return Flight(h_in, mu, near, dr.select(exists, dr.maximum(length, 0.0), 0.0), shadowed)


class Airway:
    """The air on the way of a path: the coefficients at its wavelengths. ``value``: see ``Air.pick``."""

    def __init__(self, air: Air, interaction: Any) -> None:
        self.air = air
        value: Callable[[str], Any] = air.pick(interaction)
        constituents = air.atmosphere.constituents
        self.extinction = [dr.detach(air.extinction(c, value)) for c in constituents]
        self.scattering = [None if c.phase is None else dr.detach(air.scattering(c, value)) for c in constituents]
        self._asymmetries = [air.asymmetry(c, value) for c in constituents]
        edges = levels(air.atmosphere)
        self._levels, self._count = mi.Float(edges.tolist()), len(edges)
        # Of every piece the largest extinction (1/m) that a path may meet there.
        bound = np.full((len(edges) - 1, air.wavelengths.total), 1e-30)
        for c in constituents:
            bound += largest(c.profile, edges)[:, None] * c.extinction_per_m
        rows = [bound[:, list(row)].max(axis=1) for row in air.wavelengths.rows]
        self._densest = mi.Float(np.concatenate(rows).tolist())
        self._row = air.wavelengths.row(interaction) * (len(edges) - 1)
        dr.make_opaque(self._levels, self._densest)
        self._x, self._w = (v.tolist() for v in gauss_legendre(NODES))
        # Integral from 0 up to each node.
        self._running = running_integral(NODES, tuple(self._x)).tolist()

    def depth(self, amounts: list[Any]) -> Any:
        """Optical depth of column densities (m)."""
        total = mi.UnpolarizedSpectrum(0.0)
        for extinction, amount in zip(self.extinction, amounts, strict=True):
            total += extinction * amount
        return total

    def scattered(self, densities: list[Any], worth: list[Any] | None = None) -> Any:
        """Scattering coefficient (1/m) at given densities, each constituent's times its ``worth``."""
        total = mi.UnpolarizedSpectrum(0.0)
        for k, (scattering, density) in enumerate(zip(self.scattering, densities, strict=True)):
            if scattering is not None:
                total += scattering * (density if worth is None else density * worth[k])
        return total

    def phase_values(self, nu: Any) -> list[Any]:
        """Phase function (1/sr) of every constituent at a cosine, the mean over the channels; None where it has
        none."""
        found = []
        for c, g in zip(self.air.atmosphere.constituents, self._asymmetries, strict=True):
            value = None if c.phase is None else self.air.phase_value(c, g, nu)
            found.append(value if value is None or isinstance(value, mi.Float) else dr.mean(value))
        return found

    def _first_shell(self, f: Flight) -> Any:
        falling = f.mu < 0.0

        def below(i: Any) -> Any:
            level = dr.gather(mi.Float, self._levels, i)
            return (level < f.h) | (~falling & (level <= f.h))

        return dr.clip(mi.Int32(dr.binary_search(0, self._count - 1, below)) - 1, 0, self._count - 2)

    def amounts(self, f: Flight) -> list[Any]:
        """Column density (m) of every constituent on a flight."""
        return self._follow(f)[2]

    def transmittance(self, f: Flight) -> Any:
        """Transmittance of a flight."""
        return dr.exp(-self.depth(self.amounts(f)))

    def fly(self, f: Flight, importance: Any, sample1: Any, sample2: Any, worth: Any = None) -> Scattering:
        """Transmittance of a flight, and a point on it.

        importance: what light of each channel is worth to the path; sample1, sample2: uniform numbers; worth:
        function of (distance, altitude, radius) that says what light scattered there is worth [constituent], the same
        everywhere if there is none."""
        count = len(self.extinction)
        _, _, amounts, _, total, kept, before = self._follow(f, importance, sample1, worth)
        transmittance = dr.exp(-self.depth(amounts))

        def density_at(distance: Any) -> list[Any]:
            return self.air.densities(altitude_along(self.air.radius, f.h, f.mu, distance)[0])

        begin, length, slope, share = kept
        flat = dr.abs(slope) < 1e-3
        growth = dr.exp(slope) - 1.0
        safe = dr.select(flat, 1.0, slope)
        x = dr.select(flat, sample2, dr.log(1.0 + sample2 * growth) / safe)
        x = dr.clip(x, 0.0, 1.0)
        relative = dr.select(flat, 1.0, safe * dr.exp(safe * x) / growth)  # density of x
        distance = dr.fma(length, x, begin)
        densities = [density_at(dr.fma(length * x, node, begin)) for node in self._x]
        inside = [
            dr.fma(length * x, sum(w * row[k] for w, row in zip(self._w, densities, strict=True)), before[k])
            for k in range(count)
        ]
        density = share / total * relative / length
        weight = self.scattered(density_at(distance)) * dr.exp(-self.depth(inside))
        weight = dr.select(share > 0.0, weight / density, 0.0)
        return Scattering(transmittance, total, distance, weight)

    def _follow(self, f: Flight, importance: Any = None, sample: Any = None, worth: Any = None) -> tuple[Any, ...]:
        """Go along a flight: the loop's state at its end."""
        radius = self.air.radius
        draws = importance is not None
        perigee = perigee_altitude(radius, f.h, f.mu)
        r_mu = (radius + f.h) * f.mu
        count, last = len(self.extinction), self._count - 2

        def piece(d: Any, shell: Any, amounts: list[Any], u: Any, total: Any, kept: list[Any], before: list[Any]):
            falling = r_mu + d < 0.0
            target = dr.gather(mi.Float, self._levels, mi.UInt32(dr.select(falling, shell, shell + 1)))
            bottoms_out = falling & (target <= perigee)
            crossing = dr.select(
                falling, distance_down(radius, f.h, f.mu, target), distance_up(radius, f.h, f.mu, target)
            )
            crossing = dr.maximum(dr.select(bottoms_out, -r_mu, crossing), d)
            # Beyond the outermost levels there is nothing: the end, known a little differently, must still be reached.
            leaves = ~bottoms_out & dr.select(falling, shell == 0, shell == last)
            crossing = dr.select(leaves, dr.inf, crossing)
            end = dr.minimum(crossing, f.length)
            if draws:
                densest = dr.gather(mi.Float, self._densest, self._row + mi.UInt32(shell))
                end = dr.minimum(end, d + MAX_DEPTH / densest)
            length = end - d
            places = [dr.fma(length, x, d) for x in self._x]
            points = [altitude_along(radius, f.h, f.mu, place) for place in places]
            densities = [self.air.densities(h) for h, _ in points]
            column = [length * sum(w * row[k] for w, row in zip(self._w, densities, strict=True)) for k in range(count)]
            crossed = end >= crossing
            if draws:
                rates = []
                for place, point, running, row in zip(places, points, self._running, densities, strict=True):
                    inside = [
                        dr.fma(length, sum(a * other[k] for a, other in zip(running, densities, strict=True)), start)
                        for k, start in enumerate(amounts)
                    ]
                    scattered = self.scattered(row, worth and worth(place, *point))
                    rates.append(dr.sum(importance * scattered * dr.exp(-self.depth(inside))))
                share = length * sum(w * rate for w, rate in zip(self._w, rates, strict=True))
                total = total + share
                chance = dr.select(share > 0.0, share / total, 0.0)
                take = u < chance
                u = dr.select(take, u / chance, (u - chance) / (1.0 - chance))
                slope = dr.log(rates[-1] / rates[0]) * (1.0 / (self._x[-1] - self._x[0]))
                slope = dr.select(dr.isfinite(slope), dr.clip(slope, -STEEPEST, STEEPEST), 0.0)
                found = (d, length, slope, share)
                kept = [dr.select(take, new, old) for new, old in zip(found, kept, strict=True)]
                before = [dr.select(take, new, old) for new, old in zip(amounts, before, strict=True)]
            amounts = [a + c for a, c in zip(amounts, column, strict=True)]
            shell = dr.select(crossed & ~bottoms_out, dr.clip(shell + dr.select(falling, -1, 1), 0, last), shell)
            return end, shell, amounts, u, total, kept, before

        def unfinished(d: Any, shell: Any, amounts: list[Any], *_: Any) -> Any:
            return (d < f.length) & (dr.min(self.depth(amounts)) < SPENT_DEPTH)

        width = dr.width(f.length)
        zero = dr.zeros(mi.Float, width)
        state = (
            zero + 0.0,
            self._first_shell(f),
            [zero + 0.0 for _ in range(count)],
            zero + sample if draws else zero + 0.0,
            zero + 0.0,
            [zero + 0.0 for _ in range(4)],
            [zero + 0.0 for _ in range(count)],
        )
        return dr.while_loop(state, unfinished, piece, label="flight")
