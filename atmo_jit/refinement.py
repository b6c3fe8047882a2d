"""The reference over which light is stored, and interpolation between suns of quotients over it.

At twilight light falls by a factor of two per degree of the sun. The reference, the zeroth moment of order 1, falls
alike, and is interpolated in its logarithm; quotients over it change slowly and are interpolated by themselves.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from .backend import evaluated, floats, packet, row, row_size, stored, types, uints
from .grid import Grid
from .paths import lagrange
from .projection import Moments
from .transposed import multilinear

FINE = 16  # parts of an interval of solved suns; 1.2 e-folds over it are then linear to 0.1 %
STEEPEST = 1.2  # e-folds of the reference from one solved sun to the next
LEAST = 1e-37
DEEPEST = 3.0  # and from one altitude to the next


class Reference:
    """``log`` of the reference, ``inverse`` = exp(-log), tables [K, first suns, channels], and ``fine`` [K, suns, 4]:
    the reference at so many suns that it is linear between them. It guides only: it carries no derivative.
    """

    def __init__(self, grid: Grid, channels: int) -> None:
        self.grid, self.channels = grid, channels

    @classmethod
    def of(cls, grid: Grid, channels: int, held: dict[str, Any]) -> Reference:
        """The reference that ``held`` came from."""
        reference = cls(grid, channels)
        vars(reference).update(held)
        return reference

    @property
    def held(self) -> dict[str, Any]:
        """Its arrays."""
        return {"log": self.log, "inverse": self.inverse, "fine": self.fine}

    @classmethod
    def above(cls, grid: Grid, light: Moments) -> Reference:
        """The reference for order 1."""
        reference = cls(grid, light.channels)
        reference._make(light)
        return reference

    def _make(self, light: Moments) -> None:
        t, grid, channels = types(), self.grid, light.channels
        altitudes, suns = grid.shape[0], len(grid.first_theta)
        values, steepest = dr.detach(light.values), dr.opaque(t.Float, STEEPEST / grid.first, 1)
        lane, end = dr.arange(t.UInt, altitudes * suns * channels), dr.opaque(t.UInt, suns, 1)
        channel, node = lane % channels, lane // channels
        sun, k = node % suns, node // suns

        # In the planet's shadow order 1 vanishes and later orders do not: their quotient must stay moderate.
        def steady(i: Any, highest: Any) -> tuple[Any, Any]:
            zeroth = dr.gather(t.Float, values, light.index(k, 0, i, channel))
            fall = steepest * dr.abs(t.Float(sun) - t.Float(i))
            return i + 1, dr.maximum(highest, dr.log(dr.maximum(zeroth, 1e-30)) - fall)

        # Nor does light in a cloud that sunlight does not reach.
        def level(i: Any, highest: Any) -> tuple[Any, Any]:
            there = dr.gather(t.Float, by_suns, (i * suns + sun) * channels + channel)
            return i + 1, dr.maximum(highest, there - DEEPEST * dr.abs(t.Float(k) - t.Float(i)))

        lowest = dr.full(t.Float, -100.0, dr.width(lane))
        _, by_suns = dr.while_loop((t.UInt(0), lowest), lambda i, _: i < end, steady, label="steady")
        dr.eval(by_suns)
        top = dr.opaque(t.UInt, altitudes, 1)
        _, highest = dr.while_loop((t.UInt(0), lowest), lambda i, _: i < top, level, label="level")
        self.log, self.inverse = (dr.zeros(t.Float, altitudes * suns * row_size(channels)) for _ in range(2))
        place = node * row_size(channels) + channel
        dr.scatter(self.log, highest, place)
        dr.scatter(self.inverse, dr.exp(-highest), place)
        dr.eval(self.log, self.inverse)
        fine = FINE * (grid.shape[1] - 1) + 1
        lane = dr.arange(t.UInt, altitudes * fine)
        source, k = lane % fine, lane // fine
        taps = Taps(grid, t.Float(source) * (grid.first / FINE), suns)
        rows = [row(self.log, k * suns + at, channels) for at in taps.at]
        self.fine = stored([dr.exp(taps.sum([r[c] for r in rows])) for c in range(channels)], lane, 4)

    def index(self, k: Any, sun: Any, channel: Any) -> Any:
        """Place of ``inverse`` at an altitude node and a solved sun."""
        return (k * len(self.grid.first_theta) + sun * self.grid.first) * row_size(self.channels) + channel

    def at(self, level: Any, x: Any, active: Any = True, fine: Any = None) -> list[Any]:
        """The reference at a level and a sun coordinate, per channel; ``fine``: at other levels than the grid's."""
        t, count = types(), FINE * (self.grid.shape[1] - 1) + 1
        suns = self.grid.kept("suns of the reference", lambda: dr.opaque(t.UInt, count, 1))  # see Grid.node
        held = self.fine if fine is None else fine
        x = x * float(FINE)
        s = dr.minimum(t.UInt(x), suns - 2)
        f = x - t.Float(s)
        low, high = (packet(held, level * suns + s + i, 4, active) for i in (0, 1))
        # Between two suns it falls nearly exponentially, and a line's slope there would be 4 % off.
        bend, values = f * (1.0 - f), []
        for a, b in zip(low[: self.channels], high[: self.channels], strict=True):
            rise = b - a
            values.append(dr.fma(f, rise, a) - bend * rise * (rise / dr.maximum(a + b, LEAST)))
        return values


