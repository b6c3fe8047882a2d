"""Minimising a sum of squares with jaxopt, which stays behind this module.

Levenberg-Marquardt with Gauss-Newton's Hessian, and L-BFGS-B on the sum itself. The functions that are minimised run
on the host (they call Dr.Jit), so jaxopt runs without jit, one step at a time: that gives progress, and reasons.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

MAX_ITERATIONS = 60
# Part of the standard errors below which a step changes nothing that matters.
STEP_TOLERANCE = 0.1
LEAST_GAIN = 0.1
FAR = 1e6
FORESEEN = 0.5  # part of a step's change that the Jacobian may have missed to be corrected and not computed
COST_TOLERANCE = 1e-10  # relative decrease below which rounding decides


@dataclass(frozen=True)
class Solution:
    """Where a minimisation ended: ``u`` [P], half the sum of squares ``cost``, ``iterations``, whether it
    ``converged``, the ``reason`` it stopped for, and the last ``jacobian`` [M, P], which is that of a point within a
    step of it."""

    u: np.ndarray
    cost: float
    iterations: int
    converged: bool
    reason: str
    jacobian: np.ndarray


class Residuals:
    """Residuals [M] and their Jacobian [M, P] as functions on the host.

    A Jacobian costs many times what residuals cost, so along a path of small steps it is not computed again but
    corrected by what the step has shown (Broyden 1965), as long as it had foreseen most of that.
    """

    def __init__(
        self, residual: Callable[[np.ndarray], np.ndarray], jacobian: Callable[[np.ndarray], np.ndarray]
    ) -> None:
        self._residual, self._jacobian = residual, jacobian
        self._kept: dict[bytes, np.ndarray] = {}
        self._last: tuple[np.ndarray, np.ndarray] | None = None
        self.exact = False

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
        """[M, P] at u: corrected from the last point's, or ``exact``."""
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
                self.exact = False
                return self._last[1]
        return self.renewed(u)

    def renewed(self, u: Any) -> np.ndarray:
        """The exact Jacobian at u."""
        u = np.array(u, dtype=float)
        self._last, self.exact = (u, np.nan_to_num(self._jacobian(u))), True
        return self._last[1]

    @property
    def last_jacobian(self) -> np.ndarray:
        """The Jacobian that was asked for last."""
        return self._last[1]

    def cost(self, u: Any) -> float:
        """Half the sum of squares at u."""
        r = self.residual(u)
        return 0.5 * float(r @ r)


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
    progress: Callable[[int, float], None] | None = None,
) -> Solution:
    """Minimise half the sum of squares from ``start``. ``step_tolerance``: a step that gains less than this part of the
    standard errors (root mean square over the unknowns) is the last. ``progress`` is called with iteration and cost.
    """
    run = {"levenberg_marquardt": _levenberg_marquardt, "lbfgsb": _lbfgsb}[method]
    jax, _ = _jaxopt()
    with jax.enable_x64(True):
        return run(functions, np.asarray(start, float), max_iterations, step_tolerance, progress or (lambda *_: None))


def _levenberg_marquardt(
    functions: Residuals, start: np.ndarray, max_iterations: int, enough: float, progress: Callable[[int, float], None]
) -> Solution:
    """Madsen & Nielsen, Introduction to Optimization and Data Fitting (2010), algorithm 6.18, as jaxopt has it."""
    jax, jaxopt = _jaxopt()
    import jax.numpy as jnp

    best = functions.cost(start)

    @jax.custom_jvp
    def residual(u: Any) -> Any:
        return jnp.asarray(functions.residual(u))

    @residual.defjvp
    def along(primals: Any, tangents: Any) -> Any:
        (u,), (tangent,) = primals, tangents
        # jaxopt asks for the Jacobian of steps that it then rejects, and multiplies it by zero.
        rejected = functions.cost(u) > best * (1.0 + 1e-9)
        jacobian = np.zeros((len(functions.residual(u)), len(start))) if rejected else functions.jacobian(u)
        return residual(u), jnp.asarray(jacobian) @ tangent

    def done(u: Any, iterations: int, converged: bool, reason: str) -> Solution:
        return Solution(np.array(u), best, iterations, converged, reason, functions.last_jacobian)

    solver = jaxopt.LevenbergMarquardt(
        residual, materialize_jac=True, solver="cholesky", jit=False, implicit_diff=False, damping_parameter=1e-4
    )
    u = jnp.asarray(start)
    functions.renewed(start)
    state = solver.init_state(u)
    failures = 0
    for iteration in range(1, max_iterations + 1):
        u_next, state = solver.update(u, state)
        step, now = np.asarray(state.delta), functions.cost(u_next)
        if not np.all(np.isfinite(step)):
            return done(u, iteration, False, "the data do not depend on a parameter: no step exists")
        progress(iteration, min(now, best))
        gain = best - now
        if gain > 0.0:
            best, u, failures = now, u_next, 0
            if gain < 0.5 * len(start) * enough**2:
                return done(u, iteration, True, f"steps no longer gain {enough:g} standard errors")
            continue
        failures += 1
        # What the step promised; the cost's own rounding may hide less than a small part of a standard error.
        promised = -0.5 * float(step @ np.asarray(state.gradient))
        small = promised < 0.5 * len(start) * max(enough, LEAST_GAIN) ** 2
        if not functions.exact:
            functions.renewed(u)
            state = solver.init_state(u)
        elif small or failures > 5:
            reason = "no step lowers the cost" + ("" if small else " although the gradient is not zero")
            return done(u, iteration, small, reason)
    return done(u, max_iterations, False, f"{max_iterations} iterations were not enough")


def _lbfgsb(
    functions: Residuals, start: np.ndarray, max_iterations: int, enough: float, progress: Callable[[int, float], None]
) -> Solution:
    """L-BFGS-B (Byrd et al. 1995), as jaxopt has it, on half the sum of squares."""
    _, jaxopt = _jaxopt()
    import jax.numpy as jnp

    def both(u: Any, *_: Any, **__: Any) -> tuple[Any, Any]:
        r = functions.residual(u)
        return jnp.asarray(0.5 * float(r @ r)), jnp.asarray(functions.jacobian(u).T @ r)

    solver = jaxopt.LBFGSB(both, value_and_grad=True, jit=False, implicit_diff=False, maxiter=max_iterations)
    bounds = (jnp.full(start.shape, -30.0), jnp.full(start.shape, 30.0))
    u = jnp.asarray(start)
    state = solver.init_state(u, bounds=bounds)
    cost = functions.cost(start)
    for iteration in range(1, max_iterations + 1):
        u_next, state = solver.update(u, state, bounds=bounds)
        step = np.asarray(u_next) - np.asarray(u)
        jacobian = functions.jacobian(u_next)
        length = float(np.linalg.norm(jacobian @ step) / np.sqrt(len(step)))
        before, cost, u = cost, functions.cost(u_next), u_next
        progress(iteration, cost)
        if length < enough:
            reason = f"the last step was {length:.1g} standard errors"
            return Solution(np.array(u), cost, iteration, True, reason, jacobian)
        if abs(before - cost) <= COST_TOLERANCE * before:
            return Solution(np.array(u), cost, iteration, True, "the cost no longer changes", jacobian)
    reason = f"{max_iterations} iterations were not enough"
    return Solution(np.array(u), cost, max_iterations, False, reason, functions.jacobian(u))
