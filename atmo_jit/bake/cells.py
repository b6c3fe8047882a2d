"""Bilinear tables that are read a cell at a time, in one packet of two words per value.

A value in a cell is v + v_x x + (v_y + v_xy x) y. Only the first coefficient needs a float's digits, the others are
differences of neighbours. So each value takes two words, each a float whose last bits are another's first:

    word 1    v: sign, exponent, 11 bits of mantissa      v_xy: sign, exponent, 3 bits
    word 2    v_x: sign, exponent, 7 bits                 v_y: sign, exponent, 7 bits

A word is read as it is, without masking: what its last bits add is allowed for when its first are rounded. So v keeps
2^-12, v_x and v_y keep 2^-9 and v_xy 2^-5 of themselves.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from ..backend import floats, packet, types

TWIST_BITS, SLOPE_BITS = 12, 16  # of v_xy in the first word, of v_y in the second


class Cells:
    """Cells between nodes ``values`` [rows, columns, N], in sheets of ``sheets`` rows that are not joined.

    Cells after the last node of a row or column are constant, for coordinates that rounding takes there.
    """

    def __init__(self, values: np.ndarray, sheets: tuple[int, ...]) -> None:
        *_, self.columns, self.count = values.shape
        self._stored = 1 << (self.count - 1).bit_length()
        v = np.zeros((*values.shape[:2], self._stored), np.float32)
        v[..., : self.count] = values
        by_column = np.zeros_like(v)
        np.subtract(v[:, 1:], v[:, :-1], out=by_column[:, :-1])
        by_row, by_both = (np.zeros_like(v) for _ in range(2))
        last = np.cumsum(sheets) - 1
        for of, by in ((v, by_row), (by_column, by_both)):
            np.subtract(of[1:], of[:-1], out=by[:-1])
            by[last] = 0.0
        words = np.concatenate([packed(v, by_both, TWIST_BITS), packed(by_column, by_row, SLOPE_BITS)], axis=-1)
        self._words = floats(words)
        self.nbytes = words.nbytes

    def at(self, row: Any, y: Any, column: Any, x: Any) -> list[Any]:
        """The N values at the fractions ``y``, ``x`` of the cell that begins at node ``row``, ``column`` (Ints)."""
        cell = types().UInt(dr.fma(row, self.columns, column))
        words = packet(self._words, cell, 2 * self._stored)[: self._stored + self.count]
        found = []
        for first, second in zip(words, words[self._stored :], strict=False):
            twist, slope = last_bits(first, TWIST_BITS), last_bits(second, SLOPE_BITS)
            found.append(dr.fma(dr.fma(twist, x, slope), y, dr.fma(second, x, first)))
        return found


def packed(first: np.ndarray, second: np.ndarray, bits: int) -> np.ndarray:
    """Floats near ``first`` whose last ``bits`` bits are the first bits of floats near ``second``, float32."""
    low = (second.view(np.uint32).astype(np.int64) + (1 << (31 - bits))) >> (32 - bits)
    word = first.view(np.uint32).astype(np.int64)
    size = word & 0x7FFFFFFF
    # Of all floats with these last bits the nearest, in size: integers order floats.
    size = np.maximum(size - low + (1 << (bits - 1)), 0) >> bits << bits | low
    return (size | word & 0x80000000).astype(np.uint32).view(np.float32)


def last_bits(word: Any, bits: int) -> Any:
    """The second of the two floats in a word of :func:`packed`."""
    t = types()
    return dr.reinterpret_array(t.Float, dr.reinterpret_array(t.UInt, word) << (32 - bits))
