"""Weights of the straight paths between the nodes: density, extinction and hat functions, integrated once per
atmosphere."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from .backend import row, sum_loop, table, table_of, tables_of, types
from .optics import Optics
from .paths import Paths, Points, points_along
from .profile_tangents import following_profiles
from .quadrature import gauss_legendre, running_integral


@dataclass
class Columns:
    """Matter along paths: no coefficient and no wavelength enters, so it serves every atmosphere with these profiles.

    ``density`` (relative) and ``column`` (m, from the path's start) at the points, tables [points, constituents];
    ``whole``: column of the whole path [rays, constituents].
    """

    density: Any
    column: Any
    whole: Any


def columns_along(optics: Optics, points: Points) -> Columns:
    """Densities and columns at the points of the paths, kept with them."""
    if not optics.constituents or not len(points.h):
        empty = dr.zeros(types().Float, 8)
        return Columns(empty, empty, empty)
    made = following_profiles(
        optics,
        points.paths,
        ("columns", points.nodes),
        [range(len(optics.constituents))] * 3,
        lambda other: list(vars(_traced_columns(other, points)).values()),
        lambda: list(vars(_columns(optics, points)).values()),
    )
    return Columns(*made)


def _columns(optics: Optics, points: Points) -> Columns:
    """In NumPy: it is done once, and compiling kernels for it would take longer than all of it."""
    kinds, nodes = len(optics.constituents), points.nodes
    density = np.stack([np.asarray(c.profile.density(points.h)) for c in optics.constituents], axis=-1)
    in_part = density.reshape(-1, nodes, kinds)
    own = np.einsum("pg,pgk->pk", points.weight.reshape(-1, nodes), in_part)
    before = np.concatenate([np.zeros((1, kinds)), np.cumsum(own, axis=0)])
    per_ray = points.first_part[points.paths.first]
    inside = np.einsum("gi,pik->pgk", running_integral(nodes, tuple(gauss_legendre(nodes)[0].tolist())), in_part)
    passed = (before[:-1] - before[per_ray[points.part_ray]])[:, None] + points.length.reshape(-1, nodes, 1) * inside
    return Columns(table(density), table(passed.reshape(-1, kinds)), table(before[per_ray[1:]] - before[per_ray[:-1]]))


def _traced_columns(optics: Optics, points: Points) -> Columns:
    """The same with derivatives by the profiles' parameters."""
    t, d, nodes = types(), points.device, points.nodes
    kinds = len(optics.constituents)
    count = len(points.h)
    lane = dr.arange(t.UInt, count)
    density = table_of(optics.densities(d.h), lane)
    part = dr.arange(t.UInt, count // nodes)
    own = [dr.zeros(t.Float, count // nodes) for _ in range(kinds)]
    for g in range(nodes):
        weight = dr.gather(t.Float, d.weight, part * nodes + g)
        own = [dr.fma(weight, v, s) for v, s in zip(row(density, part * nodes + g, kinds), own, strict=True)]
    own = table_of(own, part)

    def before(start: Any, stop: Any) -> list[Any]:
        def add(i: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
            return i + 1, [s + v for s, v in zip(sums, row(own, i, kinds), strict=True)]

        zero = [dr.zeros(t.Float, dr.width(stop)) for _ in range(kinds)]
        return dr.while_loop((start, zero), lambda i, _: i < stop, add, max_iterations=-1, label="columns")[1]

    part = lane // nodes
    passed = before(dr.gather(t.UInt, d.first, part), part)
    running = row(d.running, lane % nodes, nodes)
    for g, inside in enumerate(running):
        inside = inside * d.length
        passed = [dr.fma(inside, v, s) for v, s in zip(row(density, part * nodes + g, kinds), passed, strict=True)]
    ray = dr.arange(t.UInt, len(points.paths.h))
    start, stop = (dr.gather(t.UInt, d.ray_parts, 2 * ray + i) for i in (0, 1))
    return Columns(density, table_of(passed, lane), table_of(before(start, stop), ray))


class PathWeights:
    """What every visit of a path contributes to the light at its origin, for one atmosphere; no sun enters.

    Between two stations light is interpolated (paths.Points.shares); each station gets its share of the integral of
    density times transmittance over the pieces about it.

    ``scattered``: table [visits, scatterers x channels], scattering by each; ``reflected``: table [visits, channels],
    transmittance times albedo / pi at the visit where a path ends on the ground, else 0.
    """

    def __init__(self, optics: Optics, paths: Paths, nodes: int) -> None:
        t = types()
        points = points_along(paths, nodes)
        at, device, d = columns_along(optics, points), paths.device, points.device
        kinds, channels = len(optics.constituents), optics.channel_count
        visit = dr.arange(t.UInt, len(paths.station))
        sharing = points.shares.shape[1]
        optics = optics.spread(dr.width(visit))
        bounds = row(d.bounds, device.station, sharing + 1)

        def add(i: Any, sums: list[Any], values: dict[str, Any]) -> tuple[Any, list[Any]]:
            here = optics.with_values(values)
            # The farther along the path a point lies, the farther behind it this station is.
            place = t.UInt(sharing - 1)
            for bound in bounds[1:-1]:
                place = dr.select(i >= bound, place - 1, place)
            weight = dr.gather(t.Float, d.shares, i * sharing + place)
            density, column = row(at.density, i, kinds), row(at.column, i, kinds)
            seen = [dr.exp(-depth) * weight for depth in here.optical_depths(column)]
            return i + 1, [
                dr.fma(here.scattering[k][c] * density[k], seen[c], sums[n * channels + c])
                for n, k in enumerate(optics.scatterers)
                for c in range(channels)
            ]

        sums = [dr.zeros(t.Float, dr.width(visit)) for _ in range(len(optics.scatterers) * channels)]
        if sums:
            state, end = (bounds[0] + 0, sums), bounds[-1]
            _, sums = sum_loop(state, lambda i, _: i < end, add, optics.used, "weights")
        depths = [0.0] * channels
        if kinds:
            depths = optics.optical_depths(row(at.whole, device.ray, kinds))
        reflected = [
            dr.exp(-t.Float(depth)) * device.on_ground * albedo * dr.inv_pi
            for depth, albedo in zip(depths, optics.albedo, strict=True)
        ]
        scattered = [s * device.factor for s in sums] or [t.Float(0.0)]
        self.scattered, self.reflected = tables_of([scattered, reflected], visit)
