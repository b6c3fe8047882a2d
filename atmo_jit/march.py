"""Marching along view rays: exact single scattering, the gather of multiple scattering, columns and transmittance in
one pass.

A ray is cut where something happens: at the altitudes where a profile has a kink or has changed by some e-folds, at
its perigee, where it enters or leaves the planet's shadow, and wherever the optical depth has grown by MAX_DEPTH in a
channel in which anything is still seen. Inside a piece everything is smooth and four Gauss-Legendre nodes suffice, in
clear air and in fog alike; eight where densities jump.
Every ray stops as soon as its transmittance is spent.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import drjit as dr
import numpy as np

from .backend import floats, packet, parameter, row, table_of, types
from .column import SunColumns
from .geometry import UPRIGHT, altitude_along, distance_down, distance_up, hits_ground, perigee_altitude, safe_sine
from .levels import corners, dusk, has_steps
from .optics import Optics
from .quadrature import gauss_legendre, running_integral

NODES = 4  # per piece
# The same where densities jump: the column toward the sun has a square-root edge where sunlight grazes a jump, and
# pieces begin there.
NODES_AT_STEPS = 8
FEW = 4  # per piece, for densities and columns, which are smooth
MAX_DEPTH = 1.0  # optical depth of a piece: exp(-tau) over it is a polynomial of degree 7 to 1e-7
MAX_TURN = 0.03  # radians about the planet's centre: the light that scatters again changes with the sun's height
SPENT_DEPTH = 20.0  # what lies behind 2e-9 of transmittance is not seen


@dataclass
class Rays:
    """Rays that start inside the atmosphere, with the sun's place; every member a Float or Bool array of one width, or
    Float64 for the march of Optics.exact.

    ``h`` altitude (m) of the origin; ``mu``, ``mu_s``, ``nu``: cosines of view zenith, sun zenith (at the origin) and
    their angle; ``stop`` distance (m) to the end; ``ground``: the ray ends on the ground.
    """

    h: Any
    mu: Any
    mu_s: Any
    nu: Any
    stop: Any
    ground: Any

    def single(self) -> Rays:
        """The same in single precision."""
        kind = types().Float
        return Rays(*(kind(v) for v in (self.h, self.mu, self.mu_s, self.nu, self.stop)), self.ground)


@dataclass
class Light:
    """What a march returns, per channel: ``single`` and ``multiple`` scattered radiance and the ``transmittance`` to
    the end."""

    single: list[Any]
    multiple: list[Any]
    transmittance: list[Any]


class Source(Protocol):
    """A field of scattered radiance that scatters again."""

    def scattered(self, h: Any, mu_s: Any, mu: Any, cos_phi: Any, active: Any) -> list[list[Any]]:
        """Integral of phase function times radiance over all directions, toward (mu, phi): [scatterer][channel]."""


def rays_to_boundary(
    optics: Optics, h: Any, mu: Any, mu_s: Any, nu: Any, planet: tuple[Any, Any] | None = None
) -> Rays:
    """Rays from ``h`` to whatever they meet first, the ground or the top, in the precision of ``h``; ``planet``: its
    radius and thickness of air in that precision.

    That is decided in it too: in single precision a ray 1e-7 rad off the horizon may be taken for one
    on its other side, which sees other light.
    """
    t, wide = types(), type(h)
    radius, top = planet or (wide(optics.radius), wide(optics.thickness))
    ground = hits_ground(radius, h, mu)
    stop = dr.select(ground, distance_down(radius, h, mu, 0.0), distance_up(radius, h, mu, top))
    return Rays(h, mu, mu_s, nu, stop, t.Bool(ground))


def visible_sun(optics: Optics, h: Any, r: Any, mu_s: Any) -> Any:
    """Fraction of the solar disc above the horizon of a point at altitude ``h``: a smooth step over the disc's
    angular diameter.

    Bruneton 2017, GetTransmittanceToSun; a point sun (radius 0) is cut sharply.
    """
    horizon_sine = optics.radius / r
    horizon_mu = -dr.safe_sqrt(h * (2.0 * optics.radius + h)) / r
    half_width = dr.maximum(horizon_sine * optics.sun_radius, 1e-7)
    x = dr.clip(0.5 + 0.5 * (mu_s - horizon_mu) / half_width, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


def point_along(optics: Optics, rays: Rays, distance: Any) -> tuple[Any, Any, Any]:
    """Altitude, radius and sun cosine of the point at ``distance`` along each ray."""
    h, r = altitude_along(optics.radius, rays.h, rays.mu, distance)
    mu_s = dr.clip(dr.fma(distance, rays.nu, (optics.radius + rays.h) * rays.mu_s) / r, -UPRIGHT, UPRIGHT)
    return h, r, mu_s


def _sunlight_edges(optics: Optics, rays: Rays) -> list[Any]:
    """Distances along the ray where sunlight does not change smoothly; beyond ``stop`` where there is none.

    The perigee of the sunbeam through a point lies at altitude k where h (2R + h) - (r mu_s)^2 = k (2R + k): along a
    ray a quadratic in the distance, the cylinder of radius R + k about the axis through sun and planet. k = 0 is the
    planet's shadow; at the kinks of a profile the column toward the sun has a square-root edge, and at levels.dusk
    light comes suddenly. Only the far side of the planet (mu_s < 0) counts. A disc sets (visible_sun) between the
    surfaces on which r mu_s = -sqrt(r^2 - R^2) +- R times its radius: those of the shadow about axes moved by so much
    along the beam.
    """
    radius, r = optics.radius, optics.radius + rays.h
    a = (1.0 - rays.nu) * (1.0 + rays.nu)
    axial = r * rays.mu_s
    never = 2.0 * rays.stop + 1.0
    edges = []
    disc = [-1.0, 1.0] if optics.atmosphere.sun_angular_radius_deg > 0.0 else []
    sets = [sign * optics.radius * optics.sun_radius for sign in disc]
    own = r * rays.mu
    levels = [*corners(optics.atmosphere), *dusk(optics.atmosphere)]
    for k, moved in [*((parameter(level), None) for level in levels), *((0.0, by) for by in sets)]:
        along = axial if moved is None else axial - moved
        b = own - along * rays.nu
        c = (rays.h - k) * (2.0 * radius + rays.h + k) - along * along
        discriminant = dr.fma(b, b, -a * c)
        q = -b - dr.copysign(dr.safe_sqrt(discriminant), b)
        for distance in (c / q, q / a):
            counts = (
                (discriminant > 0.0)
                & dr.isfinite(distance)
                & (distance > 0.0)
                & (dr.fma(distance, rays.nu, along) < 0.0)
            )
            edges.append(dr.select(counts, distance, never))
    return edges


class Shells:
    """What a march looks up: the altitudes (m) at which it cuts, the largest extinction (1/m) of every channel between
    two of them (a table [shell, channel], or [shell, 1]: of all), and quadrature rules.

    ``largest``: that of all channels, where it is known.
    """

    def __init__(self, optics: Optics, largest: Any = None) -> None:
        self.breaks = optics.altitudes(optics.breaks_m)
        self.last = parameter(len(optics.breaks_m) - 2.0)
        self._densest = _largest_extinctions(optics, self.breaks) if largest is None else floats(largest)
        self._each = largest is None
        self._rules: dict[int, Rule] = {}

    def densest(self, shell: Any, channels: int) -> list[Any]:
        """The largest extinction of every channel in a shell."""
        if self._each:
            return row(self._densest, shell, channels)
        return [dr.gather(types().Float, self._densest, shell)] * channels

    def rule(self, nodes: int) -> Rule:
        """The rule of so many nodes."""
        if nodes not in self._rules:
            self._rules[nodes] = Rule(nodes)
        return self._rules[nodes]


class Rule:
    """A Gauss-Legendre rule as a loop: node g with its weight and the running integral of the densities at FEW
    coarser nodes.

    The node count is a parameter: another one needs no other kernel. ``rows``: those of a rule of as many nodes.
    """

    def __init__(self, nodes: int, rows: Any = None) -> None:
        t = types()
        x, w = gauss_legendre(nodes)
        few_x, few_w = gauss_legendre(FEW)
        self.few_x, self.few_w = few_x.tolist(), few_w.tolist()
        if rows is None:
            rows = floats(np.column_stack([x, w, running_integral(FEW, tuple(x)), np.zeros((nodes, 8 - 2 - FEW))]))
        self.rows = rows
        self.count = dr.opaque(t.UInt, nodes, 1)

    def at(self, g: Any) -> list[Any]:
        """Node x, weight w, and the FEW coefficients of the column up to x."""
        return packet(self.rows, g, 8)[: 2 + FEW]

    def sum(self, coefficients: list[Any], density: list[list[Any]], constituent: int) -> Any:
        """Sum over the few nodes of coefficient times density."""
        total = coefficients[0] * density[0][constituent]
        for coefficient, values in zip(coefficients[1:], density[1:], strict=True):
            total = dr.fma(coefficient, values[constituent], total)
        return total


class Cuts:
    """Where rays are cut into pieces."""

    def __init__(self, optics: Optics, rays: Rays, *, sunlit: bool = True, shells: Shells | None = None) -> None:
        self._optics, self._rays = optics, rays
        shells = shells or Shells(optics)
        self._breaks, self._last, self._shells = shells.breaks, shells.last, shells
        # Rays that meet the ground end before their perigee; of others it is above, whatever its rounding says.
        self._perigee = dr.maximum(perigee_altitude(optics.radius, rays.h, rays.mu), 0.0)
        self._r_mu = (optics.radius + rays.h) * rays.mu
        self._edges = _sunlight_edges(optics, rays) if sunlit else []
        self._closest = optics.radius + self._perigee

    def first_shell(self) -> Any:
        """The shell that each ray starts in."""
        return _first_shell(self._optics, self._rays, self._breaks, self._last)

    def after(self, d: Any, shell: Any, amounts: list[Any]) -> tuple[Any, Any]:
        """Distance to the end of the piece that starts at ``d`` in ``shell``, ``amounts`` of matter (m) away, and the
        shell after it."""
        t, rays, radius, breaks = types(), self._rays, self._optics.radius, self._breaks
        falling = self._r_mu + d < 0.0
        target = dr.gather(type(breaks), breaks, t.UInt(dr.select(falling, shell, shell + 1.0)))
        bottoms_out = falling & (target <= self._perigee)
        crossing = dr.select(
            bottoms_out,
            -self._r_mu,
            dr.select(
                falling,
                distance_down(radius, rays.h, rays.mu, target),
                distance_up(radius, rays.h, rays.mu, target),
            ),
        )
        depths = self._optics.optical_depths(amounts)
        rate = t.Float(1e-30)
        # Fog in one channel is no reason for small steps in the others once it hides everything.
        for depth, densest in zip(depths, self._shells.densest(t.UInt(shell), len(depths)), strict=True):
            rate = dr.select(depth < SPENT_DEPTH, dr.maximum(rate, densest), rate)
        longest = MAX_DEPTH / rate
        # Far out paths of that turn are longer: planets may have thousands of radii of air.
        along = self._r_mu + d
        farther = dr.sqrt(dr.fma(along, along, self._closest * self._closest)) - radius
        limit = d + dr.minimum(longest, MAX_TURN * dr.maximum(radius, farther))
        # The ray ends at the top, whatever the rounding of the crossing says.
        crossing = dr.select(~falling & (shell >= self._last), rays.stop, crossing)
        end = dr.minimum(dr.minimum(dr.maximum(crossing, d), limit), rays.stop)
        for edge in self._edges:
            end = dr.select(edge > d, dr.minimum(end, edge), end)
        passed = (end >= crossing) & ~bottoms_out
        step = dr.select(falling, -1.0, 1.0)
        return end, dr.select(passed, dr.clip(shell + step, 0.0, self._last), shell)


def march(
    optics: Optics,
    columns: SunColumns,
    rays: Rays,
    *,
    nodes: int | None = None,
    single: bool = True,
    source: Source | None = None,
    shells: Shells | None = None,
) -> Light:
    """Radiance scattered toward the origin of each ray, per unit of ``optics.solar``; ground light is not included.

    Single scattering is exact up to the quadrature: Bruneton & Neyret 2008, eq. 9 for order 1, with the planet's
    shadow. ``source``: the field of all orders that scatter once more on this ray; it is asked once per piece, at the
    centroid of the piece's weight, which is exact for a field that is linear there. ``nodes``: per piece, where not as
    many as the atmosphere's profiles need. ``shells``: those of these
    optics, where they cannot be made because a kernel is being traced. Where rays are and where they are cut is
    computed in the precision of the rays and of the optics (Optics.exact).
    """
    t, wide = types(), type(rays.h)
    c_count, k_count = optics.channel_count, len(optics.constituents)
    width = dr.width(rays.h, rays.mu, rays.nu, rays.stop)
    if k_count == 0:
        zero = [dr.zeros(t.Float, width) for _ in range(c_count)]
        return Light(zero, list(zero), [dr.full(t.Float, 1.0, width) for _ in range(c_count)])
    shells = shells or Shells(optics)
    cuts, r_mu = Cuts(optics, rays, sunlit=single, shells=shells), (optics.radius + rays.h) * rays.mu
    rule = shells.rule(nodes or (NODES_AT_STEPS if has_steps(optics.atmosphere) else NODES))
    phases = {k: optics.phase_values(k, rays.nu) for k in optics.scatterers}

    def piece(d: Any, shell: Any, amounts: list[Any], one: list[Any], more: list[Any]) -> tuple[Any, ...]:
        end, shell = cuts.after(d, shell, amounts)
        length = t.Float(end - d)

        density = [
            optics.densities(altitude_along(optics.radius, rays.h, rays.mu, dr.fma(length, x, d))[0])
            for x in rule.few_x
        ]

        def node(g: Any, one: list[Any], weight: list[Any], centroid: Any, total: Any) -> tuple[Any, ...]:
            x, w, *running = rule.at(g)
            h, r, mu_s = point_along(optics, rays, dr.fma(length, x, d))
            here, fraction = optics.densities(h), t.Float(visible_sun(optics, h, r, mu_s))
            inside = [dr.fma(length, rule.sum(running, density, k), amounts[k]) for k in range(k_count)]
            seen = [dr.exp(-depth) * (length * w) for depth in optics.optical_depths(inside)]
            if single:
                sun_depths = optics.optical_depths(columns.toward(t.Float(h), t.Float(mu_s)))
                lit = [s * dr.exp(-depth) * fraction for s, depth in zip(seen, sun_depths, strict=True)]
                for k in optics.scatterers:
                    for c in range(c_count):
                        one[c] = dr.fma(optics.scattering[k][c] * phases[k][c] * here[k], lit[c], one[c])
            if source is not None:
                for n, k in enumerate(optics.scatterers):
                    for c in range(c_count):
                        share = optics.scattering[k][c] * here[k] * seen[c]
                        weight[n * c_count + c] += share
                        total = total + share
                        centroid = dr.fma(share, x, centroid)
            return g + 1, one, weight, centroid, total

        zero = length * 0.0
        weight = [zero + 0.0 for _ in range(len(optics.scatterers) * c_count if source is not None else 0)]
        state = (t.UInt(0), one, weight, zero + 0.0, zero + 0.0)
        _, one, weight, centroid, total = dr.while_loop(state, lambda g, *_: g < rule.count, node, label="nodes")
        if source is not None:
            at = dr.fma(length, dr.select(total > 0.0, centroid / total, 0.5), d)
            h, r, mu_s = point_along(optics, rays, at)
            mu = dr.clip((r_mu + at) / r, -UPRIGHT, UPRIGHT)
            h, mu_s, mu = (t.Float(v) for v in (h, mu_s, mu))
            # Of these cosines: light is linear in sin * cos(azimuth) beside the zenith, however they are rounded.
            cos_phi = t.Float(relative_azimuth(wide(mu), wide(mu_s), rays.nu))
            toward = source.scattered(h, mu_s, mu, cos_phi, total > 0.0)
            for n in range(len(optics.scatterers)):
                for c in range(c_count):
                    more[c] = dr.fma(weight[n * c_count + c], toward[n][c], more[c])

        for k in range(k_count):
            amounts[k] = dr.fma(length, rule.sum(rule.few_w, density, k), amounts[k])
        return end, shell, amounts, one, more

    state = (
        dr.zeros(type(rays.h), width),
        cuts.first_shell(),
        [dr.zeros(t.Float, width) for _ in range(k_count)],
        [dr.zeros(t.Float, width) for _ in range(c_count)],
        [dr.zeros(t.Float, width) for _ in range(c_count)],
    )
    _, _, amounts, one, more = dr.while_loop(
        state, lambda d, _, amounts, *__: unfinished(optics, rays, d, amounts), piece, label="march"
    )
    return Light(
        [radiance * solar for radiance, solar in zip(one, optics.solar, strict=True)],
        more,
        [dr.exp(-depth) for depth in optics.optical_depths(amounts)],
    )


def unfinished(optics: Optics, rays: Rays, d: Any, amounts: list[Any]) -> Any:
    """Whether anything is to be seen beyond the distance ``d``, ``amounts`` of matter (m) away."""
    depths = optics.optical_depths(amounts)
    thinnest = depths[0]
    for depth in depths[1:]:
        thinnest = dr.minimum(thinnest, depth)
    return (d < rays.stop) & (thinnest < SPENT_DEPTH)


def relative_azimuth(mu: Any, mu_s: Any, nu: Any) -> Any:
    """cos of the azimuth between view and sun at a point: (nu - mu mu_s) / (sin sin_s); 1 where either is vertical."""
    sines = safe_sine(mu) * safe_sine(mu_s)
    apart = sines > 0.0
    return dr.select(apart, dr.clip((nu - mu * mu_s) / dr.select(apart, sines, 1.0), -1.0, 1.0), 1.0)


def _first_shell(optics: Optics, rays: Rays, breaks: Any, last: Any) -> Any:
    """Index (as a Float) of the shell [b_j, b_{j+1}] that the ray enters first: the lower one where it starts on a
    break and falls."""
    t = types()
    count = len(optics.breaks_m)
    falling = rays.mu < 0.0

    def below(i: Any) -> Any:
        level = dr.gather(type(breaks), breaks, i)
        return (level < rays.h) | (~falling & (level <= rays.h))

    # dr.binary_search, which compiles the number of breaks.
    index, end = t.UInt(0), t.UInt(last) + 1
    for _ in range(count.bit_length()):
        middle = (index + end) >> 1
        under = below(middle)
        index = dr.select(under, dr.minimum(middle + 1, end), index)
        end = dr.select(under, end, middle)
    return dr.clip(t.Float(index) - 1.0, 0.0, last)


def _largest_extinctions(optics: Optics, breaks: Any) -> Any:
    """Largest extinction coefficient (1/m) of each shell and channel: profiles are monotone between breaks, so it is at
    one of a shell's ends."""
    t = types()
    lower = dr.arange(t.UInt, len(optics.breaks_m) - 1)
    # A step in a tabulated profile sits on a break, and the density there is the upper side's; in single precision a
    # layer far up may be all on one, whose density the empty shell above it has not.
    sides = (1.0 + 1e-6 if isinstance(breaks, t.Float) else 1.0, 1.0 - 1e-6)
    ends = (dr.gather(type(breaks), breaks, i) for i in (lower, lower + 1))
    low, high = (
        optics.extinctions(optics.densities(h * side)) for h, side in zip(ends, sides, strict=True)
    )
    return table_of([dr.maximum(a, b) for a, b in zip(low, high, strict=True)], lower)
