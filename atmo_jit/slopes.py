"""Slopes of look-ups in a solved field by altitude and sun, for fine derivatives.

A look-up is linear between the levels and suns of its table: close enough for the light, while its slope jumps at each
of them, by some 1e-3 of the derivatives by the sun's zenith angle and the altitude. Those here are slopes of the cubic
through four of them.
"""

from __future__ import annotations

from typing import Any

import drjit as dr

from .backend import packet, types
from .grid import Grid, split
from .refinement import FINE, Reference


def steep_nodes(
    grid: Grid, reference: Reference, guide: Any, h: Any, mu_s: Any, active: Any
) -> tuple[tuple[Any, Any], list[tuple[list[Any], list[list[Any]]]]]:
    """How far the coordinates of level and refined sun at altitude ``h`` and sun cosine ``mu_s`` have moved, 0 with
    their derivatives; and for either nodes and their weights [channel] whose sum is the slope by it. ``guide``:
    the reference at the levels."""
    k, at_k = grid.locate_altitude(h)
    x = grid.sun_position(mu_s)
    s, at_s = grid.locate_source(x)
    moved = at_k - dr.detach(at_k), at_s - dr.detach(at_s)
    with dr.suspend_grad():
        x, at_k, at_s = (dr.detach(v) for v in (x, at_k, at_s))
        levels, by_level = cubic_slopes(k, at_k, grid.counts[0])
        suns, by_sun = cubic_slopes(s, at_s, grid.counts[1])
        parts = []
        for here, share, there, portion in (
            (levels, by_level, [s, s + 1], [1.0 - at_s, at_s]),
            ([k, k + 1], [1.0 - at_k, at_k], suns, by_sun),
        ):
            scales = [reference.at(level, x, active, guide) for level in here]
            nodes = [grid.node(level, sun) for level in here for sun in there]
            weights = [
                [a * b * part for part in scale] for a, scale in zip(share, scales, strict=True) for b in portion
            ]
            parts.append((nodes, weights))
        # The reference is no line between its own suns, and moves too.
        turns = [_reference_slope(reference, guide, level, x, active) for level in (k, k + 1)]
        nodes += [grid.node(level, sun) for level in (k, k + 1) for sun in (s, s + 1)]
        weights += [
            [a * b * (part / grid.sun_refine) for part in turn]
            for a, turn in zip([1.0 - at_k, at_k], turns, strict=True)
            for b in (1.0 - at_s, at_s)
        ]
    return moved, parts


def _reference_slope(reference: Reference, guide: Any, level: Any, x: Any, active: Any) -> list[Any]:
    """Slope of the reference by the sun coordinate ``x``, per channel."""
    count = dr.opaque(types().UInt, FINE * (reference.grid.shape[1] - 1) + 1, 1)
    s, f = split(x * float(FINE), count)
    suns, by_sun = cubic_slopes(s, f, count)
    held = [packet(guide, level * count + sun, 4, active)[: reference.channels] for sun in suns]
    return [float(FINE) * sum(w * v for w, v in zip(by_sun, part, strict=True)) for part in zip(*held, strict=True)]


def cubic_slopes(index: Any, fraction: Any, count: Any) -> tuple[list[Any], list[Any]]:
    """Four of ``count`` nodes about a fraction of the interval after node ``index``, and the slopes there of their
    Lagrange polynomials."""
    t = types()
    first = dr.minimum(dr.maximum(index, 1) - 1, count - 4)
    p = t.Float(index - first) + fraction
    square = 3.0 * p * p
    return [first + i for i in range(4)], [
        (dr.fma(12.0, p, -11.0) - square) * (1.0 / 6.0),
        (dr.fma(-10.0, p, 6.0) + square) * 0.5,
        (dr.fma(8.0, p, -3.0) - square) * 0.5,
        (dr.fma(-6.0, p, 2.0) + square) * (1.0 / 6.0),
    ]
