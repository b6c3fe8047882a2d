"""Sums over the pieces of rays, and from rays to their pieces: linear, and backwards each is the other.

Left to Dr.Jit, what lanes read from each other becomes additions to shared memory on the way back.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import drjit as dr

from .backend import row, table_of, types


class RaySums:
    """Sums for rays whose pieces are ``first`` [N + 1] to ``first`` of the next. Per piece: its ``ray`` and the first
    piece of that, ``begin``; pieces of no ray are their own first, and come after all others."""

    def __init__(self, first: Any, ray: Any, begin: Any) -> None:
        self._first, self._ray, self._begin = first, ray, begin

    def at_pieces(self, values: list[Any]) -> list[Any]:
        """Values of rays at their pieces."""
        return _linear(self._at_pieces, self._totals, values)  # to what is of no ray nothing comes back

    def totals(self, values: list[Any]) -> list[Any]:
        """Sums over all pieces of each ray."""
        return _linear(self._totals, lambda grads: self._at_pieces(grads, own=True), values)

    def before(self, values: list[Any]) -> list[Any]:
        """Sums over the pieces of the same ray that come before each."""
        return _linear(self._before, self._after, values)

    def _at_pieces(self, values: list[Any], *, own: bool = False) -> list[Any]:
        """``own``: 0 where a piece is of no ray."""
        t = types()
        dr.eval(values)
        count = dr.gather(t.UInt, self._first, dr.width(self._first) - 1)
        active = dr.arange(t.UInt, dr.width(self._ray)) < count if own else True
        return [dr.gather(t.Float, value, self._ray, active) for value in values]

    def _totals(self, values: list[Any]) -> list[Any]:
        ray = dr.arange(types().UInt, dr.width(self._first) - 1)
        return _sums(values, *(dr.gather(types().UInt, self._first, ray + i) for i in (0, 1)))

    def _before(self, values: list[Any]) -> list[Any]:
        return _sums(values, self._begin, dr.arange(types().UInt, dr.width(self._begin)))

    def _after(self, values: list[Any]) -> list[Any]:
        after = dr.arange(types().UInt, dr.width(self._begin)) + 1
        return _sums(values, after, dr.gather(types().UInt, self._first, self._ray + 1))


def _sums(values: list[Any], start: Any, stop: Any) -> list[Any]:
    """Sums from ``start`` to ``stop`` of Floats of one width."""
    t, count = types(), len(values)
    width = dr.width(values)
    table = table_of(values, dr.arange(t.UInt, width))

    def add(i: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
        return i + 1, [s + v for s, v in zip(sums, row(table, i, count), strict=True)]

    zero = [dr.zeros(t.Float, dr.width(stop)) for _ in range(count)]
    return dr.while_loop((start, zero), lambda i, _: i < stop, add, label="sum of rows")[1]


def _linear(function: Callable[..., Any], transposed: Callable[..., Any], values: list[Any]) -> list[Any]:
    if not dr.grad_enabled(values):
        return function(values)
    return dr.custom(_operation(), values, function, transposed)


@lru_cache(maxsize=1)
def _operation() -> type:
    class Linear(dr.CustomOp):
        def eval(self, values: list[Any], function: Any, transposed: Any) -> list[Any]:
            self.function, self.transposed = function, transposed
            return function(values)

        def forward(self) -> None:
            self.set_grad_out(self.function(self.grad_in("values")))

        def backward(self) -> None:
            self.set_grad_in("values", self.transposed(self.grad_out()))

        def name(self) -> str:
            return "linear"

    return Linear
