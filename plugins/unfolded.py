"""Directions at the nodes of the square that an octahedron unfolds to, and values that are known there."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

SIDE = 23  # nodes along a side of the square
COUNT = SIDE * SIDE
# Of the second difference, that nodes take from the values of a function: what linear interpolation makes too flat. A
# parabola is on the average too high by 1/12 of it between nodes; a forward peak that is hardly wider than a few of
# them needs somewhat more.
SHARPER = 0.125


def directions() -> np.ndarray:
    """Unit vectors [COUNT, 3]."""
    y, x = (v.ravel() for v in np.meshgrid(*[np.linspace(-1.0, 1.0, SIDE)] * 2, indexing="ij"))
    z = 1.0 - np.abs(x) - np.abs(y)
    folded = np.maximum(-z, 0.0)
    d = np.stack([x - np.copysign(folded, x), y - np.copysign(folded, y), z], axis=-1)
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def node(d: Any, sampler: Any, active: Any) -> Any:
    """One of the four nodes about a direction, the nearer one more often, so that its mean interpolates."""
    inverse = 1.0 / (dr.abs(d.x) + dr.abs(d.y) + dr.abs(d.z))
    x, y = d.x * inverse, d.y * inverse
    down = d.z < 0.0
    x, y = (
        dr.select(down, dr.copysign(1.0 - dr.abs(y), x), x),
        dr.select(down, dr.copysign(1.0 - dr.abs(x), y), y),
    )
    i, j = (dr.minimum(mi.UInt32(dr.fma(0.5 * v + 0.5, SIDE - 1.0, sampler.next_1d(active))), SIDE - 1) for v in (x, y))
    return j * SIDE + i


def sharpened(values: np.ndarray) -> np.ndarray:
    """Values [..., COUNT] of a function at the nodes, as those between which linear interpolation is right on the
    average."""
    at = values.reshape(-1, SIDE, SIDE)
    padded = np.empty((len(at), SIDE + 2, SIDE + 2), dtype=at.dtype)
    padded[:, 1:-1, 1:-1] = at
    # Beyond an edge the square goes on at the same edge, turned round.
    padded[:, 1:-1, -1], padded[:, 1:-1, 0] = at[:, ::-1, -2], at[:, ::-1, 1]
    padded[:, -1, 1:-1], padded[:, 0, 1:-1] = at[:, -2, ::-1], at[:, 1, ::-1]
    around = padded[:, 1:-1, 2:] + padded[:, 1:-1, :-2] + padded[:, 2:, 1:-1] + padded[:, :-2, 1:-1]
    return ((1.0 + 4.0 * SHARPER) * at - SHARPER * around).reshape(values.shape)
