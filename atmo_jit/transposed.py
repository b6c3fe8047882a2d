"""Derivatives backwards through the gather's sums (gather.py), as gathers in the other direction.

Dr.Jit turns what a kernel gathers around, into additions to memory that several lanes share, for which every thread
needs a copy of the table. Who reads an entry is geometry, known beforehand: so here every entry collects what its
readers have for it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import drjit as dr
import numpy as np

from .backend import floats, packet, row, row_size, set_rows, table_of, types, uints
from .paths import Paths
from .projection import add_harmonics
from .visits import Visits, weighed

SUNS = 2  # that a lane of by_moments takes
LANES = 64  # that share the visits of a degree


def multilinear(
    function: Callable[..., Any], transposed: Callable[..., list[Any]], *inputs: Any, alone: Sequence[int] = ()
) -> Any:
    """``function`` of Floats in each of which it is linear. ``transposed``: the derivative by one of them, given
    that by the result, the number of the input, and the inputs. ``alone``: those that are added to the product of the
    others."""
    if not dr.grad_enabled(inputs):
        return function(*inputs)
    wanted = [dr.grad_enabled(value) for value in inputs]
    return dr.custom(_Multilinear, list(inputs), function, transposed, wanted, alone)


class _Multilinear(dr.CustomOp):
    def eval(
        self, inputs: list[Any], function: Any, transposed: Any, wanted: list[bool], alone: Sequence[int]
    ) -> Any:
        self.inputs, self.function, self.transposed, self.wanted = list(inputs), function, transposed, wanted
        self.alone = alone
        return function(*inputs)

    def forward(self) -> None:
        steps, total = self.grad_in("inputs"), 0.0
        for i in (i for i, wanted in enumerate(self.wanted) if wanted):
            dr.eval(steps[i])
            given = [
                value if (i in self.alone) == (j in self.alone) else dr.zeros(type(value), dr.width(value))
                for j, value in enumerate(self.inputs)
            ]
            total = total + self.function(*given[:i], steps[i], *given[i + 1 :])
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


def by_moments(
    visits: Visits, grad: Any, weights: Any, basis: Any, nodes: int, suns: int, rows: int, orders: int, channels: int
) -> Any:
    """Derivative by the moments that gather.contracted reads, table [nodes, suns, l, m x channels]: sums over the
    visits at a node's level of derivative ``grad`` by what it returns times weight times harmonic."""
    t, width, together = types(), orders * channels, visits.together
    of_levels = visits.first[np.minimum(np.arange(nodes + 1), len(visits.first) - 1)]
    first = visits.paths.kept(("groups at levels", together, nodes), lambda: uints(of_levels))
    # A lane takes some rows under some suns: what it reads for one of them serves the others.
    beside = 1 + (rows % 2 == 0)
    some, few, per_level = (dr.opaque(t.UInt, n, 1) for n in (-(-suns // SUNS), rows // beside, suns))
    lane = dr.arange(t.UInt, nodes * -(-suns // SUNS) * (rows // beside))
    node = lane // few
    block, level = lane - node * few, node // some
    sun = (node - level * some) * SUNS
    start, stop = (dr.gather(t.UInt, first, level + i) * together for i in (0, 1))
    suns_ = [sun + i for i in range(SUNS)]

    def add(i: Any, sums: list[list[Any]]) -> tuple[Any, list[list[Any]]]:
        member = i - i // together * together
        group = dr.gather(t.UInt, visits.at_levels, i // together)
        visit, place = dr.gather(t.UInt, visits.members, group * together + member), group * per_level
        come = [row(grad, (place + dr.minimum(at, per_level - 1)) * together + member, width) for at in suns_]
        first_row = (visit * few + block) * beside
        counts = [weighed(basis, weights, first_row + i, orders, channels) for i in range(beside)]
        both = [(one, other) for one in come for other in counts]
        return i + 1, [
            [dr.fma(a, b, s) for a, b, s in zip(*two, old, strict=True)] for two, old in zip(both, sums, strict=True)
        ]

    zero = [[dr.zeros(t.Float, dr.width(lane)) for _ in range(width)] for _ in range(SUNS * beside)]
    _, sums = dr.while_loop((start, zero), lambda i, _: i < stop, add, max_iterations=-1, label="transposed")
    dr.eval(sums)  # each of the scatters would run the loop again
    found = dr.zeros(t.Float, nodes * suns * rows * row_size(width))
    for i, at in enumerate(suns_):
        set_rows(found, sums[i * beside : (i + 1) * beside], (level * per_level + at) * few + block, at < per_level)
    dr.eval(found)
    return found


def by_weights(
    visits: Visits, grad: Any, moments: Any, basis: Any, suns: int, rows: int, orders: int, channels: int
) -> Any:
    """The same by the weights, table [visits, l, channels]: sums over suns, times the harmonics."""
    t, width, together, beside = types(), orders * channels, visits.together, 1 + (rows % 2 == 0)
    lane = dr.arange(t.UInt, visits.groups * (rows // beside))
    size, per_level = dr.opaque(t.UInt, rows // beside, 1), dr.opaque(t.UInt, suns, 1)
    group = lane // size
    l_, node = lane - group * size, dr.gather(t.UInt, visits.level, group) * per_level

    def add(sun: Any, sums: list[list[Any]]) -> tuple[Any, list[list[Any]]]:
        come = [row(grad, (group * per_level + sun) * together + i, width) for i in range(together)]
        light = [row(moments, ((node + sun) * size + l_) * beside + i, width) for i in range(beside)]
        both = [(one, other) for one in come for other in light]
        return sun + 1, [
            [dr.fma(a, b, s) for a, b, s in zip(*two, old, strict=True)] for two, old in zip(both, sums, strict=True)
        ]

    zero = [[dr.zeros(t.Float, dr.width(lane)) for _ in range(width)] for _ in range(together * beside)]
    state = t.UInt(0), zero
    _, sums = dr.while_loop(state, lambda i, _: i < per_level, add, max_iterations=-1, label="transposed")
    places = [visit * size + l_ for visit in packet(visits.members, group, together)]
    counts = []
    for n, values in enumerate(sums):
        harmonics = row(basis, places[n // beside] * beside + n % beside, orders)
        counts.append([_dot(harmonics, values[c::channels]) for c in range(channels)])
    for n in range(beside, len(counts)):  # of a visit that is there twice the last has it all
        same = places[n // beside] == places[n // beside - 1]
        before = zip(counts[n], counts[n - beside], strict=True)
        counts[n] = [a + dr.select(same, b, 0.0) for a, b in before]
    dr.eval(counts)
    found = dr.zeros(t.Float, len(visits.place) * rows * row_size(channels))
    for i, place in enumerate(places):
        set_rows(found, counts[i * beside : (i + 1) * beside], place)
    dr.eval(found)
    return found


def by_weight(grad: Any, chi: Any, visits: int, rows: int, channels: int, kinds: int) -> Any:
    """Derivative by the weights of gather.weight_rows, table [visits, scatterer x channel], given that by the table
    [visits, l, channels] that it makes: sums over l of that times the phase moments ``chi``."""
    t, width = types(), kinds * channels
    visit, end = dr.arange(t.UInt, visits), dr.opaque(t.UInt, rows - 1, 1)

    def add(l_: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
        come, moments = row(grad, visit * (end + 1) + l_, channels), row(chi, l_, width)
        return l_ + 1, [dr.fma(come[j % channels], moments[j], s) for j, s in enumerate(sums)]

    state = t.UInt(0), [dr.zeros(t.Float, visits) for _ in range(width)]
    _, sums = dr.while_loop(state, lambda l_, _: l_ < end, add, max_iterations=-1, label="by weight")
    return table_of(sums, visit)


def by_phase(grad: Any, scattered: Any, visits: int, rows: int, channels: int, kinds: int) -> Any:
    """The same by the phase moments, table [l, scatterer x channel]: sums over visits, some of them in a lane."""
    t, width, some = types(), kinds * channels, -(-visits // LANES)
    lane, size, end = dr.arange(t.UInt, rows * LANES), dr.opaque(t.UInt, rows, 1), dr.opaque(t.UInt, visits, 1)
    part = lane // size
    l_, start = lane - part * size, part * dr.opaque(t.UInt, some, 1)
    stop = dr.minimum(start + dr.opaque(t.UInt, some, 1), end)

    def add(visit: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
        come, weights = row(grad, visit * size + l_, channels), row(scattered, visit, width)
        return visit + 1, [dr.fma(come[j % channels], weights[j], s) for j, s in enumerate(sums)]

    state = start, [dr.zeros(t.Float, dr.width(lane)) for _ in range(width)]
    _, sums = dr.while_loop(state, lambda visit, _: visit < stop, add, max_iterations=-1, label="by phase")
    parts = table_of(sums, lane)
    row_ = dr.arange(t.UInt, rows)

    def together(i: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
        return i + 1, [a + b for a, b in zip(row(parts, i * size + row_, width), sums, strict=True)]

    state, count = (t.UInt(0), [dr.zeros(t.Float, rows) for _ in range(width)]), dr.opaque(t.UInt, LANES, 1)
    _, sums = dr.while_loop(state, lambda i, _: i < count, together, max_iterations=-1, label="by phase")
    # After the last degree comes the ground.
    return table_of([dr.select(row_ < size - 1, s, 0.0) for s in sums], row_)


def _dot(a: list[Any], b: list[Any]) -> Any:
    total = a[0] * b[0]
    for x, y in zip(a[1:], b[1:], strict=True):
        total = dr.fma(x, y, total)
    return total


class Readers:
    """Who reads each row of a table of ``visits`` and suns (Visits.rows_of_suns), cubically at the sun coordinates
    ``x`` [visits, samples]: per row, from ``first``, the sample and its weight; ``visit`` of each row. ``skipped``: see
    gather.seen."""

    def __init__(self, x: np.ndarray, suns: int, skipped: int, visits: Visits) -> None:
        count = suns + 1 - skipped
        s = np.minimum(x.astype(np.int64), suns - 2)
        f = x - s.astype(np.float32)
        g = np.float32(1.0) - f
        weights = np.stack(
            [-0.5 * f * g * g, f * f * (1.5 * f - 2.5) + 1.0, g * g * (1.5 * g - 2.5) + 1.0, -0.5 * g * f * f], axis=-1
        )
        of_suns = np.clip(s[..., None] + np.arange(4) - skipped, 0, count - 1)
        first, size = visits.rows(count), visits.groups * visits.together * count
        rows = first[:, None, None] + of_suns * visits.together
        sample = np.broadcast_to(np.arange(x.shape[1])[:, None], rows.shape)
        read = weights != 0.0
        rows, weights, sample = rows[read], weights[read], sample[read]
        order = np.argsort(rows, kind="stable")
        self.table = floats(np.column_stack([sample[order], weights[order]]))
        self.first = uints(np.searchsorted(rows[order], np.arange(size + 1)))
        visit = np.zeros(size, int)
        visit[first[:, None] + np.arange(count) * visits.together] = np.arange(len(first))[:, None]
        self.visit = uints(visit)


def by_table(
    readers: Readers, paths: Paths, place: Any, scale: Any, grad: Any, samples: int, orders: int, channels: int
) -> Any:
    """Derivative by the table that Gather reads (gather.contracted), from ``grad`` [rays, samples, 4] by radiance;
    ``place`` and ``scale`` are those of gather.Samples and Gather."""
    t, visits = types(), len(paths.station)
    lane = dr.arange(t.UInt, visits * samples)
    visit = lane // samples
    ray = dr.gather(t.UInt, paths.device.ray, visit)
    parts = packet(scale, lane, 4), packet(grad, ray * samples + lane - visit * samples, 4)
    values = [a * b for a, b in zip(*parts, strict=True)][:channels]
    scaled = table_of([packet(place, lane, 2)[1], *values], lane)

    lane = dr.arange(t.UInt, dr.width(readers.visit))
    first = readers.visit * samples
    start, stop = (dr.gather(t.UInt, readers.first, lane + i) for i in (0, 1))

    def add(i: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
        sample, weight = packet(readers.table, i, 2)
        cos_phi, *values = row(scaled, first + t.UInt(sample), channels + 1)
        return i + 1, add_harmonics(sums, [weight * value for value in values], cos_phi)

    zero = [dr.zeros(t.Float, dr.width(lane)) for _ in range(orders * channels)]
    _, sums = dr.while_loop((start, zero), lambda i, _: i < stop, add, max_iterations=-1, label="transposed")
    return table_of(sums, lane)
