"""Random atmospheres and views at the ends of what is allowed: what must hold in all of them, and by how much it fails.

    python -m bench.stress                                # 100,000 pairs of atmosphere and view, 2,000 derivatives
    python -m bench.stress --pairs 5000 --derivatives 0 --first 40      # from the 40th atmosphere on
    python -m bench.stress --per-world 2000 --markdown docs/limits.md

Every atmosphere has a number, from which it and its views follow (bench.extremes): a line of the result names the one
where a quantity is worst, and ``--first`` returns to it. Exit status 1 where a value is not finite or negative.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

import atmo_jit
from atmo_jit.backend import doubles
from atmo_jit.derivatives import OUTPUTS, Linearization
from atmo_jit.files import atomic_outputs, check_output
from atmo_jit.parameters import RADII, VIEWS, described, parameter_names
from atmo_jit.progress import progress_bar

from .extremes import extreme_views, extreme_world
from .monte_carlo import load_twins

PER_WORLD = 500  # views of one atmosphere
TWIN_VIEWS = 6  # of them compared with the twin, which is slow
TWIN_TOLERANCE = 1e-6  # to which it halves pieces of rays
SOLVES_EVERY = 4  # atmospheres: one in so many is solved several times
CLEAR = 5.0  # optical depth up to which the twin's quadrature is a truth for scattered light
FAINT = 1e-3  # of the brightest single scattering under the same sun: errors of fainter light are relative to this
Errors = dict[str, np.ndarray]

GRAZING = 1e-6  # planet radii
# Of the altitude: a ray whose perigee is nearer to the ground grazes it, and whether it meets it is for the rounding of
# its angle and of the radius to say.
UNDECIDED = 1e-7
SETTING = 5e-8  # radians: a sun that is a point counts as a disc of 1e-7

ABOUT = {
    "not finite": "radiance, transmittance, irradiances: values that are NaN or infinite (count)",
    "negative": "the same: values below 0 (count)",
    "transmittance above 1": "excess",
    "transmittance rises along a ray": "of two points of a ray, the farther one's excess",
    "mirror symmetry": "radiance at azimuth -phi against phi, relative",
    "reciprocity": "transmittance from x to y against y to x, difference",
    "additivity": "transmittance of a ray against the product of its two halves', difference",
    "zero distance": "radiance of a ray of no length, and what its transmittance lacks to 1",
    "linearity in solar irradiance": "radiance under 8 times the light over 8, relative to the brightest",
    "orders": "what two events or all lack to one event, relative to the brightest",
    "transmittance, twin": "difference from float64",
    "optical depth, twin": "relative difference, depths from 1e-3 to 10",
    "sun irradiance, twin": "difference over the solar irradiance",
    "single scattering, twin": f"relative, rays of optical depth up to {CLEAR:g}",
    "derivatives not finite": "entries of Jacobians and of pulled back weights (count)",
    "adjoint identity": "(<J v, w> - <v, J' w>) over the sum of the terms' sizes",
}
COUNTS = ("not finite", "negative", "derivatives not finite")


class Tally:
    """Errors by quantity: how many were looked at, the 99th percentile of all, the largest, and the number of the
    atmosphere that it is from."""

    def __init__(self) -> None:
        self._found: dict[str, list[np.ndarray]] = {}
        self._worst: dict[str, tuple[float, int]] = {}

    def add(self, number: int, errors: Mapping[str, Any]) -> None:
        """The errors found in an atmosphere."""
        for name, values in errors.items():
            values = np.ravel(np.asarray(values, float))
            self._found.setdefault(name, []).append(values)
            largest = float(np.max(values, initial=0.0))
            if name not in self._worst or largest > self._worst[name][0]:
                self._worst[name] = largest, number

    def rows(self) -> list[tuple[str, int, float, float, int]]:
        """(quantity, values, 99th percentile, worst, atmosphere)."""
        rows = []
        for name in ABOUT:
            if name in self._found:
                values = np.concatenate(self._found[name])
                most = float(values.sum()) if name in COUNTS else self._worst[name][0]
                high = 0.0 if not values.size else float(np.percentile(values, 99))
                rows.append((name, values.size, high, most, self._worst[name][1]))
        return rows

    def failed(self) -> bool:
        """Whether anything was not finite or negative."""
        return any(row[3] > 0 for row in self.rows() if row[0] in COUNTS)


class Solved:
    """A solved atmosphere, asked ray by ray."""

    def __init__(self, world: Mapping[str, Any], orders: int | None = None) -> None:
        self._sky = atmo_jit.Sky(world, orders)

    def rays(self, views: Mapping[str, np.ndarray], **options: Any) -> tuple[np.ndarray, np.ndarray]:
        """Radiance and transmittance [N, W]."""
        angles = [np.radians(views[name]) for name in ("sun_zenith_deg", "view_zenith_deg", "azimuth_deg")]
        light = self._sky.rays(views["altitude_m"], *angles, views["distance_m"], **options)
        return _stacked(light.radiance, angles[0]), _stacked(light.transmittance, angles[0])

    def irradiances(self, views: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Of the sun and of the sky, [N, W]."""
        sun = np.radians(views["sun_zenith_deg"])
        direct, scattered = self._sky.irradiance(doubles(views["altitude_m"]), doubles(sun))
        return _stacked(direct, sun), _stacked(scattered, sun)


