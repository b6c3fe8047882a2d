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
STEP_TOLERANCE = 0.02
COST_TOLERANCE = 1e-10  # relative decrease below which rounding decides


@dataclass(frozen=True)
class Solution:
    """Where a minimisation ended: ``u`` [P], half the sum of squares ``cost``, ``iterations``, whether it
    ``converged`` and the ``reason`` it stopped for."""

    u: np.ndarray
    cost: float
    iterations: int
    converged: bool
    reason: str


class Residuals:
    """Residuals [M] and their Jacobian [M, P] as functions on the host; both are kept for the last points."""

    def __init__(
        self, residual: Callable[[np.ndarray], np.ndarray], jacobian: Callable[[np.ndarray], np.ndarray]
    ) -> None:
        self._functions = {"residual": residual, "jacobian": jacobian}
        self._kept: dict[tuple[str, bytes], np.ndarray] = {}

    def _get(self, name: str, u: Any) -> np.ndarray:
        u = np.asarray(u, dtype=float)
        key = name, u.tobytes()
        if key not in self._kept:
            while len(self._kept) >= 8:
                self._kept.pop(next(iter(self._kept)))
            self._kept[key] = self._functions[name](u)
        return self._kept[key]

    def residual(self, u: Any) -> np.ndarray:
        """[M] at u."""
        return self._get("residual", u)

    def jacobian(self, u: Any) -> np.ndarray:
        """[M, P] at u."""
        return self._get("jacobian", u)

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
    """Minimise half the sum of squares from ``start``. ``step_tolerance``: a step shorter than this
    part of the standard errors (root mean square over the unknowns) is the last. ``progress`` is called with iteration
    and cost."""
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
        rejected = functions.cost(u) > best
        jacobian = np.zeros((len(functions.residual(u)), len(start))) if rejected else functions.jacobian(u)
        return residual(u), jnp.asarray(jacobian) @ tangent

    solver = jaxopt.LevenbergMarquardt(
        residual, materialize_jac=True, solver="cholesky", jit=False, implicit_diff=False, damping_parameter=1e-4
    )
    u = jnp.asarray(start)
    state = solver.init_state(u)
    failures = 0
    for iteration in range(1, max_iterations + 1):
        before = best
        hessian = np.asarray(state.jtj)
        u_next, state = solver.update(u, state)
        if not np.all(np.isfinite(np.asarray(state.delta))):
            return Solution(np.asarray(u), best, iteration, False, "the data do not depend on a parameter: no step exists")
        step = np.asarray(state.delta)
        now = float(state.value)
        progress(iteration, min(now, before))
        # The step in standard errors, root mean square: what another iteration would change.
        length = float(np.sqrt(max(step @ hessian @ step, 0.0) / len(step)))
        if now < before:
            best, u, failures = now, u_next, 0
            if length < enough:
                reason = f"the last step was {length:.1g} standard errors"
                return Solution(np.asarray(u), best, iteration, True, reason)
            if before - now < COST_TOLERANCE * before:
                return Solution(np.asarray(u), best, iteration, True, "the cost no longer changes")
        else:
            failures += 1
            if length < enough or failures > 6:
                small = length < 1.0
                reason = "no step lowers the cost" + ("" if small else " although the gradient is not zero")
                return Solution(np.asarray(u), best, iteration, small, reason)
    return Solution(np.asarray(u), best, max_iterations, False, f"{max_iterations} iterations were not enough")


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
            return Solution(np.asarray(u), cost, iteration, True, f"the last step was {length:.1g} standard errors")
        if abs(before - cost) <= COST_TOLERANCE * before:
            return Solution(np.asarray(u), cost, iteration, True, "the cost no longer changes")
    return Solution(np.asarray(u), cost, max_iterations, False, f"{max_iterations} iterations were not enough")
