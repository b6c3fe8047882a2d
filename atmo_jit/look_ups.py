"""Look-ups in a field that derivatives pass through, as sums by cells of its table.

Many places look up few cells of a table of moments, each in a direction of its own. Left to Dr.Jit, each then adds
what it has for every moment at the four corners of its cell, in memory, one after the other. Here look-ups are put in
the order of their cells. What comes back to a cell is a product of two matrices, of harmonics in the directions and of
weights of the corners times what comes to the look-ups, and is added once. The derivatives by the weights follow from
sums that the look-up keeps apart for every corner: nothing is read again on the way back.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr

from .backend import packet, padded, row, row_size, table_of, tables_of, types
from .grid import Grid
from .harmonics import Harmonics, pair_count

CHUNK = 256  # look-ups that a lane sums on the way back: what it adds to memory then is little beside
BATCH = 4096  # look-ups whose harmonics are held at once
TOGETHER = 4  # pairs that a lane sums on the way back: they share what it reads of the look-ups
CORNERS = 4


@dataclass
class LookUps:
    """Look-ups of moments [node, pair, channels] of a ``degree`` in cells of ``grid``, given by the first node of each,
    in the directions of ``basis``, which carries no derivative, by the recurrence with coefficients ``steps``. Where
    they are not ``active`` they are 0. ``same``: others in the same cells."""

    grid: Grid
    degree: int
    channels: int
    kinds: int
    cell: Any
    basis: Harmonics
    steps: Any
    active: Any
    same: LookUps | None = None

    def __call__(self, moments: Any, phases: Any, weights: list[list[Any]]) -> tuple[list[Any], list[list[Any]]]:
        """Sums over pairs and corners of harmonic, phase moment, ``weights`` [corner][channel] and moment, [scatterer x
        channel]; and, without derivatives, their slopes by mu and x if the basis has them. ``phases``: phase moments
        of every pair, table [pair, scatterer x channel]."""
        flat = [weight for of_corner in weights for weight in of_corner]
        sums = dr.custom(_LookedUp, moments, phases, flat, self, dr.grad_enabled(flat))
        slopes = [dr.detach(v) for v in sums[self.width :]]
        return sums[: self.width], [slopes[i : i + self.width] for i in range(0, len(slopes), self.width)]

    @property
    def count(self) -> int:
        """How many there are."""
        return dr.width(self.cell)

    @property
    def width(self) -> int:
        """Numbers that each finds: scatterers times channels."""
        return self.kinds * self.channels

    @cached_property
    def _pairs(self) -> Any:
        return dr.opaque(types().UInt, pair_count(self.degree), 1)

    @cached_property
    def _cells(self) -> Any:
        return dr.opaque(types().UInt, self.grid.level_count * self.grid.sources, 1)

    @cached_property
    def _by_cells(self) -> tuple[Any, Any, Any]:
        """The look-ups in the order of their cells, the place of each in it, and the first place of every cell.

        Those that are not active come last, as if in a cell of their own.
        """
        if self.same is not None:
            return self.same._by_cells
        t = types()
        cell = dr.select(self.active, self.cell, self._cells)
        counts = dr.zeros(t.UInt, self.grid.level_count * self.grid.sources + 1)
        rank = dr.scatter_inc(counts, cell)
        dr.eval(rank, cell, counts)
        first = dr.cumsum(counts) - counts
        dr.eval(first)
        order, place = dr.zeros(t.UInt, self.count), dr.gather(t.UInt, first, cell) + rank
        dr.scatter(order, dr.arange(t.UInt, self.count), place)
        dr.eval(order, place)
        return order, place, first

    def rows(self, table: Any, width: int) -> list[Any]:
        """Rows of a table in the order of the cells, at every look-up."""
        return row(table, self._by_cells[1], width)

    def looked_up(self, moments: Any, phases: Any, weights: list[Any], *, apart: bool) -> list[Any]:
        """Tables in the order of the cells: of sums [scatterer x channel], of their slopes [2 x scatterer x channel] if
        there are any, and, if wanted ``apart``, of the sums at every corner without its weight [corner x scatterer x
        channel]."""
        t, channels, width = types(), self.channels, self.width
        nodes, active, (weights,), basis = self._in_order([weights], slopes=self.basis.slopes)
        own = (CORNERS if apart else 1) * width

        def pair(i: Any, state: Any, sums: list[Any]) -> tuple[Any, ...]:
            (value, *slopes), state = basis.next(packet(self.steps, i, 4, active), state)
            corners = self._corners_of(moments, nodes, i, active)
            chi, blend = row(phases, i, width, active=active), self._blend(weights, corners)
            lit = [chi[j] * blend[j % channels] for j in range(width)]
            terms = [(value, part) for part in lit]
            if apart:
                factors = [value * part for part in chi]
                terms = [(factors[j], corner[j % channels]) for corner in corners for j in range(width)]
            terms += [(slope, part) for slope in slopes for part in lit]
            return i + 1, state, [dr.fma(a, b, s) for (a, b), s in zip(terms, sums, strict=True)]

        zeros = [dr.zeros(t.Float, self.count) for _ in range(own + (2 * width if basis.slopes else 0))]
        state = (t.UInt(0), basis.start(self.count), zeros)
        *_, sums = dr.while_loop(state, lambda i, *_: active & (i < self._pairs), pair, label="looked up")
        own, slopes = sums[:own], sums[own:]
        corners = [own[n : n + width] for n in range(0, len(own), width)]
        columns = enumerate(zip(*corners, strict=True))
        whole = [_dot(weights[j % channels :: channels], column) for j, column in columns] if apart else own
        groups = [group for group in (whole, slopes, own if apart else []) if group]
        return tables_of(groups, dr.arange(t.UInt, self.count))

    def tangent(self, inputs: tuple[Any, Any, list[Any]], steps: tuple[Any, Any, list[Any]]) -> list[Any]:
        """How the sums change along ``steps`` of moments, phases and weights."""
        t, channels, width = types(), self.channels, self.width
        (moments, phases, weights), (by_moments, by_phases, by_weights) = inputs, steps
        nodes, active, (weights, by_weights), basis = self._in_order([weights, by_weights], slopes=False)

        def pair(i: Any, state: Any, sums: list[Any]) -> tuple[Any, ...]:
            (value,), state = basis.next(packet(self.steps, i, 4, active), state)
            corners, changes = (self._corners_of(table, nodes, i, active) for table in (moments, by_moments))
            chi, by_chi = (row(table, i, width, active=active) for table in (phases, by_phases))
            blend, parts = (
                self._blend(weights, corners),
                (self._blend(by_weights, corners), self._blend(weights, changes)),
            )
            moved = [a + b for a, b in zip(*parts, strict=True)]
            terms = [dr.fma(chi[j], moved[j % channels], by_chi[j] * blend[j % channels]) for j in range(width)]
            return i + 1, state, [dr.fma(value, term, s) for term, s in zip(terms, sums, strict=True)]

        zeros = [dr.zeros(t.Float, self.count) for _ in range(width)]
        state = (t.UInt(0), basis.start(self.count), zeros)
        *_, sums = dr.while_loop(state, lambda i, *_: active & (i < self._pairs), pair, label="look-ups moved")
        return self.rows(table_of(sums, dr.arange(t.UInt, self.count)), width)

    def _in_order(self, groups: list[list[Any]], *, slopes: bool) -> tuple[Any, ...]:
        """In the order of the cells: corners, which look-ups are active, groups of values, and harmonics."""
        t, order = types(), self._by_cells[0]
        cell, active = dr.gather(t.UInt, self.cell, order), dr.gather(t.Bool, self.active, order)
        groups = [[dr.gather(t.Float, value, order) for value in group] for group in groups]
        return self._nodes(cell), active, groups, self._directions(order, slopes=slopes)

    def _nodes(self, cell: Any) -> list[Any]:
        across = self.grid.counts[1]
        return [cell, cell + 1, cell + across, cell + across + 1]

    def _directions(self, look_up: Any, *, slopes: bool) -> Harmonics:
        mu, x = (dr.gather(types().Float, v, look_up) for v in (self.basis.mu, self.basis.x))
        return Harmonics(mu, x, slopes=slopes)

    def _corners_of(self, moments: Any, nodes: list[Any], pair: Any, active: Any) -> list[list[Any]]:
        return [packet(moments, node * self._pairs + pair, padded(self.channels), active) for node in nodes]

    def _blend(self, weights: list[Any], corners: list[list[Any]]) -> list[Any]:
        """Weighted sums of the values at the corners, per channel."""
        return [_dot(weights[c :: self.channels], [v[c] for v in corners]) for c in range(self.channels)]

    def transposed(self, grads: list[Any], moments: Any, phases: Any, weights: list[Any]) -> tuple[Any, Any]:
        """Derivatives by moments and phases, given those by the sums."""
        t, found = types(), [dr.zeros(types().Float, dr.width(table)) for table in (moments, phases)]
        room, size = row_size(pair_count(self.degree)), min(self.count, BATCH)
        held = [dr.empty(t.Float, size * length) for length in (room, row_size(CORNERS * self.width))]
        for begin in range(0, self.count, size):
            some, start = min(size, self.count - begin), dr.opaque(t.UInt, begin, 1)
            self._hold(held, start, some, room, grads, weights)
            self._add(held, start, some, room, (moments, phases), found)
        return tuple(found)

    def _hold(self, held: list[Any], start: Any, count: int, room: int, grads: list[Any], weights: list[Any]) -> None:
        """Write harmonics [pair], and products of weights and derivatives [corner x scatterer x channel], of ``count``
        look-ups from place ``start`` on."""
        t, lane = types(), dr.arange(types().UInt, count)
        look_up = dr.gather(t.UInt, self._by_cells[0], start + lane)
        basis, length = self._directions(look_up, slopes=False), dr.opaque(t.UInt, room // TOGETHER, 1)

        def some_pairs(i: Any, state: Any) -> tuple[Any, Any]:
            values, steps = [], row(self.steps, i, 4 * TOGETHER)
            for j in range(0, 4 * TOGETHER, 4):
                (value,), state = basis.next(steps[j : j + 4], state)
                values.append(value)
            dr.scatter(held[0], t.ArrayXf(values), lane * length + i)
            return i + 1, state

        dr.while_loop((t.UInt(0), basis.start(count)), lambda i, *_: i < length, some_pairs, label="harmonics")
        grads, weights = ([dr.gather(t.Float, v, look_up) for v in values] for values in (grads, weights))
        corners = [weights[n : n + self.channels] for n in range(0, len(weights), self.channels)]
        values = [corner[j % self.channels] * grad for corner in corners for j, grad in enumerate(grads)]
        values += [t.Float(0.0)] * (row_size(len(values)) - len(values))
        dr.scatter(held[1], t.ArrayXf(values), lane)
        dr.eval(held)

    def _add(
        self, held: list[Any], start: Any, count: int, room: int, tables: tuple[Any, Any], found: list[Any]
    ) -> None:
        """Add what these have for moments and phases to what was ``found``: a lane takes some pairs of a chunk of
        look-ups, cell by cell."""
        t, channels, width, first = types(), self.channels, self.width, self._by_cells[2]
        harmonics, products = held
        length = dr.opaque(t.UInt, room // TOGETHER, 1)
        lane = dr.arange(t.UInt, -(-count // CHUNK) * (room // TOGETHER))
        chunk = lane // length
        some_pairs, begin = lane - chunk * length, start + chunk * CHUNK
        # Behind the last cell come those that are not active.
        end = dr.minimum(
            dr.minimum(begin + CHUNK, start + dr.opaque(t.UInt, count, 1)), dr.gather(t.UInt, first, self._cells)
        )
        pairs = [some_pairs * TOGETHER + j for j in range(TOGETHER)]
        there = [pair < self._pairs for pair in pairs]
        chi = [row(tables[1], pair, width, active=active) for pair, active in zip(pairs, there, strict=True)]

        def cell(place: Any, of_phases: list[list[Any]]) -> tuple[Any, Any]:
            node = dr.gather(t.UInt, self.cell, dr.gather(t.UInt, self._by_cells[0], place))
            stop = dr.minimum(dr.gather(t.UInt, first, node + 1), end)

            def add(i: Any, sums: list[list[Any]]) -> tuple[Any, list[list[Any]]]:
                here = i - start
                parts = row(products, here, CORNERS * width)
                return i + 1, [
                    [dr.fma(value, part, s) for part, s in zip(parts, old, strict=True)]
                    for value, old in zip(packet(harmonics, here * length + some_pairs, TOGETHER), sums, strict=True)
                ]

            zeros = [[dr.zeros(t.Float, dr.width(lane)) for _ in range(CORNERS * width)] for _ in pairs]
            _, sums = dr.while_loop((place, zeros), lambda i, _: i < stop, add, label="of a cell")
            new = []
            for pair, active, phase, of_pair, old in zip(pairs, there, chi, sums, of_phases, strict=True):
                corners = self._corners_of(tables[0], self._nodes(node), pair, active)
                for n, (corner, values) in enumerate(zip(self._nodes(node), corners, strict=True)):
                    parts = of_pair[n * width : (n + 1) * width]
                    old = [
                        dr.fma(values[j % channels], part, s)
                        for j, (part, s) in enumerate(zip(parts, old, strict=True))
                    ]
                    of_moments = self._blend(phase, [parts[k : k + channels] for k in range(0, width, channels)])
                    _add_row(found[0], of_moments, corner * self._pairs + pair, padded(channels), active)
                new.append(old)
            return stop, new

        zeros = [[dr.zeros(t.Float, dr.width(lane)) for _ in range(width)] for _ in pairs]
        _, of_phases = dr.while_loop((begin, zeros), lambda place, _: place < end, cell, label="cells")
        for pair, active, values in zip(pairs, there, of_phases, strict=True):
            _add_row(found[1], values, pair, row_size(width), active)
        dr.eval(found)


def _add_row(table: Any, values: list[Any], index: Any, size: int, active: Any) -> None:
    """Add values to row ``index`` of a table of rows of ``size``."""
    t, step = types(), min(size, 8)
    values = [*values, *[t.Float(0.0)] * (size - len(values))]
    for i in range(0, size, step):
        part = t.ArrayXf(values[i : i + step]) if step > 1 else values[i]
        # A copy for every thread, as Dr.Jit would have it, takes more memory than all else here.
        dr.scatter_add(table, part, index * (size // step) + i // step, active, mode=dr.ReduceMode.Direct)


def _dot(weights: Any, values: Any) -> Any:
    total = weights[0] * values[0]
    for weight, value in zip(weights[1:], values[1:], strict=True):
        total = dr.fma(weight, value, total)
    return total


class _LookedUp(dr.CustomOp):
    def eval(self, moments: Any, phases: Any, weights: list[Any], look_ups: LookUps, apart: bool) -> list[Any]:
        look_ups.active = look_ups.active | dr.zeros(types().Bool, look_ups.count)
        dr.eval(weights, look_ups.cell, look_ups.basis.mu, look_ups.basis.x, look_ups.active)
        self.look_ups, self.inputs, width = look_ups, (moments, phases, list(weights)), look_ups.width
        sums, *more = look_ups.looked_up(*self.inputs, apart=apart)
        self.apart = more.pop() if apart else None
        return look_ups.rows(sums, width) + [value for slopes in more for value in look_ups.rows(slopes, 2 * width)]

    def forward(self) -> None:
        steps = self.grad_in("moments"), self.grad_in("phases"), self.grad_in("weights")
        dr.eval(steps)
        own = self.look_ups.tangent(self.inputs, steps)
        slopes = [dr.zeros(types().Float, self.look_ups.count)] * (2 * len(own) if self.look_ups.basis.slopes else 0)
        self.set_grad_out([*own, *slopes])

    def backward(self) -> None:
        own, width = self.look_ups, self.look_ups.width
        grads = self.grad_out()[:width]
        dr.eval(grads)
        by_moments, by_phases = own.transposed(grads, *self.inputs)
        self.set_grad_in("moments", by_moments)
        self.set_grad_in("phases", by_phases)
        if self.apart is None:
            return
        sums = own.rows(self.apart, CORNERS * width)
        corners = [sums[n : n + width] for n in range(0, len(sums), width)]
        by_weights = [
            _dot(grads[c :: own.channels], v[c :: own.channels]) for v in corners for c in range(own.channels)
        ]
        dr.eval(by_weights)
        self.set_grad_in("weights", by_weights)

    def name(self) -> str:
        return "looked up"