def _stacked(values: list[Any], like: np.ndarray) -> np.ndarray:
    return np.stack([np.broadcast_to(v.numpy(), like.shape) for v in values], axis=-1).astype(float)


def check_world(
    world: Mapping[str, Any], views: dict[str, np.ndarray], twin: Any, *, solves: bool, compared: int = TWIN_VIEWS
) -> Errors:
    """Errors by quantity in one atmosphere. ``solves``: those too that need it solved several times; ``compared``: so
    many views are with the twin."""
    solved = Solved(world)
    arrays = [*solved.rays(views), *solved.irradiances(views)]
    errors: Errors = {
        "not finite": np.sum([(~np.isfinite(a)).sum() for a in arrays]),
        "negative": np.sum([(a < 0.0).sum() for a in arrays]),
        "transmittance above 1": np.maximum(arrays[1] - 1.0, 0.0),
    }
    errors |= _along(world, views, solved, arrays[0])
    errors |= of_twin(world, views, arrays, twin, compared)
    if solves:
        errors |= _of_solves(world, views, arrays[0])
    return errors


def _along(world: Mapping[str, Any], views: dict[str, np.ndarray], solved: Solved, radiance: np.ndarray) -> Errors:
    """What holds along rays: every tenth view, cut in two."""
    some = {name: values[::10] for name, values in views.items()}
    radius = world["bottom_radius_m"]
    h, mu = some["altitude_m"], np.cos(np.radians(some["view_zenith_deg"]))
    # To a point that a straight ray reaches without meeting the ground.
    near = np.minimum(np.where(np.isfinite(some["distance_m"]), some["distance_m"], radius), 0.5 * radius)
    perigee = h - (radius + h) * mu**2 / (1.0 + np.sqrt(1.0 - mu**2))
    near = np.where((mu < 0.0) & (perigee <= 0.0), np.minimum(near, 0.5 * h / np.maximum(-mu, 1e-9)), near)
    # Whether a ray grazes the ground or hits it, both ends can tell to single precision only.
    near = np.where((mu < 0.0) & (np.abs(perigee) < GRAZING * radius), 0.0, near)
    through, first = (solved.rays(some | {"distance_m": part * near})[1] for part in (1.0, 0.5))
    none = solved.rays(some | {"distance_m": 0.0 * near}, ground=False)
    mirrored, _ = solved.rays(some | {"azimuth_deg": -some["azimuth_deg"]})

    def place(d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Altitude (m) and zenith angle (degrees) of the ray at ``d``."""
        step = d * (2.0 * (radius + h) * mu + d)
        there = h + step / (radius + h + np.sqrt((radius + h) ** 2 + step))
        cosine = ((radius + h) * mu + d) / (radius + there)
        return np.maximum(there, 0.0), np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))

    far, turned = place(near)
    _, back = solved.rays(some | {"altitude_m": far, "view_zenith_deg": 180.0 - turned, "distance_m": near})
    middle, on = place(0.5 * near)
    _, second = solved.rays(some | {"altitude_m": middle, "view_zenith_deg": on, "distance_m": 0.5 * near})
    bright = np.maximum(radiance[::10], 1e-6 * np.max(world["solar_irradiance"]))
    return {
        "transmittance rises along a ray": np.maximum(through - first, 0.0),
        "mirror symmetry": np.abs(mirrored - radiance[::10]) / bright,
        "reciprocity": np.abs(back - through),
        "additivity": np.abs(first * second - through),
        "zero distance": np.abs(np.stack([none[0] / bright, none[1] - 1.0])),
    }


def of_twin(
    world: Mapping[str, Any], views: dict[str, np.ndarray], found: list[np.ndarray], twin: Any, count: int = TWIN_VIEWS
) -> Errors:
    """Differences from the quadrature twin, in double precision, of the first ``count`` views that can be compared."""
    altitude, cosine = views["altitude_m"], np.cos(np.radians(views["view_zenith_deg"]))
    perigee = altitude - (twin.radius + altitude) * cosine**2 / (1.0 + np.sqrt(1.0 - cosine**2))
    compared = (altitude < twin.top) & ~((cosine < 0.0) & (np.abs(perigee) < UNDECIDED * altitude))
    if twin.disc == 0.0:
        # A point of a sun on the horizon is up or down as the rounding decides.
        horizon = 0.5 * np.pi + np.arctan2(np.sqrt(altitude * (2.0 * twin.radius + altitude)), twin.radius)
        compared &= np.abs(np.radians(views["sun_zenith_deg"]) - horizon) > SETTING
    inside = np.flatnonzero(compared)[:count]
    some = {name: values[inside] for name, values in views.items()}
    if not inside.size:
        return {}
    sun, view, turn = (np.radians(some[f"{name}_deg"]) for name in ("sun_zenith", "view_zenith", "azimuth"))
    mu, mu_s = np.cos(view), np.cos(sun)
    nu = np.clip(mu * mu_s + np.sin(view) * np.sin(sun) * np.cos(turn), -1.0, 1.0)
    h, distance = some["altitude_m"], some["distance_m"]
    end = np.minimum(twin.limits(h, mu)[1], distance)
    depth = twin.optical_depth(twin.columns(h, mu, 0.0, end))
    through = found[1][inside]
    with np.errstate(divide="ignore"):
        seen = (depth > 1e-3) & (depth < 10.0)
        of_depth = np.abs(-np.log(through) / np.where(seen, depth, 1.0) - 1.0)[seen]
    errors = {
        "transmittance, twin": np.abs(through - np.exp(-depth)),
        "optical depth, twin": of_depth,
        "sun irradiance, twin": np.abs(found[2][inside] - twin.sun_irradiance(h, mu_s)) / twin.solar,
    }
    clear = depth.max(axis=1) < CLEAR
    if clear.any():
        rays = {name: values[clear] for name, values in some.items()}
        single, _ = Solved(world, 1).rays(rays, ground=False)
        want = twin.single_scattering(h[clear], mu[clear], mu_s[clear], nu[clear], distance[clear])
        least = np.maximum(FAINT * want.max(axis=0, initial=0.0), 1e-9 * twin.solar)
        errors["single scattering, twin"] = np.abs(single - want) / np.maximum(want, least)
    return errors


def _of_solves(world: Mapping[str, Any], views: dict[str, np.ndarray], whole: np.ndarray) -> Errors:
    brighter = {**world, "solar_irradiance": (8.0 * np.asarray(world["solar_irradiance"])).tolist()}
    bright, _ = Solved(brighter).rays(views)
    one, two = (Solved(world, n).rays(views)[0] for n in (1, 2))
    scale = np.maximum(whole.max(axis=0), 1e-30)
    lacking = np.maximum(one - two, one - whole)
    return {
        "linearity in solar irradiance": np.abs(bright / 8.0 - whole) / scale,
        "orders": np.maximum(lacking, 0.0) / scale,
    }


def check_derivatives(rng: Random, world: Mapping[str, Any], views: dict[str, np.ndarray], names: int) -> Errors:
    """The Jacobian by a few random parameters, and forward against reverse."""
    at = Linearization(world, views, tolerance=0.03)
    known = [name for name in parameter_names(at.atmosphere, views) if name not in RADII]
    chosen = sorted(rng.sample(known, min(names, len(known))))
    by = at.jacobian(chosen)
    noise = np.random.default_rng(rng.randrange(2**32))
    values = {n: np.asarray(at.views[n] if n in VIEWS else described(at.atmosphere, n), float) for n in chosen}
    # The end of a ray without end does not move.
    sizes = {n: 0.01 * np.where(np.isfinite(v), np.abs(v), 0.0) for n, v in values.items()}
    change = {n: noise.normal(size=size.shape) * size for n, size in sizes.items()}
    weights = {output: noise.normal(size=at.value[output].shape) for output in OUTPUTS}
    moved, pulled = at.jvp(change), at.vjp(weights, chosen)
    forward = sum(np.vdot(weights[output], moved[output]) for output in OUTPUTS)
    reverse = sum(np.vdot(change[name], pulled[name]) for name in chosen)
    sizes = sum(np.abs(weights[output] * moved[output]).sum() for output in OUTPUTS)
    return {
        "derivatives not finite": np.concatenate(
            [~np.isfinite(np.ravel(v)) for found in (by, moved, pulled) for v in found.values()]
        ).astype(float),
        "adjoint identity": abs(forward - reverse) / sizes if sizes > 0.0 else 0.0,
    }


def sweep(
    pairs: int,
    first: int = 0,
    per_world: int = PER_WORLD,
    advance: Callable[[float], None] | None = None,
    jobs: int = 1,
    compared: int = TWIN_VIEWS,
) -> Tally:
    """``pairs`` of atmosphere and view, from the atmosphere of number ``first`` on; ``jobs``: processes; ``compared``:
    views of each atmosphere that the twin integrates."""
    count = -(-pairs // per_world)
    errors_of = partial(_of_views, per_world=per_world, compared=compared)
    return _each(errors_of, range(first, first + count), Tally(), advance, jobs)


def _of_views(number: int, per_world: int, compared: int) -> Errors:
    rng = Random(number)
    world = extreme_world(rng)
    views = extreme_views(rng, world, per_world)
    twin = load_twins().Twin(world, tolerance=TWIN_TOLERANCE)
    return check_world(world, views, twin, solves=number % SOLVES_EVERY == 0, compared=compared)


def sweep_derivatives(
    checks: int,
    first: int = 0,
    tally: Tally | None = None,
    advance: Callable[[float], None] | None = None,
    jobs: int = 1,
) -> Tally:
    """``checks`` derivatives of a view by a parameter, 50 views and 4 parameters an atmosphere."""
    numbers = range(first, first + -(-checks // 200))
    return _each(_of_derivatives, numbers, tally or Tally(), advance, jobs)


def _of_derivatives(number: int) -> Errors:
    rng = Random(number)
    world = extreme_world(rng, widths=(1, 1, 3))
    return check_derivatives(rng, world, extreme_views(rng, world, 50), 4)


def _each(
    errors_of: Callable[[int], Errors],
    numbers: range,
    tally: Tally,
    advance: Callable[[float], None] | None,
    jobs: int,
) -> Tally:
    """The errors of every atmosphere, in the order of their numbers, by so many processes."""
    with ExitStack() as stack:
        if jobs > 1:
            # Not forked: threads of the back end would be missing.
            pool = stack.enter_context(ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")))
            found = pool.map(errors_of, numbers)
        else:
            found = map(errors_of, numbers)
        for i, (number, errors) in enumerate(zip(numbers, found, strict=True), 1):
            tally.add(number, errors)
            if advance:
                advance(i / len(numbers))
    return tally


def table(tally: Tally) -> str:
    """The rows as Markdown."""
    lines = ["| quantity | error | values | 99 % below | worst | atmosphere |", "|---|---|---|---|---|---|"]
    for name, values, high, worst, number in tally.rows():
        lines.append(f"| {name} | {ABOUT[name]} | {values} | {high:.2g} | {worst:.3g} | {number} |")
    return "\n".join(lines)


def main() -> int:
    """Run both sweeps and print their table."""
    parser = argparse.ArgumentParser(prog="python -m bench.stress", description=__doc__.partition("\n")[0])
    parser.add_argument("--pairs", type=int, default=100_000, help="of atmosphere and view (default: %(default)s)")
    parser.add_argument("--derivatives", type=int, default=2_000, help="by a parameter (default: %(default)s)")
    parser.add_argument("--first", type=int, default=0, help="number of the first atmosphere (default: %(default)s)")
    parser.add_argument("--per-world", type=int, default=PER_WORLD, help="views of each (default: %(default)s)")
    parser.add_argument("--twin", type=int, default=TWIN_VIEWS, help="of them with the twin (default: %(default)s)")
    parser.add_argument("--jobs", type=int, default=1, help="processes (default: %(default)s)")
    parser.add_argument("--markdown", type=Path, help="page whose table is replaced by this one")
    options = parser.parse_args()
    start = time.perf_counter()
    page = check_output(options.markdown, ".md") if options.markdown else None
    with progress_bar("pairs") as advance:
        tally = sweep(options.pairs, options.first, options.per_world, advance, options.jobs, options.twin)
    with progress_bar("derivatives") as advance:
        sweep_derivatives(options.derivatives, options.first, tally, advance, options.jobs)
    print(table(tally))
    print(f"{options.pairs} pairs, {options.derivatives} derivatives, {time.perf_counter() - start:.0f} s")
    if page:
        text = page.read_text(encoding="utf-8")
        head, _, rest = text.partition("| quantity |")
        tail = rest[rest.index("\n\n") :] if "\n\n" in rest else "\n"
        with atomic_outputs(page) as (part,):
            part.write_text(head + table(tally) + tail, encoding="utf-8")
    return int(tally.failed())


if __name__ == "__main__":
    sys.exit(main())
