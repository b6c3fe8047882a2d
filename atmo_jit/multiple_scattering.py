"""Multiple scattering by orders, on angular moments instead of a four-dimensional table.

Light that scatters again is needed only through the low harmonics of its angular distribution (Rayleigh needs l <= 2,
aerosol of asymmetry g as many as g^l takes to fade). So one order is a handful of moments per altitude and sun angle,
and the next follows by gathering along straight paths from every node.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import drjit as dr
import numpy as np

from . import noted
from .backend import floats
from .column import SunColumns
from .field import Field
from .gather import Gather
from .grid import Grid
from .optics import Optics
from .paths import directions_at
from .projection import Moments, Projection
from .recording import Recordings
from .refinement import Reference
from .remainder import Remainder, found, parted
from .resolution import Resolution
from .single_scattering import first_order
from .total import following, total_of

LEAST = 1e-6  # of the light: an order that is less says nothing of those that follow
AT_ONCE = 4  # orders computed before the sum is first extrapolated
FEW, LACKING = 16, 0.03  # orders after which so much of the light must not lack, if a few more are to do
REST = 0.1  # of what a sum of orders may lack, that the remainder may: another turn costs little


def solve(
    optics: Optics,
    columns: SunColumns,
    grid: Grid,
    resolution: Resolution,
    orders: int | None,
    tolerance: float,
    *,
    noting: bool = False,
) -> Field:
    """The field of the light of all orders below ``orders``: what may scatter or reflect once more on the way to an
    observer.

    ``orders``: scattering and reflection events in the final picture; None: all of them, summed by extrapolation as
    soon as that is steady to ``tolerance``; where that is not soon, those that follow are solved for at once
    (remainder.found). The field's sky irradiance counts one event more than its moments.
    ``noting``: the field gets what ``solve_again`` need not compute once more, Field.known.
    """
    steps = _Steps.of(optics, columns, grid, resolution)
    most = orders or resolution.orders
    values = optics.values(resolution.degrees, resolution.phase_degree)
    done = steps.start(values, min(AT_ONCE, most), noting=noting)
    later, tables = done["later"], [done["tables"]]
    probes = [steps.probe(light, done, n) for n, light in enumerate(later, 2)]
    weights = arriving = np.zeros((0, grid.shape[1], optics.channel_count))
    tail = rest = None
    for n in range(AT_ONCE, most + 1):
        if orders is None and later:
            weights, error = _extrapolated(np.stack(probes))
            arriving = weights
            if error < resolution.converged * tolerance:
                break
        if n == most or (orders is None and n >= FEW and error > LACKING):
            if orders is None and later:
                tail, rest = steps.remainder(values, done, later[-1], n, REST * resolution.converged * tolerance)
            break
        later.append(steps.step(values, done, later[-1], n + 1, noting=noting))
        tables.append(done["tables"])
        probes.append(steps.probe(later[-1], done, n + 1))
    if orders is not None and later:
        arriving = np.ones((len(later), grid.shape[1], optics.channel_count))
        weights = arriving.copy()
        weights[-1] = 0.0
    shares: list[Any] = [[floats(w), floats(a)] for w, a in zip(weights, arriving, strict=True)]
    if tail is not None:
        later.append(rest)
        shares = [[floats(np.ones_like(w)), floats(np.ones_like(w))] for w in [*weights, weights[0]]]
    extrapolated = noting and orders is None and tail is None
    parts, finishing = steps.finish(values, done, later, shares, noting=noting, extrapolated=extrapolated)
    if tail is not None:
        shares[-1] = {**tail, "shares": shares[-1]}
    field = _field(optics, columns, grid, resolution, done["reference"], parts, shares, orders)
    if noting:
        field.known = {name: done[name] for name in ("reference", "first", "of_first")} | {"later": later}
        field.known["tables"] = [table for some in tables for table in some]
        field.known["finishing"] = finishing
    return field


def first_again(
    optics: Optics, columns: SunColumns, grid: Grid, resolution: Resolution, known: dict[str, Any] | None
) -> Any:
    """The light of order 1 for values of the optics that carry derivatives. ``known``: see orders_again."""
    values = optics.values(resolution.degrees, resolution.phase_degree)
    return _Steps(optics, columns, grid, resolution).first(values, known)


def orders_again(
    optics: Optics,
    columns: SunColumns,
    grid: Grid,
    resolution: Resolution,
    shares: list[Any],
    known: dict[str, Any] | None,
    first: Any,
) -> dict[str, Any]:
    """The light of the orders that ``shares`` count, as solve_again takes it, for values of the optics that carry
    derivatives. ``known``: what a solve for these very values found (Field.known); ``first``: the light of order 1.
    Nothing in here waits for a result."""
    steps = _Steps(optics, columns, grid, resolution)
    values = optics.values(resolution.degrees, resolution.phase_degree)
    started = steps.started(values, first, len(shares) + 1, known, parted(shares)[1])
    return {**started, "finishing": known["finishing"]} if known else started


def solve_again(
    optics: Optics,
    columns: SunColumns,
    grid: Grid,
    resolution: Resolution,
    shares: list[Any],
    orders: int | None,
    done: dict[str, Any],
) -> Field:
    """The field for values of the optics that carry derivatives, given the ``shares`` of a field that was solved, and
    the light of the orders: nothing in here waits for a result."""
    values = optics.values(resolution.degrees, resolution.phase_degree)
    optics = optics.with_values(values)
    steps = _Steps(optics, columns, grid, resolution)
    counts, tail = parted(shares)
    extrapolated = orders is None and tail is None
    of_orders = (done[name] for name in ("reference", "first", "later"))
    known = done.get("finishing")
    parts = steps.finished(values, *of_orders, counts, extrapolated=extrapolated, known=known)
    return _field(optics, columns, grid, resolution, done["reference"], parts, shares, orders)


def _field(
    optics: Optics,
    columns: SunColumns,
    grid: Grid,
    resolution: Resolution,
    reference: Any,
    parts: tuple[Any, ...],
    shares: list[Any],
    orders: int | None,
) -> Field:
    moments, sky, reflected = parts
    if orders == 1:
        reflected = 0.0 * reflected  # the reflection would be the second event
    reference = Reference.of(grid, optics.channel_count, reference)
    field = Field(
        optics, columns, grid, reference, resolution.first_degree, moments, sky, reflected, scatters=orders != 1
    )
    field.shares = shares
    return field


_always_traced = False


@contextmanager
def traced() -> Iterator[None]:
    """Solves in this block are traced and not played back, for those who look at their kernels."""
    global _always_traced
    before, _always_traced = _always_traced, True
    try:
        yield
    finally:
        _always_traced = before


class _Steps:
    """The parts of a solve as functions of an atmosphere's values alone.

    Everything else is geometry that stays with the grid. A solve is a hundred small kernels, and tracing them costs
    more than running them; so from the second solve on a grid on they are recorded (dr.freeze) and played back. Not
    so where derivatives are wanted: they do not pass through a recording.
    """

    def __init__(self, optics: Optics, columns: SunColumns, grid: Grid, resolution: Resolution) -> None:
        self._optics, self._columns, self._grid, self._resolution = optics, columns, grid, resolution
        self._stages = [directions_at(grid, s.up, s.down) for s in resolution.stages]
        self._recordings = Recordings(grid)

    @classmethod
    def of(cls, optics: Optics, columns: SunColumns, grid: Grid, resolution: Resolution) -> _Steps:
        """Those kept with the grid for atmospheres of this make-up, unless the profiles carry derivatives."""
        if optics.profiles_differentiable:
            return cls(optics, columns, grid, resolution)
        return grid.kept(("steps", optics.make_up), lambda: cls(optics, columns, grid, resolution))

    def start(self, values: Any, count: int, *, noting: bool) -> dict[str, Any]:
        """Orders 1 to ``count``, the reference, what the next order needs, and all tables if they are noted."""

        def start(values: Any) -> dict[str, Any]:
            with noted.noting() as of_first:
                first = self.first(values)
            with noted.noting() as tables:
                done = self.started(values, first, count)
            return {**done, "of_first": of_first if noting else [], "tables": tables if noting else []}

        return self._run(("start", count, noting), start, values)

    def step(self, values: Any, done: dict[str, Any], light: Any, n: int, *, noting: bool) -> Any:
        """Order ``n`` from the one before."""
        stage, before = self._stage(n), self._stage(n - 1)
        if stage != before or n == 2:
            done["gather"] = None

        def step(*arguments: Any) -> tuple[Any, ...]:
            with noted.noting() as tables:
                light, gather = self._step(*arguments, n)
            return light, gather, tables if noting else []

        light, done["gather"], done["tables"] = self._run(
            ("step", stage, before, n == 2, done["gather"] is None, noting),
            step,
            values,
            done["reference"],
            done["gather"],
            light,
        )
        return light

    def remainder(
        self, values: Any, done: dict[str, Any], light: Any, n: int, tolerance: float
    ) -> tuple[dict[str, Any], Any]:
        """All orders after order ``n``, and what remainder.Remainder holds for them."""
        reference = Reference.of(self._grid, self._optics.channel_count, done["reference"])
        gather = self._gather(self._optics.with_values(values), reference, n + 1, done["gather"])
        return found(gather, self._project(n + 1), light, tolerance, self._run)

    def probe(self, light: Any, done: dict[str, Any], n: int) -> np.ndarray:
        """The moments of order ``n`` of degrees 0 and 1 with m = 0, [K, S, 2, channels], over the reference where that
        is brightest under the same sun.

        Not over each altitude's own: under a cloud, where order 1 hardly comes, the quotients of later orders are so
        large that they alone would count.
        """
        channels, (altitudes, suns) = self._optics.channel_count, self._grid.shape
        inverse = done["reference"]["inverse"].numpy().reshape(altitudes, len(self._grid.first_theta), -1)
        inverse = inverse[:, :: self._grid.first, :channels].min(axis=0)
        light = Moments(light, *self._degree(n), suns, channels)
        return np.swapaxes(light.numpy()[:, :2, :suns] * inverse, 1, 2)

    def finish(
        self,
        values: Any,
        done: dict[str, Any],
        later: list[Any],
        shares: list[Any],
        *,
        noting: bool,
        extrapolated: bool,
    ) -> tuple[Any, ...]:
        """What Field holds: moments, sky and reflected irradiance; and all tables if they are noted. ``extrapolated``:
        with shares that carry derivatives (total.following)."""

        def finish(*arguments: Any) -> tuple[Any, ...]:
            with noted.noting() as tables:
                parts = self.finished(*arguments, extrapolated=extrapolated)
            return parts, tables if noting else []

        key = "finish", len(later), noting, extrapolated
        return self._run(key, finish, values, done["reference"], done["first"], later, shares)

    def _run(self, key: Any, function: Callable[..., Any], *arguments: Any) -> Any:
        if _always_traced or self._optics.profiles_differentiable or dr.grad_enabled(arguments):
            return function(*arguments)
        return self._recordings.run(key, function, *arguments)

    def _stage(self, n: int) -> int:
        return min(n - 2, len(self._stages) - 1)

    def _degree(self, n: int) -> tuple[int, int]:
        """Highest l and m of an order."""
        r = self._resolution
        return (r.first_degree,) * 2 if n == 1 else (r.stages[self._stage(n)].degree, r.stages[self._stage(n)].most)

    def first(self, values: Any, known: dict[str, Any] | None = None) -> Any:
        """The light of order 1, traced."""
        optics, grid, r = self._optics.with_values(values), self._grid, self._resolution
        fine = directions_at(grid, r.first_up, r.first_down)
        project = Projection.at(grid, fine, *self._degree(1))
        with noted.knowing(known and known["of_first"]):
            light = first_order(optics, self._columns, grid, fine, r)
            return project(light, len(grid.first_theta), optics.channel_count).values

    def started(
        self,
        values: Any,
        first: Any,
        count: int,
        known: dict[str, Any] | None = None,
        tail: dict[str, Any] | None = None,
    ) -> dict[str, Any]:
        """The same from order 1, traced; with a ``tail``, what Remainder holds, the last of the ``count`` is all that
        follow."""
        if known is None:
            return self._started(values, first, count, None, tail, None)
        with noted.knowing(known["tables"]):
            return self._started(values, first, count, known["reference"], tail, tail and known["later"][-1])

    def _started(
        self, values: Any, first: Any, count: int, held: dict[str, Any] | None, tail: dict[str, Any] | None, rest: Any
    ) -> dict[str, Any]:
        optics, grid = self._optics.with_values(values), self._grid
        first = Moments(first, *self._degree(1), len(grid.first_theta), optics.channel_count)
        with noted.apart():
            reference = Reference.above(grid, first) if held is None else Reference.of(grid, first.channels, held)
        later, light, gather = [], first, None
        for n in range(2, count + (tail is None)):
            if gather is None or self._stage(n) != self._stage(n - 1):
                gather = self._gather(optics, reference, n, None, gather)
            light = self._next(gather, light, n)
            later.append(light.values)
        if tail is not None:
            with noted.apart():
                later.append(Remainder(gather, self._project(count), tail).after(light.values, rest))
        held = gather and gather.held
        return {"first": first.values, "reference": reference.held, "later": later, "gather": held}

    def _step(self, values: Any, reference: Any, gather: Any, light: Any, n: int) -> tuple[Any, Any]:
        optics, grid = self._optics.with_values(values), self._grid
        reference = Reference.of(grid, optics.channel_count, reference)
        suns = len(grid.first_theta) if n == 2 else grid.shape[1]
        gather = self._gather(optics, reference, n, gather)
        light = self._next(gather, Moments(light, *self._degree(n - 1), suns, optics.channel_count), n)
        return light.values, gather.held

    def _gather(
        self, optics: Optics, reference: Reference, n: int, held: Any, like: Gather | None = None
    ) -> Gather:
        stage, r = self._stage(n), self._resolution
        s = r.stages[stage]
        return Gather(optics, self._grid, reference, self._stages[stage], s.azimuths, s.most, r.nodes, held, like)

    def _next(self, gather: Gather, light: Moments, n: int) -> Moments:
        return self._project(n)(gather(light), self._grid.shape[1], light.channels)

    def _project(self, n: int) -> Projection:
        return Projection.at(self._grid, self._stages[self._stage(n)], *self._degree(n))

    def finished(
        self,
        values: Any,
        reference: Any,
        first: Any,
        later: list[Any],
        shares: list[Any],
        *,
        extrapolated: bool,
        known: list[Any] | None = None,
    ) -> tuple[Any, ...]:
        """The same, traced."""
        if known is not None:
            with noted.knowing(known):
                return self.finished(values, reference, first, later, shares, extrapolated=extrapolated)
        optics, grid = self._optics.with_values(values), self._grid
        channels = optics.channel_count
        reference = Reference.of(grid, channels, reference)
        first = Moments(first, *self._degree(1), len(grid.first_theta), channels)
        rest = [Moments(v, *self._degree(n), grid.shape[1], channels) for n, v in enumerate(later, 2)]
        if extrapolated:
            shares = following(grid, reference, rest, shares)
        return total_of(optics, self._columns, grid, reference, first, rest, shares)


def _extrapolated(orders: np.ndarray) -> tuple[np.ndarray, float]:
    """Weights [N, S, size] of the N orders [N, K, S, moments, size] whose sum is closest to that of all orders, and its
    error.

    Reduced-rank extrapolation (Eddy 1979; Sidi 1991), per sun and channel: among the combinations sum_j gamma_j x_j,
    sum gamma_j = 1, of the partial sums x_j, the one whose residual sum_j gamma_j u_{j+1} (u: the orders) is
    smallest. With two orders it is the geometric tail; it is GMRES for the fixed point, and in a thick conservative
    cloud some tens of orders do the work of hundreds. What the sum lacks is the sum of all orders that follow from the
    residual. Each is about rho times the one before, with rho the ratio of the last two orders, the largest under any
    sun: so the error is the norm of the residual over that of the sum and over 1 - rho, the largest over suns and
    channels that have light.
    """
    count, _, suns, _, size = orders.shape
    u = np.ascontiguousarray(np.moveaxis(orders, (2, 4), (0, 1)).reshape(suns, size, count, -1), dtype=np.float64)
    products = u @ np.swapaxes(u, -1, -2)
    norms = np.sqrt(np.einsum("scii->sci", products))
    # Orders of one length: the late ones are faint beside the first, and it is they that count.
    scale = 1.0 / np.where(norms > 0.0, norms, 1.0)
    # A gram matrix of float32 data knows nothing below 1e-10.
    gram = products * scale[..., :, None] * scale[..., None, :] + 1e-10 * np.eye(count)
    gamma = scale * np.linalg.solve(gram, scale[..., None] / scale.max(axis=-1)[..., None, None])[..., 0]
    gamma = gamma / gamma.sum(axis=-1, keepdims=True)
    # x_j holds the orders before the j-th, so an order counts in every later partial sum.
    weights = 1.0 - np.cumsum(gamma, axis=-1)

    def norm(combination: np.ndarray) -> np.ndarray:
        return np.sqrt(np.maximum(np.einsum("sci,scij,scj->sc", combination, products, combination), 0.0))

    residual, whole = norm(gamma), norm(weights) + norms[..., 0]
    weights = weights + gamma  # the residual is the next term of the sum: take it too
    last, before = norms[..., -1], norms[..., -2]
    counts = (before > 0.0) & (last > LEAST * whole)
    ratio = np.divide(last, before, out=np.zeros_like(last), where=counts).max(axis=0)
    error = np.divide(residual, whole, out=np.zeros_like(residual), where=whole > 0.0).max(axis=0)
    error = np.where(ratio < 1.0, error / np.where(ratio < 1.0, 1.0 - ratio, 1.0), np.inf)
    return np.moveaxis(weights, -1, 0), float(error.max())
