"""Weights of the straight paths between the nodes: density, extinction and hat functions, integrated once per
atmosphere."""

from __future__ import annotations

from typing import Any

import drjit as dr

from .backend import types
from .geometry import altitude_along
from .march import FEW, MAX_DEPTH, SPENT_DEPTH
from .optics import Optics
from .paths import Paths
from .quadrature import gauss_legendre, running_integral


class PathWeights:
    """What every visit of a path contributes to the light at its origin, for one atmosphere; no sun enters.

    Between two stations the field is linear in the altitude coordinate u; each station gets its hat function's share
    of the integral of density times transmittance over both pieces beside it.

    ``weights[n * C + c]`` [visits]: scattering by scatterer n in channel c; ``reflected[c]`` [visits]: transmittance
    times albedo / pi at the visit where a path ends on the ground, else 0.
    """

    def __init__(self, optics: Optics, paths: Paths) -> None:
        t, p, d = types(), paths, paths.device
        kinds, channels = len(optics.constituents), optics.channel_count
        node = dr.arange(t.UInt, p.count)
        ray, distance, u = d.ray, d.distance, d.u
        h, mu = dr.gather(t.Float, d.h, ray), dr.gather(t.Float, d.mu_start, ray)
        nxt = dr.minimum(node + 1, dr.opaque(t.UInt, p.count - 1, 1))
        start, stop = distance, dr.select(d.follows == 1, dr.gather(t.Float, distance, nxt), distance)
        u_start, u_stop = u, dr.gather(t.Float, u, nxt)
        x, w = (a.tolist() for a in gauss_legendre(FEW))
        running = running_integral(FEW, tuple(x)).tolist()

        own = [dr.zeros(t.Float, p.count) for _ in range(kinds)]
        for node_x, weight in zip(x, w, strict=True):
            there, _ = altitude_along(optics.radius, h, mu, dr.fma(stop - start, node_x, start))
            for k, density in enumerate(optics.densities(there)):
                own[k] = dr.fma((stop - start) * weight, density, own[k])
        first = dr.gather(t.UInt, d.first, ray)
        dr.eval(own)

        def add_piece(i: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
            return i + 1, [s + dr.gather(t.Float, o, i) for s, o in zip(sums, own, strict=True)]

        zeros = [dr.zeros(t.Float, p.count) for _ in range(kinds)]
        _, before = dr.while_loop((first + 0, zeros), lambda i, _: i < node, add_piece, label="columns")

        def advance(at: Any, amounts: list[Any], near: list[Any], far: list[Any]) -> tuple[Any, ...]:
            here, _ = altitude_along(optics.radius, h, mu, at)
            there, _ = altitude_along(optics.radius, h, mu, stop)
            densest = dr.maximum(
                optics.largest_extinction(optics.densities(here)), optics.largest_extinction(optics.densities(there))
            )
            length = dr.minimum(stop - at, MAX_DEPTH / dr.maximum(densest, 1e-30))
            points = [altitude_along(optics.radius, h, mu, dr.fma(length, node_x, at))[0] for node_x in x]
            density = [optics.densities(point) for point in points]
            for g in range(FEW):
                inside = [
                    dr.fma(length, sum(running[g][i] * density[i][k] for i in range(FEW)), amounts[k])
                    for k in range(kinds)
                ]
                seen = [dr.exp(-depth) * (length * w[g]) for depth in optics.optical_depths(inside)]
                k_index, fraction = paths.locate(points[g])
                position = t.Float(k_index) + fraction
                hat = dr.clip((position - u_start) / (u_stop - u_start), 0.0, 1.0)
                hat = dr.select(u_stop == u_start, 0.5, hat)
                for n, k in enumerate(optics.scatterers):
                    for c in range(channels):
                        share = optics.scattering[k][c] * density[g][k] * seen[c]
                        i = n * channels + c
                        near[i] = dr.fma(share, 1.0 - hat, near[i])
                        far[i] = dr.fma(share, hat, far[i])
            for k in range(kinds):
                amounts[k] = dr.fma(length, sum(w[g] * density[g][k] for g in range(FEW)), amounts[k])
            done = length >= stop - at
            return dr.select(done, stop, at + length), amounts, near, far

        def unfinished(at: Any, amounts: list[Any], near: list[Any], far: list[Any]) -> Any:
            depths = optics.optical_depths(amounts)
            thinnest = depths[0]
            for depth in depths[1:]:
                thinnest = dr.minimum(thinnest, depth)
            return (at < stop) & (thinnest < SPENT_DEPTH)

        many = len(optics.scatterers) * channels
        state = (
            start + 0.0,
            [b + 0.0 for b in before],
            *([dr.zeros(t.Float, p.count) for _ in range(many)] for _ in range(2)),
        )
        _, _, near, far = dr.while_loop(state, unfinished, advance, label="weights")
        dr.eval(near, far)
        has_previous = node > first
        previous = dr.maximum(node, 1) - 1
        weights = [n + dr.gather(t.Float, f, previous, has_previous) for n, f in zip(near, far, strict=True)]
        self.weights = [dr.gather(t.Float, weight, d.station) * d.factor for weight in weights]
        self.reflected = [
            dr.gather(t.Float, dr.exp(-depth) * d.on_ground * albedo * dr.inv_pi, d.station)
            for depth, albedo in zip(optics.optical_depths(before), optics.albedo, strict=True)
        ]
        dr.eval(self.weights, self.reflected)
