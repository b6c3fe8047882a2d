"""All orders of scattering that follow, at once: in thick air that absorbs little thousands would be summed.

The remainder x = K u + K^2 u + ... after an order u solves x = K (u + x), K the step from one order to the next
(gather.Gather, projection.Projection). Were the light alike under neighbouring suns, K would couple nothing but
altitudes, and I - K for azimuthal order 0 be one matrix for all suns, I - K_0, which is inverted: M. What K_0 leaves
out, the turn of paths about the planet's centre and other azimuthal orders, is little. So Chebyshev iteration (Golub &
Varga 1961) for M (I - K) x = M K u ends after some turns, however thick the air.

Its coefficients being fixed beforehand, the iteration is a linear map, whose transposed is the same iteration with K'
and M'. So derivatives pass through the solution: (I - K)^-1 forwards, (I - K')^-1 backwards.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import drjit as dr
import numpy as np

from . import noted
from .backend import evaluated, floats, row, row_size, table, types
from .gather import Gather, harmonics_along
from .grid import Grid, cubic
from .projection import Moments, Projection, room
from .refinement import DEEPEST, STEEPEST

NEAREST = 0.25  # to 0 that an eigenvalue of M (I - K) is taken to come: sideways light in twilight
SPREAD = 0.25  # of the eigenvalues above 1, at least
POWERS = 8  # applications that tell the spread
MOST_TURNS = 40
STALLED = 10  # turns in which a correction has to halve: what does not is rounding
# Parts of the light that are taken to be absorbed: air so thick that less than that escapes is white in name only,
# rounding decides what becomes of its light.
ABSORBED = (0.0, 1e-6, 1e-5, 1e-4, 1e-3)
WILD = 1.1  # times the brightest light of the guide, which it is near: the iteration has grown instead of ending


class Remainder:
    """The equation for one atmosphere. ``gather``: the step of the orders that were summed, whose directions serve;
    ``held``: what :func:`found` made for this atmosphere or one close to it, in which no derivative is: ``matrix`` M
    [channels, n, n], ``log`` and ``inverse`` of a guide (see _Guide), ``kept`` [channels], what is not ABSORBED, and
    the coefficients ``turns`` of the iteration. ``made``: ``weights`` and ``scale`` that another of the same made.

    K is the gather without the cut at 0, since corrections have either sign.
    """

    def __init__(
        self, gather: Gather, project: Projection, held: dict[str, Any], made: dict[str, Any] | None = None
    ) -> None:
        self._project, self._held, self._grid = project, held, gather.grid
        self._channels = gather.optics.channel_count
        guide = _Guide(gather.grid, self._channels, held["log"], held["inverse"])
        self._gather = gather.signed(guide, made and made["scale"])
        weights = made["weights"] if made else gather.weights(project.degree)
        self.made = {"weights": weights, "scale": self._gather.held["scale"]}

    def moments(self, light: Any) -> Moments:
        """Light with its axes."""
        return Moments(light, self._project.degree, self._project.most, self._grid.shape[1], self._channels)

    def step(self, light: Any, weights: Any = None) -> Any:
        """K times ``light``."""
        weights = self.made["weights"] if weights is None else weights
        harmonics = self._gather.along(self.moments(light), weights)
        stepped = self._project(harmonics, self._grid.shape[1], self._channels).values
        t, suns = types(), self._grid.shape[1]
        lane = dr.arange(t.UInt, dr.width(stepped))
        # Places after the last sun stay empty.
        sun = lane // self._channels % room(suns)
        return stepped * dr.gather(t.Float, self._held["kept"], lane % self._channels, sun < suns)

    def after(self, light: Any, known: Any = None) -> Any:
        """The remainder after an order, with its derivatives; ``known``: its numbers."""
        if known is None:
            known = self.solved(evaluated(self._forwards(dr.detach(light))))
        if not dr.grad_enabled(light, self.made["weights"]):
            return known
        return dr.custom(_Solution, self.step(evaluated(light + known)), known, self)

    def solved(self, right: Any, *, transposed: bool = False) -> Any:
        """(I - K)^-1 times ``right``, or with K'."""
        step = self._backwards(dr.width(right)) if transposed else self._forwards
        light = correction = None
        for momentum, share in self._held["turns"]:
            light, correction = self.turn(right, light, correction, momentum, share, step, transposed=transposed)
        return light

    def turn(
        self,
        right: Any,
        light: Any,
        correction: Any,
        momentum: Any,
        share: Any,
        step: Callable[[Any], Any] | None = None,
        *,
        transposed: bool = False,
    ) -> tuple[Any, Any]:
        """Light and its correction after another turn of the iteration; None: there is none yet."""
        if light is not None:
            right = evaluated(right - light + (step or self._forwards)(light))
        new = share * self.preconditioned(right, transposed=transposed)
        correction = new if correction is None else dr.fma(momentum, correction, new)
        light = correction if light is None else light + correction
        light, correction = evaluated([light, correction])
        return light, correction

    def _forwards(self, light: Any) -> Any:
        return self.step(light, dr.detach(self.made["weights"]))

    def _backwards(self, width: int) -> Callable[[Any], Any]:
        """K' times a light, as the derivative of K backwards."""
        leaf = dr.zeros(types().Float, width)
        dr.enable_grad(leaf)
        stepped = self._forwards(leaf)

        def back(light: Any) -> Any:
            dr.set_grad(stepped, light)
            dr.enqueue(dr.ADMode.Backward, stepped)
            dr.traverse(dr.ADMode.Backward, dr.ADFlag.ClearInterior)
            found = dr.grad(leaf)
            dr.eval(found)
            dr.clear_grad(leaf)
            return found

        return back

    def preconditioned(self, light: Any, *, transposed: bool = False) -> Any:
        """M times a light, or M'."""
        t, of, degree, channels = types(), self.moments(light), self._project.degree, self._channels
        rows, suns = degree + 2, room(of.suns)
        size = self._grid.shape[0] * rows
        lane = dr.arange(t.UInt, size * suns * channels)
        per_row, end = dr.opaque(t.UInt, suns * channels, 1), dr.opaque(t.UInt, size, 1)
        own = lane // per_row
        channel = (lane - own * per_row) % channels
        sun = (lane - own * per_row) // channels
        of_row, of_column = (1, end) if transposed else (end, 1)
        first = channel * (end * end) + own * of_row

        def entry_of(place: Any) -> Any:
            return dr.select(place == degree + 1, t.UInt(of.entries - 1), place)

        def add(j: Any, total: Any) -> tuple[Any, Any]:
            k = j // rows
            value = dr.gather(t.Float, light, of.index(k, entry_of(j - k * rows), sun, channel))
            return j + 1, dr.fma(dr.gather(t.Float, self._held["matrix"], first + j * of_column), value, total)

        _, total = dr.while_loop(
            (t.UInt(0), dr.zeros(t.Float, dr.width(lane))),
            lambda j, _: j < end,
            add,
            max_iterations=-1,
            label="precondition",
        )
        place = own % rows
        values = dr.detach(light) + 0.0
        dr.scatter(values, total, of.index(own // rows, entry_of(place), sun, channel))
        return evaluated(values)


class _Solution(dr.CustomOp):
    """The solution x of x = K x + right, which is known, where the derivatives of x = ``stepped`` at fixed x are."""

    def eval(self, stepped: Any, known: Any, equation: Remainder) -> Any:
        self.equation = equation
        return type(known)(known)

    def forward(self) -> None:
        with noted.apart():
            self.set_grad_out(self.equation.solved(evaluated(self.grad_in("stepped"))))

    def backward(self) -> None:
        with noted.apart():
            self.set_grad_in("stepped", self.equation.solved(evaluated(self.grad_out()), transposed=True))

    def name(self) -> str:
        return "remainder"


class _Guide:
    """In the place of refinement.Reference, for light of many orders: it stands in its own logarithm, cubic between the
    solved suns. The reference of order 1 is steep in a cloud, and linear between its own finer suns: its kinks at the
    solved ones, where nearly all paths of a thick cloud end, make 1e-5 of the light at every order."""

    def __init__(self, grid: Grid, channels: int, log: Any, inverse: Any) -> None:
        self._grid, self._channels, self._log, self.inverse = grid, channels, log, inverse

    def index(self, k: Any, sun: Any, channel: Any) -> Any:
        """Place of ``inverse`` at an altitude node and a solved sun."""
        return (k * self._grid.shape[1] + sun) * row_size(self._channels) + channel

    def at(self, level: Any, x: Any) -> list[Any]:
        """The guide at a level and a sun coordinate, per channel."""
        t, suns = types(), self._grid.shape[1]
        s = dr.minimum(t.UInt(x), suns - 2)
        before = dr.select(s == 0, t.UInt(int(self._grid.whole_suns)), s - 1)
        places = [before, s, s + 1, dr.minimum(s + 2, suns - 1)]
        rows = [row(self._log, level * suns + place, self._channels) for place in places]
        taps = cubic(x - t.Float(s))
        sums = [sum(tap * values[c] for tap, values in zip(taps, rows, strict=True)) for c in range(self._channels)]
        return [dr.exp(value) for value in sums]

    @staticmethod
    def tables(light: np.ndarray) -> dict[str, Any]:
        """``log`` and ``inverse`` for the zeroth moments [K, S, channels] of a light."""
        log = np.log(np.maximum(light, 1e-30))
        for axis, steepest in ((1, STEEPEST), (0, DEEPEST)):
            log = np.moveaxis(log, axis, 0)
            apart = np.abs(np.subtract.outer(np.arange(len(log)), np.arange(len(log))))
            log = np.moveaxis((log[None] - steepest * apart[..., None, None]).max(axis=1), 0, axis)
        rows = log.reshape(-1, light.shape[2])
        return {"log": table(rows), "inverse": table(np.exp(-rows))}


def parted(shares: list[Any]) -> tuple[list[Any], dict[str, Any] | None]:
    """The shares of the orders (Field.shares), and what Remainder holds where the last is a remainder."""
    if not shares or not isinstance(shares[-1], dict):
        return shares, None
    return [*shares[:-1], shares[-1]["shares"]], shares[-1]


def joined(parts: list[tuple[dict[str, Any] | None, int, int]]) -> dict[str, Any]:
    """What Remainder holds for channels of several: per channel what one of them holds, its place in it, and how many
    channels that has. None: light of which there is no remainder, on which one does nothing."""
    some = [part for part in parts if part[0]]
    logs, matrices, kept = [], [], []
    for held, place, count in parts:
        of, at, among = (held, place, count) if held else some[0]
        logs.append(of["log"].numpy().reshape(-1, row_size(among))[:, at] * bool(held))
        matrix = of["matrix"].numpy().reshape(among, -1)[at]
        matrices.append(matrix if held else np.eye(int(np.sqrt(len(matrix)))).ravel())
        kept.append(of["kept"].numpy()[at])
    rows = np.stack(logs, axis=-1)
    widest = min((held for held, _, _ in some), key=lambda held: held["turns"][0][1].numpy()[0])
    return {
        "log": table(rows),
        "inverse": table(np.exp(-rows)),
        "matrix": floats(matrices),
        "kept": floats(kept),
        "turns": widest["turns"],
    }


def found(
    gather: Gather, project: Projection, light: Any, tolerance: float, run: Callable[..., Any]
) -> tuple[dict[str, Any], Any]:
    """What Remainder holds for an atmosphere, and the remainder after the order ``light``, to ``tolerance`` of itself.

    ``run``: runs a function of arrays under a key, recorded where it can be.
    """
    with noted.apart():
        upright = _upright(gather, project)
        taken = np.zeros(len(upright), int)
        while True:
            held, rest, grown = _iterated(gather, project, light, tolerance, run, *_inverted(project, upright, taken))
            wild = ~(grown < WILD) & (taken + 1 < len(ABSORBED))
            if not wild.any():
                return held, rest
            taken += wild


def _iterated(
    gather: Gather,
    project: Projection,
    light: Any,
    tolerance: float,
    run: Callable[..., Any],
    inverse: np.ndarray,
    kept: np.ndarray,
    upright: np.ndarray,
) -> tuple[dict[str, Any], Any, np.ndarray]:
    """The same with the matrices of _inverted, and the brightest light over that of the guide [channels]."""
    grid, channels = gather.grid, gather.optics.channel_count
    altitudes, suns = grid.shape
    last = Moments(light, project.degree, project.most, suns, channels)
    rows = [*range(project.degree + 1), last.entries - 1]
    whole = last.numpy()[:, rows].astype(float)
    # The guide needs not be exact: without the turn of paths it nearly is.
    flat = np.moveaxis(whole, -1, 0).reshape(channels, altitudes * len(rows), -1)
    total = flat + inverse @ (upright @ flat)
    zeroth = np.moveaxis(total.reshape(channels, altitudes, len(rows), -1)[:, :, 0, :suns], 0, -1)
    held = {
        **_Guide.tables(zeroth),
        "matrix": floats(inverse),
        "kept": floats(kept),
        "turns": [],
    }
    equation = Remainder(gather, project, held)
    over = held["inverse"].numpy().reshape(altitudes, suns, -1)[..., :channels]

    def size(values: Any) -> np.ndarray:
        """Largest zeroth moment [S, channels], over the guide."""
        return np.abs(equation.moments(values).numpy()[:, 0, :suns] * over).max(axis=0)

    def turn(own: Any, made: Any, *arguments: Any) -> tuple[Any, Any]:
        return Remainder(gather, project, own, made).turn(*arguments)

    def power(own: Any, made: Any, light: Any) -> Any:
        of = Remainder(gather, project, own, made)
        return evaluated(light - of.preconditioned(evaluated(light - of.step(light))))

    right = evaluated(equation.step(light))
    other, sizes = equation.preconditioned(right), []
    for _ in range(POWERS):
        sizes.append(float(size(other).max()))
        if sizes[-1] == 0.0:
            break
        other = evaluated(other / sizes[-1])
        other = run("power", power, held, equation.made, other)
    spread = max(SPREAD, 1.2 * float(np.mean(sizes[POWERS // 2 :])) if sizes[-1] else 0.0)
    light = correction = None
    errors: list[float] = []
    for momentum, share in _coefficients(NEAREST, 1.0 + spread):
        coefficients = [floats([momentum]), floats([share])]
        held["turns"].append(coefficients)
        own = {**held, "turns": []}
        light, correction = run(
            ("turn", light is None), turn, own, equation.made, right, light, correction, *coefficients
        )
        change, there = size(correction), size(light)
        errors.append(float(np.divide(change, there, out=np.zeros_like(change), where=there > 0.0).max()))
        stalled = len(errors) > STALLED and errors[-1] > 0.5 * errors[-1 - STALLED]
        if errors[-1] < tolerance or stalled or len(errors) == MOST_TURNS:
            break
    brightest = np.abs(equation.moments(light).numpy()[:, 0, :suns]).max(axis=(0, 1))
    return held, light, brightest / np.maximum(zeroth.max(axis=(0, 1)), 1e-30)


def _coefficients(lowest: float, highest: float) -> Iterator[tuple[float, float]]:
    """What the last correction counts in the next, and the residual, for eigenvalues between two bounds."""
    middle, half = 0.5 * (highest + lowest), 0.5 * (highest - lowest)
    ratio = half / middle
    yield 0.0, 1.0 / middle
    while True:
        new = 1.0 / (2.0 * middle / half - ratio)
        yield new * ratio, 2.0 * new / half
        ratio = new


def _inverted(
    project: Projection, upright: np.ndarray, taken: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """M [channels, n, n], what is not taken to be absorbed [channels], and K_0 (``upright``) less that; n counts
    altitudes and within them degrees and the irradiance. ``taken`` [channels]: the first of ABSORBED that may be taken,
    and afterwards the one that was.
    """
    channels, size, _ = upright.shape
    inverse, kept = np.empty_like(upright), np.ones(channels)
    zeroth = np.arange(0, size, project.degree + 2)
    for c in range(channels):
        for i in range(taken[c], len(ABSORBED)):
            taken[c], kept[c] = i, 1.0 - ABSORBED[i]
            inverse[c] = np.linalg.inv(np.eye(size) - kept[c] * upright[c])
            # Light makes light: where not, an eigenvalue of K_0 is beyond 1.
            if inverse[c][np.ix_(zeroth, zeroth)].sum(axis=1).min() > 0.0:
                break
    return inverse, kept, kept[:, None, None] * upright


def _upright(gather: Gather, project: Projection) -> np.ndarray:
    """K_0, float64 [channels, n, n]: K for azimuthal order 0 and light that is alike under all suns."""
    paths, channels, altitudes = gather.paths, gather.optics.channel_count, gather.grid.shape[0]
    rows, rays = project.degree + 2, len(paths.h)
    count = len(paths.station)
    basis = harmonics_along(paths, project.degree, 1).numpy().reshape(count, rows, -1)[..., :1]
    weights = gather.weights(project.degree).numpy().reshape(count, rows, -1) * basis
    place = paths.ray[paths.station] * altitudes + paths.level
    seen = np.empty((channels, rays, altitudes, rows))
    for c in range(channels):
        for l_ in range(rows):
            of_l = np.bincount(place, weights[:, l_, c].astype(float), rays * altitudes)
            seen[c, :, :, l_] = of_l.reshape(rays, altitudes)
    seen = seen.reshape(channels, altitudes, project.count, altitudes * rows)
    return 2.0 * np.pi * (project.upright() @ seen).reshape(channels, altitudes * rows, -1)
