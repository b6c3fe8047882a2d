"""The outputs of a sky as one function that derivatives pass through, recorded where it is asked for again."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

import drjit as dr
import numpy as np

from . import noted
from ._trees import flat, like
from .backend import doubles, evaluated, traversing, types
from .batches import Batches
from .parameters import VIEWS
from .profile_tangents import few_numbers
from .recording import Recordings, copied, give_back
from .solved import Sky

OUTPUTS = ("radiance", "transmittance", "sun_irradiance", "sky_irradiance")


class Evaluation:
    """The outputs of a sky as a function of values, views, pieces of their rays, and what the solve left: shares of the
    orders, and tables that are known.

    It and its derivatives are recorded (dr.freeze) where they are asked for more than once: tracing costs several
    times what running does.
    """

    def __init__(self, sky: Sky, options: dict[str, Any]) -> None:
        self._sky, self._options = sky.unlit(), options
        self._recordings = Recordings(sky.grid)
        self._recorded = all(optics.phase_kinds is not None for optics in (band.optics for band in sky.solutions))

    def __call__(self, *arguments: Any) -> list[Any]:
        """All outputs, one Float [N] each, in the order of OUTPUTS and wavelengths."""

        def function(values: Any, views: Any, pieces: Any, solved: Any) -> list[Any]:
            return self._outputs(self._again(values, solved), views, pieces)

        return self._run("value", function, *arguments)

    def forward(self, *arguments: Any) -> tuple[list[Any], list[Any]]:
        """Outputs, and how they change along ``values`` and ``views``, the last two arguments (None: not at all)."""
        *_, values, views = arguments
        return self._run(("forward", values and tuple(values[0]), views is None), self._forward, *arguments)

    def reverse(self, *arguments: Any) -> tuple[list[dict[str, Any]], dict[str, list[Any]]]:
        """Derivatives of the sum of weighted outputs, by the values and views named in the last two arguments; before
        them the weights, W Floats [N] by output. Those by views come in parts, one after the other, and may end with
        some that are of no view."""
        values, views, pieces, solved, weights, of_values, of_views = arguments
        key = (tuple(weights), *of_values, *of_views)
        # Look-ups of columns carry the derivatives by few numbers of profiles, their table those by many.
        many = not all(few_numbers(band.optics) for band in self._sky.solutions)
        by_columns = "profiles" in of_values and many and all(band["columns"] is not None for band in solved)

        def leaves(values: Any, solved: Any) -> tuple[Any, Any]:
            tables = [band["columns"] for band in solved]
            return _named(values, of_values), [type(table)(table) for table in tables] if by_columns else tables

        def of_field(values: Any, views: Any, pieces: Any, solved: Any, weights: Any) -> tuple[Any, ...]:
            """Derivatives by values, columns, views, and the light of order 1 and of the later ones."""
            values, views = copied(values), copied(views)
            own, tables = leaves(values, solved)
            orders = copied([band["orders"] for band in solved])
            lights = [[band[name] for band in orders] if of_values else [] for name in ("first", "later")]
            wanted = own, tables if by_columns else [], {name: views[name] for name in of_views}, *lights
            dr.enable_grad(wanted)
            sky = self._sky.again(values, [band["shares"] for band in solved], tables, orders)
            return _pulled_back(self._outputs(sky, views, pieces, tuple(weights)), flat(weights), wanted)

        def of_later(values: Any, solved: Any, weights: Any) -> tuple[Any, ...]:
            """Derivatives by values, columns and order 1, of the light of the later orders."""
            values, first = copied(values), copied([band["known"]["first"] for band in solved])
            own, tables = leaves(values, solved)
            wanted = own, tables if by_columns else [], first
            dr.enable_grad(wanted)
            orders = self._orders(values, solved, tables, first)
            return _pulled_back(flat([band["later"] for band in orders]), flat(weights), wanted)

        def of_first(values: Any, solved: Any, weights: Any) -> tuple[Any, ...]:
            """Derivatives by values and columns, of the light of order 1."""
            values = copied(values)
            own, tables = leaves(values, solved)
            wanted = own, tables if by_columns else []
            dr.enable_grad(wanted)
            light = self._sky.first_again(values, tables, [band["known"] for band in solved])
            return _pulled_back(light, weights, wanted)

        def of_columns(values: Any, known: Any, weights: Any) -> Any:
            """Derivatives by values, of the columns."""
            values = copied(values)
            wanted = _named(values, of_values)
            dr.enable_grad(wanted)
            return _pulled_back(self._sky.columns_again(values, known), weights, wanted)

        def tables_of(values: Any, solved: Any) -> tuple[Any, list[Any]]:
            """The tables of look-ups, and all that was evaluated for them."""
            tables = [band["columns"] for band in solved]
            sky = self._sky.again(values, [band["shares"] for band in solved], tables, [b["orders"] for b in solved])
            with noted.noting() as notes:
                return [band.field.tables for band in sky.solutions], list(notes)

        def of_rays(values: Any, whole: Any, solved: Any, look_ups: Any, begin: Any) -> tuple[Any, ...]:
            """Derivatives by values, columns, views, and the tables of look-ups, of the views of a batch."""
            views, pieces, weights = batches.taken(begin, *whole)
            values, look_ups = copied(values), copied(look_ups)
            own, tables = leaves(values, solved)
            wanted = own, tables if by_columns else [], {n: views[n] for n in of_views}, look_ups if of_values else []
            dr.enable_grad(wanted)
            dr.disable_grad([part["guide"] for part in look_ups])  # guides only
            sky = self._sky.looked_up(values, tables, look_ups)
            return _pulled_back(self._outputs(sky, views, pieces, tuple(weights)), flat(weights), wanted)

        def of_tables(values: Any, solved: Any, notes: list[Any], look_ups: Any) -> tuple[Any, ...]:
            """Derivatives by values, columns, and the light of order 1 and of the later ones, of the tables."""
            values, orders = copied(values), copied([band["orders"] for band in solved])
            own, tables = leaves(values, solved)
            wanted = own, tables if by_columns else [], *([b[name] for b in orders] for name in ("first", "later"))
            dr.enable_grad(wanted)
            sky = self._sky.again(values, [band["shares"] for band in solved], tables, orders)
            with noted.knowing(notes):
                made = [band.field.tables for band in sky.solutions]
            return _pulled_back(flat(made), flat(look_ups), wanted)

        # Several recordings: what one needs in between is free when it has been played.
        small = [{**band, "known": None, "orders": _orders_of(band["known"])} for band in solved]
        batches = self._batches(views, pieces)
        if batches is None:
            found, tables, by_views, first, later = self._run(
                ("reverse", *key), of_field, values, views, pieces, small, weights
            )
            by_views = [by_views]
            self._between()
        else:
            look_ups, notes = self._run("tables", tables_of, values, small)
            bare, sums, by_views = [{"columns": band["columns"]} for band in solved], None, []
            for begin in batches.begins():
                whole = views, pieces, weights
                *more, part, by_tables = self._run(("rays", *key), of_rays, values, whole, bare, look_ups, begin)
                by_views.append(part)
                sums = [*more, by_tables] if sums is None else _sum(sums, [*more, by_tables])
                dr.eval(sums)
            self._between()
            if of_values:
                found, tables, by_tables = sums
                *more, first, later = self._run(("field", *of_values), of_tables, values, small, notes, by_tables)
                found, tables = _sum([found, tables], more)
        if of_values:
            sums = [found, tables]
            if flat(later):
                *more, again = self._run(("later", *of_values), of_later, values, solved, later)
                sums, first = _sum(sums, more), _sum(first, again)
                self._between()
            small = [{**band, "known": {"of_first": band["known"]["of_first"]}} for band in solved]
            found, tables = _sum(sums, list(self._run(("first", *of_values), of_first, values, small, first)))
            if by_columns:
                known = [band["columns"] for band in solved]
                found = _sum(found, self._run(("columns", *of_values), of_columns, values, known, tables))
            dr.eval(found)  # one by one each would be a kernel
        return found, {name: [part[name] for part in by_views] for name in of_views}

    def _batches(self, views: Any, pieces: Any) -> Batches | None:
        """Batches of the views, if they are many."""
        return Batches.of(dr.width(views["altitude_m"]), pieces)

    def _run(self, key: Any, function: Callable[..., Any], *arguments: Any) -> Any:
        with traversing():
            return self._recordings.run(key, function, *arguments) if self._recorded else function(*arguments)

    def _between(self) -> None:
        """What the arrays of a fine solve took is not kept for the next recording: it is much, and arrays there are of
        other sizes."""
        if self._sky.resolution.twice:
            give_back()

    def _outputs(
        self, sky: Sky, views: dict[str, Any], pieces: list[Any], wanted: Collection[str] = OUTPUTS
    ) -> list[Any]:
        place = where(views)
        light = sky.rays(*place, **self._options, pieces=pieces)
        horizontal = sky.irradiance(*place[:2]) if set(wanted) & set(OUTPUTS[2:]) else ([], [])
        zero = dr.zeros(types().Float, dr.width(place[0]))
        return _wanted(wanted, light.radiance, light.transmittance, *horizontal, zero)

    def _orders(
        self, values: list[Any], solved: list[Any], columns: list[Any], first: list[Any] | None = None
    ) -> list[dict[str, Any]]:
        shares, known = ([band[name] for band in solved] for name in ("shares", "known"))
        return self._sky.orders_again(values, shares, columns, known, first)

    def _again(self, values: list[Any], solved: list[Any]) -> Sky:
        columns = self._sky.columns_again(values, [band["columns"] for band in solved])
        shares = [band["shares"] for band in solved]
        return self._sky.again(values, shares, columns, self._orders(values, solved, columns))

    def _forward(
        self, values: Any, views: Any, pieces: Any, solved: Any, along_values: Any, along_views: Any
    ) -> tuple[list[Any], list[Any]]:
        values, views = copied(values), copied(views)
        pairs = [pair for name in along_views or () for pair in [(views[name], along_views[name])]]
        for made, steps in zip(values, along_values or (), strict=False):
            pairs += [pair for name in steps for pair in zip(flat(made[name]), flat(steps[name]), strict=True)]
        for leaf, _ in pairs:
            dr.enable_grad(leaf)
        outputs = self._outputs(self._again(values, solved), views, pieces)
        for leaf, step in pairs:
            dr.set_grad(leaf, step)
        dr.enqueue(dr.ADMode.Forward, *(leaf for leaf, _ in pairs))
        dr.traverse(dr.ADMode.Forward)
        changes = dr.grad(outputs)
        dr.eval(changes)
        return dr.detach(outputs), changes


class TableEvaluation(Evaluation):
    """The same for all combinations of view zenith angles and azimuths (radians) from one place under one sun, far
    faster than ray by ray (bundle.py); not recorded."""

    def __init__(
        self,
        sky: Sky,
        options: dict[str, Any],
        altitude_m: float,
        sun_zenith: float,
        view_zenith: np.ndarray,
        azimuth: np.ndarray,
    ) -> None:
        super().__init__(sky, options)
        self._recorded = False
        self._place, self._view_zenith, self._azimuth = (altitude_m, sun_zenith), view_zenith, azimuth

    def _batches(self, views: Any, pieces: Any) -> None:
        return None

    def _outputs(
        self, sky: Sky, views: dict[str, Any], pieces: None, wanted: Collection[str] = OUTPUTS
    ) -> list[Any]:
        t = types()
        altitude, sun_zenith = self._place
        ground = self._options["ground"]
        light = sky.table(altitude, self._view_zenith, sun_zenith, self._azimuth, ground=ground)
        lane = dr.arange(t.UInt, len(self._view_zenith) * len(self._azimuth))
        rows = lane // len(self._azimuth)
        transmittance = [dr.gather(t.Float, evaluated(v), rows) for v in light.transmittance]
        sun, scattered = sky.irradiance(*(doubles([v]) for v in self._place))
        zero = dr.zeros(t.Float, dr.width(lane))
        return _wanted(wanted, light.radiance, transmittance, sun, scattered, zero)


def _named(values: list[dict[str, Any]], names: Collection[str]) -> list[dict[str, Any]]:
    return [{name: part[name] for name in names} for part in values]


def _sum(tree: Any, other: Any) -> Any:
    return like(tree, [a + b for a, b in zip(flat(tree), flat(other), strict=True)])


def _orders_of(known: dict[str, Any]) -> dict[str, Any]:
    return {name: known[name] for name in ("reference", "first", "later", "finishing")}


def _pulled_back(outputs: list[Any], weights: list[Any], wanted: Any) -> Any:
    """Derivatives of the sum of weighted outputs by the leaves of ``wanted``, evaluated."""
    pairs = [(v, w) for v, w in zip(outputs, weights, strict=True) if dr.grad_enabled(v)]
    for output, weight in pairs:
        dr.set_grad(output, weight)
    dr.enqueue(dr.ADMode.Backward, *(output for output, _ in pairs))
    dr.traverse(dr.ADMode.Backward)
    adjoints = dr.grad(wanted)
    dr.eval(adjoints)
    return adjoints


def _wanted(wanted: Collection[str], *parts: Any) -> list[Any]:
    """The outputs wanted, evaluated together, all as wide as the last of the ``parts``."""
    *groups, zero = parts
    outputs = [v + zero for name, group in zip(OUTPUTS, groups, strict=True) if name in wanted for v in group]
    dr.eval(outputs)
    return outputs


def where(views: dict[str, Any]) -> list[Any]:
    """Arguments of Sky.rays."""
    degree = np.pi / 180.0
    return [views["altitude_m"], *(views[name] * degree for name in VIEWS[1:4]), views.get("distance_m")]
