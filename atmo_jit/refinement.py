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

    ``moments`` [K, S, pairs(degree), size] and ``sky`` irradiance [K, S, size]; ``size``: channels, padded. S: the
    suns of the solve, or of order 1.
    """

    def __init__(self, moments: Any, sky: Any, degree: int, size: int) -> None:
        self.moments, self.sky, self.degree, self.size = moments, sky, degree, size

    def zeroth(self) -> Any:
        """The zeroth moment, [K, S, size]."""
        lane = dr.arange(types().UInt, dr.width(self.sky))
        return dr.gather(
            types().Float, self.moments, lane // self.size * (pair_count(self.degree) * self.size) + lane % self.size
        )

    def numpy(self, grid: Grid) -> np.ndarray:
        """The moments as an array [K, S, pairs, size]."""
        return self.moments.numpy().reshape(grid.shape[0], -1, pair_count(self.degree), self.size)


def combined(orders: list[Order], weights: np.ndarray) -> Order:
    """Sum of orders of one degree, each times its weight: ``weights`` [len(orders), S, size]."""
    t = types()
    size, suns = orders[0].size, weights.shape[1]
    moments, sky = 0.0, 0.0
    per_node = pair_count(orders[0].degree)
    lane, sky_lane = (dr.arange(t.UInt, dr.width(b)) for b in (orders[0].moments, orders[0].sky))
    place = lane // (size * per_node) % suns * size + lane % size
    for order, weight in zip(orders, weights, strict=True):
        factor = floats(weight)
        moments = dr.fma(dr.gather(t.Float, factor, place), order.moments, moments)
        sky = dr.fma(dr.gather(t.Float, factor, sky_lane % (suns * size)), order.sky, sky)
    dr.eval(moments, sky)
    return Order(moments, sky, orders[0].degree, size)


class Refinement:
    """Cubic interpolation between the solved nodes, of quotients over the reference.

    Linear interpolation between the solved nodes would bias the twilight by some tenths of a per cent; solving at the
    refined ones costs several times as much. ``log_reference`` [levels, sources, size]; ``inverse`` [K, S, size] and
    ``first_inverse`` (at the suns of order 1): 1 / reference. The reference, given at the suns of order 1, guides
    only: it carries no derivative.
    """

    def __init__(self, grid: Grid, reference: np.ndarray) -> None:
        self.grid, self.size = grid, reference.shape[-1]
        first = (reference.shape[1] - 1) // (grid.shape[1] - 1)
        logs = _steadied(np.log(np.maximum(reference, 1e-30)), STEEPEST / first)
        self.first_inverse, self.inverse = floats(np.exp(-logs)), floats(np.exp(-logs[:, ::first]))
        fine = np.einsum("fs,ksc->kfc", grid.first_sun_refinement[0], logs)
        self.log_reference = floats(np.einsum("lk,kfc->lfc", grid.altitude_refinement, fine))
        self._first_suns, self._suns, self._altitudes = (
            _taps(m) for m in (grid.first_sun_refinement, grid.sun_refinement, grid.altitude_refinement[None])
        )

    def altitudes(self, values: Any) -> Any:
        """[K, ...] -> [levels, ...]."""
        count = self.grid.shape[0]
        inner = dr.width(values) // (count * self.size)
        return self._along(values, self._altitudes, count, len(self.grid.levels), inner, 1, None)

    def both(self, values: Any, suns: int, degree: int | None = None) -> Any:
        """[K, S, pairs(degree) or nothing, size] -> [levels, sources, ...], S being ``suns``: that of the solve or
        that of order 1."""
        values = self.altitudes(values)
        taps = self._suns if suns == self.grid.shape[1] else self._first_suns
        inner = dr.width(values) // (len(self.grid.levels) * suns * self.size)
        odd = None if degree is None else uints(pairs(degree)[1] % 2)
        return self._along(values, taps, suns, self.grid.sources, inner, len(self.grid.levels), odd)

    def thinned(self, order: Order) -> Order:
        """Order 1 at the suns of the solve only."""
        t = types()
        altitudes, suns = self.grid.shape
        fine = len(self.grid.first_theta)
        step = (fine - 1) // (suns - 1)

        def pick(values: Any) -> Any:
            inner = dr.width(values) // (altitudes * fine)
            lane = dr.arange(t.UInt, altitudes * suns * inner)
            item, node = lane % inner, lane // inner
            picked = dr.gather(t.Float, values, (node // suns * fine + node % suns * step) * inner + item)
            dr.eval(picked)
            return picked

        return Order(pick(order.moments), pick(order.sky), order.degree, order.size)

    def _along(
        self, values: Any, taps: tuple[Any, Any], count: int, refined: int, inner: int, outer: int, odd: Any
    ) -> Any:
        """Interpolate the second axis of [outer, count, inner, size]; ``odd`` [inner]: 1 where a value is odd about
        the first node."""
        t, size = types(), self.size
        lane = dr.arange(t.UInt, outer * refined * inner)
        item, rest = lane % inner, lane // inner
        place, block = rest % refined, rest // refined
        first = dr.gather(t.UInt, taps[0], place)
        weights = packet(taps[1], place if odd is None else dr.fma(dr.gather(t.UInt, odd, item), refined, place), 4)
        sums = [dr.zeros(t.Float, dr.width(lane)) for _ in range(size)]
        for i, weight in enumerate(weights):
            held = packet(values, (block * count + first + i) * inner + item, size)
            sums = [dr.fma(weight, v, s) for v, s in zip(held, sums, strict=True)]
        return stored(sums, lane, size)


def _taps(matrices: np.ndarray) -> tuple[Any, Any]:
    """Banded matrices [variants, rows, columns] as the first column of every row and its four weights [variants,
    rows, 4]."""
    first = np.minimum(np.argmax(np.any(matrices != 0, axis=0), axis=1), matrices.shape[2] - 4)
    columns = np.broadcast_to(first[:, None] + np.arange(4), (len(matrices), len(first), 4))
    return uints(first), floats(np.take_along_axis(matrices, columns, axis=2))


def _steadied(logs: np.ndarray, steepest: float) -> np.ndarray:
    """Logarithms [K, S, size] kept from changing by more than ``steepest`` between neighbouring suns.

    In the planet's shadow order 1 vanishes and later orders do not: their quotient must stay moderate.
    """
    logs = logs.copy()
    suns = logs.shape[1]
    for s in range(1, suns):
        logs[:, s] = np.maximum(logs[:, s], logs[:, s - 1] - steepest)
    for s in range(suns - 2, -1, -1):
        logs[:, s] = np.maximum(logs[:, s], logs[:, s + 1] - steepest)
    return logs
