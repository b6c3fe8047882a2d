"""Slopes of look-ups in a solved field by altitude and sun, for fine derivatives.

A look-up is linear between the levels and suns of its table: close enough for the light, while its slope jumps at each
of them, by some 1e-3 of the derivatives by the sun's zenith angle and the altitude. Those here are slopes of the cubic
through four of them.
"""

from __future__ import annotations

from typing import Any

import drjit as dr

from .backend import types
from .grid import Grid
from .refinement import Reference


def steep_nodes(
    grid: Grid, reference: Reference, guide: Any, h: Any, mu_s: Any, active: Any
) -> tuple[tuple[Any, Any], list[tuple[list[Any], list[list[Any]]]]]:
    """How far the coordinates of level and refined sun at altitude ``h`` and sun cosine ``mu_s`` have moved, 0 with
    their derivatives; and for either the nodes [8] and weights [8][channel] whose sum is the slope by it. ``guide``:
    the reference at the levels."""
    k, at_k = grid.locate_altitude(h)
    x = grid.sun_position(mu_s)
    s, at_s = grid.locate_source(x)
    moved = at_k - dr.detach(at_k), at_s - dr.detach(at_s)
    with dr.suspend_grad():
        x, at_k, at_s = (dr.detach(v) for v in (x, at_k, at_s))
        levels, by_level = _cubic_slopes(k, at_k, grid.counts[0])
        suns, by_sun = _cubic_slopes(s, at_s, grid.counts[1])
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
    return moved, parts


def _cubic_slopes(index: Any, fraction: Any, count: Any) -> tuple[list[Any], list[Any]]:
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
