"""The light of march.py in steps that derivatives pass through, forwards and backwards.

A march is a loop whose every turn needs the one before, and nothing can be propagated backwards through such a loop
without its whole history. Here rays are cut first, without derivatives: where a ray is cut does not matter to its
light. Then all pieces are integrated side by side, and what remains are sums over the pieces of a ray.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from ._trees import flat, like
from .backend import evaluated, parameter, sum_loop, together, types
from .column import SunColumns
from .field import Field
from .geometry import UPRIGHT, altitude_along
from .levels import corners
from .march import (
    NODES,
    Cuts,
    Light,
    Rays,
    Rule,
    point_along,
    relative_azimuth,
    unfinished,
    visible_sun,
)
from .optics import Optics
from .ray_sums import RaySums

LEVEL = 0.02  # cosine of a zenith angle: a ray nearer to the horizontal leaves a level too slowly to tell where
TWICE = (0.5 - 12.0**-0.5, 0.5 + 12.0**-0.5)  # of a piece: Gauss points, where fine solves ask for the field
# Of a ray's first piece: beside the observer the derivative by its altitude asks for more than two places.
FIRST_PART = 0.15
WHOLE = 0.999  # of a piece is all of it
# Share of light that a piece scatters: below it the derivative of its centroid, which has the square of that below the
# line, leaves single precision.
NOTHING = 1e-18


@dataclass
class Pieces:
    """Pieces of rays, ray after ray: ``first`` [N + 1]: where those of each ray start. Per piece: ``ray``, and where
    those of this ray ``begin``; ``start`` and ``length`` (m); ``closes``: it reaches the end of the ray. After the last
    come some of no length that no ray has. ``rule``: rows of march.Rule by which all are integrated."""

    first: Any
    ray: Any
    begin: Any
    start: Any
    length: Any
    closes: Any
    rule: Any

    @property
    def count(self) -> int:
        """How many there are, of all rays."""
        return dr.width(self.start)

    def taken(self, begin: Any, rays: int, room: int) -> Pieces:
        """Those of so many ``rays`` from number ``begin`` on, with ``room`` for as many pieces; of rays beyond the last
        there are none."""
        t = types()
        first = dr.minimum(begin + dr.arange(t.UInt, rays + 1), dr.opaque(t.UInt, dr.width(self.first) - 1, 1))
        first, base = dr.gather(t.UInt, self.first, first), dr.gather(t.UInt, self.first, begin)
        lane = dr.arange(t.UInt, room)
        first = evaluated(first - base)
        place, there = base + lane, lane < dr.gather(t.UInt, first, dr.opaque(t.UInt, rays, 1))
        start, length = (dr.gather(t.Float, values, place, there) for values in (self.start, self.length))
        ray = dr.select(there, dr.gather(t.UInt, self.ray, place, there) - begin, 0)
        own = dr.select(there, dr.gather(t.UInt, self.begin, place, there) - base, lane)
        return Pieces(first, ray, own, start, length, dr.gather(t.Bool, self.closes, place, there), self.rule)

    @classmethod
    def of(cls, optics: Optics, rays: Rays, *, fine: bool = False) -> Pieces | None:
        """The pieces that march.march would integrate; None: no ray meets air. ``fine``: of the first FIRST_PART is a
        piece of its own."""
        t, kinds = types(), len(optics.constituents)
        if not kinds:
            return None
        with dr.suspend_grad():
            cuts, rule, part = Cuts(optics, rays), Rule(1), t.Bool(fine)
            width = dr.width(rays.h, rays.mu, rays.nu, rays.stop)

            def cut(store: Any) -> Any:
                def piece(d: Any, shell: Any, amounts: list[Any], number: Any) -> tuple[Any, ...]:
                    end, after = cuts.after(d, shell, amounts)
                    # Its second part ends where all of it would.
                    whole = dr.select(number == 0, FIRST_PART * end, d * (1.0 / FIRST_PART))
                    parted = part & ((number == 0) | ((number == 1) & (whole < WHOLE * end)))
                    end, shell = dr.select(parted, whole, end), dr.select(parted, shell, after)
                    if store is not None:
                        store(number, d, end)
                    density = [
                        optics.densities(altitude_along(optics.radius, rays.h, rays.mu, dr.fma(end - d, x, d))[0])
                        for x in rule.few_x
                    ]
                    more = [dr.fma(end - d, rule.sum(rule.few_w, density, k), amounts[k]) for k in range(kinds)]
                    return end, shell, more, number + 1

                zero = dr.zeros(t.Float, width)
                amounts = [dr.zeros(t.Float, width) for _ in range(kinds)]
                state = (zero, cuts.first_shell(), amounts, dr.zeros(t.UInt, width))
                return dr.while_loop(
                    state, lambda d, _, amounts, __: unfinished(optics, rays, d, amounts), piece, label="cut"
                )[-1]

            counts = cut(None)
            ends = dr.cumsum(counts)
            dr.eval(ends)
            total = int(ends[width - 1])
            if total == 0:
                return None
            total = room_for(total)
            ray, start, length = dr.zeros(t.UInt, total), dr.zeros(t.Float, total), dr.zeros(t.Float, total)
            closes, before = dr.zeros(t.UInt, total), ends - counts
            lane, begin = dr.arange(t.UInt, width), dr.arange(t.UInt, total)

            def store(number: Any, d: Any, end: Any) -> None:
                place = before + number
                dr.scatter(ray, lane, place)
                dr.scatter(begin, before, place)
                dr.scatter(start, d, place)
                dr.scatter(length, end - d, place)
                dr.scatter(closes, dr.select(end >= rays.stop, t.UInt(1), t.UInt(0)), place)

            dr.eval(cut(store), ray, begin, start, length, closes)
            first = dr.zeros(t.UInt, width + 1)
            dr.scatter(first, ends, lane + 1)
            dr.eval(first)
            closes = closes > 0
            dr.eval(closes)
        return cls(first, ray, begin, start, length, closes, Rule(NODES).rows)


def light_along(
    optics: Optics,
    columns: SunColumns,
    rays: Rays,
    pieces: Pieces | None,
    *,
    source: Field | None = None,
) -> Light:
    """What march.march returns, differentiable with respect to everything that enters."""
    t, channels, kinds = types(), optics.channel_count, len(optics.constituents)
    width = dr.width(rays.h, rays.mu, rays.nu, rays.stop)
    if pieces is None:
        zero = [dr.zeros(t.Float, width) for _ in range(channels)]
        return Light(zero, list(zero), [dr.full(t.Float, 1.0, width) for _ in range(channels)])
    rule = Rule(NODES, pieces.rule)
    full = dr.zeros(t.Float, width)
    per_ray, optics = optics.spread(width), optics.spread(pieces.count)
    along = RaySums(pieces.first, pieces.ray, pieces.begin)
    members = evaluated([v + full for v in (rays.h, rays.mu, rays.mu_s, rays.nu, rays.stop)])
    h, mu, mu_s, nu, stop = along.at_pieces(members)
    here, start = Rays(h, mu, mu_s, nu, stop, pieces.closes), pieces.start
    length = dr.select(pieces.closes, stop - start, pieces.length)
    if dr.grad_enabled(h, mu):
        first, last = (_at_its_level(optics, here, distance) for distance in (start, start + length))
        length = dr.select(pieces.closes, length - first, length + last - first)
        start = start + first
    density = [
        optics.densities(altitude_along(optics.radius, h, mu, dr.fma(length, x, start))[0]) for x in rule.few_x
    ]
    own = evaluated([length * rule.sum(rule.few_w, density, k) for k in range(kinds)])
    amounts = along.before(own)
    phases = {k: optics.phase_values(k, nu) for k in optics.scatterers}
    scatterers = optics.scatterers
    twice = source is not None and source.grid.resolution.twice
    each = channels * len(scatterers)

    def node(g: Any, one: list[Any], weight: list[Any], centroid: Any, total: Any, given: Any) -> tuple[Any, ...]:
        values, here, phases, density, amounts, length, start = given
        local, here = optics.with_values(values), Rays(**here)
        x, w, *running = rule.at(g)
        altitude, r, sun = point_along(local, here, dr.fma(length, x, start))
        inside = [dr.fma(length, rule.sum(running, density, k), amounts[k]) for k in range(kinds)]
        seen = [dr.exp(-depth) * (length * w) for depth in local.optical_depths(inside)]
        there = local.densities(altitude)
        sun_depths = local.optical_depths(columns.toward(altitude, sun, optics=local))
        fraction = visible_sun(local, altitude, r, sun)
        lit = [s * dr.exp(-depth) * fraction for s, depth in zip(seen, sun_depths, strict=True)]
        one, weight = list(one), list(weight)
        for n, k in enumerate(scatterers):
            for c in range(channels):
                coefficient = local.scattering[k][c] * there[k]
                one[c] = dr.fma(coefficient * phases[k][c], lit[c], one[c])
                if source is not None:
                    share, place = coefficient * seen[c], n * channels + c
                    if twice:
                        later = share * ((x - TWICE[0]) / (TWICE[1] - TWICE[0]))
                        weight[each + place] = weight[each + place] + later
                    weight[place] = weight[place] + share
                    total, centroid = total + share, dr.fma(share, x, centroid)
        return g + 1, one, weight, centroid, total

    zeros = [dr.zeros(t.Float, pieces.count) for _ in range(channels + each * (1 + twice) + 2)]
    state = (t.UInt(0), zeros[:channels], zeros[channels:-2], zeros[-2], zeros[-1])
    given = [optics.used, vars(here), phases, density, amounts, length, start]
    given = like(given, together(flat(given)))  # by all of them in one kernel: each would run the loop once more
    _, one, weight, centroid, total = sum_loop(state, lambda g, *_: g < rule.count, node, given, "nodes apart")
    more = [dr.zeros(t.Float, pieces.count) for _ in range(channels)]
    if source is not None:
        # What is evaluated here is not run again by the kernels of derivatives.
        *held, centroid, total = evaluated([*one, *weight, centroid, total])
        one, weight = held[:channels], held[channels:]
        scatters = total > NOTHING
        if twice:
            # Not less than nothing at either place, where a piece's light is all at one end.
            later = [dr.clip(second, 0.0, whole) for second, whole in zip(weight[each:], weight[:each], strict=True)]
            first = [whole - second for second, whole in zip(later, weight[:each], strict=True)]
            asked = [(dr.fma(length, x, start), w) for x, w in zip(TWICE, (first, later), strict=True)]
        else:
            centre = dr.select(scatters, centroid / dr.select(scatters, total, 1.0), 0.5)
            asked = [(dr.fma(length, centre, start), weight)]
        for at, weights in asked:
            toward = _asked(optics, source, here, at, scatters)
            for place, (w, v) in enumerate(zip(weights, toward, strict=True)):
                more[place % channels] = dr.fma(w, dr.maximum(v, 0.0), more[place % channels])
    sums = along.totals([*one, *more, *own])
    return Light(
        [radiance * solar for radiance, solar in zip(sums[:channels], per_ray.solar, strict=True)],
        sums[channels : 2 * channels],
        [dr.exp(-depth) for depth in per_ray.optical_depths(sums[2 * channels :])],
    )


def _asked(optics: Optics, source: Field, rays: Rays, distance: Any, active: Any) -> list[Any]:
    """The source at a distance along each ray, evaluated: [scatterer x channel]."""
    altitude, r, sun = point_along(optics, rays, distance)
    mu = dr.clip(dr.fma(optics.radius + rays.h, rays.mu, distance) / r, -UPRIGHT, UPRIGHT)
    values = source.unclipped(altitude, sun, mu, relative_azimuth(mu, sun, rays.nu), active)
    return evaluated([value for of_kind in values for value in of_kind])


def _at_its_level(optics: Optics, rays: Rays, distance: Any) -> Any:
    """0, with the derivative of a ``distance`` at which a ray has one altitude, whatever its direction; from a higher
    observer that altitude is higher too, the less so the farther it is, and not at corners of profiles.

    The source is asked a few times for every piece, and exact where it is linear over it: what that leaves out changes
    little from ray to ray as long as rays are cut at the same altitudes, and between observers as long as all pieces
    move, and none grows.
    """
    h, mu = dr.detach(rays.h), dr.detach(rays.mu)
    r, d = optics.radius + h, dr.detach(distance)
    low, high = dr.zeros(type(h), dr.width(h)), optics.thickness + 0.0 * h
    for corner in (parameter(level) for level in corners(optics.atmosphere)[1:-1]):
        low = dr.select(corner <= h, dr.maximum(corner, low), low)
        high = dr.select(corner > h, dr.minimum(corner, high), high)
    there = altitude_along(optics.radius, h, mu, d)[0]
    end = dr.select(there > h, high, low)
    follows = dr.clip((end - there) / dr.select(end != h, end - h, 1.0), 0.0, 1.0)
    rises = dr.fma(r, mu, d)  # r there, times the cosine of the zenith angle
    steep = (dr.abs(rises) > LEVEL * r) & (d > 0.0)
    higher = dr.fma(mu, d, r) - follows * (r + there - h)
    moves = r * d * (rays.mu - mu) + higher * (rays.h - h)
    return dr.select(steep, -moves / dr.select(steep, rises, 1.0), 0.0)


def room_for(count: int) -> int:
    """Pieces for which there is room: sizes that seldom change between atmospheres, so that recordings serve."""
    step = 1 << max(count.bit_length() - 4, 4)
    return -(-count // step) * step
