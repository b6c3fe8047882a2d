"""Bilinear tables that are read a cell at a time, in one packet of two words per value.

A value in a cell is v + v_x x + (v_y + v_xy x) y. Only the first coefficient needs a float's digits, the others are
differences of neighbours. So each value takes two words, each a float whose last bits are another's first:

    word 1    v: sign, exponent, 11 bits of mantissa      v_xy: sign, exponent, 3 bits
    word 2    v_x: sign, exponent, 7 bits                 v_y: sign, exponent, 7 bits

A word is read as it is, without masking: what its last bits add is allowed for when its first are rounded. So v is
right to 2^-12, v_x and v_y are to 2^-8 and v_xy is to 2^-4 of themselves.
"""

from __future__ import annotations

from typing import Any

import drjit as dr

from ..backend import packet, stored, types

TWIST_BITS, SLOPE_BITS = 12, 16  # of v_xy in the first word, of v_y in the second


class Cells:
    """Cells between nodes [rows, columns] whose ``values`` are N Floats, in sheets of ``sheets`` rows that are not
    joined.

    Cells after the last node of a row or column are constant, for coordinates that rounding takes there.
    """

    def __init__(self, values: list[Any], columns: int, sheets: tuple[int, ...]) -> None:
        t = types()
        self.columns, self.count = columns, len(values)
        self._stored = 1 << (self.count - 1).bit_length()
        lane = dr.arange(t.UInt, sum(sheets) * columns)
        nodes = stored(values, lane, self._stored)
        row, column = lane // columns, lane % columns
        # The last row of a sheet is its own neighbour.
        end, last = 0, dr.zeros(t.Bool, 1)
        for rows in sheets:
            end += rows
            last |= row == end - 1
        below = dr.select(last, 0, t.UInt(columns))
        right = dr.select(column == columns - 1, 0, t.UInt(1))
        corners = [packet(nodes, lane + step, self._stored) for step in (0, right, below, below + right)]
        first, second = [], []
        for v, at_right, at_below, at_both in zip(*corners, strict=True):
            v_x, v_y = at_right - v, at_below - v
            first.append(packed(v, at_both - at_below - v_x, TWIST_BITS))
            second.append(packed(v_x, v_y, SLOPE_BITS))
        self.words = stored(first + second, lane, 2 * self._stored)

    @classmethod
    def of(cls, words: Any, count: int, columns: int) -> Cells:
        """The cells of ``count`` values that have these ``words``."""
        cells = cls.__new__(cls)
        cells.columns, cells.count, cells.words = columns, count, words
        cells._stored = 1 << (count - 1).bit_length()
        return cells

    @property
    def nbytes(self) -> int:
        """Bytes of the table."""
        return 4 * dr.width(self.words)

    def at(self, row: Any, y: Any, column: Any, x: Any) -> list[Any]:
        """The N values at the fractions ``y``, ``x`` of the cell that begins at node ``row``, ``column`` (Ints)."""
        cell = types().UInt(dr.fma(row, self.columns, column))
        words = packet(self.words, cell, 2 * self._stored)[: self._stored + self.count]
        found = []
        for first, second in zip(words, words[self._stored :], strict=False):
            twist, slope = last_bits(first, TWIST_BITS), last_bits(second, SLOPE_BITS)
            found.append(dr.fma(dr.fma(twist, x, slope), y, dr.fma(second, x, first)))
        return found


def packed(first: Any, second: Any, bits: int) -> Any:
    """Floats near ``first`` whose last ``bits`` bits are the first bits of floats near ``second``."""
    t = types()
    low = t.Int((dr.reinterpret_array(t.UInt, second) + (1 << (31 - bits))) >> (32 - bits))
    word = dr.reinterpret_array(t.Int, first)
    # Of all floats with these last bits the nearest, in size: integers order floats.
    size = dr.maximum((word & 0x7FFFFFFF) - low + (1 << (bits - 1)), 0) >> bits << bits | low
    return dr.reinterpret_array(t.Float, size | word & t.Int(-0x80000000))


def last_bits(word: Any, bits: int) -> Any:
    """The second of the two floats in a word of :func:`packed`."""
    t = types()
    return dr.reinterpret_array(t.Float, dr.reinterpret_array(t.UInt, word) << (32 - bits))
