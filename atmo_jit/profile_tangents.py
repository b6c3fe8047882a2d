"""How tables that follow from the profiles and the sun's size alone change with those.

Columns of matter and the visible part of the sun know of no coefficient and no wavelength: they are kept with the grid,
and so are their derivatives by the few numbers that profiles have. Backwards such a derivative is a sum of products,
where otherwise what made the table would run once more, backwards.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import drjit as dr

from . import noted
from .backend import packet, row_size, scattered, types
from .kept import Keeper
from .optics import Optics

SUN = -1  # owner of a column that depends on the sun's size


@dataclass
class Part:
    """Derivative ``values`` [rows] of one ``column`` of table number ``table`` by number ``number`` of all that Optics
    has of profiles and sun."""

    number: int
    table: int
    column: int
    values: Any


def few_numbers(optics: Optics) -> bool:
    """Whether every profile is made from single numbers: the nodes of a tabulated one are too many."""
    return all(len(number) == 1 for numbers in optics.profiles for number in numbers)


def following_profiles(
    optics: Optics,
    keeper: Keeper,
    key: Any,
    owners: Sequence[Sequence[int]],
    make: Callable[[Optics], list[Any]],
    first: Callable[[], list[Any]] | None = None,
) -> list[Any]:
    """Tables that ``make`` returns for optics, kept under ``key`` with a ``keeper`` that is for these profiles alone;
    they carry derivatives where the profiles or the sun's size of ``optics`` do.

    ``owners``, per table and column: the constituent on whose profile alone it depends, or SUN. ``first``: makes the
    same tables without derivatives.
    """
    if optics.profiles_differentiable and not few_numbers(optics):
        with noted.apart():
            return make(optics)
    with dr.suspend_grad():
        tables = keeper.kept(key, first or (lambda: make(optics)))
    if not optics.profiles_differentiable:
        return tables
    parts = keeper.kept(("tangents", key), lambda: tangents(optics, owners, make))
    sizes = [row_size(len(columns)) for columns in owners]
    return dr.custom(_operation(), _numbers(optics), tables, sizes, parts)


def _numbers(optics: Optics) -> list[Any]:
    return [number for numbers in (*optics.profiles, [optics.sun_radius]) for number in numbers]


def tangents(optics: Optics, owners: Sequence[Sequence[int]], make: Callable[[Optics], list[Any]]) -> list[Part]:
    """Derivatives of the tables: see following_profiles.

    One column has one owner: so one step of a number of every profile serves all columns.
    """
    t = types()
    given = [*optics.profiles, [optics.sun_radius]]
    first = [sum(len(group) for group in given[:k]) for k in range(len(given))]
    parts = []
    for place in range(max(len(group) for group in given)):
        groups = [[t.Float(dr.detach(number)) for number in group] for group in given]
        leaves = [number for group in groups for number in group]
        dr.enable_grad(leaves)
        tables = make(optics.with_values({"profiles": groups[:-1], "sun_radius": groups[-1][0]}))
        for group in groups:
            for i, number in enumerate(group):
                dr.set_grad(number, dr.opaque(t.Float, float(i == place), 1))
        dr.enqueue(dr.ADMode.Forward, leaves)
        dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearEdges)  # a table may follow from another
        for i, (columns, table) in enumerate(zip(owners, tables, strict=True)):
            size = row_size(len(columns))
            rows = packet(dr.grad(table), dr.arange(t.UInt, dr.width(table) // size), size)
            parts += [
                Part(first[k] + place, i, column, rows[column])
                for column, k in enumerate(columns)
                if place < len(given[k])
            ]
        dr.eval([part.values for part in parts])
    return parts


@lru_cache(maxsize=1)
def _operation() -> type:
    class FollowingProfiles(dr.CustomOp):
        def eval(self, numbers: list[Any], tables: list[Any], sizes: list[int], parts: list[Part]) -> list[Any]:
            self.count, self.sizes, self.parts = len(numbers), sizes, parts
            self.rows = [dr.width(table) // size for table, size in zip(tables, sizes, strict=True)]
            return list(tables)

        def forward(self) -> None:
            t, steps, grads = types(), self.grad_in("numbers"), []
            for i, (rows, size) in enumerate(zip(self.rows, self.sizes, strict=True)):
                columns = [dr.zeros(t.Float, rows) for _ in range(size)]
                for part in (part for part in self.parts if part.table == i):
                    columns[part.column] = dr.fma(steps[part.number], part.values, columns[part.column])
                grads.append(scattered(columns, dr.arange(t.UInt, rows), size))
            dr.eval(grads)
            self.set_grad_out(grads)

        def backward(self) -> None:
            t, grads = types(), self.grad_out()
            dr.eval(grads)
            columns = [
                packet(grad, dr.arange(t.UInt, rows), size)
                for grad, rows, size in zip(grads, self.rows, self.sizes, strict=True)
            ]
            found = [dr.zeros(t.Float, 1) for _ in range(self.count)]
            for part in self.parts:
                found[part.number] += dr.sum(columns[part.table][part.column] * part.values)
            self.set_grad_in("numbers", found)

        def name(self) -> str:
            return "following profiles"

    return FollowingProfiles
