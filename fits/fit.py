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
from .kept import Point, Report
from .observations import Observations
from .optimise import MAX_ITERATIONS, STEP_TOLERANCE, Residuals, Solution, minimise, steps_ahead
from .problem import HUBER, Evaluation, Problem, without_darkness
from .starts import check_count, check_units, few_of, fits, starting_points
from .uncertainty import Uncertainty, uncertainty

POOR = 5.0  # residual over sigma, and
POOR_LOG = 0.15  # relative residual, above both of which other starting values are tried
ROUNDS = 12  # of loss and weights, each of
FIRST_ITERATIONS = 10
LAST_ROUNDS = 3
STEPS_FORESEEN = 3
ALIKE = 1.1  # ratio of weights within which they are not worth another round
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


def fit(
    data: Observations,
    config: FitConfig,
    progress: Progress | None = None,
    keep: Callable[[Point], None] | None = None,
    begun: Point | None = None,
) -> Fit:
    """Fit the free values of ``config`` to ``data``. ``progress`` is called with an estimate of the fraction done.

    ``keep`` is called with every point from which another call can go on when it has ``begun`` there. That comes to the
    same minimum, to a part of the standard errors that ends a search (a tenth), since it does not know the Jacobians of
    the steps before.

    Raises InputError for data that cannot be fitted: fewer samples than unknowns, units that cannot be right; for a
    point of another fit.
    """
    started = time.perf_counter() - (begun.seconds if begun else 0.0)
    air = at_wavelengths(config.atmosphere, data.wavelengths_nm)
    before = np.count_nonzero(data.used)
    if config.residual == "log":
        data = without_darkness(data)
    everything, data = data, data.part(np.flatnonzero(data.used.any(axis=1)))
    samples = int(np.count_nonzero(data.used))
    whole = Problem.of(replace(config, atmosphere=air), data)
    check_count(whole, samples)
    few = few_of(whole)
    if config.optimiser == "levenberg_marquardt":
        for problem in (few, whole):
            steps_ahead(len(problem.scalars))
    if begun is None:
        few.model.place(few.atmosphere_values(few.start))
        check_units(few)
        begun = Point(0, (), tuple(few.start), tuple(few.start))
    elif not fits(begun, few, whole):
        raise InputError("begun: is a point of another fit")
    report = Report(progress, keep, begun, started)
    if begun.step == 0:
        _search(few, whole, report)
    step = max(begun.step, 1)
    end = _polished(whole, report)
    # Where the model errs more than the data, finer nodes show nothing.
    if step == 1 and end.problem.excess == 1.0 and whole.model.too_coarse(whole.atmosphere_values(end.solution.u)):
        report.reached(step=2, nodes=end.solution.u, u=end.solution.u)
        end = _polished(whole, report)
    problem, u, solution = end.problem, end.solution.u, end.solution
    found = replace(problem.evaluate(u), jacobian=solution.jacobian)
    errors = uncertainty(problem, u, found)
    masked = everything.part(np.flatnonzero(~everything.used.any(axis=1)))
    unseen = None
    if len(masked.radiance):
        unseen = masked, Problem(problem.config, masked, problem.model.at(masked), problem.leaves).evaluate(u).predicted
    seconds = time.perf_counter() - started
    starts = len(report.point.ends)
    return Fit(problem, u, found, errors, solution, starts, seconds, int(before - samples), unseen)


@dataclass(frozen=True)
class _End:
    """Where a minimisation ended, and of what."""

    problem: Problem
    solution: Solution

    @property
    def left(self) -> np.ndarray:
        """Residuals over sigma of the samples in use."""
        return self.problem.evaluate(self.solution.u).raw[self.problem.data.used]


def _search(few: Problem, whole: Problem, report: Report) -> None:
    """The best minimum for some of the samples, from where the report's point is and, where that ends poorly, from
    other starts; as the point from which all samples are looked at."""
    few.model.place(few.atmosphere_values(np.array(report.point.nodes)))
    ends = [np.array(end) for end in report.point.ends]
    for start in [np.array(report.point.u), *starting_points(few)[len(ends) + 1 :]]:
        report.reached(ends=ends, u=start)
        end = _minimum(few, start, report)
        ends.append(end.solution.u)
        if end.solution.converged and not _poor(end):
            break
    # Poor ends are compared by their residuals, whose scale does not change with the loss.
    best = whole.spread(few, min(ends, key=lambda u: _scale(few.evaluate(u).raw[few.data.used])))
    report.reached(step=1, ends=ends, nodes=best, u=best)


