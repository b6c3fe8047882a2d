"""Minimising a sum of squares with jaxopt, which stays behind this module.

Levenberg-Marquardt with Gauss-Newton's Hessian, and L-BFGS-B on the sum itself. The functions that are minimised run
on the host (they call Dr.Jit), so jaxopt runs one step at a time: that gives progress, and reasons.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

MAX_ITERATIONS = 60
# Part of the standard errors below which a step changes nothing that matters.
STEP_TOLERANCE = 0.1
LEAST_GAIN = 0.1
FAR = 1e6
FAILURES = 6  # steps, each shorter than the one before, that may raise the cost
TRUSTED = 2  # corrections of a Jacobian that is still believed where it says that nothing is left to gain
FORESEEN = 0.3  # part of a step's change that the Jacobian may have missed to be corrected and not computed
FARTHEST = 30.0  # u between which L-BFGS-B looks
UNKNOWN = 1e-14  # of the largest curvature, below which there is none
DAMPING = 1e-4  # at the start, of the largest square
COST_TOLERANCE = 1e-10  # relative decrease below which rounding decides

Progress = Callable[[int, float, np.ndarray], None]


@dataclass(frozen=True)
class Solution:
    """Where a minimisation ended: ``u`` [P], the sum of the loss ``cost``, ``iterations``, whether it ``converged``,
    the ``reason`` it stopped for, and the last ``jacobian`` [M, P], which is that of a point within a
    step of it."""

    u: np.ndarray
    cost: float
    iterations: int
    converged: bool
    reason: str
    jacobian: np.ndarray


class Residuals:
    """Residuals [M] and their Jacobian [M, P] as functions on the host, and the ``loss`` whose sum is minimised: of M
    residuals, with its slope and curvature.

    A Jacobian costs many times what residuals cost, so along a path of small steps it is not computed again but
    corrected by what the step has shown (Broyden 1965), as long as it had foreseen most of that. ``known``: a point and
    the Jacobian there or close by.
    """

    def __init__(
        self,
        residual: Callable[[np.ndarray], np.ndarray],
        jacobian: Callable[[np.ndarray], np.ndarray],
        loss: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]],
        known: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> None:
        self._residual, self._jacobian, self._loss = residual, jacobian, loss
        self._kept: dict[bytes, np.ndarray] = {}
        self._last = known
        self.corrections = 0

    def residual(self, u: Any) -> np.ndarray:
        """[M] at u; kept for the last points."""
        u = np.array(u, dtype=float)
        key = u.tobytes()
        if key not in self._kept:
            while len(self._kept) >= 4:
                self._kept.pop(next(iter(self._kept)))
            # A step too far may end where nothing is finite: bad, but a number.
            self._kept[key] = np.nan_to_num(self._residual(u), nan=FAR, posinf=FAR, neginf=-FAR)
        return self._kept[key]

    def jacobian(self, u: Any) -> np.ndarray:
        """[M, P] at u: corrected from the last point's, or exact."""
        u = np.array(u, dtype=float)
        if self._last is not None:
            before, jacobian = self._last
            step = u - before
            if not step.any():
                return jacobian
            foreseen = jacobian @ step
            missed = self.residual(u) - self.residual(before) - foreseen
            if np.linalg.norm(missed) < FORESEEN * np.linalg.norm(foreseen):
                self._last = u, jacobian + np.outer(missed, step / (step @ step))
                self.corrections += 1
                return self._last[1]
        return self.renewed(u)

    def renewed(self, u: Any) -> np.ndarray:
        """The exact Jacobian at u."""
        u = np.array(u, dtype=float)
        self._last, self.corrections = (u, np.nan_to_num(self._jacobian(u))), 0
        return self._last[1]

    @property
    def last_jacobian(self) -> np.ndarray:
        """The Jacobian that was asked for last."""
        return self._last[1]

    def cost(self, u: Any) -> float:
        """Sum of the loss at u."""
        return float(np.sum(self._loss(self.residual(u))[0]))

    def gradient(self, u: Any) -> np.ndarray:
        """Its derivatives [P]."""
        return self.jacobian(u).T @ self._loss(self.residual(u))[1]

    def small(self, u: Any, more: float) -> tuple[np.ndarray, np.ndarray]:
        """P + 1 residuals and their Jacobian [P + 1, P] whose least squares have the cost of all, and ``more``, its
        gradient g and, by the curvature of the loss, its Hessian H = V diag(w) V': sqrt(w) V', with w^-1/2 V' g.

        ``more`` has to be at least the cost: slope^2 / curvature is up to four times a robust loss.
        """
        jacobian = self.jacobian(u)
        loss, slope, curvature = self._loss(self.residual(u))
        w, v = np.linalg.eigh(jacobian.T @ (curvature[:, None] * jacobian))
        known = w > UNKNOWN * max(w[-1], 0.0)
        root = np.sqrt(np.where(known, w, 1.0))
        residual = np.where(known, v.T @ (jacobian.T @ slope) / root, 0.0)
        rest = np.sqrt(max(2.0 * (float(np.sum(loss)) + more) - float(residual @ residual), 0.0))
        return np.append(residual, rest), np.vstack([np.where(known, root, 0.0)[:, None] * v.T, np.zeros(len(w))])


