"""Derivatives backwards through the gather's sums (gather.py), as gathers in the other direction.

Dr.Jit turns what a kernel gathers around, into additions to memory that several lanes share, for which every thread
needs a copy of the table. Who reads an entry is geometry, known beforehand: so here every entry collects what its
readers have for it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np

from .backend import floats, packet, row, row_size, stored, table_of, types, uints
from .paths import Paths
from .projection import add_harmonics

SUNS, ROWS = 5, 2  # that a lane of by_moments takes


def multilinear(function: Callable[..., Any], transposed: Callable[..., list[Any]], *inputs: Any) -> Any:
    """``function`` of Floats in each of which it is linear. ``transposed``: the derivative by one of them, given
    that by the result, the number of the input, and the inputs."""
    if not dr.grad_enabled(inputs):
        return function(*inputs)
    wanted = [dr.grad_enabled(value) for value in inputs]
    return dr.custom(_Multilinear, list(inputs), function, transposed, wanted)


class _Multilinear(dr.CustomOp):
    def eval(self, inputs: list[Any], function: Any, transposed: Any, wanted: list[bool]) -> Any:
        self.inputs, self.function, self.transposed, self.wanted = list(inputs), function, transposed, wanted
        return function(*inputs)

    def forward(self) -> None:
        steps, total = self.grad_in("inputs"), 0.0
        for i in (i for i, wanted in enumerate(self.wanted) if wanted):
            dr.eval(steps[i])
            total = total + self.function(*self.inputs[:i], steps[i], *self.inputs[i + 1 :])
        dr.eval(total)
        self.set_grad_out(total)

    def backward(self) -> None:
        grad = self.grad_out()
        dr.eval(grad)
        grads = [
            self.transposed(grad, i, *self.inputs) if wanted else dr.zeros(type(value), dr.width(value))
            for i, (value, wanted) in enumerate(zip(self.inputs, self.wanted, strict=True))
        ]
        self.set_grad_in("inputs", grads)

    def name(self) -> str:
        return "multilinear"


def by_moments(paths: Paths, grad: Any, weights: Any, nodes: int, suns: int, rows: int, width: int) -> Any:
    """Derivative by the moments that gather.contracted reads, table [nodes, suns, l, width]: sums over the visits at a
    node's level of derivative ``grad`` [visits, suns, width] times weight."""
    t = types()

    def at_levels() -> tuple[Any, Any]:
        order = np.argsort(paths.level, kind="stable")
        return uints(order), uints(np.searchsorted(paths.level[order], np.arange(nodes + 1)))

    order, first = paths.kept(("visits at levels", nodes), at_levels)
    # A lane takes a part of some rows under some suns: what it reads for one of them serves the others.
    size, whole = min(row_size(width), 8), row_size(width)
    parts, some, few = (dr.opaque(t.UInt, n, 1) for n in (whole // size, -(-suns // SUNS), -(-rows // ROWS)))
    per_level, per_sun = dr.opaque(t.UInt, suns, 1), dr.opaque(t.UInt, rows, 1)
    lane = dr.arange(t.UInt, nodes * -(-suns // SUNS) * -(-rows // ROWS) * (whole // size))
    place = lane // parts
    part, node = lane - place * parts, place // few
    row_, level = (place - node * few) * ROWS, node // some
    sun = (node - level * some) * SUNS
    start, stop = (dr.gather(t.UInt, first, level + i) for i in (0, 1))
    suns_, rows_ = [sun + i for i in range(SUNS)], [row_ + i for i in range(ROWS)]

    def add(i: Any, sums: list[list[Any]]) -> tuple[Any, list[list[Any]]]:
        visit = dr.gather(t.UInt, order, i)
        come, held = (
            [packet(table, (visit * count + dr.minimum(at, count - 1)) * parts + part, size) for at in places]
            for table, count, places in ((grad, per_level, suns_), (weights, per_sun, rows_))
        )
        new = [(one, other) for one in come for other in held]
        return i + 1, [
            [dr.fma(a, b, s) for a, b, s in zip(*both, old, strict=True)] for both, old in zip(new, sums, strict=True)
        ]

    zero = [[dr.zeros(t.Float, dr.width(lane)) for _ in range(size)] for _ in range(SUNS * ROWS)]
    _, sums = dr.while_loop((start, zero), lambda i, _: i < stop, add, max_iterations=-1, label="transposed")
    dr.eval(sums)  # each of the scatters would run the loop again
    found = dr.zeros(t.Float, nodes * suns * rows * whole)
    for values, (at, l_) in zip(sums, ((at, l_) for at in suns_ for l_ in rows_), strict=True):
        index = ((level * per_level + at) * per_sun + l_) * parts + part
        there = (at < per_level) & (l_ < per_sun)
        dr.scatter(found, t.ArrayXf(values) if size > 1 else values[0], index, there)
    dr.eval(found)
    return found


def by_weights(paths: Paths, grad: Any, moments: Any, suns: int, rows: int, width: int) -> Any:
    """The same by the weights, table [visits, l, width]: sums over suns."""
    t, together = types(), 1 + (rows % 2 == 0)
    lane = dr.arange(t.UInt, len(paths.station) * rows // together)
    size, per_level = dr.opaque(t.UInt, rows // together, 1), dr.opaque(t.UInt, suns, 1)
    visit = lane // size
    l_, node = lane - visit * size, dr.gather(t.UInt, paths.device.level, visit) * per_level

    def add(sun: Any, sums: list[list[Any]]) -> tuple[Any, list[list[Any]]]:
        come, place = row(grad, visit * per_level + sun, width), ((node + sun) * size + l_) * together
        return sun + 1, [
            [dr.fma(a, b, s) for a, b, s in zip(come, row(moments, place + i, width), old, strict=True)]
            for i, old in enumerate(sums)
        ]

    zero = [[dr.zeros(t.Float, dr.width(lane)) for _ in range(width)] for _ in range(together)]
    state = t.UInt(0), zero
    _, sums = dr.while_loop(state, lambda i, _: i < per_level, add, max_iterations=-1, label="transposed")
    fill = [t.Float(0.0)] * (row_size(width) - width)
    return stored([v for values in sums for v in [*values, *fill]], lane, together * row_size(width))


class Readers:
    """Who reads each row of a table [visits, suns + 2, m x channels], cubically at the sun coordinates ``x`` [visits,
    samples]: per row, from ``first``, the sample and its weight."""

    def __init__(self, x: np.ndarray, suns: int) -> None:
        visits, samples = x.shape
        s = np.minimum(x.astype(np.int64), suns - 2)
        f = x - s.astype(np.float32)
        g = np.float32(1.0) - f
        weights = np.stack(
            [-0.5 * f * g * g, f * f * (1.5 * f - 2.5) + 1.0, g * g * (1.5 * g - 2.5) + 1.0, -0.5 * g * f * f], axis=-1
        )
        rows = (np.arange(visits)[:, None] * (suns + 2) + s)[..., None] + np.arange(4)
        sample = np.broadcast_to(np.arange(samples)[:, None], rows.shape)
        read = weights != 0.0
        rows, weights, sample = rows[read], weights[read], sample[read]
        order = np.argsort(rows, kind="stable")
        self.table = floats(np.column_stack([sample[order], weights[order]]))
        self.first = uints(np.searchsorted(rows[order], np.arange(visits * (suns + 2) + 1)))


def by_table(
    readers: Readers,
    paths: Paths,
    place: Any,
    scale: Any,
    grad: Any,
    samples: int,
    suns: int,
    orders: int,
    channels: int,
) -> Any:
    """Derivative by the table that Gather reads, [visits, suns + 2, m x channels], from ``grad`` [rays, samples, 4] by
    radiance; ``place`` and ``scale`` are those of gather.Samples and Gather."""
    t, visits = types(), len(paths.station)
    lane = dr.arange(t.UInt, visits * samples)
    visit = lane // samples
    ray = dr.gather(t.UInt, paths.device.ray, visit)
    parts = packet(scale, lane, 4), packet(grad, ray * samples + lane - visit * samples, 4)
    values = [a * b for a, b in zip(*parts, strict=True)][:channels]
    scaled = table_of([packet(place, lane, 2)[1], *values], lane)

    lane = dr.arange(t.UInt, visits * (suns + 2))
    first = lane // (suns + 2) * samples
    start, stop = (dr.gather(t.UInt, readers.first, lane + i) for i in (0, 1))

    def add(i: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
        sample, weight = packet(readers.table, i, 2)
        cos_phi, *values = row(scaled, first + t.UInt(sample), channels + 1)
        return i + 1, add_harmonics(sums, [weight * value for value in values], cos_phi)

    return _summed(add, start, stop, orders * channels, lane)


def _summed(add: Callable[..., Any], start: Any, stop: Any, width: int, lane: Any) -> Any:
    zero = [dr.zeros(types().Float, dr.width(lane)) for _ in range(width)]
    _, sums = dr.while_loop((start, zero), lambda i, _: i < stop, add, max_iterations=-1, label="transposed")
    return table_of(sums, lane)
