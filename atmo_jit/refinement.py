"""Light at the solved nodes, relative to a reference, and its cubic interpolation to the refined ones."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from .backend import floats, packet, stored, types, uints
from .grid import Grid
from .harmonics import pair_count, pairs

STEEPEST = 1.2  # e-folds of the reference from one sun node to the next


class Order:
    """Light of one order, or a sum of orders, at the solved nodes, divided by the reference.

    ``moments`` [K, S, pairs(degree), size] and ``sky`` irradiance [K, S, size]; ``size``: channels, padded.
    """

    def __init__(self, moments: Any, sky: Any, degree: int, size: int) -> None:
        self.moments, self.sky, self.degree, self.size = moments, sky, degree, size

    def zeroth(self) -> Any:
        """The zeroth moment, [K, S, size]."""
        lane = dr.arange(types().UInt, dr.width(self.sky))
        return dr.gather(
            types().Float, self.moments, lane // self.size * (pair_count(self.degree) * self.size) + lane % self.size
        )

    def plus(self, other: Order, factor: Any = None) -> Order:
        """The sum with an order of equal or lower degree, which is first multiplied by ``factor`` [S, size] if that is given."""
        t, size = types(), self.size
        both = [list(zip(*(a.tolist() for a in pairs(d)), strict=True)) for d in (self.degree, other.degree)]
        place = {pair: i for i, pair in enumerate(both[1])}
        source = np.array([place.get(pair, -1) for pair in both[0]])
        count = pair_count(self.degree)
        lane = dr.arange(t.UInt, dr.width(self.moments))
        pair, node = lane // size % count, lane // (size * count)
        there = dr.gather(t.UInt, uints(np.maximum(source, 0)), pair)
        held = dr.gather(t.UInt, uints(source >= 0), pair) > 0
        moments = dr.gather(
            t.Float, other.moments, (node * pair_count(other.degree) + there) * size + lane % size, held
        )
        sky = other.sky
        if factor is not None:
            period = dr.opaque(t.UInt, dr.width(factor) // size, 1)
            moments *= dr.gather(t.Float, factor, node % period * size + lane % size)
            sky = sky * dr.gather(t.Float, factor, dr.arange(t.UInt, dr.width(sky)) % (period * size))
        moments, sky = self.moments + moments, self.sky + sky
        dr.eval(moments, sky)
        return Order(moments, sky, self.degree, size)


class Refinement:
    """Cubic interpolation between the solved nodes, of quotients over the reference.

    Linear interpolation between the solved nodes would bias the twilight by some tenths of a per cent; solving at the refined ones costs
    several times as much. ``log_reference`` [levels, sources, size]; ``inverse`` [K, S, size] is 1 / reference.
    """

    def __init__(self, grid: Grid, reference: np.ndarray) -> None:
        self.grid, self.size = grid, reference.shape[-1]
        logs = _steadied(np.log(np.maximum(reference, 1e-30)))
        self.inverse = floats(np.exp(-logs))
        fine = np.einsum("fs,ksc->kfc", grid.sun_refinement, logs)
        self.log_reference = floats(np.einsum("lk,kfc->lfc", grid.altitude_refinement, fine))
        self._suns, self._altitudes = _taps(grid.sun_refinement), _taps(grid.altitude_refinement)

    def altitudes(self, values: Any) -> Any:
        """[K, ...] -> [levels, ...]."""
        count = self.grid.shape[0]
        return self._along(
            values, self._altitudes, count, len(self.grid.levels), dr.width(values) // (count * self.size), 1
        )

    def suns(self, values: Any, outer: int) -> Any:
        """[outer, S, ...] -> [outer, sources, ...]."""
        count = self.grid.shape[1]
        return self._along(
            values, self._suns, count, self.grid.sources, dr.width(values) // (outer * count * self.size), outer
        )

    def both(self, values: Any) -> Any:
        """[K, S, ...] -> [levels, sources, ...]."""
        return self.suns(self.altitudes(values), len(self.grid.levels))

    def _along(self, values: Any, taps: tuple[Any, Any], count: int, refined: int, inner: int, outer: int) -> Any:
        """Interpolate the middle axis of [outer, count, inner, size]."""
        t, size = types(), self.size
        lane = dr.arange(t.UInt, outer * refined * inner)
        item, rest = lane % inner, lane // inner
        place, block = rest % refined, rest // refined
        first, weights = dr.gather(t.UInt, taps[0], place), packet(taps[1], place, 4)
        sums = [dr.zeros(t.Float, dr.width(lane)) for _ in range(size)]
        for i, weight in enumerate(weights):
            held = packet(values, (block * count + first + i) * inner + item, size)
            sums = [dr.fma(weight, v, s) for v, s in zip(held, sums, strict=True)]
        return stored(sums, lane, size)


def _taps(matrix: np.ndarray) -> tuple[Any, Any]:
    """A banded matrix as the first column and the four weights of every row."""
    first = np.minimum(np.argmax(matrix != 0, axis=1), matrix.shape[1] - 4)
    return uints(first), floats(np.take_along_axis(matrix, first[:, None] + np.arange(4), axis=1))


def _steadied(logs: np.ndarray) -> np.ndarray:
    """Logarithms [K, S, size] kept from changing by more than STEEPEST between neighbouring suns.

    In the planet's shadow order 1 vanishes and later orders do not: their quotient must stay moderate.
    """
    logs = logs.copy()
    suns = logs.shape[1]
    for s in range(1, suns):
        logs[:, s] = np.maximum(logs[:, s], logs[:, s - 1] - STEEPEST)
    for s in range(suns - 2, -1, -1):
        logs[:, s] = np.maximum(logs[:, s], logs[:, s + 1] - STEEPEST)
    return logs