def _jaxopt() -> tuple[Any, Any]:
    import jax

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "JAXopt is no longer maintained", DeprecationWarning)
        import jaxopt
    return jax, jaxopt


def minimise(
    functions: Residuals,
    start: np.ndarray,
    *,
    method: str = "levenberg_marquardt",
    max_iterations: int = MAX_ITERATIONS,
    step_tolerance: float = STEP_TOLERANCE,
    progress: Progress | None = None,
) -> Solution:
    """Minimise the sum of the loss from ``start``. ``step_tolerance``: a step that gains less than this part of the
    standard errors (root mean square over the unknowns) is the last. ``progress`` is called with iteration, the
    least cost so far, and where that is.
    """
    run = {"levenberg_marquardt": _levenberg_marquardt, "lbfgsb": _lbfgsb}[method]
    jax, _ = _jaxopt()
    with jax.enable_x64(True):
        return run(functions, np.asarray(start, float), max_iterations, step_tolerance, progress or (lambda *_: None))


class _Steps:
    """Levenberg-Marquardt's steps for P unknowns: Madsen & Nielsen, Introduction to Optimization and Data Fitting
    (2010), algorithm 6.18, as jaxopt has it; compiled once.

    It sees ``Residuals.small``, P + 1 rows whatever the number of samples, so that one compiled step serves all data.
    """

    def __init__(self, size: int) -> None:
        jax, jaxopt = _jaxopt()
        import jax.numpy as jnp

        self.functions: Residuals | None = None
        self.best = self._more = 0.0
        self._error: BaseException | None = None
        self._shapes = [jax.ShapeDtypeStruct(shape, jnp.float64) for shape in ((size + 1,), (size + 1, size))]

        @jax.custom_jvp
        def residual(u: Any) -> Any:
            return jax.pure_callback(lambda u: self._on_host(0, u), self._shapes[0], u)

        @residual.defjvp
        def along(primals: Any, tangents: Any) -> Any:
            (u,), (tangent,) = primals, tangents
            return residual(u), jax.pure_callback(lambda u: self._on_host(1, u), self._shapes[1], u) @ tangent

        self._solver = jaxopt.LevenbergMarquardt(
            residual, materialize_jac=True, solver="cholesky", jit=True, implicit_diff=False
        )
        self._state_type = type(jax.eval_shape(self._solver.init_state, jax.ShapeDtypeStruct((size,), jnp.float64)))

    def _on_host(self, which: int, u: Any) -> np.ndarray:
        """Small residuals (0) or Jacobian (1); JAX would hide an error that passed through it."""
        try:
            return self._small(np.array(u, dtype=float))[which]
        except BaseException as error:  # raised again by __call__
            self._error = error
            return np.full(self._shapes[which].shape, np.nan)

    def _small(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        functions = self.functions
        if functions.cost(u) > self.best * (1.0 + 1e-9):
            # jaxopt asks for the Jacobian of steps that it then rejects, and multiplies it by zero.
            rest = np.sqrt(2.0 * (functions.cost(u) + self._more))
            return np.append(np.zeros(len(u)), rest), np.zeros((len(u) + 1, len(u)))
        return functions.small(u, self._more)

    def start(self, functions: Residuals, u: np.ndarray) -> Any:
        """The state at ``u``."""
        self.functions, self.best = functions, functions.cost(u)
        self._more = self.best
        residual, jacobian = functions.small(u, self._more)
        gradient, squares = jacobian.T @ residual, jacobian.T @ jacobian
        return self._state_type(
            iter_num=np.asarray(0),
            damping_factor=DAMPING * np.diag(squares).max(),
            increase_factor=np.asarray(2.0),
            error=np.linalg.norm(gradient),
            residual=residual,
            value=np.asarray(self.best + self._more),
            delta=np.zeros_like(u),
            gradient=gradient,
            jac=jacobian,
            jt=jacobian.T.copy(),
            jtj=squares,
            hess_res=None,
            aux=None,
        )

    def __call__(self, u: np.ndarray, state: Any) -> tuple[np.ndarray, Any]:
        """The point and the state after a step."""
        jax, _ = _jaxopt()
        u, state = jax.tree.map(np.asarray, tuple(self._solver.update(u, state)))
        if self._error is not None:
            error, self._error = self._error, None
            raise error
        return u, state


class _Bowl:
    """Half of the squared distance to the origin: what :class:`_Steps` is compiled on."""

    def cost(self, u: np.ndarray) -> float:
        return 0.5 * float(u @ u)

    def small(self, u: np.ndarray, more: float) -> tuple[np.ndarray, np.ndarray]:
        return np.append(u, np.sqrt(2.0 * more)), np.vstack([np.eye(len(u)), np.zeros(len(u))])


_aside = ThreadPoolExecutor(1, thread_name_prefix="atmo-jit-steps")


@lru_cache(maxsize=16)
def steps_ahead(size: int) -> Future[_Steps]:
    """Steps for this many unknowns, compiled in a thread of its own: to import and compile them takes about as long as
    the kernels of the first sky, which does not wait for them."""
    return _aside.submit(_compiled, size)


def _compiled(size: int) -> _Steps:
    jax, _ = _jaxopt()
    with jax.enable_x64(True):
        steps, start = _Steps(size), np.ones(size)
        steps(start, steps.start(_Bowl(), start))
    return steps


def _levenberg_marquardt(
    functions: Residuals, start: np.ndarray, max_iterations: int, enough: float, progress: Progress
) -> Solution:
    """Steps of :class:`_Steps` until they gain nothing."""
    steps, u = steps_ahead(len(start)).result(), start
    state = steps.start(functions, start)
    best = steps.best

    def done(u: Any, iterations: int, converged: bool, reason: str) -> Solution:
        return Solution(np.array(u), best, iterations, converged, reason, functions.last_jacobian)

    failures = 0
    for iteration in range(1, max_iterations + 1):
        u_next, state = steps(u, state)
        step, now = state.delta, functions.cost(u + state.delta)
        if not np.all(np.isfinite(step)):
            return done(u, iteration, False, "the data do not depend on a parameter: no step exists")
        gain = best - now
        progress(iteration, min(now, best), u_next if gain > 0.0 else u)
        if gain > 0.0:
            best = steps.best = now
            u, failures = u_next, 0
            if gain < 0.5 * len(start) * enough**2:
                return done(u, iteration, True, f"steps no longer gain {enough:g} standard errors")
            continue
        failures += 1
        # What the step promised; the cost's own rounding may hide less than a small part of a standard error.
        promised = -0.5 * float(step @ state.gradient)
        small = promised < 0.5 * len(start) * max(enough, LEAST_GAIN) ** 2
        if functions.corrections > (TRUSTED if small else 0):
            functions.renewed(u)
            state = steps.start(functions, u)
        elif small or failures > FAILURES:
            reason = "no step lowers the cost" + ("" if small else " although the gradient is not zero")
            return done(u, iteration, small, reason)
    return done(u, max_iterations, False, f"{max_iterations} iterations were not enough")


def _lbfgsb(
    functions: Residuals, start: np.ndarray, max_iterations: int, enough: float, progress: Progress
) -> Solution:
    """L-BFGS-B (Byrd et al. 1995) on the sum itself: SciPy's by way of jaxopt, whose own takes a minute to trace."""
    _, jaxopt = _jaxopt()
    ended: list[Any] = []
    points = [np.asarray(start, float)]

    def both(u: Any, *_: Any, **__: Any) -> Any:
        return functions.cost(u), functions.gradient(u)

    def after(u: Any) -> None:
        points.append(np.array(u, dtype=float))
        change = functions.cost(points[-2]) - functions.cost(points[-1])
        progress(len(points) - 1, functions.cost(points[-1]), points[-1])
        # How far Newton's step would lead.
        ahead = functions.small(u, functions.cost(u))[0][:-1]
        if np.linalg.norm(ahead) < enough * np.sqrt(len(ahead)):
            ended.append(f"the minimum is less than {enough:g} standard errors away")
        elif abs(change) <= COST_TOLERANCE * functions.cost(points[-1]):
            ended.append("the cost no longer changes")
        if ended:
            raise StopIteration

    solver = jaxopt.ScipyBoundedMinimize(
        fun=both,
        method="L-BFGS-B",
        value_and_grad=True,
        jit=False,
        dtype=np.float64,
        maxiter=max_iterations,
        callback=after,
        implicit_diff_solve=None,
    )
    bounds = np.full(start.shape, -FARTHEST), np.full(start.shape, FARTHEST)
    u, info = solver.run(points[0], bounds=bounds)
    if not ended and info.success:
        ended.append("the gradient vanishes")
    u = points[-1] if ended and len(points) > 1 else np.array(u, dtype=float)
    reason = ended[0] if ended else f"{max_iterations} iterations were not enough"
    return Solution(u, functions.cost(u), len(points) - 1, bool(ended), reason, functions.jacobian(u))
