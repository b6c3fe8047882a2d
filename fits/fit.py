"""The fit: from observations and a configuration to values, errors, and what they are worth.

>>> from atmo_jit.fits import FitConfig, fit, load_observations
>>> result = fit(load_observations("scan.npz"), FitConfig.load("fit.toml"))  # doctest: +SKIP
>>> result.parameters["mie.phase.g"]["value"]  # doctest: +SKIP

In steps, each from where the one before ended: a part of the samples; with a robust loss, once more with the scale of
the residuals that were left; all samples, on nodes placed for the atmosphere found. Where the end is poor, other
starting values are tried.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from atmo_jit.errors import InputError
from atmo_jit.wavelengths import at_wavelengths

from .config import FitConfig
from .observations import Observations
from .optimise import STEP_TOLERANCE, Residuals, Solution, minimise
from .problem import HUBER, Evaluation, Problem, without_darkness
from .uncertainty import Uncertainty, uncertainty

FEW = 300  # samples (directions) that the first steps look at
UNIT_FACTOR = 30.0  # between data and sky at the start, from which on the units are suspected
POOR = 5.0  # residual over sigma, and
POOR_LOG = 0.15  # relative residual, above both of which other starting values are tried
RESTARTS = 3
MODEL_ERRS = 1.5  # variance of residuals over sigma from which on the model, and not noise, keeps them apart
LEAST_CLUSTERS = 6  # from which a scatter of means is known
FIRST_TOLERANCE = 0.5  # standard errors of the few samples within which the first steps end

Progress = Callable[[float], None]


@dataclass(frozen=True)
class Fit:
    """What :func:`fit` found: the ``problem`` and its ``u`` at the minimum, what was ``found`` there, ``errors``, how
    it went, and ``unseen``: the samples of directions that are masked altogether, and what the fit predicts there."""

    problem: Problem
    u: np.ndarray
    found: Evaluation
    errors: Uncertainty
    solution: Solution
    starts: int
    seconds: float
    dropped: int
    unseen: tuple[Observations, np.ndarray] | None

    @property
    def values(self) -> dict[str, float]:
        """Value of every scalar by name."""
        return dict(zip((s.name for s in self.problem.scalars), self.problem.values(self.u).tolist(), strict=True))


def fit(data: Observations, config: FitConfig, progress: Progress | None = None) -> Fit:
    """Fit the free values of ``config`` to ``data``. ``progress`` is called with an estimate of the fraction done.

    Raises InputError for data that cannot be fitted: fewer samples than unknowns, units that cannot be right.
    """
    started = time.perf_counter()
    air = at_wavelengths(config.atmosphere, data.wavelengths_nm)
    before = np.count_nonzero(data.used)
    if config.residual == "log":
        data = without_darkness(data)
    everything, data = data, data.part(np.flatnonzero(data.used.any(axis=1)))
    samples = int(np.count_nonzero(data.used))
    whole = Problem.of(replace(config, atmosphere=air), data)
    _check_count(whole, samples)
    whole.model.place(whole.atmosphere_values(whole.start))
    rows = _some(data, FEW)
    _check_units(whole.part(rows))
    report = _Report(progress)
    tries = []
    for start in _starting_points(whole):
        tries.append(_minimum(whole, rows, start, report))
        problem, u, solution = tries[-1]
        if solution.converged and not _poor(problem, u):
            break
        if len(tries) > RESTARTS:
            break
    # Poor ends are compared by their residuals, whose scale does not change with the loss.
    problem, u, solution = min(tries, key=lambda end: _scale(end[0].evaluate(end[1])))
    problem, u, solution = _polished(whole, u, report)
    found = problem.evaluate(u, jacobian=True)
    errors = uncertainty(problem, u, found)
    masked = everything.part(np.flatnonzero(~everything.used.any(axis=1)))
    unseen = None
    if len(masked.radiance):
        unseen = masked, Problem(problem.config, masked, problem.model.at(masked), problem.leaves).evaluate(u).predicted
    seconds = time.perf_counter() - started
    return Fit(problem, u, found, errors, solution, len(tries), seconds, int(before - samples), unseen)


class _Report:
    """Progress over all minimisations: every iteration takes a share of what is left."""

    def __init__(self, progress: Progress | None) -> None:
        self._progress, self._left, self.iterations = progress, 1.0, 0

    def __call__(self, iteration: int, cost: float) -> None:
        self.iterations += 1
        self._left *= 0.9
        if self._progress is not None:
            self._progress(1.0 - self._left)


End = tuple[Problem, np.ndarray, Solution]


def _minimum(whole: Problem, rows: np.ndarray, start: np.ndarray, report: _Report) -> End:
    """The minimum for some of the samples from one start; with its problem."""
    u = start
    for _ in range(3):
        if whole.model.strays(whole.atmosphere_values(u)) or u is start:
            whole.model.place(whole.atmosphere_values(u))
        problem = whole.part(rows)
        problem = problem.with_loss(*_loss(problem, u, first=u is start))
        solution = _solve(problem, u, report, FIRST_TOLERANCE)
        u = solution.u
        excess = _loss(problem, u)[1]
        if 0.7 < excess / problem.excess < 1.4 and not whole.model.strays(whole.atmosphere_values(u)):
            break
    return problem, u, solution


def _polished(whole: Problem, u: np.ndarray, report: _Report) -> End:
    """The minimum for all samples, on nodes for the atmosphere at ``u``."""
    whole.model.place(whole.atmosphere_values(u))
    problem = whole.with_loss(*_loss(whole, u))
    last = _solve(problem, u, report, STEP_TOLERANCE)
    return problem, last.u, replace(last, iterations=report.iterations)


def _solve(problem: Problem, u: np.ndarray, report: _Report, step_tolerance: float) -> Solution:
    functions = Residuals(
        lambda u: problem.evaluate(u).residual, lambda u: problem.evaluate(u, jacobian=True).jacobian
    )
    return minimise(
        functions, u, method=problem.config.optimiser, step_tolerance=step_tolerance, progress=report
    )


def _scale(found: Evaluation) -> float:
    """Robust standard deviation of the residuals over sigma."""
    return 1.4826 * float(np.nanmedian(np.abs(found.raw)))


def _loss(problem: Problem, u: np.ndarray, first: bool = False) -> tuple[float, float]:
    """d of the loss and the excess of the residuals at ``u``; at a start, which may be anywhere, no excess."""
    found = problem.evaluate(u)
    scale = _scale(found)
    huber = HUBER * max(1.0, scale) if problem.config.robust else np.inf
    raw = found.raw[problem.data.used]
    variance = scale**2 if problem.config.robust else float(raw @ raw) / len(raw)
    if first or variance < MODEL_ERRS:
        return huber, 1.0
    bounded = np.clip(raw / np.sqrt(variance), -3.0, 3.0)
    effects = [1.0]
    for cluster in problem.clusters():
        sizes = np.bincount(cluster)
        sizes, sums = sizes[sizes > 0], np.bincount(cluster, bounded)[sizes > 0]
        if len(sizes) >= LEAST_CLUSTERS:
            effects.append(float(np.mean(sums**2 / sizes) / np.mean(bounded**2)))
    return huber, variance * max(effects)


def _poor(problem: Problem, u: np.ndarray) -> bool:
    """Whether the model is far from the data, in sigma and in per cent."""
    found = problem.evaluate(u)
    with np.errstate(invalid="ignore"):
        relative = float(np.nanmedian(np.abs(found.predicted / problem.data.radiance - 1.0)))
    return _scale(found) > POOR and relative > POOR_LOG


def _starting_points(whole: Problem) -> list[np.ndarray]:
    """The start, then logarithmic scalars ten times larger and smaller and the others in the middle of their ranges."""
    points = [whole.start]
    for factor in (10.0, 0.1, 1.0):
        middle = [
            s.inner(s.start * factor) if s.logarithmic and not s.nuisance else 0.0 if s.bounded else s.inner(s.start)
            for s in whole.scalars
        ]
        points.append(np.array(middle))
    return points


def _some(data: Observations, count: int) -> np.ndarray:
    """At most ``count`` rows, spread evenly over the order of the data, as many of each scan as it has part."""
    total = len(data.radiance)
    if total <= 2 * count:
        return np.arange(total)
    rows = np.sort(np.random.default_rng(0).permutation(total)[:count])
    missing = [int(np.flatnonzero(data.scan == s)[0]) for s in range(data.scans) if not np.any(data.scan[rows] == s)]
    return np.union1d(rows, np.array(missing, int))


def _check_count(problem: Problem, samples: int) -> None:
    unknowns = sum(not np.isfinite(s.prior_sigma) for s in problem.scalars)
    if samples < max(unknowns, 1):
        raise InputError(
            f"observations: {samples} samples for {unknowns} unknowns without a prior; needed are at least {unknowns}"
        )


def _check_units(problem: Problem) -> None:
    """Raise InputError where data and sky are so far apart, with and without aerosol, that the unit must be wrong."""
    if any(s.positive and s.prior_sigma > 1.0 for s in problem.scalars):
        return  # the calibration is free: any unit will do
    ratios = []
    for factor in (1.0, 0.1, 10.0):
        u = [s.inner(s.start * (factor if s.logarithmic and not s.nuisance else 1.0)) for s in problem.scalars]
        predicted = problem.evaluate(np.array(u)).predicted
        ratios.append(float(np.nanmedian(problem.data.radiance / np.maximum(predicted, 1e-30))))
    ratio = min(ratios, key=lambda r: abs(np.log(max(r, 1e-30))))
    if not 1.0 / UNIT_FACTOR < ratio < UNIT_FACTOR:
        raise InputError(
            f"radiance: is {ratio:.3g} times that of the sky with the starting values; must be in W m^-2 sr^-1 nm^-1, "
            "as solar_irradiance in W m^-2 nm^-1 (or 1/sr where that is 1)"
        )