class Taps:
    """Interpolation at the sun coordinate ``x`` (s at node s of ``suns``) by the polynomial through six nodes: those
    ``at``, and their weights.

    Its slope is as exact between the nodes as a cubic's value. Beyond the first node lie the mirrored ones after it
    (the sun has passed through the zenith: a moment cos(m phi) changes by (-1)^m), beyond the last the last.
    """

    def __init__(self, grid: Grid, x: Any, suns: int) -> None:
        t = types()
        s = dr.minimum(t.UInt(x), suns - 2)
        self.weights = quintic(x - t.Float(s))
        self.mirrored, self.at = [], []
        for n in (2, 1):
            behind = dr.minimum(n - dr.minimum(s, n), suns - 1) if grid.whole_suns else t.UInt(0)
            self.mirrored.append(s < n)
            self.at.append(dr.select(s < n, behind, dr.maximum(s, n) - n))
        for n in range(4):
            self.mirrored.append(t.Bool(False))
            self.at.append(dr.minimum(s + n, suns - 1))

    def sum(self, values: list[Any], sign: Any = 1.0) -> Any:
        """Sum of weight times value; ``sign``: of mirrored ones."""
        total = 0.0
        for weight, value, mirrored in zip(self.weights, values, self.mirrored, strict=True):
            total = dr.fma(weight, value * dr.select(mirrored, sign, 1.0), total)
        return total


def quintic(f: Any) -> list[Any]:
    """Lagrange weights of the six nodes about a fraction ``f`` of the middle interval."""
    below = [f + 2.0, f + 1.0, f, f - 1.0, f - 2.0, f - 3.0]
    weights = []
    for scale, skipped in zip((-120.0, 24.0, -12.0, 12.0, -24.0, 120.0), range(6), strict=True):
        product = 1.0 / scale
        for i in range(6):
            product = product * below[i] if i != skipped else product
        weights.append(product)
    return weights


def between_levels(grid: Grid, values: Any, length: int) -> Any:
    """[K, length] -> [levels, length]: by the polynomial in the altitude coordinate through four nodes, or six where
    derivatives are wanted."""
    t, nodes = types(), grid.shape[0]
    count = min(6 if grid.resolution.twice else 4, nodes)

    def taps() -> tuple[Any, Any, Any]:
        level = np.arange(grid.level_count) / grid.refine
        first = np.clip(np.floor(level).astype(int) + 1 - count // 2, 0, nodes - count)
        weights = lagrange((first[:, None] + np.arange(count)).astype(float), level)
        # Levels that read a node are consecutive.
        readers = np.searchsorted(first, [np.arange(nodes) - count + 1, np.arange(nodes) + 1])
        return uints(first), floats(weights), uints(readers.T)

    first, weights, readers = grid.kept("between levels", taps)

    def at_levels(values: Any) -> Any:
        lane = dr.arange(t.UInt, grid.level_count * length)
        level, place = lane // length, lane % length
        start, total = dr.gather(t.UInt, first, level), 0.0
        for i in range(count):
            value = dr.gather(t.Float, values, (start + i) * length + place)
            total = dr.fma(dr.gather(t.Float, weights, level * count + i), value, total)
        return evaluated(total)

    def transposed(grad: Any, *_: Any) -> Any:
        lane = dr.arange(t.UInt, nodes * length)
        node, place = lane // length, lane % length
        start, stop = packet(readers, node, 2)

        def add(level: Any, total: Any) -> tuple[Any, Any]:
            weight = dr.gather(t.Float, weights, level * count + node - dr.gather(t.UInt, first, level))
            return level + 1, dr.fma(weight, dr.gather(t.Float, grad, level * length + place), total)

        state = start, dr.zeros(t.Float, dr.width(lane))
        total = dr.while_loop(state, lambda level, _: level < stop, add, max_iterations=-1, label="between levels")[1]
        dr.eval(total)
        return total

    return multilinear(at_levels, transposed, values)