def _minimum(few: Problem, start: np.ndarray, report: Report) -> _End:
    """The minimum for some of the samples from one start; with a loss and weights that suit what is left there."""
    u, known = start, None
    for _ in range(ROUNDS):
        nodes = {}
        if few.model.strays(few.atmosphere_values(u)):
            few.model.place(few.atmosphere_values(u))
            known, nodes = None, {"nodes": u}
        report.reached(u=u, **nodes)
        problem = _weighed(few, u)
        solution = _solve(problem, u, report, FIRST_TOLERANCE, FIRST_ITERATIONS, known)
        u, known = solution.u, (solution.u, solution.jacobian)
        end = _End(problem, solution)
        if solution.converged and _alike(_weights(problem, end.left), (problem.huber, problem.excess)):
            break
    return end


def _polished(whole: Problem, report: Report) -> _End:
    """The minimum for all samples, on nodes for the atmosphere that the report's point names, and with weights at first
    for it, then for what is left at the minimum: where parameters do the same to the data, priors decide, whose weight
    against the data this is."""
    nodes, u = np.array(report.point.nodes), np.array(report.point.u)
    whole.model.place(whole.atmosphere_values(nodes))
    problem = _weighed(whole, nodes)
    last = _solve(problem, u, report, STEP_TOLERANCE)
    for _ in range(LAST_ROUNDS):
        weights = _weights(problem, _End(problem, last).left)
        if _alike(weights, (problem.huber, problem.excess)):
            break
        problem = problem.with_loss(*weights)
        last = _solve(problem, last.u, report, STEP_TOLERANCE, known=(last.u, last.jacobian))
    return _End(problem, replace(last, iterations=report.iterations))


def _weighed(problem: Problem, u: np.ndarray) -> Problem:
    """The problem with a loss for the residuals at ``u``, and weights for those that a step from there will leave: they
    may be far smaller, and with the weights of those at u priors would decide."""
    residuals, jacobian = problem.residuals(u), problem.jacobian(u)
    samples = int(np.count_nonzero(problem.data.used))
    huber, excess = _weights(problem, residuals[:samples])
    for _ in range(STEPS_FORESEEN):
        _, slope, curvature = problem.with_loss(huber, excess).loss(residuals)
        hessian = jacobian.T @ (curvature[:, None] * jacobian)
        step = -np.linalg.lstsq(hessian, jacobian.T @ slope, rcond=1e-12)[0]
        excess = _weights(problem, (residuals + jacobian @ step)[:samples])[1]
    return problem.with_loss(huber, excess)


def _alike(one: tuple[float, float], other: tuple[float, float]) -> bool:
    """Whether two losses and weights are close enough to each other to serve for each other."""
    return all(a == b or 1.0 / ALIKE < a / b < ALIKE for a, b in zip(one, other, strict=True))


def _solve(
    problem: Problem,
    u: np.ndarray,
    report: Report,
    enough: float,
    iterations: int = MAX_ITERATIONS,
    known: tuple[np.ndarray, np.ndarray] | None = None,
) -> Solution:
    return minimise(
        Residuals(problem.residuals, problem.jacobian, problem.loss, known),
        u,
        method=problem.config.optimiser,
        max_iterations=iterations,
        step_tolerance=enough,
        progress=report,
    )


def _scale(raw: np.ndarray) -> float:
    """Robust standard deviation of the residuals over sigma."""
    return 1.4826 * float(np.median(np.abs(raw)))


def _weights(problem: Problem, raw: np.ndarray) -> tuple[float, float]:
    """d of the loss and the excess for residuals over sigma of the samples in use."""
    scale = _scale(raw)
    huber = HUBER * max(1.0, scale) if problem.config.robust else np.inf
    variance = scale**2 if problem.config.robust else float(raw @ raw) / len(raw)
    if variance < MODEL_ERRS:
        return huber, 1.0
    bounded = np.clip(raw / np.sqrt(variance), -3.0, 3.0)
    effects = [1.0]
    for cluster in problem.clusters():
        sizes = np.bincount(cluster)
        sizes, sums = sizes[sizes > 0], np.bincount(cluster, bounded)[sizes > 0]
        if len(sizes) >= LEAST_CLUSTERS:
            effects.append(float(np.mean(sums**2 / sizes) / np.mean(bounded**2)))
    return huber, variance * max(effects)


def _poor(end: _End) -> bool:
    """Whether the model is far from the data, in sigma and in per cent, or not as close as it should be with a value
    without a prior at its bound: where searches end that went astray."""
    problem, u = end.problem, end.solution.u
    found, data = problem.evaluate(u), problem.data
    stuck = any(
        s.at_bound(v) and not np.isfinite(s.prior_sigma)
        for s, v in zip(problem.scalars, problem.values(u), strict=True)
    )
    if stuck and _scale(found.raw[data.used]) ** 2 > MODEL_ERRS:
        return True
    measured = data.radiance[data.used]
    relative = float(np.median(np.abs(found.predicted[data.used] - measured) / np.maximum(np.abs(measured), 1e-30)))
    return _scale(found.raw[data.used]) > POOR and relative > POOR_LOG
